"""Pseudo-measurements from symmetric functions of noisy numbers: sums of powers or products.

Sources: Kamen, "Multiple target tracking based on symmetric measurement equations", IEEE TAC 1992; Leven
and Lanterman, "Unscented Kalman filters for multiple target tracking with symmetric measurement
equations", IEEE TAC 2009. Numbers m = p + v have independent noise with variance sigma^2. A covariance R
is never computed, only a factor W with R = W W^H, because the entries of W span ten decades or more, and
the entries of R twice that. Complex numbers x + iy, whose parts have the same sigma, preserve the pairs
of x and y.
"""

from itertools import combinations
from math import comb, factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.arrays import Floats

Numbers = NDArray  # real or complex


class Pseudo(NamedTuple):
    """Pseudo-measurement at p: expectation (..., n), Jacobian for p, and a factor W of its noise.

    The Jacobian is (..., n, n) and W is (..., n, terms).
    """

    expected: Numbers
    jacobian: Numbers
    factor: Numbers


def power_sums(m: Numbers, sigma: float) -> Numbers:
    """Compute unbiased sums of powers of order 1 to n, (..., n), from measured numbers (..., n).

    For real numbers, these are sums of Hermite polynomials, sigma^a He_a(m / sigma), whose mean is p^a.
    Powers of complex numbers with circular noise are unbiased.
    """
    if np.iscomplexobj(m) or sigma == 0.0:
        return raw_power_sums(m)
    before, power = np.ones_like(m), m
    sums = [power.sum(axis=-1)]
    for order in range(1, m.shape[-1]):
        before, power = power, m * power - order * sigma**2 * before
        sums.append(power.sum(axis=-1))
    return np.stack(sums, axis=-1)


def raw_power_sums(m: Numbers) -> Numbers:
    """Compute plain sums of powers, (8) of the paper, which are biased for noisy real numbers."""
    return np.sum(m[..., None, :] ** np.arange(1, m.shape[-1] + 1)[:, None], axis=-1)


def power_sums_at(p: Numbers, sigma: float) -> Pseudo:
    """Compute the expected power sums of numbers p (..., n).

    W[a, (i, j)] = s^j a! / ((a - j)! sqrt(j!)) p_i^(a - j) with s = sigma, or s = sigma sqrt(2) for
    complex numbers.
    """
    n = p.shape[-1]
    s = sigma * np.sqrt(2.0) if np.iscomplexobj(p) else sigma
    orders = np.arange(1, n + 1)
    jacobian = orders[:, None] * p[..., None, :] ** (orders[:, None] - 1)
    factor = np.zeros((*p.shape[:-1], n, n, n), p.dtype)
    for a in range(1, n + 1):
        for j in range(1, a + 1):
            scale = s**j * comb(a, j) * np.sqrt(factorial(j))
            factor[..., a - 1, :, j - 1] = scale * p ** (a - j)
    return Pseudo(raw_power_sums(p), jacobian, factor.reshape(*p.shape[:-1], n, n * n))


def product_sums(m: Numbers) -> Numbers:
    """Compute the unbiased elementary symmetric functions e_1 ... e_n (..., n), (7) of the paper."""
    return _elementary(m)[..., 1:]


def _elementary(m: Numbers) -> Numbers:
    """Compute the elementary symmetric functions e_0 ... e_n (..., n + 1)."""
    n = m.shape[-1]
    found = np.zeros((*m.shape[:-1], n + 1), m.dtype)
    found[..., 0] = 1.0
    for i in range(n):
        found[..., 1 : i + 2] = found[..., 1 : i + 2] + m[..., i, None] * found[..., : i + 1]
    return found


def product_sums_at(p: Numbers, sigma: float) -> Pseudo:
    """Compute expected sums of products of p (..., n): W[a, T] = sigma^|T| e_{a - |T|}(p without T).

    The columns T are the 2^n - 1 non-empty subsets of the numbers.
    """
    n = p.shape[-1]
    columns = []
    for size in range(1, n + 1):
        for left_out in combinations(range(n), size):
            rest = _elementary(np.delete(p, left_out, axis=-1))
            column = np.zeros((*p.shape[:-1], n), p.dtype)
            column[..., size - 1 :] = sigma**size * rest
            columns.append(column)
    factor = np.stack(columns, axis=-1)
    # the column of a single number, divided by sigma, is the derivative with respect to this number
    jacobian = factor[..., :n] / sigma if sigma else product_sums_at(p, 1.0).jacobian
    return Pseudo(product_sums(p), jacobian, factor)


def update_root(
    mean: Floats, root: Floats, measured: Numbers, innovation: Numbers, factor: Numbers
) -> tuple[Floats, Floats]:
    """Apply the Kalman update in square-root form: means (..., n), factors X (..., n, k), P = X X'.

    The result is NaN if numbers overflow or the innovation covariance is singular. One QR decomposition
    of [[W', 0], [Z', X']] gives the root of the innovation covariance, the gain and the new root. Rows
    are scaled to unit length first, because sums of powers differ by many decades.

    Args:
        mean: mean before the update.
        root: X before the update.
        measured: Z (..., m, k): H X, the change of the measurement along the columns of X, or the
            measurement's deviations at the samples. Complex rows represent their real and imaginary
            parts.
        innovation: (..., m).
        factor: W (..., m, terms).
    """
    if np.iscomplexobj(measured):
        measured = np.concatenate([measured.real, measured.imag], axis=-2)
        innovation = np.concatenate([innovation.real, innovation.imag], axis=-1)
        # each part of circular noise has half the variance
        upper = np.concatenate([factor.real, -factor.imag], axis=-1)
        lower = np.concatenate([factor.imag, factor.real], axis=-1)
        factor = np.concatenate([upper, lower], axis=-2) * np.sqrt(0.5)
    scale = 1.0 / np.linalg.norm(factor, axis=-1)
    measured, factor, innovation = (
        measured * scale[..., None],
        factor * scale[..., None],
        innovation * scale,
    )
    m, n, terms = innovation.shape[-1], mean.shape[-1], factor.shape[-1]
    array = np.zeros((*mean.shape[:-1], terms + root.shape[-1], m + n))
    array[..., :terms, :m] = np.swapaxes(factor, -1, -2)
    array[..., terms:, :m] = np.swapaxes(measured, -1, -2)
    array[..., terms:, m:] = np.swapaxes(root, -1, -2)
    triangle = np.swapaxes(np.linalg.qr(array, mode="r"), -1, -2)
    is_usable = np.isfinite(triangle).all(axis=(-2, -1)) & np.isfinite(innovation).all(axis=-1)
    is_usable &= (np.diagonal(triangle, axis1=-2, axis2=-1)[..., :m] != 0.0).all(axis=-1)
    triangle = np.where(is_usable[..., None, None], triangle, np.eye(m + n))
    whitened = np.linalg.solve(triangle[..., :m, :m], innovation[..., None])
    moved = mean + (triangle[..., m:, :m] @ whitened)[..., 0]
    return np.where(is_usable[..., None], moved, np.nan), triangle[..., m:, m:]
