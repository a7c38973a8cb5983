"""The report: result folders as one HTML page that fetches nothing and runs only our scripts.

Begin here; `verdict` has the sentences that a section opens with.

Plotly draws the charts: its bundle of basic traces, which is small enough to be in every page, lies here
as its publisher gives it (npm: plotly.js-basic-dist-min 4.1.1, MIT licence).
"""

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from urllib.parse import unquote

import pandas as pd
from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup

from pipeline.output.charts import Chart
from pipeline.output.report.first_run import picture_of_timeline, plan_of_first_run
from pipeline.output.report.naming import distinct_names
from pipeline.output.report.verdict import verdict
from pipeline.output.results import MetricTable, Result, metric_tables, read_result, read_table
from pipeline.output.terminal import format_value
from recorders.atomic import whole_file
from recorders.errors import BadInput
from recorders.parameters import build
from recorders.parsing import parse_json

# Longer tables (one row per step, say) stay in their Parquet and CSV files.
LONGEST_TABLE = 60
_SIGNATURE = b"<!-- fuselog "


@dataclass(frozen=True)
class Shown:
    """A figure of the page, a chart or a picture, and what it says to who cannot see it."""

    name: str
    caption: str
    description: str
    chart: Chart | None = None
    picture: str = ""


@dataclass(frozen=True)
class Section:
    """Holds what the page shows of one result folder; `lead` is what one sees at once."""

    name: str
    result: Result
    verdict: tuple[str, str]
    lead: list[Shown]
    metrics: list[MetricTable]
    tables: dict[str, pd.DataFrame]
    figures: list[Shown]


def write_report(folders: Sequence[Path], page: Path, *, viewer: bool = False) -> None:
    """Render result folders, in the order given, as one HTML page.

    The same folders give the same bytes, but for the pictures that `viewer` takes of their timelines.

    Raises BadInput where a folder holds no result or a damaged one, the page cannot be written, or the
    viewer has no driver.
    """
    results = [read_result(folder) for folder in folders]
    names = distinct_names(results, folders)
    sections = [_section(*each, viewer=viewer) for each in zip(folders, results, names, strict=True)]
    environment = Environment(
        loader=PackageLoader("pipeline.output.report", "."),
        autoescape=select_autoescape(),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"value": format_value, "drawn": _as_json, "hashes": _hashes}
    text = environment.get_template("page.html").render(
        sections=sections,
        style=_asset("page.css"),
        scripts=[_asset("plotly-basic.min.js"), _asset("page.js")],
    )
    with whole_file(page) as new:
        new.write_bytes(_signed(text.encode(errors="backslashreplace")))


def is_report(page: Path) -> bool:
    """Tell whether a file is a page that `write_report` wrote, as it was written."""
    content = page.read_bytes()
    return content == _signed(content.rpartition(_SIGNATURE)[0])


def _signed(page: bytes) -> bytes:
    """The page with its own SHA-256 at its end."""
    return b"%b%b%b -->\n" % (page, _SIGNATURE, hashlib.sha256(page).hexdigest().encode())


def _asset(name: str) -> str:
    return (resources.files("pipeline.output.report") / name).read_text(encoding="utf-8")


def _hashes(scripts: Sequence[str]) -> Markup:
    """The scripts that a browser may run, as a content security policy lists them."""
    digests = [base64.b64encode(hashlib.sha256(each.encode()).digest()).decode() for each in scripts]
    return Markup(" ".join(f"'sha256-{digest}'" for digest in digests))


def _as_json(chart: Chart, estimators: Iterable[str]) -> Markup:
    """A chart for the script, an estimator in one colour in all of a section; `<` ends no element."""
    values = {**chart.model_dump(mode="json"), "colours": chart.colours(estimators)}
    return Markup(json.dumps(values, separators=(",", ":")).replace("<", "\\u003c"))


def _section(folder: Path, result: Result, name: str, *, viewer: bool) -> Section:
    for each in result.files:
        if each.startswith(("figures/", "tables/")) and not (folder / each).is_file():
            raise BadInput(f"{folder}: {each} is missing; run the experiment again")
    try:
        tables = {path.stem: read_table(path) for path in sorted(folder.glob("tables/*.parquet"))}
        figures = sorted(map(_figure, sorted(folder.glob("figures/*.svg"))), key=_rank)
    except (OSError, ValueError) as error:
        raise BadInput(
            f"{folder}: a table or figure is damaged ({error}); run the experiment again"
        ) from error
    short = {
        name: table
        for name, table in tables.items()
        if len(table) <= LONGEST_TABLE and name != "summary"
    }
    lead = [*_first_run(folder, viewer=viewer), *figures[:1]]
    metrics = metric_tables(result.metrics, result.bounds, tables.get("runs"))
    return Section(name, result, verdict(result), lead, metrics, short, figures[1:])


def _rank(shown: Shown) -> tuple[bool, bool, int]:
    """Errors come first, then what is drawn with its intervals; of these, what compares the most."""
    chart = shown.chart or Chart(panels=[])
    has_bands = any(panel.bands for panel in chart.panels)
    return not shown.name.startswith("errors"), not has_bands, -len(chart.colours())


def _figure(path: Path) -> Shown:
    """A figure by its SVG file: as a chart where it is one, else as a picture."""
    name = unquote(path.stem)
    described = path.with_suffix(".json")
    if described.is_file():
        values = parse_json(described.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError(f"{described.name} is not a chart")
        return _chart(name, build(Chart, values, str(described)))
    return Shown(name, name, f"Figure: {name}", picture=_address("svg+xml", path.read_bytes()))


def _chart(name: str, chart: Chart) -> Shown:
    axes = [f"{panel.y.label} over {panel.x.label}" for panel in chart.panels]
    what = f"Chart: {'; '.join(dict.fromkeys(axes))}; {', '.join(chart.colours())}"
    return Shown(name, chart.title or name, what, chart)


def _first_run(folder: Path, *, viewer: bool) -> list[Shown]:
    """The first run in space: as the viewer shows it, or from above where it has paths."""
    if viewer:
        address = _address("webp", picture_of_timeline(folder / "timeline.rrd"))
        return [Shown("", "first run, in the viewer", "The first run in the viewer", picture=address)]
    plan = plan_of_first_run(folder)
    return [] if plan is None else [_chart("", plan)]


def _address(kind: str, image: bytes) -> str:
    """An image as the address of itself; what scripts and links it may hold are dead in it."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
