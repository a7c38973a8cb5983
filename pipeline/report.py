"""The report: result folders as one self-contained HTML page."""

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import pandas as pd
from jinja2 import Environment, PackageLoader, select_autoescape

from pipeline.results import MetricTable, Result, metric_tables, read_result
from pipeline.terminal import format_value
from recorders.atomic import whole_file
from recorders.errors import BadInput

# Longer tables (one row per step, say) stay in their Parquet and CSV files.
LONGEST_TABLE = 60
_SIGNATURE = b"<!-- fuselog "


@dataclass(frozen=True)
class Section:
    """What the page shows of one result folder."""

    result: Result
    metrics: list[MetricTable]
    tables: dict[str, pd.DataFrame]
    figures: dict[str, str]


def write_report(folders: Sequence[Path], page: Path) -> None:
    """Render result folders, in the order given, as one HTML page.

    Raises BadInput where a folder holds no result or a damaged one, or the page cannot be written.
    """
    sections = [_section(folder) for folder in folders]
    environment = Environment(loader=PackageLoader("pipeline", "."), autoescape=select_autoescape())
    environment.filters["value"] = format_value
    text = environment.get_template("report.html").render(sections=sections)
    with whole_file(page) as new:
        new.write_bytes(_signed(text.encode(errors="backslashreplace")))


def is_report(page: Path) -> bool:
    """Whether a file is a page that `write_report` wrote, as it was written."""
    content = page.read_bytes()
    return content == _signed(content.rpartition(_SIGNATURE)[0])


def _signed(page: bytes) -> bytes:
    """The page with its own SHA-256 at its end."""
    return b"%b%b%b -->\n" % (page, _SIGNATURE, hashlib.sha256(page).hexdigest().encode())


def _section(folder: Path) -> Section:
    result = read_result(folder)
    try:
        tables = {path.stem: _read_table(path) for path in sorted(folder.glob("tables/*.parquet"))}
        figures = {unquote(path.stem): _as_image(path) for path in sorted(folder.glob("figures/*.svg"))}
    except (OSError, ValueError) as error:
        raise BadInput(f"{folder}: a table or figure is damaged ({error}); run it again") from error
    short = {
        name: table
        for name, table in tables.items()
        if len(table) <= LONGEST_TABLE and name != "summary"
    }
    return Section(result, metric_tables(result.metrics), short, figures)


def _read_table(path: Path) -> pd.DataFrame:
    with path.open("rb") as file:
        return pd.read_parquet(file)


def _as_image(path: Path) -> str:
    """An SVG figure as the address of an image: what scripts and links it may hold are dead there."""
    return "data:image/svg+xml;base64," + base64.b64encode(path.read_bytes()).decode()
