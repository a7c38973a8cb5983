"""Operations on Gaussians in place: Cholesky factors, innovations, the Kalman gain, covariances.

Means are in the space of the state, covariances in its tangent space; covariances are exactly symmetric.
Sarkka and Svensson, Bayesian Filtering and Smoothing, 2nd edition, 2023.
"""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats

LOG_TWO_PI = float(np.log(2.0 * np.pi))


class Innovation(NamedTuple):
    """Difference of a measurement from its prediction.

    Attributes:
        difference: v (m,), NaN for missing components.
        covariance: covariance S (m, m) of v.
        cross_covariance: covariance C (t, m) of the state with v.
    """

    difference: Floats
    covariance: Floats
    cross_covariance: Floats


def no_innovation(states: int, components: int) -> Innovation:
    """Allocate memory for an innovation of m components and a state with t tangent components."""
    return Innovation(
        np.empty(components), np.empty((components, components)), np.empty((states, components))
    )


def cholesky(factor: Floats, matrix: Floats, size: int) -> bool:
    """Compute the lower Cholesky factor L of the leading block of a matrix, A = L L'.

    Args:
        factor: (n, n), filled; may be the matrix itself.
        matrix: A (n, n), symmetric in its first `size` rows and columns.
        size: size of the leading block.

    Returns:
        Whether the block is positive definite (and not NaN).
    """
    for column in range(size):
        for row in range(column, size):
            entry = matrix[row, column]
            for k in range(column):
                entry -= factor[row, k] * factor[column, k]
            if row > column:
                factor[row, column] = entry / factor[column, column]
            elif entry > 0.0:
                factor[row, row] = np.sqrt(entry)
            else:
                return False
    return True


def semidefinite_cholesky(factor: Floats, matrix: Floats, size: int) -> bool:
    """Compute the lower factor of a positive semidefinite block; columns with a zero pivot are zero.

    Args:
        factor, matrix, size: as for `cholesky`.

    Returns:
        Whether the block is positive semidefinite (and not NaN).
    """
    for column in range(size):
        smallest = 1e-15 * size * matrix[column, column]
        for row in range(column, size):
            entry = matrix[row, column]
            for k in range(column):
                entry -= factor[row, k] * factor[column, k]
            if row == column:
                if not entry >= -smallest:
                    return False
                factor[row, row] = np.sqrt(entry) if entry > smallest else 0.0
            else:
                pivot = factor[column, column]
                factor[row, column] = entry / pivot if pivot > 0.0 else 0.0
    return True


def invert(matrix: Floats, inverse: Floats, factor: Floats) -> bool:
    """Compute the inverse of a symmetric matrix A by its Cholesky factor.

    Args:
        matrix: A (n, n), not changed.
        inverse: (n, n), filled.
        factor: (n, n), filled with the lower factor L, A = L L'.

    Returns:
        Whether A is positive definite.
    """
    size = len(matrix)
    if not cholesky(factor, matrix, size):
        return False
    for column in range(size):
        for row in range(size):
            entry = 1.0 if row == column else 0.0
            for k in range(row):
                entry -= factor[row, k] * inverse[k, column]
            inverse[row, column] = entry / factor[row, row]
        for row in range(size - 1, -1, -1):
            entry = inverse[row, column]
            for k in range(row + 1, size):
                entry -= factor[k, row] * inverse[k, column]
            inverse[row, column] = entry / factor[row, row]
    return True


def solve_semidefinite(matrix: Floats, right: Floats, factor: Floats) -> bool:
    """Solve A X = B in place by the Cholesky factor of A.

    A pivot that is zero up to rounding means a component without variance; the row of X for this
    component is set to zero, which gives a solution if B is in the range of A.

    Args:
        matrix: A (n, n), symmetric.
        right: B (n, m), replaced by X.
        factor: (n, n) working memory.

    Returns:
        Whether A is positive semidefinite.
    """
    size, columns = len(matrix), right.shape[1]
    if not semidefinite_cholesky(factor, matrix, size):
        return False
    for row in range(size):
        scale = 1.0 / factor[row, row] if factor[row, row] > 0.0 else 0.0
        for k in range(row):
            for column in range(columns):
                right[row, column] -= factor[row, k] * right[k, column]
        for column in range(columns):
            right[row, column] *= scale
    for row in range(size - 1, -1, -1):
        scale = 1.0 / factor[row, row] if factor[row, row] > 0.0 else 0.0
        for k in range(row + 1, size):
            for column in range(columns):
                right[row, column] -= factor[k, row] * right[k, column]
        for column in range(columns):
            right[row, column] *= scale
    return True


def wrap(difference: float, is_angle: bool) -> float:
    """Wrap a difference of angles to [-pi, pi); return any other difference unchanged."""
    if is_angle and not abs(difference) < np.pi:
        difference = wrap_angle(difference)
    return difference


def drop_missing(innovation: Innovation) -> int:
    """Move the measured components to the front, and return their number."""
    difference, covariance, cross_covariance = innovation
    size = 0
    for component in range(len(difference)):
        if np.isnan(difference[component]):
            continue
        if size < component:
            difference[size] = difference[component]
            cross_covariance[:, size] = cross_covariance[:, component]
            covariance[size] = covariance[component]
            covariance[:, size] = covariance[:, component]
        size += 1
    return size


def whiten(innovation: Innovation, size: int) -> tuple[float, float]:
    """Replace v by L^-1 v and S by L, S = L L', and return v' S^-1 v and log det S.

    The value of v' S^-1 v is NaN if S is not positive definite.

    Args:
        innovation: v (m,) and S (m, m), changed in place.
        size: number of measured components, which come first; see `drop_missing`.
    """
    difference, factor, _ = innovation
    if not cholesky(factor, factor, size):
        return np.nan, np.nan
    return whiten_by(factor, difference, size)


def whiten_kept(innovation: Innovation, size: int, components: int) -> tuple[float, float]:
    """Call `whiten`; if all components are measured, a kernel knows their number and needs no loops."""
    if size == components:
        return whiten(innovation, components)
    return whiten(innovation, size)


def whiten_by(factor: Floats, difference: Floats, size: int) -> tuple[float, float]:
    """Replace v by L^-1 v, and return the new v' v, and log det L L'.

    Args:
        factor: L, lower triangular; its first `size` rows and columns are used.
        difference: v (m,), changed in place.
        size: number of measured components.
    """
    squared, determinant = 0.0, 1.0
    for i in range(size):
        entry = difference[i]
        for k in range(i):
            entry -= factor[i, k] * difference[k]
        difference[i] = entry / factor[i, i]
        squared += difference[i] * difference[i]
        determinant *= factor[i, i]
    return squared, 2.0 * np.log(determinant)


def kalman_step(innovation: Innovation, size: int, step: Floats) -> None:
    """Fill `step` (t,) with K v for a whitened innovation, and replace C by W = C L^-T.

    K v is W L^-1 v, and K S K' is W W'.

    Args:
        innovation: whitened v, the factor L of S, and C (t, m).
        size: number of measured components.
        step: (t,), filled.
    """
    difference, factor, cross = innovation
    for row in range(len(step)):
        step[row] = 0.0
        for i in range(size):
            entry = cross[row, i]
            for k in range(i):
                entry -= factor[i, k] * cross[row, k]
            cross[row, i] = entry / factor[i, i]
            step[row] += cross[row, i] * difference[i]


def downdate(covariance: Floats, weighted: Floats, size: int) -> None:
    """Replace P by P - W W', in place.

    Args:
        covariance: P (t, t).
        weighted: W (t, m), as computed by `kalman_step`.
        size: number of columns of W to use.
    """
    for row in range(len(covariance)):
        for column in range(row + 1):
            entry = covariance[row, column]
            for i in range(size):
                entry -= weighted[row, i] * weighted[column, i]
            covariance[row, column] = covariance[column, row] = entry


def scalar_update(
    mean: Floats, covariance: Floats, cross: Floats, variance: float, difference: float
) -> None:
    """Update by a scalar innovation v in place: x + C v / s and P - C C' / s.

    Args:
        mean, covariance: x (n,) in a flat space, P (n, n).
        cross: C (n,), covariance of the state with v.
        variance, difference: s and v.
    """
    share = difference / variance
    for row in range(len(cross)):
        mean[row] += cross[row] * share
        part = cross[row] / variance
        for column in range(row + 1):
            covariance[row, column] -= part * cross[column]
            covariance[column, row] = covariance[row, column]


def fill_identity(matrix: Floats) -> None:
    """Fill a matrix with the identity."""
    matrix[:, :] = 0.0
    for row in range(len(matrix)):
        matrix[row, row] = 1.0


def multiply(left: Floats, right: Floats, product: Floats) -> None:
    """Compute the product of two square matrices.

    Args:
        left, right, product: (n, n); the product must be a different array.
    """
    for row in range(len(product)):
        for column in range(len(product)):
            entry = 0.0
            for k in range(len(product)):
                entry += left[row, k] * right[k, column]
            product[row, column] = entry


def multiply_into(left: Floats, matrix: Floats, product: Floats) -> None:
    """Replace A by F A, in place.

    Args:
        left, matrix, product: F, A and working memory, (n, n).
    """
    multiply(left, matrix, product)
    matrix[:, :] = product


def propagate_covariance(covariance: Floats, transition: Floats, product: Floats) -> None:
    """Replace P by F P F', in place.

    Args:
        covariance, transition: P and F, (t, t).
        product: (t, t), filled with F P.
    """
    size = len(covariance)
    multiply(transition, covariance, product)
    for row in range(size):
        for column in range(row + 1):
            entry = 0.0
            for k in range(size):
                entry += product[row, k] * transition[column, k]
            covariance[row, column] = covariance[column, row] = entry


def measured_covariance(covariance: Floats, rows: Floats, cross: Floats, spread: Floats) -> None:
    """Fill C = P H' and S = H C, with H in the first m rows of `rows`.

    Args:
        covariance: P (t, t).
        rows: H (at least m, t).
        cross: C (t, m), filled.
        spread: S (m, m), filled.
    """
    for i in range(len(spread)):
        for row in range(len(covariance)):
            entry = 0.0
            for k in range(len(covariance)):
                entry += covariance[row, k] * rows[i, k]
            cross[row, i] = entry
        for j in range(i + 1):
            entry = 0.0
            for k in range(len(covariance)):
                entry += rows[j, k] * cross[k, i]
            spread[i, j] = spread[j, i] = entry


def predict_constant_velocity(
    mean: Floats,
    covariance: Floats,
    duration_s: float,
    layout: tuple[int, int],
    noise: tuple[float, float, float],
) -> None:
    """Predict positions and velocities, assuming constant velocity, in place.

    The index of the position along axis a is a * layout[0]; the index of its velocity is greater by
    layout[1]. The noise adds a variance of the position, a covariance of position and velocity, and a
    variance of the velocity to each axis.

    Args:
        mean: (n,).
        covariance: (n, n).
        duration_s: duration.
        layout: see above.
        noise: the three moments, the same for every axis.
    """
    stride, apart = layout
    places = range(0, stride * (len(mean) // 2), stride)
    for place in places:
        mean[place] += duration_s * mean[place + apart]
        for column in range(len(mean)):
            covariance[place, column] += duration_s * covariance[place + apart, column]
    for place in places:
        for row in range(len(mean)):
            covariance[row, place] += duration_s * covariance[row, place + apart]
    for place in places:
        covariance[place, place] += noise[0]
        covariance[place, place + apart] += noise[1]
        covariance[place + apart, place] += noise[1]
        covariance[place + apart, place + apart] += noise[2]


def add_through(covariance: Floats, gain: Floats, variances: Floats) -> None:
    """Add G diag(variances) G' to P, in place.

    Args:
        covariance: P (t, t).
        gain: G (t, k).
        variances: (k,), the variance that belongs to each column of G.
    """
    for row in range(len(covariance)):
        for column in range(row + 1):
            entry = covariance[row, column]
            for k in range(len(variances)):
                entry += gain[row, k] * variances[k] * gain[column, k]
            covariance[row, column] = covariance[column, row] = entry


def copy_gaussian(mean: Floats, covariance: Floats, to_mean: Floats, to_covariance: Floats) -> None:
    """Copy a mean and its covariance.

    Args:
        mean, covariance: (n,), (t, t).
        to_mean, to_covariance: arrays of the same sizes, overwritten.
    """
    to_mean[:] = mean
    to_covariance[:, :] = covariance
