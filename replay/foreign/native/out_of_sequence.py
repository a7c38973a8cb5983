"""Reprocessing of out-of-sequence messages by the filters of a library.

Messages are passed to the filters as they arrive, and every run has two filters. The settled filter has
processed, in order, the messages that no other message can precede any more; the newest filter has
processed all messages that have arrived. When a message is late, the newest filter is replaced by a copy
of the settled one and processes the messages in the window again. Estimates come from the newest filter
and innovations from the settled one, so both equal the results of processing in order.
"""

from bisect import bisect
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.replay.engine.arrays import Integers, varying
from fuselog.replay.engine.streams.blocks import Ragged, join
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.foreign.description import Description
from fuselog.replay.foreign.native.following import (
    COPY,
    DESTROY,
    NOBODY,
    NOT_COPIED,
    Filters,
    Given,
    Static,
    addresses_of,
    advance,
    copies_of,
    work_of,
)
from fuselog.replay.foreign.native.library import Library
from fuselog.replay.foreign.results import Results
from fuselog.replay.inference.linear_algebra.gaussian import Innovation
from fuselog.replay.inference.run.out_of_sequence import rewound
from fuselog.replay.inference.run.recursion import FilterEvents


@varying(1)
class Arrived(NamedTuple):
    """Messages that have arrived, in the order of their stamps, and the largest delay of a message.

    Attributes:
        order: (n,) the messages that have arrived, sorted by stamp and position in the file; the
            messages of run r begin at the first event of the run.
        estimating: (n,), 1 for messages that have an estimate at their stamp.
        window_ns: (1,) the largest delay.
    """

    order: Integers
    estimating: Integers
    window_ns: Integers


def follow_as_arrived(
    run: int,
    given: Given,
    arrived: Arrived,
    settled: Filters,
    newest: Filters,
    made: Results,
    work: tuple[Innovation, Innovation],
) -> None:
    """Pass the messages of one run to its filters as they arrive, until the run fails."""
    events, order = given.events, arrived.order
    begin, end = events.offsets[run], events.offsets[run + 1]
    taken = begin
    for event in range(begin, end):
        if newest.failure[run] == ALL_WELL:
            first = insert(begin, event, events, order)
            if first < event:
                first = taken
                restart(run, given, settled, newest)
            estimated = newest_estimated(event, events, arrived)
            for row in range(first, event + 1):
                calls = events.wants_estimate[event] and row == estimated
                caller = event if calls else NOBODY
                recorded = made.innovations.end[run]
                advance(run, order[row], caller, given, newest, made, work)
                made.innovations.end[run] = recorded
            since_ns = events.time_ns[order[event]] - arrived.window_ns[0]
            while taken < event and events.time_ns[order[taken]] < since_ns:
                advance(run, order[taken], NOBODY, given, settled, made, work)
                taken += 1
            end = event + 1 if newest.failure[run] != ALL_WELL else end
    for row in range(taken, end):
        advance(run, order[row], NOBODY, given, settled, made, work)


def insert(begin: int, event: int, events: FilterEvents, order: Integers) -> int:
    """Insert a message in the order of stamps and positions in the file, and return its row.

    Args:
        begin: first row of the message's run.
        event: index of the message; all rows before this index are in order.
        events: stamps and positions of all messages.
        order: (n,), the event in each row, changed in place.
    """
    time_ns, position = events.time_ns[event], events.arrival[event, 1]
    row = event
    while row > begin and (
        events.time_ns[order[row - 1]] > time_ns
        or (events.time_ns[order[row - 1]] == time_ns and events.arrival[order[row - 1], 1] > position)
    ):
        order[row] = order[row - 1]
        row -= 1
    order[row] = event
    return row


def restart(run: int, given: Given, settled: Filters, newest: Filters) -> None:
    """Replace the newest filter by a copy of the settled one."""
    DESTROY(given.addresses.destroy, newest.handle[run])
    newest.handle[run] = COPY(given.addresses.copy, settled.handle[run])
    newest.time_ns[run], newest.begun[run] = settled.time_ns[run], settled.begun[run]
    if newest.handle[run] == 0:
        newest.failure[run] = NOT_COPIED


def newest_estimated(last: int, events: FilterEvents, arrived: Arrived) -> int:
    """Find the newest stamp with an estimate, up to row `last`; return the last row of this stamp."""
    row, order = last, arrived.order
    while row > 0 and arrived.estimating[order[row]] == 0:
        row -= 1
    while row < last and events.time_ns[order[row + 1]] == events.time_ns[order[row]]:
        row += 1
    return row


@lru_cache(maxsize=1)
def _loop() -> OverRuns:
    title = "filters of a library, with reprocessing of out-of-sequence messages"
    return compile_over_runs(follow_as_arrived, title=title)


def follow_all_as_arrived(
    window_ns: int,
    library: Library,
    description: Description,
    static: Static,
    events: FilterEvents,
    carried: Filters,
    made: Results,
) -> None:
    """Pass the messages of all runs to their filters as they arrive; see `following.follow_all`."""
    estimates = np.array([each.estimates for each in description.topics])
    arrived = Arrived(
        np.zeros(len(events.time_ns), np.int64),
        estimates[events.source].astype(np.int64),
        np.array([window_ns]),
    )
    settled = copies_of(library, carried)
    given = Given(addresses_of(library, description), static, events)
    runs = len(settled.handle)
    _loop()(runs, given, arrived, settled, carried, made, scratch=work_of(description))
    library.destroy_all(settled.handle.tolist())


def gone_back(name: str, blocks: Sequence[FilterEvents]) -> Ragged:
    """List the out-of-sequence messages in blocks, and how many messages were reprocessed for each."""
    newer = [list[tuple[int, int]]() for _ in blocks[0].offsets[1:]]
    made = []
    for events in blocks:
        counts = np.zeros(len(events.time_ns), np.int64)
        keys = list(zip(events.time_ns.tolist(), events.arrival[:, 1].tolist(), strict=True))
        for order, (begin, end) in zip(newer, pairwise(events.offsets.tolist()), strict=True):
            for event in range(begin, end):
                place = bisect(order, keys[event])
                counts[event] = len(order) - place
                order.insert(place, keys[event])
        made.append(rewound(name, events, counts))
    return join(made)
