"""Counts of an estimator's measurements by outcome: used, gated, skipped, or without effect.

The counts are computed from the inputs and outputs of any estimator: its messages by topic, its
innovations, and the messages that it reports as skipped.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from fuselog.recorders.log import Clock, Stream, schemas
from fuselog.replay.engine.arrays import AnyArray
from fuselog.replay.engine.replaying.attribution import Attribution
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows
from fuselog.replay.engine.streams.failures import sentences_of

# Messages that drive a motion are not measurements and have no innovations.
CONTROLS = {schemas.ODOMETRY.full_name, schemas.INERTIAL_SAMPLE.full_name}
INNOVATION, SKIPPED = schemas.INNOVATION.full_name, schemas.SKIPPED.full_name
UNTAKEN = "the estimator does not use this topic"
SILENT, EARLY = "they gave no innovation", "come before the prior"
LANDMARK, TRUTH = schemas.LANDMARK.full_name, schemas.TRUTH_STATE.full_name
PRIOR = schemas.GAUSSIAN_ESTIMATE.full_name


class Row(NamedTuple):
    """Row of the table `coverage`.

    Attributes:
        estimator: its label.
        topic: topic of the measurements, or several topics if innovations cannot be assigned to a single
            topic.
        messages: number of messages.
        used, gated: numbers of accepted and of rejected innovations, or None if the estimator has no
            innovations.
        skipped: number of messages that the estimator reports as skipped.
        why: reasons for unused messages, in words.
    """

    estimator: str
    topic: str
    messages: int
    used: int | None
    gated: int | None
    skipped: int
    why: str

    @property
    def unused(self) -> int:
        """Return the number of messages without an innovation."""
        return 0 if self.used is None else self.messages - self.used - (self.gated or 0)

    @property
    def sentence(self) -> str:
        """Return a sentence about unused messages or a doubtful topic; "" if no sentence is needed."""
        if self.unused > self.skipped or (self.unused > 0 and not self.used):
            share = f"{self.unused} of {self.messages}"
            return f"{self.estimator}: {self.topic}: {share} not used: {self.why}"
        return f"{self.estimator}: {self.topic}: {self.why}" if self.why and not self.skipped else ""


@dataclass
class Usage:
    """Counts of how the measurements of one bound estimator were used, over all runs.

    Attributes:
        name: name of the bound estimator.
        given: number of messages by topic.
        measured: the topics of measurements among the topics of `given`.
        facts: by topic, the number of messages to which each description applies.
        used, gated: numbers of accepted and rejected innovations.
        skipped: number of skipped messages, by reason.
        speaks: whether the estimator has innovations.
        doubtful: sentences about problems with topics that the estimator starts from, by topic.
        shares: counts of innovations by topic.
        begins_ns: (runs,) the stamp of the first prior, or None if there are no priors.
    """

    name: str
    given: Counter[str] = field(default_factory=Counter)
    measured: set[str] = field(default_factory=set)
    facts: dict[str, Counter[str]] = field(default_factory=dict)
    used: int = 0
    gated: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    speaks: bool = False
    doubtful: dict[str, str] = field(default_factory=dict)
    shares: Attribution = field(default_factory=Attribution)
    begins_ns: AnyArray | None = None

    def note_start(self, static: Mapping[str, Ragged]) -> None:
        """Check and count the streams that the estimator starts from."""
        for topic, ragged in static.items():
            if ragged.stream.schema.full_name == PRIOR:
                there = np.diff(ragged.offsets) > 0
                begins_ns = np.zeros(ragged.runs, np.int64)
                begins_ns[there] = ragged.stream.publish_time_ns[ragged.offsets[:-1][there]]
                before = begins_ns if self.begins_ns is None else self.begins_ns
                self.begins_ns = np.minimum(before, begins_ns)
            if ragged.stream.schema.full_name == LANDMARK:
                self.given[topic] += len(ragged)
                self._note_maps(topic, ragged)

    def _note_maps(self, topic: str, ragged: Ragged) -> None:
        """Find the last run whose map states two positions for a landmark, and record the landmark."""
        run, number = run_of_rows(ragged.offsets), ragged["landmark_id"]
        order = np.lexsort((number, run))
        run, number, place = run[order], number[order], ragged["position_m"][order]
        is_same = (np.diff(run) == 0) & (np.diff(number) == 0)
        apart_m = np.where(is_same, np.linalg.norm(np.diff(place, axis=0), axis=1), 0.0)
        if apart_m.any():
            last = run[np.flatnonzero(apart_m)[-1]]
            worst = int(np.argmax(np.where(run[:-1] == last, apart_m, 0.0)))
            self.doubtful[topic] = (
                f"landmark {number[worst]} is stated at two positions, {apart_m[worst]:.3g} m apart"
            )

    def note_given(
        self, streams: Mapping[str, Ragged], static: Mapping[str, Ragged], order: Clock = "publish_time"
    ) -> None:
        """Count the messages of a block, `streams`, in the order of the clock `order`.

        `static` are the streams that the estimator started from.
        """
        sensed = {
            topic: ragged
            for topic, ragged in streams.items()
            if ragged.stream.schema.full_name not in CONTROLS
        }
        if len(sensed) > 1:
            self.shares.note_given(sensed, order)
        for topic, ragged in streams.items():
            stream = ragged.stream
            self.given[topic] += len(stream)
            if stream.schema.full_name in CONTROLS:
                continue
            self.measured.add(topic)
            facts = self.facts.setdefault(topic, Counter())
            if self.begins_ns is not None:
                begins_ns = np.repeat(self.begins_ns, np.diff(ragged.offsets))
                facts[EARLY] += int(np.count_nonzero(stream.times(order) < begins_ns))
            repeated = ragged.findings.once("repeated", partial(_repeated, stream))
            facts["repeat the previous message"] += repeated
            maps = [each.stream for each in static.values() if each.stream.schema.full_name == LANDMARK]
            if maps and "target_id" in stream.columns:
                known = np.unique(np.concatenate([each["landmark_id"] for each in maps]))
                key, find = ("unknown", known.tobytes()), partial(_unknown, stream, known)
                facts["measure targets that are not in the map"] += ragged.findings.once(key, find)

    def note_outputs(self, outputs: Sequence[Ragged]) -> None:
        """Count a block of the estimator's `outputs`."""
        for each in outputs:
            stream = each.stream
            if stream.schema.full_name == INNOVATION:
                accepted = int(np.count_nonzero(stream["accepted"]))
                self.used += accepted
                self.gated += len(stream) - accepted
                self.speaks = True
                if len(self.measured) > 1:
                    self.shares.note_innovations(each)
            elif stream.schema.full_name == SKIPPED and len(stream):
                self.skipped.update(sentences_of(stream))

    def merge(self, other: "Usage") -> None:
        """Add the counts of other runs."""
        self.given.update(other.given)
        self.measured |= other.measured
        for topic, facts in other.facts.items():
            self.facts.setdefault(topic, Counter()).update(facts)
        self.used += other.used
        self.gated += other.gated
        self.skipped.update(other.skipped)
        self.speaks |= other.speaks
        self.doubtful = other.doubtful | self.doubtful
        self.shares.merge(other.shares)

    def rows(self) -> Iterator[Row]:
        """Yield a row for each topic, or one for all topics if their innovations cannot be separated."""
        label, topics = self.name.partition("/")[0], sorted(self.measured)
        for topic, why in self.doubtful.items():
            yield Row(label, topic, self.given[topic], None, None, 0, why)
        for group in [[topic] for topic in topics] if self._is_by_topic else [topics]:
            skipped = {
                why: count
                for why, count in self.skipped.items()
                if len(group) == len(topics) or _topic_in(why, group)
            }
            reasons = [f"{count} skipped: {why}" for why, count in skipped.items()]
            messages = sum(self.given[topic] for topic in group)
            row = Row(label, " + ".join(group), messages, None, None, sum(skipped.values()), "")
            if self.speaks:
                row = row._replace(used=self.used, gated=self.gated)
            if self.speaks and len(group) < len(topics):
                row = row._replace(used=self.shares.used[group[0]], gated=self.shares.gated[group[0]])
            facts = [
                f"{count} {fact}" if len(group) == 1 else f"{count} of {topic} {fact}"
                for topic in group
                for fact, count in self.facts[topic].items()
                if count and (fact != EARLY or row.unused > 0)  # a tracker may use these messages too
            ]
            if row.unused > 0 and not facts and not reasons:
                reasons = [SILENT]
            yield row._replace(why="; ".join([*reasons, *facts]))

    @property
    def _is_by_topic(self) -> bool:
        """Test whether the outcome of every topic's measurements is known."""
        named = all(_topic_in(why, self.measured) for why in self.skipped)
        return not self.measured or (named and (self.shares.is_known or not self.speaks))


def _topic_in(why: str, topics: Iterable[str]) -> bool:
    """Test whether a reason begins with one of these topics."""
    return any(why.startswith(f"topic {topic}:") for topic in topics)


def _repeated(stream: Stream) -> int:
    """Count the messages that equal the one before them in all fields; NaN equals NaN."""
    same = np.diff(stream.publish_time_ns) == 0
    for column in stream.columns.values() if same.any() else ():
        flat = column.reshape(len(column), -1)
        equal = flat[1:] == flat[:-1]
        if column.dtype.kind == "f":
            equal |= np.isnan(flat[1:]) & np.isnan(flat[:-1])
        same &= equal.all(axis=1)
    return int(np.count_nonzero(same))


def _unknown(stream: Stream, known: AnyArray) -> int:
    """Count the messages that measure a target without one of the numbers `known` (m,)."""
    return int(np.count_nonzero(~np.isin(stream["target_id"], known)))
