"""Detects from its inertial samples alone whether a body stands.

A body that stands feels gravity, which does not change, and does not turn. Skog, Handel, Nilsson and
Rantakokko, Zero-Velocity Detection - An Algorithm Evaluation, IEEE Transactions on Biomedical
Engineering 57(11), 2010: the variance of the specific force, and the energy of the turn rate.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def unrest(time_ns: Integers, force: Floats, rate: Floats, window_s: float) -> tuple[Floats, Floats]:
    """Measure how much a unit was shaken and turned during the window that ends with each sample.

    Args:
        time_ns: (n,), sorted.
        force: specific force, m/s2, (n, 3).
        rate: turn rate, rad/s, (n, 3).
        window_s: how long the window is.

    Returns the standard deviation (n,) of the force as a vector, m/s2, and the root mean square (n,) of
    the turn rate, rad/s. They are infinite before the first window is over, and where samples of a
    window are missing or not finite.
    """
    window_ns = round(1e9 * window_s)
    numbers = np.hstack([force - np.nanmedian(force, axis=0), rate])  # differences keep their digits
    known = np.asarray(np.isfinite(numbers).all(axis=1))
    numbers[~known] = 0.0
    begin = np.searchsorted(time_ns, time_ns - window_ns)
    end = np.arange(1, len(time_ns) + 1)

    def mean(columns: NDArray) -> Floats:
        """Average columns (n, k) over each window."""
        sums = np.vstack([np.zeros(columns.shape[1]), np.cumsum(columns, axis=0)])
        return (sums[end] - sums[begin]) / (end - begin)[:, None]

    variance = np.sum(mean(numbers[:, :3] ** 2) - mean(numbers[:, :3]) ** 2, axis=1)
    energy = np.sum(mean(numbers[:, 3:] ** 2), axis=1)
    spoils = ~known | (np.diff(time_ns, prepend=time_ns[:1]) > window_ns)
    is_whole = (time_ns - time_ns[0] >= window_ns) & (mean(spoils[:, None])[:, 0] == 0.0)
    shaken = np.where(is_whole, np.sqrt(np.maximum(variance, 0.0)), np.inf)
    return shaken, np.where(is_whole, np.sqrt(np.maximum(energy, 0.0)), np.inf)
