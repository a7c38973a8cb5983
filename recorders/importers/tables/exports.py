"""Recognition of tables written by `fuselog export`, and the mapping that reads them."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

from fuselog.recorders.importers.tables.columns import stream_lines
from fuselog.recorders.importers.tables.files import Batch
from fuselog.recorders.log import Schema, schemas

_CLOCKS = ("publish_time_ns", "log_time_ns", "sensor_time_ns")
_NAMED_VECTORS = ("value", "state", "mean")


def export_mapping(path: Path, columns: Sequence[str], batch: Batch) -> list[str]:
    """Write the lines of an exported table's mapping after `files`; empty for other tables."""
    if tuple(columns[:3]) != _CLOCKS:
        return []
    fitting = [
        (schema, fields)
        for schema in schemas.SCHEMAS.values()
        if (fields := _fields(schema, columns[3:])) is not None
    ]
    if not fitting:
        return []
    topic = "/" + unquote(path.name.partition(".")[0]).replace("-", "/")
    name = topic.replace("_", "").lower()
    fitting.sort(key=lambda each: (list(each[1].values()).count([]), each[0].name.lower() not in name))
    schema, fields = fitting[0]
    times = [f'time = {{ column = "{_CLOCKS[0]}", unit = "ns", order = "any" }}']
    for name, clock in (("arrival", _CLOCKS[1]), ("sensor", _CLOCKS[2])):
        if not batch[clock].equals(batch[_CLOCKS[0]]):
            times.append(f'{name} = {{ column = "{clock}", unit = "ns", order = "any" }}')
    lines = []
    for name, given in fields.items():
        lines.append(f"fields.{name} = {json.dumps(given)}")
        components = [each.removeprefix(f"{name}_") for each in given] if isinstance(given, list) else []
        if name in _NAMED_VECTORS and components and not components[0].isdecimal():
            lines.append(f'components = "{",".join(components)}"')
            lines.append(f'kinds = "{",".join(map(_kind, components))}"')
    return [*times, *stream_lines(topic, schema.name, "the columns are those of fuselog export", *lines)]


def _fields(schema: Schema, columns: Sequence[str]) -> dict[str, str | list[str]] | None:
    """Assign columns to the fields of a message; None if a field or a column is left over."""
    found: dict[str, str | list[str]] = {}
    left = list(columns)
    for entry in sorted(list(schema)[1:], key=lambda each: -len(each.name)):
        if entry.kind == "vector":
            own = [name for name in left if name.startswith(f"{entry.name}_")]
            found[entry.name] = own
        else:
            own = [name for name in left if name == entry.name]
            if own:
                found[entry.name] = own[0]
        if not own and not entry.may_be_absent and entry.kind != "vector":
            return None
        left = [name for name in left if name not in own]
    return None if left else {entry.name: found[entry.name] for entry in schema if entry.name in found}


def _kind(component: str) -> str:
    if re.fullmatch(r"(.*_)?orientation_[wxyz]", component):
        return "quaternion"
    return "angle" if component.endswith("_rad") else "linear"
