"""Study of the accuracy and consistency of robots that localise themselves with shared estimates.

The paper (Jin, Lee, Hashimoto, DIND networks) contains no numbers for real robots.
"""

from collections.abc import Mapping, Sequence

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.studies.toolkit import localization


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    outcome = localization.study(experiment, setting)
    outcome.figures["modes"] = mode_chart(outcome.metrics, list(experiment.estimators))
    return outcome


def by_robot(metrics: Mapping[str, MetricValue], estimator: str, quantity: str) -> dict[str, float]:
    """Return one estimator's numeric values of a metric, by case."""
    start = f"{estimator}.{quantity}."
    found = {key.removeprefix(start): value for key, value in metrics.items() if key.startswith(start)}
    return {key: float(value) for key, value in found.items() if isinstance(value, int | float)}


def mode_chart(metrics: Mapping[str, MetricValue], estimators: Sequence[str]) -> Chart:
    """Draw RMSE and NEES of every robot's position, by estimator."""
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


COOPERATIVE = Study(
    "robots that share their estimates: what each fusion method costs", study, is_campaign=True
)
