"""LCD sampling: equally weighted samples that are as close to N(0, I) as possible.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section V.A. The paper does not mention that the covariance of the optimal set is too small (eigenvalues
of 0.82 for 5 samples in two dimensions, 0.99 for 150), which degrades a filter: apply `moment_corrected`
before use.
"""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling.distance import Array, lcd_distance_and_gradient

Report = Callable[[str], object]

STARTS = 8
OBJECTIVE_SCALE = 1000.0
# D is flat around its optimum, so stop only when rounding stops the line search.
OPTIMISER = {"ftol": 1e-15, "gtol": 1e-9, "maxcor": 20, "maxiter": 10**6, "maxfun": 10**6}


def silent(_: str) -> None:
    """Ignore a progress report."""


def lcd_samples(
    dimension: int,
    count: int,
    generator: Generator,
    *,
    symmetric: bool = False,
    starts: int = STARTS,
    report: Report = silent,
) -> Array:
    """Compute the sample set (count, dimension) with the smallest D among several local optima.

    The set is not moment-corrected.

    Args:
        dimension: N.
        count: L.
        generator: draws the initial sets from N(0, I); the optimum and its rotation depend on it.
        symmetric: whether the set contains the negative of every sample; with an odd count, one sample
            is at the origin.
        starts: number of local optima to find.
        report: function that is called with a message before each optimisation.

    Raises:
        BadInput: the set could not have a regular covariance, see `check_count`.
    """
    from scipy.optimize import minimize  # slow to import

    check_count(dimension, count, symmetric)
    free = count // 2 if symmetric else count
    weights = np.full(count, 1 / count)

    def whole(flat: Array) -> Array:
        points = flat.reshape(free, dimension)
        if not symmetric:
            return points
        return np.concatenate([points, -points, np.zeros((count % 2, dimension))])

    def objective(flat: Array) -> tuple[float, Array]:
        distance, gradient = lcd_distance_and_gradient(whole(flat), weights)
        if symmetric:
            gradient = gradient[:free] - gradient[free : 2 * free]
        return OBJECTIVE_SCALE * distance, OBJECTIVE_SCALE * gradient.ravel()

    from threadpoolctl import threadpool_limits  # slow to import

    optima = []
    for start in range(starts):
        report(f"{count} samples in {dimension} dimensions: start {start + 1} of {starts}")
        begin = generator.standard_normal(free * dimension)
        with threadpool_limits(1):  # for such small products, a second core would only wait
            optima.append(minimize(objective, begin, jac=True, method="L-BFGS-B", options=OPTIMISER))
    found: Array = min(optima, key=lambda optimum: optimum.fun).x
    return whole(found)


def check_count(dimension: int, count: int, symmetric: bool) -> None:
    """Raise BadInput if `count` samples in `dimension` dimensions cannot have covariance I."""
    least = 2 * dimension if symmetric else dimension + 1
    if dimension < 1:
        raise BadInput(f"a sample set needs a dimension of 1 or more, found {dimension}")
    if count < least:
        kind = "symmetric samples" if symmetric else "samples"
        raise BadInput(
            f"{count} {kind} cannot have a regular covariance in {dimension} dimensions; "
            f"give {least} or more"
        )


def moment_corrected(points: Array) -> Array:
    """Shift the set (L, N) to mean 0, and multiply it by C^(-1/2), which results in covariance I.

    Raises:
        BadInput: the set's covariance is singular.
    """
    centred = points - points.mean(axis=0)
    variances, axes = np.linalg.eigh(centred.T @ centred / len(points))
    if not variances[0] > 1e-12 * variances[-1]:
        raise BadInput(f"{len(points)} samples span fewer than {points.shape[1]} dimensions; give more")
    corrected: Array = centred @ (axes / np.sqrt(variances)) @ axes.T
    return corrected
