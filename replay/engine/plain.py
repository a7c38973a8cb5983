"""Estimators from plain functions: what is alike in all of them, written once.

`recursive` makes an estimator of a function that follows one run through its messages, compiled or not;
`batch` of one that solves whole streams. Both find their topics, once for every robot or other prefix
that has them, name the outputs, and tell of a run that failed while the others go on.
"""

import copy
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from types import MappingProxyType
from typing import Any, Generic, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log import Schema, Stream, Topic, make_stream, schemas
from recorders.parameters import Parameters, ParametersType
from replay.engine.blocks import Block, Ragged, gather, ragged_rows
from replay.engine.channels import bindings, given_or_stated, resolved
from replay.engine.compile import compile_over_runs, uncompiled_over_runs
from replay.engine.components import Components
from replay.engine.estimator import Batch, Bound, Estimator, Recursive
from replay.engine.failures import Failure, reason_of, reason_stream
from replay.engine.measurements import Vectors, numbers_of
from replay.engine.philox import run_key
from replay.engine.priors import gaussians
from replay.engine.results import failures_by_run, innovation_stream, state_stream, states_in
from replay.engine.tangent import tangent_components

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Generators = tuple[np.random.Generator | None, ...]

DIVERGED = "the estimate is no longer finite: the filter diverged"


@dataclass(frozen=True, eq=False)
class Given(Mapping[str, Ragged], Generic[ParametersType]):
    """What is given of all runs; topics go by the names under which an estimator asked for them.

    It maps those that are given whole to their streams: of a recursion what it starts from, of a batch
    all. A topic that is optional and that the log lacks is not in it.
    """

    parameters: ParametersType
    topics: Mapping[str, Topic]
    whole: Mapping[str, Ragged]
    runs: int

    def stated(self, topic: str, name: str) -> float:
        """The parameter `name`, or where it is None the number that the topic's channel states.

        Raises BadInput where neither does.
        """
        return given_or_stated(self.parameters, [self.topics[topic]], name)

    def prior(self, topic: str) -> tuple[Integers, Floats, Floats]:
        """The prior of every run: stamps (runs,), means (runs, d), covariances (runs, t, t).

        They are of the estimate's components, in their order, whatever the log's order is. NaN where a
        run has none that can be used: it has failed, and gets no messages.
        """
        return gaussians(self.whole[topic])

    def __getitem__(self, topic: str) -> Ragged:
        """A whole topic, all runs end to end."""
        return self.whole[topic]

    def __iter__(self) -> Iterator[str]:
        """The names of what is given."""
        return iter(self.whole)

    def __len__(self) -> int:
        """How many topics are given."""
        return len(self.whole)


@dataclass(frozen=True, eq=False)
class OneRun(Mapping[str, Stream]):
    """What is given of one run, stream by stream; see `Given` and `each_run`."""

    given: Given[Any]
    run: int

    def stated(self, topic: str, name: str) -> float:
        """See `Given.stated`."""
        return self.given.stated(topic, name)

    def prior(self, topic: str) -> tuple[int, Floats, Floats]:
        """The run's prior, see `Given.prior`: stamp, mean (d,), covariance (t, t)."""
        stream = self[topic]
        time_ns, mean, covariance = gaussians(Ragged(stream, np.array([0, len(stream)])))
        return int(time_ns[0]), mean[0], covariance[0]

    @cached_property
    def generator(self) -> np.random.Generator:
        """The run's own generator: from the parameter `seed` and the first messages of its streams.

        So it is the same on any number of cores, and whatever other runs there are.
        """
        first = [column[:1] for stream in self.values() for column in stream.columns.values()]
        return _generator(self.given.parameters, first)

    def __getitem__(self, topic: str) -> Stream:
        """A topic's messages of this run."""
        return self.given[topic].of_run(self.run)

    def __iter__(self) -> Iterator[str]:
        """The names of what is given."""
        return iter(self.given)

    def __len__(self) -> int:
        """How many topics are given."""
        return len(self.given)


def _generator(parameters: Any, first: Iterable[NDArray]) -> np.random.Generator:
    """A counter-based generator (Philox), keyed by a seed and a run's first data."""
    key = run_key(getattr(parameters, "seed", 0), first)
    return np.random.Generator(np.random.Philox(key=key))


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
            space (see `replay.engine.tangent`), d where all are linear or angles.
        innovation, innovation_covariance: (n, m), (n, m, m) of the message.
        squared: (n,) the normalised innovation squared.
        accepted: (n,) whether a gate let the message in; 1 unless set.
        target: (n,) what the message was about; 0 unless set.
        further: (n, k) the fields of the further outputs that were named, after the sensor's clock, side
            by side in order; a message is told of an output where its first field is a number.
    """

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats
    accepted: Integers
    target: Integers
    further: Floats


class Solution(NamedTuple):
    """How the solutions ended, (n,) each; the cost is what was minimised."""

    iterations: Integers
    converged: Integers
    rank: Integers
    cost: Floats


class Told(NamedTuple):
    """What a batch says beside its estimates: stamps (n,), and columns by the fields of a schema."""

    time_ns: Integers
    columns: Mapping[str, NDArray]


class Measured(NamedTuple):
    """Innovations of a batch's measurements: stamps (n,), (n, m) with covariances (n, m, m).

    `target` (n,) is what each was about; 0 unless given.
    """

    time_ns: Integers
    innovation: Floats
    covariance: Floats
    target: Integers | None = None


class Estimates(NamedTuple):
    """What one run's streams were solved to.

    Attributes:
        time_ns, mean, covariance: stamps (n,), means (n, d), covariances (n, t, t).
        solution: how it ended.
        innovations: of the measurements, where the batch names what is `measured`.
        further: by name, what the batch's further `outputs` say.
    """

    time_ns: Integers
    mean: Floats
    covariance: Floats
    solution: Solution | None = None
    innovations: Measured | None = None
    further: Mapping[str, Told] = MappingProxyType({})


class Solved(NamedTuple):
    """The estimates by run, and the failures; a run that failed has no estimates."""

    estimates: Mapping[int, Estimates]
    failures: Mapping[int, Failure]


def recursive(
    summary: str,
    *,
    parameters: type[ParametersType] = Parameters,  # type: ignore[assignment]
    streams: Mapping[str, Schema],
    whole: Mapping[str, Schema],
    components: Components,
    truth: str = "",
    measured: Components | None = None,
    vectors: Mapping[str, Vectors] | None = None,
    optional: Collection[str] = (),
    outputs: Mapping[str, Schema] = MappingProxyType({}),
    draws: bool = False,
    start: Callable[[Given[ParametersType]], tuple[Any, Any]],
    follow: Callable[..., None] | None = None,
    follow_all: Callable[..., None] | None = None,
    compiled: bool = True,
) -> Estimator[ParametersType]:
    """An estimator that follows its messages in time.

    Args:
        summary: what it is, in one line.
        parameters: their type; without one there are none.
        streams: the topics to follow, with their schemas; see `bindings` for their names.
        whole: the topics that `start` needs whole, such as a map or a prior. Gaussian estimates among
            them are priors: of the estimate's components, see `Given.prior`.
        components: the estimate's components by name, with their kinds.
        truth: the topic with the truth of what is estimated.
        measured: the components of the innovations, where `follow` tells of them.
        vectors: what is wanted of the vectors that topics of `streams` hold, by topic. What the log
            does not say of them is refused; without an entry here vectors come as the log has them.
        optional: which of `streams` and `whole` a log may lack.
        outputs: further outputs by name, with schemas whose fields are numbers; see `Results.further`.
        draws: whether random numbers are drawn: `follow` then gets the run's own generator as its last
            argument, `follow_all` those of all runs. It depends on the parameter `seed` and the run's
            first message, not on other runs, blocks or cores.
        start: what is given -> settings, and the state: a NamedTuple of arrays with a first axis of
            runs. A run has failed where its row in the first of them is not finite.
        follow: follow(run, settings, messages, state, results) takes one run through a block of its
            messages: it changes that run's rows of `state`, and fills `results`, in place.
        follow_all: in place of `follow`: follow_all(settings, messages, state, results) takes all runs
            at once, and is called as it is. For NumPy with an axis of runs, or a loop compiled already.
        compiled: whether numba compiles `follow`; plain Python is a hundred times slower.

    The shortest range so far, of everything that was seen:

    >>> class Shortest(NamedTuple):
    ...     range_m: Floats
    >>> def start(given):
    ...     return (), Shortest(np.full((given.runs, 1), 1e9))
    >>> def follow(run, settings, messages, state, results):
    ...     for row in range(messages.offsets[run], messages.offsets[run + 1]):
    ...         state.range_m[run, 0] = min(state.range_m[run, 0], messages.value[row, 1])
    ...         results.mean[row, 0] = state.range_m[run, 0]
    ...         results.covariance[row, 0, 0] = 0.01
    >>> nearest = recursive(
    ...     "shortest range so far",
    ...     streams={"/range": schemas.RANGE},
    ...     whole={},
    ...     components={"range_m": "linear"},
    ...     start=start,
    ...     follow=follow,
    ...     compiled=False,
    ... )
    >>> from recorders.log import RunMetadata
    >>> from recorders.recording import Recording
    >>> from replay.engine.replaying import collect, replay
    >>> from replay.engine.sources import memory_source
    >>> seen = make_stream("/range", schemas.RANGE, [0, 10, 20], target_id=[1, 1, 2], range_m=[5, 3, 4])
    >>> source = memory_source(Recording([seen]), RunMetadata("example"))
    >>> bound = nearest.bind("nearest", source.topics, Parameters())
    >>> estimates = collect(replay([source], bound))
    >>> estimates["/estimates/nearest/state"]["mean"].ravel().tolist()
    [5.0, 3.0, 3.0]
    """
    if (follow is None) == (follow_all is None):
        raise BadInput(
            f"estimator '{summary}': neither follow nor follow_all is given; give one of them"
        )
    for leaf, schema in outputs.items():
        _require_numbers(summary, leaf, schema)

    @cache
    def loop() -> Callable[..., None]:
        assert follow is not None
        return compile_over_runs(follow) if compiled else uncompiled_over_runs(follow)

    def advance_all(arguments: tuple[Any, ...], generators: Generators) -> None:
        if follow_all is not None:
            follow_all(*arguments, *([generators] if draws else []))
        else:
            loop()(len(generators), *arguments, own=generators if draws else None)

    def bind(name: str, prefix: str, found: Mapping[str, Topic], values: ParametersType) -> Bound:
        made = _Outputs(
            name, f"/estimates/{name}", resolved(truth, prefix), components, measured or {}, outputs
        )
        wanted = {found[topic].name: each for topic, each in (vectors or {}).items() if topic in found}
        numbers = np.array([number for number, each in enumerate(streams) if each in found])

        def started(maps: Mapping[str, Ragged], runs: int) -> _Carried:
            settings, state = start(Given(values, found, maps, runs))
            return _Carried(settings, state, np.zeros(runs, bool), (None,) * runs)

        def begin(given: dict[str, Ragged]) -> _Carried | None:
            maps = {each: given[found[each].name] for each in whole if each in found}
            return started(maps, next(iter(maps.values())).runs) if maps else None

        def advance(carried: _Carried | None, block: Block) -> tuple[_Carried, list[Ragged]]:
            # without anything whole, the first block is what tells how many runs there are
            settings, before, told, generators = carried or started({}, len(block.events.offsets) - 1)
            state = type(before)(*(array.copy() for array in before))
            messages, skipped = _messages(block, wanted, values)
            messages = messages._replace(topic=numbers[messages.topic])
            results = made.blank(len(messages.time_ns))
            generators = _drawn_on(generators, messages, values) if draws else generators
            advance_all((settings, messages, state, results), generators)
            is_lost = ~np.isfinite(np.reshape(state[0], (len(told), -1)).sum(axis=1))
            failing: NDArray[np.bool_] = is_lost & ~told & (np.diff(messages.offsets) > 0)
            told = told | failing
            outcome = made.of_block(messages, results, np.flatnonzero(failing))
            return _Carried(settings, state, told, generators), [*outcome, *made.of_skipped(skipped)]

        read, needed = _topics(found, streams), _topics(found, whole)
        return Recursive(name, read, needed, begin, advance, _priors(found, whole, components))

    return _estimator(summary, parameters, {**streams, **whole}, optional, bind)


def _require_numbers(summary: str, leaf: str, schema: Schema) -> None:
    for field in schema.fields[1:]:
        if field.kind == "vector":
            raise BadInput(
                f"estimator '{summary}': field {field.name} of its output {leaf} is a vector; give a "
                "further output of a recursion fields of one number each"
            )


def _drawn_on(generators: Generators, messages: Messages, parameters: Any) -> Generators:
    """The runs' generators for one block: copies, since a block may have to be gone through again.

    A run that has none yet gets one at its first message.
    """
    return tuple(
        copy.deepcopy(generator)
        if generator is not None or begin == end
        else _generator(parameters, [messages.time_ns[begin : begin + 1], messages.value[begin]])
        for generator, begin, end in zip(
            generators, messages.offsets[:-1], messages.offsets[1:], strict=True
        )
    )


def batch(
    summary: str,
    *,
    parameters: type[ParametersType] = Parameters,  # type: ignore[assignment]
    streams: Mapping[str, Schema],
    whole: Mapping[str, Schema],
    components: Components,
    truth: str = "",
    measured: Components | None = None,
    optional: Collection[str] = (),
    outputs: Mapping[str, Schema] = MappingProxyType({}),
    solve: Callable[[Given[ParametersType]], Solved],
) -> Estimator[ParametersType]:
    """An estimator that solves whole streams.

    Args as for `recursive`, and:
        outputs: further outputs by name, with their schemas; see `Estimates.further`.
        solve: solve(given) gets the streams and whole topics of all runs, by the names asked for;
            `each_run` makes it of a function of one run.

    The mean of all ranges:

    >>> def mean_range(streams, parameters):
    ...     ranges = streams["/range"]
    ...     mean, covariance = ranges["range_m"].mean().reshape(1, 1), np.full((1, 1, 1), 0.01)
    ...     return Estimates(ranges.publish_time_ns[-1:], mean, covariance)
    >>> average = batch(
    ...     "mean range",
    ...     streams={"/range": schemas.RANGE},
    ...     whole={},
    ...     components={"range_m": "linear"},
    ...     solve=each_run(mean_range),
    ... )
    >>> from recorders.log import RunMetadata
    >>> from recorders.recording import Recording
    >>> from replay.engine.replaying import collect, replay
    >>> from replay.engine.sources import memory_source
    >>> seen = make_stream("/range", schemas.RANGE, [0, 10, 20], target_id=[1, 1, 2], range_m=[5, 3, 4])
    >>> source = memory_source(Recording([seen]), RunMetadata("example"))
    >>> estimates = collect(replay([source], average.bind("average", source.topics, Parameters())))
    >>> estimates["/estimates/average/state"]["mean"].tolist()
    [[4.0]]
    """

    def bind(name: str, prefix: str, found: Mapping[str, Topic], values: ParametersType) -> Bound:
        made = _Outputs(
            name, f"/estimates/{name}", resolved(truth, prefix), components, measured or {}, outputs
        )

        def solve_all(given: dict[str, Ragged]) -> list[Ragged]:
            streams_of = {each: given[topic.name] for each, topic in found.items()}
            runs = next(iter(streams_of.values())).runs
            return made.of_solved(solve(Given(values, found, streams_of, runs)), runs)

        read, needed = _topics(found, streams), _topics(found, whole)
        return Batch(name, read, needed, solve_all, _priors(found, whole, components))

    return _estimator(summary, parameters, {**streams, **whole}, optional, bind)


def each_run(
    solve: Callable[[OneRun, ParametersType], Estimates],
) -> Callable[[Given[ParametersType]], Solved]:
    """Solve run by run, for `batch`: solve(streams, parameters) gets a run's streams by name.

    They know more of the run: `OneRun.prior`, `stated` and a `generator`. Where `solve` raises, that
    run has failed; where all do, it is the input that is bad.
    """

    def solve_all(given: Given[ParametersType]) -> Solved:
        solved: dict[int, Estimates] = {}
        failures: dict[int, Failure] = {}
        errors: list[Exception] = []
        for run in range(given.runs):
            streams = OneRun(given, run)
            try:
                solved[run] = solve(streams, given.parameters)
            except (MemoryError, OSError):
                raise
            except Exception as error:
                end_ns = max(stream.publish_time_ns.max(initial=0) for stream in streams.values())
                failures[run] = Failure(int(end_ns), reason_of(error))
                errors.append(error)
        if not solved:
            raise errors[0]
        return Solved(solved, failures)

    return solve_all


def _priors(
    found: Mapping[str, Topic], whole: Mapping[str, Schema], components: Components
) -> dict[str, Components]:
    return {
        found[name].name: components
        for name, schema in whole.items()
        if schema is schemas.GAUSSIAN_ESTIMATE and name in found
    }


def _topics(found: Mapping[str, Topic], names: Mapping[str, Schema]) -> tuple[str, ...]:
    return tuple(found[name].name for name in names if name in found)


def _estimator(
    summary: str,
    parameters: type[ParametersType],
    asked: Mapping[str, Schema],
    optional: Collection[str],
    bind_one: Callable[[str, str, Mapping[str, Topic], ParametersType], Bound],
) -> Estimator[ParametersType]:
    def bind(label: str, topics: Mapping[str, Topic], values: ParametersType) -> list[Bound]:
        return [
            bind_one(f"{label}{prefix}", prefix, found, values)
            for prefix, found in bindings(topics, asked, optional)
        ]

    needs = [
        f"{resolved(name, '...')} ({schema.full_name}{', optional' if name in optional else ''})"
        for name, schema in asked.items()
    ]
    return Estimator(summary, ", ".join(needs), parameters, bind)


class _Carried(NamedTuple):
    """What a recursion carries from block to block; `told` (runs,) says whose failure was told.

    A run's generator is None until there is a message, or where none is wanted.
    """

    settings: Any
    state: Any
    told: NDArray[np.bool_]
    generators: Generators


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

    name: str
    topic: str
    truth: str
    components: Components
    measured: Components
    further: Mapping[str, Schema]

    @property
    def tangent(self) -> int:
        """How many components the tangent space has."""
        return len(tangent_components(list(self.components), list(self.components.values())))

    def blank(self, rows: int) -> Results:
        """Results that say nothing."""
        d, t, m = len(self.components), self.tangent, len(self.measured)
        width = sum(len(schema.fields) - 1 for schema in self.further.values())
        return Results(
            np.full((rows, d), np.nan),
            np.full((rows, t, t), np.nan),
            np.full((rows, m), np.nan),
            np.full((rows, m, m), np.nan),
            np.full(rows, np.nan),
            np.ones(rows, np.int64),
            np.zeros(rows, np.int64),
            np.full((rows, width), np.nan),
        )

    def of_block(self, messages: Messages, results: Results, failing: Integers) -> list[Ragged]:
        """The outputs of one block; of several estimates at a stamp the last stands."""
        # what is said of a covariance that is none is for the replay to find
        said = np.isfinite(np.einsum("nd->n", results.mean))
        rows = _last_of_stamps(messages, np.flatnonzero(said))
        columns = messages.time_ns, messages.offsets, self.components, self.truth
        state = states_in(rows, f"{self.topic}/state", *columns, results.mean, results.covariance)
        failures = {}
        for run in failing.tolist():
            begin, end = messages.offsets[run : run + 2]
            last = np.flatnonzero(said[begin:end]).max(initial=-1)
            end_ns = messages.time_ns[min(begin + last + 1, end - 1)]
            failures[run] = Failure(int(end_ns), DIVERGED)
        made = [
            state,
            failures_by_run(self.topic, failures, len(messages.offsets) - 1),
        ]
        if self.measured:
            made.append(self._innovations_of_block(messages, results))
        return [*made, *self._further_of_block(messages, results.further)]

    def of_solved(self, solved: Solved, runs: int) -> list[Ragged]:
        """The outputs of a batch."""
        made = [failures_by_run(self.topic, solved.failures, runs)]
        parts: dict[str, dict[int, Stream]] = {}
        for run, estimates in solved.estimates.items():
            for stream in self._of_run(estimates):
                parts.setdefault(stream.topic, {})[run] = stream
        for found in parts.values():
            nothing = next(iter(found.values())).take(slice(0, 0))
            made.append(gather([found.get(run, nothing) for run in range(runs)]))
        return made

    def _of_run(self, estimates: Estimates) -> Iterator[Stream]:
        """What is said of one run, in streams; raises BadInput where a shape is wrong."""
        time_ns, mean, covariance = self._checked(
            "", estimates[:3], ((), (len(self.components),), (self.tangent,) * 2)
        )
        topic, components = f"{self.topic}/state", self.components
        yield state_stream(topic, time_ns, components, self.truth, mean, covariance)
        if estimates.solution is not None:
            yield make_stream(
                f"{self.topic}/solution",
                schemas.SOLUTION,
                time_ns,
                metadata={"truth": self.truth},
                **estimates.solution._asdict(),
            )
        if self.measured:
            yield self._innovations_of_run(estimates.innovations)
        for name, schema in self.further.items():
            if name in estimates.further:
                told = estimates.further[name]
                columns: dict[str, Any] = dict(told.columns)
                yield make_stream(f"{self.topic}/{name}", schema, told.time_ns, **columns)

    def _innovations_of_run(self, told: Measured | None) -> Stream:
        m = len(self.measured)
        told = told or Measured(np.empty(0, np.int64), np.empty((0, m)), np.empty((0, m, m)))
        time_ns, innovation, covariance = self._checked("innovations.", told[:3], ((), (m,), (m, m)))
        count = len(time_ns)
        weighted = np.linalg.solve(covariance, innovation[..., None])[..., 0]
        return innovation_stream(
            f"{self.topic}/innovation",
            time_ns,
            self.measured,
            self.truth,
            target_id=np.zeros(count, np.int64) if told.target is None else told.target,
            accepted=np.ones(count, np.int64),
            innovation=innovation,
            covariance=covariance,
            squared=np.einsum("ni,ni->n", innovation, weighted),
        )

    def _checked(
        self, part: str, arrays: Sequence[Any], shapes: Sequence[tuple[int, ...]]
    ) -> tuple[Integers, Floats, Floats]:
        """Stamps, means and covariances as arrays; raises BadInput where a shape is wrong."""
        time_ns, mean, covariance = (np.asarray(array) for array in arrays)
        names = ("time_ns", "innovation" if part else "mean", "covariance")
        for name, array, shape in zip(names, (time_ns, mean, covariance), shapes, strict=True):
            wanted = (*time_ns.shape[:1], *shape)
            if array.shape != wanted:
                raise BadInput(
                    f"estimator {self.name}: {part}{name} has the shape {array.shape}; "
                    f"{wanted} is needed"
                )
        return time_ns, mean.astype(float, copy=False), covariance.astype(float, copy=False)

    def of_skipped(self, skipped: _Skipped) -> list[Ragged]:
        """What was not used, for estimators of what may lack a covariance."""
        if not any(skipped.reasons):
            return []
        topic = f"{self.topic}/skipped"
        stream = reason_stream(topic, schemas.SKIPPED, skipped.time_ns, skipped.reason, skipped.reasons)
        return [Ragged(stream, skipped.offsets)]

    def _innovations_of_block(self, messages: Messages, results: Results) -> Ragged:
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

    def _further_of_block(self, messages: Messages, told: Floats) -> Iterator[Ragged]:
        first = 0
        for name, schema in self.further.items():
            names = [field.name for field in schema.fields[1:]]
            own, first = told[:, first : first + len(names)], first + len(names)
            rows = np.flatnonzero(np.isfinite(own[:, 0]))
            columns = dict(zip(names, own[rows].T, strict=True))
            stream = make_stream(f"{self.topic}/{name}", schema, messages.time_ns[rows], **columns)
            yield Ragged(stream, np.searchsorted(rows, messages.offsets))


def _last_of_stamps(messages: Messages, rows: Integers) -> Integers:
    """Of these rows, in order, the last one of every stamp of a run."""
    time_ns = messages.time_ns[rows]
    is_last = np.ones(len(rows), bool)
    np.not_equal(time_ns[1:], time_ns[:-1], out=is_last[:-1])
    ends = np.searchsorted(rows, messages.offsets[1:])
    is_last[ends[ends > 0] - 1] = True
    return rows[is_last]
