"""A log ends early, or a piece of it is missing or zeroed: what a full disk or a power cut leaves."""

import numpy as np

from tests.faults import Tally
from tests.faults.damaged_logs import tally


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Cut small logs of each compression in turn, at most so many: off, out, or to zeros."""
    return tally(_cut, seconds, rng, most)


def _cut(raw: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    begin, end = sorted(rng.integers(8, len(raw) + 1, 2).tolist())
    kind = rng.choice(["off", "out", "zeroed"], p=[0.6, 0.2, 0.2])
    if kind == "off":
        return raw[:begin], f"cut off at byte {begin} of {len(raw)}"
    kept = bytes(end - begin) if kind == "zeroed" else b""
    return raw[:begin] + kept + raw[end:], f"bytes {begin} to {end} of {len(raw)} cut {kind}"
