"""`make faults`: every part of the fault campaign beside this file that can run, and what held.

python -m tests.faults [PART ...] [--seconds 500] [--seed 0] [--most N]
"""

import argparse
import importlib
import sys
from pathlib import Path

import numpy as np

from fuselog.pipeline.output.terminal import print_table, say

PARTS = sorted(
    path.stem for path in Path(__file__).parent.glob("*.py") if "\ndef run(" in path.read_text()
)


def main() -> int:
    """Run the parts for equal shares of the time; 0 where all that was tried held."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"any of {', '.join(PARTS)} [default: all]")
    parser.add_argument(
        "--seconds", type=float, default=350, help="for all parts together, but for those that count"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--most", type=int, help="how often each part tries at most")
    asked = parser.parse_args()
    parts = asked.parts or PARTS
    rows, notes = [], []
    for part in parts:
        rng = np.random.default_rng([asked.seed, PARTS.index(part)])
        tally = importlib.import_module(f"tests.faults.{part}").run(
            asked.seconds / len(PARTS), rng, asked.most
        )
        rows.append((part, tally.tried, tally.held))
        notes += [f"{part}: {note}" for note in tally.notes]
    for note in notes:
        say(note)
    print_table(("part", "tried", "held"), rows, f"seed {asked.seed}")
    return int(any(tried > held for _, tried, held in rows))


if __name__ == "__main__":
    sys.exit(main())
