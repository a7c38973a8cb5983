"""Makes estimators from plain functions: binding, outputs and failures are the same for all of them.

`recursive` makes an estimator of a function that follows one run through its messages, compiled or not;
`batch` of one that solves whole streams. Both find their topics, once for every robot or other prefix
that has them, name the outputs, and tell of a run that failed while the others go on.
"""

import copy
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import cache, partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.compiling.kinds import RunOnce
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Schema
from fuselog.recorders.parameters import Parameters, ParametersType
from fuselog.replay.engine.api.binding import (
    Find,
    bindings_by_name,
    estimator_of,
    priors_of,
    requirements_of,
    topics_of,
)
from fuselog.replay.engine.api.inputs import (
    AnyParameters,
    Binding,
    Given,
    Messages,
    OneRun,
    generator_of,
    messages_of,
)
from fuselog.replay.engine.api.outputs import Estimates, Outputs, Solved
from fuselog.replay.engine.arrays import AnyArgument
from fuselog.replay.engine.renamed import renamed
from fuselog.replay.engine.replaying.estimator import Batch, Bound, Carried, Estimator, Recursive
from fuselog.replay.engine.streams.blocks import Block, Ragged
from fuselog.replay.engine.streams.channels import resolved
from fuselog.replay.engine.streams.failures import Failure, reason_of
from fuselog.replay.engine.streams.measurements import Vectors
from fuselog.replay.engine.through_numba import numba_over_runs
from fuselog.replay.engine.vectors.components import Components

Generators = tuple[np.random.Generator | None, ...]
# (settings, state, block) -> the state after it, and the output streams.
Advance = Callable[[Carried, Carried, Block], tuple[Carried, list[Ragged]]]


@renamed(whole="static")
def recursive(
    summary: str,
    *,
    parameters: type[ParametersType] = Parameters,  # type: ignore[assignment]
    streams: Mapping[str, Schema] = MappingProxyType({}),
    static: Mapping[str, Schema] = MappingProxyType({}),
    find: Find | None = None,
    requirements: str = "",
    variant: str | None = None,
    components: Components = MappingProxyType({}),
    truth: str = "",
    measured: Components | None = None,
    vectors: Mapping[str, Vectors] | None = None,
    optional: Collection[str] = (),
    outputs: Mapping[str, Schema] = MappingProxyType({}),
    draws: bool = False,
    start: Callable[[Given[ParametersType]], tuple[Carried, Carried]],
    follow: RunOnce | None = None,
    follow_all: RunOnce | None = None,
    advance: Advance | None = None,
    out_of_sequence: Callable[[ParametersType, int], Advance] | None = None,
    finish: Callable[[Carried, Carried], list[Ragged]] | None = None,
    compiled: bool = True,
    allocates: bool = True,
) -> Estimator[ParametersType]:
    """Make an estimator that follows its messages in time.

    Args:
        summary: what it is, in one line.
        parameters: their type; without one there are none.
        streams: the topics to follow, with their schemas; see `bindings` for their names.
        static: the topics that `start` needs from beginning to end, such as a map or a prior. Gaussian
            estimates among them are priors: of the estimate's components, see `Given.prior`.
        find: in place of `streams` and `static`, where their names depend on the log or the parameters:
            find(name, topics, parameters) gives a `Binding` for everything that can be estimated there;
            none where the log does not fit. The name is the estimator's, for errors.
        requirements: with `find`, what a log has to have, in words.
        variant: the parameter that the rest of a name such as `shooter:bearings-only` sets.
        components: the estimate's components by name, with their kinds.
        truth: the topic with the truth of what is estimated.
        measured: the components of the innovations, where `follow` fills them.
        vectors: what is wanted of the vectors that topics of `streams` hold, by topic. What the log
            does not state of them is refused; without an entry here vectors come as the log has them.
        optional: which of `streams` and `static` a log may lack.
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
        advance: in place of both, where the outputs are other than one Gaussian estimate:
            advance(settings, state, block) -> the state after a block, and the output streams, whose
            topics are /estimates/ + `Given.name` and more. There are no `components` then; the state is
            of any type, and is not changed.
        out_of_sequence: with `advance`, for an estimator that goes back for late messages:
            out_of_sequence(parameters, back_ns) gives what takes the place of `advance` where messages
            come in the order of their arrival, and their stamps go back by up to so many nanoseconds.
            Raises BadInput where the parameters do not let it go back.
        finish: with `advance`: finish(settings, state) -> the output streams that waited for messages
            which did not come any more, such as those that are smoothed.
        compiled: whether `follow` is compiled; plain Python is a hundred times slower.
        allocates: whether `follow` may make arrays, and call all that numba knows: numba, an extra,
            compiles it. One that makes no arrays is compiled without numba, in a twentieth of the time,
            see `fuselog.recorders.compiling.compile.compile_over_runs`.

    Returns:
        The estimator, which `replay` takes.

    The shortest range so far, of everything that was seen:

    >>> from fuselog.recorders.log import RunMetadata, make_stream, schemas
    >>> class Shortest(NamedTuple):
    ...     range_m: np.ndarray
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
    ...     components={"range_m": "linear"},
    ...     start=start,
    ...     follow=follow,
    ...     compiled=False,
    ... )
    >>> from fuselog.recorders.recording import Recording
    >>> from fuselog.replay.engine.replaying.replaying import collect, replay
    >>> from fuselog.replay.engine.streams.sources import memory_source
    >>> seen = make_stream("/range", schemas.RANGE, [0, 10, 20], target_id=[1, 1, 2], range_m=[5, 3, 4])
    >>> source = memory_source(Recording([seen]), RunMetadata("example"))
    >>> bound = nearest.bind("nearest", source.topics, Parameters())
    >>> estimates = collect(replay([source], bound))
    >>> estimates["/estimates/nearest/state"]["mean"].ravel().tolist()
    [5.0, 3.0, 3.0]
    """
    if sum(each is not None for each in (follow, follow_all, advance)) != 1:
        raise BadInput(f"estimator '{summary}': give one of follow, follow_all and advance")
    if advance is None and (out_of_sequence or finish):
        raise BadInput(f"estimator '{summary}': out_of_sequence and finish need advance; give that too")
    for leaf, schema in outputs.items():
        _require_numbers(summary, leaf, schema)

    @cache
    def loop() -> OverRuns:
        assert follow is not None
        if not compiled:
            return OverRuns(follow)
        return numba_over_runs(follow) if allocates else compile_over_runs(follow)

    def advance_all(arguments: tuple[AnyArgument, ...], generators: Generators) -> None:
        if follow_all is not None:
            follow_all(*arguments, *([generators] if draws else []))
        else:
            loop()(len(generators), *arguments, per_run=generators if draws else None)

    def bind(name: str, bound: Binding, values: ParametersType) -> Bound:
        found = {**bound.streams, **bound.static}
        made = Outputs(
            name,
            f"/estimates/{name}",
            resolved(truth, bound.suffix),
            components,
            measured or {},
            outputs,
        )
        wanted = {found[topic].name: each for topic, each in (vectors or {}).items() if topic in found}
        numbers = np.array([number for number, each in enumerate(streams) if each in found])

        def started(maps: Mapping[str, Ragged], runs: int) -> _Carried:
            settings, state = start(Given(values, found, maps, runs, name, bound.setup))
            return _Carried(settings, state, np.zeros(runs, bool), (None,) * runs)

        def begin(given: dict[str, Ragged]) -> _Carried | None:
            maps = {each: given[topic.name] for each, topic in bound.static.items()}
            stated = {topic.name for topic in bound.static.values()}
            maps |= {
                each: rows for each, rows in given.items() if each not in stated
            }  # found at the start
            return started(maps, next(iter(maps.values())).runs) if maps else None

        def begun(carried: _Carried | None, block: Block) -> _Carried:
            # without static topics, the first block is what tells how many runs there are
            return carried or started({}, len(block.events.offsets) - 1)

        def by(step: Advance, carried: _Carried | None, block: Block) -> tuple[_Carried, list[Ragged]]:
            before = begun(carried, block)
            state, outcome = step(before.settings, before.state, block)
            return before._replace(state=state), outcome

        def run(carried: _Carried | None, block: Block) -> tuple[_Carried, list[Ragged]]:
            settings, before, reported, generators = begun(carried, block)
            state = type(before)(*(array.copy() for array in before))
            messages, skipped = messages_of(block, wanted, values)
            messages = messages._replace(topic=numbers[messages.topic])
            results = made.blank(len(messages.time_ns))
            generators = _drawn_on(generators, messages, values) if draws else generators
            advance_all((settings, messages, state, results), generators)
            is_lost = ~np.isfinite(np.reshape(state[0], (len(reported), -1)).sum(axis=1))
            failing: NDArray[np.bool_] = is_lost & ~reported & (np.diff(messages.offsets) > 0)
            reported = reported | failing
            outcome = made.of_block(messages, results, np.flatnonzero(failing))
            return _Carried(settings, state, reported, generators), [*outcome, *made.of_skipped(skipped)]

        def ended(carried: _Carried | None) -> list[Ragged]:
            assert finish is not None
            return finish(carried.settings, carried.state) if carried else []

        def going_back(back_ns: int) -> Recursive:
            assert out_of_sequence is not None
            return replace(in_order, run=partial(by, out_of_sequence(values, back_ns)))

        in_order = Recursive(
            name,
            *topics_of(bound),
            begin,
            partial(by, advance) if advance else run,
            priors_of(bound),
            finish=ended if finish else None,
            truth=made.truth,
        )
        return replace(in_order, out_of_sequence=going_back) if out_of_sequence else in_order

    where = find or partial(bindings_by_name, streams, static, optional, components)
    needs = requirements or requirements_of({**streams, **static}, optional)
    return estimator_of(summary, needs, parameters, variant, where, bind)


def _require_numbers(summary: str, leaf: str, schema: Schema) -> None:
    for field in schema.fields[1:]:
        if field.kind == "vector":
            raise BadInput(
                f"estimator '{summary}': field {field.name} of its output {leaf} is a vector; give a "
                "further output of a recursion fields of one number each"
            )


def _drawn_on(generators: Generators, messages: Messages, parameters: AnyParameters) -> Generators:
    """Copy the runs' generators for one block, since a block may have to be processed again.

    A run that has none yet gets one at its first message.
    """
    return tuple(
        copy.deepcopy(generator)
        if generator is not None or begin == end
        else generator_of(parameters, [messages.time_ns[begin : begin + 1], messages.value[begin]])
        for generator, begin, end in zip(
            generators, messages.offsets[:-1], messages.offsets[1:], strict=True
        )
    )


@renamed(whole="static")
def batch(
    summary: str,
    *,
    parameters: type[ParametersType] = Parameters,  # type: ignore[assignment]
    streams: Mapping[str, Schema] = MappingProxyType({}),
    static: Mapping[str, Schema] = MappingProxyType({}),
    find: Find | None = None,
    requirements: str = "",
    variant: str | None = None,
    components: Components = MappingProxyType({}),
    truth: str = "",
    measured: Components | None = None,
    optional: Collection[str] = (),
    outputs: Mapping[str, Schema] = MappingProxyType({}),
    solve: Callable[[Given[ParametersType]], Solved | list[Ragged]],
) -> Estimator[ParametersType]:
    """Make an estimator that solves whole streams.

    Args:
        summary: what it is, in one line.
        parameters: their type; without one there are none.
        streams: the topics of measurements, within the span that is replayed, with their schemas.
        static: the topics that are read whole, such as a map or a prior.
        find: as for `recursive`.
        requirements: as for `recursive`.
        variant: as for `recursive`.
        components: the estimate's components by name, with their kinds.
        truth: the topic with the truth of what is estimated.
        measured: the components of the innovations, where `solve` gives them.
        optional: which of `streams` and `static` a log may lack.
        outputs: further outputs by name, with their schemas; see `Estimates.further`.
        solve: solve(given) gets the streams and static topics of all runs, by the names asked for;
            `each_run` makes it of a function of one run. Where the outputs are other than Gaussian
            estimates there are no `components`, and it returns the output streams, whose topics are
            /estimates/ + `Given.name` and more.

    Returns:
        The estimator, which `replay` takes.

    The mean of all ranges:

    >>> from fuselog.recorders.log import RunMetadata, make_stream, schemas
    >>> def mean_range(streams, parameters):
    ...     ranges = streams["/range"]
    ...     mean, covariance = ranges["range_m"].mean().reshape(1, 1), np.full((1, 1, 1), 0.01)
    ...     return Estimates(ranges.publish_time_ns[-1:], mean, covariance)
    >>> average = batch(
    ...     "mean range",
    ...     streams={"/range": schemas.RANGE},
    ...     components={"range_m": "linear"},
    ...     solve=each_run(mean_range),
    ... )
    >>> from fuselog.recorders.recording import Recording
    >>> from fuselog.replay.engine.replaying.replaying import collect, replay
    >>> from fuselog.replay.engine.streams.sources import memory_source
    >>> seen = make_stream("/range", schemas.RANGE, [0, 10, 20], target_id=[1, 1, 2], range_m=[5, 3, 4])
    >>> source = memory_source(Recording([seen]), RunMetadata("example"))
    >>> estimates = collect(replay([source], average.bind("average", source.topics, Parameters())))
    >>> estimates["/estimates/average/state"]["mean"].tolist()
    [[4.0]]
    """

    def bind(name: str, bound: Binding, values: ParametersType) -> Bound:
        found = {**bound.streams, **bound.static}
        made = Outputs(
            name,
            f"/estimates/{name}",
            resolved(truth, bound.suffix),
            components,
            measured or {},
            outputs,
        )

        def solve_all(given: dict[str, Ragged]) -> list[Ragged]:
            streams_of = {each: given[topic.name] for each, topic in found.items()}
            runs = next(iter(streams_of.values())).runs
            solved = solve(Given(values, found, streams_of, runs, name, bound.setup))
            return made.of_solved(solved, runs) if isinstance(solved, Solved) else solved

        return Batch(name, *topics_of(bound), solve_all, priors_of(bound), truth=made.truth)

    where = find or partial(bindings_by_name, streams, static, optional, components)
    needs = requirements or requirements_of({**streams, **static}, optional)
    return estimator_of(summary, needs, parameters, variant, where, bind)


def each_run(
    solve: Callable[[OneRun, ParametersType], Estimates],
) -> Callable[[Given[ParametersType]], Solved]:
    """Make a function that solves run by run, for `batch`, of one that solves a run.

    Where `solve` raises, that run has failed; where all do, it is the input that is bad.

    Args:
        solve: (streams, parameters) -> the estimates of a run. The streams go by name, and know more
            of the run: `OneRun.prior`, `stated` and a `generator`.

    Returns:
        The function, for the argument `solve` of `batch`.
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


class _Carried(NamedTuple):
    """Holds what a recursion carries from block to block; `reported` (runs,): whose failure was.

    A run's generator is None until there is a message, or where none is wanted.
    """

    settings: Carried
    state: Carried
    reported: NDArray[np.bool_]
    generators: Generators
