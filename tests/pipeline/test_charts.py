"""What charts hold of tables that are made: which series of whom, in which unit, with which label."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from fuselog.pipeline.comparing.comparing import _chart as difference_chart
from fuselog.pipeline.output.charts import Axis, Chart, Panel, Series, band, curve, draw
from fuselog.pipeline.output.report.first_run import first_run
from fuselog.pipeline.output.report.scene import nis_chart, plan, tracked
from fuselog.pipeline.output.summary import (
    effective_chart,
    error_chart,
    late_chart,
    late_counts,
    mode_chart,
)
from fuselog.pipeline.runs.sweeps import Over, figures_of
from fuselog.pipeline.tuning.outcome import Tuning
from fuselog.recorders.log import RunMetadata, make_stream, schemas, write_log
from fuselog.replay.judging.errors.evaluation import Errors

TIMES = np.array([0.0, 1.0, 2.0])


def held(chart: Chart) -> dict[str, dict[str, Any]]:
    """What a reader of the JSON finds: by axes' labels the columns of series and bands by label."""
    return {
        f"{panel.title}{': ' if panel.title else ''}{panel.y.label} over {panel.x.label}": {
            **{each.label: [each.x, each.y] for each in panel.series},
            **{f"{each.label} band": [each.x, each.low, each.high] for each in panel.bands},
        }
        for panel in Chart.model_validate_json(chart.model_dump_json()).panels
    }


def test_what_diverged_is_left_out_of_a_chart(tmp_path: Path) -> None:
    """Also of one whose values or limits are infinite: matplotlib has no axis for these."""
    values = [1.0, 1e305, np.inf]
    y = Axis(label="NEES", log=True, limits=(0.1, np.inf))
    panel = Panel(y=y, series=[curve("a", TIMES, values), Series(label="b", x=values, y=values)])
    draw(Chart(panels=[panel])).savefig(tmp_path / "figure.png")
    assert [each.y for each in panel.series] == [[1.0, None, None]] * 2


def same(found: Mapping[str, Any], wanted: Mapping[str, Mapping[str, Any]]) -> None:
    """All panels and series of both, their names, and their numbers to seven digits."""
    assert {name: set(own) for name, own in found.items()} == {
        name: set(own) for name, own in wanted.items()
    }
    for name, own in wanted.items():
        for label, columns in own.items():
            for drawn, column in zip(found[name][label], columns, strict=True):
                values = np.array(drawn)
                if values.dtype.kind == "U":
                    assert values.tolist() == list(column), f"{name}: {label}"
                else:
                    np.testing.assert_allclose(
                        values.astype(float), column, rtol=1e-6, err_msg=f"{name}: {label}"
                    )


def errors(estimator: str, *components: str, is_bound: bool = False) -> Errors:
    """Errors of three components or one, without rows."""
    size, none = len(components), np.empty(0)
    kinds = tuple("rotation" if each.startswith("body") else "linear" for each in components)
    stamps = np.empty(0, np.int64)
    shapes = none.reshape(0, size), none.reshape(0, size, size)
    rows = (stamps, stamps, stamps, none, *shapes, none)
    return Errors(estimator, "robot1", components, kinds, *rows, 0, is_bound=is_bound)


def steps(start: float, quantity: str) -> pd.DataFrame:
    """A table of steps whose columns all differ."""
    names = [quantity, f"{quantity}_low", f"{quantity}_high", "nees", "nees_low", "nees_high"]
    columns = {name: start + 0.1 * number + TIMES for number, name in enumerate(names)}
    return pd.DataFrame({"elapsed_s": TIMES, "runs": 7, **columns})


def test_errors_and_nees_are_of_their_estimators_in_their_unit() -> None:
    ekf, bound = steps(1.0, "position_rmse_m"), steps(5.0, "position_rmse_m")
    plane = ("x_m", "y_m")
    judged = [(errors("ekf", *plane), ekf), (errors("bound", *plane, is_bound=True), bound)]
    chart = error_chart(judged, "robot1")
    assert chart.title == (
        "robot1, over all 7 runs together; tinted: 95 % range if the estimator's covariance is right"
    )
    assert all(panel.y.log for panel in chart.panels)
    rmse = {
        "ekf": [TIMES, ekf["position_rmse_m"]],
        "ekf band": [TIMES, ekf["position_rmse_m_low"], ekf["position_rmse_m_high"]],
        "bound": [TIMES, bound["position_rmse_m"]],
    }
    nees = {
        "ekf": [TIMES, ekf["nees"]],
        "95 % if consistent (2 components) band": [TIMES, ekf["nees_low"], ekf["nees_high"]],
    }
    own = held(chart)
    assert all(of.pop("outside") for of in own.values())  # the strip along the foot
    name = "ekf: outside always: "
    axes_of = {f"{name}position error, RMS (m) over time (s)": rmse}
    same(own, {**axes_of, f"{name}mean NEES over time (s)": nees})
    turned = ("body_x_rad", "body_y_rad", "body_z_rad")
    axes = {
        "orientation_rmse_deg": (turned, "orientation error (°)"),
        "rmse_room_degC": (("room_degC",), "error of room_degC, RMS"),
    }
    for quantity, (components, label) in axes.items():
        chart = error_chart([(errors("ekf", *components), steps(1.0, quantity))], "")
        assert chart.panels[0].y.label == label
        np.testing.assert_allclose(chart.panels[0].series[0].y, 1.0 + TIMES)
    assert chart.title.startswith("errors, over all 7 runs together")


def test_modes_particles_and_late_messages_are_of_their_estimators() -> None:
    rows = product(("imm", "bank"), ("drive", "stand"), (False, True), TIMES)
    modes = pd.DataFrame(rows, columns=["estimator", "mode", "smoothed", "elapsed_s"])
    modes["probability"] = np.arange(len(modes)) / len(modes)
    chart = mode_chart(modes, "vehicle1")
    assert chart.title == "vehicle1, probability of each mode; dashed: from all data of a run"
    for panel, start in zip(chart.panels, (0, 12), strict=True):
        assert panel.title == ("imm" if start == 0 else "bank")
        drawn = [(each.label, each.style) for each in panel.series]
        assert drawn == list(product(("drive", "stand"), ("line", "dashed")))
        np.testing.assert_allclose(
            np.ravel([each.y for each in panel.series]), np.arange(start, start + 12) / 24, rtol=1e-6
        )
    shares = modes[~modes["smoothed"] & (modes["mode"] == "drive")].assign(
        effective_share=lambda of: of["probability"]
    )
    chart = effective_chart(shares, "")
    own = {name: [TIMES, each["probability"]] for name, each in shares.groupby("estimator")}
    same(held(chart), {"effective share over time (s)": own})
    assert chart.title == "particles, effective share of the particles"
    late = pd.DataFrame(
        {
            "estimator": ["ekf", "ekf", "ukf"],
            "case": "robot1",
            "became": ["inserted", "dropped", "dropped"],
            "elapsed_s": [1.0, 2.0, 3.0],
            "late_s": [0.1, 0.2, 0.3],
            "messages": [2, 3, 4],
            "repeated": [5.0, np.nan, np.nan],
        }
    )
    delay = "mean delay (s) over time (s)"
    wanted = {
        f"ekf: 2 inserted, 10 reprocessed for them; 3 dropped: {delay}": {
            "inserted": [[1.0], [0.1]],
            "dropped": [[2.0], [0.2]],
        },
        f"ukf: 4 dropped: {delay}": {"dropped": [[3.0], [0.3]]},
    }
    same(held(late_chart(late, "robot1")), wanted)
    again = late.replace({"became": {"inserted": "dropped"}})
    assert late_counts(again)["late_s"].tolist() == pytest.approx([(2 * 0.1 + 3 * 0.2) / 5, 0.3])


def swept(over: list[Over], values: np.ndarray, quantity: str = "position_rmse_m") -> pd.DataFrame:
    """A sweep of two estimators over a grid: values (estimators, points)."""
    points = list(product(*(each.taken for each in over)))
    rows = [
        {
            "estimator": name,
            "quantity": quantity,
            "case": "robot1",
            "point": number,
            "value": value,
            "low": 0.9 * value,
            "high": 1.2 * value,
        }
        | {each.key: taken for each, taken in zip(over, point, strict=True)}
        for name, own in zip(("ekf", "ukf"), values, strict=True)
        for number, (point, value) in enumerate(zip(points, own, strict=True))
    ]
    return pd.DataFrame(rows)


def test_a_sweep_is_curves_over_what_is_swept() -> None:
    over = [Over("ekf.sigma_m", (0.1, 0.2, 0.4), (0.1, 0.4), is_log=True)]
    values = np.array([[3.0, 1.0, 2.0], [4.0, 6.0, 5.0]])
    [(name, chart)] = figures_of(swept(over, values), over).items()
    assert name == "position_rmse_m-robot1"
    assert chart.title == "position error, RMS (m) of robot1; bands: middle 90 % of runs"
    wanted = {label: [over[0].taken, own] for label, own in zip(("ekf", "ukf"), values, strict=True)}
    bands = {f"{label} band": [x, 0.9 * own, 1.2 * own] for label, (x, own) in wanted.items()}
    same(held(chart), {"position error, RMS (m) over ekf.sigma_m": {**wanted, **bands}})
    assert chart.panels[0].x.log
    mixed = [Over("kind", ("a", "b")), over[0]]
    values = np.arange(12.0).reshape(2, 2, 3)
    [chart] = figures_of(swept(mixed, values.reshape(2, 6)), mixed).values()
    assert ", means over the others;" in chart.title
    by_kind, by_sigma = chart.panels
    assert (by_kind.x.label, by_kind.x.log, by_sigma.x.log) == ("kind", False, True)
    assert [each.y for each in by_kind.series] == values.mean(axis=2).tolist()
    assert [each.y for each in by_sigma.series] == values.mean(axis=1).tolist()


def test_a_map_of_a_sweep_has_its_cross_where_the_error_is_least() -> None:
    """The first parameter goes up, the second to the right; NEES has no cross."""
    over = [Over("q", (1.0, 2.0)), Over("r", (10.0, 20.0, 40.0))]
    values = np.array([[4.0, 3.0, 2.0, 5.0, 6.0, 9.0], [8.0, 7.0, 5.0, 4.0, 3.5, 6.0]])
    [figure] = figures_of(swept(over, values), over).values()
    *maps, bar = figure.axes
    for axes, label, own, least in zip(maps, ("ekf", "ukf"), values, [(2, 0), (1, 1)], strict=True):
        assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == (label, "r", "q")
        assert np.array_equal(axes.images[0].get_array(), own.reshape(2, 3))
        assert axes.images[0].origin == "lower"
        [[cross]] = [line.get_xydata().tolist() for line in axes.lines]
        assert tuple(cross) == least
        assert [text.get_text() for text in axes.get_xticklabels()] == ["10", "20", "40"]
    assert bar.get_ylabel() == "position error, RMS (m)"
    assert maps[0].images[0].norm is maps[1].images[0].norm
    [figure] = figures_of(swept(over, values, "nees"), over).values()
    assert not figure.axes[0].lines


def test_a_comparison_has_the_difference_of_the_second_less_the_first() -> None:
    columns = {"first": "ekf", "second": "ukf", "case": "robot1", "elapsed_s": TIMES}
    rows = pd.concat(
        pd.DataFrame(
            {
                **columns,
                "quantity": name,
                "difference": at + TIMES,
                "low": at - 1 + TIMES,
                "high": at + 2 + TIMES,
            }
        )
        for at, name in ((1.0, "position_rmse_m"), (5.0, "nees"))
    )
    chart = difference_chart(rows)
    assert chart.title == "robot1: ukf minus ekf, with 95 % intervals over the runs"
    wanted = {
        f"difference of {name} over time (s)": {
            "ukf - ekf": [TIMES, at + TIMES],
            "ukf - ekf band": [TIMES, at - 1 + TIMES, at + 2 + TIMES],
            "no difference": [[0.0, 2.0], [0.0, 0.0]],
        }
        for at, name in ((1.0, "position_rmse_m"), (5.0, "nees"))
    }
    same(held(chart), wanted)


def test_a_profile_falls_from_the_maximum_along_its_parameter() -> None:
    """The level is where 95 % end: half of 1.96 squared below."""
    free = [SimpleNamespace(name=name, is_log=name == "sigma") for name in ("sigma", "bias")]
    profiles = [
        SimpleNamespace(
            name=each.name, along=at + TIMES, parabola=(TIMES - 1) ** 2, rise=2 * (TIMES - 1) ** 2
        )
        for at, each in zip((1.0, -1.0), free, strict=True)
    ]
    tuned = SimpleNamespace(
        found=SimpleNamespace(coordinates=SimpleNamespace(free=free)),
        _profiles=profiles,
        _meanings={"sigma": "standard deviation"},
    )
    chart = Tuning.profile_chart.fget(tuned)
    labels = {"sigma": "standard deviation", "bias": "bias"}
    wanted = {
        f"log-likelihood relative to its maximum over {labels[each.name]}": {
            "log-likelihood": [each.along, -each.rise],
            "by curvature": [each.along, -each.parabola],
            "95 %": [each.along[[0, -1]], [-1.92073, -1.92073]],
        }
        for each in profiles
    }
    same(held(chart), wanted)
    assert [panel.x.log for panel in chart.panels] == [True, False]


def test_the_first_picture_has_the_paths_in_the_plane(tmp_path) -> None:
    """The x axis goes right and y up, whatever the order of the state; the truth is a reference."""
    stamps = np.arange(1, 5) * 10**9
    metadata = {"components": "y_m,heading_rad,x_m", "kinds": "linear,angle,linear"}
    state = np.stack([stamps * 1e-9, np.zeros(4), stamps * -2e-9], axis=1)
    truth = make_stream("/robot1/truth", schemas.TRUTH_STATE, stamps, metadata=metadata, state=state)
    made = [
        make_stream(
            f"/estimates/{name}/robot1/pose",
            schemas.GAUSSIAN_ESTIMATE,
            stamps,
            metadata={**metadata, "truth": "/robot1/truth"},
            mean=state + off,
            covariance=np.tile(1e-6 * np.eye(3).ravel(), (4, 1)),
        )
        for name, off in (("ekf", 0.5), ("ukf", 0.25))
    ]
    run = RunMetadata("own", epoch_ns=0)
    for folder in ("logs", "estimates"):
        (tmp_path / folder).mkdir()
    write_log(tmp_path / "logs/run-0000.mcap", [truth], run)
    write_log(tmp_path / "estimates/run-0000.mcap", made, run)
    found = first_run(tmp_path)
    assert found is not None
    chart = plan(found)
    assert chart.title == "robot1, first run from above"
    paths = {
        name: [state[:, 2] + off, state[:, 0] + off]
        for name, off in (("ekf", 0.5), ("ukf", 0.25), ("truth", 0.0))
    }
    same(held(chart), {"y (m) over x (m)": paths})
    [panel] = chart.panels
    assert panel.plane
    assert [each.reference for each in panel.series] == [True, False, False]


def test_nis_over_time_is_of_all_runs_and_says_how_often_it_is_outside(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of two runs; one of two components each is unknown now and then, and counts nowhere."""
    time_s, wanted = np.arange(120.0), {}
    degrees = np.where(np.arange(120) % 4, 2, 1)
    found: dict[tuple[str, str], Any] = {}
    for label, late, where in (("calm", 1.0, "never"), ("late", 9.0, "75 % of the time")):
        squared = degrees * np.where(time_s < 30.0, 1.0, late)
        runs = [SimpleNamespace(squared=factor * squared, degrees=degrees) for factor in (0.5, 1.5)]
        runs[0].squared[7], runs[1].degrees = np.nan, np.where(time_s == 9.0, 0, degrees)
        found[label, "a"] = [(time_s, each) for each in runs]
        known = [degrees * (time_s != 7.0), runs[1].degrees]
        sums = [np.nan_to_num(runs[0].squared), runs[1].squared * (time_s != 9.0)]
        counts, edges = np.histogram(np.tile(time_s, 2), 60, weights=np.concatenate(known))
        mean = np.histogram(np.tile(time_s, 2), 60, weights=np.concatenate(sums))[0] / counts
        middle = (edges[:-1] + edges[1:]) / 2
        low, high = (chi2.ppf(level, counts) / counts for level in (0.025, 0.975))
        is_out = (mean < low) | (mean > high)
        assert is_out.mean() == {"never": 0.0}.get(where, 0.75)
        own = {label: [middle, mean], "95 % if consistent band": [middle, low, high]}
        wanted[f"{label}: outside {where}: NIS per component over time (s)"] = own
        if is_out.any():
            own["outside"] = [middle[is_out], np.zeros(45)]
    found["other", "b"] = found["calm", "a"]
    monkeypatch.setattr("fuselog.pipeline.output.report.scene.innovations_of_runs", lambda _: found)
    (tmp_path / "estimates").mkdir()
    for run in range(2):
        (tmp_path / f"estimates/run-000{run}.mcap").touch()
    chart = nis_chart(tmp_path, ["late", "calm", "other"])
    assert chart is not None
    drawn = held(chart)
    for own in drawn.values():
        if "outside" in own:  # at the foot
            low = min(np.min(each[1]) for each in own.values())
            assert set(own["outside"][1]) == {low}
            own["outside"][1] = np.zeros(45)
    same(drawn, wanted)
    least, most = chart.panels[0].y.limits or (0.0, 0.0)
    shown = [each for own in wanted.values() for each in own.values()]
    values = np.concatenate([np.concatenate(each[1:]) for each in shown])
    assert least < values[values > 0].min() < values.max() < most
    calm = nis_chart(tmp_path, ["calm"])  # whose band reaches higher than its curve
    assert calm is not None
    [panel] = calm.panels
    assert panel.y.limits is not None
    assert panel.y.limits[1] > np.max(panel.bands[0].high) > np.max(panel.series[0].y)
    assert "of a, 2 runs together;" in chart.title
    assert nis_chart(tmp_path, ["unknown"]) is None


def test_trackers_are_seen_from_above_over_the_true_ways(tmp_path) -> None:
    """A panel for each in the order that is asked for, at one scale; a gap between any two tracks.

    Of three cases it is the one of the median error; what a sensor detects is placed by its last fix.
    """
    stamps, steps = np.arange(4) * 10**9, np.arange(4.0)
    state = np.stack([10.0 * steps, -steps], axis=1)
    truths = [
        make_stream(
            f"/target{number}/truth",
            schemas.TRUTH_STATE,
            stamps,
            metadata={"components": "x_m,y_m", "kinds": "linear,linear"},
            state=state + 5.0 * number,
        )
        for number in range(2)
    ]
    made = [
        make_stream(
            f"/estimates/{name}/track",
            schemas.TRACK_ESTIMATE,
            stamps,
            metadata={"components": "y_m,x_m", "kinds": "linear,linear"},
            track_id=np.array([7, 3, 7, 3]),
            mean=state[:, ::-1] + off,
            covariance=np.zeros((4, 4)),
        )
        for name, off in (("near", 0.5), ("far", 2.5))
    ]
    scanned = [
        make_stream(
            "/radar/scan",
            schemas.SCAN,
            stamps[1:3],
            metadata={"origin": "/ship/fix"},
            scan_id=np.array([5, 4]),
            detections=np.array([1, 1]),
        ),
        make_stream(
            "/radar/detection",
            schemas.DETECTION,
            stamps[1:3],
            scan_id=np.array([4, 5]),
            position_m=np.array([[1.0, 2.0], [3.0, 4.0]]),
        ),
        make_stream(
            "/ship/fix",
            schemas.POSITION_FIX,
            stamps[[0, 2]],
            position_m=np.array([[10.0, 0.0], [20.0, 0.0]]),
            covariance_m2=np.ones((2, 2)),
        ),
    ]
    run = RunMetadata("own", epoch_ns=0)
    for name in ("clutter-10", "clutter-50", "clutter-90"):
        for folder, streams in (("logs", [*truths, *scanned]), ("estimates", made)):
            (tmp_path / name / folder).mkdir(parents=True)
            write_log(tmp_path / name / folder / "run-0000.mcap", streams, run)
    errors = {"clutter-10": 3.0, "clutter-50": 2.0, "clutter-90": 1.0, "not-kept": 2.5}
    chart = tracked(tmp_path, ["far", "absent", "near"], errors, "GOSPA of far")
    assert chart is not None
    assert chart.title.startswith("First run of clutter-50, the case of the median GOSPA of far,")
    assert [panel.title for panel in chart.panels] == ["far", "near"]
    assert len({str(panel.x.limits) for panel in chart.panels}) == 1
    detections, truth, far = chart.panels[0].series
    assert detections.x == [21.0, 13.0]  # of the later scan first, when the ship was at 20 m
    assert detections.y == [2.0, 4.0]
    assert truth.reference
    assert truth.x == [0.0, 10.0, 20.0, 30.0, None, 5.0, 15.0, 25.0, 35.0, None]
    assert far.x == [12.5, 32.5, None, 2.5, 22.5, None]  # track 3, then track 7
    assert far.y == [1.5, -0.5, None, 2.5, 0.5, None]
    assert tracked(tmp_path, ["absent"], {}, "") is None


def test_a_figure_has_what_its_chart_says() -> None:
    """Each curve over its x in its look, each band from low to high, in the colour of its label."""
    x = np.array([1.0, 2.0, 4.0])
    chart = Chart(
        title="all of it",
        panels=[
            Panel(
                x=Axis(label="time (s)", log=True, limits=(0.5, 5.0)),
                y=Axis(label="error (m)"),
                title="first",
                series=[
                    curve("a", x, [3.0, 1.0, 2.0], "dashed"),
                    curve("b", x, [5.0, 6.0, 7.0], "markers"),
                ],
                bands=[band("b", x, [4.0, 5.0, 6.0], [6.0, 7.0, 9.0])],
            )
        ],
    )
    figure = draw(chart)
    [axes] = figure.axes
    assert [line.get_xydata().T.tolist() for line in axes.lines] == [
        [x.tolist(), each.y] for each in chart.panels[0].series
    ]
    assert [(line.get_linestyle(), line.get_marker()) for line in axes.lines] == [
        ("--", "None"),
        ("None", "o"),
    ]
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("first", "time (s)", "error (m)")
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_xlim()) == ("log", "linear", (0.5, 5.0))
    [filled] = axes.collections
    corners = {tuple(corner) for corner in filled.get_paths()[0].vertices.tolist()}
    assert {(1.0, 4.0), (2.0, 7.0), (4.0, 9.0)} <= corners
    colours = chart.colours()
    assert [line.get_color() for line in axes.lines] == [colours["a"], colours["b"]]
    assert figure.get_suptitle() == "all of it"
