"""Joint errors of several objects, with the estimator's labels or the best labels at each step.

Source of the total error: Zhang et al., "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016, (20). Estimates and truths are (..., objects, axes).
"""

from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
MOST_PERMUTED = 6


def total_error(squared: Floats) -> Floats:
    """Compute the root mean square error (..., steps) over objects, equation (20).

    This is the root of a sum; the text of the paper describes a sum of roots.
    """
    return np.sqrt(np.mean(squared, axis=-1))


def fixed_squared_error(estimates: Floats, truths: Floats) -> Floats:
    """Compute the sum of squared errors (...,) over objects; every estimate keeps its label.

    Args:
        estimates: (..., objects, axes).
        truths: (..., objects, axes).
    """
    return np.asarray(np.sum((estimates - truths) ** 2, axis=(-2, -1)))


def assigned_squared_error(estimates: Floats, truths: Floats, cutoff_m: float = np.inf) -> Floats:
    """Compute the smallest sum of squared errors (...,) over all labellings of the estimates.

    Each squared error is limited to the squared cutoff. With a cutoff, the result is the squared GOSPA
    (alpha = 2, order 2), because there are as many estimates as truths.

    Args:
        estimates: (..., objects, axes).
        truths: (..., objects, axes), with the same number of objects.
        cutoff_m: upper limit of a distance, in m.
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
