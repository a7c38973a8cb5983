"""What the charts of studies hold of tables that are made: which rows of whom, in which unit."""

from collections.abc import Callable
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t

from fuselog.pipeline.families.acoustic import recordings, sequence
from fuselog.pipeline.families.biometrics import sequential
from fuselog.pipeline.families.directional import orientation, torus, torus_real
from fuselog.pipeline.families.los import moving
from fuselog.pipeline.families.networks import cooperative, cooperative_stress, quad_inertial, stress
from fuselog.pipeline.families.networks import study as networks
from fuselog.pipeline.families.ranging import study as ranging
from fuselog.pipeline.families.sampling import extended_target, lrkf_dimension, reactor
from fuselog.pipeline.families.sets import set_filter, set_membership
from fuselog.pipeline.families.tracking import autoferry, crossing
from fuselog.pipeline.families.vehicles import scaling
from fuselog.pipeline.families.vehicles import study as vehicles
from fuselog.pipeline.output.charts import Chart
from fuselog.pipeline.studies.navigation import gnss_ins, imu_grades, outages
from tests.pipeline.test_charts import held, same

Wanted = dict[str, dict[str, Any]]
BOTH = ["ekf", "ukf"]


def made(*quantities: str, **levels: list[Any]) -> pd.DataFrame:
    """A row for each combination of levels; of the quantities' numbers no two are alike."""
    table = pd.DataFrame(list(product(*levels.values())), columns=list(levels))
    rng = np.random.default_rng(0)
    return table.assign(**{each: rng.uniform(1.0, 2.0, len(table)) for each in quantities})


def over(
    table: pd.DataFrame, x: str, y: str, of: Callable[[list[float]], Any] = np.mean, **where: Any
) -> list[list[Any]]:
    """The places of `x` in the rows where columns have these values, and what `y` is at each."""
    rows = [
        row for row in table.to_dict("records") if all(row[key] == each for key, each in where.items())
    ]
    places = list(dict.fromkeys(row[x] for row in rows))
    return [places, [of([row[y] for row in rows if row[x] == place]) for place in places]]


def of_both(table: pd.DataFrame, x: str, y: str, **where: Any) -> dict[str, Any]:
    return {each: over(table, x, y, estimator=each, **where) for each in BOTH}


def of_moving_sights() -> tuple[Chart, Wanted]:
    """Root mean squares in mrad; who knows nothing of biases has no curve."""
    labels = {
        "common_roll_rad2": "RMSE of the common roll (mrad)",
        "bias_rad2": "RMSE of a bias (mrad)",
        "nees_per_component": "NEES for each component",
    }
    table = made(
        *labels, case=["still", "fast"], run=[0, 1], estimator=[*BOTH, "unaware"], second=[1, 2]
    )
    wanted: Wanted = {
        f"{case}: {label} over time (s)": of_both(table, "second", name, case=case)
        for (name, label), case in product(labels.items(), ("still", "fast"))
    }
    for name, own in wanted.items():
        if "NEES" in name:
            own["ideal"] = [[1, 2], [1, 1]]
        else:
            own |= {key: [x, 1e3 * np.sqrt(y)] for key, (x, y) in own.items()}
    return moving._chart(table), wanted


def of_losses() -> tuple[Chart, Wanted]:
    table = made("nees", "rmse_ratio", loss=[0.0, 0.5, 0.9], estimator=BOTH)
    wanted = of_both(table, "loss", "nees") | {"consistent": [[0.0, 0.9], [4, 4]]}
    return networks._loss_chart(table), {"mean NEES (4 states) over share of messages lost": wanted}


def of_robots() -> tuple[Chart, Wanted]:
    table = made("position_rmse_m", "position_nees", estimator=BOTH, robot=["robot1", "robot2"])
    metrics = {
        f"{row['estimator']}.{name}.{row['robot']}": row[name]
        for row in table.to_dict("records")
        for name in ("position_rmse_m", "position_nees")
    }
    consistent = {"consistent": [["robot1", "robot2"], [2, 2]]}
    return cooperative.mode_chart({**metrics, "ekf.position_nees.said": "no number"}, BOTH), {
        "RMSE of the position (m) over ": of_both(table, "robot", "position_rmse_m"),
        "NEES of the position over ": of_both(table, "robot", "position_nees") | consistent,
    }


def of_bandwidth() -> tuple[Chart, Wanted]:
    """Over bytes that rise, however the rows stand."""
    names = {"position_rmse_m": "RMSE of the position (m)", "nees": "mean NEES (4 states)"}
    table = made(*names, estimator=BOTH, policy=["all", "few"], bytes_per_s=[10.0, 30.0])
    wanted: Wanted = {
        f"{label} over sent by a node (B/s)": {
            f"{each}, {policy}": over(table, "bytes_per_s", name, estimator=each, policy=policy)
            for each, policy in product(BOTH, ("all", "few"))
        }
        for name, label in names.items()
    }
    wanted["mean NEES (4 states) over sent by a node (B/s)"]["consistent"] = [[10, 30], [4, 4]]
    return stress._bandwidth_chart(table[::-1]), wanted


def of_lies() -> tuple[Chart, Wanted]:
    names = {
        "position_rmse_m": "RMSE of the other nodes (m)",
        "nees": "mean NEES of the other nodes",
        "liar_refused": "share of the liar's messages rejected",
    }
    table = made(*names, estimator=BOTH, lie_m=[0.0, 5.0])
    return stress._lie_chart(table), {
        f"{label} over lie (m)": of_both(table, "lie_m", name) for name, label in names.items()
    }


def of_seldom_sharing() -> tuple[Chart, Wanted]:
    """Means over the robots, of those that share once in a while or always."""
    names = {"position_rmse_m": "RMSE of the position (m)", "position_nees": "NEES of the position"}
    table = made(*names, estimator=BOTH, case=["calm", "once-2s", "leaves"], robot=[1, 2])
    table["bytes_per_s"] = table["case"].map({"calm": 50.0, "once-2s": 5.0, "leaves": 1.0})
    shared = table[table["case"] != "leaves"].sort_values("bytes_per_s", kind="stable")
    wanted: Wanted = {
        f"{label} over sent by a robot (B/s)": of_both(shared, "bytes_per_s", name)
        for name, label in names.items()
    }
    wanted["NEES of the position over sent by a robot (B/s)"]["consistent"] = [[5, 50], [2, 2]]
    return cooperative_stress._chart(table), wanted


def of_shots() -> tuple[Chart, Wanted]:
    table = made("error_m", case=["clean", "wrong"], estimator=BOTH, run=[0, 1, 2], shot=[0, 1])
    wanted: Wanted = {
        f"{case}: median error (m) over shot": {
            each: over(table, "shot", "error_m", np.median, case=case, estimator=each) for each in BOTH
        }
        for case in ("clean", "wrong")
    }
    return sequence._chart(table), wanted


def of_sounds() -> tuple[Chart, Wanted]:
    """The share of errors that are at most as large."""
    table = pd.DataFrame({"snr_db": [10.0] * 4 + [0.0] * 2, "error_m": [4.0, 1, 3, 2, 6, 5]})
    own = {"10 dB": [[1, 2, 3, 4], [0.25, 0.5, 0.75, 1]], "0 dB": [[5, 6], [0.5, 1]]}
    return recordings._chart(table), {"share of sounds with a smaller error over error (m)": own}


def of_units() -> tuple[Chart, Wanted]:
    """Of the smoother alone."""
    names = {"position_rmse_m": "position RMSE (m)", "heading_rmse_deg": "heading RMSE (deg)"}
    levels: dict[str, list[Any]] = {"offset": ["none", "found"], "units": ["one", "mean"]}
    table = made(*names, estimator=BOTH, **levels, recording=["a", "b"])
    wanted: Wanted = {
        f"{label} over recording": {
            f"{units}, {offset}": over(
                table, "recording", y, estimator="ukf", offset=offset, units=units
            )
            for offset, units in product(*levels.values())
        }
        for y, label in names.items()
    }
    options: Any = SimpleNamespace(smoother="ukf")
    return quad_inertial._chart(table, options), wanted


def of_outages() -> tuple[Chart, Wanted]:
    """Root mean squares over the windows of a length."""
    table = made("error_m", estimator=BOTH, length_s=[20.0, 5.0], window=["a", "b"], since_s=[0.5, 1.0])
    axes = "horizontal error (m) over since the fixes are withheld (s)"
    root = outages._root_mean_square
    wanted: Wanted = {
        f"{length:g} s, 2 windows: {axes}": {
            each: over(table, "since_s", "error_m", root, estimator=each, length_s=length)
            for each in BOTH
        }
        for length in (5.0, 20.0)
    }
    return gnss_ins._chart(table), wanted


def of_grades() -> tuple[Chart, Wanted]:
    table = made("error_m", grade=["phone", "tactical"], estimator=BOTH, after_s=[10.0, 20.0])
    wanted = {
        f"{grade}, {each}": over(table, "after_s", "error_m", grade=grade, estimator=each)
        for grade, each in product(("phone", "tactical"), BOTH)
    }
    name = "95 % of drives are within (m) over time since the last fix (s)"
    return imu_grades._chart(table), {name: wanted}


def of_kinds_of_movement() -> tuple[Chart, Wanted]:
    parts = ("total", "heading", "inclination")
    table = made(*(f"{part}_deg" for part in parts), estimator=BOTH, kind=["slow", "fast"])
    return orientation._chart(table), {
        f"{part} RMSE (deg) over trials": of_both(table, "kind", f"{part}_deg") for part in parts
    }


def of_bounded_sets() -> tuple[Chart, Wanted]:
    """A metric that is missing has no mark."""
    metrics = {"box.containment_share": 1.0, "box.area_median_m2": 3.0, "l4.containment_share": 0.5}
    labels = ("share of sets that contain the truth", "median area (m²)")
    values = ([1.0, 0.5], [3.0, np.nan])
    return set_membership._bounds_chart(metrics), {
        f"{label} over ": {label: [["box", "l4"], own]}
        for label, own in zip(labels, values, strict=True)
    }


def of_filtered_sets() -> tuple[Chart, Wanted]:
    """Of the first run."""
    table = made("area_m2", "inside", run=[0, 1], estimator=BOTH, case=["robot1", "robot2"])
    labels = {"area_m2": "median area (m²)", "inside": "share of frames with the robot inside"}
    return set_filter._chart(table), {
        f"{label} over ": of_both(table, "case", name, run=0) for name, label in labels.items()
    }


def of_clutter() -> tuple[Chart, Wanted]:
    """Means over five runs with Student's interval."""
    levels: dict[str, list[Any]] = {"estimator": BOTH, "clutter_per_scan": [0.0, 10.0]}
    table = made("gospa_m", detection_probability=[0.9, 0.5], run=[*range(5)], **levels)
    half = t.ppf(0.975, 4) / np.sqrt(5)
    wanted: Wanted = {}
    for probability in (0.9, 0.5):
        own = wanted[
            f"probability of detection {probability:g}: mean GOSPA (m) over false detections in a scan"
        ] = {}
        for each in BOTH:
            where = {"estimator": each, "detection_probability": probability}
            x, mean = over(table, "clutter_per_scan", "gospa_m", **where)
            spread = over(table, "clutter_per_scan", "gospa_m", lambda of: np.std(of, ddof=1), **where)[
                1
            ]
            own[each] = [x, mean]
            own[f"{each} band"] = [x, np.subtract(mean, half * np.array(spread)),
                                   np.add(mean, half * np.array(spread))]  # fmt: skip
    return crossing._chart(table), wanted


def of_ferries() -> tuple[Chart, Wanted]:
    table = made("gospa_m", run=["s2", "s13"], estimator=BOTH)
    wanted = of_both(table, "run", "gospa_m")
    return autoferry._chart(table), {"mean GOSPA (m) over scenario": wanted}


def of_ranges() -> tuple[Chart, Wanted]:
    """Seconds since the first of all estimates; thinned to 600, the first and the last among them."""
    stamps = 10**9 * np.arange(7, 7 + 900)
    error = np.sqrt(np.arange(900.0))
    chart = ranging.errors_chart({"ekf": (stamps, error), "ukf": (stamps[5:7], error[:2])}, "error (m)")
    [panel] = chart.panels
    ekf, ukf = panel.series
    assert (len(ekf.x), ekf.x[0], ekf.x[-1]) == (600, 0.0, 899.0)
    assert ekf.y == pytest.approx(np.sqrt(np.array(ekf.x, float)), rel=1e-6)
    assert (ukf.x, ukf.y) == ([5.0, 6.0], [0.0, 1.0])
    return chart, {"error (m) over time (s)": {each.label: [each.x, each.y] for each in (ekf, ukf)}}


def of_vehicles() -> tuple[Chart, Wanted]:
    """Roots of medians over the runs, of which one failed at the second step."""
    squared = np.array([[1.0, 4.0], [9.0, np.nan], [25.0, 16.0]])
    case: Any = SimpleNamespace(name="turning", scores={"kf": SimpleNamespace(assigned_by_step=squared)})
    own = {"kf": [[1, 2], [3.0, np.sqrt(10.0)]]}
    return vehicles._chart(case), {"median error of all vehicles (m) over step": own}


def of_numbers_of_vehicles() -> tuple[Chart, Wanted]:
    names = {"step_ms": "CPU time per step (ms)", "position_rmse_m": "error per vehicle (m)"}
    table = made(*names, estimator=BOTH, vehicles=[2, 5, 10])
    return scaling._chart(table), {
        f"{label} over vehicles": of_both(table, "vehicles", name) for name, label in names.items()
    }


def of_tests_in_sequence() -> tuple[Chart, Wanted]:
    rates = [(0.01, 0.001), (0.1, 0.05)]
    labels = {
        "false_accept": "false accepts (share)",
        "genuine_probes": "mean number of probes of the person",
    }
    table = made(
        "value", way=list(sequential.WAYS), rates=rates, quantity=list(labels), matcher=["A", "B"]
    )
    said = dict(zip(rates, ("1 % and 0.1 %", "10 % and 5 %"), strict=True))
    wanted: Wanted = {
        f"{label} over matcher": {
            f"{words}, {said[of]}": over(table, "matcher", "value", way=way, rates=of, quantity=name)
            for (way, words), of in product(sequential.WAYS.items(), rates)
        }
        for name, label in labels.items()
    }
    options: Any = SimpleNamespace(rates=rates)
    return sequential._chart_of_tests(table, options), wanted


def of_winds() -> tuple[Chart, Wanted]:
    """Sums from the half on, less those of persistence."""
    table = pd.DataFrame(
        {
            "hour": [1, 2, 3] * 2,
            "predictor": ["persistence"] * 3 + ["torus"] * 3,
            "log_density": [9.0, 1.0, 2.0, 0.0, 4.0, 7.0],
        }
    )
    own = {"torus": [[2, 3], [3.0, 8.0]]}
    return torus_real._chart(table, 2), {
        "cumulative log density minus that of persistence over hour": own
    }


def of_moved_samples() -> tuple[Chart, Wanted]:
    names = {
        "mean_error_rad": "error of the mean (rad)",
        "covariance_error_rad2": "error of the covariance (rad²)",
    }
    table = made(*names, coupling_rad=[0.1, 1.0], samples=["five", "ukf"], correlation=[-0.5, 0.5])
    options: Any = SimpleNamespace(couplings_rad=(0.1, 1.0))
    return torus.propagation_chart(table, options), {
        f"c = {coupling:g} rad: {label} over correlation": {
            each: over(table, "correlation", name, samples=each, coupling_rad=coupling)
            for each in ("five", "ukf")
        }
        for (name, label), coupling in product(names.items(), (0.1, 1.0))
    }


def of_drives() -> tuple[Chart, Wanted]:
    """Families of samplings over their numbers; the extended filter is a level."""
    levels: dict[str, list[Any]] = {"run": [0, 1], "estimator": ["smart-5", "smart-9", "ekf"]}
    samples = {"smart-5": 5.0, "smart-9": 9.0, "ekf": np.nan}
    [direction, words] = next(iter(lrkf_dimension.DIRECTIONS.items()))
    moments = made("mean_error", direction=[direction], dimension=[2, 4], **levels)
    drives = made("position_rmse_m", "cpu_ms_per_s", drive=["slow"], dimension=[7], **levels)
    wanted: Wanted = {}
    for table, quantity, label, title, where in (
        (moments, "mean_error", "error of the mean (sigma)", f"waves {words}, N = 2", {"dimension": 2}),
        (moments, "mean_error", "error of the mean (sigma)", f"waves {words}, N = 4", {"dimension": 4}),
        (drives, "position_rmse_m", "RMSE of the position (m)", "slow, 7 states", {}),
        (drives, "cpu_ms_per_s", "CPU time per second of log (ms)", "slow, 7 states", {}),
    ):
        table["samples"] = table["estimator"].map(samples)
        means = dict(zip(*over(table, "estimator", quantity, **where), strict=True))
        wanted[f"{title}: {label} over samples"] = {
            "smart": [[5, 9], [means["smart-5"], means["smart-9"]]],
            "ekf": [lrkf_dimension.X_LIMITS, [means["ekf"]] * 2],
        }
    return lrkf_dimension._chart(moments, drives), wanted


def of_the_reactor() -> tuple[Chart, Wanted]:
    """What approximates, beside the exact moments that it is judged by."""
    names = {"mean_rmse": "RMSE of the mean", "covariance_rmse": "RMSE of the covariance"}
    table = made(*names, estimator=[*BOTH, reactor.REFERENCE], step=[1, 2])
    return reactor.error_chart(table, "cold"), {
        f"{label} over step": of_both(table, "step", name) for name, label in names.items()
    }


def of_extended_targets() -> tuple[Chart, Wanted]:
    """The least and the greatest of a set that was turned."""
    names = {"position_rmse_m": "RMSE of the position (m)", "area_rmse_m2": "RMSE of the area (m²)"}
    [first, *_] = extended_target.SMART
    turned = [f"{first}{extended_target.TURNED}{number}" for number in (1, 2, 3)]
    table = made(*names, estimator=[*BOTH, *turned, extended_target.REFERENCE], step=[1, 2])
    of_turned = table[table["estimator"].isin(turned)]
    wanted: Wanted = {
        f"{label} over step": of_both(table, "step", name)
        | {
            f"{first}, 3 rotations band": [
                *over(of_turned, "step", name, min),
                over(of_turned, "step", name, max)[1],
            ]
        }
        for name, label in names.items()
    }
    return extended_target.error_chart(table), wanted


CHARTS = [
    of_moving_sights,
    of_losses,
    of_robots,
    of_bandwidth,
    of_lies,
    of_seldom_sharing,
    of_shots,
    of_sounds,
    of_units,
    of_outages,
    of_grades,
    of_kinds_of_movement,
    of_bounded_sets,
    of_filtered_sets,
    of_clutter,
    of_ferries,
    of_ranges,
    of_vehicles,
    of_numbers_of_vehicles,
    of_tests_in_sequence,
    of_winds,
    of_moved_samples,
    of_drives,
    of_the_reactor,
    of_extended_targets,
]


@pytest.mark.parametrize("chart", CHARTS, ids=lambda chart: chart.__name__)
def test_a_chart_has_the_numbers_of_its_table(chart: Callable[[], tuple[Chart, Wanted]]) -> None:
    drawn, wanted = chart()
    same(held(drawn), wanted)
