"""The figures of Belfadel et al. 2014 with our numbers: scenes, NEES, NEES of single biases, GDOP."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from pipeline.studies.los_cases import Case, bias_names
from pipeline.studies.repetitions import draw_groups, draw_interval
from replay.judging.evaluation import chi_square_interval


def figures(cases: Sequence[Case], runs: int) -> dict[str, Figure]:
    """All figures by name."""
    conditions = list(dict.fromkeys(case.condition for case in cases))
    by_condition = {name: [case for case in cases if case.condition == name] for name in conditions}
    first = by_condition[conditions[0]]
    found = {"scenes": _scenes(first), "nees": _nees(by_condition, runs), "dilution": _dilution(first)}
    for name, of in by_condition.items():
        found[f"component-nees-{name}"] = _component_nees(of, runs)
    return found


def _scenes(cases: Sequence[Case]) -> Figure:
    """Figures 2-6 and 11-15: every scenario from the side, with its true lines of sight."""
    figure = Figure(figsize=(12, 2.8), layout="constrained")
    for axes, case in zip(figure.subplots(1, len(cases), sharey=True), cases, strict=True):
        targets = 1e-3 * np.array(case.parameters.target_position_m)
        sensors = 1e-3 * case.scene.position_m
        for sensor in sensors:
            for target in targets:
                axes.plot([sensor[0], target[0]], [sensor[1], target[1]], color="0.8", lw=0.7)
        axes.plot(sensors[:, 0], sensors[:, 1], "s", label="sensors")
        axes.plot(targets[:, 0], targets[:, 1], "^", label="targets")
        axes.set(title=f"scenario {case.number}", xlabel="x (km)", aspect="equal")
    figure.axes[0].set_ylabel("altitude (km)")
    figure.axes[0].legend(fontsize=7)
    return figure


def _nees(by_condition: dict[str, list[Case]], runs: int) -> Figure:
    """Figures 7 and 16: the mean NEES of each repetition, CRLB at the truth and at the estimate."""
    figure = Figure(figsize=(10, 3.5), layout="constrained")
    for axes, (name, cases) in zip(
        np.atleast_1d(figure.subplots(1, len(by_condition), sharey=True)),
        by_condition.items(),
        strict=True,
    ):
        draw_interval(axes, *chi_square_interval(len(cases[0].truth), runs))
        for case in cases:
            repetitions = np.arange(len(case.nees))
            x = case.number + 0.5 * (repetitions / max(1, len(repetitions) - 1) - 0.5)
            axes.plot(x, np.nanmean(case.nees, axis=1), "o", color="C0", ms=4)
            axes.plot(x, np.nanmean(case.nees_at_estimate, axis=1), "x", color="C1", ms=5)
        axes.set(xlabel="scenario", title=f"{name}: a mark is {runs} runs")
    figure.axes[0].plot([], [], "o", color="C0", label="CRLB at the truth")
    figure.axes[0].plot([], [], "x", color="C1", label="CRLB at the estimate")
    figure.axes[0].set_ylabel("mean NEES")
    figure.axes[0].legend(fontsize=8)
    return figure


def _component_nees(cases: Sequence[Case], runs: int) -> Figure:
    """Figures 8 and 17: mean NEES of each bias, all repetitions together."""
    figure = Figure(figsize=(8, 3.5), layout="constrained")
    axes = figure.subplots()
    draw_interval(axes, *chi_square_interval(1, runs))
    draw_groups(axes, [case.component_nees.tolist() for case in cases], bias_names(cases[0]), "o")
    axes.set_xticks(range(len(cases)), [str(case.number) for case in cases])
    axes.set(xlabel="scenario", ylabel="mean NEES of one bias", title=cases[0].condition)
    axes.legend(ncols=2, fontsize=7)
    return figure


def _dilution(cases: Sequence[Case]) -> Figure:
    """Figures 9 and 18: GDOP of all targets and sensors."""
    figure = Figure(figsize=(8, 3.5), layout="constrained")
    axes = figure.subplots()
    targets, sensors = cases[0].dilution().shape
    labels = [f"target {t + 1}, sensor {s + 1}" for t in range(targets) for s in range(sensors)]
    draw_groups(axes, [case.dilution().ravel().tolist() for case in cases], labels, "s")
    axes.set_xticks(range(len(cases)), [str(case.number) for case in cases])
    axes.set(xlabel="scenario", ylabel="GDOP", title=f"without bias ({cases[0].condition})")
    axes.legend(ncols=2, fontsize=6)
    return figure
