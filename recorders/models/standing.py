"""Detection of standstill from inertial samples.

A stationary body measures constant gravity and no rotation. Skog, Handel, Nilsson and Rantakokko,
Zero-Velocity Detection - An Algorithm Evaluation, IEEE Transactions on Biomedical Engineering 57(11),
2010: the variance of the specific force, and the energy of the turn rate.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def unrest(time_ns: Integers, force: Floats, rate: Floats, window_s: float) -> tuple[Floats, Floats]:
    """Compute how much a unit was shaken and rotated in the window that ends with each sample.

    Args:
        time_ns: (n,), sorted, in ns.
        force: (n, 3), specific force, m/s2.
        rate: (n, 3), turn rate, rad/s.
        window_s: length of the window.

    Returns the standard deviation (n,) of the force as a vector, m/s2, and the root mean square (n,) of
    the turn rate, rad/s. They are infinite before the end of the first window, and if samples of a
    window are missing or not finite.
    """
    window_ns = round(1e9 * window_s)
    numbers = np.hstack(
        [force - np.nanmedian(force, axis=0), rate]
    )  # the difference avoids cancellation
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
