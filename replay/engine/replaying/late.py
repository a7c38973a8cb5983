"""Handling of late (out-of-sequence) messages: dropping them, waiting for them, or reprocessing.

In order of arrival (log time), measurement stamps (publish time) go back whenever a message was late.
`taking_late` wraps an estimator so that it gets its messages in order of arrival, with one of three
policies:

    drop            skip a message that is older than the newest one processed
    wait:SECONDS    hold back every message until this time after its stamp; then do the same as drop
    rewind:SECONDS  go back by at most this time, and reprocess all later messages; skip older messages

Skipped messages are reported on the estimator's topic `skipped`, as `schemas.SKIPPED`. A message that
newer messages waited for is reported on `waited`, as `schemas.WAITED`. For `rewind` the estimator does
the reprocessing itself and reports it on `rewound`, as `schemas.REWOUND` (`Recursive.out_of_sequence`;
for filters of models, `fuselog.replay.inference.run.out_of_sequence`, for those of libraries
`fuselog.replay.foreign.native.out_of_sequence`).
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.arrays import Booleans, Integers
from fuselog.replay.engine.replaying.estimator import Bound, Carried, Recursive
from fuselog.replay.engine.streams.blocks import Block, Events, Ragged, join, last_of_equals, run_of_rows
from fuselog.replay.engine.streams.failures import reason_stream

POLICIES = ("drop", "wait", "rewind")
OLDER = "older than what was used before"  # part of the reason for skipping a message
LONGEST_S = 1e9


class Late(NamedTuple):
    """Policy for out-of-sequence messages, and how long to wait or how far to go back."""

    policy: str
    window_ns: int

    @property
    def back_ns(self) -> int:
        """Return how far back, in ns, the stamps of an estimator's messages may go."""
        return self.window_ns if self.policy == "rewind" else 0


def parse_late(text: str, *, arrival_order: bool) -> Late:
    """Parse `drop`, `wait:SECONDS` or `rewind:SECONDS`.

    Raises BadInput if the text has another form, or if messages are not processed in order of arrival.

    Args:
        text: as given on the command line.
        arrival_order: whether messages are processed in order of arrival.
    """
    policy, _, seconds = text.partition(":")
    if policy not in POLICIES:
        raise BadInput(
            f"--late {text}: give drop, wait:SECONDS or rewind:SECONDS; {choices(policy, POLICIES)}"
        )
    if not arrival_order:
        raise BadInput(
            f"--late {text}: messages can be late only if they are processed in order of arrival; add "
            "--arrival-order (in Python arrival_order=True)"
        )
    if policy == "drop":
        if text != policy:
            raise BadInput(f"--late {text}: drop has no duration; give --late drop")
        return Late(policy, 0)
    try:
        window_s = float(seconds)
    except ValueError:
        window_s = np.nan
    if not 0 <= window_s <= LONGEST_S:
        raise BadInput(f"--late {text}: give zero or more seconds, such as {policy}:0.5")
    return Late(policy, round(window_s * 1e9))


def taking_late(bound: Bound, late: Late) -> Recursive:
    """Make an estimator that gets its messages in order of log time.

    Raises BadInput if the estimator is not recursive, or cannot reprocess messages as the policy
    requires.

    Args:
        bound: the estimator, which expects its messages in order of their stamps.
        late: policy for out-of-sequence messages.
    """
    if not isinstance(bound, Recursive):
        raise BadInput(
            f"estimator {bound.name}: it solves for all messages together, so no message can be late; "
            "leave out --late"
        )
    if late.policy == "rewind":
        if bound.out_of_sequence is None:
            raise BadInput(
                f"estimator {bound.name}: it cannot reprocess out-of-sequence messages (only estimators "
                "of a model and a method, and filters of libraries, can); give --late drop or "
                "--late wait:SECONDS"
            )
        bound = bound.out_of_sequence(late.window_ns)
    return replace(
        bound,
        start=partial(_start, bound),
        run=partial(_run, bound, late),
        finish=partial(_finish, bound, late),
    )


class _State(NamedTuple):
    """State carried from block to block.

    Attributes:
        inner: state of the wrapped estimator.
        waiting: messages that are held back.
        newest_ns, arrived_ns: (runs,) the newest stamps processed, and the newest that have arrived;
            None before the first block.
    """

    inner: Carried
    waiting: Mapping[str, Ragged]
    newest_ns: Integers | None = None
    arrived_ns: Integers | None = None


def _start(bound: Recursive, static: dict[str, Ragged]) -> _State:
    return _State(bound.start(static), {})


def _run(bound: Recursive, late: Late, state: _State, block: Block) -> tuple[_State, list[Ragged]]:
    return _take(bound, late, state, block.streams, is_over=False)


def _finish(bound: Recursive, late: Late, state: _State) -> list[Ragged]:
    """Process the messages still held back, and return the last outputs of the estimator."""
    made: list[Ragged] = []
    if state.waiting:
        nothing = {
            topic: Ragged(held.stream.take(slice(0, 0)), np.zeros_like(held.offsets))
            for topic, held in state.waiting.items()
        }
        state, made = _take(bound, late, state, nothing, is_over=True)
    return made + (bound.finish(state.inner) if bound.finish is not None else [])


def _take(
    bound: Recursive, late: Late, state: _State, streams: dict[str, Ragged], *, is_over: bool
) -> tuple[_State, list[Ragged]]:
    arrivals = _arrivals(late, streams, state.waiting)
    ready = np.ones(len(arrivals.run), bool)
    if late.policy == "wait" and not is_over:
        ready = arrivals.moment_ns < _reached(streams)[arrivals.run]
    newest_ns, behind_ns = _find_behind(arrivals, ready, state.newest_ns)
    is_late = behind_ns > late.back_ns
    skipped = [_skipped(bound.name, arrivals, is_late, late)]
    arrived_ns = state.arrived_ns
    if late.policy == "wait":
        arrived_ns, waited = _waited(bound.name, streams, arrived_ns, late)
        skipped.append(waited)
    inner, made = bound.run(state.inner, _block(arrivals, ready & ~is_late))
    waiting = {} if ready.all() else _block(arrivals, ~ready).streams
    return _State(inner, waiting, newest_ns, arrived_ns), [*skipped, *made]


class _Arrivals(NamedTuple):
    """Messages of all topics in the order in which they are processed, run by run.

    Attributes:
        streams: the topics.
        run, topic, row: (n,) the run, the index of the topic, and the row in that topic.
        stamp_ns, moment_ns: (n,) the times at which the messages were measured, and at which they are
            processed.
        position: (n,) position in the file.
    """

    streams: dict[str, Ragged]
    run: Integers
    topic: Integers
    row: Integers
    stamp_ns: Integers
    moment_ns: Integers
    position: Integers

    @property
    def runs(self) -> int:
        """Return the number of runs, including empty ones."""
        return next(iter(self.streams.values())).runs


def _arrivals(late: Late, streams: dict[str, Ragged], waiting: Mapping[str, Ragged]) -> _Arrivals:
    """Merge new messages with those held back; messages with equal times stay in the file's order."""
    if waiting:
        streams = {topic: join([waiting[topic], streams[topic]]) for topic in streams}
    columns = [
        (
            run_of_rows(ragged.offsets),
            np.full(len(ragged), topic),
            np.arange(len(ragged)),
            ragged.stream.publish_time_ns,
            ragged.stream.log_time_ns,
            ragged.stream.position,
        )
        for topic, ragged in enumerate(streams.values())
    ]
    run, topic, row, stamp_ns, moment_ns, position = map(np.concatenate, zip(*columns, strict=True))
    if late.policy == "wait":
        moment_ns = np.maximum(moment_ns, stamp_ns + late.window_ns)
    order = np.lexsort((position, moment_ns, run))
    found = (column[order] for column in (run, topic, row, stamp_ns, moment_ns, position))
    return _Arrivals(streams, *found)


def _reached(streams: dict[str, Ragged]) -> Integers:
    """Return the arrival time (runs,) of each run's last message, or zero if a run has no message."""
    reached = []
    for ragged in streams.values():
        last = np.maximum(ragged.offsets[1:], 1) - 1
        arrived = np.append(ragged.stream.log_time_ns, 0)[last]
        reached.append(np.where(np.diff(ragged.offsets) > 0, arrived, 0))
    newest: Integers = np.max(reached, axis=0)
    return newest


def _find_behind(
    arrivals: _Arrivals, ready: Booleans, before_ns: Integers | None
) -> tuple[Integers, Integers]:
    """Find the newest stamps (runs,) up to the last ready message, and the lag (n,) of each message.

    The lag is the time by which a message is older than the newest one before it; it is zero if the
    message is not older, or is not ready.
    """
    newest_ns = np.zeros(arrivals.runs, np.int64) if before_ns is None else before_ns.copy()
    behind_ns, rows = np.zeros(len(ready), np.int64), np.flatnonzero(ready)
    ends = np.searchsorted(arrivals.run[rows], np.arange(len(newest_ns) + 1))
    for run in np.flatnonzero(np.diff(ends)):
        own = rows[ends[run] : ends[run + 1]]
        newest = np.maximum.accumulate(np.append(newest_ns[run], arrivals.stamp_ns[own]))
        behind_ns[own] = np.maximum(newest[:-1] - arrivals.stamp_ns[own], 0)
        newest_ns[run] = newest[-1]
    return newest_ns, behind_ns


def _block(arrivals: _Arrivals, chosen: Booleans) -> Block:
    """Make a block of the chosen messages, each topic in the order of processing."""
    run, topic, row = (column[chosen] for column in (arrivals.run, arrivals.topic, arrivals.row))
    streams: dict[str, Ragged] = {}
    source, before = np.empty(len(run), np.int64), 0
    for number, (name, ragged) in enumerate(arrivals.streams.items()):
        own = np.flatnonzero(topic == number)
        offsets = np.searchsorted(run[own], np.arange(arrivals.runs + 1))
        streams[name] = Ragged(ragged.stream.take(row[own]), offsets)
        source[own] = before + np.arange(len(own))
        before += len(own)
    stamp_ns, moment_ns, position = (
        column[chosen] for column in (arrivals.stamp_ns, arrivals.moment_ns, arrivals.position)
    )
    offsets = np.searchsorted(run, np.arange(arrivals.runs + 1))
    is_last = last_of_equals(offsets, stamp_ns, moment_ns)
    events = Events(offsets, stamp_ns, topic, source, is_last)
    return Block(streams, events, np.stack([moment_ns, position], axis=1))


def _skipped(name: str, arrivals: _Arrivals, is_late: Booleans, late: Late) -> Ragged:
    by = f"more than {late.back_ns * 1e-9:g} s " if late.back_ns else ""
    reasons = [f"topic {topic}: it is {by}{OLDER}" for topic in arrivals.streams]
    stream = reason_stream(
        f"/estimates/{name}/skipped",
        schemas.SKIPPED,
        arrivals.stamp_ns[is_late],
        arrivals.topic[is_late],
        reasons,
    )
    offsets = np.searchsorted(arrivals.run[is_late], np.arange(arrivals.runs + 1))
    return Ragged(replace(stream, log_time_ns=arrivals.moment_ns[is_late]), offsets)


def _waited(
    name: str, streams: dict[str, Ragged], arrived_ns: Integers | None, late: Late
) -> tuple[Integers, Ragged]:
    """Find the newest stamps (runs,) that have arrived, and the messages that newer ones wait for."""
    arrivals = _arrivals(Late("drop", 0), streams, {})
    everything = np.ones(len(arrivals.run), bool)
    arrived_ns, behind_ns = _find_behind(arrivals, everything, arrived_ns)
    in_time = (behind_ns > 0) & (arrivals.moment_ns <= arrivals.stamp_ns + late.window_ns)
    stream = make_stream(
        f"/estimates/{name}/waited",
        schemas.WAITED,
        arrivals.stamp_ns[in_time],
        log_time_ns=arrivals.moment_ns[in_time],
        behind_s=behind_ns[in_time] * 1e-9,
    )
    offsets = np.searchsorted(arrivals.run[in_time], np.arange(arrivals.runs + 1))
    return arrived_ns, Ragged(stream, offsets)
