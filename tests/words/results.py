"""What a result folder holds, in words and numbers: its tables, its charts, its result.json."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

MOST_WORDS = 6  # of a column that are all given
TINY = 1e-9  # of the greatest of some numbers: what is less is rounding


def result_in_words(folder: Path) -> str:
    """What stands in a result folder."""
    lines = ["# its tables and figures"]
    for path in sorted((folder / "tables").rglob("*.parquet")):
        table = pq.read_table(path).to_pandas(ignore_metadata=True)
        name = path.relative_to(folder / "tables").with_suffix("").as_posix()
        lines.append(f"{name}: {len(table)} rows")
        lines += [f"  {column}: {in_numbers(table[column].tolist())}" for column in table]
    for path in sorted((folder / "figures").glob("*.json")):
        lines.append(f"{path.stem}: {chart_in_words(json.loads(path.read_text(encoding='utf-8')))}")
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    lines.append("result.json:")
    for name, value in result["metrics"].items():
        known = {key: result[key].get(name) for key in ("bounds", "intervals")}
        ends = [f"{key} {in_numbers(value)}" for key, value in known.items() if value]
        values = value if isinstance(value, list) else [value]
        lines.append(f"  {', '.join([f'{name}: {in_numbers(values)}', *ends])}")
    return "\n".join([*lines, *_files(result)]) + "\n"


def chart_in_words(chart: Mapping[str, Any]) -> str:
    """What a chart's titles, axes and legends say, and between what numbers its curves lie."""
    panels = []
    for panel in chart["panels"]:
        title = f"{panel['title']}: " if panel["title"] else ""
        panels.append(f"  {title}{_axis(panel['y'])} over {_axis(panel['x'])}")
        for each in panel["series"]:
            panels.append(f"    {each['label']} ({each['style']}): {_drawn(each, 'x', 'y')}")
        for each in panel["bands"]:
            panels.append(f"    {each['label']} (band): {_drawn(each, 'x', 'low', 'high')}")
    return "\n".join([chart["title"], *panels])


def _axis(axis: Mapping[str, Any]) -> str:
    limits = "" if axis["limits"] is None else f" ({in_numbers(axis['limits'])})"
    return axis["label"] + (" (log)" if axis["log"] else "") + limits


def _drawn(each: Mapping[str, Any], *names: str) -> str:
    return ", ".join(f"{name} {in_numbers(each[name])}" for name in names)


def _files(result: Mapping[str, Any]) -> Iterator[str]:
    """The names of files, and which of them have no hash."""
    for name, found in result["files"].items():
        yield f"  {name}{'' if found else ' (by the clock)'}"


def in_numbers(values: Iterable[Any]) -> str:
    """The first, the last, the least and the greatest of numbers; the words of what is none."""
    values = list(values)
    numbers = [float(each) for each in values if isinstance(each, int | float)]
    finite = [each for each in numbers if math.isfinite(each)]
    if not finite:
        words = list(dict.fromkeys(map(str, values)))
        return ", ".join(words if len(words) <= MOST_WORDS else [*words[:2], "...", words[-1]])
    least = TINY * max(map(abs, finite))
    told = [finite[0], finite[-1], min(finite), max(finite)]
    first, last, low, high = (f"{0.0 if abs(each) < least else each:.3g}" for each in told)
    missing = len(values) - len(finite)
    lacks = f" ({missing} of {len(values)} are no numbers)" if missing else ""
    if len(finite) < 3:
        return (first if len(finite) == 1 else f"{first} and {last}") + lacks
    return f"{first} ... {last}, of {low} to {high}{lacks}"
