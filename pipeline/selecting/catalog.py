"""Catalogs: Parquet files with a row per log, from which commands select logs.

A log is identified by its path, which the file stores relative to its own folder, so that both can be
moved together. Columns that other programs add are kept.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput, check_format
from fuselog.recorders.parameters import flat
from fuselog.recorders.remote.paths import RemotePath, is_url, located, state_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

SUFFIX = ".parquet"
# Increased when the columns change incompatibly; stored in the metadata of the file's schema.
FORMAT = 1
_KEY = b"fuselog_catalog"
GONE = (0, 0, "")  # the state of a log that cannot be reached
REQUIRED = ("log", "size_bytes", "modified_ns", "version")  # columns in which no value is missing


def schema() -> "pa.Schema":
    """Return the columns of a catalog."""
    import pyarrow as pa

    text, number = pa.string(), pa.float64()
    topic = {"topic": text, "schema": text, "encoding": text, "messages": pa.int64(), "rate_hz": number}
    finding = dict.fromkeys(("kind", "where", "severity", "sentence"), text)
    columns = {
        text: "log folder problem scenario parameters notes version sha256",
        pa.int64(): "size_bytes modified_ns begin_ns end_ns publish_begin_ns publish_end_ns messages "
        "seed run epoch_ns gaps faults",
        number: "duration_s longest_gap_s",
        pa.bool_(): "is_deep",
        pa.list_(text): "models",
        pa.list_(pa.struct(topic.items())): "topics",
        pa.list_(pa.struct(finding.items())): "findings",
    }
    return pa.schema([(name, kind) for kind, names in columns.items() for name in names.split()])


def state_of_log(log: str) -> tuple[int, int, str]:
    """Return the size of a log, its modification time, and its version if it is at a URL."""
    try:
        return state_of(located(log))
    except (BadInput, OSError):
        return GONE


def logs_under(folder: Path) -> Iterator[str]:
    """Find the logs in a folder and in the folders in it, except estimates logs and kept results."""
    if isinstance(folder, RemotePath):
        yield from (str(each) for each in folder.rglob("*.mcap") if _is_log(each.name))
        return
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and not _is_made(Path(place, name))
        )
        yield from (str(Path(place, name)) for name in sorted(names) if _is_log(name))


def _is_made(folder: Path) -> bool:
    """Test whether a folder is a result, or belongs to an unfinished result or to a viewed one."""
    return folder.suffix in (".unfinished", ".segments") or (folder / "result.json").is_file()


def _is_log(name: str) -> bool:
    return name.endswith(".mcap") and not name.endswith(".estimates.mcap")


def logs_in(path: Path) -> list[Path]:
    """List the logs in a folder by name, without estimates logs; return any other path as it is.

    Raises BadInput if a folder has no logs.
    """
    if not path.is_dir():
        return [path]
    files = recordings_in(path)
    if not files:
        raise BadInput(f"{path}: has no logs to replay; give a log, or a folder or result with logs")
    return files


def recordings_in(folder: Path) -> list[Path]:
    """List the logs in a folder by name, without estimates logs; return [] for any other path."""
    return [each for each in sorted(folder.glob("*.mcap")) if _is_log(each.name)]


def is_catalog(path: Path) -> bool:
    """Test whether a path is that of a catalog, by its suffix."""
    return path.suffix == SUFFIX


def read_catalog(path: Path) -> "pd.DataFrame":
    """Read the rows of a catalog, with the paths of its logs as seen from the working directory.

    Raises BadInput if the file is missing, is not a catalog, or is a catalog of another version.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as file:
            stored = pq.read_table(file)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror or error})") from None
    except pa.ArrowException as error:
        raise BadInput(f"{path}: is not a Parquet file ({error}); fuselog catalog writes one") from None
    version = (stored.schema.metadata or {}).get(_KEY)
    if version is None or not version.isdigit():
        raise BadInput(f"{path}: is not a catalog; write one with fuselog catalog FOLDER -o {path.name}")
    check_format(path, int(version), FORMAT)
    for field in schema():
        is_there = (
            field.name in stored.schema.names and stored.schema.field(field.name).type == field.type
        )
        if not is_there or (field.name in REQUIRED and stored[field.name].null_count):
            raise BadInput(f"{path}: its column {field.name} was changed; write it again")
    stored = stored.select([*dict.fromkeys([*schema().names, *stored.schema.names])])
    names = stored["log"].to_pylist()
    return _pandas(stored.set_column(0, "log", pa.array([_seen(log, path) for log in names])))


def table_of(rows: Sequence[Mapping[str, Any]]) -> "pd.DataFrame":
    """Make a table with the columns of a catalog, and any additional columns of the rows."""
    import pyarrow as pa

    table = pa.Table.from_pylist(rows, schema())
    more = dict.fromkeys(name for row in rows for name in row if name not in table.column_names)
    for name in more:
        table = table.append_column(name, _array([row.get(name) for row in rows]))
    return _pandas(table)


def rows_in(table: "pd.DataFrame") -> list[dict[str, Any]]:
    """Return the rows of a table as dictionaries, with None for a missing value."""
    rows: list[dict[str, Any]] = _arrow(table).to_pylist()
    return rows


def write_catalog(path: Path, table: "pd.DataFrame") -> None:
    """Write rows as a catalog, which replaces an earlier one in one step."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    stored = _arrow(table)
    logs = pa.array([_stored(log, path) for log in table["log"]])
    stored = stored.set_column(0, "log", logs).replace_schema_metadata({_KEY: str(FORMAT).encode()})
    with whole_file(path) as new, new.open("wb") as file:
        pq.write_table(stored, file)


def _pandas(table: "pa.Table") -> "pd.DataFrame":
    """Convert a table to pandas, whose integers and flags may be missing."""
    import pandas as pd
    import pyarrow as pa

    kinds = {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype()}
    return table.to_pandas(types_mapper=kinds.get)


def _arrow(table: "pd.DataFrame") -> "pa.Table":
    import pyarrow as pa

    own = pa.Table.from_pandas(table[schema().names], schema(), preserve_index=False)
    for name in table.columns.difference(schema().names, sort=False):
        own = own.append_column(name, pa.array(table[name], from_pandas=True))
    return own


def is_written(path: Path) -> bool:
    """Test whether a file is a catalog, of any version."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as file:
            return _KEY in (pq.read_schema(file).metadata or {})
    except (OSError, pa.ArrowException):
        return False


def _stored(log: str, path: Path) -> str:
    """Return the path of a log relative to the folder of its catalog; URLs are stored as they are."""
    return log if is_url(log) else Path(os.path.relpath(log, path.parent)).as_posix()


def _seen(log: str, path: Path) -> str:
    return log if is_url(log) else os.path.normpath(path.parent / log)


def read_current(path: Path) -> "pd.DataFrame":
    """Read a catalog as `read_catalog` does; raise BadInput if a log changed after it was catalogued."""
    table = read_catalog(path)
    now = map(state_of_log, table["log"])
    then = zip(table["size_bytes"], table["modified_ns"], table["version"], strict=True)
    changed = [log for log, a, b in zip(table["log"], now, then, strict=True) if a not in (b, GONE)]
    if changed:
        others = f", like {len(changed) - 1} others" if len(changed) > 1 else ""
        raise BadInput(
            f"{changed[0]}: changed after it was catalogued{others}; update {path} with fuselog "
            f"catalog FOLDER -o {path}"
        )
    return table


def with_columns(table: "pd.DataFrame") -> "pd.DataFrame":
    """Add the columns that conditions may name: of each topic, model, parameter and note.

    The topic `/robot1/odometry` adds `robot1_odometry_messages` and `robot1_odometry_rate_hz`, the model
    `robot` adds `fits_robot`, the recorder's parameter `speed_mps` adds `run_speed_mps`, and the note
    `site` adds `note_site`. A name that two of these columns would have is left out.
    """
    import pyarrow as pa

    added = [dict(_columns_of(row)) for row in rows_in(table)]
    meant: dict[str, set[str]] = {}
    for name, source in (what for row in added for what in row):
        meant.setdefault(name, set()).add(source)
    sole = {name: sources.pop() for name, sources in sorted(meant.items()) if len(sources) == 1}
    columns = {
        name: _array([row.get((name, source), _without(name)) for row in added])
        for name, source in sole.items()
        if name not in table
    }
    return table.join(_pandas(pa.table(columns)).set_index(table.index)) if columns else table


def _without(name: str) -> Any:
    """Return the value of an added column for a log that lacks the topic or model."""
    return False if name.startswith("fits_") else 0 if name.endswith("_messages") else None


def _array(values: Sequence[Any]) -> "pa.Array":
    """Make a column of values; numbers and texts together become texts."""
    import pyarrow as pa

    try:
        return pa.array(values)
    except pa.ArrowException:
        return pa.array([None if value is None else str(value) for value in values])


def _columns_of(row: Mapping[Any, Any]) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield the name of each added column with its source, and its value."""
    for topic in row["topics"] or ():
        for what in ("messages", "rate_hz"):
            yield (_name(f"{topic['topic'].strip('/')}_{what}"), topic["topic"]), topic[what]
    for model in row["models"] or ():
        yield (_name(f"fits_{model}"), model), True
    for prefix, stated in (("run", row["parameters"]), ("note", row["notes"])):
        for name, value in flat(_parsed(stated, row["log"])):
            if isinstance(value, bool | int | float | str):
                yield (_name(f"{prefix}_{name}"), name), value


def _parsed(stated: str | None, log: str) -> dict[str, Any]:
    """Parse parameters or notes of a row; raise BadInput if another program has changed them."""
    try:
        found = json.loads(stated or "{}")
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise BadInput(f"{log}: its parameters or notes in the catalog are damaged; write it again")
    return found


def _name(text: str) -> str:
    return re.sub(r"\W", "_", text)
