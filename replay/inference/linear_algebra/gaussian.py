"""Computes with Gaussians in place: Cholesky factors, innovations, the Kalman gain, covariances.

Means lie in the state's own space, covariances in its tangent space and are symmetric by construction.
Sarkka and Svensson, Bayesian Filtering and Smoothing, 2nd edition, 2023.
"""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats

LOG_TWO_PI = float(np.log(2.0 * np.pi))


class Innovation(NamedTuple):
    """Holds how a measurement differs from its prediction.

    Attributes:
        difference: v (m,), NaN where the measurement has no such component.
        covariance: S (m, m), of v.
        cross_covariance: C (t, m), of the state with v.
    """

    difference: Floats
    covariance: Floats
    cross_covariance: Floats


def no_innovation(states: int, components: int) -> Innovation:
    """Make memory for an innovation of m components of a state with t tangent components."""
    return Innovation(
        np.empty(components), np.empty((components, components)), np.empty((states, components))
    )


def cholesky(factor: Floats, matrix: Floats, size: int) -> bool:
    """Fill the lower Cholesky factor L of the leading block of a matrix, A = L L'.

    Args:
        factor: (n, n) filled; may be the matrix itself.
        matrix: A (n, n), symmetric in its first `size` rows and columns.
        size: of the leading block.

    Returns False where the block is not positive definite (or NaN).
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
    """Fill the lower factor of a positive semidefinite block: below a pivot of about zero it is zero.

    Args:
        factor, matrix, size: as for `cholesky`.

    Returns False where the block is indefinite (or NaN).
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
    """Fill the inverse of a symmetric matrix A by its Cholesky factor.

    Args:
        matrix: A (n, n), which stays as it is.
        inverse: (n, n) filled.
        factor: (n, n) filled with the lower factor L, A = L L'.

    Returns False where A is not positive definite.
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
    """Solve A X = B in place, by Cholesky's factor of A, which goes into `factor`.

    A pivot of zero, but for round-off, is what A knows exactly: its row of X is zero, a solution where B
    is in the range of A. False where A is not positive semidefinite.

    Args:
        matrix: A (n, n), symmetric.
        right: B (n, m), which becomes X.
        factor: (n, n) to work in.
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
    """Wrap a difference of angles to [-pi, pi); any other stays as it is."""
    if is_angle and not abs(difference) < np.pi:
        difference = wrap_angle(difference)
    return difference


def drop_missing(innovation: Innovation) -> int:
    """Move the components that were measured to the front; returns how many there are."""
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
    """Turn v into L^-1 v and S into L, S = L L'; returns v' S^-1 v and log det S.

    The first is NaN where S is not positive definite.

    Args:
        innovation: v (m,) and S (m, m), changed in place.
        size: how many components stand in front, see `drop_missing`.
    """
    difference, factor, _ = innovation
    if not cholesky(factor, factor, size):
        return np.nan, np.nan
    return whiten_by(factor, difference, size)


def whiten_by(factor: Floats, difference: Floats, size: int) -> tuple[float, float]:
    """Turn v into L^-1 v; returns its square, and log det L L'.

    Args:
        factor: L, lower, of which the first `size` rows and columns count.
        difference: v (m,), changed in place.
        size: how many components are measured.
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
    """Fill `step` (t,) with K v of a whitened innovation; its cross-covariance C becomes W = C L^-T.

    So K v = W L^-1 v, and K S K' = W W'.

    Args:
        innovation: v whitened, the factor L of S, and C (t, m).
        size: how many components are measured.
        step: (t,) filled.
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
    """Downdate P to P - W W', in place.

    Args:
        covariance: P (t, t).
        weighted: W (t, m), as `kalman_step` leaves it.
        size: how many columns of W count.
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
    """Update by one number v, in place: x + C v / s and P - C C' / s.

    Args:
        mean, covariance: x (n,) in a flat space, P (n, n).
        cross: C (n,), the covariance of the state with v.
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
    """Make a matrix the identity."""
    matrix[:, :] = 0.0
    for row in range(len(matrix)):
        matrix[row, row] = 1.0


def multiply(left: Floats, right: Floats, product: Floats) -> None:
    """Fill the product of two square matrices.

    Args:
        left, right, product: (n, n); the last is none of the others.
    """
    for row in range(len(product)):
        for column in range(len(product)):
            entry = 0.0
            for k in range(len(product)):
                entry += left[row, k] * right[k, column]
            product[row, column] = entry


def multiply_into(left: Floats, matrix: Floats, product: Floats) -> None:
    """Multiply A by F from the left, F A, in place.

    Args:
        left, matrix, product: F, A and what is worked in, (n, n).
    """
    multiply(left, matrix, product)
    matrix[:, :] = product


def propagate_covariance(covariance: Floats, transition: Floats, product: Floats) -> None:
    """Propagate P to F P F' in place.

    Args:
        covariance, transition: P and F, (t, t).
        product: (t, t), which becomes F P.
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
    """Fill C = P H' and S = H C, with H in `rows`, of which there may be more than are measured.

    Args:
        covariance: P (t, t).
        rows: H (at least m, t).
        cross: C (t, m) filled.
        spread: S (m, m) filled.
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
    """Predict positions and velocities at constant velocity, in place.

    Axis a has its position at a * layout[0], and its velocity layout[1] further. To each the noise adds
    a variance of the position, a covariance of both, and a variance of the velocity.

    Args:
        mean: (n,).
        covariance: (n, n).
        duration_s: how long.
        layout: see above.
        noise: the three moments of every axis.
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
        variances: (k,), of its columns.
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
        to_mean, to_covariance: overwritten, as large.
    """
    to_mean[:] = mean
    to_covariance[:, :] = covariance
