"""The report, which shows results as one HTML page that loads nothing and runs only our scripts.

Begin here. `kinds` writes the opening of a section, `story` writes the advice and the cards, and `scene`
draws the pictures of a run.

Plotly draws the charts. Plotly's bundle of basic traces, small enough to be part of every page, is in
this folder as published (npm: plotly.js-basic-dist-min 4.1.1, MIT licence).
"""

import base64
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple
from urllib.parse import unquote

import pandas as pd
from jinja2 import Template
from markdown_it import MarkdownIt
from markupsafe import Markup, escape

from fuselog.pipeline.output.alarms import Cause
from fuselog.pipeline.output.charts import COLOURS, Chart
from fuselog.pipeline.output.pages import templates
from fuselog.pipeline.output.report.evidence import Findings, Timings
from fuselog.pipeline.output.report.first_run import first_run, picture_of_timeline
from fuselog.pipeline.output.report.glossary import Term, glossary
from fuselog.pipeline.output.report.kinds import Opening, opening
from fuselog.pipeline.output.report.scene import lens, nis_chart, plan, tracked
from fuselog.pipeline.output.report.sheet import Sheet, sheets, table_of_pairs
from fuselog.pipeline.output.report.sweeps import RUNS_TABLE
from fuselog.pipeline.output.results import TIMINGS, Result, read_result, read_table, split_metric
from fuselog.pipeline.output.terminal import format_value, is_value
from fuselog.pipeline.output.words import QUANTITIES, TRACKING, count, label_of, listed, quantity
from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters, build
from fuselog.recorders.parsing import parse_json

# Colours of estimators, the same in all sections of a page.
USUAL = ("dead-reckoning", "ekf", "ukf")
# Longer tables, such as one row per step, are only in their Parquet and CSV files.
LONGEST_TABLE = 60
SCENES = ("scene", "lens")  # figures to keep for a comparison, which has no logs to draw
MOST_DOUBTS = 3  # doubts on the first screen; the others are folded
_SIGNATURE = b"<!-- fuselog "
_MARKDOWN = MarkdownIt("commonmark", {"html": False}).disable("image")

_NAMED = re.compile(r"at ([\d.]+) s of run (\d+)")

# Background colours behind names; the first of each tuple is that of the page.
# A section is named after its experiment and the settings in which it differs from the others. The
# colour of a curve is made dark or light enough for text.
LIGHT, DARK = ("#ffffff", "#fdf1f5"), ("#14171a", "#2a1a20")
READABLE = 4.6  # WCAG 2.2, 1.4.3 asks for 4.5 to 1


def distinct_names(results: Sequence[Result], folders: Sequence[Path]) -> list[str]:
    """Name results by experiment and by the settings that differ between results of the experiment.

    Results with the same experiment and settings are distinguished by their folders.
    """
    names = [
        _name(result, [each for each in results if each.experiment == result.experiment])
        for result in results
    ]
    return [
        f"{name} ({folder})" if names.count(name) > 1 else name
        for name, folder in zip(names, folders, strict=True)
    ]


def _name(result: Result, alike: Sequence[Result]) -> str:
    settings = [dict(_flat(each.settings)) for each in alike]
    own = dict(_flat(result.settings))
    # an estimator's settings are already among its parameters
    given = {key[1:] for each in settings for key in each if key[0] == "estimators"}
    keys = dict.fromkeys(
        key
        for each in settings
        for key in each
        if key not in (("title",), ("candidates",)) and not (key[0] == "parameters" and key[1:] in given)
    )
    differing = [key for key in keys if any(each.get(key) != own.get(key) for each in settings)]
    lasts = [key[-1] for key in differing]
    differences = [
        f"{key[-1] if lasts.count(key[-1]) == 1 else '.'.join(key)} "
        + (format_value(own[key]) if key in own else "default")
        for key in differing
    ]
    return ": ".join(filter(None, [result.experiment, ", ".join(differences)]))


def _flat(
    values: Mapping[str, Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all nested settings, with the names that lead to each."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, (*path, name))
        else:
            yield (*path, name), value


def title_of(result: Result, labels: Sequence[str], runs: int) -> str:
    """Write the heading of a result: the experiment's title, or the command and the logs."""
    settings = result.settings
    title = str(settings.get("title") or result.experiment)
    if result.made_by == "compare":
        return f"{listed(list(labels))}, compared"
    if isinstance(settings.get("logs"), Mapping):
        title = f"{title}: {listed(list(labels)) or count(runs, 'run')}"
    return f"{title}, parameter sweep" if result.made_by == "sweep" else title


def luminance(colour: str) -> float:
    """Compute the relative luminance of a colour such as `#2f7fd1`, from 0 to 1 (WCAG 2.2)."""
    channels = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    linear = [each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Compute the contrast ratio of two colours, from 1 to 21."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def readable(colour: str, grounds: tuple[str, ...], towards: int) -> str:
    """Mix the colour with black (0) or white (255) until it is readable on all backgrounds."""
    channels = [int(colour[place : place + 2], 16) for place in (1, 3, 5)]
    for share in range(0, 101, 2):
        mixed = [round(each + (towards - each) * share / 100) for each in channels]
        text = "#" + "".join(f"{each:02x}" for each in mixed)
        if all(contrast(text, ground) >= READABLE for ground in grounds):
            return text
    raise AssertionError("black or white is readable on any background")


@cache
def text_colours() -> list[tuple[str, str]]:
    """Return, for each curve colour, text colours for the light and the dark page."""
    return [(readable(each, LIGHT, 0), readable(each, DARK, 255)) for each in COLOURS]


class NamedRun(NamedTuple):
    """A run that the report names: a sentence about it, and the command that opens it."""

    words: str
    command: str


def worst_runs(folder: Path, result: Result, found: Findings) -> list[NamedRun]:
    """Name the run with the largest error of each estimator, and runs that warnings name.

    Returns an empty list unless the result has several runs that can be opened one by one.
    """
    if result.made_by != "run" or found.runs < 2 or "study" not in result.settings:
        return []
    named = []
    for label in found.compared:
        errors = found.by_run(label, found.main)
        if len(errors):
            run, most = max(errors.items(), key=lambda each: each[1])
            words = f"{label}: the largest {quantity(found.main).name}, {most:.3g}, is that of run {run}"
            named.append(NamedRun(words, _command(folder, run, f"worst:{label}")))
    for alarm in result.alarms:
        if match := _NAMED.search(alarm.sentence):
            words = f"{alarm.where}: a warning is about {match[1]} s of run {match[2]}"
            named.append(NamedRun(words, _command(folder, match[2], match[1])))
    return named


def _command(folder: Path, run: object, at: str) -> str:
    return f"fuselog view {quote(str(folder))} --runs {run} --at {quote(at)}"


class _Timings(Parameters):
    """The content of timings.json: run time in s and number of messages by estimator."""

    of: dict[str, dict[str, float]]


@dataclass(frozen=True)
class Shown:
    """A figure on the page (a chart or a picture), with a description for screen readers."""

    name: str
    caption: str
    description: str
    chart: Chart | None = None
    picture: str = ""


@dataclass(frozen=True)
class Section:
    """The contents of a page about one result folder, from top to bottom."""

    name: str
    title: str
    result: Result
    labels: list[str]
    opening: Opening
    text: Markup
    looks: list[Shown]
    over_time: list[Shown]
    legend: str
    sheet: Sheet | None
    sheets: list[Sheet]
    worst: list[NamedRun]
    tables: dict[str, pd.DataFrame]
    figures: list[Shown]
    glossary: list[Term] = field(default_factory=list)


def write_report(
    folders: Sequence[Path],
    page: Path,
    *,
    viewer: bool = False,
    diagnose: Callable[[Path, Result], Sequence[Cause]] | None = None,
) -> None:
    """Render result folders, in the given order, as one HTML page.

    Pages of the same folders are identical byte for byte, except for screenshots (`viewer`). With
    `diagnose`, results without a diagnosis are diagnosed first.

    Raises BadInput if a folder's result is missing or damaged, if the page cannot be written, or if the
    viewer has no graphics driver.
    """
    results = [read_result(folder) for folder in folders]
    if diagnose is not None:
        results = [
            each if each.causes else each.model_copy(update={"causes": [*diagnose(folder, each)]})
            for folder, each in zip(folders, results, strict=True)
        ]
    names = distinct_names(results, folders)
    sections = [_section(*each, viewer=viewer) for each in zip(folders, results, names, strict=True)]
    text = _template().render(
        MOST_DOUBTS=MOST_DOUBTS,
        text_colours=text_colours(),
        sections=sections,
        style=_asset("page.css"),
        scripts=[_asset("plotly-basic.min.js"), _asset("page.js")],
        terms=list(dict.fromkeys(term for section in sections for term in section.glossary)),
    )
    with whole_file(page) as new:
        new.write_bytes(_signed(text.encode(errors="backslashreplace")))


@cache
def _template() -> Template:
    filters = {
        "value": format_value,
        "empty": empty_cells,
        "drawn": _as_json,
        "hashes": _hashes,
        "named": _named,
        "hues": _hues,
    }
    return templates("fuselog.pipeline.output.report", filters).get_template("page.html")


def is_report(page: Path) -> bool:
    """Test whether a file is an unchanged page that `write_report` wrote."""
    content = page.read_bytes()
    return content == _signed(content.rpartition(_SIGNATURE)[0])


def _signed(page: bytes) -> bytes:
    """Append the SHA-256 of the page as its signature."""
    return b"%b%b%b -->\n" % (page, _SIGNATURE, hashlib.sha256(page).hexdigest().encode())


def empty_cells(table: pd.DataFrame) -> list[str]:
    """Explain why cells of a table are empty: no input data, or an infinite value."""
    cells = [value for row in table.itertuples(index=False) for value in row if not is_value(value)]
    infinite = sum(isinstance(value, float) and math.isinf(value) for value in cells)
    counts = {
        "no input data": len(cells) - infinite,
        "the result is infinite": infinite,
    }
    return [f"{count(of, 'cell')} without a value: {why}." for why, of in counts.items() if of]


def _asset(name: str) -> str:
    return (resources.files("fuselog.pipeline.output.report") / name).read_text(encoding="utf-8")


def _hashes(scripts: Sequence[str]) -> Markup:
    """List the hashes of scripts that a browser may run, for the content security policy."""
    digests = [base64.b64encode(hashlib.sha256(each.encode()).digest()).decode() for each in scripts]
    return Markup(" ".join(f"'sha256-{digest}'" for digest in digests))


def _as_json(chart: Chart, estimators: Iterable[str]) -> Markup:
    """Write a chart as JSON for the script, with a fixed colour for each estimator and `<` escaped."""
    values = {**chart.model_dump(mode="json"), "colours": chart.colours(estimators)}
    return Markup(json.dumps(values, separators=(",", ":")).replace("<", "\\u003c"))


def _hues(labels: Sequence[str]) -> dict[str, str]:
    """Assign to each estimator the CSS class of its colour."""
    return {label: f"e{place % len(text_colours())}" for place, label in enumerate(labels)}


def _named(text: str, labels: Sequence[str]) -> Markup:
    """Format a sentence as HTML in which the names of estimators are coloured."""
    hues = _hues(labels)
    if not hues:
        return escape(text)
    longest = sorted(map(re.escape, hues), key=len, reverse=True)
    parts = re.split(rf"(?<![\w:.-])({'|'.join(longest)})(?![\w-]|[:.]\w)", text)
    return Markup("").join(
        Markup('<b class="{}">{}</b>').format(hues[part], part) if place % 2 else escape(part)
        for place, part in enumerate(parts)
    )


def _section(folder: Path, result: Result, name: str, *, viewer: bool) -> Section:
    for each in result.files:
        if each.startswith(("figures/", "tables/")) and not (folder / each).is_file():
            raise BadInput(f"{folder}: {each} is missing; run the experiment again")
    try:
        tables = {path.stem: read_table(path) for path in sorted(folder.glob("tables/*.parquet"))}
        figures = sorted(map(_figure, sorted(folder.glob("figures/*.svg"))), key=_rank)
    except (OSError, ValueError) as error:
        raise BadInput(f"{folder}: a figure is damaged ({error}); run the experiment again") from error
    begun = opening(result, tables, _timings(folder, result))
    labels = [*(result.settings.get("estimators") or {}), *begun.found.labels, *begun.found.bounds]
    labels = list(dict.fromkeys(map(str, labels)))
    looks = [_chart("", begun.chart)] if begun.chart else []
    order = [card.estimator for card in begun.story.cards] or labels
    looks += _first_run(folder, order, begun.found, viewer=viewer)
    if result.made_by == "compare":
        looks += [each for name in SCENES for each in figures if each.name == name]
        figures = [each for each in figures if each.name not in SCENES]
    if result.made_by == "sweep" or not looks or looks[-1].name == "tracks":
        looks, figures = [*looks, *figures[:2]], figures[2:]
    over_time = [each for each in figures if each.name.startswith("errors")][:1]
    nis = nis_chart(folder, [label for label in labels if label in begun.found.labels])
    figures = [each for each in figures if each not in over_time]
    sheet, each_case = sheets(begun.found)
    short = {
        key: table
        for key, table in tables.items()
        if len(table) <= LONGEST_TABLE and key not in ("summary", "runs", RUNS_TABLE)
    }
    if begun.found.pairs:
        short["differences between pairs, with 95 % intervals over the runs"] = table_of_pairs(
            begun.found
        )
    keys = {split_metric(key)[1] for key in result.metrics} | {
        row.key for rows in (sheet.groups.values() if sheet else ()) for row in rows
    }
    return Section(
        name,
        title_of(result, labels, begun.found.runs),
        result,
        list(dict.fromkeys([*USUAL, *labels])) if {*USUAL} & {*labels} else labels,
        begun,
        Markup(_MARKDOWN.render(str(result.settings.get("text") or ""))),  # escapes HTML
        looks,
        [*over_time, *([_chart("nis", nis)] if nis else [])],
        _legend(begun),
        sheet,
        each_case,
        worst_runs(folder, result, begun.found),
        short,
        figures,
        glossary(keys, draws=bool(begun.story.draws)),
    )


def _legend(begun: Opening) -> str:
    """Explain the quantity by which estimators are compared, if it is not a plain error."""
    by = quantity(begun.found.main) if begun.found.compared else None
    return f"{by.name}: {by.meaning} Lower is better." if by and by.group == TRACKING else ""


def _timings(folder: Path, result: Result) -> Timings:
    """Read the timings of estimators; return {} if the result has no timings."""
    path = folder / TIMINGS
    if TIMINGS not in result.files or not path.is_file():
        return {}
    try:
        return dict(build(_Timings, {"of": parse_json(path.read_text(encoding="utf-8"))}, str(path)).of)
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read ({error}); run the experiment again") from None


def _rank(shown: Shown) -> tuple[bool, bool, int]:
    """Return a sort key for figures: errors first, then intervals, then figures with the most curves."""
    chart = shown.chart or Chart(panels=[])
    has_bands = any(panel.bands for panel in chart.panels)
    return (
        "rmse" not in shown.name and not shown.name.startswith("errors"),
        not has_bands,
        -len(chart.colours()),
    )


def _figure(path: Path) -> Shown:
    """Load a figure by its SVG file: as a chart if it has a description, else as a picture."""
    name = unquote(path.stem)
    described = path.with_suffix(".json")
    if described.is_file():
        values = parse_json(described.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError(f"{described.name} is not a chart")
        return _chart(name, build(Chart, values, str(described)))
    key, _, case = name.partition("-")
    words = f"{label_of(key)}{f' of {case}' if case else ''}" if key in QUANTITIES else name
    return Shown(name, words, f"Figure: {words}", picture=_address("svg+xml", path.read_bytes()))


def _chart(name: str, chart: Chart) -> Shown:
    axes = [f"{panel.y.label} over {panel.x.label}" for panel in chart.panels]
    titles = filter(None, (panel.title for panel in chart.panels))
    what = f"Chart: {'; '.join(dict.fromkeys([*axes, *titles]))}; {', '.join(chart.colours())}"
    return Shown(name, chart.title or re.sub("[-_]", " ", name), what, chart)


def _first_run(folder: Path, order: Sequence[str], found: Findings, *, viewer: bool) -> list[Shown]:
    """Show the first run, as the viewer draws it or from above with a magnified detail."""
    if viewer:
        address = _address("webp", picture_of_timeline(folder / "timeline.rrd"))
        return [Shown("", "first run in the viewer", "The first run in the viewer", picture=address)]
    run = first_run(folder)
    if run is None:
        first = next((label for label in order if label in found.compared), "")
        of_what = f"{quantity(found.main).name} of {first}"
        tracks = tracked(folder, order, _errors_by_case(found, first), of_what)
        return [_chart("tracks", tracks)] if tracks else []
    near = lens(run, order)
    return [_chart("scene", plan(run)), *([_chart("lens", near)] if near else [])]


def _errors_by_case(found: Findings, label: str) -> dict[str, float]:
    """Return an estimator's error in each case."""
    by_case = {each.case: each.quantities.get(found.main, {}).get(label) for each in found.tables}
    return {
        case: float(each.value)
        for case, each in by_case.items()
        if each and isinstance(each.value, int | float)
    }


def _address(kind: str, image: bytes) -> str:
    """Encode an image as a data URL, in which its scripts and links are inactive."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
