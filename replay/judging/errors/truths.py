"""Reading of truths along with estimates, keeping only the messages around the estimates' stamps.

A truth that is stated twice, by one topic or by two, is doubtful; messages are checked for this during
reading.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas, topics_of
from fuselog.recorders.log.streams import concatenate
from fuselog.replay.engine.streams.sources import Source

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

BLOCK_MESSAGES = 1 << 16
# In the metadata of a truth: some targets have no truth in the log.
COVERS, SOME_TARGETS = "covers", "some targets"


class Doubt(NamedTuple):
    """Doubt about a truth: the number of messages of the truth, and the reason."""

    messages: int
    why: str


class Truths:
    """Truths of one run for several readers, each of which reads in order of time."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.topics = topics_of(source.topics, schemas.TRUTH_STATE)
        self._beside: dict[str, list[str]] = {}
        for topic in self.topics:
            self._beside.setdefault(topic.rpartition("/")[0], []).append(topic)
        self._apart: dict[tuple[str, str], dict[str, float]] = {}
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
        """Return the messages of a topic that determine the truth at some stamps.

        `reader` identifies the caller. Messages before the stamps that all readers still need are
        dropped, and are read again if a new reader needs them.
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

    @property
    def doubts(self) -> dict[str, Doubt]:
        """Return the doubts about truths that are stated twice, at one stamp or by two topics."""
        found: dict[str, list[str]] = {}
        judging = {topic for topic, _ in self._reached} | self._forgotten
        for (topic, other), apart in self._apart.items():
            if topic not in judging or not apart:
                continue
            name = max(apart, key=apart.__getitem__)
            if topic != other:
                what = f"{other} states the truth of the same object and is not used"
            elif apart[name]:
                what = "a truth is stated twice with the same stamp"
            else:
                continue
            found.setdefault(topic, []).append(f"{what}: {name} differs by up to {apart[name]:.3g}")
        topics = self.source.topics
        return {topic: Doubt(topics[topic].messages, "; ".join(why)) for topic, why in found.items()}

    def _note_twice(self, block: dict[str, Stream]) -> None:
        """Record the differences between truths of one object in a block, by linear component."""
        for topic, stream in block.items():
            again = np.flatnonzero(stream.publish_time_ns[1:] == stream.publish_time_ns[:-1])
            if len(again):
                states = _states(stream).items()
                apart = {name: np.abs(np.diff(state)[again]) for name, state in states}
                self._note_apart(topic, topic, apart)
        for topic in {topic for topic, _ in self._reached} & block.keys():
            for other in self._beside[topic.rpartition("/")[0]]:
                if other != topic and other in block:
                    self._note_apart(topic, other, _apart(block[topic], block[other]))

    def _note_apart(self, topic: str, other: str, apart: dict[str, Floats]) -> None:
        kept = self._apart.setdefault((topic, other), {})
        for name, values in apart.items():
            kept[name] = max(kept.get(name, 0.0), float(np.fmax.reduce(values, initial=0.0)))

    def _read_block(self, blocks: Iterator[dict[str, Stream]]) -> None:
        block = next(blocks, None)
        if block is None:
            self._blocks = None
            return
        self._note_twice(block)
        for topic, stream in block.items():
            kept = self._current(topic)
            self._parts[topic] = concatenate([kept, stream]) if len(kept) else stream
            self._read_to_ns = max(self._read_to_ns, int(stream.publish_time_ns[-1]))

    def _current(self, topic: str) -> Stream:
        """Return the stored messages of a topic, from the first that a reader may still need."""
        held = self._parts[topic]
        readers = [at_ns for (of, _), at_ns in self._reached.items() if of == topic]
        passed_ns = min(readers or self._reached.values(), default=-1)
        first = int(np.searchsorted(held.publish_time_ns, passed_ns, side="right")) - 1
        if first <= 0:
            return held
        self._forgotten.add(topic)
        return held.take(slice(first, None))


def _states(truth: Stream) -> dict[str, Floats]:
    """Return the linear components (n,) of a truth by name."""
    names = truth.components
    kinds = truth.metadata.get("kinds", "").split(",") if truth.metadata.get("kinds") else []
    columns = truth["state"].reshape(len(truth), -1).T
    named = zip(names, columns, kinds or ["linear"] * len(names), strict=False)
    return {name: column for name, column, kind in named if kind == "linear"}


def _apart(truth: Stream, other: Stream) -> dict[str, Floats]:
    """Compute differences of two truths by component, at stamps of the first that the second spans."""
    time_ns, there_ns = truth.publish_time_ns, other.publish_time_ns
    both = (time_ns >= there_ns[0]) & (time_ns <= there_ns[-1])
    own, others = _states(truth), _states(other)
    return {
        name: np.abs(own[name] - np.interp(time_ns, there_ns, others[name]))[both]
        for name in own
        if name in others
    }
