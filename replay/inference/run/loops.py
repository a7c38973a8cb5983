"""Loops over the events of a run, shared by filters, trackers and networks.

Events may be messages, scans of detections, or measurements and transmissions of a network's nodes. All
events have `offsets` (runs + 1,) and `time_ns` (n,); they are the field `events` in the inputs of a
recursion.
"""

from typing import Protocol

from fuselog.replay.engine.arrays import AnyArgument
from fuselog.replay.engine.streams.results import ALL_WELL


class OnEvent(Protocol):
    """Function that is called for an event of a run; it returns ALL_WELL or the number of a failure.

    Inputs, state, results and memory belong to the recursion; see `over_events`.
    """

    def __call__(
        self,
        run: int,
        event: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
        /,
    ) -> int: ...


class OnStamp(Protocol):
    """Function that updates the state of a run by all events of a stamp.

    It returns whether the run continues.
    """

    def __call__(
        self,
        run: int,
        begin: int,
        end: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
        /,
    ) -> bool: ...


class Follow(Protocol):
    """Function that updates the state of a run by all its events and fills the results."""

    def __call__(
        self,
        run: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
        /,
    ) -> None: ...


def over_events(process: OnEvent, record: OnEvent, *, fails: bool = True) -> Follow:
    """Make the loop over the events of one run, one after the other.

    The run ends when its `state.failure` is not ALL_WELL, or after its last event.

    Args:
        process: `process(run, event, inputs, state, results, memory)` updates the state by an event and
            returns ALL_WELL or the number of a failure. A negative number does not end the run, but
            nothing is recorded for the event.
        record: function with the same arguments that fills the requested results; it is called if
            `process` returned ALL_WELL.
        fails: whether a run can fail; otherwise, the state needs no `failure`, and all events are
            processed.

    Returns:
        `follow(run, inputs, state, results, memory)`, for `compile_over_runs`.
    """

    def follow(
        run: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
    ) -> None:
        begin = max(inputs.events.offsets[run], 0)  # so that no event counts from the end
        for event in range(begin, inputs.events.offsets[run + 1]):
            has_failed = state.failure[run] != ALL_WELL if fails else False
            if has_failed:
                break
            failure = process(run, event, inputs, state, results, memory)
            if failure == ALL_WELL:
                failure = record(run, event, inputs, state, results, memory)
            if fails and failure >= 0:
                state.failure[run] = failure

    return follow


def over_stamps(process: OnStamp) -> Follow:
    """Make the loop over the events of one run that processes all events of a stamp together.

    Args:
        process: `process(run, begin, end, inputs, state, results, memory)` updates the state by the
            events from `begin` to `end` and returns whether the run continues.

    Returns:
        `follow(run, inputs, state, results, memory)`, for `compile_over_runs`.
    """

    def follow(
        run: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
    ) -> None:
        begin, last, time_ns = (
            inputs.events.offsets[run],
            inputs.events.offsets[run + 1],
            inputs.events.time_ns,
        )
        goes_on = True
        while goes_on and begin < last:
            end = begin + 1
            while end < last and time_ns[end] == time_ns[begin]:
                end += 1
            goes_on = process(run, begin, end, inputs, state, results, memory)
            begin = end

    return follow
