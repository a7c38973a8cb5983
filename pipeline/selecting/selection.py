"""The logs that a condition selects from the rows of a catalog."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fuselog.pipeline.selecting.catalog import read_current, with_columns
from fuselog.pipeline.selecting.where import rows_where
from fuselog.recorders.errors import BadInput, choices, some_of
from fuselog.recorders.remote.paths import located

if TYPE_CHECKING:
    import pandas as pd

MOST_NAMED = 3  # largest number of logs that notes name


class SelectionOptions(NamedTuple):
    """The options with which a command selects logs and the workers that process each log by itself.

    Attributes:
        paths: logs, folders of logs, and catalogs.
        where: a condition on the columns of the catalogs.
        group: the column that names the group of each log.
        workers: the number of processes.
        scheduler: the address of a Dask scheduler.
    """

    paths: Sequence[Path]
    where: str | None = None
    group: str | None = None
    workers: int | None = None
    scheduler: str | None = None

    @property
    def stated(self) -> dict[str, Any]:
        """Return the settings that a result states of the selection."""
        conditions = {"where": self.where, "group": self.group}
        given = {name: value for name, value in conditions.items() if value is not None}
        return {**given, "selection": [str(path) for path in self.paths]}


@dataclass(frozen=True)
class Selection:
    """The logs to which the paths of a command refer.

    Attributes:
        logs: the logs that can be read.
        groups: the group of each log, such as its robot; empty if no column is named.
        unreadable: why other logs cannot be read.
    """

    logs: Sequence[Path]
    groups: Sequence[str] = ()
    unreadable: Mapping[Path, str] = field(default_factory=dict)

    def require_readable(self, path: Path) -> None:
        """Raise BadInput if no log can be read."""
        if not self.logs:
            log, why = next(iter(self.unreadable.items()))
            raise BadInput(f"{path}: no selected log can be read; {log}: {why}")

    @property
    def notes(self) -> Iterator[str]:
        """Yield sentences on the logs that cannot be read."""
        yield from notes_of(self.unreadable)


def notes_of(left_out: Mapping[Any, str]) -> Iterator[str]:
    """Yield sentences on logs that are left out, with the reasons of the first ones."""
    for log, why in list(left_out.items())[:MOST_NAMED]:
        yield f"{log}: left out: {why}"
    if len(left_out) > MOST_NAMED:
        yield f"{len(left_out) - MOST_NAMED} other logs are left out as well"


def table_of(left_out: Mapping[Any, str]) -> "pd.DataFrame":
    """Return a table with a row for each log that is left out, with the reason."""
    import pandas as pd  # slow to import

    rows = [(str(log), why) for log, why in left_out.items()]
    return pd.DataFrame(rows, columns=["log", "problem"])


def of_catalog(path: Path, where: str | None = None) -> Selection:
    """Select logs from a catalog; see `selected`."""
    return selected(with_columns(read_current(path)), str(path), where)


def selected(
    table: "pd.DataFrame", name: str, where: str | None = None, group: str | None = None
) -> Selection:
    """Select the logs whose rows meet a condition.

    Args:
        table: the rows of catalogs, with all columns.
        name: the name of the table for messages.
        where: the condition.
        group: the column that names the group of each log.

    Raises BadInput if no log meets the condition, there is no such column, or a log has no value there.
    """
    if where is not None:
        table = rows_where(table, where)
    if table.empty:
        condition = "" if where is None else f" meets --where {where}"
        raise BadInput(f"{name}: no log{condition}; fuselog catalog shows the rows")
    if group is not None and group not in table:
        raise BadInput(
            f"--group: no column '{group}' in the catalog; {choices(group, [*map(str, table)])}"
        )
    bad = table["problem"].notna()
    logs = [located(log) for log in table["log"][~bad]]
    groups = [] if group is None else table[group][~bad].astype(str).tolist()
    if group is not None and (unknown := table["log"][~bad & table[group].isna()]).size:
        raise BadInput(
            f"--group {group}: no value for {some_of(unknown, MOST_NAMED)}; "
            f'fill the column, or leave these logs out with --where "{group} == {group}"'
        )
    why = {
        located(log): str(of) for log, of in zip(table["log"][bad], table["problem"][bad], strict=True)
    }
    return Selection(logs, groups, why)
