"""One bit of a log is another: what a disk, a cable or a memory does."""

import numpy as np

from tests.faults import Tally
from tests.faults.damaged_logs import tally


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Flip bits of small logs of each compression in turn, at most so many."""
    return tally(_flipped, seconds, rng, most)


def _flipped(raw: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    place, bit = int(rng.integers(len(raw))), int(rng.integers(8))
    damaged = bytearray(raw)
    damaged[place] ^= 1 << bit
    return bytes(damaged), f"bit {bit} of byte {place} of {len(raw)} flipped"
