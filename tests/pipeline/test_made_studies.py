"""Metrics and tables of studies, of made errors: each number is another, and known in closed form."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import skew

from fuselog.pipeline.families.acoustic import study as acoustic
from fuselog.pipeline.families.acoustic.cases import Mode
from fuselog.pipeline.families.los import printed
from fuselog.pipeline.families.los import study as los
from fuselog.pipeline.families.los.cases import ALONE, BLIND, JOINT
from fuselog.pipeline.families.sets import error_bounds, set_filter, set_membership
from fuselog.pipeline.families.tracking import ais, autoferry, crossing
from fuselog.pipeline.families.tracking.study import means_of, nis_metrics
from fuselog.pipeline.families.vehicles import scaling
from fuselog.pipeline.families.vehicles import study as vehicles
from fuselog.pipeline.families.vehicles.cases import Scores
from fuselog.pipeline.output.results import Outcome
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.families.sets.judging.evaluation import JudgedSets

S = 10**9


def names(**columns: Any) -> Any:
    return SimpleNamespace(**columns)


def sets(estimator: str, case: str, area_m2: list[float], flags: str) -> JudgedSets:
    """A frame for each area; its flags say what it is: known, inside, in the arena, within the bound."""
    known, inside, arena, holds = (np.array([mark in each for each in flags.split()]) for mark in "kiab")
    rows = np.arange(len(area_m2))
    return JudgedSets(
        estimator, case, 0 * rows, S * rows, np.array(area_m2), known, inside, arena, holds, len(case)
    )


def test_sets_are_counted_where_there_is_a_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        sets("l8", "robot1", [1.0, 2.0, 9.0, 100.0], "kiab kab ka iab"),
        sets("l8", "robot22", [4.0, 6.0], "kib kb"),
        sets("exact", "robot1", [0.5, 0.5, 3.0, 4.0], "kiab kiab kiab kiab"),
        sets("box", "robot1", [2.0, 2.0, 10.0, 99.0], "kiab kiab kiab kiab"),
    ]
    metrics = set_membership.set_metrics(found)
    wanted = {"frames": 5, "containment_share": 0.4, "area_median_m2": 4.0, "violations": 1}
    wanted |= {"outside_arena": 2, "faults": 13, "frames.robot1": 3, "area_median_m2.robot1": 2.0}
    wanted |= {"containment_share.robot22": 0.5, "outside_arena.robot22": 2, "faults.robot22": 7}
    assert {name: metrics[f"l8.{name}"] for name in wanted} == pytest.approx(wanted)
    assert set_membership._ratios(found, ".free") == {
        "l8.area_ratio_median.free": 3.5,
        "l8.below_box_share.free": 0.5,
        "box.area_ratio_median.free": 4.0,
    }
    asked: list[Any] = []
    runner: Any = names(
        experiment=names(gap_limit_s=0.2),
        obtain=asked.append,
        replay=lambda _: names(outputs={}, sources=[]),
    )
    monkeypatch.setattr(set_membership, "judge_sets", lambda *_: found)
    free = set_membership._without_errors(runner)
    assert (asked, free["l8.below_box_share.error-free"]) == ([{"error_share": 0.0}], 0.5)
    rows = set_membership.frame_table(found[:1]).to_dict("records")
    assert list(rows[2].values()) == ["l8", "robot1", 0, 2 * S, 9.0, True, False, True, False]


def test_filters_of_sets_beside_frames() -> None:
    """Areas by the geometric mean of their ratios, containment by the mean difference, over robots."""
    keys = {"case": ["robot1", "robot2"] * 3, "run": [0, 0, 1, 1, 2, 2]}
    summary = pd.concat(
        [
            pd.DataFrame({"estimator": label, **keys, "area_m2": area * 3, "inside": inside * 3})
            for label, area, inside in (
                (set_filter.FILTER, [1.0, 4.0], [0.9, 0.8]),
                (set_filter.EKF, [2.0, 2.0], [0.5, 0.6]),
            )
        ]
    )
    outcome = Outcome()
    set_filter._compare(summary, outcome)
    key = f"{set_filter.FILTER}.{{}}.{set_filter.EKF}"
    assert outcome.metrics[key.format("area_ratio")] == pytest.approx(1.0)
    assert outcome.metrics[key.format("containment_gain")] == pytest.approx(0.3)
    low, high = outcome.intervals[key.format("area_ratio")]
    assert low == pytest.approx(1.0 / high)  # type: ignore[operator]
    table = pd.DataFrame({"estimator": "a", "case": "b", "run": 0, "inside": [True, False, True, True]})
    [row] = set_filter.summarise(table.assign(area_m2=[0.0, 1.0, 2.0, 9.0])).to_dict("records")
    assert (row["area_m2"], row["inside"]) == (2.0, 0.75)
    findings = ["CONTRADICTS_PAST", "FRAME_WRONG", "UNDECIDED", "PAST_WRONG", "UNDECIDED", "UNDECIDED"]
    numbers = np.array([getattr(set_filter, name) for name in findings])
    holds = np.array([False, True, False, True, True, True])  # of frames 0 and 2, which were doubted
    judged = names(sets=names(estimator="f"), finding=numbers, frame_holds=holds)
    assert set_filter.isolation_metrics([judged]) == {
        "f.isolated_rightly": 1.0,
        "f.isolated_wrongly": 1.0,
        "f.undecided": 2.0,
    }


def test_bounds_of_odometry_are_an_offset_and_a_rate() -> None:
    """Short spans make the offset, the longest one the rate here; of both robots the larger counts."""
    odometry = np.outer([1.0, 2.0, 3.0, 3.0, 3.0, 23.0], [1.0, 0.1])
    errors = error_bounds.RobotErrors(np.array([0.1, 0.3]), np.array([0.5]), odometry)
    smaller = error_bounds.RobotErrors(np.array([0.2]), np.array([0.7, 0.6]), 0.5 * odometry)
    options = error_bounds.BoundOptions(margin=1.5, bearing_quantile=0.5)
    driven, bearings = error_bounds._bounds([errors, smaller], options)
    assert list(driven.values()) == pytest.approx([4.5, 1.5, 0.45, 0.15])
    assert bearings == pytest.approx({"bound_rad": 0.6, "bearing_bound_rad": 0.2})


def scores(fixed: list[float], assigned: list[float]) -> Scores:
    """Two steps of three runs, whose squared errors are known by the place."""
    by_step = np.array([[1.0, 4.0], [9.0, 16.0], [np.nan, 100.0]])
    return Scores(np.array(fixed), np.array(assigned), by_step, 4.0 * by_step, by_step / 2.0, 1)


def test_vehicles_have_means_medians_and_a_share_below_the_reference() -> None:
    found = {"kf": scores([1.0, 2.0, 6.0], [3.0, 4.0, 8.0]), "x": scores([0.5, 3.0, np.nan], [0.0] * 3)}
    metrics = vehicles._metrics("cv", found, "kf")
    wanted = {"total_error_m": 3.0, "median_total_error_m": 2.0, "assigned_total_error_m": 5.0}
    wanted |= {"median_assigned_total_error_m": 4.0, "gospa_m": 13.0, "failed_runs": 1.0}
    assert metrics == pytest.approx(
        {f"kf.{name}.cv": value for name, value in wanted.items()}
        | {"x.total_error_m.cv": 1.75, "x.median_total_error_m.cv": 1.75, "x.gospa_m.cv": 13.0}
        | {"x.assigned_total_error_m.cv": 0.0, "x.median_assigned_total_error_m.cv": 0.0}
        | {"x.failed_runs.cv": 1.0, "kf.share_below_reference.cv": 0.0}
        | {"x.share_below_reference.cv": 1 / 3}
    )
    table = vehicles._steps(names(name="cv", scores={"kf": found["kf"]}))
    assert table["error_m"].tolist() == pytest.approx([5.0**0.5, 40.0**0.5])
    assert table["assigned_error_m"].tolist() == pytest.approx([20.0**0.5, 160.0**0.5])
    assert table["assigned_median_m"].tolist() == pytest.approx([20.0**0.5, 8.0])
    assert (table["step"].tolist(), table["gospa_m"].tolist()) == ([1, 2], [2.5, 20.0])
    of_field = names(obtain=lambda over: over)
    options: Any = names(area_per_vehicle_m2=25.0, together_m=4.0)
    apart, near = (scaling._record(of_field, options, 4, place) for place in ("apart", "together"))
    assert apart == {"vehicles": 4, "field_m": (-5.0, 5.0, -5.0, 5.0)}  # type: ignore[comparison-overlap]
    assert near == {"vehicles": 4, "field_m": (-2.0, 2.0, -2.0, 2.0)}  # type: ignore[comparison-overlap]


def test_growth_of_a_difference_is_from_the_least_clutter_to_the_most() -> None:
    rows = [
        {"detection_probability": 0.9, "estimator": label, "run": str(run), "clutter_per_scan": clutter}
        | {"gospa_m": slope * clutter + 10.0 * run}
        for label, slope in (("jpda", 3.0), ("gnn", 1.0))
        for run in (0, 1)
        for clutter in (5.0, 50.0, 20.0)
    ]
    outcome = Outcome()
    crossing._measure_growth(pd.DataFrame(rows), [("jpda", "gnn"), ("jpda", "absent")], outcome)
    assert outcome.metrics == {"jpda.growth_of_change_m.gnn-detection-90": pytest.approx(90.0)}
    means = means_of(pd.DataFrame(rows).drop(columns=["detection_probability"]))
    assert {label: mean["gospa_m"] for label, mean in means.items()} == {"jpda": 80.0, "gnn": 30.0}
    parts = {"estimator": "gnn", "case": "radar", "degrees": np.array([2, 1])}
    found = nis_metrics([names(squared=np.array([5.0, 1.0]), **parts)])
    assert found == {"gnn.nis_per_component.radar": 2.0}
    arrived = names(log_time_ns=np.array([1, 7, 5]), publish_time_ns=np.array([1, 3, 5]))
    later = names(log_time_ns=np.array([9]), publish_time_ns=np.array([9]))
    source: Any = names(streams={"/radar/scan": arrived, "/other": later, "/lidar/scan": later})
    assert autoferry._last_late_ns(source) == 7


def test_only_who_waits_for_late_scans_knows_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each way is replayed in the order of arrival, and tracks of who waits 0.5 s are judged so late."""
    asked: list[Any] = []

    def replayed(*_: Any, order: str, late: Any) -> Any:
        asked.append((order, late.policy, late.window_ns))
        return {}

    def tabled(outputs: Any, labels: list[str], runs: Any, delay_s: float) -> pd.DataFrame:
        return pd.DataFrame({"estimator": labels, "run": [*runs], "delay_s": delay_s})

    monkeypatch.setattr(autoferry, "replay_in_memory", replayed)
    monkeypatch.setattr(autoferry, "table_of", tabled)
    monkeypatch.setattr(autoferry, "_farthest", lambda *given: float(given[-1]))
    monkeypatch.setattr(autoferry, "_last_late_ns", lambda source: source + 7)
    options = autoferry.AutoferryOptions(
        late=("wait:0.5", "rewind:2", "drop"), late_estimators=("jpda", "not run")
    )
    experiment: Any = names(estimators={"jpda": {}, "gnn": {}})
    found = autoferry._late_table(experiment, options, [1], {}, {"one": SimpleNamespace()})
    assert asked == [
        ("log_time", "wait", S // 2),
        ("log_time", "rewind", 2 * S),
        ("log_time", "drop", 0),
    ]
    assert found["policy"].tolist() == ["wait", "rewind", "drop"]
    assert found["delay_s"].tolist() == [0.5, 0.0, 0.0]
    assert found["from_in_order_m"].tolist() == [8.0] * 3


def test_vessels_are_drawn_best_first_and_those_heard_of_late_are_counted() -> None:
    """Shares of vessels that are heard often alone; a vessel is live for 30 s, a track as well."""
    shares = {"a": [0.2, 0.9, 0.5, 0.7, 1.0], "b": [0.3, 0.1, 0.4, 0.6, 1.0]}
    reports = [ais.MANY_REPORTS + 1] * 4 + [ais.MANY_REPORTS]
    vessels = pd.concat(
        [pd.DataFrame({"estimator": of, "share": own, "reports": reports}) for of, own in shares.items()]
    )
    identity = make_stream(
        "/identity", schemas.IDENTITY, S * np.array([10, 20, 100]), thing_id=[1, 2, 1]
    )
    source = names(epoch_ns=10 * S, read=lambda _: {"/identity": identity})
    chart = ais.tracks_chart(names(sources=[source], judged=[]), vessels, ais.AisOptions(live_s=30.0))
    above, below = chart.panels
    drawn = {each.label: (each.x, each.y) for each in (*above.series, *below.series)}
    assert drawn == {
        "a": ([0, 1, 2, 3], [0.9, 0.7, 0.5, 0.2]),
        "b": ([0, 1, 2, 3], [0.6, 0.4, 0.3, 0.1]),
        f"kept: {ais.KEPT_SHARE:g}": ([0, 3], [ais.KEPT_SHARE] * 2),
        "vessels": ([0, 10, 30, 40, 90], [1, 2, 1, 0, 1]),
    }


def of_sensor(scheme_m: dict[str, float]) -> Any:
    """A case of one target and two biases over two repetitions of two runs, known in closed form."""
    bias_mrad = np.array([[[1.0, 6.0], [3.0, 2.0]], [[np.nan, np.nan], [5.0, 4.0]]])
    return names(
        condition="c",
        number=1,
        targets=1,
        nees=np.array([[1.0, 2.0], [3.0, np.nan]]),
        nees_at_estimate=np.array([[4.0, 6.0], [8.0, 8.0]]),
        bias_error_mrad=bias_mrad,
        sigma_mrad=np.array([2.0, 8.0]),
        component_nees=np.array([0.5, 0.7]),
        truth=np.zeros(5),
        converged={scheme: 0.1 * length for scheme, length in scheme_m.items()},
        iterations={scheme: int(length) for scheme, length in scheme_m.items()},
        position_rmse_m=lambda scheme: np.array([scheme_m[scheme]]),
        position_error_m=lambda scheme: scheme_m[scheme] * np.array([[[0.5], [1.5]], [[1.0], [1.0]]]),
        dilution=lambda: np.array([[7.0, 9.0]]),
        parameters=names(target_position_m=[[10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [10.0, 1.0, 0.0]]),
        scene=names(
            position_m=np.zeros((2, 3)), wanted=np.array([True, False, True, False, False, False])
        ),
    )


def test_tables_of_lines_of_sight(monkeypatch: pytest.MonkeyPatch) -> None:
    case = of_sensor({ALONE: 3.0, BLIND: 4.0, JOINT: 2.0})
    monkeypatch.setattr(los, "steepest_deg", lambda _: 80.0)
    found = los._metrics(case)
    first, second = (35 / 3) ** 0.5, (56 / 3) ** 0.5
    wanted = {"nees_at_truth": 2.0, "nees_at_estimate": 6.5, "bias_rmse_mrad": [first, second]}
    wanted |= {"bias_sigma_mrad": [2.0, 8.0], "component_nees": [0.5, 0.7], "parameters": 5.0}
    wanted |= {"repetitions": 2.0, "position_rmse_m": [2.0], "converged_share": 0.2}
    wanted |= {"most_iterations": 2.0}
    for name, value in wanted.items():
        assert found[f"{JOINT}.{name}.c-1"] == pytest.approx(value), name
    assert [found[f"{scheme}.position_rmse_m.c-1"] for scheme in (ALONE, BLIND)] == [[3.0], [4.0]]
    assert found["scene.steepest_deg.c-1"] == 80.0
    paper: Any = names(
        runs=4,
        table_of_positions="II",
        position_scenario=1,
        position_rmse_m={ALONE: [3.5]},
        bias_rmse_mrad=[[1.1, 1.2]],
        bias_sigma_mrad=[[1.0, 2.0]],
        bias_mean_mrad=[[1.5, 1.6]],
    )
    positions = los._table_of_positions([case], paper).to_dict("records")
    assert [row["ours_rmse_m"] for row in positions] == [3.0, 4.0, 2.0]
    assert positions[0]["paper_rmse_m"] == 3.5
    biases = los._table_of_biases([case], paper).to_dict("list")
    for name, values in {
        "bias": ["yaw1", "roll1"],
        "paper_rmse_mrad": [1.1, 1.2],
        "paper_sigma_mrad": [1.0, 2.0],
        "paper_mean_mrad": [1.5, 1.6],
        "ours_rmse_mrad": [first, second],
        "ours_sigma_mrad": [2.0, 8.0],
        "ours_mean_mrad": [2.0, 4.0],
        "paper_bound_mrad": [1.0, 2.0],
        "ours_bound_mrad": [2.0 * 2.0 / 2**0.5, 2.0 * 8.0 / 2**0.5],
    }.items():
        assert biases[name] == (values if name == "bias" else pytest.approx(values)), name
    nees = los._table_of_nees([case])
    assert nees["nees_at_truth"].tolist() == [1.5, 3.0]
    assert nees["nees_at_estimate"].tolist() == [5.0, 8.0]
    dilution = los._table_of_dilution([case]).to_dict("records")
    assert [(row["target"], row["sensor"], row["gdop"]) for row in dilution] == [
        (1, 1, 7.0),
        (1, 2, 9.0),
    ]
    monkeypatch.setattr(los, "one_bias_known", lambda _: np.arange(36.0).reshape(6, 6))
    known = los._table_of_one_bias_known([case])
    biases_of = [f"{angle}{sensor}" for sensor in (1, 2) for angle in ("yaw", "pitch", "roll")]
    assert known["known"].tolist() == biases_of
    assert [*known][2:] == [f"sigma_{name}_mrad" for name in biases_of]
    assert known["sigma_roll1_mrad"].tolist() == [2.0, 8.0, 14.0, 20.0, 26.0, 32.0]
    assert printed._widest_span_deg(case) == pytest.approx(90.0)
    beside = printed.metrics_beside_print(case, paper)
    assert beside[f"{JOINT}.sigma_by_printed.c-1"] == [2.0, 4.0]
    assert beside[f"{JOINT}.rmse_rule.c-1"] == pytest.approx(printed.RULE * 2.0**0.5)
    assert beside[f"{JOINT}.mean_error_rule_share.c-1"] == 0.75  # of 2, 5 with 2.8; 4, 4 with 11.3


def test_shots_are_judged_by_mode_and_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds of 3 and 4 m; errors of the position of 5 m and of 60 m, which is far."""

    def mode(scale: float) -> Mode:
        bound = np.diag([9.0, 16.0, 0.25])
        error = scale * np.array(
            [[[3.0, 4.0, 1.0], [36.0, 48.0, 3.0]], [[-3.0, -4.0, 1.0], [0.0, 5.0, 1.0]]]
        )
        nees = scale * np.array([[1.0, 2.0], [3.0, 10.0]])
        return Mode(["x_m", "y_m", "sensor_1_x_m"], bound, error, nees, 0.5 * scale)

    def case(multiplier: float) -> Any:
        modes = {acoustic.NATIVE: mode(multiplier), acoustic.LOCAL: mode(1.0)}
        return names(
            number=2, multiplier=multiplier, modes=modes, parameters=names(sigma_position_m=2.0)
        )

    ranges = {3: (np.array([1.0, 2.0, 9.0]), 0.5)}
    monkeypatch.setattr(acoustic, "range_errors_m", lambda _: ranges)
    monkeypatch.setattr(acoustic, "hearing", lambda _: [3.0])
    cases = [case(1.0), case(2.0)]
    metrics = acoustic._metrics(cases)
    rmse_m = ((25.0 + 3600.0 + 25.0 + 25.0) / 4) ** 0.5
    for name, value in {
        "nees": 4.0,
        "position_rmse_m": rmse_m,
        "position_bound_m": 5.0,
        "ellipse_area_m2": -2.0 * np.log(0.05) * np.pi * 12.0,
        "far_per_1000": 250.0,
        "converged_share": 0.5,
        "nees_by_noise": [4.0, 8.0],
        "median_nees_by_noise": [2.5, 5.0],
        "converged_share_by_noise": [0.5, 1.0],
        "position_rmse_m_by_noise": [rmse_m, 2.0 * rmse_m],
        "position_bound_m_by_noise": [5.0, 5.0],
    }.items():
        assert metrics[f"{acoustic.NATIVE}.{name}.scenario-2"] == pytest.approx(value), name
    assert metrics[f"{acoustic.NATIVE}.sensor_gain_percent.scenario-2-sensor_1_x_m"] == 75.0
    assert metrics[f"{acoustic.LOCAL}.far_per_1000_at_most_noise.scenario-2"] == 250.0
    assert metrics["range.mean_error_m.scenario-2"] == [4.0]
    assert metrics["range.skew.scenario-2"] == [pytest.approx(skew([1.0, 2.0, 9.0]))]
    [row] = acoustic._table_of_range_errors(cases).to_dict("records")
    assert list(row.values()) == pytest.approx(
        [2, 3, 4.0, np.std([1.0, 2.0, 9.0]), 0.5, skew([1, 2, 9])]
    )
    ellipses = acoustic._table_of_ellipses(cases).to_dict("records")
    spread = np.cov([[3.0, 36.0, -3.0, 0.0], [4.0, 48.0, -4.0, 5.0]])
    for place, label in enumerate((acoustic.NATIVE, acoustic.LOCAL)):
        bound_m2, area_m2 = (
            -2.0 * np.log(0.05) * np.pi * each for each in (12.0, np.linalg.det(spread) ** 0.5)
        )
        assert [*ellipses[place].values()] == [2, label, *map(pytest.approx, (bound_m2, area_m2, 5.0))]
    parts = acoustic._table_of_components(cases).to_dict("list")
    assert parts["rmse"][2] == pytest.approx(3.0**0.5)
    assert parts["sigma"][:3] == [3.0, 4.0, 0.5]
    assert parts["mean_error"][:3] == pytest.approx([9.0, 13.25, 1.5])
    assert parts["mean_error_bound"][:3] == pytest.approx([3.0, 4.0, 0.5])
    assert parts["nees"][2] == pytest.approx(12.0)
    maps = pd.DataFrame(
        {"mode": "m", "aim_x_m": 1.0, "aim_y_m": 2.0, "x_m": [3.0, 4, 5], "y_m": [6.0, 7, 8]}
    )
    assert acoustic._metrics_of_maps(maps.assign(y_m=[6.0, 7, 8], ratio=[1.0, 9.0, 2.0])) == {
        "m.map_aim_m": [1.0, 2.0],
        "m.map_best_place_m": [4.0, 7.0],
        "m.map_best_ratio": 9.0,
        "m.map_median_ratio": 2.0,
    }
