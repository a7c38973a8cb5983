"""Defines a metric, and how metrics become the numbers of all that is judged.

They register by name, as estimators do. A metric is fed block by block, and what it makes of them can be
merged: over the blocks of a long log, over the runs of an ensemble, over the workers of a campaign.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from fuselog.recorders.registry import available, foreign_code, load
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.errors.evaluation import Errors, Innovations


class Output(NamedTuple):
    """Holds messages of one output topic of an estimator, of any schema.

    Row r of a run belongs to `sources[run]`, whose number in the whole ensemble is `first_run` + run.

    Attributes:
        estimator: the label of the estimator.
        case: what it estimates, such as `robot1`; may be empty.
        leaf: the last part of the name of the topic.
        rows: the messages, run by run.
        sources: the sensor streams and truth of each run.
        first_run: the number in the whole ensemble of the first run.
    """

    estimator: str
    case: str
    leaf: str
    rows: Ragged
    sources: Sequence[Source]
    first_run: int = 0


Judged = TypeVar("Judged", bound=Any)
State = TypeVar("State", bound=Any)


@dataclass(frozen=True)
class Metric(Generic[Judged, State]):
    """Describes a registered metric: what it tells, what it judges, and how it comes to its numbers.

    Attributes:
        summary: what it tells, in a line.
        judges: `Errors` for what follows from estimates and truth, `Innovations` for what a filter says
            of its measurements, the type that an entry point `fuselog.judges` gives, such as
            `SetErrors`, or `Output` for all messages.
        start: the state before anything was judged.
        add: the state after one block more; it may change the one that it is handed. The blocks of a
            run come in time.
        merge: the state of two parts that have no run in common.
        finish: a state's numbers as `quantity_unit`; none where there is nothing to say.

    Most metrics are made of sums: see `metric_of_sums`.
    """

    summary: str
    judges: type[Judged]
    start: Callable[[], State]
    add: Callable[[State, Judged], State]
    merge: Callable[[State, State], State]
    finish: Callable[[State], Mapping[str, float]]

    def of(self, judged: Judged) -> Mapping[str, float]:
        """Return the numbers of `judged` alone, as one block."""
        return self.finish(self.add(self.start(), judged))


Sums = dict[str, Any]


def metric_of_sums(
    summary: str,
    judges: type[Judged],
    sums: Callable[[Judged], Mapping[str, Any]],
    finish: Callable[[Sums], Mapping[str, float]],
) -> Metric[Judged, Sums]:
    """Return a metric whose state is sums by name.

    Args:
        summary: what it tells.
        judges: what it judges.
        sums: of one block: numbers and arrays, which add up, and sets, which unite.
        finish: the numbers that follow from the sums over all blocks; {} stands for no block at all.

    Returns:
        The metric, for registration under a name.

    >>> from fuselog.replay.judging.errors.evaluation import Errors
    >>> def counted(errors):
    ...     return {"near": int((abs(errors.error) < 1).all(axis=1).sum()), "all": len(errors.error)}
    >>> near = metric_of_sums(
    ...     "share of estimates with all errors below 1", Errors, counted,
    ...     lambda sums: {"near_share": sums["near"] / sums["all"]} if sums.get("all") else {},
    ... )
    >>> near.finish(near.merge({"near": 1, "all": 2}, {"near": 3, "all": 6}))
    {'near_share': 0.5}
    """
    return Metric(summary, judges, dict, lambda state, judged: plus(state, sums(judged)), plus, finish)


def plus(first: Sums, second: Mapping[str, Any]) -> Sums:
    """Add sums of both by name: numbers and arrays add up, sets unite."""
    total = dict(first)
    for name, value in second.items():
        if name not in total:
            total[name] = value
        else:
            total[name] = total[name] | value if isinstance(value, set) else total[name] + value
    return total


def find_metrics(names: Sequence[str] = ()) -> dict[str, Metric[Any, Any]]:
    """Return the metrics of these names, of all where none is given; BadInput for an unknown one."""
    return {name: load("metrics", name, Metric) for name in names or available("metrics")}


def metric_key(estimator: str, quantity: str, case: str) -> str:
    """Name a number: `estimator.quantity[.case]`."""
    return ".".join(filter(None, (estimator, quantity, case)))


class MetricCollection:
    """Collects what metrics make of all that is judged, as it comes.

    What is judged together (one output topic of one estimator) is told by a key.
    """

    def __init__(self, metrics: Mapping[str, Metric[Any, Any]]) -> None:
        self._metrics = dict(metrics)
        self._states: dict[tuple[type, str], dict[str, Any]] = {}
        self._named: dict[tuple[type, str], tuple[str, str]] = {}

    def add(self, key: str, judged: Any) -> None:
        """Judge a block; raises BadInput where a metric raises."""
        place = type(judged), key
        self._named[place] = judged.estimator, judged.case
        states = self._states.setdefault(place, {})
        for name, metric in self._metrics.items():
            if isinstance(judged, metric.judges):
                with foreign_code(f"metric {name}"):
                    state = states[name] if name in states else metric.start()
                    states[name] = metric.add(state, judged)

    def __getstate__(self) -> dict[str, Any]:
        """Return it as it is pickled: metrics are found again by their names."""
        return {**vars(self), "_metrics": list(self._metrics)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _metrics=find_metrics(state["_metrics"]))

    def merge(self, other: "MetricCollection") -> None:
        """Take in what was made of other runs by the same metrics."""
        self._named |= other._named
        for place, theirs in other._states.items():
            ours = self._states.setdefault(place, {})
            for name, state in theirs.items():
                with foreign_code(f"metric {name}"):
                    ours[name] = self._metrics[name].merge(ours[name], state) if name in ours else state

    def finish(self, of: Callable[[str], bool] | None = None) -> dict[str, float]:
        """Return the numbers, as `estimator.quantity[.case]`, of all keys or of some.

        Errors come first, then innovations. Raises BadInput where a metric raises.
        """
        values: dict[str, float] = {}
        for place in sorted(self._states, key=lambda place: _RANKS.get(place[0], 2)):
            states = self._states[place]
            if of is not None and not of(place[1]):
                continue
            estimator, case = self._named[place]
            for name, state in states.items():
                with foreign_code(f"metric {name}"):
                    for quantity, value in self._metrics[name].finish(state).items():
                        values[metric_key(estimator, quantity, case)] = float(value)
        return values


_RANKS: dict[type, int] = {Errors: 0, Innovations: 1, Output: 3}


def measure(judged: Iterable[Any], metrics: Mapping[str, Metric[Any, Any]]) -> dict[str, float]:
    """Measure all that was judged, each whole, as `estimator.quantity[.case]`.

    Raises BadInput where a metric raises.
    """
    measurement = MetricCollection(metrics)
    for number, each in enumerate(judged):
        measurement.add(str(number), each)
    return measurement.finish()
