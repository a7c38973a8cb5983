"""Study of sequential verification, with Wald's test of each probe and Page's test of the matcher.

Log-likelihood ratios are calibrated on users other than those to whom they are applied. A matcher's
ratios are resampled by users as clusters: a replicate draws users with replacement, and all intervals
are quantiles over the replicates. The data contain one genuine score per user and matcher, so further
probes of a person are simulated with scores of other persons. These simulated probes are independent, or
their normal scores have an assumed correlation. Only two kinds of sequences are entirely real: one
person with one matcher after another, and many impostors against one identity.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field, PositiveFloat, PositiveInt
from scipy.special import ndtr

from fuselog.pipeline.families.biometrics.watched import Labelled, faulty, watching
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.biometrics.sequential import (
    Decisions,
    Rates,
    decide,
    first_alarm,
    page_sums,
    wald_bounds,
    wald_probes,
)
from fuselog.replay.families.biometrics.verification import Fused, fused_of
from fuselog.replay.judging.errors.evaluation import split_topic
from fuselog.replay.judging.intervals import Interval

Share = Annotated[float, Field(gt=0, lt=0.5)]
RatioOf = Callable[[Integers], Floats]
WAYS = {
    "independent": "independent probes",
    "one-identity": "impostors against one identity",
    "alike": "correlated probes of one person",
    "matchers": "one person, one matcher after another",
}
# The person scores like an impostor, impostors score like the person, or genuine scores decrease.
FAULTS = ("misses", "accepts", "drifts")
FIXED_PROBES = 50  # more probes than any matcher needs
IMPOSTORS = 100_000  # enough probes to cover the tail of all impostor scores


class Options(Parameters):
    """The error rates of the tests, and options of their evaluation.

    Attributes:
        rates: pairs of specified false accept and false reject rates.
        alike: correlation of the normal scores of one person's probes.
        sequences: number of sequences of probes to draw.
        replicates: number of times that users are resampled.
        most_probes: number of probes after which an undecided sequence ends.
        label_ratio: smallest absolute sum of the other matchers' log-likelihood ratios for which a probe
            is labelled and used to monitor a matcher.
        run_length: specified mean number of labelled probes until a false alarm.
        watched: number of series of probes in which a matcher is monitored.
        watched_probes: number of probes in a series without a fault.
        fault_probes: number of probes in a series with a fault.
    """

    rates: list[tuple[Share, Share]] = [(0.01, 0.01), (0.001, 0.01)]
    alike: Annotated[float, Field(ge=0, lt=1)] = 0.5
    sequences: PositiveInt = 5_000
    replicates: Annotated[int, Field(ge=20)] = 80
    most_probes: PositiveInt = 200
    label_ratio: PositiveFloat = 7.0
    run_length: PositiveFloat = 1000.0
    watched: PositiveInt = 20
    watched_probes: PositiveInt = 5000
    fault_probes: PositiveInt = 500


class Drawn(NamedTuple):
    """A matcher's ratios (users, users) by probe and gallery entry, and users (n,) of a replicate."""

    ratios: Floats
    users: Integers

    def others(self, gallery: Integers, rng: np.random.Generator) -> Integers:
        """Draw a probe for each gallery entry (n,), from a user other than the entry's."""
        probe = rng.choice(self.users, len(gallery))
        while (same := probe == gallery).any():
            probe[same] = rng.choice(self.users, int(same.sum()))
        return probe

    def impostors(self, count: int, rng: np.random.Generator) -> tuple[Integers, Integers]:
        """Draw users of probes and of gallery entries (count,), never the same user for both."""
        gallery = rng.choice(self.users, count)
        return self.others(gallery, rng), gallery


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    replayed = Runner(experiment, setting).run()
    ratios = {
        split_topic(topic)[1]: _matrix(fused_of(rows.of_run(0)))
        for topic, rows in replayed.outputs.items()
        if topic.endswith("/fused")
    }
    if len(ratios) < 2:
        raise BadInput(
            "study biometrics-sequential monitors each matcher with the help of the others; give a "
            "score-mixture of all pairs, with at least two matchers as its subsets"
        )
    rng = np.random.default_rng(experiment.seed)
    count = len(next(iter(ratios.values())))
    draws = [np.arange(count), *rng.integers(count, size=(options.replicates, count))]
    tests: list[pd.DataFrame] = []
    watches: list[pd.DataFrame] = []
    for number, users in enumerate(setting.progress(draws, "drawing users again", len(draws))):
        drawn = {name: Drawn(matrix, users) for name, matrix in ratios.items()}
        tests.append(pd.DataFrame(wald_tests(drawn, options, rng)).assign(replicate=number))
        watches.append(pd.DataFrame(watched(drawn, options, rng)).assign(replicate=number))
    outcome = Outcome(input_sha256=hash_streams(replayed.sources))
    _tell_tests(_intervals(pd.concat(tests), ["way", "matcher", "rates"]), ratios, options, outcome, rng)
    _tell_watches(_intervals(pd.concat(watches), ["fault", "matcher"]), outcome)
    return outcome


def _matrix(fused: Fused) -> Floats:
    """Return ratios (users, users) by probe and gallery entry; raise BadInput if pairs are missing."""
    if not (fused.is_ratio and fused.is_complete):
        raise BadInput(
            "study biometrics-sequential needs log-likelihood ratios of all pairs; give a score-mixture "
            'with pairs = "all"'
        )
    users = int(fused.gallery.max()) + 1
    matrix = np.empty((users, users))
    matrix[fused.probe, fused.gallery] = fused.score
    return matrix


def wald_tests(
    drawn: Mapping[str, Drawn], options: Options, rng: np.random.Generator
) -> Iterator[dict[str, Any]]:
    """Evaluate Wald's test: errors and numbers of probes by kind of sequence, matcher and rates."""
    count, most = options.sequences, options.most_probes
    for stated in options.rates:
        rates = Rates(*stated)
        for matcher, each in drawn.items():
            for way in ("independent", "one-identity", "alike"):
                genuine, impostors = probes_of(way, each, options, rng)
                decisions = [decide(of, count, rates, most) for of in (genuine, impostors)]
                yield {"way": way, "matcher": matcher, "rates": stated, **_found(*decisions)}
        first = next(iter(drawn.values()))
        users, pairs = first.users, first.impostors(count, rng)
        own = [np.diag(each.ratios)[users] for each in drawn.values()]
        of_others = [each.ratios[pairs] for each in drawn.values()]
        decisions = [
            decide(in_turn(ratios), len(ratios[0]), rates, len(ratios)) for ratios in (own, of_others)
        ]
        yield {"way": "matchers", "matcher": "all", "rates": stated, **_found(*decisions)}


def probes_of(
    way: str, drawn: Drawn, options: Options, rng: np.random.Generator
) -> tuple[RatioOf, RatioOf]:
    """Return functions that draw the next ratios of sequences of probes, for persons and impostors."""
    genuine = np.diag(drawn.ratios)[drawn.users]
    if way == "alike":
        some = drawn.ratios[drawn.impostors(IMPOSTORS, rng)]
        same, other = (_alike(ratios, options, rng) for ratios in (genuine, some))
        return same, other
    claimed = rng.choice(drawn.users, options.sequences)

    def of_impostors(going: Integers) -> Floats:
        if way == "one-identity":
            return drawn.ratios[drawn.others(claimed[going], rng), claimed[going]]
        return drawn.ratios[drawn.impostors(len(going), rng)]

    return lambda going: rng.choice(genuine, len(going)), of_impostors


def _alike(ratios: Floats, options: Options, rng: np.random.Generator) -> RatioOf:
    """Return a function that draws correlated probes whose ratios have the given distribution."""
    ordered, share = np.sort(ratios), options.alike
    own = rng.normal(size=options.sequences)

    def ratio_of(going: Integers) -> Floats:
        normal = np.sqrt(share) * own[going] + np.sqrt(1.0 - share) * rng.normal(size=len(going))
        return ordered[np.minimum((ndtr(normal) * len(ordered)).astype(int), len(ordered) - 1)]

    return ratio_of


def in_turn(ratios: Sequence[Floats]) -> RatioOf:
    """Return a function that uses the ratios of one matcher after another in every sequence."""
    left = iter(ratios)
    return lambda going: next(left)[going]


def _found(genuine: Decisions, impostors: Decisions) -> dict[str, float]:
    """Compute the shares of wrong and missing decisions, and the mean number of probes per decision."""
    undecided = np.concatenate([genuine.probes, impostors.probes]) == 0
    return {
        "false_accept": float(impostors.accepted.mean()),
        "false_reject": float(genuine.rejected.mean()),
        "genuine_probes": float(genuine.probes[genuine.probes > 0].mean()),
        "impostor_probes": float(impostors.probes[impostors.probes > 0].mean()),
        "undecided": float(undecided.mean()),
    }


def fixed_number(ratios: Floats, rates: Rates, rng: np.random.Generator) -> float:
    """Find the smallest number of independent probes whose summed ratios meet both error rates.

    Args:
        ratios: (users, users), log-likelihood ratios by probe and gallery entry.
        rates: the error rates to meet.
        rng: random number generator that draws the probes.

    Returns:
        The number of probes; NaN if `FIXED_PROBES` are not enough.
    """
    drawn = Drawn(ratios, np.arange(len(ratios)))
    same, other = np.zeros(IMPOSTORS), np.zeros(IMPOSTORS)
    for number in range(1, FIXED_PROBES + 1):
        same += rng.choice(np.diag(ratios), IMPOSTORS)
        other += ratios[drawn.impostors(IMPOSTORS, rng)]
        if np.mean(same <= np.quantile(other, 1.0 - rates.false_accept)) <= rates.false_reject:
            return float(number)
    return float("nan")


def watched(
    drawn: Mapping[str, Drawn], options: Options, rng: np.random.Generator
) -> Iterator[dict[str, Any]]:
    """Count the probes until the alarm, by fault and matcher; "none" means a matcher without a fault.

    Half of the users are the reference; the other half is monitored.
    """
    users = next(iter(drawn.values())).users
    is_reference = rng.permutation(int(users.max()) + 1) % 2 == 0
    halves = [users[is_reference[users] == half] for half in (True, False)]
    for matcher, each in drawn.items():
        label = sum(other.ratios for name, other in drawn.items() if name != matcher)
        assert isinstance(label, np.ndarray)
        size = options.watched * options.watched_probes
        reference, seen = (
            labelled(Drawn(each.ratios, half), label, options.label_ratio, size, rng) for half in halves
        )
        steady = [np.sort(reference.ratio[reference.is_genuine == kind]) for kind in (False, True)]
        if min(map(len, steady)) == 0 or len(seen.ratio) < options.watched_probes:
            raise BadInput(
                f"study biometrics-sequential: the other matchers can label only {len(seen.ratio)} of "
                f"{size} probes to monitor {matcher}; lower options.label_ratio or give other matchers"
            )
        for fault in ("none", *FAULTS):
            probes = options.watched_probes if fault == "none" else options.fault_probes
            whole = min(len(seen.ratio), options.watched * probes) // probes * probes
            some = Labelled(seen.ratio[:whole], seen.is_genuine[:whole])
            now = some._replace(ratio=faulty(fault, some, steady, rng))
            changes = watching(now, steady).reshape(4, -1, probes)
            alarm = first_alarm(page_sums(changes).max(axis=0), options.run_length, together=2)
            yield {
                "fault": fault,
                "matcher": matcher,
                "probes": float(np.where(alarm > 0, alarm, probes).mean()),
                "silent": float(np.mean(alarm == 0)),
            }


def labelled(
    drawn: Drawn, label: Floats, least: float, count: int, rng: np.random.Generator
) -> Labelled:
    """Draw probes and label them with the other matchers; drop probes that those leave undecided.

    Args:
        drawn: the matcher's ratios, and the users.
        label: (users, users), the summed log-likelihood ratios of the other matchers.
        least: smallest absolute ratio for which a probe is labelled.
        count: number of probes to draw, about half of them genuine.
        rng: random number generator that draws the probes.

    Returns:
        The labelled probes.
    """
    probe, gallery = drawn.impostors(count, rng)
    probe = np.where(rng.random(count) < 0.5, gallery, probe)
    labels = label[probe, gallery]
    clear = np.abs(labels) >= least
    return Labelled(drawn.ratios[probe, gallery][clear], labels[clear] > 0.0)


def _intervals(table: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Compute the value for all users, and its 95 % interval over the replicates."""
    quantities = table.columns.drop([*by, "replicate"])
    rows = []
    for key, group in table.groupby(by, sort=False):
        of = dict(zip(by, key, strict=True))
        for name in quantities:
            whole, replicates = group[name].iloc[0], group[name].iloc[1:].dropna()
            low, high = np.quantile(replicates, [0.025, 0.975]) if len(replicates) else (np.nan, np.nan)
            rows.append({**of, "quantity": name, "value": whole, "low": low, "high": high})
    return pd.DataFrame(rows)


def _tell_tests(
    table: pd.DataFrame,
    ratios: Mapping[str, Floats],
    options: Options,
    outcome: Outcome,
    rng: np.random.Generator,
) -> None:
    """Add metrics and a figure of Wald's tests to the outcome."""
    for row in records(table):
        quantity, case = row["quantity"], f"{row['matcher']}-{_case(row['rates'])}"
        is_share = quantity in ("false_accept", "false_reject", "undecided")
        key = f"{row['way']}.{quantity}{'_percent' if is_share else ''}.{case}"
        _measure(row, key, 100.0 if is_share else 1.0, outcome)
    outcome.tables["tests"] = table.assign(rates=table["rates"].map(_percents))
    for stated in options.rates:
        rates = Rates(*stated)
        for error, bound in wald_bounds(rates)._asdict().items():
            outcome.metrics[f"wald.{error}_percent.{_case(stated)}"] = 100.0 * bound
        for matcher, matrix in ratios.items():
            case = f"{matcher}-{_case(stated)}"
            outcome.metrics[f"fixed.probes.{case}"] = fixed_number(matrix, rates, rng)
            means = np.diag(matrix).mean(), matrix[~np.eye(len(matrix), dtype=bool)].mean()
            for kind, mean in zip(("genuine", "impostor"), means, strict=True):
                wald = wald_probes(rates, float(mean), genuine=kind == "genuine")
                outcome.metrics[f"wald.{kind}_probes.{case}"] = wald
    outcome.figures["tests"] = _chart_of_tests(table, options)


def _tell_watches(table: pd.DataFrame, outcome: Outcome) -> None:
    """Add metrics of the monitoring of matchers to the outcome."""
    outcome.tables["watch"] = table
    for row in records(table):
        name, scale = ("silent_percent", 100.0) if row["quantity"] == "silent" else ("probes", 1.0)
        _measure(row, f"watch.{name}.{row['fault']}-{row['matcher']}", scale, outcome)


def _measure(row: Mapping[str, Any], key: str, scale: float, outcome: Outcome) -> None:
    outcome.measure(key, Interval(*(scale * row[name] for name in ("value", "low", "high"))))


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as dictionaries."""
    rows: list[Any] = table.to_dict("records")
    return rows


def _chosen(table: pd.DataFrame, **of: Any) -> pd.DataFrame:
    """Select the rows in which columns have the given values."""
    for name, value in of.items():
        table = table[table[name] == value]
    return table


def _percents(rates: tuple[float, float]) -> str:
    return " and ".join(f"{100.0 * rate:g} %" for rate in rates)


def _case(rates: tuple[float, float]) -> str:
    return "-".join(f"{100.0 * rate:g}".replace(".", "p") for rate in rates)


def _chart_of_tests(table: pd.DataFrame, options: Options) -> Chart:
    """Draw false accepts and mean numbers of probes by matcher, per kind of sequence and rates."""
    panels = []
    for quantity, label in (
        ("false_accept", "false accepts (share)"),
        ("genuine_probes", "mean number of probes of the person"),
    ):
        panel = Panel(x=Axis(label="matcher"), y=Axis(label=label, log=quantity == "false_accept"))
        for stated, way in product(options.rates, WAYS):
            rows = _chosen(table, way=way, rates=stated, quantity=quantity)
            name = f"{WAYS[way]}, {_percents(stated)}"
            panel.series.append(curve(name, rows["matcher"].tolist(), rows["value"], "markers"))
        panels.append(panel)
    return Chart(panels=panels)


BIOMETRICS_SEQUENTIAL = Study(
    "sequential verification by several probes, and detection of matchers that fail or drift",
    study,
    Options,
)
