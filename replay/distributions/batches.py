"""Lays batch axes of the public functions flat for the compiled loops."""

import numpy as np
from numpy.typing import NDArray


def flatten(array: NDArray, batch: tuple[int, ...], *core: int) -> NDArray[np.float64]:
    """`array` (..., *core) broadcast to the batch axes and laid out as (n, *core), contiguous."""
    flat = np.broadcast_to(array, (*batch, *core)).reshape(-1, *core)
    return np.ascontiguousarray(flat, dtype=np.float64)
