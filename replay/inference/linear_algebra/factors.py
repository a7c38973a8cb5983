"""Lower factors S of covariances P = S S', computed by weighted Gram-Schmidt orthogonalisation.

Thornton, JPL Technical Memorandum 33-798, 1976; Bierman, Factorization Methods for Discrete Sequential
Estimation, 1977, VI.4.
"""

from collections.abc import Sequence

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.vectors.covariances import is_positive_definite
from fuselog.replay.inference.linear_algebra.covariances import Form, Predicted
from fuselog.replay.inference.linear_algebra.gaussian import multiply
from fuselog.replay.inference.linear_algebra.manifold import Turning

ROUNDING = 1e-15  # relative to a variance, per component on which it depends
NOTHING_LEFT = 1e-28  # relative square of a row that depends on others, because of rounding


def orthogonalise(rows: Floats, weights: Floats, factor: Floats) -> bool:
    """Compute the lower factor L (r, r) of A diag(w) A' = L L' from the rows of A (r, c).

    This is modified Gram-Schmidt orthogonalisation, which does not form products of A with itself;
    weights may be negative. The diagonal of L is positive; if a row depends on earlier rows, its
    diagonal entry and the entries below are zero. If the product is not positive semidefinite, the pivot
    is NaN.

    Args:
        rows: A (r, c), overwritten.
        weights: w (c,).
        factor: L (r, r), filled.

    Returns:
        Whether A diag(w) A' is positive semidefinite.
    """
    size, count = len(rows), len(weights)
    for i in range(size):
        squared, whole = 0.0, 0.0
        for k in range(count):
            squared += rows[i, k] * weights[k] * rows[i, k]
        for k in range(i):
            whole += factor[i, k] * factor[i, k]
        least = NOTHING_LEFT * (whole + abs(squared))
        if not squared >= -least:
            factor[i, i] = np.nan
            return False
        pivot = np.sqrt(squared) if squared > least else 0.0
        factor[i, i] = pivot
        for j in range(i + 1, size):
            entry = 0.0
            if pivot > 0.0:
                for k in range(count):
                    entry += rows[j, k] * weights[k] * rows[i, k]
                for k in range(count):
                    rows[j, k] -= entry / squared * rows[i, k]
                entry /= pivot
            factor[j, i] = entry
            factor[i, j] = 0.0
    return True


def fill_root(rows: Floats, covariance: Floats) -> bool:
    """Fill the first columns of `rows` with a factor N (n, n) of a covariance N N'.

    This is a Cholesky factorisation with pivoting by the relative size of the pivots, since the
    covariance may be singular.

    Args:
        rows: (n, at least n), whose first n columns become N.
        covariance: (n, n), overwritten.

    Returns:
        Whether the covariance is positive semidefinite.
    """
    size, whole = len(covariance), np.empty(len(covariance))
    for i in range(size):
        whole[i] = covariance[i, i]
    for k in range(size):
        best, largest = -1, ROUNDING * size
        for i in range(size):
            if not covariance[i, i] >= -ROUNDING * size * whole[i]:
                return False
            if covariance[i, i] > largest * whole[i]:
                best, largest = i, covariance[i, i] / whole[i]
        if best >= 0:
            pivot = np.sqrt(covariance[best, best])
            for i in range(size):
                rows[i, k] = covariance[i, best] / pivot
            for i in range(size):
                for j in range(size):
                    covariance[i, j] -= rows[i, k] * rows[j, k]
    return True


def retriangulate(rows: Floats, factor: Floats) -> None:
    """Compute the lower factor of A A' from A (t, t); `factor` may be the same array.

    Args:
        rows: A (t, t).
        factor: (t, t), filled.
    """
    weights = np.empty(len(rows))
    weights[:] = 1.0
    orthogonalise(rows.copy(), weights, factor)


def _start(covariances: Floats) -> Floats:
    """Factor covariances; if one is not positive definite, return NaN, so that its run cannot start."""
    factors, whole = np.full_like(covariances, np.nan), is_positive_definite(covariances)
    factors[whole] = np.linalg.cholesky(covariances[whole])
    return factors


def _to_covariance(factor: Floats) -> None:
    for row in range(len(factor) - 1, -1, -1):
        for column in range(row, -1, -1):
            entry = 0.0
            for k in range(column + 1):
                entry += factor[row, k] * factor[column, k]
            factor[row, column] = factor[column, row] = entry


def _times(factor: Floats, vector: Sequence[float] | Floats, product: Floats) -> None:
    product[:] = 0.0
    for k in range(len(factor)):
        entry = 0.0
        for row in range(k, len(factor)):
            entry += factor[row, k] * vector[row]
        for row in range(k, len(factor)):
            product[row] += factor[row, k] * entry


def _propagate(factor: Floats, transition: Floats, product: Floats) -> None:
    multiply(transition, factor, product)
    retriangulate(product, factor)


def _turn(turning: Turning, vector: Floats, factor: Floats) -> None:
    turning(vector, factor)
    retriangulate(factor, factor)


def _mix(weights: Floats, away: Floats, shift: Floats, carried: Floats, factor: Floats) -> None:
    t = len(factor)
    array, scales = np.empty((t, 2 * t + 1)), np.empty(2 * t + 1)
    factor[:, :] = 0.0
    for mode in range(len(weights)):
        scales[:t], scales[t:] = 1.0, weights[mode]
        array[:, :t], array[:, t : 2 * t] = factor, carried[mode]
        for row in range(t):
            array[row, 2 * t] = away[mode, row] - shift[row]
        orthogonalise(array, scales, factor)


def _retrace(before: Floats, after: Floats, work: Predicted, turned: Floats, _: Floats) -> bool:
    """Reverse a prediction, given G S- in `work.product` and P - G D' in `work.rest`."""
    t = len(before)
    for row in range(t):
        for column in range(t - 1, -1, -1):
            entry, pivot = work.product[row, column], after[column, column]
            for k in range(column + 1, t):
                entry -= turned[k, row] * after[k, column]
            turned[column, row] = entry / pivot if pivot > 0.0 else 0.0
        before[row] = work.rest[row]
    _to_covariance(before)
    return True


FACTORS = Form(_start, _to_covariance, _times, _propagate, _turn, _mix, _retrace)
