"""Runs with altered topics, such as `--set /fix.delay_s=0.3`; the log files are not changed.

A log is altered block by block. A topic whose stamps change is read separately and merged with the
others by its new stamps. Memory holds only one block of each topic, even if the stamps change by hours.
"""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, overload

import numpy as np

from fuselog.pipeline.altering.changes import Change, by_topic, changes_of, is_of_topic
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream, Topic, schemas
from fuselog.recorders.log.planes import LATITUDE, Origin, frame_of, is_planar, stated_in
from fuselog.recorders.parsing import parse_json
from fuselog.replay.engine.streams.planes import into_plane_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source

NOTE = "alterations"  # key in the metadata of an estimates log
Settings = Mapping[str, Any]


@overload
def alter(source: LogSource, settings: Settings) -> LogSource: ...
@overload
def alter(source: MemorySource, settings: Settings) -> MemorySource: ...
@overload
def alter(source: LogSource | MemorySource, settings: Settings) -> LogSource | MemorySource: ...
def alter(source: LogSource | MemorySource, settings: Settings) -> LogSource | MemorySource:
    """Alter the topics of a run, in addition to the alterations that it already has.

    Topics in different tangent planes are converted to one plane; see `in_one_plane`.

    Args:
        source: the run.
        settings: values by `/TOPIC.WHAT`, such as `{"/fix.delay_s": 0.3}`; see `changes_of`.

    Raises BadInput if the topic or field does not exist, or if a value is invalid.
    """
    if not settings and not in_one_plane(source.name, source.topics, {}):
        return source
    made: AlteredLog | AlteredRecording
    if isinstance(source, AlteredRecording):
        made = _altered(source.before, {**source.alterations, **settings})
    elif isinstance(source, MemorySource):
        made = _altered(source, settings)
    else:
        of_log = source.alterations if isinstance(source, AlteredLog) else {}
        made = AlteredLog(source.log, source.start_ns, source.end_ns, {**of_log, **settings})
    for topic, (lost, count) in made.left_out.items():
        if lost == count:
            raise BadInput(
                f"{source.name}: all {count} messages of {topic} would be before 1970; set a smaller "
                f"{topic}.delay_s or clock_gain"
            )
    return made


def alter_all(
    sources: Iterable[LogSource | MemorySource], settings: Settings
) -> list[LogSource | MemorySource]:
    """Alter the topics of runs, and log how many messages are omitted because they would be before 1970.

    Raises BadInput in the same cases as `alter`.
    """
    made = [alter(source, settings) for source in sources]
    for source in made:
        if settings and isinstance(source, AlteredLog | AlteredRecording):
            for topic, (lost, count) in source.left_out.items():
                logging.getLogger("fuselog").warning(
                    f"{source.name}: {lost} of {count} messages of {topic} would be before 1970 and "
                    "are left out"
                )
    return made


def _before_1970(
    stored: LogSource | MemorySource, changes: Mapping[str, Change]
) -> dict[str, tuple[int, int]]:
    """Count, by topic, the messages that changes move to before 1970, and all messages."""
    found = {}
    for topic, change in changes.items():
        if change.is_moving and change.moved(np.array(stored.extent("publish_time")))[0] < 0:
            stamps_ns = stored.read([change.stored])[change.stored].publish_time_ns
            lost = int(np.count_nonzero(change.moved(stamps_ns) < 0))
            if lost:
                found[topic] = lost, len(stamps_ns)
    return found


def alterations_of(source: Source) -> dict[str, Any]:
    """Return the alterations of a run, by `/TOPIC.WHAT`."""
    return dict(source.alterations) if isinstance(source, AlteredLog | AlteredRecording) else {}


def note_of(source: Source) -> dict[str, str]:
    """Return a run's alterations as metadata of an estimates log, or {} if the run is not altered."""
    return {name: json.dumps(applied) for name, applied in setting_of(source).items()}


def setting_of(source: Source) -> dict[str, dict[str, Any]]:
    """Return a run's alterations as a setting of a result, or {} if the run is not altered."""
    applied = alterations_of(source)
    return {NOTE: applied} if applied else {}


def stated_alterations(estimates: Source) -> dict[str, Any]:
    """Read from an estimates log how its run was altered; raise BadInput if the entry is unreadable."""
    notes = estimates.run.notes if estimates.run else {}
    try:
        stated = parse_json(notes.get(NOTE, "{}"))
    except ValueError:
        stated = None
    if not isinstance(stated, dict):
        raise BadInput(
            f"{estimates.name}: its metadata has no readable alterations; replay the log again"
        )
    return stated


def split_settings(settings: Settings) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split settings into alterations of topics, and parameters of estimators and of topics.

    >>> split_settings({"/fix.delay_s": 0.3, "gate_probability": 1, "/fix.lever_x_m": 0.4})
    ({'/fix.delay_s': 0.3}, {'gate_probability': 1, '/fix': {'lever_x_m': 0.4}})
    """
    others = by_topic(settings)
    altering = {
        key: value
        for key, value in others.items()
        if is_of_topic(key) and not isinstance(value, Mapping)
    }
    return altering, {key: value for key, value in others.items() if key not in altering}


@dataclass(frozen=True, repr=False)
class AlteredRecording(MemorySource):
    """A recording in memory whose streams are altered; `before` is the unaltered recording."""

    before: MemorySource = field(kw_only=True)
    alterations: Settings = field(kw_only=True)
    changes: Mapping[str, Change] = field(kw_only=True)

    @cached_property
    def left_out(self) -> dict[str, tuple[int, int]]:
        """Count, by topic, the messages that would be before 1970, and all messages."""
        return _before_1970(self.before, self.changes)


def _altered(source: MemorySource, settings: Settings) -> AlteredRecording:
    changes = in_one_plane(source.name, source.topics, changes_of(source, settings))
    streams = {
        topic: changes[topic].altered(source.streams[changes[topic].stored]) if topic in changes else own
        for topic, own in source.streams.items()
    }
    return AlteredRecording(
        streams,
        source.run,
        source.name,
        source.start_ns,
        source.end_ns,
        before=source,
        alterations=settings,
        changes=changes,
    )


@dataclass(frozen=True, repr=False)
class AlteredLog(LogSource):
    """A log file whose topics are altered as they are read."""

    alterations: Settings = field(default_factory=dict)

    @cached_property
    def changes(self) -> dict[str, Change]:
        """Return the changes of topics."""
        changes = changes_of(LogSource(self.log), self.alterations)
        return in_one_plane(self.name, self.log.topics, changes)

    @cached_property
    def left_out(self) -> dict[str, tuple[int, int]]:
        """Count, by topic, the messages that would be before 1970, and all messages."""
        return _before_1970(LogSource(self.log), self.changes)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Return the log's topics as altered."""
        of_log = self.log.topics
        return {
            name: self.changes[name].stated(of_log[self.changes[name].stored])
            if name in self.changes
            else own
            for name, own in of_log.items()
        }

    def extent(self, clock: Clock) -> tuple[int, int]:
        """Return a span in ns that contains all stamps of a clock, before and after the alteration."""
        ends = np.array(super().extent(clock))
        moved = [ends, *(each.moved(ends) for each in self.changes.values() if clock == "publish_time")]
        return max(0, int(np.min(moved))), int(np.max(moved))

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Read whole topics in publish-time order, regardless of the source's span."""
        return self._altered(super().read([self._stored(topic) for topic in topics]), topics)

    def empty(self, topic: str) -> Stream:
        """Return the topic without its messages."""
        stream = super().empty(self._stored(topic))
        return replace(stream, topic=topic, metadata=self.topics[topic].metadata)

    def whole(self) -> "AlteredLog":
        """Return the source over the whole run."""
        return replace(self, start_ns=None, end_ns=None)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield blocks of the source's span, which refers to the altered stamps."""
        moving = [
            topic
            for topic in dict.fromkeys(topics)
            if order == "publish_time" and topic in self.changes and self.changes[topic].is_moving
        ]
        others = [topic for topic in topics if topic not in moving]
        parts = [self._moved_blocks(topic, block_messages) for topic in moving]
        if others:
            stored = super().blocks([self._stored(topic) for topic in others], order, block_messages)
            parts.append(self._altered(block, others) for block in stored)
        return parts[0] if len(parts) == 1 else in_turn(parts, order)

    def _stored(self, topic: str) -> str:
        return self.changes[topic].stored if topic in self.changes else topic

    def _altered(self, block: Mapping[str, Stream], topics: Sequence[str]) -> dict[str, Stream]:
        found = {}
        for topic in topics:
            stream = block.get(self._stored(topic))
            if stream is not None:
                found[topic] = self.changes[topic].altered(stream) if topic in self.changes else stream
        return found

    def _moved_blocks(self, topic: str, block_messages: int) -> Iterator[dict[str, Stream]]:
        """Yield blocks of a topic whose stamps change."""
        change = self.changes[topic]
        start_ns, end_ns = (
            None if at_ns is None else max(0, change.before(at_ns) + slack_ns)
            for at_ns, slack_ns in ((self.start_ns, -1), (self.end_ns, 1))  # allows for rounding
        )
        log = LogSource(self.log, start_ns, end_ns, rejections=self.rejections, is_raw=self.is_raw)
        for block in log.blocks([change.stored], "publish_time", block_messages):
            stream = change.altered(block[change.stored])
            is_in = np.ones(len(stream), bool)
            if self.start_ns is not None:
                is_in &= stream.publish_time_ns >= self.start_ns
            if self.end_ns is not None:
                is_in &= stream.publish_time_ns < self.end_ns
            if is_in.any():
                yield {topic: stream.take(is_in)}


def in_turn(parts: Iterable[Iterator[dict[str, Stream]]], order: Clock) -> Iterator[dict[str, Stream]]:
    """Merge the blocks of several topics, each ordered by time, into one ordered sequence.

    Messages are yielded only up to the time that every topic has reached.
    """
    running, waiting = dict(enumerate(parts)), dict[int, dict[str, Stream]]()
    while running or waiting:
        for number in [each for each in running if each not in waiting]:
            block = next(running[number], None)
            if block is None:
                del running[number]
            elif block:
                waiting[number] = block
        if any(number not in waiting for number in running):
            continue  # an empty block
        if not waiting:
            return
        limit_ns = min(
            max(int(stream.times(order)[-1]) for stream in block.values()) for block in waiting.values()
        )
        now: dict[str, Stream] = {}
        for number, block in list(waiting.items()):
            later: dict[str, Stream] = {}
            for topic, stream in block.items():
                cut = int(np.searchsorted(stream.times(order), limit_ns, side="right"))
                for rows, kept in ((slice(0, cut), now), (slice(cut, None), later)):
                    if len(part := stream.take(rows)):
                        kept[topic] = part
            if later:
                waiting[number] = later
            else:
                del waiting[number]
        yield now


def in_one_plane(
    name: str, topics: Mapping[str, Topic], changes: Mapping[str, Change]
) -> dict[str, Change]:
    """Extend the changes of topics so that all positions are in one local tangent plane.

    The single plane is the plane of the truth, in which errors are computed. Without truth, all
    positions are converted to the plane of the first topic.

    Args:
        name: the run's name.
        topics: the topics that are stored in the run.
        changes: other alterations, by topic, which are applied first.

    Raises BadInput if planes differ and a topic with positions does not state its local tangent plane.
    """
    stating = {
        topic: changes[topic].stated(topics[changes[topic].stored]) if topic in changes else own
        for topic, own in topics.items()
    }
    stated = {topic: stated_in(topic, own.metadata) for topic, own in stating.items()}
    origins = {topic: origin for topic, origin in stated.items() if origin is not None}
    if len(set(origins.values())) < 2:
        return dict(changes)
    truths = [each for each in origins if stating[each].schema_name == schemas.TRUTH_STATE.full_name]
    into = origins[[*truths, *origins][0]]
    for topic, own in stating.items():
        silent = LATITUDE not in own.metadata and not frame_of(own.metadata)
        if silent and is_planar(own.schema_name, own.metadata):
            first, other = (
                next(each for each, origin in origins.items() if (origin == into) is wanted)
                for wanted in (True, False)
            )
            raise BadInput(
                f"{name}: {topic} does not state the origin of its tangent plane, and {first} states "
                f"{into}, {other} {origins[other]}; set it, such as --set {topic}.plane="
                f"{into.latitude_deg:.9g},{into.longitude_deg:.9g},{into.altitude_m:.9g}"
            )
    made = dict(changes)
    for topic, origin in origins.items():
        if origin != into:
            before = changes.get(topic) or Change(topic, topic)
            made[topic] = replace(
                before,
                columns=(*before.columns, partial(_moved, origin, into)),
                metadata={**before.metadata, **into.metadata},
            )
    return made


def _moved(origin: Origin, into: Origin, stream: Stream) -> Stream:
    own = replace(stream, metadata={**stream.metadata, **origin.metadata})
    return into_plane_of(own, into)
