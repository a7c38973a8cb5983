"""Detection of estimates that are not finite, have an invalid covariance, or go back in time."""

from typing import NamedTuple

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
SOUND = -1
FOREVER = (1 << 63) - 1  # the row, or the stamp in ns, at which a run without faults ends
# Fraction of a variance: a covariance that is singular up to rounding (for example, of one particle) is
# valid.
INDEFINITE = 1e-9
# Squared fraction of two standard deviations: rounding in single precision is smaller.
ASYMMETRIC = 1e-6
# Fraction of a variance that has to remain for a covariance to be far from singular.
CLEAR = 1e-10
LANES = 16  # estimates that are tested together


class Work(NamedTuple):
    """Work space for covariances (t, t): `factor` (t, t), and one entry per lane in the last axes."""

    factor: Floats
    lanes: Floats
    scale: Floats


def work_space(size: int) -> Work:
    """Make the work space for covariances (size, size)."""
    return Work(np.empty((size, size)), np.empty((size, size, LANES)), np.empty(LANES))


def find_unsound(
    run: int,
    offsets: Integers,
    time_ns: Integers,
    before_ns: Integers,
    mean: Floats,
    covariance: Floats,
    rows: Integers,
    found: Integers,
    work: Work,
) -> None:
    """Find the first invalid estimate of a run, and the entry of `UNSOUND` that describes its fault.

    Args:
        run: number of the run.
        offsets: (runs + 1,) first row of each run.
        time_ns: (n,) stamps.
        before_ns: (runs,) the last stamp before this block.
        mean: (n, d).
        covariance: (n, t * t) row-major.
        rows: (runs,) row of the first invalid estimate; filled, with FOREVER if there is none.
        found: (runs,) index in `UNSOUND`; filled, with SOUND if there is no invalid estimate.
        work: work space.
    """
    rows[run], found[run] = FOREVER, SOUND
    begin, end, last_ns = offsets[run], offsets[run + 1], before_ns[run]
    while begin < end:
        stop = min(begin + LANES, end)
        is_clear = stop - begin == LANES and are_clearly_sound(begin, mean, covariance, work)
        for row in range(begin, stop):
            wrong = GOES_BACK if time_ns[row] < last_ns else SOUND
            if wrong < 0 and not is_clear:
                wrong = fault_of(mean[row], covariance[row], work.factor)
            if wrong >= 0:
                rows[run] = row
                found[run] = wrong
                return
            last_ns = time_ns[row]
        begin = stop


def are_clearly_sound(first: int, mean: Floats, covariance: Floats, work: Work) -> bool:
    """Test whether LANES estimates are finite, and their covariances symmetric and far from singular.

    All of them are factorised together, without square roots: while one factorisation waits for its
    previous step, the processor works on the others. If the result is False, `fault_of` decides.

    Args:
        first: row of the first estimate.
        mean, covariance: as for `find_unsound`.
        work: work space.
    """
    lanes, scale = work.lanes, work.scale
    size, is_clear = len(work.factor), True
    for lane in range(LANES):
        own, total = covariance[first + lane], 0.0
        for i in range(mean.shape[1]):
            total += mean[first + lane, i]
        is_clear &= np.isfinite(total)
        for i in range(size):
            for k in range(i + 1):
                lanes[i, k, lane] = own[i * size + k]
                apart = own[i * size + k] - own[k * size + i]
                if apart != 0.0:
                    both = own[i * (size + 1)] * own[k * (size + 1)]
                    is_clear &= apart * apart < ASYMMETRIC * both
    for column in range(size):
        for lane in range(LANES):
            left, variance = lanes[column, column, lane], covariance[first + lane, column * (size + 1)]
            is_clear &= CLEAR * variance < left < np.inf
            scale[lane] = 1.0 / left
        for i in range(column + 1, size):
            share = lanes[i, column] * scale
            for k in range(column + 1, i + 1):
                lanes[i, k] -= share * lanes[k, column]
    return is_clear


def fault_of(mean: Floats, covariance: Floats, factor: Floats) -> int:
    """Return the index in `UNSOUND` of an estimate's fault, ignoring its stamp, or SOUND.

    Args:
        mean, covariance: (d,), (t * t,) row-major.
        factor: (t, t), work space.
    """
    size, wrong, is_wrong, total = len(factor), SOUND, False, 0.0
    for i in range(len(mean)):
        total += mean[i]
    for i in range(len(covariance)):
        total += covariance[i]
    if not np.isfinite(total):
        return NOT_FINITE
    for column in range(size):  # Cholesky
        variance = covariance[column * size + column]
        for i in range(column, size):
            entry = covariance[i * size + column]
            apart = entry - covariance[column * size + i]
            if apart * apart > ASYMMETRIC * abs(variance * covariance[i * size + i]):
                wrong = NOT_SYMMETRIC
            for k in range(column):
                entry -= factor[i, k] * factor[column, k]
            if i == column:
                is_wrong = not variance >= 0.0 or entry < -INDEFINITE * variance
                factor[i, i] = np.sqrt(entry) if entry > ROUNDING * variance else 0.0
            elif factor[column, column] > 0.0:
                factor[i, column] = entry / factor[column, column]
            else:  # no variance is left, so the component cannot be correlated with another
                both = variance * covariance[i * size + i]
                is_wrong = entry * entry > INDEFINITE * both
                factor[i, column] = 0.0
            if is_wrong:
                wrong = NOT_POSITIVE_DEFINITE
        if wrong >= 0:
            break
    return wrong


unsound_over_runs = compile_over_runs(find_unsound)
