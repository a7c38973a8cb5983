"""Writer of streams as a log, in whole chunks; an interrupted log leaves no partial file."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.container.packing import chunks_of
from fuselog.recorders.log.container.writing import ContainerWriter
from fuselog.recorders.log.layout import layout_of
from fuselog.recorders.log.mirrors import (
    MIRROR_OF,
    Mirror,
    Numbered,
    chunks_of_mirrors,
    descriptor_set,
)
from fuselog.recorders.log.run import RECORD_NAME, RunMetadata
from fuselog.recorders.log.schemas import Schema
from fuselog.recorders.log.streams import Stream, check_stream

Mirrors = Callable[[Stream], Iterable[Mirror]]


@dataclass
class _Topic:
    """The state of a topic between blocks, with its number of messages so far."""

    channel_id: int
    schema: Schema
    metadata: dict[str, str]
    widths: dict[str, int]
    messages: int = 0


@dataclass
class _Channel:
    """The channel of a Foxglove mirror, and its number of messages so far."""

    channel_id: int
    messages: int = 0


class LogWriter:
    """A writer of one log; use it as a context manager, and the log appears completely or not at all.

    Args:
        path: log to write; an existing file is replaced at the end, in one step.
        run: metadata of the run; if it is known only at the end, use `describe`.
        compression: "zstd", "lz4" or "none".
        chunk_bytes: approximate size of an uncompressed chunk.
        mirrors: function that makes the messages for viewers that are written next to each stream.

    Raises BadInput if the file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        run: RunMetadata | None = None,
        *,
        compression: str = "zstd",
        chunk_bytes: int = 1 << 20,
        mirrors: Mirrors | None = None,
    ) -> None:
        self.path = Path(path)
        self._container = ContainerWriter(self.path, compression)
        self._run = None if run is None else run.to_record()
        self._chunk_bytes = chunk_bytes
        self._topics: dict[str, _Topic] = {}
        self._mirrors = mirrors
        self._channels: dict[str, _Channel] = {}

    def __enter__(self) -> Self:
        self._container.__enter__()
        if self._run is not None:
            self._container.add_metadata(RECORD_NAME, self._run)
        return self

    def __exit__(self, *raised: Any) -> None:
        self._container.__exit__(*raised)

    def describe(self, run: RunMetadata) -> None:
        """Write the metadata of the run, once."""
        self._container.add_metadata(RECORD_NAME, run.to_record())

    def write(self, streams: Iterable[Stream]) -> None:
        """Write a block of streams, merged in log-time order; ties keep the order given.

        The block is in the file when the call returns, so only one block is in memory, and a truncated
        file contains the earlier blocks.

        Raises BadInput if a stream violates its schema (see `check_stream`), a topic occurs twice, or a
        topic changes its schema, the widths of its vectors or its metadata between blocks.
        """
        block = list(streams)
        names = [stream.topic for stream in block]
        if len(set(names)) < len(names):
            raise BadInput(
                f"{self.path}: a topic is given twice among {', '.join(names)}; join its streams"
            )
        for stream in block:
            check_stream(stream, f"{self.path}: ")
            self._declare(stream)
        parts = []
        for stream in block:
            if len(stream):
                topic = self._topics[stream.topic]
                layout = layout_of(stream.schema, topic.widths)
                parts.append(layout.build(_in_log_time_order(stream), topic.channel_id, topic.messages))
                topic.messages += len(stream)
        if parts:
            self._container.add_chunks(list(chunks_of(parts, self._chunk_bytes)))
        if self._mirrors is not None:
            self.write_mirrors(each for stream in block for each in self._mirrors(stream))

    def write_mirrors(self, mirrors: Iterable[Mirror]) -> int:
        """Write messages for viewers, in log-time order; return their number."""
        numbered = []
        for mirror in mirrors:
            channel = self._channels.get(mirror.topic)
            if channel is None:
                description = descriptor_set(mirror.message)
                schema_id = self._container.add_schema(mirror.message.DESCRIPTOR.full_name, description)
                stated = {MIRROR_OF: mirror.of}
                channel = _Channel(self._container.add_channel(mirror.topic, schema_id, stated))
                self._channels[mirror.topic] = channel
            numbered.append(Numbered(channel.channel_id, channel.messages, mirror))
            channel.messages += 1
        self._container.add_chunks(list(chunks_of_mirrors(numbered, self._chunk_bytes)))
        return len(numbered)

    def _declare(self, stream: Stream) -> None:
        """Register the stream's topic, or compare it with the registered one."""
        widths = {
            entry.name: stream.columns[entry.name].shape[1]
            for entry in stream.schema
            if entry.kind == "vector"
        }
        metadata = dict(stream.metadata)
        topic = self._topics.get(stream.topic)
        if topic is None:
            schema_id = self._container.add_schema(stream.schema.full_name, stream.schema.descriptor_set)
            channel_id = self._container.add_channel(stream.topic, schema_id, metadata)
            topic = _Topic(channel_id, stream.schema, metadata, widths)
            self._topics[stream.topic] = topic
        if topic.schema.descriptor_set != stream.schema.descriptor_set:
            raise BadInput(
                f"{self.path}: topic {stream.topic} already has {topic.schema.full_name}, so it cannot "
                f"take {stream.schema.full_name}; use another topic"
            )
        if topic.metadata != metadata:
            raise BadInput(
                f"{self.path}: topic {stream.topic} changes its metadata between blocks; give every "
                "block the same metadata"
            )
        if topic.messages == 0:
            topic.widths = widths
        elif len(stream) and topic.widths != widths:
            raise BadInput(
                f"{self.path}: topic {stream.topic} has vectors of widths {topic.widths}, so it cannot "
                f"take {widths}; a stream has one width, so use another topic"
            )


def write_log(
    path: str | Path,
    streams: Iterable[Stream],
    run: RunMetadata | None = None,
    *,
    compression: str = "zstd",
    mirrors: Mirrors | None = None,
) -> None:
    """Write one log from streams in memory; see `LogWriter`.

    >>> from fuselog.recorders.log import make_stream, open_log, read_streams, schemas
    >>> seen = make_stream("/range", schemas.RANGE, [0, 10], target_id=[1, 2], range_m=[5, 3])
    >>> write_log("run.mcap", [seen])
    >>> read_streams(open_log("run.mcap"), ["/range"])["/range"]["range_m"].tolist()
    [5.0, 3.0]
    """
    with LogWriter(path, run, compression=compression, mirrors=mirrors) as log:
        log.write(streams)


def _in_log_time_order(stream: Stream) -> Stream:
    if np.all(stream.log_time_ns[1:] >= stream.log_time_ns[:-1]):
        return stream
    return stream.take(np.argsort(stream.log_time_ns, kind="stable"))
