"""Goes through the events of a run in time: the loops that filters, trackers and networks share.

What events are differs: messages, scans of detections, activities of nodes. All have `offsets`
(runs + 1,) and `time_ns` (n,), and stand in the inputs of a recursion as `events`.
"""

from typing import Protocol

from fuselog.replay.engine.arrays import AnyArgument
from fuselog.replay.engine.streams.results import ALL_WELL


class OnEvent(Protocol):
    """Does something at an event of a run, see `over_events`; returns ALL_WELL or what failed.

    Inputs, state, results and memory are those of the recursion.
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
    """Moves the state of a run through all events of a stamp; returns whether the run goes on."""

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
    """Moves the state of a run through all its events, and fills the results."""

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

    Args:
        process: `process(run, event, inputs, state, results, memory)` moves the state through an event;
            returns the number of what failed. What is negative ends no run, and only after ALL_WELL is
            something recorded.
        record: the same, after that: it fills in what is wanted of the state.
        fails: whether a run may fail; else the state has no `failure`, and all events are processed.

    Returns `follow(run, inputs, state, results, memory)`, for `compile_over_runs`. The run ends where
    its `state.failure` is not ALL_WELL, or its events end.
    """

    def follow(
        run: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
    ) -> None:
        """Move the state, and fill the results, until the events end or the run fails."""
        for event in range(inputs.events.offsets[run], inputs.events.offsets[run + 1]):
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
    """Make the loop over the events of one run, all of one stamp together.

    Args:
        process: `process(run, begin, end, inputs, state, results, memory)` moves the state through the
            events from `begin` to `end`; returns whether the run goes on.

    Returns `follow(run, inputs, state, results, memory)`, for `compile_over_runs`.
    """

    def follow(
        run: int,
        inputs: AnyArgument,
        state: AnyArgument,
        results: AnyArgument,
        memory: AnyArgument,
    ) -> None:
        """Move the state, and fill the results, until the events end or the run does."""
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
