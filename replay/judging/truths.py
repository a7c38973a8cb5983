"""The truth at the stamps of estimates, read along with them: memory holds what they are at."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from recorders.log import Stream, schemas
from recorders.log.streams import concatenate
from replay.engine.sources import Source
from replay.engine.tangent import between

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

BLOCK_MESSAGES = 1 << 16


class Truths:
    """The truths of one run, for readers that each go through it in time."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.topics = [
            topic.name
            for topic in source.topics.values()
            if topic.schema_name == schemas.TRUTH_STATE.full_name
        ]
        self._begin()

    def _begin(self) -> None:
        self._blocks: Iterator[dict[str, Stream]] | None = self.source.whole().blocks(
            self.topics, "publish_time", BLOCK_MESSAGES
        )
        self._parts = {topic: self.source.empty(topic) for topic in self.topics}
        self._read_to_ns = -1
        self._forgotten: set[str] = set()
        self._reached: dict[tuple[str, str], int] = {}

    def around(self, topic: str, time_ns: Integers, gap_limit_s: float, reader: str = "") -> Stream:
        """The messages of a topic about some stamps: no later ones would change the truth there.

        `reader` is who asks; what all readers have passed is forgotten, and read anew where one that was
        not there yet asks for it.
        """
        if len(time_ns) == 0:
            return self.source.empty(topic)
        first_ns, last_ns = int(time_ns.min()), int(time_ns.max())
        if topic in self._forgotten and first_ns < self._parts[topic].publish_time_ns[0]:
            self._begin()
        self._reached[topic, reader] = first_ns
        enough_ns = last_ns + round(gap_limit_s * 1e9)
        while self._blocks is not None and self._read_to_ns <= enough_ns:
            there = self._parts[topic].publish_time_ns
            if len(there) and there[-1] >= last_ns:
                break
            self._read_block(self._blocks)
        self._reached[topic, reader] = last_ns
        return self._parts[topic]

    def _read_block(self, blocks: Iterator[dict[str, Stream]]) -> None:
        block = next(blocks, None)
        if block is None:
            self._blocks = None
            return
        for topic, stream in block.items():
            kept = self._current(topic)
            self._parts[topic] = concatenate([kept, stream]) if len(kept) else stream
            self._read_to_ns = max(self._read_to_ns, int(stream.publish_time_ns[-1]))

    def _current(self, topic: str) -> Stream:
        """What is held of a topic, from the last message that some reader may still need."""
        held = self._parts[topic]
        readers = [at_ns for (of, _), at_ns in self._reached.items() if of == topic]
        passed_ns = min(readers or self._reached.values(), default=-1)
        first = int(np.searchsorted(held.publish_time_ns, passed_ns, side="right")) - 1
        if first <= 0:
            return held
        self._forgotten.add(topic)
        return held.take(slice(first, None))


def truth_at(truth: Stream, time_ns: Integers, kinds: Sequence[str], gap_limit_s: float) -> Floats:
    """The truth's state (n, d) at any stamps; see `states_at`."""
    return states_at(truth.publish_time_ns, truth["state"], time_ns, kinds, gap_limit_s)


def states_at(
    times: Integers, state: Floats, time_ns: Integers, kinds: Sequence[str], gap_limit_s: float
) -> Floats:
    """States (m, d) at times (m,) as states (n, d) at any stamps (n,), the shortest way between.

    NaN over gaps above the limit; a stamp that there is a state of exactly needs no neighbour.
    """
    if len(times) == 0:
        return np.full((len(time_ns), len(kinds)), np.nan)
    right = np.searchsorted(times, time_ns, side="left").clip(0, len(times) - 1)
    left = np.where(times[right] > time_ns, right - 1, right).clip(0)
    span = times[right] - times[left]
    weight = (time_ns - times[left]) / np.maximum(span, 1)
    value = between(state[left], state[right], weight, kinds)
    inside = (times[left] <= time_ns) & (time_ns <= times[right]) & (span <= gap_limit_s * 1e9)
    value[~inside] = np.nan
    return value
