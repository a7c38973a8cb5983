"""The study of simulated targets that cross: what associations are worth in clutter.

Every case has a rate of clutter and a probability of detection; the targets of a run and their true ways
are the same in all cases.
"""

from itertools import product

import pandas as pd

from pipeline.output.charts import Axis, Chart, Panel, band, curve
from pipeline.output.claims import Claim
from pipeline.output.results import Outcome
from pipeline.output.summary import summary_table
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.runner import Runner
from pipeline.studies.toolkit.repetitions import Interval, mean_interval
from pipeline.studies.tracking.tracking import difference, lower, means_of, table_of
from recorders.parameters import Parameters
from replay.judging.tracks.errors import instants_of


class CrossingOptions(Parameters):
    """The cases.

    Attributes:
        clutter_per_scan: mean numbers of false detections in a scan.
        detection_probability: probabilities of detection.
    """

    clutter_per_scan: tuple[float, ...] = (10.0, 50.0, 100.0)
    detection_probability: tuple[float, ...] = (0.95, 0.8, 0.65)


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    grid = list(product(setting.options.clutter_per_scan, setting.options.detection_probability))
    cases = {
        _case(*point): dict(zip(("clutter_per_scan", "detection_probability"), point, strict=True))
        for point in grid
    }
    outcome, tables = Outcome(), []
    for name, replayed in Runner(experiment, setting).cases(cases):
        runs = {str(run): instants_of(source) for run, source in enumerate(replayed.sources)}
        table = table_of(replayed.outputs, list(experiment.estimators), runs)
        for position, (quantity, value) in enumerate(cases[name].items()):
            table.insert(position, quantity, value)
        for label, of_mean in means_of(table.drop(columns=[*cases[name]])).items():
            outcome.metrics |= {f"{label}.{what}.{name}": value for what, value in of_mean.items()}
        tables.append(table)
    every = pd.concat(tables, ignore_index=True)
    outcome.tables |= {"runs": every, "summary": summary_table(outcome.metrics)}
    outcome.figures["gospa"] = _chart(every)
    outcome.claims = _claims(every)
    return outcome


def _case(clutter_per_scan: float, detection_probability: float) -> str:
    return f"clutter-{clutter_per_scan:g}-detection-{100 * detection_probability:g}"


def _chart(every: pd.DataFrame) -> Chart:
    """GOSPA over clutter, with 95 % intervals over the runs: a panel by probability of detection."""
    panels = []
    for probability, of_panel in every.groupby("detection_probability", sort=False):
        panel = Panel(
            x=Axis(label="false detections in a scan"),
            y=Axis(label="mean GOSPA (m), c = 20 m"),
            title=f"probability of detection {probability:g}",
        )
        for label, rows in of_panel.groupby("estimator", sort=False):
            means = rows.groupby("clutter_per_scan")["gospa_m"].apply(list).map(mean_interval)
            mean, low, high = zip(*means, strict=True)
            panel.series.append(curve(str(label), means.index, mean, "line+markers"))
            panel.bands.append(band(str(label), means.index, low, high))
        panels.append(panel)
    return Chart(panels=panels, columns=3)


def _claims(every: pd.DataFrame) -> list[Claim]:
    """What associations and modes are expected to be worth, where they were run in all cases."""
    estimators = set(every["estimator"])
    claims = []
    if {"jipda", "jpda", "hungarian", "nearest"} <= estimators:
        claims += _association_claims(every)
    if {"pmbm", "jipda"} <= estimators:
        claims += [_lower_gospa(every, clutter, "pmbm", "jipda") for clutter in _clutters(every)]
    if {"modes", "drive", "manoeuvre"} <= estimators:
        claims += _mode_claims(every)
    return claims


def _association_claims(every: pd.DataFrame) -> list[Claim]:
    least, most = min(_clutters(every)), max(_clutters(every))
    claims = [
        _lower_gospa(every, clutter, label, other)
        for label, other in (("jipda", "nearest"), ("jpda", "nearest"), ("jpda", "hungarian"))
        for clutter in _clutters(every)
    ]
    gained = {
        f"p_D {probability:g}": _change(every, probability, "jpda", "nearest")
        for probability in every["detection_probability"].unique()
    }
    statement = f"jpda gains more over nearest at {most:g} than at {least:g} false detections a scan"
    claims.append(lower(statement, "expected", "m", gained))
    statement = f"jpda switches tracks less often than nearest at {most:g} false detections a scan"
    fewer = _differences(every, most, "switches", "jpda", "nearest")
    return [*claims, lower(statement, "expected", "", fewer)]


def _clutters(every: pd.DataFrame) -> list[float]:
    return every["clutter_per_scan"].unique().tolist()


def _lower_gospa(every: pd.DataFrame, clutter: float, label: str, other: str) -> Claim:
    return lower(
        f"{label} has a lower GOSPA than {other} at {clutter:g} false detections a scan",
        "expected",
        "m",
        _differences(every, clutter, "gospa_m", label, other),
    )


def _mode_claims(every: pd.DataFrame) -> list[Claim]:
    least = every["clutter_per_scan"].min()
    straight = {
        f"target {number}, {name}": interval
        for number in (1, 2)
        for name, interval in _differences(
            every, least, f"target{number}_rmse_m", "modes", "manoeuvre"
        ).items()
    }
    return [
        lower(
            f"modes lower the RMSE of the target that turns, against driving alone, at {least:g}",
            "expected",
            "m",
            _differences(every, least, "target5_rmse_m", "modes", "drive"),
        ),
        lower(
            f"modes lower the RMSE of targets that go straight, against manoeuvring alone, at {least:g}",
            "expected",
            "m",
            straight,
        ),
    ]


def _differences(
    every: pd.DataFrame, clutter: float, quantity: str, label: str, other: str
) -> dict[str, Interval]:
    """The differences of two estimators at a rate of clutter, by probability of detection."""
    return {
        f"p_D {probability:g}": difference(_of(every, clutter, probability), quantity, label, other)
        for probability in every["detection_probability"].unique()
    }


def _of(every: pd.DataFrame, clutter: float, probability: float) -> pd.DataFrame:
    """The rows of one case."""
    is_of_case = every["clutter_per_scan"] == clutter
    return every[is_of_case & (every["detection_probability"] == probability)]


def _change(every: pd.DataFrame, probability: float, label: str, other: str) -> Interval:
    """By how much the difference in GOSPA of two estimators grows from the least clutter to the most."""
    at_probability = every[every["detection_probability"] == probability]
    by_run = at_probability.pivot_table("gospa_m", "run", ["estimator", "clutter_per_scan"], sort=False)
    apart = by_run[label] - by_run[other]
    return mean_interval((apart[max(apart)] - apart[min(apart)]).tolist())


CROSSING = Study("associations over clutter and probability of detection", study, CrossingOptions)
