"""Tables of a known path as strangers write them, imported by a guess: none may be wrong in silence."""

import tempfile
import time
from pathlib import Path

import numpy as np

from tests.faults import Tally
from tests.recorders.strange_tables import draw, judge

MOST = 2000


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Draw `MOST` tables, or `most`, in at most twice `seconds`; note the share that is read right."""
    end = time.monotonic() + 2 * seconds
    tried = right = 0
    notes = []
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder:
        while time.monotonic() < end and tried < (MOST if most is None else most):
            drawn = draw(Path(folder), rng)
            verdict, why = judge(drawn)
            drawn.path.unlink()
            tried, right = tried + 1, right + (verdict == "right")
            notes += [f"{drawn.choices}: {why}"] if verdict == "wrong" else []
    held = tried - len(notes)
    return Tally(tried, held, [*notes, f"{100 * right / tried:.1f} % of {tried} read right"])
