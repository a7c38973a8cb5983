"""Opened logs: their topics and missing parts."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mcap import records

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.container.reading import Container, open_container
from fuselog.recorders.log.mirrors import MIRROR_OF
from fuselog.recorders.log.run import RECORD_NAME, RunMetadata
from fuselog.recorders.log.schemas import Schema
from fuselog.recorders.remote.paths import located


@dataclass(frozen=True)
class Topic:
    """One topic, which several channels may share.

    Attributes:
        name, schema_name: names of the topic and of its messages' schema.
        encoding: encoding of the messages.
        channel_ids: numbers of its channels.
        metadata: metadata that all channels share.
        messages: number of messages.
    """

    name: str
    schema_name: str
    encoding: str
    channel_ids: tuple[int, ...]
    metadata: Mapping[str, str]
    messages: int


def topics_of(topics: Mapping[str, Topic], schema: Schema) -> list[str]:
    """Return the names of the topics whose messages have this schema, in the order of `topics`."""
    return [name for name, topic in topics.items() if topic.schema_name == schema.full_name]


@dataclass(frozen=True)
class Log:
    """An opened log: a description of its contents, without the messages."""

    path: Path
    container: Container

    @cached_property
    def run(self) -> RunMetadata | None:
        """Return the metadata of the run, or None if the log has none."""
        record = self.container.metadata.get(RECORD_NAME)
        return None if record is None else RunMetadata.from_record(record, self.path)

    @cached_property
    def topics(self) -> dict[str, Topic]:
        """Return the topics by name, sorted, without Foxglove mirrors."""
        return {name: topic for name, topic in self._all.items() if MIRROR_OF not in topic.metadata}

    @cached_property
    def mirrors(self) -> dict[str, Topic]:
        """Return the topics that are only for viewers, by name, sorted."""
        return {name: topic for name, topic in self._all.items() if MIRROR_OF in topic.metadata}

    @property
    def companions(self) -> dict[str, Topic]:
        """Return `mirrors`; the previous release used this name."""
        warnings.warn(
            "Log: 'companions' was renamed to 'mirrors'; the old name will be removed in the next "
            "release",
            FutureWarning,
            stacklevel=2,
        )
        return self.mirrors

    @cached_property
    def _all(self) -> dict[str, Topic]:
        grouped: dict[str, list[records.Channel]] = {}
        for channel in self.container.channels.values():
            grouped.setdefault(channel.topic, []).append(channel)
        return {name: self._topic(name, grouped[name]) for name in sorted(grouped)}

    def _topic(self, name: str, channels: list[records.Channel]) -> Topic:
        first, *others = channels
        schema = self.container.schemas.get(first.schema_id)
        return Topic(
            name,
            schema.name if schema else "",
            first.message_encoding,
            tuple(channel.id for channel in channels),
            {
                key: value
                for key, value in first.metadata.items()
                if all(other.metadata.get(key) == value for other in others)
            },
            sum(self.container.message_counts[channel.id] for channel in channels),
        )

    def require(self, topic: str) -> Topic:
        """Return the topic of this name; raise BadInput with the available names if there is none."""
        if topic not in self.topics:
            raise BadInput(
                f"{self.path}: no topic {topic}; it has {', '.join(self.topics) or 'no topics'}"
            )
        return self.topics[topic]

    @property
    def loss_statement(self) -> str | None:
        """Return a sentence on what is missing from a recovered log; None if nothing is missing."""
        parts = [self._lost_messages(), _listed(self.container.damages, "damages")]
        stated = ": ".join(filter(None, parts))
        return f"{self.path}: {stated}" if stated else None

    def _lost_messages(self) -> str:
        """Describe the messages that are missing according to a summary; empty if there are none."""
        stated = {
            topic.name: sum(self.container.stated_counts[key] for key in topic.channel_ids)
            for topic in self._all.values()
        }
        lost = {name: count - self._all[name].messages for name, count in stated.items()}
        parts = [f"{lost[name]} of {stated[name]} of {name}" for name in lost if lost[name] > 0]
        return f"messages are left out, {_listed(parts, 'topics')}" if parts else ""


def open_log(path: str | Path, *, recover: bool = False) -> Log:
    """Open a log.

    Args:
        path: an MCAP file, or its URL.
        recover: whether to read only the intact part of a truncated or damaged file; its index is then
            not used.

    Raises BadInput if the file is missing or not MCAP, or is incomplete and `recover` is False.

    >>> from fuselog.recorders.log import write_log
    >>> from fuselog.recorders.recording import record_run
    >>> recording, run = record_run("landmarks", {"duration_s": 2.0}, seed=7)
    >>> write_log("run.mcap", recording.streams, run)
    >>> log = open_log("run.mcap")
    >>> log.run.scenario, log.run.seed
    ('landmarks', 7)
    >>> log.topics["/robot1/odometry"].messages
    40
    """
    place = located(path)
    log = Log(place, open_container(place, use_index=not recover))
    if log.loss_statement and not recover:
        count = len(log.container.regions)
        raise BadInput(
            f"{log.loss_statement}; {count} intact {'chunk is' if count == 1 else 'chunks are'} "
            "readable with --recover"
        )
    return log


def _listed(parts: Sequence[str], what: str) -> str:
    """Join the first few entries in one sentence."""
    more = f", and {len(parts) - 3} more {what}" if len(parts) > 3 else ""
    return f"{', '.join(parts[:3])}{more}"
