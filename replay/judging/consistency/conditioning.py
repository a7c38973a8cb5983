"""Judges what rounding has left of covariances, from samples of those that a replay gives.

Each pivot of a Cholesky factorisation is taken as a share of its variance, so that units are of no
account: it is how much of the variance the components before do not tell. The largest is one, and one
below 1e-12 has four of a double's sixteen digits left (Higham, Accuracy and Stability of Numerical
Algorithms, 2nd edition, theorem 10.7).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.streams.blocks import Ragged

LOST = 1e-12  # a pivot below has lost its digits
# Of a block so many are looked at, evenly: one of EACH, but at least FEWEST.
EACH, FEWEST, MOST = 64, 8, 256


class Conditioning(NamedTuple):
    """States what samples of a topic's covariances are like.

    Attributes:
        sampled: how many were looked at.
        lost: in how many a pivot has lost its digits.
        failed: how many are not positive definite, beyond rounding.
        least: the least pivot.
        run: where that has lost its digits: of which run, by its number in the ensemble.
        elapsed_s: and when, since the run's epoch.
    """

    sampled: int = 0
    lost: int = 0
    failed: int = 0
    least: float = 1.0
    run: int = 0
    elapsed_s: float = 0.0

    def plus(self, other: "Conditioning") -> "Conditioning":
        """Return both together."""
        worst = other if other.least < self.least else self
        return worst._replace(
            sampled=self.sampled + other.sampled,
            lost=self.lost + other.lost,
            failed=self.failed + other.failed,
        )


def conditioning_of(rows: Ragged, epochs_ns: NDArray[np.int64], first_run: int = 0) -> Conditioning:
    """Look at samples of the covariances of a block.

    Args:
        rows: Gaussian estimates, or innovations.
        epochs_ns: (runs,) times zero.
        first_run: the number of the first run.
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
    """Return the rows that are looked at, of so many."""
    most = min(count, max(FEWEST, min(count // EACH, MOST)))
    return np.arange(most) * (count - 1) // max(1, most - 1)


def _least_of_all(covariances: NDArray[np.float64]) -> float:
    """Return the least pivot of covariances (count, n, n), or NaN where one has no factor.

    Every replay pays for it, and nearly always nothing is lost: it is in few calls of NumPy.
    """
    count, size, _ = covariances.shape
    try:
        factors = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        return math.nan
    diagonals = factors.reshape(count, -1)[:, :: size + 1]
    pivots = diagonals * diagonals / covariances.reshape(count, -1)[:, :: size + 1]
    return float(pivots.item(pivots.argmin()))  # which is that of a NaN, where there is one


def least_pivots(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least pivot (count,) of covariances (count, n, n), as shares of variances.

    A component without variance is known, and one that is not finite is none: both are left out. Where
    a pivot is not positive there is no factor, and it is the least one.
    """
    variances = np.einsum("rii->ri", covariances)
    is_in = np.isfinite(variances) & (variances != 0.0)
    scale = np.where(is_in, 1.0 / np.sqrt(np.where(is_in, np.abs(variances), 1.0)), 0.0)
    known = np.nan_to_num(covariances, posinf=0.0, neginf=0.0)
    shares = known * scale[:, :, None] * scale[:, None, :]
    np.einsum("rii->ri", shares)[~is_in] = 1.0
    return np.array([_least_pivot(each) for each in shares])


def _least_pivot(left: NDArray[np.float64]) -> float:
    """Find that of one matrix (n, n), which is spent; it ends at a pivot that is not positive."""
    least = 1.0
    for place in range(len(left)):
        pivot = float(left[place, place])
        least = min(least, pivot)
        if pivot <= 0.0:
            break
        column = left[place + 1 :, place]
        left[place + 1 :, place + 1 :] -= np.outer(column, column) / pivot
    return least
