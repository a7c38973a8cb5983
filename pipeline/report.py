"""The report: result folders as one self-contained HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup

from pipeline.results import MetricTable, Result, metric_tables, read_result
from pipeline.terminal import format_value
from recorders.errors import BadInput

# Longer tables (one row per step, say) stay in their Parquet and CSV files.
LONGEST_TABLE = 60


@dataclass(frozen=True)
class Section:
    """What the page shows of one result folder."""

    result: Result
    metrics: list[MetricTable]
    tables: dict[str, pd.DataFrame]
    figures: dict[str, Markup]


def write_report(folders: Sequence[Path], page: Path) -> None:
    """Render result folders, in the order given, as one HTML page.

    Raises BadInput where a folder holds no result or a damaged one, or the page cannot be written.
    """
    sections = [_section(folder) for folder in folders]
    environment = Environment(loader=PackageLoader("pipeline", "."), autoescape=select_autoescape())
    environment.filters["value"] = format_value
    text = environment.get_template("report.html").render(sections=sections)
    part = page.with_name(page.name + ".part")
    try:
        page.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(page)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise BadInput(f"{page}: cannot be written ({error.strerror})") from error


def _section(folder: Path) -> Section:
    result = read_result(folder)
    try:
        tables = {path.stem: pd.read_parquet(path) for path in sorted(folder.glob("tables/*.parquet"))}
        figures = {path.stem: _inline(path) for path in sorted(folder.glob("figures/*.svg"))}
    except (OSError, ValueError) as error:
        raise BadInput(f"{folder}: a table or figure is damaged ({error}); run it again") from error
    short = {
        name: table
        for name, table in tables.items()
        if len(table) <= LONGEST_TABLE and name != "summary"
    }
    return Section(result, metric_tables(result.metrics), short, figures)


def _inline(path: Path) -> Markup:
    """An SVG figure as part of the page, without its XML prologue."""
    text = path.read_text(encoding="utf-8")
    return Markup(text[text.index("<svg") :])
