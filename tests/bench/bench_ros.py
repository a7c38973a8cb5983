"""How fast bags of ROS become columns beside rosbags' messages, measured side by side in one run.

`python -m tests.bench ros` prints the ratios. `python -m tests.bench.bench_ros` imports a bag of five
million messages into a log, and prints how much memory that took.
"""

import resource  # noqa: TID251
import struct
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from fuselog.recorders.importers.ros.choosing import RosParameters
from fuselog.recorders.importers.ros.importer import read
from fuselog.recorders.recording import import_log
from tests.bench.timing import cpu_seconds

MESSAGES = 150_000
MANY = 5_000_000
START_NS, STEP_NS = 1_700_000_000_000_000_000, 5_000_000
TOPICS = {
    "/odom": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


class Row(NamedTuple):
    """One comparison: messages per second of CPU time, and ours over theirs."""

    name: str
    ours: float
    theirs: float
    ratio: float


def message_of(store: Typestore, name: str) -> Any:
    """A message of zeros but for its quaternion, with a text wherever there may be one."""

    def value(description: Any) -> Any:
        kind, of = description
        if kind is Nodetype.NAME:
            return message_of(store, of)
        if kind is Nodetype.BASE:
            return "base_link" if of[0] == "string" else 0
        return np.zeros(of[1], of[0][1][0])

    fields = {field: value(description) for field, description in store.fielddefs[name][1]}
    return store.types[name](**fields | ({"w": 1.0} if name.endswith("/Quaternion") else {}))


def stamped(raw: bytes, count: int) -> Iterator[tuple[int, bytes]]:
    """Copies of a message with stamps of their own: they stand behind four bytes in ROS 1 and 2."""
    message = bytearray(raw)
    for number in range(count):
        stamp_ns = START_NS + number * STEP_NS
        struct.pack_into("<II", message, 4, stamp_ns // 10**9, stamp_ns % 10**9)
        yield stamp_ns, bytes(message)


def write_bag(place: Path, form: str, count: int) -> Path:
    """A bag of so many messages of each topic."""
    if form == "bag":
        store = get_typestore(Stores.ROS1_NOETIC)
        path, serialize = place.with_suffix(".bag"), store.serialize_ros1
        bag: Any = Ros1Writer(path)
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        path, serialize = place, store.serialize_cdr
        plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        bag = Ros2Writer(path, version=9, storage_plugin=plugin)
        if form == "mcap":
            bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        topics = [bag.add_connection(topic, name, typestore=store) for topic, name in TOPICS.items()]
        messages = [
            stamped(bytes(serialize(message_of(store, name), name)), count) for name in TOPICS.values()
        ]
        for together in zip(*messages, strict=True):
            for topic, (stamp_ns, raw) in zip(topics, together, strict=True):
                bag.write(topic, stamp_ns, raw)
    return path


def read_with_rosbags(path: Path) -> None:
    """Every message as rosbags gives it."""
    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            bag.deserialize(raw, connection.msgtype)


def read_as_columns(path: Path) -> None:
    """Every stream, block by block."""
    for _ in read(path, RosParameters()).blocks:
        pass


def main() -> list[Row]:
    """The rates of each format."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for form in ("mcap", "db3", "bag"):
            path = write_bag(Path(folder) / form, form, MESSAGES // len(TOPICS))
            taken = cpu_seconds(
                {
                    "ours": lambda path=path: read_as_columns(path),
                    "theirs": lambda path=path: read_with_rosbags(path),
                }
            )
            rates = {name: MESSAGES / seconds for name, seconds in taken.items()}
            ratio = rates["ours"] / rates["theirs"]
            rows.append(Row(f"{form}, messages per second", rates["ours"], rates["theirs"], ratio))
    return rows


def import_many() -> None:
    """Import five million messages, and say what that took."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_bag(Path(folder) / "bag", "mcap", MANY // len(TOPICS))
        own, most, begin = psutil.Process(), 0, time.perf_counter()
        before = own.memory_info().rss

        blocks = read(path, RosParameters()).blocks
        for block in blocks:
            most = max(most, own.memory_info().rss)
            del block
        reading_s = time.perf_counter() - begin
        _, messages = import_log("ros", path, {}, Path(folder) / "log.mcap")
        print(f"{MANY} messages read in {reading_s:.1f} s, {(most - before) / 1e6:.0f} MB at most")
        print(
            f"{messages} messages written in {time.perf_counter() - begin - reading_s:.1f} s; ", end=""
        )
        print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB at most, in all")


if __name__ == "__main__":
    import_many()
