"""Lays batch axes of the public functions flat for the compiled loops."""

import numpy as np
from numpy.typing import NDArray


def flatten(array: NDArray, batch: tuple[int, ...], *core: int) -> NDArray[np.float64]:
    """Lay an array out as (n, *core), contiguous, broadcast to its batch axes.

    Args:
        array: (..., *core).
        batch: the axes (...) that it gets; n is their product.
        core: the sizes of its last axes.
    """
    flat = np.broadcast_to(array, (*batch, *core)).reshape(-1, *core)
    return np.ascontiguousarray(flat, dtype=np.float64)
