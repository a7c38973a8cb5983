"""Memory layout of the results of filters, in this process or in a file that another process fills.

If the other process crashes, the results that it has written are still available.
"""

import math
from collections.abc import Callable
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Integers
from fuselog.replay.inference.linear_algebra.gaussian import LOG_TWO_PI
from fuselog.replay.inference.run.recursion import EstimateRows, InnovationRows


class Sizes(NamedTuple):
    """Numbers of components: n of the state, t of its tangent space, and m of the innovations."""

    n: int
    t: int
    m: int


class Results(NamedTuple):
    """Results of filters, filled in place.

    Attributes:
        progress: (runs,) index of the current message, visible to another process.
        issued_ns: for every estimate, the arrival time of the message that triggered it, or its stamp if
            messages are processed in order of their stamps.
        estimates, innovations: the rows of run r begin at the offset of this run.
    """

    progress: Integers
    issued_ns: Integers
    estimates: EstimateRows
    innovations: InnovationRows


def results(
    due: Integers, recorded: Integers, sizes: Sizes, memory: Callable[[int], np.ndarray] = np.zeros
) -> Results:
    """Allocate results; in run r, estimates begin at row due[r], innovations at row recorded[r].

    Args:
        due: (runs + 1,) offsets of the estimates.
        recorded: (runs + 1,) offsets of the innovations.
        sizes: sizes of states and innovations.
        memory: memory(count) -> an array of `count` numbers of 8 bytes.
    """
    runs, (n, t, m) = len(due) - 1, sizes
    shapes = [
        *((runs,) for _ in range(3)),
        *((int(due[-1]), *shape) for shape in ((), (), (n,), (t, t))),
        *((int(recorded[-1]), *shape) for shape in ((), (), (m,), (m, m), (3,))),
    ]
    ends = list(accumulate(map(math.prod, shapes), initial=0))
    whole = memory(max(ends[-1], 1))
    progress, due_end, recorded_end, issued_ns, time_ns, mean, covariance, noted_ns, target, *others = (
        whole[begin:end].reshape(shape)
        for (begin, end), shape in zip(pairwise(ends), shapes, strict=True)
    )
    difference, spread, numbers = others
    estimates = EstimateRows(due_end.view(np.int64), time_ns.view(np.int64), mean, covariance)
    target_id = target.view(np.uint32)[: len(target)]
    innovations = InnovationRows(
        recorded_end.view(np.int64), noted_ns.view(np.int64), target_id, difference, spread, numbers
    )
    return Results(progress.view(np.int64), issued_ns.view(np.int64), estimates, innovations)


def begun(made: Results, due: Integers, recorded: Integers) -> Results:
    """Clear the results: set the end of each run to its first row, and all values to NaN.

    Args:
        made: results of all runs, changed in place.
        due, recorded: (runs + 1,), first rows of the estimates and innovations of each run.
    """
    made.estimates.end[:], made.innovations.end[:] = due[:-1], recorded[:-1]
    for each in (*made.estimates[2:], *made.innovations[3:]):
        each[:] = np.nan
    return made


def in_file(path: Path) -> Callable[[int], np.ndarray]:
    """Return a function that maps a file as memory; the file is created if it does not exist."""

    def memory(count: int) -> np.ndarray:
        if not path.exists():
            with path.open("wb") as file:
                file.truncate(8 * count)
        return np.asarray(np.memmap(path, np.float64, "r+", shape=(count,))).view(np.ndarray)

    return memory


def fill_squares(innovations: InnovationRows) -> int:
    """Fill NIS and log-likelihood of one run's innovations, up to the first invalid covariance.

    If a covariance is not positive definite, the innovations end before its row, and this row is
    returned; otherwise, -1 is returned.
    """
    end = int(innovations.end[0])
    present = ~np.isnan(innovations.difference[:end])
    unsound = end
    for pattern in np.unique(present, axis=0):
        rows = np.flatnonzero((present == pattern).all(axis=1))
        at = np.flatnonzero(pattern)
        missing = np.flatnonzero(~pattern)
        spread = innovations.covariance[rows][:, at][:, :, at]
        sound = np.isfinite(spread).all(axis=(1, 2))
        sound = np.atleast_1d(sound)
        sound[sound] = np.linalg.eigvalsh(spread[sound]).min(axis=1, initial=np.inf) > 0.0
        unsound = min(unsound, *rows[~sound].tolist(), end)
        rows, spread = rows[sound], spread[sound]
        difference = innovations.difference[rows][:, at]
        factor = np.linalg.cholesky(spread)
        white = np.linalg.solve(factor, difference[:, :, None])[:, :, 0]
        squared = np.einsum("ni,ni->n", white, white)
        determinant = 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        is_used = (innovations.numbers[rows, 2] > 0.0) & (len(at) > 0)
        likelihood = -0.5 * (squared + determinant + len(at) * LOG_TWO_PI)
        innovations.numbers[rows, 0] = squared
        innovations.numbers[rows, 1] = np.where(is_used, likelihood, 0.0)
        innovations.numbers[rows, 2] = is_used
        for each in missing:
            innovations.covariance[rows, each, :] = np.nan
            innovations.covariance[rows, :, each] = np.nan
    if unsound < end:
        innovations.end[0] = unsound
        return unsound
    return -1
