"""Reprocessing of out-of-sequence messages; the final belief is the same as with messages in order.

For every message within a window, the filter stores the message, the state after it, and its innovation.
An out-of-sequence message is inserted at its stamp and position in the file, and all messages after it
are processed again. Estimates that were already output are not changed; an innovation is output once no
message can change it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.arrays import Columns, Integers
from fuselog.replay.engine.streams.blocks import Block, Ragged, copied, ragged_rows, run_of_rows
from fuselog.replay.engine.streams.results import ALL_WELL, failures_of
from fuselog.replay.inference.kalman.methods import Method
from fuselog.replay.inference.kalman.steps import FAILURES, CoreMemory, EstimateRun, Steps
from fuselog.replay.inference.kalman.update import innovation_components
from fuselog.replay.inference.model.bound_model import BoundModel, title_of
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.settings import reading_settings
from fuselog.replay.inference.run.events import filter_events, passed_over
from fuselog.replay.inference.run.history import (
    History,
    KeptMessages,
    Structure,
    copying_rows,
    most_within,
    no_history,
    structure_of,
)
from fuselog.replay.inference.run.loops import Follow, over_events
from fuselog.replay.inference.run.recursion import (
    CONTROL,
    FilterEvents,
    InnovationRows,
    ProcessEvent,
    RecursionState,
    RunInputs,
    RunResults,
    filled,
    processing,
    writing_estimates,
)
from fuselog.replay.inference.sampling.sets import sets_by_runs

# The loop


class LateState(NamedTuple):
    """State of the recursion, for all runs.

    Attributes:
        carried: state after all messages so far.
        failure: failures of the runs.
        history: the stored messages.
        window_ns: largest delay up to which a message is reprocessed.
        repeated: (n,) number of updates that were repeated because of each event.
        row: (runs,) for each run, the row of the stored message that is being processed.
    """

    carried: RecursionState
    failure: Integers
    history: History
    window_ns: int
    repeated: Integers
    row: Integers


@lru_cache(maxsize=64)
def _compiled(bound_model: BoundModel, method: Method, structure: Structure) -> tuple[OverRuns, Steps]:
    steps = method.steps(bound_model)
    reads = reading_settings(number_fields(bound_model.model.parameters))
    loop = reprocessing(
        bound_model.model, processing(bound_model, steps, reads), steps.estimate, structure
    )
    title = f"{title_of(bound_model.model, method.summary)}, which reprocesses out-of-sequence messages"
    return compile_over_runs(loop, title=title), steps


def reprocessing(
    model: Model, process: ProcessEvent, estimate: EstimateRun, structure: Structure
) -> Follow:
    """Make the loop over the events of one run in order of arrival; see `recursion.recursion`.

    `structure` is the structure of `KeptMessages`.
    """
    write = writing_estimates(estimate)
    copy, restore = copying_rows(structure), copying_rows(dict(structure)["after"])
    passes_controls = model.control is not None and not model.control.estimates

    def insert(run: int, event: int, events: FilterEvents, history: History, capacity: int) -> int:
        """Insert an event in order of stamp and position in the file, and return its row."""
        kept, base = history.kept, run * capacity
        if history.first[run] + history.counts[run] == capacity:
            for k in range(history.counts[run]):
                copy(kept, base + history.first[run] + k, kept, base + k)
            history.first[run] = 0
        row: int = base + history.first[run] + history.counts[run]
        time_ns, position = events.time_ns[event], events.arrival[event, 1]
        while kept.time_ns[row - 1] > time_ns or (
            kept.time_ns[row - 1] == time_ns and kept.position[row - 1] > position
        ):
            copy(kept, row - 1, kept, row)
            row -= 1
        kept.time_ns[row], kept.position[row] = time_ns, position
        kept.source[row], kept.target_id[row] = events.source[event], events.target_id[event]
        kept.data[row] = events.data[event]
        history.counts[run] += 1
        return row

    def process_again(
        run: int, row: int, inputs: RunInputs, state: LateState, memory: CoreMemory
    ) -> int:
        """Predict to the time of a stored message and update by it; return a failure or ALL_WELL."""
        events, carried, kept, at = inputs.events, state.carried, state.history.kept, state.row
        stored = FilterEvents(
            events.offsets,
            kept.time_ns,
            kept.source,
            kept.data,
            kept.has_innovation,
            kept.target_id,
            events.arrival,
        )
        records = InnovationRows(
            at, kept.time_ns, kept.target_id, kept.difference, kept.covariance, kept.numbers
        )
        kept.difference[row], kept.covariance[row] = np.nan, np.nan
        at[run] = row
        again = RunInputs(stored, inputs.settings, inputs.gates)
        failure = process(run, row, again, carried, RunResults((), records), memory)
        kept.has_innovation[row] = at[run] > row
        restore(carried, run, kept.after, row)
        return failure

    def write_innovation(run: int, row: int, kept: KeptMessages, innovations: InnovationRows) -> None:
        """Write the innovation of a stored message to the results."""
        if kept.has_innovation[row]:
            result = innovations.end[run]
            innovations.time_ns[result] = kept.time_ns[row]
            innovations.target_id[result] = kept.target_id[row]
            innovations.difference[result] = kept.difference[row]
            innovations.covariance[result] = kept.covariance[row]
            innovations.numbers[result] = kept.numbers[row]
            innovations.end[run] = result + 1

    def newest_estimated(last: int, kept: KeptMessages) -> int:
        """Find the newest stamp with an estimate, and return the row of its last message."""
        row = last
        while passes_controls and kept.source[row] == CONTROL:
            row -= 1
        while row < last and kept.time_ns[row + 1] == kept.time_ns[row]:
            row += 1
        return row

    def reprocess(
        run: int,
        event: int,
        inputs: RunInputs,
        state: LateState,
        results: RunResults,
        memory: CoreMemory,
    ) -> int:
        """Insert an event, and process it and all later messages again."""
        history, kept = state.history, state.history.kept
        begin = insert(run, event, inputs.events, history, capacity_of(history))
        last = last_row(run, history)
        state.repeated[event] = last - begin
        restore(kept.after, begin - 1, state.carried, run)
        failure = ALL_WELL
        for row in range(begin, last + 1):
            failure = process_again(run, row, inputs, state, memory)
            if failure != ALL_WELL:
                break
        first = run * capacity_of(history) + history.first[run]
        while first < last and kept.time_ns[first + 1] < kept.time_ns[last] - state.window_ns:
            write_innovation(run, first, kept, results.innovations)
            first += 1
        history.counts[run] = last - first + 1
        history.first[run] = first - run * capacity_of(history)
        return failure

    def record(
        run: int,
        event: int,
        inputs: RunInputs,
        state: LateState,
        results: RunResults,
        memory: CoreMemory,
    ) -> int:
        """Write the newest estimate if the event requests one."""
        if not inputs.events.wants_estimate[event]:
            return ALL_WELL
        kept = state.history.kept
        row = newest_estimated(last_row(run, state.history), kept)
        return write(run, row, kept.time_ns[row], kept.after.belief, results.estimates, memory)

    return over_events(reprocess, record)


def capacity_of(history: History) -> int:
    """Return the number of rows for the messages of each run."""
    return len(history.kept.time_ns) // len(history.first)


def last_row(run: int, history: History) -> int:
    """Return the row of the newest stored message of a run."""
    row: int = run * capacity_of(history) + history.first[run] + history.counts[run] - 1
    return row


# As an estimator


# A `filtering.Filter` and its state; this module cannot import `filtering`.
AnyFilter = Any  # type: ignore[explicit-any]
AnyFilterState = Any  # type: ignore[explicit-any]


@dataclass(frozen=True)
class OutOfSequenceFilter:
    """Filter that reprocesses messages with delays of up to `window_ns`, with the methods of `Filter`.

    `inner` is a `filtering.Filter`, and the states are of its type.
    """

    inner: AnyFilter
    window_ns: int

    def start(self, static: Mapping[str, Ragged]) -> AnyFilterState:
        """Make the initial state of every run from its prior."""
        state = self.inner.start(static)
        return state._replace(kept=no_history(self.inner.bound_model, state.carried))

    def run(self, state: AnyFilterState, block: Block) -> tuple[AnyFilterState, list[Ragged]]:
        """Filter a block with its messages in order of arrival."""
        inner, sensors = self.inner, self.inner.bound_model.sensors
        events, without_covariance = filter_events(
            inner.bound_model, inner.found, block, state.context, inner.settings
        )
        carried, before = copied(state.carried), state.kept
        history = before.with_room(2 * (most_within(before, events, self.window_ns) + 3))
        runs = len(history.first)
        run = run_of_rows(events.offsets)
        wants_estimate = events.wants_estimate & (events.time_ns >= history.start_ns[run])
        events = events._replace(wants_estimate=wants_estimate)
        due = ragged_rows(wants_estimate, events.offsets)
        recorded = ragged_rows(events.source >= 0, events.offsets) + history.offsets
        estimates, innovations = inner.no_results(due, recorded, len(innovation_components(sensors)))
        repeated = np.zeros(len(wants_estimate), np.int64)
        loop, steps = _compiled(inner.bound_model, inner.method, structure_of(history.kept))
        sets = tuple(next(sets_by_runs(each, (), events.offsets))[1] for each in inner.samplers)
        loop(
            runs,
            RunInputs(events, inner.settings_of_runs(state.context, runs), inner.gates),
            LateState(
                carried, carried.failure, history, self.window_ns, repeated, np.zeros(runs, np.int64)
            ),
            RunResults(estimates, innovations),
            scratch=partial(steps.memory, sets),
        )
        states, *others = inner.output_streams(*filled(estimates, due))
        made = [issued(states, events, history.start_ns), *others]
        made += [inner.innovations(*filled(innovations, recorded))] if sensors else []
        if (carried.failure != state.carried.failure).any():
            failures = state.carried.failure, carried.failure, carried.time_ns, FAILURES
            made.append(failures_of(f"/estimates/{inner.name}", *failures))
        skipped = passed_over(inner.name, inner.bound_model, inner.found, block, without_covariance)
        made += [rewound(inner.name, events, repeated), *skipped]
        return state._replace(carried=carried, kept=history), made

    def finish(self, state: AnyFilterState) -> list[Ragged]:
        """Return the innovations that were kept back because later messages could have changed them."""
        history: History = state.kept
        has_innovation = history.kept.has_innovation[history.rows]
        rows, offsets = history.rows[has_innovation], ragged_rows(has_innovation, history.offsets)
        if not self.inner.bound_model.sensors:
            return []
        kept = history.kept
        columns: Columns = kept.time_ns, kept.target_id, kept.difference, kept.covariance, kept.numbers
        innovations = InnovationRows(offsets[1:], *(column[rows] for column in columns))
        return [self.inner.innovations(innovations, offsets)]


def rewound(name: str, events: FilterEvents, repeated: Integers) -> Ragged:
    """Report the out-of-sequence messages, and how many updates were repeated because of each.

    Args:
        name: name of the estimator.
        events: the n events of the block.
        repeated: (n,) number of updates; zero for messages in order.
    """
    is_late = repeated > 0
    stream = make_stream(
        f"/estimates/{name}/rewound",
        schemas.REWOUND,
        events.time_ns[is_late],
        log_time_ns=events.arrival[is_late, 0],
        repeated=repeated[is_late],
    )
    return Ragged(stream, ragged_rows(is_late, events.offsets))


def issued(estimates: Ragged, events: FilterEvents, start_ns: Integers) -> Ragged:
    """Set the log times of estimates to the arrival times of the events that requested them.

    A run has estimates either for all of these events after its prior, or only for the first few of
    them.

    Args:
        estimates: estimates of the filter.
        events: events of the block, with their arrival.
        start_ns: (runs,) stamps of the priors.
    """
    if not events.arrival.shape[1]:
        return estimates
    run = run_of_rows(events.offsets)
    called = events.wants_estimate & (events.time_ns >= start_ns[run])
    begin = ragged_rows(called, events.offsets)[:-1]
    first = np.repeat(begin - estimates.offsets[:-1], np.diff(estimates.offsets))
    moment_ns = events.arrival[called, 0][first + np.arange(len(estimates))]
    return replace(estimates, stream=replace(estimates.stream, log_time_ns=moment_ns))
