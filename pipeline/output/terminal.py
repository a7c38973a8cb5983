"""Progress bars and tables on the terminal; standard output is for results only.

Texts from logs and file names may contain control characters, which are printed as visible codes.
"""

import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from io import StringIO
from time import monotonic
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from fuselog.pipeline.output.words import MISSING
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import printable
from fuselog.replay.judging.intervals import FEWEST_RUNS, too_few
from fuselog.replay.judging.verdicts import Claimed

if TYPE_CHECKING:
    import pandas as pd

    from fuselog.pipeline.output.claims import Claim
    from fuselog.pipeline.output.results import Bounds, Measured, MetricTable, MetricValue
    from fuselog.recorders.log import Log

# With more cases than this, metrics are summarised, and only files list each case.
MOST_CASES = 6
# Interval between progress lines if standard error is not a terminal.
TOLD_EVERY_S = 60.0


def _console(*, stderr: bool) -> Console:
    """Make a console for plain text that is as wide as the terminal, or very wide without a terminal."""
    console = Console(stderr=stderr, highlight=False, markup=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = 1000
    return console


MOST_ALARMS = 5  # number of warnings printed
out = _console(stderr=False)
err = _console(stderr=True)


class OnceAMinute:
    """Progress lines on standard error if it is not a terminal, at most one a minute."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Start timing when a command begins, so that its first progress line appears after a minute."""
        self._last_s = monotonic()

    def tell(self, text: str) -> None:
        """Write a line, unless the last line or the start of the command was less than a minute ago."""
        now_s = monotonic()
        if now_s - self._last_s >= TOLD_EVERY_S:
            self._last_s = now_s
            warn(text)


once_a_minute = OnceAMinute()


def progress(items: Iterable[Any], title: object, total: int | None) -> Iterable[Any]:
    """Yield items with a progress bar on standard error, or one line a minute if it is not a terminal.

    The title is converted to text again after every item, because it may report progress.
    """
    if not err.is_terminal:
        for done, item in enumerate(items, start=1):
            yield item
            once_a_minute.tell(f"{title}: {done}" + ("" if total is None else f" of {total}"))
        return
    from rich.progress import MofNCompleteColumn, Progress  # slow to import

    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(str(title), total=total)
        for item in items:
            yield item
            bar.update(task, advance=1, description=str(title))


@contextmanager
def status() -> Iterator[Callable[[str], None]]:
    """Show progress in one line on standard error, or one line a minute if it is not a terminal."""
    with err.status("", spinner="line") if err.is_terminal else nullcontext() as line:

        def show(text: str) -> None:
            if line is not None:
                line.update(printable(text))
            else:
                once_a_minute.tell(text)

        yield show


def say(*texts: str) -> None:
    """Print lines without line breaks, so that paths stay whole."""
    for text in texts:
        out.print(printable(text), soft_wrap=True)


def say_next(*words: str) -> None:
    """Suggest the next command."""
    say(f"next: {shlex.join(['fuselog', *words])}")


def warn(*texts: str) -> None:
    """Print lines on standard error."""
    for text in texts:
        err.print(printable(f"fuselog: {text}"), soft_wrap=True)


def warn_of_losses(logs: "Iterable[Log]") -> None:
    """Print what could not be read of damaged logs."""
    for log in logs:
        if log.loss_statement:
            warn(log.loss_statement)


def print_json(value: Any) -> None:
    """Print one complete JSON document; numbers that are not finite become null."""
    sys.stdout.write(json.dumps(_finite(value), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class PrintedTable(NamedTuple):
    """A table to be printed."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> None:
    """Print a table; numeric columns are right-aligned, long texts are wrapped."""
    out.print(_drawn(PrintedTable(title, columns, list(rows))))


def printed(table: PrintedTable) -> str:
    """Format a table as text."""
    console = Console(file=StringIO(), highlight=False, markup=False, emoji=False, width=1000)
    with console.capture() as captured:
        console.print(_drawn(table))
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def _drawn(printed: PrintedTable) -> Table:
    title, columns, body = printed
    table = Table(
        title=printable(title) or None,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        show_edge=False,
    )
    for index, column in enumerate(columns):
        numeric = bool(body) and all(isinstance(row[index], int | float | None) for row in body)
        table.add_column(printable(column), justify="right" if numeric else "left", overflow="fold")
    for row in body:
        table.add_row(*(printable(format_value(value)) for value in row))
    return table


def format_value(value: object) -> str:
    """Format a value: floats with four digits, long lists of numbers as their range, others as text.

    Missing values, such as NaN and infinity, are empty; see `is_value`.
    """
    if isinstance(value, list):
        known = [each for each in value if is_value(each)]
        if any(isinstance(each, dict) for each in known):
            return f"{len(value)} tables"
        if any(isinstance(each, list) for each in known):
            return ", ".join(map(format_value, value))
        if len(known) > 4 and all(isinstance(each, int | float) for each in known):
            return f"{format_value(min(known))} to {format_value(max(known))}"
        return " ".join(format_value(each) or MISSING for each in value)
    if not is_value(value):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def is_value(value: object) -> bool:
    """Test whether a cell has a value; None, NaN, infinity and pandas' missing values do not count.

    >>> [is_value(each) for each in (0.0, "", None, math.nan, math.inf)]
    [True, True, False, False, False]
    """
    if isinstance(value, float):
        return math.isfinite(value)
    return value is not None and type(value).__name__ not in ("NAType", "NaTType")


def has_many_cases(metrics: "Mapping[str, MetricValue]") -> bool:
    """Test whether the metrics have too many cases to be printed one by one."""
    return _number_of_cases(metrics) > MOST_CASES


def _number_of_cases(metrics: "Mapping[str, MetricValue]") -> int:
    from fuselog.pipeline.output.results import split_metric  # slow to import

    return len({split_metric(key)[2] for key in metrics} - {""})


def print_metrics(
    metrics: "Mapping[str, MetricValue]",
    bounds: "Mapping[str, Bounds]",
    runs: "pd.DataFrame | None" = None,
    details: str = "--json",
) -> None:
    """Print metrics as tables, one per case, with a row per quantity and a column per estimator.

    If a value has bounds (the 95 % range of a consistent estimator), the bounds follow the value. If
    there is a table of runs, the mean NEES over the runs is added, or the reason why it is missing (see
    `metric_tables`). Many cases are summarised in one table of medians; `details` names the place that
    lists each case.
    """
    for title, columns, rows in tables_of(metrics, bounds, runs):
        print_table(columns, rows, title)
    if runs is not None and {"run", "nees"} <= {*runs} and 1 < runs["run"].nunique() < FEWEST_RUNS:
        say(f"nees: its mean over the runs has no interval: {too_few(runs['run'].nunique())}")
    if has_many_cases(metrics):
        say(f"each of the {_number_of_cases(metrics)} cases separately: {details}")


def tables_of(
    metrics: "Mapping[str, MetricValue]",
    bounds: "Mapping[str, Bounds]",
    runs: "pd.DataFrame | None" = None,
    most_cases: int = MOST_CASES,
) -> list[PrintedTable]:
    """Make the tables of metrics, or of their medians if there are more cases than `most_cases`."""
    from fuselog.pipeline.output.results import Measured, metric_tables  # slow to import

    tables = metric_tables(metrics, bounds, runs)
    is_summarised = _number_of_cases(metrics) > most_cases
    found = []
    for table in tables:
        if table.case and is_summarised:
            continue
        rows = []
        for quantity, values in table.quantities.items():
            cells = [values.get(estimator, Measured()) for estimator in table.estimators]
            rows.append([quantity, *map(_with_bounds, cells)])
        found.append(PrintedTable(table.case, ["", *table.estimators], rows))
    return [*found, _over_cases([table for table in tables if table.case])] if is_summarised else found


def _over_cases(tables: "Sequence[MetricTable]") -> PrintedTable:
    """Make a table of the median, minimum and maximum over cases, with a row per quantity."""
    estimators = tables[0].estimators
    rows = [
        [quantity, *(_spread(of.get(estimator, [])) for estimator in estimators)]
        for quantity, of in over_cases(tables).items()
    ]
    title = f"{len(tables)} cases: median over the cases that have the metric (minimum to maximum)"
    return PrintedTable(title, ["", *estimators], rows)


def over_cases(tables: "Sequence[MetricTable]") -> dict[str, dict[str, list[float]]]:
    """Collect the finite numbers of all tables, by quantity and estimator."""
    found: dict[str, dict[str, list[float]]] = {}
    for table in tables:
        for quantity, values in table.quantities.items():
            for estimator, each in values.items():
                if isinstance(each.value, int | float) and math.isfinite(each.value):
                    found.setdefault(quantity, {}).setdefault(estimator, []).append(float(each.value))
    return found


def _spread(values: Sequence[float]) -> str | None:
    if not values:
        return None
    least, middle, greatest = map(format_value, (min(values), float(np.median(values)), max(values)))
    return middle if least == greatest else f"{middle} ({least} to {greatest})"


def _with_bounds(measured: "Measured") -> object:
    if not measured.bounds or not measured.place:
        return measured.value
    low, high = map(format_value, measured.bounds)
    return f"{format_value(measured.value)} ({low} to {high})"


def print_pose_errors(metrics: Mapping[str, float]) -> None:
    """Print APE and RPE with a column per statistic, then the numbers of poses and pairs."""
    rows: dict[str, dict[str, float]] = {}
    counts = []
    for key, value in metrics.items():
        found = re.fullmatch(r"(ape|rpe)_(translation|rotation)_(\w+)_(m|deg)", key)
        if found is None:
            counts.append(f"{value:.0f} {key.replace('_', ' ')}")
            continue
        error, of, statistic, unit = found.groups()
        rows.setdefault(f"{error.upper()} {of} ({unit})", {})[statistic] = value
    names = next(iter(rows.values()))
    print_table(["", *names], [[row, *values.values()] for row, values in rows.items()])
    say(", ".join(counts))


def print_parameters(
    parameters: Mapping[str, Mapping[str, object]], stated: Mapping[str, Mapping[str, str]] | None = None
) -> None:
    """Print the parameters of estimators, with a row per parameter and a column per estimator label.

    Parameters from a log's channels come last, with the topic of the channel.
    """
    names = dict.fromkeys(name for values in parameters.values() for name in values)
    rows = [[name, *(values.get(name) for values in parameters.values())] for name in names]
    print_table(["parameter", *parameters], rows)
    if stated and any(stated.values()):
        print_parameters({f"{label}, from the log": values for label, values in stated.items()})


def print_worst(alarms: Sequence[Finding]) -> None:
    """Print the worst warning about the numbers that follow."""
    for alarm in alarms[:1]:
        say(f"doubtful: {alarm.sentence}")


def print_others(alarms: Sequence[Finding]) -> None:
    """Print a few of the other warnings."""
    for alarm in alarms[1:MOST_ALARMS]:
        say(f"also doubtful: {alarm.sentence}")
    if len(alarms) > MOST_ALARMS:
        say(f"and {len(alarms) - MOST_ALARMS} more; --json lists them all")


def print_claims(claims: "Sequence[Claim]") -> None:
    """Print the claims with the paper's and our numbers, after a line on claims without a verdict."""
    elsewhere = sum(claim.verdict == Claimed.NO_VERDICT for claim in claims)
    if elsewhere:
        say(
            f"{elsewhere} of {len(claims)} claims are about another recording: their numbers follow, "
            "without a verdict"
        )
    for claim in claims:
        say(f"{claim.verdict}: {claim.claim}")
        say(f"  paper: {claim.paper}; ours: {claim.ours}" + (f"; {claim.why}" if claim.why else ""))
