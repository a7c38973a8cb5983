"""`make bench`: every benchmark beside this file, as ratios measured in one run."""

import importlib
import sys
from pathlib import Path

from pipeline.terminal import print_table

COLUMNS = ("what", "ours", "theirs", "ratio")


def main() -> None:
    """Run the benchmarks named on the command line (`python -m tests.bench log`), else all."""
    chosen = sys.argv[1:]
    for path in sorted(Path(__file__).parent.glob("bench_*.py")):
        name = path.stem.removeprefix("bench_")
        if not chosen or name in chosen:
            module = importlib.import_module(f"tests.bench.{path.stem}")
            print_table(COLUMNS, module.main(), name)


if __name__ == "__main__":
    main()
