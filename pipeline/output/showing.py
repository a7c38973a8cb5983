"""Display of objects of the Python interface, as a few lines of text or as tables in a notebook."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from fuselog.pipeline.output.results import Bounds, MetricValue
from fuselog.pipeline.output.terminal import PrintedTable, format_value, printed, tables_of

MOST_SENTENCES = 5


class Shown(NamedTuple):
    """The displayed contents of an object.

    Attributes:
        title: a description in one line.
        sentences: remarks, of which the first few are displayed.
        tables: tables of the object's numbers.
    """

    title: str
    sentences: Sequence[str] = ()
    tables: Sequence[PrintedTable] = ()

    @property
    def text(self) -> str:
        """Return the display as text."""
        return "\n".join([self.title, *self._first(), *map(printed, self.tables)])

    @property
    def html(self) -> str:
        """Return the display as HTML for a notebook's cell."""
        from fuselog.pipeline.output.pages import templates  # slow to import

        page = templates("fuselog.pipeline.output", {"value": format_value}).get_template("shown.html")
        return page.render(lines=self._first(), **self._asdict())

    def _first(self) -> list[str]:
        more = len(self.sentences) - MOST_SENTENCES
        return [*self.sentences[:MOST_SENTENCES], *([f"and {more} more"] if more > 0 else [])]


class Showing(ABC):
    """A base class of objects that display what `_shown` returns, as text or as HTML in a notebook."""

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
) -> Shown:
    """Format metrics for display; if there are several cases, show their medians."""
    return Shown(title, sentences, tables_of(metrics, bounds, most_cases=1))
