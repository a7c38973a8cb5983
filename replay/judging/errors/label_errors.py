"""Computes errors of several things at once, with the estimators' labels or each step's best.

Source of the total error: Zhang et al., "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016, (20). Estimates and truths are (..., things, axes).
"""

from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
MOST_PERMUTED = 6


def total_error(squared: Floats) -> Floats:
    """Compute (20): the root of the mean over steps of all things' squared errors, (..., steps).

    It is the root of a sum; the paper's words have a sum of roots.
    """
    return np.sqrt(np.mean(squared, axis=-1))


def fixed_squared_error(estimates: Floats, truths: Floats) -> Floats:
    """Return the summed squared errors (...,) where every estimate keeps its label.

    Args:
        estimates: (..., things, axes).
        truths: likewise.
    """
    return np.asarray(np.sum((estimates - truths) ** 2, axis=(-2, -1)))


def assigned_squared_error(estimates: Floats, truths: Floats, cutoff_m: float = np.inf) -> Floats:
    """Return the least summed squared errors (...,) that any labelling of the estimates gives.

    None counts for more than the squared cutoff: then it is GOSPA (alpha = 2, order 2) squared, since
    there are as many estimates as truths.

    Args:
        estimates: (..., things, axes).
        truths: likewise, as many.
        cutoff_m: no distance counts as longer.
    """
    count = estimates.shape[-2]
    distance = np.sum((estimates[..., :, None, :] - truths[..., None, :, :]) ** 2, axis=-1)
    distance = np.minimum(distance, cutoff_m**2)
    flat = distance.reshape(-1, count, count)
    if count > MOST_PERMUTED:
        found = [_least(each) if np.isfinite(each).all() else np.nan for each in flat]
        return np.reshape(found, distance.shape[:-2])
    orders = np.array(list(permutations(range(count))))
    sums = flat[:, np.arange(count), orders[0]].sum(axis=1)
    for order in orders[1:]:
        np.minimum(sums, flat[:, np.arange(count), order].sum(axis=1), out=sums)
    return sums.reshape(distance.shape[:-2])


def _least(distance: Floats) -> float:
    return float(distance[linear_sum_assignment(distance)].sum())
