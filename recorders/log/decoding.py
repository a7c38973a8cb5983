"""Decoding of opened regions into the columns of one topic.

The layout of messages is checked before it is used. The fast path reads all messages of a region
together in fuselog's fixed layout, if every constant byte of every message matches (`Layout.parse`). On
the slow path, the protobuf library reads the messages one by one, so logs of other writers are read
slowly but correctly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from google.protobuf.message import DecodeError, Message
from mcap import records
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.container.chunks import Contents
from fuselog.recorders.log.layout import RECORD_HEAD, Layout, columns_of, layout_of, windows
from fuselog.recorders.log.loops import HEAD_BYTES
from fuselog.recorders.log.opening import Log
from fuselog.recorders.log.schemas import PROTOBUF_TYPES, SCHEMAS, Field, message_class, schema_of
from fuselog.recorders.log.streams import Stream, empty_stream

_Decoded = tuple[NDArray[np.int64], NDArray[np.int64], dict[str, NDArray]]


class Decoder:
    """A decoder of one topic of a log, region by region, which threads may share.

    Raises BadInput if the topic is unknown, or its messages are not protobuf with numeric fields.
    """

    def __init__(self, log: Log, topic: str) -> None:
        self._topic = log.require(topic)
        self._where = f"{log.path}: topic {topic}"
        description = self._description(log)
        try:
            self._message_class = message_class(description.data, description.name)
        except (DecodeError, KeyError, TypeError) as error:
            raise BadInput(
                f"{self._where}: the description of {description.name} is damaged ({error})"
            ) from error
        descriptor = self._message_class.DESCRIPTOR
        self.schema = schema_of(self._message_class)
        self._check_fields()
        self._is_fixed = [(entry.number, entry.type) for entry in descriptor.fields] == [
            (number, PROTOBUF_TYPES[entry.kind]) for number, entry in enumerate(self.schema, start=1)
        ]
        self._layout: Layout | None = None

    def _description(self, log: Log) -> records.Schema:
        """Return the file's description of the messages; all channels of the topic must agree."""
        described = []
        for identifier in self._topic.channel_ids:
            channel = log.container.channels[identifier]
            schema = log.container.schemas.get(channel.schema_id)
            described.append((channel.message_encoding, schema and replace(schema, id=0)))
        encoding, schema = described[0]
        if any(other != described[0] for other in described):
            raise BadInput(f"{self._where} has channels of different schemas; give each its own topic")
        if schema is None or schema.encoding != "protobuf" or encoding != "protobuf":
            raise BadInput(
                f"{self._where} is {schema.name if schema else 'without a schema'} in the encoding "
                f"'{encoding}'; fuselog replays protobuf messages with numeric fields: "
                "import other logs first, such as those of ROS with: fuselog import ros PATH"
            )
        return schema

    def _check_fields(self) -> None:
        """Require that a message with a fuselog message's name has its fields, except newer ones."""
        kinds = {entry.name: entry.kind for entry in self.schema}
        expected = SCHEMAS.get(self.schema.full_name, self.schema)
        wrong = [
            entry.name
            for entry in expected
            if kinds.get(entry.name, entry.kind if entry.may_be_absent else None) != entry.kind
        ]
        if wrong or not kinds:
            raise BadInput(
                f"{self._where}: this {self.schema.full_name} has no numeric field "
                f"{', '.join(wrong) or 'at all'}; it was written with another schema; "
                "record or import it again"
            )

    def empty(self) -> Stream:
        """Return the topic without messages."""
        return empty_stream(self._topic.name, self.schema, self._topic.metadata)

    def decode(self, contents: Contents, rank: int) -> list[Stream]:
        """Decode the topic's messages in region number `rank` of the file, by channel.

        Raises BadInput if a message cannot be decoded, or its fields do not form columns.
        """
        return [
            self._stream(contents.data, contents.messages[identifier], rank)
            for identifier in self._topic.channel_ids
            if identifier in contents.messages
        ]

    def _stream(self, data: NDArray[np.uint8], offsets: NDArray[np.int64], rank: int) -> Stream:
        found = self._at_once(data, offsets) or self._one_by_one(data, offsets)
        log_time_ns, publish_time_ns, columns = found
        return Stream(
            self._topic.name,
            self.schema,
            publish_time_ns,
            log_time_ns,
            columns,
            (rank << 32) + offsets,
            self._topic.metadata,
        )

    def _at_once(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> _Decoded | None:
        """Read clocks and columns by the fixed layout; return None if a message has another layout."""
        if not self._is_fixed:
            return None
        if self._layout is None:
            (first,) = self._messages(data, offsets[:1])
            vectors = [entry.name for entry in self.schema if entry.kind == "vector"]
            self._layout = layout_of(self.schema, {name: len(getattr(first, name)) for name in vectors})
        found = self._layout.parse(data, offsets)
        return None if found is None else (*_clocks(found), columns_of(self.schema, found))

    def _one_by_one(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> _Decoded:
        """Read clocks and columns with the protobuf library, for any order and presence of fields."""
        messages = self._messages(data, offsets)
        columns = {entry.name: self._column(entry, messages) for entry in self.schema}
        return *_clocks(_heads(data, offsets)), columns

    def _messages(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> list[Message]:
        ends = offsets + HEAD_BYTES + _heads(data, offsets)["mcap length"].astype(np.int64)
        begins = offsets + RECORD_HEAD.itemsize
        try:
            return [
                self._message_class.FromString(data[begin:end].tobytes())
                for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)
            ]
        except DecodeError as error:
            raise BadInput(
                f"{self._where}: a message cannot be read as {self.schema.full_name} ({error}); "
                "leave the topic out, or write the log again"
            ) from error

    def _column(self, entry: Field, messages: Sequence[Message]) -> NDArray:
        values = [getattr(message, entry.name) for message in messages]
        if entry.kind == "vector":
            widths = {len(value) for value in values}
            if len(widths) > 1:
                raise BadInput(
                    f"{self._where}: field {entry.name} has vectors of different lengths "
                    f"{sorted(widths)}; a stream has one length, so split the topic"
                )
            return np.array([list(value) for value in values], entry.dtype)
        column = np.array(values, entry.dtype)
        if not self._message_class.DESCRIPTOR.fields_by_name[entry.name].has_presence:
            return column
        absent = np.array([not message.HasField(entry.name) for message in messages])
        if entry.kind == "real":
            return np.where(absent, np.nan, column)
        if absent.any():
            raise BadInput(
                f"{self._where}: field {entry.name} is absent from {int(absent.sum())} messages; "
                "write every field"
            )
        return column


def _heads(data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> NDArray[np.void]:
    return windows(data, RECORD_HEAD.itemsize)[offsets].view(RECORD_HEAD)


def _clocks(records: NDArray[np.void]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Copy log times and publish times from message records or their heads."""
    return records["mcap log_time"].copy(), records["mcap publish_time"].copy()
