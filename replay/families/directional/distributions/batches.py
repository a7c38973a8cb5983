"""Flattening of batch axes for compiled loops."""

import numpy as np
from numpy.typing import NDArray


def flatten(array: NDArray, batch: tuple[int, ...], *core: int) -> NDArray[np.float64]:
    """Broadcast an array to its batch axes and return it as a contiguous array (n, *core).

    Args:
        array: (..., *core).
        batch: the batch axes (...) to broadcast to; n is their product.
        core: the sizes of the array's last axes.
    """
    flat = np.broadcast_to(array, (*batch, *core)).reshape(-1, *core)
    return np.ascontiguousarray(flat, dtype=np.float64)
