"""The study of cooperative localization: accuracy and consistency of robots that share estimates.

Claims: Jin, Lee, Hashimoto, DIND networks, section 4.2, on real robots; the paper has no numbers.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.output.charts import Axis, Chart, Panel, curve, level
from pipeline.output.claims import Claim, judged
from pipeline.output.results import MetricValue, Outcome
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.studies.toolkit import localization

ALONE, NAIVE, CI, JOINT = "alone", "naive", "ci", "joint"


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    outcome = localization.study(experiment, setting)
    outcome.claims = claims(outcome.metrics)
    outcome.figures["modes"] = mode_chart(outcome.metrics, list(experiment.estimators))
    return outcome


def by_robot(metrics: Mapping[str, MetricValue], estimator: str, quantity: str) -> dict[str, float]:
    """One estimator's values of a metric by case; those that are numbers."""
    start = f"{estimator}.{quantity}."
    found = {key.removeprefix(start): value for key, value in metrics.items() if key.startswith(start)}
    return {key: float(value) for key, value in found.items() if isinstance(value, int | float)}


def mode_chart(metrics: Mapping[str, MetricValue], estimators: Sequence[str]) -> Chart:
    """RMSE and NEES of every robot's position, estimator by estimator."""
    panels = []
    for quantity, label in (
        ("position_rmse_m", "RMSE of the position (m)"),
        ("position_nees", "NEES of the position"),
    ):
        values = {estimator: by_robot(metrics, estimator, quantity) for estimator in estimators}
        series = [
            curve(estimator, list(own), list(own.values()), "markers")
            for estimator, own in values.items()
        ]
        panels.append(Panel(y=Axis(label=label, log=True), series=series))
    robots = list(dict.fromkeys(robot for own in values.values() for robot in own))
    if robots:
        panels[-1].series.append(level("consistent", robots, 2))
    return Chart(columns=2, panels=panels)


def claims(metrics: Mapping[str, MetricValue]) -> list[Claim]:
    """What the paper says of CI, against the position's NEES (2 when all is well) and RMSE."""

    def robots(estimator: str, quantity: str) -> list[float]:
        return list(by_robot(metrics, estimator, quantity).values())

    def told(values: list[float]) -> str:
        return "/".join(f"{value:.2f}" for value in values)

    nees = {name: robots(name, "position_nees") for name in (ALONE, NAIVE, CI, JOINT)}
    rmse = {name: robots(name, "position_rmse_m") for name in (ALONE, NAIVE, CI, JOINT)}
    if not all(nees.values()):
        return []
    rows = [
        (
            "fused with CI, the robots' estimates stay consistent",
            f"NEES of the position, robot by robot: {told(nees[CI])}",
            max(nees[CI]) <= 2.5,
        ),
        (
            "fused as if they were independent, they do not",
            f"NEES {told(nees[NAIVE])}, mean {np.mean(nees[NAIVE]):.1f}; CI's {np.mean(nees[CI]):.2f}",
            bool(np.mean(nees[NAIVE]) > 2 * np.mean(nees[CI]) and max(nees[NAIVE]) > 2.5),
        ),
        (
            "nodes gain by what others send",
            f"RMSE of the position, m: {told(rmse[ALONE])} alone, {told(rmse[CI])} with CI, "
            f"{told(rmse[JOINT])} by one joint filter",
            bool(np.mean(rmse[CI]) < 0.5 * np.mean(rmse[ALONE])),
        ),
    ]
    why = "the limits are ours; the gate and the criterion of CI were chosen on MRCLAM set 6"
    return [judged(claim, "section 4.2, no numbers", ours, holds, why) for claim, ours, holds in rows]


COOPERATIVE = Study(
    "robots that share their estimates: what each way of fusing costs", study, is_campaign=True
)
