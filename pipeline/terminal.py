"""What the terminal shows: progress bars and tables. Standard output is for results alone."""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from pipeline.results import MetricValue, metric_tables

out = Console()
err = Console(stderr=True)


def progress(items: Iterable[Any], title: str, total: int) -> Iterable[Any]:
    """Pass items through with a progress bar on standard error; none where nobody watches."""
    with Progress(console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(title, total=total)
        for item in items:
            yield item
            bar.advance(task)


def print_json(value: Any) -> None:
    """One JSON document on standard output."""
    json.dump(value, sys.stdout, indent=2, allow_nan=False)
    sys.stdout.write("\n")


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A table; numbers are set right."""
    table = Table(title=title or None, title_justify="left")
    body = [list(row) for row in rows]
    for index, column in enumerate(columns):
        numeric = bool(body) and all(isinstance(row[index], int | float | None) for row in body)
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in body:
        table.add_row(*(format_number(value) for value in row))
    out.print(table)


def format_number(value: object) -> str:
    """Four significant digits for floats, text for the rest."""
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def print_metrics(metrics: Mapping[str, MetricValue]) -> None:
    """Metrics as tables: one per case, a row per quantity, a column per estimator."""
    for table in metric_tables(metrics):
        rows = [[quantity, *values] for quantity, values in table.rows]
        print_table(table.case, ["", *table.estimators], rows)
