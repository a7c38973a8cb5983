"""Estimators from plain functions: what is alike in all of them, written once.

`recursive` makes an estimator of a function that follows one run through its messages, compiled or not;
`batch` of one that solves whole streams. Both find their topics, once for every robot or other prefix
that has them, name the outputs, and tell of a run that failed while the others go on.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Generic, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log import Schema, Stream, Topic, make_stream, schemas
from recorders.parameters import ParametersType
from replay.blocks import Block, Ragged, ragged_rows
from replay.compile import compile_over_runs, uncompiled_over_runs
from replay.components import Components
from replay.engine import Batch, Bound, Estimator, Recursive
from replay.failures import Failure, reason_of, reason_stream
from replay.measurements import Vectors, numbers_of
from replay.priors import gaussians
from replay.results import failures_by_run, innovation_stream, state_stream
from replay.tangent import tangent_components

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

DIVERGED = "the estimate is no longer finite: the filter diverged"


@dataclass(frozen=True)
class Given(Generic[ParametersType]):
    """What a recursion starts from; topics go by the names under which it asked for them."""

    parameters: ParametersType
    topics: Mapping[str, Topic]
    whole: Mapping[str, Ragged]
    runs: int

    def stated(self, topic: str, name: str) -> float:
        """The parameter `name`, or where it is None the number that the topic's channel states.

        Raises BadInput where neither does.
        """
        value = getattr(self.parameters, name)
        try:
            return float(self.topics[topic].metadata[name] if value is None else value)
        except (KeyError, ValueError):
            raise BadInput(
                f"topic {self.topics[topic].name} does not state {name}; give it with --set {name}=..."
            ) from None

    def prior(self, topic: str) -> tuple[Integers, Floats, Floats]:
        """The prior of every run: stamps (runs,), means (runs, d), covariances (runs, t, t).

        They are of the estimate's components, in their order, whatever the log's order is. NaN where a
        run has none that can be used: it has failed, and gets no messages.
        """
        return gaussians(self.whole[topic])


class Messages(NamedTuple):
    """The messages of all runs in time order: run r owns the rows offsets[r]:offsets[r + 1].

    Attributes:
        offsets: (runs + 1,).
        time_ns: (n,).
        topic: (n,) which stream, in the order in which they were asked for.
        value: (n, width) the fields after the sensor's clock, in order of declaration; NaN beyond. Of
            vectors there are the components that were asked for, in that order.
    """

    offsets: Integers
    time_ns: Integers
    topic: Integers
    value: Floats


class Results(NamedTuple):
    """What a recursion fills, one row for every message; a row of NaN says nothing.

    Attributes:
        mean, covariance: (n, d), (n, t, t) the estimate after the message; t components in the tangent
            space (see `replay.tangent`), d where all are linear or angles.
        innovation, innovation_covariance: (n, m), (n, m, m) of the message.
        squared: (n,) the normalised innovation squared.
        accepted: (n,) whether a gate let the message in; 1 unless set.
        target: (n,) what the message was about; 0 unless set.
    """

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats
    accepted: Integers
    target: Integers


class Solution(NamedTuple):
    """How the solutions ended, (n,) each; the cost is what was minimised."""

    iterations: Integers
    converged: Integers
    rank: Integers
    cost: Floats


class Estimates(NamedTuple):
    """What streams were solved to: stamps (n,), means (n, d), covariances (n, t, t), how it ended."""

    time_ns: Integers
    mean: Floats
    covariance: Floats
    solution: Solution | None = None


class Solved(NamedTuple):
    """The estimates of all runs end to end, run r owning offsets[r]:offsets[r + 1]; failures by run."""

    offsets: Integers
    estimates: Estimates
    failures: Mapping[int, Failure]


def recursive(
    summary: str,
    *,
    parameters: type[ParametersType],
    streams: Mapping[str, Schema],
    whole: Mapping[str, Schema],
    components: Components,
    truth: str = "",
    measured: Components | None = None,
    vectors: Mapping[str, Vectors] | None = None,
    start: Callable[[Given[ParametersType]], tuple[Any, Any]],
    follow: Callable[[int, Any, Messages, Any, Results], None] | None = None,
    follow_all: Callable[[Any, Messages, Any, Results], None] | None = None,
    compiled: bool = True,
) -> Estimator[ParametersType]:
    """An estimator that follows its messages in time.

    Args:
        summary: what it is, in one line.
        parameters: their type.
        streams: the topics to follow, with their schemas; see `bindings` for their names.
        whole: the topics that `start` needs whole, such as a map or a prior. Gaussian estimates among
            them are priors: of the estimate's components, see `Given.prior`.
        components: the estimate's components by name, with their kinds.
        truth: the topic with the truth of what is estimated.
        measured: the components of the innovations, where `follow` tells of them.
        vectors: what is wanted of the vectors that topics of `streams` hold, by topic. What the log
            does not say of them is refused; without an entry here vectors come as the log has them.
        start: what is given -> settings, and the state: a NamedTuple of arrays with a first axis of
            runs. A run has failed where its row in the first of them is not finite.
        follow: follow(run, settings, messages, state, results) takes one run through a block of its
            messages: it changes that run's rows of `state`, and fills `results`, in place.
        follow_all: in place of `follow`: follow_all(settings, messages, state, results) takes all runs
            at once, and is called as it is. For NumPy with an axis of runs, or a loop compiled already.
        compiled: whether numba compiles `follow`; plain Python is a hundred times slower.
    """

    @cache
    def following() -> Callable[[Any, Messages, Any, Results], None]:
        if follow_all is not None:
            return follow_all
        assert follow is not None
        loop = compile_over_runs(follow) if compiled else uncompiled_over_runs(follow)
        return lambda settings, messages, state, results: loop(
            len(messages.offsets) - 1, settings, messages, state, results
        )

    def bind(name: str, prefix: str, found: Mapping[str, Topic], values: ParametersType) -> Bound:
        outputs = _Outputs(f"/estimates/{name}", _resolved(truth, prefix), components, measured or {})
        wanted = {found[topic].name: each for topic, each in (vectors or {}).items()}

        def started(maps: Mapping[str, Ragged], runs: int) -> _Carried:
            return _Carried(*start(Given(values, found, maps, runs)), np.zeros(runs, bool))

        def begin(given: dict[str, Ragged]) -> _Carried | None:
            maps = {each: given[found[each].name] for each in whole}
            return started(maps, next(iter(maps.values())).runs) if maps else None

        def advance(carried: _Carried | None, block: Block) -> tuple[_Carried, list[Ragged]]:
            # without anything whole, the first block is what tells how many runs there are
            settings, before, told = carried or started({}, len(block.events.offsets) - 1)
            state = type(before)(*(array.copy() for array in before))
            messages, skipped = _messages(block, wanted, values)
            results = outputs.blank(len(messages.time_ns))
            following()(settings, messages, state, results)
            is_lost = ~np.isfinite(np.reshape(state[0], (len(told), -1)).sum(axis=1))
            failing: NDArray[np.bool_] = is_lost & ~told & (np.diff(messages.offsets) > 0)
            made = outputs.of_block(messages, results, np.flatnonzero(failing))
            return _Carried(settings, state, told | failing), [*made, *outputs.of_skipped(skipped)]

        read, needed = _topics(found, streams), _topics(found, whole)
        return Recursive(name, read, needed, begin, advance, _priors(found, whole, components))

    return _estimator(summary, parameters, {**streams, **whole}, bind)


def batch(
    summary: str,
    *,
    parameters: type[ParametersType],
    streams: Mapping[str, Schema],
    whole: Mapping[str, Schema],
    components: Components,
    truth: str = "",
    solve: Callable[[Mapping[str, Ragged], ParametersType], Solved],
) -> Estimator[ParametersType]:
    """An estimator that solves whole streams.

    Args as for `recursive`, and:
        solve: solve(given, parameters) gets the streams and whole topics of all runs, by the names
            asked for; `each_run` makes it of a function of one run.
    """

    def bind(name: str, prefix: str, found: Mapping[str, Topic], values: ParametersType) -> Bound:
        outputs = _Outputs(f"/estimates/{name}", _resolved(truth, prefix), components, {})

        def solve_all(given: dict[str, Ragged]) -> list[Ragged]:
            return outputs.of_solved(solve({each: given[found[each].name] for each in found}, values))

        read, needed = _topics(found, streams), _topics(found, whole)
        return Batch(name, read, needed, solve_all, _priors(found, whole, components))

    return _estimator(summary, parameters, {**streams, **whole}, bind)


def each_run(
    solve: Callable[[Mapping[str, Stream], ParametersType], Estimates],
) -> Callable[[Mapping[str, Ragged], ParametersType], Solved]:
    """Solve run by run, for `batch`.

    Where `solve` raises, that run has failed; where all do, it is the input that is bad.
    """

    def solve_all(given: Mapping[str, Ragged], parameters: ParametersType) -> Solved:
        solved: list[Estimates] = []
        failures: dict[int, Failure] = {}
        errors: list[Exception] = []
        counts = [0]
        for run in range(next(iter(given.values())).runs):
            streams = {name: ragged.of_run(run) for name, ragged in given.items()}
            try:
                solved.append(solve(streams, parameters))
                counts.append(len(solved[-1].time_ns))
            except (MemoryError, OSError):
                raise
            except Exception as error:
                end_ns = max(stream.publish_time_ns.max(initial=0) for stream in streams.values())
                failures[run] = Failure(int(end_ns), reason_of(error))
                errors.append(error)
                counts.append(0)
        if not solved:
            raise errors[0]
        return Solved(np.cumsum(counts), _joined(solved), failures)

    return solve_all


def _joined(parts: Sequence[Estimates]) -> Estimates:
    solutions = [part.solution for part in parts if part.solution]
    return Estimates(
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([part.mean for part in parts]),
        np.concatenate([part.covariance for part in parts]),
        Solution(*map(np.concatenate, zip(*solutions, strict=True))) if solutions else None,
    )


def bindings(
    topics: Mapping[str, Topic], asked: Mapping[str, Schema]
) -> Iterator[tuple[str, dict[str, Topic]]]:
    """Where a log has all the topics asked for, with their schemas: prefix, and topics as asked for.

    A name with a slash in front, such as `/landmarks`, is a topic for all; others, such as `odometry`,
    are looked for under every prefix: `/robot1/odometry`, `/robot2/odometry`.
    """
    own = [name for name in asked if not name.startswith("/")]
    end = f"/{own[0]}" if own else ""
    prefixes = [name.removesuffix(end) for name in topics if name.endswith(end)] if own else [""]
    for prefix in prefixes:
        found = {
            name: topics[full]
            for name, schema in asked.items()
            if (full := _resolved(name, prefix)) in topics
            and topics[full].schema_name == schema.full_name
        }
        if len(found) == len(asked):
            yield prefix, found


def _resolved(name: str, prefix: str) -> str:
    return name if name.startswith("/") or not name else f"{prefix}/{name}"


def _priors(
    found: Mapping[str, Topic], whole: Mapping[str, Schema], components: Components
) -> dict[str, Components]:
    return {
        found[name].name: components
        for name, schema in whole.items()
        if schema is schemas.GAUSSIAN_ESTIMATE
    }


def _topics(found: Mapping[str, Topic], names: Mapping[str, Schema]) -> tuple[str, ...]:
    return tuple(found[name].name for name in names)


def _estimator(
    summary: str,
    parameters: type[ParametersType],
    asked: Mapping[str, Schema],
    bind_one: Callable[[str, str, Mapping[str, Topic], ParametersType], Bound],
) -> Estimator[ParametersType]:
    def bind(label: str, topics: Mapping[str, Topic], values: ParametersType) -> list[Bound]:
        return [
            bind_one(f"{label}{prefix}", prefix, found, values)
            for prefix, found in bindings(topics, asked)
        ]

    needs = [f"{_resolved(name, '...')} ({schema.full_name})" for name, schema in asked.items()]
    return Estimator(summary, ", ".join(needs), parameters, bind)


class _Carried(NamedTuple):
    """What a recursion carries from block to block; `told` (runs,) says whose failure was told."""

    settings: Any
    state: Any
    told: NDArray[np.bool_]


class _Skipped(NamedTuple):
    """Messages that were not used: offsets by run, stamps, and the number of the reason of each."""

    offsets: Integers
    time_ns: Integers
    reason: Integers
    reasons: list[str]


def _messages(
    block: Block, vectors: Mapping[str, Vectors], parameters: Any
) -> tuple[Messages, _Skipped]:
    """A block's messages, their fields as numbers; and those that lack a covariance."""
    events = block.events
    read = [
        numbers_of(ragged.stream, vectors.get(topic), parameters)
        for topic, ragged in block.streams.items()
    ]
    tables, missing = zip(*read, strict=True)
    skip = np.concatenate(missing)[events.source]
    reasons = [vectors[topic].complaint(topic) if topic in vectors else "" for topic in block.streams]
    skipped = _Skipped(
        ragged_rows(skip, events.offsets), events.time_ns[skip], events.topic[skip], reasons
    )
    # the messages of one topic are in order already
    value = tables[0] if len(tables) == 1 else _side_by_side(tables)[events.source]
    rows = ~skip if skip.any() else slice(None)
    kept = Messages(
        ragged_rows(~skip, events.offsets),
        events.time_ns[rows],
        events.topic[rows],
        value[rows],
    )
    return kept, skipped


def _side_by_side(tables: Sequence[Floats]) -> Floats:
    """Tables one after another, NaN where one has fewer columns than the widest."""
    width = max(table.shape[1] for table in tables)
    found = np.full((sum(map(len, tables)), width), np.nan)
    for begin, table in zip(np.cumsum([0, *map(len, tables)]), tables, strict=False):
        found[begin : begin + len(table), : table.shape[1]] = table
    return found


@dataclass(frozen=True)
class _Outputs:
    """The output topics of one bound estimator: state, failures and, where told, innovations."""

    topic: str
    truth: str
    components: Components
    measured: Components

    def blank(self, rows: int) -> Results:
        """Results that say nothing."""
        d, m = len(self.components), len(self.measured)
        t = len(tangent_components(list(self.components), list(self.components.values())))
        return Results(
            np.full((rows, d), np.nan),
            np.full((rows, t, t), np.nan),
            np.full((rows, m), np.nan),
            np.full((rows, m, m), np.nan),
            np.full(rows, np.nan),
            np.ones(rows, np.int64),
            np.zeros(rows, np.int64),
        )

    def of_block(self, messages: Messages, results: Results, failing: Integers) -> list[Ragged]:
        """The outputs of one block; of several estimates at a stamp the last stands."""
        # what is said of a covariance that is none is for the replay to find
        said = np.isfinite(np.einsum("nd->n", results.mean))
        rows = _last_of_stamps(messages, np.flatnonzero(said))
        state = self._state(messages.time_ns[rows], results.mean[rows], results.covariance[rows])
        failures = {}
        for run in failing.tolist():
            begin, end = messages.offsets[run : run + 2]
            last = np.flatnonzero(said[begin:end]).max(initial=-1)
            end_ns = messages.time_ns[min(begin + last + 1, end - 1)]
            failures[run] = Failure(int(end_ns), DIVERGED)
        made = [
            Ragged(state, np.searchsorted(rows, messages.offsets)),
            failures_by_run(self.topic, failures, len(messages.offsets) - 1),
        ]
        return [*made, self._innovations(messages, results)] if self.measured else made

    def of_solved(self, solved: Solved) -> list[Ragged]:
        """The outputs of a batch."""
        offsets, estimates, failures = solved
        time_ns, solution = estimates.time_ns, estimates.solution
        made = [
            Ragged(self._state(time_ns, estimates.mean, estimates.covariance), offsets),
            failures_by_run(self.topic, failures, len(offsets) - 1),
        ]
        if solution:
            topic, metadata = f"{self.topic}/solution", {"truth": self.truth}
            columns = solution._asdict()
            told = make_stream(topic, schemas.SOLUTION, time_ns, metadata=metadata, **columns)
            made.append(Ragged(told, offsets))
        return made

    def _state(self, time_ns: Integers, mean: Floats, covariance: Floats) -> Stream:
        return state_stream(
            f"{self.topic}/state", time_ns, self.components, self.truth, mean, covariance
        )

    def of_skipped(self, skipped: _Skipped) -> list[Ragged]:
        """What was not used, for estimators of what may lack a covariance."""
        if not any(skipped.reasons):
            return []
        topic = f"{self.topic}/skipped"
        stream = reason_stream(topic, schemas.SKIPPED, skipped.time_ns, skipped.reason, skipped.reasons)
        return [Ragged(stream, skipped.offsets)]

    def _innovations(self, messages: Messages, results: Results) -> Ragged:
        rows = np.flatnonzero(np.isfinite(results.squared))
        stream = innovation_stream(
            f"{self.topic}/innovation",
            messages.time_ns[rows],
            self.measured,
            self.truth,
            target_id=results.target[rows],
            accepted=results.accepted[rows],
            innovation=results.innovation[rows],
            covariance=results.innovation_covariance[rows],
            squared=results.squared[rows],
        )
        return Ragged(stream, np.searchsorted(rows, messages.offsets))


def _last_of_stamps(messages: Messages, rows: Integers) -> Integers:
    """Of these rows, in order, the last one of every stamp of a run."""
    time_ns = messages.time_ns[rows]
    is_last = np.ones(len(rows), bool)
    np.not_equal(time_ns[1:], time_ns[:-1], out=is_last[:-1])
    ends = np.searchsorted(rows, messages.offsets[1:])
    is_last[ends[ends > 0] - 1] = True
    return rows[is_last]
