"""Definition of metrics, and collections of metrics that compute the numbers of a replay.

Metrics are registered by name, as estimators are. A metric processes block after block, and its states
can be merged: over the blocks of a long log, the runs of an ensemble, or the workers of a campaign.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from fuselog.recorders.registry import available, foreign_code, load
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.errors.evaluation import Errors, Innovations


class Output(NamedTuple):
    """Messages of one output topic of an estimator, of any schema.

    Run r of `rows` belongs to `sources[r]`, whose number in the whole ensemble is `first_run` + r.

    Attributes:
        estimator: label of the estimator.
        case: name of the estimated object, such as `robot1`; may be empty.
        leaf: last part of the topic name.
        rows: the messages, run by run.
        sources: sensor streams and truth of each run.
        first_run: number of the first run in the whole ensemble.
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
    """Registered metric: description, input, and functions that compute it.

    Attributes:
        summary: one-line description.
        judges: type of the input: `Errors` for metrics of estimates and truth, `Innovations` for
            metrics of a filter's innovations, the type that an entry point `fuselog.judges` returns,
            such as `SetErrors`, or `Output` for all messages.
        start: start() -> the initial state, without any input.
        add: add(state, block) -> the state after one more block; it may modify the given state. The
            blocks of a run are in order of time.
        merge: merge(first, second) -> the combined state of two parts, which have no run in common.
        finish: finish(state) -> values by name, as `quantity_unit`; empty if there are no values.

    Most metrics are computed from sums; see `metric_of_sums`.
    """

    summary: str
    judges: type[Judged]
    start: Callable[[], State]
    add: Callable[[State, Judged], State]
    merge: Callable[[State, State], State]
    finish: Callable[[State], Mapping[str, float]]

    def of(self, judged: Judged) -> Mapping[str, float]:
        """Compute the values by name for `judged` as a single block."""
        return self.finish(self.add(self.start(), judged))


Sums = dict[str, Any]


def metric_of_sums(
    summary: str,
    judges: type[Judged],
    sums: Callable[[Judged], Mapping[str, Any]],
    finish: Callable[[Sums], Mapping[str, float]],
) -> Metric[Judged, Sums]:
    """Make a metric whose state is sums by name.

    Args:
        summary: one-line description.
        judges: type of the input.
        sums: sums(block) -> sums by name: numbers and arrays are added, sets are united.
        finish: finish(sums over all blocks) -> the values by name; without any block, the sums are {}.

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
    """Add sums by name: add numbers and arrays, unite sets."""
    total = dict(first)
    for name, value in second.items():
        if name not in total:
            total[name] = value
        else:
            total[name] = total[name] | value if isinstance(value, set) else total[name] + value
    return total


def find_metrics(names: Sequence[str] = ()) -> dict[str, Metric[Any, Any]]:
    """Return the metrics with these names, or all metrics; raise BadInput for an unknown name."""
    return {name: load("metrics", name, Metric) for name in names or available("metrics")}


def metric_key(estimator: str, quantity: str, case: str) -> str:
    """Return the key of a number: `estimator.quantity[.case]`."""
    return ".".join(filter(None, (estimator, quantity, case)))


class MetricCollection:
    """Collection of metrics that are computed block by block.

    A key identifies one output topic of one estimator, whose blocks are judged together.
    """

    def __init__(self, metrics: Mapping[str, Metric[Any, Any]]) -> None:
        self._metrics = dict(metrics)
        self._states: dict[tuple[type, str], dict[str, Any]] = {}
        self._named: dict[tuple[type, str], tuple[str, str]] = {}

    def add(self, key: str, judged: Any) -> None:
        """Add a block to all metrics that judge its type; raise BadInput if a metric raises."""
        place = type(judged), key
        self._named[place] = judged.estimator, judged.case
        states = self._states.setdefault(place, {})
        for name, metric in self._metrics.items():
            if isinstance(judged, metric.judges):
                with foreign_code(f"metric {name}"):
                    state = states[name] if name in states else metric.start()
                    states[name] = metric.add(state, judged)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling; metrics are stored by name and looked up again."""
        return {**vars(self), "_metrics": list(self._metrics)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _metrics=find_metrics(state["_metrics"]))

    def merge(self, other: "MetricCollection") -> None:
        """Add the states of the same metrics for other runs."""
        self._named |= other._named
        for place, theirs in other._states.items():
            ours = self._states.setdefault(place, {})
            for name, state in theirs.items():
                with foreign_code(f"metric {name}"):
                    ours[name] = self._metrics[name].merge(ours[name], state) if name in ours else state

    def finish(self, of: Callable[[str], bool] | None = None) -> dict[str, float]:
        """Compute the numbers of all keys, or those that `of` selects, as `estimator.quantity[.case]`.

        Errors come first, then innovations. Raises BadInput if a metric raises an exception.
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
    """Compute metrics of judged objects, one block each, with the keys `estimator.quantity[.case]`.

    Raises BadInput if a metric raises an exception.
    """
    measurement = MetricCollection(metrics)
    for number, each in enumerate(judged):
        measurement.add(str(number), each)
    return measurement.finish()
