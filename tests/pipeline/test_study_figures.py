"""What the figures of papers hold of cases that are made: whose errors, which bound, which scenario."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2, norm

from fuselog.pipeline.families.acoustic import figures as acoustic
from fuselog.pipeline.families.acoustic.cases import Mode
from fuselog.pipeline.families.directional.bingham import error_figure
from fuselog.pipeline.families.directional.inertial import trials_figure
from fuselog.pipeline.families.directional.torus import filter_figure
from fuselog.pipeline.families.los import figures as optical
from fuselog.pipeline.output.charts import Band, Series
from fuselog.recorders.families.los.models import ANGLES

RUNS = 7


def is_if_efficient(band: Band, components: int, x: list[float]) -> bool:
    """Whether 95 % of means of NEES lie in a band: the sum over all runs is chi-square."""
    ends = chi2.ppf([0.025, 0.975], components * RUNS) / RUNS
    return band.x == x and np.allclose([band.low, band.high], np.transpose([ends, ends]), rtol=1e-6)


def columns(series: list[Series], label: str) -> list[tuple[Any, Any]]:
    return [(each.x, each.y) for each in series if each.label == label]


def sights(number: int, condition: str) -> Any:
    """Two sensors, one bias of each wanted, and one target; two repetitions, of which a run failed."""
    offset = number + (10.0 if condition == "wide" else 0.0)
    return SimpleNamespace(
        number=number,
        condition=condition,
        parameters=SimpleNamespace(target_position_m=[(3000.0, 5000.0 + offset, 1.0)]),
        scene=SimpleNamespace(
            position_m=np.array([[0.0, 100.0, 9.0], [2000.0, 200.0, 9.0]]),
            wanted=np.arange(2 * len(ANGLES)) % len(ANGLES) == 1,
        ),
        truth=np.zeros(5),
        nees=offset + np.array([[1.0, 3.0], [6.0, np.nan]]),
        nees_at_estimate=offset + np.array([[2.0, 6.0], [8.0, 10.0]]),
        component_nees=offset + np.array([0.1, 0.2]),
        dilution=lambda: offset + np.array([[0.3, 0.4]]),
    )


def test_figures_of_lines_of_sight() -> None:
    """NEES beside the interval of as many components as it is of; places in km; GDOP without bias."""
    cases = [sights(number, of) for of in ("narrow", "wide") for number in (1, 2)]
    figures = optical.figures(cases, RUNS)
    narrow, wide = figures["nees"].panels
    assert (narrow.title, wide.title) == ("narrow: each mark is 7 runs", "wide: each mark is 7 runs")
    assert columns(wide.series, "CRLB at the truth") == [
        ([0.75, 1.25], [13.0, 17.0]),
        ([1.75, 2.25], [14.0, 18.0]),
    ]
    assert columns(wide.series, "CRLB at the estimate") == [
        ([0.75, 1.25], [15.0, 20.0]),
        ([1.75, 2.25], [16.0, 21.0]),
    ]
    assert all(is_if_efficient(band, 5, [0.5, 2.5]) for panel in (narrow, wide) for band in panel.bands)
    for name, offset, labels, of in (
        ("component-nees-narrow", 0.1, [f"{ANGLES[1]}{sensor}" for sensor in (1, 2)], "narrow"),
        ("component-nees-wide", 10.1, [f"{ANGLES[1]}{sensor}" for sensor in (1, 2)], "wide"),
        ("dilution", 0.3, [f"target 1, sensor {sensor}" for sensor in (1, 2)], "without bias (narrow)"),
    ):
        [panel] = figures[name].panels
        assert figures[name].title == of
        assert panel.x.ticks == {0.0: "1", 1.0: "2"}
        assert [each.label for each in panel.series] == labels
        for place, each in enumerate(panel.series):
            np.testing.assert_allclose(each.x, np.arange(2) + 0.4 * place - 0.2)
            np.testing.assert_allclose(each.y, offset + 0.1 * place + np.array([1.0, 2.0]))
        assert all(is_if_efficient(band, 1, [-0.5, 1.5]) for band in panel.bands)
        assert len(panel.bands) == (name != "dilution")
    first, second = figures["scenes"].panels
    assert (first.title, second.title) == ("scenario 1", "scenario 2")
    assert columns(second.series, "lines of sight") == [
        ([0.0, 3.0], [0.1, 5.002]),
        ([2.0, 3.0], [0.2, 5.002]),
    ]
    assert columns(second.series, "sensors") == [([0.0, 2.0], [0.1, 0.2])]
    assert columns(second.series, "targets") == [([3.0], [5.002])]


def shots(number: int, multiplier: float) -> Any:
    """One mode, whose bound and errors have different shapes, beside one that errs half as much."""
    error = np.array([[[3.0, 0.0, 9.0], [-3.0, 1.0, 9.0]], [[np.nan] * 3, [0.0, -1.0, 9.0]]])
    bound, nees = number * multiplier * np.diag([4.0, 1.0, 9.0]), np.array([[1.0, 3.0], [np.nan, 8.0]])
    places = SimpleNamespace(
        shooter_position_m=(100.0 + number, 20.0), sensor_position_m=[(0.0, 1.0), (2.0, 3.0)]
    )
    modes = {
        label: Mode(["x_m", "y_m", "t_s"], share * bound, share * error, multiplier * share * nees, 1.0)
        for label, share in (("full", 1.0), ("half", 0.5))
    }
    return SimpleNamespace(number=number, multiplier=multiplier, parameters=places, modes=modes)


def test_figures_of_shots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ellipses of 95 %, errors of the last scenario beside their Gaussian, sweeps over the noise."""
    cases = [shots(number, noise) for number in (1, 3) for noise in (0.5, 1.0, 2.0)]
    options: Any = SimpleNamespace(modes=["full", "half"])
    drawn = np.arange(-5.0, 6.0)
    errors = lambda case: {2: (drawn, float(case.number)), 5: (0.1 * drawn, 4.0)}  # noqa: E731
    monkeypatch.setattr(acoustic, "range_errors_m", errors)
    monkeypatch.setattr(acoustic, "_maps", lambda _: None)
    found: Any = acoustic.figures(cases, options, RUNS)

    ellipses = found["ellipses"].panels
    assert [each.title for each in ellipses] == [
        f"scenario {n}, {m}" for n in (1, 3) for m in options.modes
    ]
    for panel, case in zip(ellipses, np.repeat([cases[1], cases[4]], 2), strict=True):
        mode, centre = case.modes[panel.title.split()[-1]], case.parameters.shooter_position_m
        by_label = {each.label: np.stack([each.x, each.y], axis=1) for each in panel.series}
        for label, covariance in (("CRLB", mode.bound[:2, :2]), ("estimates", mode.covariance)):
            off = by_label[label] - centre
            nees = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off.T).T)
            np.testing.assert_allclose(nees, chi2.ppf(0.95, 2), rtol=1e-4)
        assert by_label["shooter"].tolist() == [list(centre)]
        assert by_label["sensors"].tolist() == [[0.0, 1.0], [2.0, 3.0]]

    for axes, sensor, sigma in zip(found["range-errors"].axes, (2, 5), (3.0, 4.0), strict=True):
        assert (axes.get_title(), axes.get_xlabel()) == (
            f"scenario 3, sensor {sensor}",
            "range error (m)",
        )
        x, y = axes.lines[0].get_xydata().T
        assert (x[0], x[-1]) == (-4 * sigma, 4 * sigma)
        np.testing.assert_allclose(y, norm.pdf(x, scale=sigma))
        assert sum(each.get_height() * each.get_width() for each in axes.patches) == pytest.approx(1.0)

    for name, label, of, count in (("nees", "mean NEES", 4.0, 2), ("rmse", "position RMSE (m)", 0.0, 4)):
        for number, panel in zip((1, 3), found[name].panels, strict=True):
            assert (panel.title, panel.y.label) == (f"scenario {number}", label)
            assert panel.x.label == "multiple of the angular noise"
            assert len(panel.series) == count
            for mode, share in (("full", 1.0), ("half", 0.5)):
                noise, rmse_m = np.array([0.5, 1.0, 2.0]), share * np.sqrt(20.0 / 3.0)
                mean = of * share * noise if of else np.full(3, rmse_m)
                assert columns(panel.series, mode) == [(noise.tolist(), pytest.approx(mean, rel=1e-6))]
                bound_m = np.sqrt(5.0 * share * number * noise)
                assert columns(panel.series, f"CRLB of {mode}") == (
                    [] if of else [(noise.tolist(), pytest.approx(bound_m, rel=1e-6))]
                )
            assert all(is_if_efficient(band, 2, [0.5, 2.0]) for band in panel.bands)
            assert len(panel.bands) == bool(of)


@pytest.mark.parametrize("draw", [filter_figure, error_figure])
def test_boxes_are_of_their_runs(draw: Any) -> None:
    """The middle of each box is the median of the runs that did not fail; the mark is their mean."""
    cases = ("calm", "noise-13")
    errors = {
        case: {
            name: at + np.array([0.0, 1.0, 5.0, np.nan]) for at, name in ((1.0, "grid"), (2.0, "ukf"))
        }
        | {"last": np.array([10.0 + number])}
        for number, case in enumerate(cases)
    }
    figure = draw(errors)
    assert figure.axes[0].get_ylabel() in (
        "RMSE of a run per angle (rad)",
        "angular RMSE of a run (deg)",
    )
    for number, (axes, case) in enumerate(zip(figure.axes, cases, strict=True)):
        assert axes.get_title().replace(" ", "-") == case
        assert [text.get_text() for text in axes.get_xticklabels()] == ["grid", "ukf", "last"]
        marks = [line.get_ydata() for line in axes.lines if line.get_marker() == "^"]
        assert np.ravel(marks).tolist() == [3.0, 4.0, 10.0 + number]
        medians = [line.get_ydata()[0] for line in axes.lines if line.get_color() == "C1"]
        assert medians == [2.0, 3.0, 10.0 + number]


def test_bars_are_of_their_trial_and_estimator() -> None:
    """Trials from above in their order."""
    rows = [("a", "vqf", 4.0), ("a", "ekf", 1.0), ("b", "vqf", 3.0), ("b", "ekf", 2.0)]
    trials = pd.DataFrame(rows, columns=["trial", "estimator", "movement_rmse_deg"])
    [axes] = trials_figure(trials).axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["b", "a"]
    found = {bars.get_label(): [bar.get_width() for bar in bars] for bars in axes.containers}
    assert found == {"vqf": [3.0, 4.0], "ekf": [2.0, 1.0]}
    assert axes.get_xlabel() == "total orientation RMSE over movement (deg)"
