"""Export of logs to other tools: estimates and truths as trajectories, any stream as a table.

A log is read once, block by block, so memory use does not grow with its length. Tracks are an exception:
they are exported frame by frame. Existing files are never replaced.
"""

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args
from urllib.parse import quote

from fuselog.pipeline.output.outputs import Kind, check_files, check_folder
from fuselog.recorders.atomic import whole_file, whole_folder
from fuselog.recorders.errors import BadInput, UnknownName, choices, without_warnings_of_numbers
from fuselog.recorders.log import Log, LogWriter, Stream, open_log, read_blocks, read_empty, schemas
from fuselog.recorders.registry import available, load
from fuselog.recorders.trajectories import Trajectory, kitti_lines, tum_lines
from fuselog.replay.judging.errors.trajectory_streams import trajectory_of

To = Literal["tum", "kitti", "ros2", "ros2-sqlite3", "mot", "csv", "parquet", "foxglove"]
SUFFIXES: dict[To, str] = {
    "tum": ".txt",
    "kitti": ".txt",
    "mot": ".txt",
    "csv": ".csv",
    "parquet": ".parquet",
    "foxglove": ".mcap",
}
TRAJECTORIES: dict[str, tuple[str, Callable[[Trajectory], list[str]]]] = {
    "tum": ("# timestamp tx ty tz qx qy qz qw\n", tum_lines),
    "kitti": ("", kitti_lines),
}
# The storage of bags, as ROS names it.
BAGS = {"ros2": "mcap", "ros2-sqlite3": "sqlite3"}
POSES = {*TRAJECTORIES, *BAGS}

Write = Callable[[Stream], None]
FramesOf = Callable[[Log, Sequence[str]], dict[str, tuple[list[str], list[str]]]]


class Exported(NamedTuple):
    """The written files by topic, and sentences on what the files do not contain."""

    files: dict[str, Path]
    notes: list[str]


@without_warnings_of_numbers()
def export(
    path: str | Path,
    *,
    to: To,
    out: str | Path | None = None,
    topics: Sequence[str] = (),
    recover: bool = False,
) -> Exported:
    """Export topics of a log as trajectories, tracks, tables or messages for Foxglove.

    Args:
        path: the log, or estimates log.
        to: the format. "tum" and "kitti" are trajectories of poses, and of estimates and truths with a
            position. "ros2" and "ros2-sqlite3" are a bag of ROS 2 with the same data and geodetic fixes,
            as MCAP or SQLite; see `fuselog.pipeline.logs.ros2`. "mot" has a file of tracks for each
            tracker and one of all truths; see `fuselog.pipeline.families.tracking.mot`. "csv" and
            "parquet" are tables. "foxglove" is one log with messages that Foxglove shows; see
            `fuselog.pipeline.logs.foxglove`.
        out: the folder for the files, by default named after the log. If a single topic is given (except
            with "mot" and bags), and for "foxglove", this is the path of the file.
        topics: the topics to export; all suitable topics if empty.
        recover: read the intact part of a log that was cut off or damaged.

    Returns:
        The written files by topic, and sentences on what the files do not contain.

    Raises BadInput if a topic does not exist or does not suit the format, or the output already exists.
    """
    if to not in get_args(To):
        raise BadInput(f"no format '{to}' to export to; {choices(to, get_args(To))}")
    log = open_log(path, recover=recover)
    notes = [log.loss_statement] if log.loss_statement else []
    if to in available("exports"):
        return _export_frames(log, to, topics, Path(out or f"{log.path.stem}-{to}"), notes)
    chosen = _chosen(log, to, topics, notes)
    if to == "foxglove":
        return _export_mirrors(log, chosen, Path(out or f"{log.path.stem}-foxglove.mcap"), notes)
    if to in BAGS:
        return _export_bag(log, to, chosen, Path(out or f"{log.path.stem}-{to}"), notes)
    names = {topic: _file_name(topic, to) for topic in chosen}
    for topic, name in names.items():
        if list(names.values()).count(name) > 1:
            raise BadInput(
                f"{path}: two topics would have the same file {name}; export {topic} alone with --topic"
            )
    if len(topics) == 1:
        (topic,) = chosen
        place = Path(out or f"{log.path.stem}-{names[topic]}")
        check_files([(place, _new(to))], {"log": [log.path]})
        with whole_file(place) as part:
            _write(log, to, {topic: part}, notes)
        return Exported({topic: place}, notes)
    place = Path(out or f"{log.path.stem}-{to}")
    check_folder(place, {"log": [log.path]})
    with whole_folder(place, _refuse) as part:
        _write(log, to, {topic: part / name for topic, name in names.items()}, notes)
    return Exported({topic: place / name for topic, name in names.items()}, notes)


def _chosen(log: Log, to: To, topics: Sequence[str], notes: list[str]) -> list[str]:
    """Choose the topics to export; note unsuitable topics, or raise BadInput if one was requested."""
    chosen = []
    for topic in dict.fromkeys(topics or log.topics):
        if topic not in log.topics:
            raise UnknownName(f"{log.path}: no topic {topic}; {choices(topic, log.topics)}")
        try:
            empty = read_empty(log, topic)
            if to in POSES and (lacks := _lacking(empty, to)):
                raise BadInput(f"{log.path}: topic {topic}: {lacks}; export it as csv")
        except BadInput as error:
            if topics:
                raise
            if to not in POSES:
                notes.append(str(error))
            continue
        chosen.append(topic)
    if not chosen and to in POSES:
        raise BadInput(
            f"{log.path}: has no estimates, truths or poses to export to {to}; export it as csv"
        )
    if not chosen:
        why = f": {notes[-1].removeprefix(f'{log.path}: ')}" if notes else "; it has no topics"
        raise BadInput(f"{log.path}: has no topic of numeric messages, which export to {to} needs{why}")
    return chosen


def _export_mirrors(log: Log, topics: Sequence[str], place: Path, notes: list[str]) -> Exported:
    """Write a log with the Foxglove mirrors of all topics that have one."""
    from fuselog.pipeline.logs.foxglove import mirrors, sentence_of  # slow to import

    check_files([(place, _new("foxglove"))], {"log": [log.path]})
    written = dict.fromkeys(topics, 0)
    with LogWriter(place) as writer:
        for block in read_blocks(log, topics):
            for topic, stream in block.items():
                written[topic] += writer.write_mirrors(mirrors(stream))
        if not any(written.values()):
            raise BadInput(f"{log.path}: has nothing that Foxglove can show; export it as csv")
    without = [topic for topic, messages in written.items() if messages == 0]
    if without:
        notes.append(sentence_of(without))
    return Exported({topic: place for topic, messages in written.items() if messages}, notes)


def _export_bag(log: Log, to: To, topics: Sequence[str], place: Path, notes: list[str]) -> Exported:
    """Write the folder of a bag."""
    from rosbags.rosbag2 import StoragePlugin

    from fuselog.pipeline.logs.ros2 import write_bag  # slow to import

    check_folder(place, {"log": [log.path]})
    with whole_folder(place, _refuse) as part:
        bag = part / place.name  # its files have the name of its folder
        try:
            written = write_bag(log, topics, bag, StoragePlugin[BAGS[to].upper()], notes)
        except sqlite3.Error as error:
            raise BadInput(f"{place}: cannot be written ({error})") from error
        if not written:
            raise BadInput(f"{log.path}: has no finite poses to export to {to}; export it as csv")
        for file in bag.iterdir():
            file.rename(part / file.name)
        bag.rmdir()
    return Exported(dict.fromkeys(written, place), notes)


def _export_frames(log: Log, to: To, topics: Sequence[str], place: Path, notes: list[str]) -> Exported:
    """Write a folder with the files that an entry point of `fuselog.exports` makes from a log.

    The entry point is called with the log and the topics, and returns the topics and lines of each file.
    """
    frames: FramesOf = load("exports", to)
    files = frames(log, topics)
    names = {name: f"{quote(name, safe=' ')}{SUFFIXES[to]}" for name in files}
    check_folder(place, {"log": [log.path]})
    with whole_folder(place, _refuse) as part:
        for name, (_, lines) in files.items():
            text = "".join(f"{line}\n" for line in lines)
            (part / names[name]).write_text(text, encoding="utf-8", newline="\n")
    exported = {topic: place / names[name] for name, (of, _) in files.items() for topic in of}
    return Exported(exported, notes)


def _new(to: To) -> Kind:
    """Return the `Kind` of an output file that must not exist yet."""
    return Kind(SUFFIXES[to], f"a new {to} file", lambda _: False)


def _lacking(empty: Stream, to: To) -> str:
    """Return why a stream cannot have poses, whatever its messages; priors are not estimates."""
    schema = empty.schema.full_name
    if to in BAGS and schema == schemas.GEODETIC_FIX.full_name:
        return ""
    is_estimate = schema == schemas.GAUSSIAN_ESTIMATE.full_name and empty.topic.startswith("/estimates/")
    if not is_estimate and schema not in (schemas.TRUTH_STATE.full_name, schemas.POSE.full_name):
        return f"is not an estimate, truth{', Pose or GeodeticFix' if to in BAGS else ' or Pose'}"
    return "" if trajectory_of(empty) is not None else "has no position"


def _file_name(topic: str, to: To) -> str:
    return quote(topic.strip("/").replace("/", "-"), safe=" ") + SUFFIXES[to]


def _refuse(place: Path) -> None:
    raise BadInput(f"{place}: exists, and fuselog export does not replace files; give another --out")


def _write(log: Log, to: To, files: dict[str, Path], notes: list[str]) -> None:
    with ExitStack() as stack:
        write = {
            topic: stack.enter_context(
                _trajectory_file(path, to, notes) if to in TRAJECTORIES else _table_file(path, to)
            )
            for topic, path in files.items()
        }
        for block in read_blocks(log, list(files)):
            for topic, stream in block.items():
                write[topic](stream)
        for topic in files:
            write[topic](read_empty(log, topic))


@contextmanager
def _trajectory_file(path: Path, to: To, notes: list[str]) -> Iterator[Write]:
    """Open a text file of poses for writing; note missing orientations and omitted poses."""
    header, lines_of = TRAJECTORIES[to]
    dropped: dict[str, int] = {}
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(header)

        def write(stream: Stream) -> None:
            trajectory = trajectory_of(stream)
            assert trajectory is not None
            if stream.topic not in dropped and trajectory.rotation is None:
                notes.append(f"{stream.topic}: has no orientation; the identity is written instead")
            dropped[stream.topic] = dropped.get(stream.topic, 0) + len(stream) - len(trajectory)
            file.writelines(f"{line}\n" for line in lines_of(trajectory))

        yield write
    notes += [
        f"{topic}: {count} poses are not finite and were omitted"
        for topic, count in dropped.items()
        if count
    ]


@contextmanager
def _table_file(path: Path, to: To) -> Iterator[Write]:
    """Open a table for writing, with the columns of the first stream that is written."""
    import pyarrow.csv
    import pyarrow.parquet

    make: Callable[..., Any] = pyarrow.csv.CSVWriter if to == "csv" else pyarrow.parquet.ParquetWriter
    with path.open("wb") as file, ExitStack() as stack:
        begun: list[tuple[Any, list[str]]] = []

        def write(stream: Stream) -> None:
            table = stream.arrow()
            if not begun:
                begun.append((stack.enter_context(make(file, table.schema)), table.column_names))
            writer, columns = begun[0]
            if len(table) and table.column_names != columns:
                raise BadInput(
                    f"topic {stream.topic}: has vectors of different lengths, which a table cannot "
                    "store; export the other topics with --topic"
                )
            if len(table):
                writer.write_table(table)

        yield write
