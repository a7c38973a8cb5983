"""Assignment of innovations to topics by their stamps, for estimators that use several topics.

Innovations do not state their topic. If several topics have messages with the same stamp, and the number
of innovations with this stamp equals the number of these messages, innovations and messages are matched
in the order of the file. The topics are counted together if the numbers of innovations and messages
differ, or if innovations have other stamps (an estimator may shift its messages by their delay).
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Clock
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows

Integers = NDArray[np.int64]
# If more messages than this wait for innovations, the oldest blocks are dropped, as at the end of a run.
MOST_WAITING = 1 << 18


class _Messages(NamedTuple):
    """Messages (n,): their run, stamp, position in the file and index of the topic."""

    run: Integers
    time_ns: Integers
    position: Integers
    topic: Integers


@dataclass
class Attribution:
    """Counts of the innovations of one estimator by topic.

    Attributes:
        used, gated: numbers of accepted and rejected innovations, by topic.
        is_known: whether every innovation could be assigned to one topic.
    """

    used: Counter[str] = field(default_factory=Counter)
    gated: Counter[str] = field(default_factory=Counter)
    is_known: bool = True
    _waiting: list[_Messages] = field(default_factory=list)
    _topics: list[str] = field(default_factory=list)

    def note_given(self, streams: Mapping[str, Ragged], order: Clock) -> None:
        """Add a block of measurements; all blocks have the same topics."""
        if not self.is_known or not streams:
            return
        self._topics = list(streams)
        parts = [
            _Messages(
                run_of_rows(ragged.offsets),
                ragged.stream.times(order),
                ragged.stream.position,
                np.full(len(ragged), number),
            )
            for number, ragged in enumerate(streams.values())
        ]
        self._waiting.append(_joined(parts))
        while sum(len(each.run) for each in self._waiting[1:]) > MOST_WAITING:
            self._waiting.pop(0)

    def note_innovations(self, innovations: Ragged) -> None:
        """Count a block of innovations."""
        if not self.is_known or not len(innovations):
            return
        there, run, time_ns = (
            _joined(self._waiting),
            run_of_rows(innovations.offsets),
            innovations.stream.publish_time_ns,
        )
        topic = _topic_of(there, run, time_ns)
        if topic is None:
            self.end(is_known=False)
            return
        accepted = innovations["accepted"] != 0
        for number, name in enumerate(self._topics):
            own = accepted[topic == number]
            self.used[name] += int(own.sum())
            self.gated[name] += int((~own).sum())
        reached_ns = np.full(innovations.runs, -1)
        np.maximum.at(reached_ns, run, time_ns)
        left = there.time_ns > reached_ns[there.run]
        self._waiting = [_Messages(*(column[left] for column in there))]

    def end(self, *, is_known: bool = True) -> None:
        """Discard the messages that still wait for innovations."""
        self.is_known &= is_known
        self._waiting.clear()

    def merge(self, other: "Attribution") -> None:
        """Add the counts of other runs."""
        self.used.update(other.used)
        self.gated.update(other.gated)
        self.is_known &= other.is_known


def _joined(parts: list[_Messages]) -> _Messages:
    if not parts:
        return _Messages(*(np.empty(0, np.int64) for _ in _Messages._fields))
    return _Messages(*map(np.concatenate, zip(*parts, strict=True)))


def _topic_of(there: _Messages, run: Integers, time_ns: Integers) -> Integers | None:
    """Return the topic index (n,) of each innovation, or None if a topic cannot be determined."""
    stamps, stamp = np.unique(np.concatenate([there.time_ns, time_ns]), return_inverse=True)
    of_run = np.concatenate([there.run, run]) * len(stamps) + stamp
    moments, moment = np.unique(of_run, return_inverse=True)
    of_message, of_innovation = moment[: len(there.run)], moment[len(there.run) :]
    messages, innovations = (
        np.bincount(each, minlength=len(moments)) for each in (of_message, of_innovation)
    )
    order = np.lexsort((there.position, of_message))
    begin = np.cumsum(messages) - messages
    topic = np.append(there.topic[order], -1)
    changes = np.flatnonzero(np.diff(topic[:-1]) * (np.diff(of_message[order]) == 0))
    are_several = np.zeros(len(moments), bool)
    are_several[of_message[order][changes]] = True
    if np.any((innovations > 0) & ((messages == 0) | (are_several & (messages != innovations)))):
        return None
    by_moment = np.argsort(of_innovation, kind="stable")
    before = (np.cumsum(innovations) - innovations)[of_innovation[by_moment]]
    place = np.empty(len(run), np.int64)
    place[by_moment] = np.arange(len(run)) - before
    found: Integers = topic[begin[of_innovation] + np.where(are_several[of_innovation], place, 0)]
    return found
