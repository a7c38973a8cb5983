"""Estimators made from plain functions, with the same binding, outputs and failure handling for all.

`recursive` makes an estimator from a function that processes the messages of one run in order; `batch`
makes one from a function that solves whole streams. Both look up their topics under every prefix that
has them (one estimator per robot, for example), name the outputs, and report failed runs while the other
runs continue.
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
    """Make an estimator that processes its messages in time order.

    Args:
        summary: one-line description of the estimator.
        parameters: type of its parameters; without a type, the estimator has no parameters.
        streams: topics to process, with their schemas; see `bindings` for how their names are resolved.
        static: topics that `start` needs as a whole, such as a map or a prior. Static topics of Gaussian
            estimates are priors that have the estimate's components; see `Given.prior`.
        find: replaces `streams` and `static` if their names depend on the log or the parameters:
            find(name, topics, parameters) yields a `Binding` for each object that can be estimated in
            the log (for each robot, say), or nothing if the log does not fit. `name` is the name of the
            estimator, for error messages.
        requirements: with `find`, a description of what the log must contain.
        variant: the parameter that is set by the part after the colon in a name such as
            `shooter:bearings-only`.
        components: components of the estimate by name, with their kinds.
        truth: topic with the true values of the estimated quantities.
        measured: components of the innovations, if `follow` fills them.
        vectors: the vector components to read, by topic of `streams`. The log must state these
            components. Vectors of a topic that has no entry are read as they are in the log.
        optional: topics of `streams` and `static` that a log may lack.
        outputs: further outputs by name, with schemas whose fields are numbers; see `Results.further`.
        draws: whether the estimator draws random numbers. `follow` then gets the run's generator as its
            last argument, and `follow_all` the generators of all runs. Each run's generator depends only
            on the parameter `seed` and the run's first message, not on other runs, blocks or cores.
        start: start(given) -> the settings and the initial state: a NamedTuple of arrays whose first
            axis is the run. A run has failed if its row in the first of these arrays is not finite.
        follow: follow(run, settings, messages, state, results) processes the messages of one run in a
            block: it updates the rows of `state` that belong to the run and fills `results`, both in
            place.
        follow_all: replaces `follow`: follow_all(settings, messages, state, results) processes all runs
            in one call. It is not compiled: use NumPy code with an axis of runs, or a loop that is
            already compiled.
        advance: replaces `follow` and `follow_all` if the output is not one Gaussian estimate:
            advance(settings, state, block) -> the state after the block and the output streams, whose
            topics begin with /estimates/ + `Given.name`. In that case there are no `components`; the
            state can be of any type and must not be modified.
        out_of_sequence: with `advance`, for an estimator that reprocesses out-of-sequence messages:
            out_of_sequence(parameters, back_ns) returns the function that replaces `advance` if
            messages come in order of arrival and their stamps go back by at most `back_ns` nanoseconds.
            It raises BadInput if the parameters do not allow this.
        finish: with `advance`: finish(settings, state) -> the output streams that were still waiting
            for further messages when the log ended, such as smoothed estimates.
        compiled: whether `follow` is compiled; in plain Python it is about a hundred times slower.
        allocates: whether `follow` may create arrays and call everything that numba supports; it is then
            compiled by numba, an optional dependency. A function that creates no arrays is compiled
            without numba, in a twentieth of the time; see
            `fuselog.recorders.compiling.compile.compile_over_runs`.

    Returns:
        The estimator, for `replay`.

    The shortest range so far, over all targets:

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
        raise BadInput(f"estimator '{summary}': give exactly one of follow, follow_all and advance")
    if advance is None and (out_of_sequence or finish):
        raise BadInput(
            f"estimator '{summary}': out_of_sequence and finish need advance; give it as well"
        )
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
            # without static topics, the number of runs is known only from the first block
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
                f"estimator '{summary}': field {field.name} of its output {leaf} is a vector; each "
                "field of a further output of a recursion must be one number"
            )


def _drawn_on(generators: Generators, messages: Messages, parameters: AnyParameters) -> Generators:
    """Copy the generators of the runs for one block, because a block may have to be processed again.

    A run without a generator gets one at its first message.
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
        summary: one-line description of the estimator.
        parameters: type of its parameters; without a type, the estimator has no parameters.
        streams: topics of measurements within the replayed span, with their schemas.
        static: topics that are read as a whole, such as a map or a prior.
        find: as for `recursive`.
        requirements: as for `recursive`.
        variant: as for `recursive`.
        components: components of the estimate by name, with their kinds.
        truth: topic with the true values of the estimated quantities.
        measured: components of the innovations, if `solve` returns them.
        optional: topics of `streams` and `static` that a log may lack.
        outputs: further outputs by name, with their schemas; see `Estimates.further`.
        solve: solve(given) gets the streams and static topics of all runs under the requested names;
            `each_run` makes such a function from one that solves a single run. If the output is not a
            Gaussian estimate, there are no `components`, and `solve` returns the output streams, whose
            topics begin with /estimates/ + `Given.name`.

    Returns:
        The estimator, for `replay`.

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
    """Make a function for `batch` that solves all runs from a function that solves one run.

    If `solve` raises for a run, that run has failed; if it raises for all runs, the first exception is
    raised.

    Args:
        solve: solve(streams, parameters) -> the estimates of a run. `streams` is a `OneRun`: it maps
            topic names to streams, and offers `prior`, `stated` and the run's random `generator`.

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
    """State that a recursion carries between blocks; `reported` (runs,) marks reported failures.

    A generator is None before its run's first message, and always if the estimator draws no random
    numbers.
    """

    settings: Carried
    state: Carried
    reported: NDArray[np.bool_]
    generators: Generators
