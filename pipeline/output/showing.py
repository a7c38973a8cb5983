"""Shows what an object of the Python interface holds: in a few lines, and as tables in a notebook."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, NamedTuple

from fuselog.pipeline.output.results import Bounds, MetricValue
from fuselog.pipeline.output.terminal import PrintedTable, format_value, printed, tables_of

if TYPE_CHECKING:
    import pandas as pd

MOST_SENTENCES = 5


class Shown(NamedTuple):
    """Holds what is shown of an object.

    Attributes:
        title: what it is, in a line.
        sentences: what has to be known of it, of which the first few are shown.
        tables: its numbers.
    """

    title: str
    sentences: Sequence[str] = ()
    tables: Sequence[PrintedTable] = ()

    @property
    def text(self) -> str:
        """Return it as text."""
        return "\n".join([self.title, *self._first(), *map(printed, self.tables)])

    @property
    def html(self) -> str:
        """Return it as HTML for a notebook's cell."""
        lines = [f"<b>{escape(self.title)}</b>", *map(escape, self._first())]
        return "".join(f"<div>{line}</div>" for line in lines) + "".join(map(_html, self.tables))

    def _first(self) -> list[str]:
        more = len(self.sentences) - MOST_SENTENCES
        return [*self.sentences[:MOST_SENTENCES], *([f"and {more} more"] if more > 0 else [])]


class Showing(ABC):
    """Prints as what `_shown` gives: as text, and as HTML in a notebook."""

    @property
    @abstractmethod
    def _shown(self) -> Shown: ...

    def __repr__(self) -> str:
        return self._shown.text

    def _repr_html_(self) -> str:
        return self._shown.html


def shown_metrics(
    title: str,
    sentences: Sequence[str],
    metrics: Mapping[str, MetricValue],
    bounds: Mapping[str, Bounds],
    runs: "pd.DataFrame | None" = None,
) -> Shown:
    """Show metrics: of several cases the medians."""
    return Shown(title, sentences, tables_of(metrics, bounds, runs, most_cases=1))


def _html(table: PrintedTable) -> str:
    cells = [[escape(format_value(value)) for value in row] for row in table.rows]
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in cells)
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
