"""Detection of estimates that are not finite, have an invalid covariance, or go back in time."""

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.replay.engine.vectors.covariances import ROUNDING

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

UNSOUND = (
    "the estimate is no longer finite",
    "the covariance is no longer positive definite",
    "the stamps of its estimates go back",
    "the covariance is not symmetric",
)
NOT_FINITE, NOT_POSITIVE_DEFINITE, GOES_BACK, NOT_SYMMETRIC = range(len(UNSOUND))
# Fraction of a variance: a covariance that is singular up to rounding (for example, of one particle) is
# valid.
INDEFINITE = 1e-9
# Squared fraction of two standard deviations: rounding in single precision is smaller.
ASYMMETRIC = 1e-6


def find_unsound(
    run: int,
    offsets: Integers,
    time_ns: Integers,
    before_ns: Integers,
    mean: Floats,
    covariance: Floats,
    rows: Integers,
    found: Integers,
    factor: Floats,
) -> None:
    """Find the first invalid estimate of a run, and the entry of `UNSOUND` that describes its fault.

    Args:
        run: number of the run.
        offsets: (runs + 1,) first row of each run.
        time_ns: (n,) stamps.
        before_ns: (runs,) the last stamp before these.
        mean: (n, d).
        covariance: (n, t * t) row-major.
        rows: (runs,) row of the first invalid estimate, filled if there is one.
        found: (runs,) index in `UNSOUND`, filled if there is an invalid estimate.
        factor: (t, t), work space.
    """
    last_ns, size = before_ns[run], factor.shape[0]
    for row in range(offsets[run], offsets[run + 1]):
        wrong = -1
        is_wrong = False
        total = 0.0
        for i in range(mean.shape[1]):
            total += mean[row, i]
        for i in range(covariance.shape[1]):
            total += covariance[row, i]
        if time_ns[row] < last_ns:
            wrong = GOES_BACK
        elif not np.isfinite(total):
            wrong = NOT_FINITE
        else:
            for column in range(size):  # Cholesky
                variance = covariance[row, column * size + column]
                for i in range(column, size):
                    entry = covariance[row, i * size + column]
                    apart = entry - covariance[row, column * size + i]
                    if apart * apart > ASYMMETRIC * abs(variance * covariance[row, i * size + i]):
                        wrong = NOT_SYMMETRIC
                    for k in range(column):
                        entry -= factor[i, k] * factor[column, k]
                    if i == column:
                        is_wrong = not variance >= 0.0 or entry < -INDEFINITE * variance
                        factor[i, i] = np.sqrt(entry) if entry > ROUNDING * variance else 0.0
                    elif factor[column, column] > 0.0:
                        factor[i, column] = entry / factor[column, column]
                    else:  # no variance is left, so the component cannot be correlated with another
                        both = variance * covariance[row, i * size + i]
                        is_wrong = entry * entry > INDEFINITE * both
                        factor[i, column] = 0.0
                    if is_wrong:
                        wrong = NOT_POSITIVE_DEFINITE
                if wrong >= 0:
                    break
        if wrong >= 0:
            rows[run] = row
            found[run] = wrong
            break
        last_ns = time_ns[row]


unsound_over_runs = compile_over_runs(find_unsound)
