"""Chi-squared distribution, with the function names of `scipy.stats.chi2`.

Importing scipy.special takes a fifth of the run time of a short command, so these functions are
kernels. Half of a chi-squared variable with k degrees of freedom has the gamma distribution with shape
k / 2.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.replay.engine.arrays import Floats

# A number or an array, like the arguments.
Numbers = Any  # type: ignore[explicit-any]

_ROUNDING = 2.0**-53
_STEPS = 100  # of Newton's method, which needs 3 to 12
_CLOSE = 1e-9  # relative step of Newton's method whose square is below the rounding error
_FARTHEST = 2.0  # largest relative step
_TINY = 1e-300


def ppf(probability: ArrayLike, degrees: ArrayLike) -> Numbers:
    """Compute the quantiles of the chi-squared distribution for given probabilities.

    Args:
        probability: (...), from 0 to 1.
        degrees: (...), degrees of freedom.

    Returns:
        (...), or one number.
    """
    return _quantile(probability, np.subtract(1.0, probability), degrees)


def isf(probability: ArrayLike, degrees: ArrayLike) -> Numbers:
    """Compute upper quantiles: the values that a chi-squared variable exceeds with given probabilities.

    Args:
        probability: (...), from 0 to 1.
        degrees: (...), degrees of freedom.

    Returns:
        (...), or one number.
    """
    return _quantile(np.subtract(1.0, probability), probability, degrees)


def sf(value: ArrayLike, degrees: ArrayLike) -> Numbers:
    """Compute the probabilities that a chi-squared variable exceeds given values.

    Args:
        value: (...), not negative.
        degrees: (...), degrees of freedom.

    Returns:
        (...), or one number.
    """
    return _by_element(_tails, value, degrees)


def _quantile(below: ArrayLike, above: ArrayLike, degrees: ArrayLike) -> Numbers:
    return _by_element(_quantiles, below, above, degrees)


def _by_element(loop: OverRuns, *numbers: ArrayLike) -> Numbers:
    """Apply a kernel to each element of broadcast arrays; the last array has the degrees of freedom."""
    same = np.broadcast_arrays(*(np.asarray(each, np.float64) for each in numbers))
    columns = [np.ascontiguousarray(each).ravel() for each in same]
    shape = 0.5 * columns.pop()
    log_gamma = np.array([math.lgamma(each) if each > 0.0 else math.nan for each in shape])
    found = np.empty(len(shape))
    loop(len(found), found, *columns, shape, log_gamma)
    return found.reshape(same[0].shape)[()]


def _log_tails(shape: float, log_gamma: float, value: float) -> tuple[float, float]:
    """Compute the logarithms of the gamma distribution's probabilities below and above a value.

    The smaller probability is computed by a series, or by a continued fraction with Lentz's method
    (Press et al., Numerical Recipes, 6.2); the other is its complement.
    """
    front = shape * math.log(value) - value - log_gamma
    if value < shape + 1.0:
        term = 1.0 / shape
        total, n = term, 1.0
        while term > _ROUNDING * total:
            term *= value / (shape + n)
            total += term
            n += 1.0
        below = front + math.log(total)
        return below, _log_of_rest(below)
    b = value + 1.0 - shape
    c, d = 1.0 / _TINY, 1.0 / b
    product, change, n = d, 0.0, 1.0
    while abs(change - 1.0) > 8.0 * _ROUNDING:
        a = -n * (n - shape)
        b += 2.0
        d, c = a * d + b, b + a / c
        d = 1.0 / (d if abs(d) > _TINY else _TINY)
        c = c if abs(c) > _TINY else _TINY
        change = c * d
        product *= change
        n += 1.0
    above = front + math.log(product)
    return _log_of_rest(above), above


def _log_of_rest(log_probability: float) -> float:
    return math.log1p(-min(math.exp(log_probability), 1.0 - _ROUNDING))


def _tail(run: int, found: Floats, value: Floats, shape: Floats, log_gamma: Floats) -> None:
    """Compute the probability that a value is exceeded."""
    half = 0.5 * value[run]
    if not 0.0 < shape[run] < math.inf or not half >= 0.0:
        found[run] = math.nan
    elif half == 0.0 or half == math.inf:
        found[run] = 1.0 if half == 0.0 else 0.0
    else:
        found[run] = math.exp(_log_tails(shape[run], log_gamma[run], half)[1])


def _solve(
    run: int, found: Floats, below: Floats, above: Floats, shape: Floats, log_gamma: Floats
) -> None:
    """Find the value with given probabilities below and above it, by Newton's method on its logarithm.

    The logarithm of the smaller tail, as a function of the logarithm of the value, is nearly linear at
    small values, and its curvature does not change sign.
    """
    if not 0.0 < shape[run] < math.inf or not 0.0 <= below[run] <= 1.0:
        found[run] = math.nan
    elif below[run] == 0.0 or above[run] == 0.0:
        found[run] = 0.0 if below[run] == 0.0 else math.inf
    else:
        is_below = below[run] < above[run]
        wanted = math.log(below[run] if is_below else above[run])
        value = shape[run]
        for _ in range(_STEPS):
            low, high = _log_tails(shape[run], log_gamma[run], value)
            tail = low if is_below else high
            slope = math.exp(shape[run] * math.log(value) - value - log_gamma[run] - tail)
            step = (wanted - tail) / (slope if is_below else -slope)
            value *= math.exp(min(max(step, -_FARTHEST), _FARTHEST))
            if abs(step) < _CLOSE:
                break
        found[run] = 2.0 * value


_tails = compile_over_runs(_tail)
_quantiles = compile_over_runs(_solve)
