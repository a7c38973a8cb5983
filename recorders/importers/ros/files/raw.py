"""Holds messages as a file of a bag keeps them: bytes, and the stamps of the recorder."""

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
    """Describes one publisher's topic in a file; its type is named as in ROS 2: `nav_msgs/msg/Odometry`.

    `encoding` is cdr or ros1 where the messages can be read.
    """

    topic: str
    type_name: str
    encoding: str
    definition: MessageDefinition
    messages: int


class Batch(NamedTuple):
    """Holds some messages (n,) of a connection, in file order: their place in `data`, and stamps."""

    connection: Connection
    data: NDArray[np.uint8]
    begins: NDArray[np.int64]
    lengths: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]


class BagFile(Protocol):
    """Reads one file of a bag.

    `losses` is whole after the reading. `others` names what is in the file beside messages.
    """

    path: Path
    connections: list[Connection]
    others: list[str]

    @property
    def losses(self) -> list[str]:
        """Return what cannot be read, a sentence each."""

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Return the messages of the wanted connections, a chunk of the file at a time."""


def joined(connection: Connection, parts: Sequence[bytes], log_time_ns: NDArray[np.int64]) -> Batch:
    """Lay messages that are apart in memory end to end.

    Args:
        connection: the publisher.
        parts: n messages.
        log_time_ns: (n,), the stamps of the recorder.
    """
    lengths = np.array([len(part) for part in parts], np.int64)
    data = np.frombuffer(b"".join(parts), np.uint8)
    return Batch(connection, data, np.cumsum(lengths) - lengths, lengths, log_time_ns)


def words(data: NDArray[np.uint8], places: NDArray[np.int64], dtype: str) -> NDArray:
    """Read numbers of one type out of bytes.

    Args:
        data: the bytes.
        places: (n,), at which byte each number begins.
        dtype: their type, such as "<i8".

    Returns:
        (n,).
    """
    return windows(data, np.dtype(dtype).itemsize)[places].view(dtype)
