"""Messages as bytes with the stamps of the recorder, as stored in the files of a bag."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from fuselog.recorders.log.layout import windows

FORMATS = {
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
UNDEFINED = MessageDefinition(MessageDefinitionFormat.NONE, "")


class Connection(NamedTuple):
    """A topic of one publisher in a file; its type is named as in ROS 2: `nav_msgs/msg/Odometry`.

    `encoding` is cdr or ros1 if the messages can be read.
    """

    topic: str
    type_name: str
    encoding: str
    definition: MessageDefinition
    messages: int


class Batch(NamedTuple):
    """Some messages (n,) of a connection, in file order: their positions in `data`, and stamps."""

    connection: Connection
    data: NDArray[np.uint8]
    begins: NDArray[np.int64]
    lengths: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]


class BagFile(Protocol):
    """A reader of one file of a bag.

    `losses` is complete only after reading. `others` names what the file contains besides messages.
    """

    path: Path
    connections: list[Connection]
    others: list[str]

    @property
    def losses(self) -> list[str]:
        """Return a sentence for each part that cannot be read."""

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, a chunk of the file at a time."""


def joined(connection: Connection, parts: Sequence[bytes], log_time_ns: NDArray[np.int64]) -> Batch:
    """Join messages from separate buffers into one batch.

    Args:
        connection: the publisher's topic.
        parts: n messages.
        log_time_ns: (n,), stamps of the recorder, in ns.
    """
    lengths = np.array([len(part) for part in parts], np.int64)
    data = np.frombuffer(b"".join(parts), np.uint8)
    return Batch(connection, data, np.cumsum(lengths) - lengths, lengths, log_time_ns)


def words(data: NDArray[np.uint8], places: NDArray[np.int64], dtype: str) -> NDArray:
    """Read numbers of one type from bytes.

    Args:
        data: the bytes.
        places: (n,), byte position of each number.
        dtype: type of the numbers, such as "<i8".

    Returns:
        The numbers (n,).
    """
    return windows(data, np.dtype(dtype).itemsize)[places].view(dtype)
