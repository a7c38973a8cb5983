"""Scalar kernels of the Bingham distribution for d = 2 and 4.

The normalization constant is an inverse Laplace transform at 1, as in the saddlepoint approximation of
Kume and Wood (Biometrika 92, 2005):

    F(z) = 2 pi^(d/2) / (2 pi i)  int  exp(s)  prod_k (s - z_k)^(-1/2)  ds,

and moments only add factors 1 / (s - z_k). On Talbot's contour, with the parameters of Trefethen,
Weideman, Schmelzer (BIT 46, 2006), the trapezoidal rule converges geometrically, uniformly over all z in
(-inf, 0]: 14 nodes give an accuracy of about 1e-14, without Bessel functions, tables or cancellation.
"""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.models.orientation import SIGNS
from fuselog.replay.families.directional.distributions.gaussian_kernels import solve_in_place

Vector = NDArray | tuple[float, ...]

NODES = 28
_theta = np.pi / NODES * np.arange(1, NODES, 2)
_cotangent = 1.0 / np.tan(0.6407 * _theta)
# the other half of the contour is the complex conjugate of this one, hence the factor 2
CONTOUR = NODES * (0.5017 * _theta * _cotangent - 0.6122 + 0.2645j * _theta)
WEIGHTS = (
    -2.0j
    * np.exp(CONTOUR)
    * (0.5017 * _cotangent - 0.5017 * 0.6407 * _theta * (1.0 + _cotangent**2) + 0.2645j)
)
# real and imaginary parts of both, (nodes / 2, 4)
_PARTS = np.stack([CONTOUR.real, CONTOUR.imag, WEIGHTS.real, WEIGHTS.imag], axis=1)
for _table in (CONTOUR, WEIGHTS, _PARTS):
    _table.setflags(write=False)

# Newton's method squares the error in every step: if it is below this, one more step reaches rounding
# error.
_LAST_STEP = 1e-8
_MOST_STEPS = 30
_MOST_SWEEPS = 30


Complex = tuple[float, float]


def times(x: Complex, y: Complex) -> Complex:
    """Multiply two complex numbers."""
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def reciprocal(x: Complex) -> Complex:
    """Compute 1 / x for a complex x, scaled by the larger of its two parts, as C does."""
    if abs(x[0]) >= abs(x[1]):
        ratio = x[1] / x[0]
        size = x[0] + x[1] * ratio
        return 1.0 / size, -ratio / size
    ratio = x[0] / x[1]
    size = x[0] * ratio + x[1]
    return ratio / size, -1.0 / size


def root(x: Complex) -> Complex:
    """Compute the square root of a complex number with a nonnegative real part, by the method of C."""
    size = math.sqrt((abs(x[0]) + math.hypot(x[0], x[1])) * 0.5)
    if size == 0.0:
        return 0.0, x[1]
    if x[0] >= 0.0:
        return size, x[1] / (2.0 * size)
    return abs(x[1]) / (2.0 * size), math.copysign(size, x[1])


def integrate(z: NDArray, mean: NDArray, covariance: NDArray) -> float:
    """Compute mean and covariance of x_i^2 under a Bingham distribution; z (d,), with z[-1] = 0.

    Args:
        z: concentrations, at most 0.
        mean: E(x_i^2), (d,), overwritten.
        covariance: Cov(x_i^2, x_j^2), (d, d), overwritten: the derivative of `mean` with respect to z.

    Returns:
        F / (2 pi^(d/2)).
    """
    d = len(z)
    mean[:] = 0.0
    covariance[:] = 0.0
    factors = np.empty((d, 2))  # 1 / (s - z_k)
    total = 0.0
    for node in range(len(_PARTS)):
        integrand = _PARTS[node, 2], _PARTS[node, 3]
        for i in range(d):
            factor = reciprocal((_PARTS[node, 0] - z[i], _PARTS[node, 1]))
            factors[i, 0], factors[i, 1] = factor
            integrand = times(integrand, root(factor))
        total += integrand[0]
        for i in range(d):
            first = times(integrand, (factors[i, 0], factors[i, 1]))
            mean[i] += first[0]
            for j in range(i + 1):
                covariance[i, j] += times(first, (factors[j, 0], factors[j, 1]))[0]
    for i in range(d):
        mean[i] *= 0.5 / total
        covariance[i, i] *= 3.0
        for j in range(i + 1):
            covariance[i, j] = 0.25 * covariance[i, j] / total - mean[i] * mean[j]
            covariance[j, i] = covariance[i, j]
    return total


def fit_concentrations(target: NDArray, z: NDArray) -> bool:
    """Find concentrations for which E(x_i^2) equals `target`, by Newton's method on (14).

    The search starts at the fit of the first-order saddlepoint approximation. The residuals are weighted
    by E(x_i^2) / target_i, which makes them nearly linear in z if z is large; five steps then suffice
    for concentrations from 0 to beyond -1e6. The order of the concentrations is never changed: z[i]
    belongs to target[i].

    Args:
        target: moments (d,), ascending, with sum 1.
        z: concentrations (d,), overwritten; the last is 0.

    Returns:
        Whether the fit converged; False if a target is not positive or a moment diverges.
    """
    d = len(z)
    last = d - 1
    if not target[0] > 0.0:
        return False
    for i in range(d):
        z[i] = 0.5 / target[last] - 0.5 / target[i]
    mean, step = np.empty(d), np.empty((last, 1))
    covariance = np.empty((d, d))
    for _ in range(_MOST_STEPS):
        integrate(z, mean, covariance)
        error = 0.0
        for i in range(last):
            missing = (target[i] - mean[i]) / target[i]
            error = max(error, abs(missing))
            step[i, 0] = missing * mean[i]
        solve_in_place(covariance, step)
        for i in range(last):
            z[i] += step[i, 0]
        if error < _LAST_STEP:
            return True
    return False


def eigen_ascending(matrix: NDArray, values: NDArray, vectors: NDArray) -> None:
    """Compute the eigenvalues, ascending, and eigenvectors of a symmetric matrix.

    The method is cyclic Jacobi rotations. For d <= 4 they are faster than LAPACK, and small eigenvalues
    keep their relative precision.

    Args:
        matrix: (d, d), destroyed.
        values, vectors: eigenvalues (d,) and eigenvectors as columns (d, d); both overwritten.
    """
    d = len(values)
    for i in range(d):
        for j in range(d):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_MOST_SWEEPS):
        rotated = False
        for p in range(d - 1):
            for q in range(p + 1, d):
                off = matrix[p, q]
                # below this, the square of `off` is lost in rounding next to the diagonal
                if not off * off > 1e-33 * abs(matrix[p, p] * matrix[q, q]):
                    continue
                rotated = True
                slope = 0.5 * (matrix[q, q] - matrix[p, p]) / off
                tangent = math.copysign(1.0, slope) / (abs(slope) + math.hypot(slope, 1.0))
                cosine = 1.0 / math.hypot(tangent, 1.0)
                sine = cosine * tangent
                matrix[p, p] -= tangent * off
                matrix[q, q] += tangent * off
                matrix[p, q] = matrix[q, p] = 0.0
                for k in range(d):
                    if k not in (p, q):
                        kp, kq = matrix[k, p], matrix[k, q]
                        matrix[k, p] = matrix[p, k] = cosine * kp - sine * kq
                        matrix[k, q] = matrix[q, k] = sine * kp + cosine * kq
                    kp, kq = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = cosine * kp - sine * kq, sine * kp + cosine * kq
        if not rotated:
            break
    for i in range(d):
        values[i] = matrix[i, i]
    for i in range(d - 1):
        least = i
        for k in range(i + 1, d):
            if values[k] < values[least]:
                least = k
        if least != i:
            values[i], values[least] = values[least], values[i]
            for k in range(d):
                vectors[k, i], vectors[k, least] = vectors[k, least], vectors[k, i]


def compose(left: Vector, right: Vector, out: NDArray) -> None:
    """Write left (+) right to `out`.

    Args:
        left, right, out: complex numbers or quaternions (d,); `out` is a different array.
    """
    for i in range(len(out)):
        out[i] = 0.0
        for j in range(len(out)):
            out[i] += SIGNS[j, i ^ j] * left[j] * right[i ^ j]


def compose_columns(left: Vector, columns: NDArray, out: NDArray) -> None:
    """Write left (+) columns[:, k] to out[:, k].

    Args:
        left: (d,).
        columns, out: (d, k), different arrays.
    """
    for k in range(out.shape[1]):
        compose(left, columns[:, k], out[:, k])


def turn_columns(columns: NDArray, increment: NDArray) -> None:
    """Replace columns[:, k] by columns[:, k] (+) increment, in place.

    Args:
        columns: (d, k), such as principal axes.
        increment: a known rotation, a unit vector (d,).
    """
    before = columns.copy()
    for k in range(columns.shape[1]):
        compose(before[:, k], increment, columns[:, k])


def framed(matrix: NDArray, frame: Vector, out: NDArray) -> None:
    """Write L matrix L^T, where L y = frame (+) y: a moment or parameter matrix in another frame.

    Args:
        matrix, out: (d, d), different arrays.
        frame: a unit vector (d,).
    """
    half = np.empty(out.shape)
    compose_columns(frame, matrix, half)
    compose_columns(frame, half.T, out)


def weighted_outer(columns: NDArray, weights: NDArray, out: NDArray) -> None:
    """Write columns diag(weights) columns^T to `out`.

    Args:
        columns, out: (d, d), different arrays.
        weights: (d,).
    """
    d = len(weights)
    for i in range(d):
        for j in range(i + 1):
            out[i, j] = 0.0
            for k in range(d):
                out[i, j] += columns[i, k] * weights[k] * columns[j, k]
            out[j, i] = out[i, j]


def compose_covariances(left: NDArray, right: NDArray, out: NDArray) -> None:
    """Write the second moment of x (+) y to `out`, for independent x and y (lemmas 2 and 4).

    Lemma 2 is correct as printed; its proof, (111)-(115), has wrong signs.

    Args:
        left, right, out: second moments of x, y and x (+) y, (d, d); `out` is a different array.
    """
    d = len(out)
    for i in range(d):
        for k in range(i + 1):
            out[i, k] = 0.0
            for j in range(d):
                for m in range(d):
                    sign = SIGNS[j, i ^ j] * SIGNS[m, k ^ m]
                    out[i, k] += sign * left[j, m] * right[i ^ j, k ^ m]
            out[k, i] = out[i, k]


def predict(axes: NDArray, z: NDArray, noise_covariance: NDArray) -> bool:
    """Predict x (+) w in place by algorithm 1, whose second input is Z^w, not the printed Z^v.

    The computation is in the frame of the mode, in which small moments keep their precision next to
    large ones.

    Args:
        axes: principal axes (d, d) in columns, the mode last.
        z: concentrations (d,).
        noise_covariance: E(w w^T), (d, d).

    Returns:
        Whether the moment fit converged.
    """
    d = len(z)
    mode = axes[:, d - 1].copy()
    moments, local, work = np.empty(d), np.empty((d, d)), np.empty((d, d))
    local_moments(axes, z, moments, work)
    compose_covariances(work, noise_covariance, local)
    eigen_ascending(local, moments, work)
    compose_columns(mode, work, axes)
    return fit_concentrations(moments, z)


def inverse(x: NDArray, out: NDArray) -> None:
    """Write the inverse of a unit complex number or quaternion to `out`.

    Args:
        x, out: (d,).
    """
    for i in range(len(x)):
        out[i] = x[i] if i == 0 else -x[i]


def local_moments(axes: NDArray, z: NDArray, moments: NDArray, out: NDArray) -> None:
    """Compute the moments along the axes, and the second moment in the frame of the mode.

    In that frame, small moments keep their precision next to large ones.

    Args:
        axes, z: as for `predict`.
        moments, out: E(x_i^2), (d,), and the second moment (d, d); both overwritten.
    """
    d = len(z)
    local, back = np.empty((d, d)), np.empty(d)
    integrate(z, moments, out)
    inverse(axes[:, d - 1], back)
    compose_columns(back, axes, local)
    weighted_outer(local, moments, out)


def update(axes: NDArray, z: NDArray, inverse_noise: NDArray, measurement: Vector) -> None:
    """Update with one measurement in place by algorithm 2, with M = z (+) (D M^v), not M^p as printed.

    Args:
        axes: principal axes (d, d) in columns, the mode last.
        z: concentrations (d,).
        inverse_noise: D M^v Z^v M^v^T D, the parameter matrix of the inverse of the noise, (d, d).
        measurement: a unit vector (d,).
    """
    d = len(z)
    total, seen = np.empty((d, d)), np.empty((d, d))
    weighted_outer(axes, z, total)
    framed(inverse_noise, measurement, seen)
    for i in range(d):
        for j in range(d):
            total[i, j] += seen[i, j]
    eigen_ascending(total, z, axes)
    greatest = z[d - 1]
    for i in range(d):
        z[i] -= greatest


@cache
def _over_all(function: Callable[..., None]) -> Callable[..., None]:
    return compile_over_runs(function)


def _predict_one(
    n: int, axes: NDArray, z: NDArray, noise_covariance: NDArray, converged: NDArray
) -> None:
    converged[n] = predict(axes[n], z[n], noise_covariance[n])


def predict_each(axes: NDArray, z: NDArray, noise_covariance: NDArray) -> NDArray:
    """Apply `predict` to every distribution and its noise; return which predictions (n,) converged.

    Args:
        axes, z: (n, d, d) and (n, d), changed in place.
        noise_covariance: (n, d, d).
    """
    converged = np.empty(len(z), np.bool_)
    _over_all(_predict_one)(len(z), axes, z, noise_covariance, converged)
    return converged


def _fit_one(n: int, covariance: NDArray, axes: NDArray, z: NDArray, converged: NDArray) -> None:
    moments = np.empty(z.shape[1])
    eigen_ascending(covariance[n], moments, axes[n])
    converged[n] = fit_concentrations(moments, z[n])


def fit_each(covariance: NDArray, axes: NDArray, z: NDArray) -> NDArray:
    """Fit a distribution to every second moment; return which fits (n,) converged.

    Args:
        covariance: second moments (n, d, d), destroyed.
        axes, z: (n, d, d) and (n, d), overwritten.
    """
    converged = np.empty(len(z), np.bool_)
    _over_all(_fit_one)(len(z), covariance, axes, z, converged)
    return converged
