"""Kernels of bivariate wrapped normals: fits to samples and products.

Functions with `Component` arguments also accept arrays. A covariance is passed as c11, c12, c22.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.models.planar import Component, Components, wrap_angle

TURN = 2.0 * math.pi
# exp(-UNIFORM / 2) is below the rounding of 1: a distribution with a larger variance is uniform.
UNIFORM = 80.0
# exp(-REACH^2 / 2) is below the rounding of 1
_REACH = 8.6
_MLE_WRAPS = 3
_MLE_GRID = 64
_MLE_REFINEMENTS = 34
# the five samples are the mean plus these multiples of (a, b)
DIRAC_SIGNS = ((-1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (0.0, 0.0))
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


class Mixture(NamedTuple):
    """A wrapped Gaussian mixture: means (n, 2), weights (n,), and a common covariance (2, 2)."""

    mean: NDArray[np.float64]
    weights: NDArray[np.float64]
    covariance: NDArray[np.float64]


def circular_correlation(c11: Component, c12: Component, c22: Component) -> Component:
    """Compute r_c of a wrapped normal: sinh(c12) / sqrt(sinh(c11) sinh(c22)), without overflow.

    The definition printed in section II lacks the square root of the denominator.
    """
    scale = np.exp(abs(c12) - 0.5 * (c11 + c22)) * np.sign(c12)
    return -scale * np.expm1(-2.0 * abs(c12)) / np.sqrt(np.expm1(-2.0 * c11) * np.expm1(-2.0 * c22))


def covariance_of(correlation: Component, c11: Component, c22: Component) -> Component:
    """Compute the c12 of a wrapped normal with this r_c; the inverse of `circular_correlation`."""
    return np.arcsinh(correlation * np.sqrt(np.sinh(c11) * np.sinh(c22)))


def diracs(c11: Component, c22: Component, correlation: Component, w5: Component) -> Components:
    """Compute offsets a, b in (0, pi) from the mean, and weights w1 = w2, w3 = w4 (algorithm 1).

    cos a = 1 - (1 - m) / (2 w~) with 1 - m = 1 - exp(-c11 / 2); the paper misplaces the bracket. The
    computation uses half angles, which keeps all digits of small variances.
    """
    w = 0.5 - 0.5 * w5
    a = 2.0 * np.arcsin(np.sqrt(-np.expm1(-0.5 * c11) / (4.0 * w)))
    b = 2.0 * np.arcsin(np.sqrt(-np.expm1(-0.5 * c22) / (4.0 * w)))
    return a, b, 0.5 * w * (1.0 + correlation), 0.5 * w * (1.0 - correlation)


def five_samples(
    mean: NDArray, covariance: NDArray, central_weight: float, x: NDArray, weights: NDArray
) -> None:
    """Write the samples of algorithm 1 for a wrapped normal.

    Args:
        mean, covariance: (2,), (2, 2).
        central_weight: w5, 0 to 1/2.
        x, weights: positions (5, 2) and weights (5,), overwritten; x is not wrapped.
    """
    c11, c12, c22 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    a, b, w1, w3 = diracs(c11, c22, circular_correlation(c11, c12, c22), central_weight)
    for n, (sign1, sign2) in enumerate(DIRAC_SIGNS):
        x[n, 0], x[n, 1] = mean[0] + sign1 * a, mean[1] + sign2 * b
    for n, weight in enumerate((w1, w1, w3, w3, central_weight)):
        weights[n] = weight


def circular_moments(x: NDArray, weights: NDArray, spread: NDArray) -> Components:
    """Compute circular means, circular variances -2 ln|m|, and r_c of a wrapped Gaussian mixture.

    Args:
        x: means of the components (n, 2), or samples.
        weights: (n,), with sum 1.
        spread: the covariance (2, 2) of every component; 0 for samples.

    No step subtracts from 1, because small variances would lose digits.
    """
    means, variances, fading, squares = np.empty(2), np.empty(2), np.empty(2), np.empty(2)
    for k in range(2):
        sine, cosine = 0.0, 0.0
        for n in range(len(weights)):
            sine += weights[n] * math.sin(x[n, k])
            cosine += weights[n] * math.cos(x[n, k])
        means[k] = math.atan2(sine, cosine)
        shortfall, square = 0.0, 0.0
        for n in range(len(weights)):
            shortfall += weights[n] * 2.0 * math.sin(0.5 * (x[n, k] - means[k])) ** 2
            square += weights[n] * math.sin(x[n, k] - means[k]) ** 2
        variances[k] = min(spread[k, k] - 2.0 * math.log1p(-min(shortfall, 1.0)), UNIFORM)
        fading[k] = math.exp(-2.0 * spread[k, k])
        squares[k] = fading[k] * square - 0.5 * math.expm1(-2.0 * spread[k, k])
    sines, cosines = 0.0, 0.0
    for n in range(len(weights)):
        first, second = x[n, 0] - means[0], x[n, 1] - means[1]
        sines += weights[n] * math.sin(first) * math.sin(second)
        cosines += weights[n] * math.cos(first) * math.cos(second)
    cross = math.cosh(spread[0, 1]) * sines + math.sinh(spread[0, 1]) * cosines
    correlation = cross * math.sqrt(math.sqrt(fading[0] * fading[1]) / (squares[0] * squares[1]))
    return means[0], means[1], variances[0], variances[1], correlation


def mixed_mle(
    x: NDArray,
    weights: NDArray,
    m1: float,
    m2: float,
    c11: float,
    c22: float,
    deviations: NDArray,
) -> float:
    """Find the c12 that maximizes the weighted likelihood of samples, given the other moments.

    Kurz and Hanebeck, CDC 2015. The likelihood has several maxima, so the search starts with a grid over
    the whole range. The wraps are truncated at three, as in the source.

    Args:
        x, weights: samples (n, 2), weights (n,).
        m1, m2, c11, c22: the circular means and variances.
        deviations: (n, 2), scratch memory.
    """
    for n in range(len(x)):
        deviations[n, 0] = wrap_angle(x[n, 0] - m1) / math.sqrt(c11)
        deviations[n, 1] = wrap_angle(x[n, 1] - m2) / math.sqrt(c22)
    turns = TURN / math.sqrt(c11), TURN / math.sqrt(c22)
    # correlation = sin(position): the grid is dense near -1 and 1, where the likelihood is narrow
    spacing = math.pi / (_MLE_GRID + 1)
    best, centre = -np.inf, 0.0
    for n in range(1, _MLE_GRID + 1):
        position = n * spacing - 0.5 * math.pi
        value = _log_likelihood(math.sin(position), deviations, weights, turns)
        if value > best:
            best, centre = value, position
    low, high = centre - spacing, centre + spacing
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left = _log_likelihood(math.sin(left), deviations, weights, turns)
    at_right = _log_likelihood(math.sin(right), deviations, weights, turns)
    for _ in range(_MLE_REFINEMENTS):
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = _log_likelihood(math.sin(left), deviations, weights, turns)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = _log_likelihood(math.sin(right), deviations, weights, turns)
    return math.sin(0.5 * (low + high)) * math.sqrt(c11 * c22)


def _log_likelihood(rho: float, x: NDArray, weights: NDArray, turns: tuple[float, float]) -> float:
    """Compute the log likelihood, up to a constant, of samples (n, 2) scaled by standard deviations."""
    scale = 0.5 / (1.0 - rho * rho)
    total = 0.5 * math.log(scale)
    for n in range(len(weights)):
        density = 0.0
        for j in range(-_MLE_WRAPS, _MLE_WRAPS + 1):
            first = x[n, 0] + j * turns[0]
            for k in range(-_MLE_WRAPS, _MLE_WRAPS + 1):
                second = x[n, 1] + k * turns[1]
                density += math.exp(
                    -scale * (first * first - 2.0 * rho * first * second + second * second)
                )
        # the sum must stay finite if the density of a sample underflows
        total += weights[n] * math.log(density + 1e-300)
    return total


def fit_samples(x: NDArray, weights: NDArray) -> Components:
    """Fit a wrapped normal (m1, m2, c11, c12, c22) with the circular moments and r_c of samples.

    If no positive definite covariance has this r_c, c12 is the mixed maximum-likelihood estimate.

    Args:
        x, weights: samples (n, 2), weights (n,) with sum 1.
    """
    m1, m2, c11, c22, correlation = circular_moments(x, weights, np.zeros((2, 2)))
    c12 = covariance_of(correlation, c11, c22)
    if not c12 * c12 < c11 * c22:
        c12 = mixed_mle(x, weights, m1, m2, c11, c22, np.empty(x.shape))
    return m1, m2, c11, c12, c22


def blank_mixture(variance: NDArray) -> Mixture:
    """Allocate memory for a product; `variance` (2,) is at least the sum of the densities' variances."""
    most = (2 * _turns(variance[0]) + 1) * (2 * _turns(variance[1]) + 1)
    return Mixture(np.empty((most, 2)), np.empty(most), np.empty((2, 2)))


def product_mixture(
    mean: NDArray, covariance: NDArray, other_mean: NDArray, other: NDArray, mixture: Mixture
) -> int:
    """Compute the product of two wrapped normal densities, which is exactly a wrapped Gaussian mixture.

    The mixture has one component for each number of full turns between the two means; a Kalman update
    computes the component. Returns the number of components.

    Args:
        mean, covariance, other_mean, other: means (2,) and covariances (2, 2) of both densities.
        mixture: overwritten; it must be large enough, see `blank_mixture`.
    """
    first, second, inverse = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    _limit(covariance, first)
    _limit(other, second)
    total, gain = np.empty((2, 2)), np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            total[i, j] = first[i, j] + second[i, j]
    determinant = total[0, 0] * total[1, 1] - total[0, 1] * total[1, 0]
    for i in range(2):
        inverse[i, i] = total[1 - i, 1 - i] / determinant
        inverse[i, 1 - i] = -total[i, 1 - i] / determinant
    _multiply(first, inverse, gain)
    _multiply(gain, second, mixture.covariance)
    turns0, turns1 = _turns(total[0, 0]), _turns(total[1, 1])
    wide = 2 * turns1 + 1
    count = (2 * turns0 + 1) * wide
    greatest = -np.inf
    for n in range(count):
        innovation0 = wrap_angle(other_mean[0] - mean[0]) + (n // wide - turns0) * TURN
        innovation1 = wrap_angle(other_mean[1] - mean[1]) + (n % wide - turns1) * TURN
        exponent = -0.5 * (
            inverse[0, 0] * innovation0**2
            + 2.0 * inverse[0, 1] * innovation0 * innovation1
            + inverse[1, 1] * innovation1**2
        )
        greatest = max(greatest, exponent)
        mixture.weights[n] = exponent
        for k in range(2):
            mixture.mean[n, k] = mean[k] + gain[k, 0] * innovation0 + gain[k, 1] * innovation1
    sum_of_weights = 0.0
    for n in range(count):
        mixture.weights[n] = np.exp(mixture.weights[n] - greatest)
        sum_of_weights += mixture.weights[n]
    for n in range(count):
        mixture.weights[n] /= sum_of_weights
    return count


def _multiply(left: NDArray, right: NDArray, product: NDArray) -> None:
    for i in range(2):
        for j in range(2):
            product[i, j] = left[i, 0] * right[0, j] + left[i, 1] * right[1, j]


def _limit(covariance: NDArray, limited: NDArray) -> None:
    """Write the covariance, or UNIFORM times the identity if the distribution is uniform."""
    c11, c12, c22 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    least = 0.5 * (c11 + c22) - math.hypot(0.5 * (c11 - c22), c12)
    for i in range(2):
        for j in range(2):
            uniform = UNIFORM if i == j else 0.0
            limited[i, j] = uniform if least > UNIFORM else covariance[i, j]


def _turns(variance: float) -> int:
    """Return the number of turns in each direction for which the wrapped sum has full precision."""
    return int((_REACH * math.sqrt(variance) + math.pi) / TURN) + 1


def fit_product(
    mean: NDArray, covariance: NDArray, other_mean: NDArray, other: NDArray, mixture: Mixture
) -> Components:
    """Fit a wrapped normal (m1, m2, c11, c12, c22) with the circular moments and r_c of a product.

    If no positive definite covariance has this r_c because the modes are far apart, c12 keeps the
    correlation of the components.

    Args:
        mean, covariance, other_mean, other: means (2,) and covariances (2, 2) of both densities.
        mixture: scratch memory, see `blank_mixture`.
    """
    count = product_mixture(mean, covariance, other_mean, other, mixture)
    means, weights, spread = mixture.mean[:count], mixture.weights[:count], mixture.covariance
    m1, m2, c11, c22, correlation = circular_moments(means, weights, spread)
    c12 = covariance_of(correlation, c11, c22)
    if not c12 * c12 < c11 * c22:
        c12 = spread[0, 1] * math.sqrt(c11 * c22 / (spread[0, 0] * spread[1, 1]))
    return m1, m2, c11, c12, c22


def density(x1: float, x2: float, covariance: NDArray) -> float:
    """Compute the density at a deviation from the mean, by the wrapped sum or the shorter Fourier sum.

    Args:
        x1, x2: the deviation, in rad.
        covariance: (2, 2).
    """
    c11, c12, c22 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    least = 0.5 * (c11 + c22) - math.hypot(0.5 * (c11 - c22), c12)
    total = 0.0
    if least > 1.0:
        most = int(_REACH / math.sqrt(least)) + 1
        for j in range(-most, most + 1):
            for k in range(-most, most + 1):
                decay = math.exp(-0.5 * (j * j * c11 + 2.0 * j * k * c12 + k * k * c22))
                total += decay * math.cos(j * x1 + k * x2)
        return max(total, 0.0) / TURN**2
    determinant = c11 * c22 - c12 * c12
    turns1, turns2 = _turns(c11), _turns(c22)
    x1, x2 = wrap_angle(x1), wrap_angle(x2)
    for j in range(-turns1, turns1 + 1):
        first = x1 + j * TURN
        for k in range(-turns2, turns2 + 1):
            second = x2 + k * TURN
            square = c22 * first * first - 2.0 * c12 * first * second + c11 * second * second
            total += math.exp(-0.5 * square / determinant)
    return total / (TURN * math.sqrt(determinant))


@cache
def _over_all(function: Callable[..., None]) -> Callable[..., None]:
    return compile_over_runs(function)


def _density_one(n: int, deviation: NDArray, covariance: NDArray, out: NDArray) -> None:
    out[n] = density(deviation[n, 0], deviation[n, 1], covariance[n])


def density_each(deviation: NDArray, covariance: NDArray) -> NDArray:
    """Compute the density (n,) at every deviation; see `density`.

    Args:
        deviation, covariance: (n, 2), (n, 2, 2).
    """
    out = np.empty(len(deviation))
    _over_all(_density_one)(len(out), deviation, covariance, out)
    return out


def _circular_moments_one(n: int, x: NDArray, weights: NDArray, out: NDArray) -> None:
    moments = circular_moments(x[n], weights[n], np.zeros((2, 2)))
    out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = moments


def circular_moments_each(x: NDArray, weights: NDArray) -> NDArray:
    """Compute the circular moments (n, 5) of sample sets; see `circular_moments`.

    Args:
        x, weights: samples (n, samples, 2), weights (n, samples).
    """
    out = np.empty((len(x), 5))
    _over_all(_circular_moments_one)(len(out), x, weights, out)
    return out


def _mixed_mle_one(n: int, x: NDArray, weights: NDArray, out: NDArray, deviations: NDArray) -> None:
    m1, m2, c11, c22, _ = circular_moments(x[n], weights[n], np.zeros((2, 2)))
    c12 = mixed_mle(x[n], weights[n], m1, m2, c11, c22, deviations)
    out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = m1, m2, c11, c12, c22


def fit_mixed_mle_each(x: NDArray, weights: NDArray) -> NDArray:
    """Fit m1, m2, c11, c12, c22 (n, 5) to sample sets, with c12 by `mixed_mle`.

    Args:
        x, weights: samples (n, samples, 2), weights (n, samples).
    """
    out, memory = np.empty((len(x), 5)), partial(np.empty, x.shape[1:])
    _over_all(_mixed_mle_one)(len(out), x, weights, out, scratch=memory)
    return out


def _product_one(
    n: int,
    mean: NDArray,
    covariance: NDArray,
    other_mean: NDArray,
    other: NDArray,
    out: NDArray,
    mixture: Mixture,
) -> None:
    fitted = fit_product(mean[n], covariance[n], other_mean[n], other[n], mixture)
    out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = fitted


def fit_product_each(mean: NDArray, covariance: NDArray, other_mean: NDArray, other: NDArray) -> NDArray:
    """Fit wrapped normals (n, 5) to products of pairs of densities; see `fit_product`.

    Args:
        mean, covariance, other_mean, other: means (n, 2) and covariances (n, 2, 2) of both densities.
    """
    out, variance = np.empty((len(mean), 5)), np.einsum("nkk->nk", covariance + other)
    memory = partial(blank_mixture, variance.max(axis=0, initial=0.0))
    _over_all(_product_one)(len(out), mean, covariance, other_mean, other, out, scratch=memory)
    return out
