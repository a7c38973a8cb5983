"""Extremes of long series; a module of its own, because Rerun is slow to import."""

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.judging.errors.evaluation import Floats


def extremes(of_span: NDArray[np.int64], values: Floats) -> NDArray[np.int64]:
    """Return the rows of the minimum and maximum of every span; among equal values, the first.

    Args:
        of_span: (n,), sorted: the index of each value's span, from zero.
        values: (n,); NaN is never an extreme.
    """
    first = np.flatnonzero(np.diff(of_span, prepend=-1))
    sizes = np.diff(first, append=len(of_span))
    is_extreme = np.zeros(len(values), bool)
    for extreme in (np.fmin, np.fmax):
        rows = np.flatnonzero(values == np.repeat(extreme.reduceat(values, first), sizes))
        is_extreme[rows[np.diff(of_span[rows], prepend=-1) > 0]] = True
    return np.flatnonzero(is_extreme)
