"""Rows of catalogs, made from the summaries of logs, and the logs that a command selects."""

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, ClassVar

from fuselog.pipeline.logs.information import fitting_of, main_span, rate
from fuselog.pipeline.output import terminal
from fuselog.pipeline.output.outputs import Kind, check_files
from fuselog.pipeline.output.results import hash_of
from fuselog.pipeline.runs.batches import Row, batches_of, over_logs, rows_of
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.ensemble import Progress, no_progress
from fuselog.pipeline.runs.executors import pool_for
from fuselog.pipeline.selecting.catalog import (
    SUFFIX,
    is_catalog,
    is_written,
    logs_in,
    logs_under,
    read_catalog,
    read_current,
    rows_in,
    schema,
    state_of_log,
    table_of,
    with_columns,
    write_catalog,
)
from fuselog.pipeline.selecting.selection import Selection, selected
from fuselog.pipeline.selecting.where import rows_where
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.log import open_log, read_span
from fuselog.recorders.log.impossible import YEAR_NS
from fuselog.recorders.remote.paths import is_url, located, partly
from fuselog.replay.engine.streams.linting import lint_source
from fuselog.replay.engine.streams.sources import LogSource

if TYPE_CHECKING:
    import pandas as pd

MOST_ROWS = 40  # largest number of rows that are printed
STATE = ("size_bytes", "modified_ns", "version")
CATALOG = Kind(SUFFIX, "a catalog of fuselog", is_written)


@dataclass(frozen=True)
class Describing:
    """The task of describing a log for its row in a catalog.

    Attributes:
        deep: whether the messages are read as well, for gaps, findings and the hash.
    """

    deep: bool
    doing: ClassVar[str] = "cataloguing"

    def __call__(self, log: Path, number: int, folder: Path) -> list[Row]:  # noqa: ARG002
        """Return the row of a log, without its path and state."""
        opened = open_log(log if self.deep else partly(log))
        own, run = opened.container.regions, opened.run
        begin_ns, end_ns = read_span(opened, "log_time")
        main = main_span(opened) if end_ns - begin_ns > YEAR_NS else None
        begin_ns, end_ns = main or (begin_ns, end_ns)
        duration_s = (end_ns - begin_ns) * 1e-9
        is_noted = run is not None or all("publish_time" in each.spans for each in own)
        published = read_span(opened, "publish_time") if is_noted else (None, None)
        topics = [
            {
                "topic": topic.name,
                "schema": topic.schema_name,
                "encoding": topic.encoding,
                "messages": topic.messages,
                "rate_hz": None if main else rate(topic.messages, duration_s),
            }
            for topic in opened.topics.values()
        ]
        row: Row = {
            "begin_ns": begin_ns,
            "end_ns": end_ns,
            "duration_s": duration_s,
            "publish_begin_ns": published[0],
            "publish_end_ns": published[1],
            "messages": sum(each.messages for each in opened.topics.values()),
            "topics": topics,
            "models": [
                name for name, each in fitting_of(opened.topics, is_all=False).items() if each.methods
            ],
        }
        if run is not None:
            row |= {name: getattr(run, name) for name in ("scenario", "seed", "run", "epoch_ns")}
            row |= {name: json.dumps(getattr(run, name)) for name in ("parameters", "notes")}
        return [row | (_deep(log, LogSource(opened)) if self.deep else {})]


def _deep(log: Path, source: LogSource) -> Row:
    """Return those properties of a log that only its messages show."""
    found = lint_source(source)
    gaps = [each.value for each in found if each.kind == "gap"]
    findings = [
        {name: getattr(each, name) for name in ("kind", "where", "severity", "sentence")}
        for each in found
    ]
    faults = sum(each.severity != "hint" for each in found)
    longest = {"gaps": len(gaps), "longest_gap_s": max(gaps, default=0.0)}
    return longest | {"faults": faults, "findings": findings, "sha256": hash_of(log)}


@dataclass(frozen=True)
class Catalogued:
    """The rows of logs, and how many of them are new, read again, unchanged or gone."""

    table: "pd.DataFrame"
    counts: Mapping[str, int] = field(default_factory=dict)


@without_warnings_of_numbers()
def catalogued(
    paths: Sequence[Path],
    out: Path | None = None,
    *,
    deep: bool = False,
    workers: int | None = 1,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> Catalogued:
    """Describe the logs in folders, and write or update the catalog `out`; see `catalog`."""
    if out is None and len(paths) == 1 and is_catalog(paths[0]):
        return Catalogued(read_catalog(paths[0]))
    logs = _logs_of(paths)
    if not logs:
        raise BadInput(f"{paths[0]}: has no logs (*.mcap) to catalogue; give a folder with logs")
    if out is None:
        return Catalogued(_rows(logs, deep=deep))
    check_files([(out, CATALOG)], {"log": map(located, logs)})
    with checkpoints_of(out) as checkpoints:
        known = {row["log"]: row for row in rows_in(read_catalog(out))} if out.exists() else {}
        states = {log: state_of_log(log) for log in logs}
        current = {
            log
            for log, row in known.items()
            if states.get(log) == tuple(row[name] for name in STATE) and row["is_deep"] >= deep
        }
        asked = [log for log in logs if log not in current]
        batches = batches_of(Describing(deep), list(map(located, asked)))
        pool = pool_for(workers, scheduler, len(asked))
        found = over_logs(batches, pool, checkpoints, progress)
        counts = Counter("read again" if log in known else "new" for log in asked)
        counts |= {"unchanged": len(current & {*logs}), "gone": len(known.keys() - {*logs})}
        for log, rows in zip(asked, found, strict=True):
            own = {name: of for name, of in known.get(log, {}).items() if name not in schema().names}
            known[log] = own | _row(log, rows[0], states[log], deep)
        table = table_of([known[log] for log in logs])
        if asked or counts["gone"] or not out.exists():
            write_catalog(out, table)
    return Catalogued(table, counts)


def catalog(
    *paths: str | Path,
    out: str | Path | None = None,
    deep: bool = False,
    where: str | None = None,
    workers: int | None = 1,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> "pd.DataFrame":
    """Describe logs in a table with a row per log, from their summaries.

    Args:
        paths: folders, which are searched for logs together with their subfolders; logs; or one catalog.
        out: the catalog to write, a Parquet file; if it exists, only new and changed logs are read.
        deep: also read the messages, for gaps, the findings of `lint` and a hash of the file.
        where: a condition on columns, such as "fix_rate_hz > 4 and duration_s > 60".
        workers: as for `run`, if a catalog is written.
        scheduler: as for `run`.
        progress: as for `run`.

    Returns:
        A row per log, also for one that cannot be read, with the reason as its `problem`. Columns for
        each topic, model, parameter and note are added, such as `fix_rate_hz` for the topic /fix.

    Raises BadInput if there are no logs, or the condition or the catalog is invalid.

    >>> from fuselog.pipeline.api.api import record, write
    >>> write("drives/a.mcap", record("landmarks", seed=7, duration_s=2.0))
    >>> catalog("drives", where="robot1_odometry_rate_hz > 10")["messages"].tolist()
    [204]
    """
    place = None if out is None else Path(out)
    found = catalogued(
        list(map(located, paths)),
        place,
        deep=deep,
        workers=workers,
        scheduler=scheduler,
        progress=progress,
    )
    table = with_columns(found.table)
    return table if where is None else rows_where(table, where)


def _logs_of(paths: Sequence[Path]) -> list[str]:
    """List the logs in folders, and the logs that are given directly, without duplicates."""
    found = (logs_under(path) if path.is_dir() else [str(path)] for path in paths)
    distinct: dict[str, str] = {}
    for log in chain.from_iterable(found):
        distinct.setdefault(_place(log), log)
    return list(distinct.values())


def _place(log: str) -> str:
    """Return what identifies a log: its URL or absolute path."""
    return log if is_url(log) else os.path.normpath(Path(log).absolute())


def _rows(logs: Sequence[str], *, deep: bool = False) -> "pd.DataFrame":
    """Describe logs in this process."""
    task = Describing(deep)
    return table_of(
        [_row(log, rows_of(task, located(log), 0, Path())[0], state_of_log(log), deep) for log in logs]
    )


def _row(log: str, found: Row, state: tuple[int, int, str], deep: bool) -> Row:
    folder = PurePosixPath(log).parent if is_url(log) else Path(log).absolute().parent
    own = {"log": log, "folder": folder.name, "is_deep": deep}
    return own | dict(zip(STATE, state, strict=True)) | found


def select(paths: Sequence[Path], where: str | None = None, group: str | None = None) -> Selection:
    """Find the logs of folders and catalogs, and single logs, that meet a condition.

    Folders are searched together with their subfolders, as by `catalog`. A log that is named by several
    paths is used once, with the columns of the first path.

    Args:
        paths: logs, folders of logs, and catalogs.
        where: a condition on the columns of the catalogs.
        group: the column that names the group of each log.

    Raises BadInput if no log meets the condition, or a log changed after it was catalogued.
    """
    tables = [read_current(path) if is_catalog(path) else _rows(_logs_of([path])) for path in paths]
    table = table_of([row for table in tables for row in rows_in(table)])
    table = with_columns(table[~table["log"].map(_place).duplicated()])
    return selected(table, str(paths[0]), where, group)


def logs_meant(paths: Sequence[Path], where: str | None = None) -> Selection:
    """Find the logs that a command uses together: all logs in folders, or a selection from catalogs."""
    if where is None and not any(map(is_catalog, paths)):
        return Selection([log for path in paths for log in logs_in(path)])
    return select_together(paths, where)


def select_together(paths: Sequence[Path], where: str | None = None) -> Selection:
    """Select logs that a command uses together, and warn about those that cannot be read.

    Raises BadInput if no log can be read; see also `select`.
    """
    found = select(paths, where)
    found.require_readable(paths[0])
    terminal.warn(*found.notes)
    return found


def show_catalog(
    paths: Sequence[Path],
    *,
    as_json: bool,
    out: Path | None = None,
    deep: bool = False,
    where: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Describe logs, write the catalog, and print the rows that meet a condition."""
    found = catalogued(
        paths, out, deep=deep, workers=workers, scheduler=scheduler, progress=terminal.progress
    )
    table = found.table
    if where is not None:
        table = rows_where(with_columns(table), where)[[*table]]
    rows = rows_in(table)
    if as_json:
        terminal.print_json({"logs": rows, **found.counts})
        return
    shown = ("log", "MB", "duration (s)", "messages", "topics", "models", "problem")
    if rows:
        terminal.print_table(shown, map(_shown, rows[:MOST_ROWS]))
    if len(rows) > MOST_ROWS:
        terminal.say(f"and {len(rows) - MOST_ROWS} more; --where selects, --json prints all")
    of_all = "" if where is None else f" of {len(found.table)}"
    counts = ", ".join(f"{number} {what}" for what, number in found.counts.items() if number)
    terminal.say(f"{len(rows)}{of_all} logs" + (f"; {out}: {counts}" if out else ""))
    if out is not None:
        terminal.say_next("replay", str(out), "-e", "ekf")


def _shown(row: Row) -> list[object]:
    """Return the cells of a printed row."""
    topics, models = (row[name] or () for name in ("topics", "models"))
    size = [row["log"], row["size_bytes"] * 1e-6, row["duration_s"], row["messages"], len(topics)]
    return [*size, ", ".join(models), row["problem"]]
