"""Estimators made from foreign filters; they bind to the topics of a log like any estimator.

A filter in this process gets its messages block by block. A filter in a separate process gets all
messages of a run at the end of the replay; if it crashes, only this run is affected.
"""

import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Schema, Stream, Topic, schemas
from fuselog.recorders.log.streams import check_stream
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.replaying.estimator import Bound, Estimator, Recursive
from fuselog.replay.engine.streams.blocks import Block, Ragged, by_runs
from fuselog.replay.engine.streams.channels import given_or_stated, resolved
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.engine.streams.measurements import check_width
from fuselog.replay.engine.streams.priors import gaussians
from fuselog.replay.engine.streams.results import failures_by_run, named, state_stream
from fuselog.replay.foreign.description import (
    Description,
    ForeignParameters,
    TopicRead,
    read_description,
)
from fuselog.replay.foreign.naming import what_runs
from fuselog.replay.foreign.native.following import (
    Filters,
    Followed,
    Static,
    copies_of,
    filters_of,
    follow_all,
    followed,
    offsets_of,
    reason_of_code,
)
from fuselog.replay.foreign.native.library import Library
from fuselog.replay.foreign.native.out_of_sequence import gone_back
from fuselog.replay.foreign.processes.isolation import (
    Limits,
    Ran,
    describe_apart,
    follow_here,
    follow_runs_apart,
)
from fuselog.replay.foreign.processes.tasks import IN_ORDER, RunGiven, sizes_of
from fuselog.replay.foreign.results import begun, results
from fuselog.replay.inference.run.recursion import (
    EstimateRows,
    FilterEvents,
    InnovationRows,
    recorded_innovations,
)
from fuselog.replay.inference.run.timing import add_output_times, at_stamps_of

Prior = tuple[Integers, Floats, Floats]
# Processes runs with their filters in other processes; None marks a run that does not take part.
FollowRuns = Callable[[Sequence[RunGiven | None], Limits], list[Ran | None]]


class LibraryParameters(ForeignParameters):
    """Settings of a filter in a shared library.

    Attributes:
        path: the library, which has the functions of `fuselog_filter.h`.
        in_process: whether the library is called in this process; this is faster, but a crash of the
            filter ends the replay.
    """

    path: str = ""
    in_process: bool = False


@dataclass(frozen=True)
class FoundFilter:
    """Filter bound to the topics of a log.

    Attributes:
        name: name of its output topics, after `/estimates/`.
        description: description of the filter.
        prefix: prefix of its topics.
        topics: topics of the log, by the names in the description.
        prior: topic of the prior; "" if the filter starts without a prior.
        parameters: all of its parameters.
    """

    name: str
    description: Description
    prefix: str
    topics: Mapping[str, Topic]
    prior: str
    parameters: Any

    @property
    def numbers(self) -> tuple[float, ...]:
        """Return the parameters of the filter; raise BadInput if one is neither set nor in the log."""
        asked = list(self.topics.values())
        return tuple(
            given_or_stated(self.parameters, asked, name) for name in self.description.parameters
        )

    @property
    def truth(self) -> str:
        """Return the topic of the truth."""
        return resolved(self.description.truth, self.prefix)

    def bound(self, start: Any, run: Any, finish: Any) -> Recursive:
        """Make the bound estimator from its functions `start`, `run` and `finish`."""
        read = [each for each in self.description.topics if each.topic in self.topics]
        static = [self.topics[each.topic].name for each in read if each.static]
        return Recursive(
            self.name,
            tuple(self.topics[each.topic].name for each in read if not each.static),
            tuple(filter(None, [self.prior, *static])),
            start,
            run,
            {self.prior: self.description.state} if self.prior else {},
            finish=finish,
            parameters=self.parameters,
            truth=self.truth,
        )

    def started(self, given: Mapping[str, Ragged], runs: int) -> tuple[Static, Prior | None]:
        """Return the static messages and the priors of all runs from `given`."""
        prior = gaussians(given[self.prior]) if self.prior else None
        return static_of(self.description, self.topics, given, runs), prior

    def events(
        self, block: Block, start_ns: Integers, next_output: Integers
    ) -> tuple[FilterEvents, Integers]:
        """Convert a block to events, including additional estimates at multiples of `every_s`.

        Returns the events, and for each run (runs,) the multiple of `every_s` at which the next
        additional estimate is due.
        """
        events = events_of(self.description, self.topics, block)
        every_s = self.parameters.every_s
        if every_s is None or not len(events.time_ns):
            return events, next_output
        return add_output_times(events, start_ns, next_output, round(every_s * 1e9))


def bind_all(
    label: str, description: Description, topics: Mapping[str, Topic], parameters: Any
) -> list[FoundFilter]:
    """Bind a filter under every prefix of a log that has its topics."""
    found = []
    for prefix, read in description.bindings(topics):
        name = label + prefix
        prior = _named(name, "prior", description.prior, prefix, schemas.GAUSSIAN_ESTIMATE, topics)
        _named(name, "truth", description.truth, prefix, schemas.TRUTH_STATE, topics)
        found.append(FoundFilter(name, description, prefix, read, prior, parameters))
    return found


def _named(
    label: str, what: str, name: str, prefix: str, schema: Schema, topics: Mapping[str, Topic]
) -> str:
    """Return the topic of the prior or truth that a description names; "" if the log has none.

    Raises BadInput if the log has another prior or truth under the prefix of the filter's topics,
    because the name in the description is then probably wrong.
    """
    topic = resolved(name, prefix)
    if not name or topic in topics:
        return topic if name else ""
    others = [
        each
        for each, of in topics.items()
        if of.schema_name == schema.full_name
        and each.startswith(f"{prefix}/")
        and not each.startswith("/estimates/")
    ]
    if others:
        raise BadInput(
            f"estimator {label}: its description names the {what} {topic}, which is not in the "
            f"log; it has {', '.join(others)}"
        )
    return ""


# --- in this process --------------------------------------------------------------------------------


class _Running(NamedTuple):
    """State of filters in this process between blocks; `owner` destroys the filters."""

    filters: Filters
    static: Static
    start_ns: Integers
    next_output: Integers
    owner: "_Owner"


class _Owner:
    """Owner that destroys filters when it is garbage-collected."""

    def __init__(self, library: Library, handles: Integers) -> None:
        weakref.finalize(self, library.destroy_all, handles.tolist())


def bind_in_process(found: FoundFilter, library: Library) -> Recursive:
    """Bind a filter whose library is called in this process."""
    description, numbers = found.description, found.numbers

    def started(given: Mapping[str, Ragged], runs: int) -> _Running:
        static, prior = found.started(given, runs)
        seed = found.parameters.seed
        filters = filters_of(library, numbers, seed, prior, runs, description)
        start_ns, owner = filters.time_ns.copy(), _Owner(library, filters.handle)
        return _Running(filters, static, start_ns, np.zeros(runs, np.int64), owner)

    def start(given: dict[str, Ragged]) -> _Running | None:
        return started(given, next(iter(given.values())).runs) if given else None

    def run(state: _Running | None, block: Block) -> tuple[_Running, list[Ragged]]:
        before = state or started({}, len(block.events.offsets) - 1)
        filters = copies_of(library, before.filters)  # a block may have to be processed again
        own_start = np.where(filters.has_prior == 1, before.start_ns, _first_ns(block))
        start_ns = np.where(filters.begun == 1, before.start_ns, own_start)
        events, next_output = found.events(block, start_ns, before.next_output)
        due, recorded = offsets_of(description, events)
        made = begun(results(due, recorded, sizes_of(description)), due, recorded)
        was = filters.failure.copy()
        follow_all(library, description, before.static, events, filters, made)
        failed = np.flatnonzero((filters.failure >= 0) & (was != filters.failure)).tolist()
        failures = {
            each: Failure(
                int(filters.time_ns[each]), reason_of_code(int(filters.failure[each]), description)
            )
            for each in failed
        }
        results_of_runs = followed(made, due, recorded)
        after = _Running(filters, before.static, start_ns, next_output, _Owner(library, filters.handle))
        return after, streams_of(found.name, description, found.truth, results_of_runs, failures)

    return found.bound(start, run, None)


def _first_ns(block: Block) -> Integers:
    """Return the stamp of every run's first message (runs,); 0 for a run without messages."""
    offsets, times_ns = block.events.offsets, np.append(block.events.time_ns, 0)
    return np.where(np.diff(offsets) > 0, times_ns[offsets[:-1]], 0)


# --- in separate processes -------------------------------------------------------------------------


class _Waiting(NamedTuple):
    """Messages that have arrived so far."""

    static: Static
    prior: Prior | None
    events: tuple[FilterEvents, ...]
    start_ns: Integers
    next_output: Integers


def bind_apart(found: FoundFilter, follow_runs: FollowRuns, window_ns: int = IN_ORDER) -> Recursive:
    """Bind a filter that gets all messages of a run in one call.

    Args:
        found: the filter.
        follow_runs: function that processes runs with their filters.
        window_ns: largest delay of out-of-sequence messages if messages are passed in order of arrival;
            IN_ORDER if they are passed in order of their stamps.
    """
    description, numbers = found.description, found.numbers

    def started(given: Mapping[str, Ragged], runs: int) -> _Waiting:
        static, prior = found.started(given, runs)
        start_ns = np.full(runs, -1) if prior is None else prior[0]
        return _Waiting(static, prior, (), start_ns, np.zeros(runs, np.int64))

    def start(given: dict[str, Ragged]) -> _Waiting | None:
        return started(given, next(iter(given.values())).runs) if given else None

    def run(state: _Waiting | None, block: Block) -> tuple[_Waiting, list[Ragged]]:
        before = state or started({}, len(block.events.offsets) - 1)
        start_ns = np.where(before.start_ns < 0, _first_ns(block), before.start_ns)
        events, next_output = found.events(block, start_ns, before.next_output)
        start_ns = np.where(np.diff(block.events.offsets) > 0, start_ns, before.start_ns)
        events_of_all = (*before.events, events)
        return before._replace(events=events_of_all, start_ns=start_ns, next_output=next_output), []

    def given_of(state: _Waiting, run: int) -> RunGiven | None:
        prior = None
        if state.prior is not None:
            time_ns, mean, covariance = (column[run] for column in state.prior)
            if not np.isfinite(mean.sum()):
                return None  # a run without a usable prior does not take part
            prior = int(time_ns), mean, covariance
        static = static_of_run(state.static, run)
        events = of_run(state.events, run)
        given = RunGiven(static, events, prior, numbers, found.parameters.seed, window_ns)
        if window_ns != IN_ORDER and prior is not None:  # older messages are not used
            given = given.from_time(prior[0])
        return given if len(given.events.time_ns) else None

    def finish(state: _Waiting | None) -> list[Ragged]:
        if state is None or not state.events:
            return []
        runs = len(state.events[0].offsets) - 1
        given = [given_of(state, each) for each in range(runs)]
        ran = follow_runs(given, Limits.of(found.parameters))
        due = recorded = np.zeros(2, np.int64)
        nothing = followed(results(due, recorded, sizes_of(description)), due, recorded)
        results_of_runs = joined([nothing if each is None else each.followed for each in ran])
        failures = {
            number: each.failure
            for number, each in enumerate(ran)
            if each is not None and each.failure is not None
        }
        made = streams_of(found.name, description, found.truth, results_of_runs, failures)
        return made if window_ns == IN_ORDER else [*made, gone_back(found.name, state.events)]

    return found.bound(start, run, finish)


# --- libraries --------------------------------------------------------------------------------------


def description_of_library(label: str, settings: Mapping[str, Any]) -> Description:
    """Read the description of the library named in settings; raise BadInput if it may not run."""
    file = _file(Path(what_runs(label, "lib", settings)).absolute())
    return _description(file, in_process=False)


@dataclass(frozen=True)
class _OfLibraries(Estimator[Any]):
    """Placeholder for estimators of libraries; the settings name the library."""

    def specified(self, label: str, settings: Mapping[str, Any]) -> Estimator[Any]:
        """Return the estimator of the library named in `settings` of `label`."""
        # absolute, because processes have their own working folders
        file = _file(Path(what_runs(label, "lib", settings)).absolute())
        in_process = settings.get("in_process", False) is True
        description = _description(file, in_process)

        def bind(label: str, topics: Mapping[str, Topic], parameters: Any) -> list[Bound]:
            bound: list[Bound] = []
            for found in bind_all(label, description, topics, parameters):
                made = (
                    bind_in_process(found, _loaded(file))
                    if in_process
                    else bind_apart(found, follow_runs)
                )
                bound.append(replace(made, out_of_sequence=partial(_going_back, found, follow_runs)))
            return bound

        def follow_runs(runs: Sequence[RunGiven | None], limits: Limits) -> list[Ran | None]:
            if not in_process:
                return follow_runs_apart(str(file.path), runs, description, limits)
            return [
                None if each is None else follow_here(_loaded(file), each, description) for each in runs
            ]

        parameters = description.parameters_over(LibraryParameters)
        return Estimator(description.summary, description.requirements, parameters, bind)


def _going_back(found: FoundFilter, follow_runs: FollowRuns, window_ns: int) -> Recursive:
    """Bind a filter for messages in order of arrival; raise BadInput if `every_s` is set."""
    if found.parameters.every_s is not None:
        raise BadInput(
            f"estimator {found.name}: --late rewind gives no estimates between messages (every_s, "
            "--every); give --late drop or --late wait:SECONDS"
        )
    return bind_apart(found, follow_runs, window_ns)


class _File(NamedTuple):
    """Identity of a library file; it changes when the library is compiled again."""

    path: Path
    changed_ns: int
    size: int


def _file(path: Path) -> _File:
    try:
        state = path.stat()
    except OSError:
        raise BadInput(f"{path}: no such file; give the path of a shared library") from None
    return _File(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=64)
def _description(file: _File, in_process: bool) -> Description:
    text = _loaded(file).description if in_process else describe_apart(str(file.path))
    return read_description(text, str(file.path))


@lru_cache(maxsize=64)
def _loaded(file: _File) -> Library:
    return Library(file.path)


def unspecified(label: str, topics: Mapping[str, Topic], parameters: Any) -> list[Bound]:  # noqa: ARG001
    """Raise BadInput because no settings name a program."""
    raise BadInput(f"estimator {label}: no program is named; give -e lib:PATH or -e exec:COMMAND")


LIB = _OfLibraries(
    "your own filter in C, C++ or Rust, with the functions of fuselog_filter.h: -e lib:PATH",
    "the topics that the filter's description names",
    LibraryParameters,
    unspecified,
)


def numbers_of(topic: TopicRead, stream: Stream, width: int) -> Floats:
    """Combine the fields of a topic in rows (n, width), padded with NaN.

    Raises BadInput if a field is missing.
    """
    data, column = np.full((len(stream), width), np.nan), 0
    for field, size in topic.sizes.items():
        if field not in stream.columns:
            raise BadInput(
                f"topic {stream.topic}: has no field {field}, which the filter reads; "
                f"{choices(field, stream.columns)}"
            )
        values = stream[field]
        if not len(stream):
            continue
        if values.ndim == 1 and size:
            raise BadInput(
                f"topic {stream.topic}: {field} is one number, not a vector of {size}; name it {field}"
            )
        check_width(stream, field, size or 1) if values.ndim == 2 else None
        data[:, column : column + (size or 1)] = values.reshape(len(stream), -1)
        column += size or 1
    return data


def static_of(
    description: Description, found: Mapping[str, Topic], given: Mapping[str, Ragged], runs: int
) -> Static:
    """Combine the messages of the static topics in all runs, topic by topic."""
    parts = [
        (number, topic, given[found[topic.topic].name])
        for number, topic in enumerate(description.topics)
        if topic.static and topic.topic in found
    ]
    nothing = Static(
        np.zeros(runs + 1, np.int64),
        np.empty(0, np.int64),
        np.empty(0, np.int64),
        np.empty((0, description.width)),
    )
    if not parts:
        return nothing
    order, offsets = by_runs([each.offsets for _, _, each in parts])
    return Static(
        offsets,
        np.concatenate([each.stream.publish_time_ns for _, _, each in parts])[order],
        np.concatenate([np.full(len(each), number) for number, _, each in parts])[order],
        np.concatenate([numbers_of(topic, each.stream, description.width) for _, topic, each in parts])[
            order
        ],
    )


def static_of_run(static: Static, run: int) -> Static:
    """Return the static messages of one run."""
    begin, end = static.offsets[run : run + 2].tolist()
    return Static(
        np.array([0, end - begin]),
        static.time_ns[begin:end],
        static.source[begin:end],
        static.data[begin:end],
    )


def events_of(description: Description, found: Mapping[str, Topic], block: Block) -> FilterEvents:
    """Convert a block's messages to events, which refer to topics by index in the description."""
    numbers = {
        found[each.topic].name: number
        for number, each in enumerate(description.topics)
        if each.topic in found
    }
    tables, targets, sources = [], [], []
    for name, ragged in block.streams.items():
        topic = description.topics[numbers[name]]
        tables.append(numbers_of(topic, ragged.stream, description.width))
        target = ragged[topic.target] if topic.target else np.zeros(len(ragged))
        targets.append(target.astype(np.int64))
        sources.append(numbers[name])
    merged = block.events
    source = np.array(sources)[merged.topic]
    wanted = at_stamps_of(
        merged.is_last, np.array([each.estimates for each in description.topics])[source]
    )
    return FilterEvents(
        merged.offsets,
        merged.time_ns,
        source,
        np.ascontiguousarray(np.concatenate(tables)[merged.source]),
        wanted,
        np.concatenate(targets)[merged.source],
        np.empty((len(source), 0), np.int64) if block.arrival is None else block.arrival,
    )


def streams_of(
    name: str,
    description: Description,
    truth: str,
    followed: Followed,
    failures: Mapping[int, Failure],
) -> list[Ragged]:
    """Make output streams from the results of filters."""
    topic, (issued_ns, estimates, offsets, innovations, recorded) = f"/estimates/{name}", followed
    state = state_stream(
        f"{topic}/{description.output}",
        estimates.time_ns,
        description.state,
        truth,
        estimates.mean,
        estimates.covariance,
    )
    state = replace(state, log_time_ns=issued_ns)
    made = [Ragged(state, offsets), failures_by_run(topic, failures, len(offsets) - 1)]
    if description.innovation:
        metadata = {**named(description.innovation), "truth": truth}
        made.append(recorded_innovations(f"{topic}/innovation", metadata, innovations, recorded))
        check_stream(made[-1].stream)
    return made


def of_run(parts: Sequence[FilterEvents], run: int) -> FilterEvents:
    """Join one run's events of several blocks."""
    spans = [slice(int(each.offsets[run]), int(each.offsets[run + 1])) for each in parts]
    columns = [
        np.concatenate([each[place][span] for each, span in zip(parts, spans, strict=True)])
        for place in range(1, len(FilterEvents._fields))
    ]
    return FilterEvents(np.array([0, len(columns[0])]), *columns)


def joined(of_runs: Sequence[Followed]) -> Followed:
    """Join the results of single runs."""
    estimates = zip(*(run.estimates for run in of_runs), strict=True)
    innovations = zip(*(run.innovations for run in of_runs), strict=True)
    return Followed(
        np.concatenate([run.issued_ns for run in of_runs]),
        EstimateRows(*map(np.concatenate, estimates)),
        _offsets([len(run.estimates.time_ns) for run in of_runs]),
        InnovationRows(*map(np.concatenate, innovations)),
        _offsets([len(run.innovations.time_ns) for run in of_runs]),
    )


def _offsets(counts: Sequence[int]) -> Integers:
    return np.cumsum([0, *counts])
