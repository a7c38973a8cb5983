"""Search for the files of a bag: one file or a folder's files, which ROS may split and compress."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import zstandard

from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.files.raw import BagFile, Batch, Connection, joined

SUFFIXES = (".bag", ".db3", ".mcap")
_WANTED = "give a .bag, .db3 or .mcap file of ROS, or the folder of one"
_ZSTD = ".zstd"
_MAGIC = zstandard.FRAME_HEADER


@dataclass
class Bag:
    """The files of one bag, in the order of their splits, and sentences on missing parts.

    `stated` has the number of messages of each topic according to metadata.yaml; `is_packed` is True if
    every message is compressed separately.
    """

    path: Path
    files: list[BagFile]
    missing: list[str] = field(default_factory=list)
    stated: Counter[str] = field(default_factory=Counter)
    is_packed: bool = False

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, file by file."""
        for file in self.files:
            for batch in file.batches(wanted):
                yield _unpacked(batch) if self.is_packed or _looks_packed(batch) else batch

    @property
    def connections(self) -> list[Connection]:
        """Return the connections of all files."""
        return [each for file in self.files for each in file.connections]

    @property
    def others(self) -> list[str]:
        """Return what the files contain besides messages."""
        return [each for file in self.files for each in file.others]

    @property
    def losses(self) -> list[str]:
        """Return a sentence for each part that cannot be read; the list is complete after reading."""
        found = [*self.missing, *(loss for file in self.files for loss in file.losses)]
        return list(dict.fromkeys(found))  # a part that is read twice is reported twice


def looks_like_bag(path: Path) -> bool:
    """Test whether a path looks like a bag that is not MCAP: a .bag or .db3 file, or a bag's folder."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or bool(_members(path, {}))
    return path.suffix in (".bag", ".db3")


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag; raise BadInput if the path is not a bag, or if none of its files can be read.

    Files that are compressed as a whole are decompressed to a temporary folder.
    """
    about = _metadata(path) if path.is_dir() else {}
    paths = _members(path, about) if path.is_dir() else [path]
    there = [each for each in paths if each.is_file()]
    bag = Bag(
        path,
        [],
        [f"{each}: is missing, although metadata.yaml names it" for each in paths if each not in there],
    )
    if not there:
        raise BadInput(f"{path}: contains no bag; {_WANTED}")
    for entry in about.get("topics_with_message_count") or []:
        bag.stated[entry["topic_metadata"]["name"]] += int(entry["message_count"])
    bag.is_packed = str(about.get("compression_mode") or "").lower() == "message"
    with scratch_folder("fuselog-ros") as scratch:
        for each in there:
            bag.files.append(_open_file(each, scratch))
        if len({type(each) for each in bag.files}) > 1:
            raise BadInput(f"{path}: contains bags of several formats; give one of them")
        yield bag


def _open_file(path: Path, scratch: Path) -> BagFile:
    place = path
    if path.suffix == _ZSTD:
        place = scratch / path.stem
        try:
            with path.open("rb") as packed, place.open("wb") as file:
                zstandard.ZstdDecompressor().copy_stream(packed, file)
        except zstandard.ZstdError as error:
            raise BadInput(f"{path}: cannot be decompressed ({error})") from None
    if place.suffix == ".mcap":
        from fuselog.recorders.importers.ros.files.mcap_file import McapFile

        return McapFile(place)
    if place.suffix == ".db3":
        from fuselog.recorders.importers.ros.files.sqlite_file import SqliteFile

        return SqliteFile(place, scratch)
    if place.suffix in (".bag", ".active"):
        from fuselog.recorders.importers.ros.files.ros1_file import Ros1File

        return Ros1File(place)
    raise BadInput(f"{path}: is not a bag; {_WANTED}")


def _looks_packed(batch: Batch) -> bool:
    """Test from the first bytes whether a batch is compressed, in case no metadata.yaml states it."""
    begin = int(batch.begins[0]) if len(batch.begins) else len(batch.data)
    return batch.connection.encoding == "cdr" and batch.data[begin : begin + 4].tobytes() == _MAGIC


def _unpacked(batch: Batch) -> Batch:
    """Decompress messages; those that cannot be decompressed become empty."""
    parts = []
    for begin, length in zip(batch.begins.tolist(), batch.lengths.tolist(), strict=True):
        try:
            parts.append(zstandard.decompress(batch.data[begin : begin + length].tobytes()))
        except zstandard.ZstdError:
            parts.append(b"")
    return joined(batch.connection, parts, batch.log_time_ns)


def _metadata(folder: Path) -> dict[str, Any]:
    """Read metadata.yaml of a ROS 2 bag; return an empty dict if it is missing."""
    place = folder / "metadata.yaml"
    if not place.exists():
        return {}
    from ruamel.yaml import YAML  # slow to import
    from ruamel.yaml.error import YAMLError

    try:
        about = YAML(typ="safe").load(place.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    except (OSError, ValueError, KeyError, TypeError, YAMLError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(f"{place}: cannot be read ({reason}); give the bag's files one by one") from None
    if not isinstance(about, dict):
        raise BadInput(f"{place}: does not describe a bag; give the bag's files one by one")
    return about


def _members(folder: Path, about: dict[str, Any]) -> list[Path]:
    """List the files of a folder, from its metadata or sorted by their names and numbers."""
    stated = [folder / PurePath(str(name)).name for name in about.get("relative_file_paths") or []]
    if stated:
        return stated
    found = [each for each in folder.iterdir() if each.name.removesuffix(_ZSTD).endswith(SUFFIXES)]
    return sorted(
        found,
        key=lambda each: [
            (int(part or 0), part) if part.isdigit() else (-1, part)
            for part in re.split(r"(\d+)", each.name)
        ],
    )
