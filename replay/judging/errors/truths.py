"""The truth at the stamps of estimates, read along with them: memory holds what they are at."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from recorders.log import Stream, schemas
from recorders.log.streams import concatenate
from replay.engine.streams.sources import Source

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
