"""What studies call what they find: tables with columns, figures with axes and curves, metrics.

What a study gives in a test is held to the lines that are kept of it in `studies.txt`: none may be new.
`KEEP_FOUND=1 pytest tests/pipeline/test_*stud*.py` adds what is, and keeps what is there.
"""

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.output.charts import Chart
from pipeline.output.results import Outcome
from tests.goldens import numbers

PATH = Path(__file__).with_name("studies.txt")


def hold(
    study: str, labels: list[str], outcome: Outcome, settings: Mapping[str, Any] | None = None
) -> None:
    """Raise AssertionError where an outcome has names that nobody has reviewed, or other numbers."""
    numbers.hold_outcome(study, settings or {}, outcome)
    kept = _kept()
    new = set(_named(labels, outcome)) - kept.get(study, set())
    if new and os.environ.get("KEEP_FOUND"):
        kept[study] = kept.get(study, set()) | new
        lines = [line for name in sorted(kept) for line in [f"[{name}]", *sorted(kept[name]), ""]]
        PATH.write_text("\n".join(lines), encoding="utf-8")
        return
    assert not new, f"study {study}: {sorted(new)}\nwhere it is meant: see tests/words/studies.py"


def _kept() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    own: set[str] = set()
    for line in PATH.read_text(encoding="utf-8").splitlines() if PATH.exists() else ():
        if line.startswith("["):
            own = found.setdefault(line.strip("[]"), set())
        elif line:
            own.add(line)
    return found


def _named(labels: list[str], outcome: Outcome) -> Iterator[str]:
    """A line for each; what a test chose, its estimators, numbers and cases, is left open."""
    for name, table in outcome.tables.items():
        of = f"table {name}" if len(table) else f"table {name} without rows"
        yield _open(labels, f"{of}: {', '.join(map(str, table.columns))}")
    for name, figure in outcome.figures.items():
        if isinstance(figure, Chart):
            yield _open(labels, f"figure {name}: '{figure.title}'")
            for panel in figure.panels:
                drawn = [*panel.series, *panel.bands]
                if not any(each.x for each in drawn):
                    yield _open(labels, f"figure {name}, '{panel.title}': nothing")
                for each in drawn:
                    told = f"figure {name}, '{panel.title}': {panel.y.label} over {panel.x.label}"
                    style = getattr(each, "style", "band")
                    yield _open(labels, f"{told}, {style} '{each.label}'")
    for name in outcome.metrics:
        yield _open(labels, f"metric {'.'.join(name.split('.')[:2])}")


def _open(labels: list[str], line: str) -> str:
    for label in sorted(labels, key=len, reverse=True):
        line = re.sub(rf"(?<![\w-]){re.escape(label)}(?![\w-])", "$", line)
    line = re.sub(r"\d+(\.\d+)?(e-?\d+)?", "0", line)
    return re.sub("outside (never|always|at 0 % of steps)", "outside so often", line)
