"""Loss of precision in covariances due to rounding, from samples of a replay's covariances.

Each pivot of a Cholesky factorisation is divided by its variance, so that units do not matter: the
quotient is the fraction of the variance that the preceding components do not explain. It is at most 1;
below 1e-12, only four of the sixteen digits of a double are left (Higham, Accuracy and Stability of
Numerical Algorithms, 2nd edition, theorem 10.7).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.streams.blocks import Ragged

LOST = 1e-12  # a smaller pivot has lost its precision
# One in EACH covariances of a block is sampled, evenly spaced, but at least FEWEST and at most MOST.
EACH, FEWEST, MOST = 64, 8, 256


class Conditioning(NamedTuple):
    """Conditioning of samples of the covariances on a topic.

    Attributes:
        sampled: number of samples.
        lost: number of samples in which a pivot has lost its digits.
        failed: number of samples that are not positive definite, even if rounding errors are allowed
            for.
        least: the smallest pivot.
        run: number of the run in the ensemble that has the smallest pivot, if that pivot has lost its
            digits.
        elapsed_s: time of this pivot since the run's epoch.
    """

    sampled: int = 0
    lost: int = 0
    failed: int = 0
    least: float = 1.0
    run: int = 0
    elapsed_s: float = 0.0

    def plus(self, other: "Conditioning") -> "Conditioning":
        """Combine the samples with the samples of `other`."""
        worst = other if other.least < self.least else self
        return worst._replace(
            sampled=self.sampled + other.sampled,
            lost=self.lost + other.lost,
            failed=self.failed + other.failed,
        )


def conditioning_of(rows: Ragged, epochs_ns: NDArray[np.int64], first_run: int = 0) -> Conditioning:
    """Compute the conditioning of a sample of a block's covariances.

    Args:
        rows: Gaussian estimates, or innovations.
        epochs_ns: (runs,) epochs of the runs.
        first_run: number of the first run.
    """
    count = len(rows)
    if not count:
        return Conditioning()
    at = _sampled(count)
    flat = rows["covariance"].take(at, axis=0)
    size = math.isqrt(flat.shape[1])
    if size < 2 or size * size != flat.shape[1]:
        return Conditioning()
    covariances = flat.reshape(-1, size, size)
    smallest = _least_of_all(covariances)
    if smallest >= LOST:
        return Conditioning(len(at), least=smallest)
    least = least_pivots(covariances)
    worst = int(least.argmin())
    smallest = float(least[worst])
    if smallest >= LOST:
        return Conditioning(len(at), least=smallest)
    run = int(rows.offsets.searchsorted(at[worst], side="right")) - 1
    elapsed_s = (int(rows.stream.publish_time_ns[at[worst]]) - int(epochs_ns[run])) * 1e-9
    lost, failed = (int(np.count_nonzero(least < limit)) for limit in (LOST, -LOST))
    return Conditioning(len(at), lost, failed, smallest, first_run + run, elapsed_s)


@lru_cache(maxsize=64)
def _sampled(count: int) -> NDArray[np.int64]:
    """Return the rows to sample, out of `count`."""
    most = min(count, max(FEWEST, min(count // EACH, MOST)))
    return np.arange(most) * (count - 1) // max(1, most - 1)


def _least_of_all(covariances: NDArray[np.float64]) -> float:
    """Compute the smallest pivot of covariances (count, n, n); NaN if one of them has no factor.

    Every replay calls this function and precision is rarely lost, so it uses few calls of NumPy.
    """
    count, size, _ = covariances.shape
    try:
        factors = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        return math.nan
    diagonals = factors.reshape(count, -1)[:, :: size + 1]
    pivots = diagonals * diagonals / covariances.reshape(count, -1)[:, :: size + 1]
    return float(pivots.item(pivots.argmin()))  # argmin returns a NaN if there is one


def least_pivots(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the smallest pivots (count,) of covariances (count, n, n), divided by the variances.

    Components without variance and components that are not finite are left out. The factorisation ends
    at a pivot that is not positive, which is then the smallest.
    """
    variances = np.einsum("rii->ri", covariances)
    is_in = np.isfinite(variances) & (variances != 0.0)
    scale = np.where(is_in, 1.0 / np.sqrt(np.where(is_in, np.abs(variances), 1.0)), 0.0)
    known = np.nan_to_num(covariances, posinf=0.0, neginf=0.0)
    shares = known * scale[:, :, None] * scale[:, None, :]
    np.einsum("rii->ri", shares)[~is_in] = 1.0
    return np.array([_least_pivot(each) for each in shares])


def _least_pivot(left: NDArray[np.float64]) -> float:
    """Compute the smallest pivot of one matrix (n, n), up to the first pivot that is not positive.

    The matrix is overwritten.
    """
    least = 1.0
    for place in range(len(left)):
        pivot = float(left[place, place])
        least = min(least, pivot)
        if pivot <= 0.0:
            break
        column = left[place + 1 :, place]
        left[place + 1 :, place + 1 :] -= np.outer(column, column) / pivot
    return least
