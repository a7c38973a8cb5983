"""Figures of Belfadel et al. 2014 with our numbers: scenes, NEES, biases' NEES, GDOP."""

from collections.abc import Sequence

import numpy as np

from fuselog.pipeline.families.los.cases import Case, bias_names
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, interval, path
from fuselog.pipeline.studies.toolkit.repetitions import EFFICIENT, groups
from fuselog.replay.judging.errors.evaluation import chi_square_interval


def figures(cases: Sequence[Case], runs: int) -> dict[str, Chart]:
    """Draw all figures by name."""
    conditions = list(dict.fromkeys(case.condition for case in cases))
    by_condition = {name: [case for case in cases if case.condition == name] for name in conditions}
    first = by_condition[conditions[0]]
    found = {"scenes": _scenes(first), "nees": _nees(by_condition, runs), "dilution": _dilution(first)}
    for name, of in by_condition.items():
        found[f"component-nees-{name}"] = _component_nees(of, runs)
    return found


def _scenes(cases: Sequence[Case]) -> Chart:
    """Draw every scenario from the side, with its true lines of sight, figures 2-6 and 11-15."""
    panels = []
    for case in cases:
        targets = 1e-3 * np.array(case.parameters.target_position_m)[:, :2]
        sensors = 1e-3 * case.scene.position_m[:, :2]
        sights = [
            path("lines of sight", np.array([sensor, target]), reference=True)
            for sensor in sensors
            for target in targets
        ]
        seen = [
            path("sensors", sensors, "markers"),
            path("targets", targets, "markers"),
        ]
        title, x, y = f"scenario {case.number}", Axis(label="x (km)"), Axis(label="altitude (km)")
        panels.append(Panel(title=title, x=x, y=y, series=[*sights, *seen], plane=True))
    return Chart(columns=len(cases), panels=panels)


def _nees(by_condition: dict[str, list[Case]], runs: int) -> Chart:
    """Draw the mean NEES of each repetition, with the CRLB at truth and estimate, figures 7 and 16."""
    panels = []
    for name, cases in by_condition.items():
        numbers = [case.number for case in cases]
        bounds = chi_square_interval(len(cases[0].truth), runs)
        ends = [min(numbers) - 0.5, max(numbers) + 0.5]
        panel = Panel(
            title=f"{name}: each mark is {runs} runs",
            x=Axis(label="scenario", ticks={float(number): str(number) for number in numbers}),
            y=Axis(label="mean NEES"),
            bands=[interval(EFFICIENT, ends, *bounds)],
        )
        for case in cases:
            repetitions = np.arange(len(case.nees))
            x = case.number + 0.5 * (repetitions / max(1, len(repetitions) - 1) - 0.5)
            for label, nees in (
                ("CRLB at the truth", case.nees),
                ("CRLB at the estimate", case.nees_at_estimate),
            ):
                panel.series.append(curve(label, x, np.nanmean(nees, axis=1), "markers"))
        panels.append(panel)
    return Chart(columns=len(panels), panels=panels)


def _component_nees(cases: Sequence[Case], runs: int) -> Chart:
    """Draw the mean NEES of each bias over all repetitions, figures 8 and 17."""
    nees = [case.component_nees.tolist() for case in cases]
    numbers = [str(case.number) for case in cases]
    x, series = groups(nees, bias_names(cases[0]), numbers, "scenario")
    bands = [interval(EFFICIENT, [-0.5, len(cases) - 0.5], *chi_square_interval(1, runs))]
    panel = Panel(x=x, y=Axis(label="mean NEES of one bias"), series=series, bands=bands)
    return Chart(title=cases[0].condition, panels=[panel])


def _dilution(cases: Sequence[Case]) -> Chart:
    """Draw GDOP of all targets and sensors, figures 9 and 18."""
    targets, sensors = cases[0].dilution().shape
    labels = [f"target {t + 1}, sensor {s + 1}" for t in range(targets) for s in range(sensors)]
    dilution = [case.dilution().ravel().tolist() for case in cases]
    x, series = groups(dilution, labels, [str(case.number) for case in cases], "scenario")
    panel = Panel(x=x, y=Axis(label="GDOP"), series=series)
    return Chart(title=f"without bias ({cases[0].condition})", panels=[panel])
