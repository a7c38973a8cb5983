"""Functions that find the source logs and estimators of estimates logs, and hash the input of replays.

The module also writes the tables of all individual errors.
"""

import hashlib
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import numpy as np

from fuselog.pipeline.altering.sources import alter, stated_alterations
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Log, open_log
from fuselog.recorders.parsing import parse_json
from fuselog.recorders.remote.paths import referred_to
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source
from fuselog.replay.judging.errors.evaluation import Errors, split_topic

# Folder of the tables of individual errors, in a result folder.
ERRORS = Path("tables", "errors")


def log_of_estimates(estimates: Log) -> Path:
    """Find the log from which estimates were replayed; raise BadInput if it is missing.

    A recording with both estimates and sensors is its own source log.
    """
    named = estimates.run.notes.get("log") if estimates.run else None
    if named is None and recorded_estimators(estimates):
        return estimates.path
    if named is None:
        raise BadInput(f"{estimates.path}: does not state its source log; give it with --log")
    path = referred_to(named, estimates.path)
    if not path.exists():
        raise BadInput(f"{estimates.path}: its source log {path} is missing; give it with --log")
    return path


def source_of_estimates(
    estimates: Log, place: Path | None = None, *, recover: bool = False
) -> LogSource:
    """Open the source log of an estimates log, with the same changes as in the replay.

    Args:
        estimates: the estimates log.
        place: the path of the source log, if it differs from the one in the estimates log.
        recover: read the intact part of a damaged log.
    """
    log = open_log(place or log_of_estimates(estimates), recover=recover)
    return alter(LogSource(log), stated_alterations(LogSource(estimates)))


def stated_estimators(estimates: Log | Source) -> dict[str, Any]:
    """Return parameters by label, in the order of the replay; return {} if the log has no parameters."""
    notes = estimates.run.notes if estimates.run else {}
    try:
        stated = parse_json(notes.get("estimators", "{}"))
    except ValueError:
        return {}
    return stated if isinstance(stated, dict) else {}


def labels_of(estimates: Log | Source) -> list[str]:
    """List the estimators that have estimates in a log."""
    topics = (topic for topic in estimates.topics if topic.startswith("/estimates/"))
    return list(dict.fromkeys(split_topic(topic)[0] for topic in topics))


def recorded_estimators(log: Log | Source) -> list[str]:
    """List the estimators with estimates in a recording, such as an autopilot's.

    An estimates log has a source log, so the list is empty.
    """
    notes = log.run.notes if log.run else {}
    has_sensors = any(not topic.startswith("/estimates/") for topic in log.topics)
    return labels_of(log) if has_sensors and "log" not in notes else []


def hash_streams(sources: Iterable[MemorySource]) -> str:
    """Hash every column of every run with SHA-256; the hashes of equal data are equal."""
    digest = hashlib.sha256()
    for source in sources:
        add_to_hash(digest, source)
    return digest.hexdigest()


def add_to_hash(digest: "hashlib._Hash", source: MemorySource) -> None:
    """Add a run's columns to a hash."""
    for stream in source.streams.values():
        for array in (stream.publish_time_ns, stream.log_time_ns, *stream.columns.values()):
            digest.update(np.ascontiguousarray(array).data)


def hash_files(paths: Sequence[Path]) -> str:
    """Hash the bytes of files with SHA-256."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


class ErrorTables:
    """A context that writes all individual errors to a Parquet file per estimator and case.

    The errors are written block by block as they arrive.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / ERRORS
        self._stack = ExitStack()
        self._writers: dict[tuple[str, str], Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: Any) -> None:
        self._stack.close()

    def add(self, errors: Errors) -> None:
        """Write a block; see `error_table`."""
        import pyarrow
        import pyarrow.parquet

        from fuselog.replay.judging.tables import error_table

        table = pyarrow.Table.from_pandas(error_table(errors), preserve_index=False)
        what = errors.estimator, errors.case
        if what not in self._writers:
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{quote('-'.join(filter(None, what)), safe=' ')}.parquet"
            file = self._stack.enter_context(path.open("wb"))
            writer = pyarrow.parquet.ParquetWriter(file, table.schema)
            self._writers[what] = self._stack.enter_context(writer)
        if len(table):
            self._writers[what].write_table(table)


def join_tables(parts: Sequence[Path], place: Path) -> None:
    """Write the rows of several Parquet files to one, in order."""
    import pyarrow.parquet

    files = [pyarrow.parquet.ParquetFile(part) for part in parts]
    with pyarrow.parquet.ParquetWriter(place, files[0].schema_arrow) as writer:
        for file in files:
            for group in range(file.num_row_groups):
                writer.write_table(file.read_row_group(group))
