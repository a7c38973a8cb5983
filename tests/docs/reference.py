"""The pages of the reference: commands, Python, messages, and all that is registered by a name."""

import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path

import fuselog as fl
from fuselog.pipeline.api.catalog import Entry
from fuselog.recorders.log.schemas import SCHEMAS, Field, Schema
from fuselog.recorders.parameters import describe, explain
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import registered_models
from tests.bench.__main__ import COLUMNS
from tests.claims.pages import SPEED

STUB = Path(__file__).parents[2] / "fuselog" / "__init__.pyi"
KALMAN = "fuselog.replay.inference.kalman.reference"
COMMANDS = """# Commands

::: mkdocs-click
    :module: fuselog.pipeline.command_line
    :command: fuselog
    :depth: 1
"""
ROOMS = {
    "pipeline": "Logs, replays, experiments",
    "recorders": "Streams and recorders",
    "replay": "Models, estimators, metrics, timelines",
}
KINDS: dict[str, tuple[Mapping[str, Entry], str]] = {
    "scenarios": (
        fl.scenarios,
        "Scenarios that you can record or import. `--set NAME=VALUE` changes a parameter, whose name "
        "ends in its unit, such as `_m` or `_radps`.",
    ),
    "models": (
        fl.models,
        "Each model describes a state, how it moves and what sensors measure of it. A check mark "
        "means that the [method](estimators.md) can estimate the state.",
    ),
    "estimators": (
        fl.estimators,
        "All names for `-e NAME`. Methods estimate the state of any [model](models.md), and have the "
        "model's parameters in addition to their own; the other estimators have their own equations.",
    ),
    "metrics": (fl.metrics, "Metrics that judge estimates."),
}
PLACES = [f"reference/{name}.md" for name in ("commands", "python", "messages", "speed", *KINDS)]
TYPES = {
    "time_ns": "`optional sfixed64`, ns",
    "identifier": "`optional fixed32`",
    "real": "`optional double`",
    "vector": "`repeated double`, packed, of one length per stream",
}


@cache
def reference() -> dict[str, str]:
    """The text of each page, by its place in the site."""
    kinds = (_kind(kind, [*entries.values()], what) for kind, (entries, what) in KINDS.items())
    return dict(zip(PLACES, [COMMANDS, _python(), _messages(), _speed(), *kinds], strict=True))


def _kind(kind: str, entries: Sequence[Entry], what: str) -> str:
    matrix = _methods_of_models() if kind == "models" else []
    sections = [line for entry in entries for line in _section(entry)]
    return "\n".join([f"# {kind.title()}", "", what, "", *matrix, *sections])


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table, and an empty one."""
    cells = [[each.replace("|", "\\|") for each in row] for row in [head, ["---"] * len(head), *rows]]
    return [*(f"| {' | '.join(row)} |" for row in cells), ""]


def _python() -> str:
    """All public names, as the stub of the package lists them; messages have a page of their own."""
    imports = [
        node for node in ast.parse(STUB.read_text("utf-8")).body if isinstance(node, ast.ImportFrom)
    ]
    lines = [
        "# Python",
        "",
        "The package `fuselog` exports these names; [Python](../python.md) shows how to use them. "
        "`fuselog.schemas` contains the [messages](messages.md).",
    ]
    for room, nodes in groupby(imports, lambda node: (node.module or "").split(".")[1]):
        names = [alias.name for node in nodes for alias in node.names if alias.name != "schemas"]
        names.sort(key=lambda name: (name[0].isupper(), name))  # functions first
        lines += ["", f"## {ROOMS[room]}", "", *(f"::: fuselog.{name}\n" for name in names)]
    lines += ["", "## The Kalman filter in two functions", ""]
    lines += [f"::: {KALMAN}.{name}\n" for name in ("predict", "update")]
    return "\n".join([*lines, "## Tests", "", "::: fuselog.testing.assert_golden", ""])


def _messages() -> str:
    lines = [
        "# Messages",
        "",
        "All messages of a log. Each is a protobuf message of syntax proto3. All fields are always "
        "written, and are numbered in this order. The first is `sensor_time_ns`, the time of the "
        "sensor's own clock.",
        "",
    ]
    for schema in SCHEMAS.values():
        lines += _schema(schema)
    return "\n".join(lines)


def _schema(schema: Schema) -> Iterator[str]:
    yield from [f"## {schema.name}", "", schema.purpose, ""]
    rows = [
        [str(number), f"`{field.name}`", TYPES[field.kind], _missing(field)]
        for number, field in enumerate(schema.fields, start=1)
    ]
    yield from table(["number", "field", "type", "missing value"], rows)


def _missing(field: Field) -> str:
    says = {
        "NaN": field.may_be_nan,
        "absent from logs that are older than the field": field.may_be_absent,
    }
    return "; ".join(text for text, holds in says.items() if holds)


def _methods_of_models() -> list[str]:
    rows = [
        [f"[{name}](#{name})", *("" if method.lacks(model) else "✓" for method in METHODS.values())]
        for name, model in registered_models().items()
    ]
    return table(["model", *METHODS], rows)


def _speed() -> str:
    lines = [
        "# Speed",
        "",
        "fuselog compared with other software, in one run and with the same estimates, as last measured "
        "by `make bench`. `python -m tests.bench NAME` measures one table.",
        "",
    ]
    for name, kept in json.loads(SPEED.read_text(encoding="utf-8")).items():
        lines += [
            f"## {name}",
            "",
            f"{kept['day']}, {kept['machine']}",
            "",
            *table(COLUMNS, kept["rows"]),
        ]
    return "\n".join(lines)


def _section(entry: Entry) -> Iterator[str]:
    """What `fuselog KINDs NAME` prints of an entry, its parameters folded."""
    yield from [f"## {entry.name}", "", f"{entry.what}.", ""]
    facts = {key: fact for key, fact in entry.facts.items() if fact != "yes"}
    for key, fact in facts.items():
        yield f"- {key}: {f'`{fact}`' if fact.startswith('fuselog ') else fact}"
    parameters = describe(entry.parameters, entry.values) if entry.parameters else []
    if parameters:
        rows = [
            [f"`{each.name}`", _value(each.default), each.unit, each.accepts, each.meaning]
            for each in parameters
        ]
        lines = table(["parameter", "default", "unit", "accepts", "meaning"], rows)
        for place, text in explain(entry.parameters).items() if entry.parameters else ():
            lines += [*([f"**`{place}`**", ""] if place else []), *text.splitlines(), ""]
        yield from ["", f'??? note "{len(rows)} parameters"', "", *(f"    {line}" for line in lines)]
    yield ""


def _value(default: object) -> str:
    return "" if default is None else f"`{default}`"
