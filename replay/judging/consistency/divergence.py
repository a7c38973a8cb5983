"""Detection of divergence: the time from which the innovations of a filter stay too large."""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.log import Stream
from fuselog.replay.engine import chi2

IMPROBABLE = 1e-4  # probability bound for the sum of NIS over a window
WINDOW = 30  # number of innovations over which NIS is averaged
USUALLY_WELL = 0.8  # fraction of earlier windows in which the NIS must be as expected


class Divergence(NamedTuple):
    """Point at which a filter begins to diverge.

    Attributes:
        row: index of the innovation after which the filter diverges.
        time_ns: the stamp of this innovation.
        nis_per_component: the mean NIS per component from this innovation on.
    """

    row: int
    time_ns: int
    nis_per_component: float


def find_divergence(innovations: Stream) -> Divergence | None:
    """Find the time after which NIS stays too large, in a run whose NIS was as expected before.

    Args:
        innovations: all innovations of one estimator, in order of time.
    """
    nis = innovations["normalised_innovation_squared"]
    degrees = np.isfinite(innovations["innovation"]).sum(axis=1)
    used = np.flatnonzero((degrees > 0) & np.isfinite(nis))
    if len(used) < 4 * WINDOW:
        return None
    ones = np.ones(WINDOW)
    sums = np.convolve(nis[used], ones, "valid")
    sizes, of_window = np.unique(np.convolve(degrees[used], ones, "valid"), return_inverse=True)
    is_well = sums <= chi2.isf(IMPROBABLE, sizes)[of_window]
    if is_well[-1] or not is_well.any():
        return None
    last = int(np.flatnonzero(is_well)[-1])
    if len(is_well) - last < 2 * WINDOW or np.mean(is_well[: last + 1]) < USUALLY_WELL:
        return None
    row = int(used[min(last + WINDOW, len(used) - 1)])
    later = used[last + WINDOW :]
    mean = float(nis[later].sum() / degrees[later].sum())
    return Divergence(row, int(innovations.publish_time_ns[row]), mean)
