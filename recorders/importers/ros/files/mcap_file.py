"""Reader of MCAP files from ROS, a chunk at a time, based on `fuselog.recorders.log.container`."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from mcap import records
from rosbags.interfaces import MessageDefinition
from rosbags.typesys.msg import normalize_msgtype

from fuselog.recorders.importers.ros.files.raw import FORMATS, UNDEFINED, Batch, Connection, words
from fuselog.recorders.log.container.ahead import ahead
from fuselog.recorders.log.container.chunks import Contents, Damaged, open_region
from fuselog.recorders.log.container.reading import Region, open_container, read_bytes
from fuselog.recorders.log.loops import HEAD_BYTES, MESSAGE_HEAD_BYTES
from fuselog.recorders.log.opening import Log

# Offset of the recorder's stamp in a message's record.
_LOG_TIME = HEAD_BYTES + 6


class McapFile:
    """An MCAP file; see `BagFile`. Raises BadInput if the file is not MCAP, or cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._container = open_container(path)
        self._by_id = {
            number: self._connection(channel) for number, channel in self._container.channels.items()
        }
        self.connections = list(self._by_id.values())
        self.others = [f"attachment {name}" for name in self._container.attachments]
        self.others += [f"metadata {name}" for name in self._container.metadata]
        loss = Log(path, self._container).loss_statement
        self.losses = [] if loss is None else [loss]

    def _connection(self, channel: records.Channel) -> Connection:
        schema = self._container.schemas.get(channel.schema_id)
        definition = UNDEFINED
        if schema is not None and schema.encoding in FORMATS:
            definition = MessageDefinition(
                FORMATS[schema.encoding], schema.data.decode(errors="replace")
            )
        name = "" if schema is None else schema.name
        if channel.message_encoding in ("cdr", "ros1"):
            name = normalize_msgtype(name)
        count = self._container.message_counts[channel.id]
        return Connection(channel.topic, name, channel.message_encoding, definition, count)

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, a chunk of the file at a time."""
        chosen = {number: each for number, each in self._by_id.items() if wanted(each)}
        regions = [
            region
            for region in self._container.regions
            if region.channel_ids is None or not region.channel_ids.isdisjoint(chosen)
        ]
        with self.path.open("rb") as file:
            reads = ((region, read_bytes(file, *region.extent)) for region in regions)
            for opened in ahead(partial(_opened, self.path), reads):
                if isinstance(opened, str):
                    self.losses.append(opened)
                    continue
                for number, places in opened.messages.items():
                    if number in chosen:
                        yield Batch(
                            chosen[number],
                            opened.data,
                            places + MESSAGE_HEAD_BYTES,
                            words(opened.data, places + 1, "<i8") + (HEAD_BYTES - MESSAGE_HEAD_BYTES),
                            words(opened.data, places + _LOG_TIME, "<i8"),
                        )


def _opened(path: Path, read: tuple[Region, bytes]) -> Contents | str:
    """Open a region; return the reason if it cannot be read."""
    region, raw = read
    try:
        return open_region(raw, region.offset)
    except Damaged as damage:
        return f"{path}: {damage}"
