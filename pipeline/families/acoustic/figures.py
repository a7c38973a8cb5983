"""Figures of Osborne et al. 2014 with our numbers: ellipses, range errors, sweeps, maps."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from fuselog.pipeline.families.acoustic.cases import (
    AcousticOptions,
    Case,
    Mode,
    area_ratios,
    range_errors_m,
)
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, interval, path
from fuselog.pipeline.studies.toolkit.repetitions import EFFICIENT
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import chi_square_interval


def figures(cases: Sequence[Case], options: AcousticOptions, runs: int) -> dict[str, Chart | Figure]:
    """Draw all figures by name."""
    nominal = [case for case in cases if case.multiplier == 1.0]
    return {
        "ellipses": _ellipses(nominal, options.modes),
        "range-errors": _range_errors(nominal[-1]),
        "nees": _sweep(cases, options.modes, "mean NEES", lambda mode: mode.mean_nees, runs),
        "rmse": _sweep(cases, options.modes, "position RMSE (m)", lambda mode: mode.rmse_m, None),
        "maps": _maps(options),
    }


def _ellipses(nominal: Sequence[Case], modes: Sequence[str]) -> Chart:
    """Draw the 95 % ellipses of the CRLB and of the estimates, figures 6-14."""
    panels = []
    for case in nominal:
        shooter = np.array(case.parameters.shooter_position_m)
        sensors = np.array(case.parameters.sensor_position_m)
        for label in modes:
            mode = case.modes[label]
            panel = Panel(title=f"scenario {case.number}, {label}", plane=True)
            for name, covariance in (("CRLB", mode.bound[:2, :2]), ("estimates", mode.covariance)):
                [outline] = ellipses(shooter[None], covariance[None])
                panel.series.append(path(name, outline, "line" if name == "CRLB" else "dashed"))
            panel.series.append(path("sensors", sensors, "markers"))
            panel.series.append(path("shooter", shooter[None], "markers", reference=True))
            panels.append(panel)
    return Chart(columns=len(modes), panels=panels)


def _range_errors(case: Case) -> Figure:
    """Draw errors of local range estimates and the zero-mean Gaussian of eq (25), figures 3-5."""
    found = range_errors_m(case)
    figure = Figure(figsize=(11, 3), layout="constrained")
    for axes, (sensor, (error, sigma)) in zip(
        np.atleast_1d(figure.subplots(1, len(found))), found.items(), strict=True
    ):
        x = np.linspace(-4 * sigma, 4 * sigma, 200)
        axes.hist(error, bins=60, range=(x[0], x[-1]), density=True, color="0.8")
        axes.plot(x, np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)))
        axes.set(title=f"scenario {case.number}, sensor {sensor}", xlabel="range error (m)")
    return figure


def _sweep(
    cases: Sequence[Case],
    modes: Sequence[str],
    label: str,
    value: Callable[[Mode], float],
    interval_runs: int | None,
) -> Chart:
    """Draw NEES with its interval, or another value with its CRLB, by noise level, figures 15-20."""
    numbers = sorted({case.number for case in cases})
    panels = []
    for number in numbers:
        swept = [case for case in cases if case.number == number]
        noise = [case.multiplier for case in swept]
        x = Axis(label="multiple of the angular noise")
        panel = Panel(title=f"scenario {number}", x=x, y=Axis(label=label))
        if interval_runs:
            panel.bands.append(interval(EFFICIENT, noise, *chi_square_interval(2, interval_runs)))
        for name in modes:
            found = [case.modes[name] for case in swept]
            panel.series.append(curve(name, noise, [value(mode) for mode in found], "line+markers"))
            if not interval_runs:
                bound_m = [mode.bound_m for mode in found]
                panel.series.append(curve(f"CRLB of {name}", noise, bound_m, "dashed"))
        panels.append(panel)
    return Chart(columns=len(numbers), panels=panels)


def _maps(options: AcousticOptions) -> Figure:
    """Draw bearings-only ellipse areas relative to those of another mode, figures 22 and 23."""
    aims = options.maps.aims
    figure = Figure(figsize=(11, 4), layout="constrained")
    for axes, (label, aim) in zip(figure.subplots(1, len(aims)), aims.items(), strict=True):
        x, y, ratio = area_ratios(options.maps, label, aim)
        picture = axes.pcolormesh(x, y, ratio, norm=LogNorm(vmin=1.0, vmax=np.nanmax(ratio)))
        figure.colorbar(picture, ax=axes)
        _mark(axes, aim)
        axes.set(title=f"bearings only by {label}", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    return figure


def _mark(axes: Axes, aim: tuple[float, float]) -> None:
    axes.plot(*aim, "r*", ms=10, label="aim")
    axes.legend(fontsize=7)
