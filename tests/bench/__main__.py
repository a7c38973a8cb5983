"""`make bench`: every benchmark beside this file, as ratios measured in one run.

What it prints is kept in docs/speed.json, each table with its machine; the page of speed is made of it.
"""

import importlib
import json
import os
import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

from fuselog.pipeline.output.terminal import format_value, print_table
from tests.claims.pages import SPEED

COLUMNS = ("what", "ours", "theirs", "ratio")


def main() -> None:
    """Run the benchmarks named on the command line (`python -m tests.bench log`), else all."""
    chosen = sys.argv[1:]
    for path in sorted(Path(__file__).parent.glob("bench_*.py")):
        name = path.stem.removeprefix("bench_")
        if not chosen or name in chosen:
            module = importlib.import_module(f"tests.bench.{path.stem}")
            rows = [[format_value(value) for value in row] for row in module.main()]
            print_table(COLUMNS, rows, name)
            keep(name, rows)


def keep(name: str, rows: list[list[str]]) -> None:
    """Put a benchmark's table into the file of all, in place of the one that was there."""
    there = json.loads(SPEED.read_text(encoding="utf-8")) if SPEED.exists() else {}
    there[name] = {"day": datetime.now(UTC).date().isoformat(), "machine": machine(), "rows": rows}
    SPEED.write_text(json.dumps(dict(sorted(there.items())), indent=1) + "\n", encoding="utf-8")


def machine() -> str:
    """The processor, its cores, the system and Python, as a reader compares machines."""
    cpu = platform.processor() or platform.machine()
    listed = Path("/proc/cpuinfo")
    if listed.exists():
        models = [line for line in listed.read_text().splitlines() if line.startswith("model name")]
        cpu = models[0].partition(": ")[2] if models else cpu
    system, python = platform.system(), platform.python_version()
    return f"{cpu}, {os.cpu_count()} cores, {system}, Python {python}"


if __name__ == "__main__":
    main()
