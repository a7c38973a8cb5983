"""The overlapping Allan deviation, with intervals from a model's degrees of freedom.

NIST SP 1065 has the definitions. Degrees of freedom are exact for any sum of Gaussian terms. For M
second differences with autocovariance g, their number is M^2 g_0^2 / sum over |k| < M of (M - |k|)
g_k^2.
"""

from typing import NamedTuple

import numpy as np

from fuselog.pipeline.sensing.terms import Terms
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Floats, Integers

PER_DECADE = 8
_BLOCK = 1 << 16
_FULL = 1 << 17  # number of samples above which only some of the differences are used
_A_WINDOW = 1000  # number of differences per window in this case, which are as accurate as all


class Curve(NamedTuple):
    """An Allan deviation, with times (n,), deviations (n,), and numbers of differences (n,)."""

    taus_s: Floats
    deviations: Floats
    pairs: Integers


def multiples_of(count: int) -> Integers:
    """Choose window lengths, in samples, for a curve of `count` samples, up to a third of `count`."""
    decades = np.log10(max(count // 3, 1))
    spread = np.logspace(0, decades, int(PER_DECADE * decades) + 1)
    return np.unique(np.floor(spread + 1e-9).astype(np.int64))


def _stride(multiple: int, count: int) -> int:
    """Compute the step between used differences; adjacent ones are nearly equal for long windows."""
    return max(1, multiple // _A_WINDOW) if count > _FULL else 1


def allan_deviation(values: Floats, step_s: float, multiples: Integers) -> Curve:
    """Compute the overlapping Allan deviation of samples (n,) every `step_s`; NaN marks lost samples.

    Only pairs of complete windows are used. For many samples, a thousand differences per window are
    used.

    Args:
        values: the samples, in any unit, on a grid without gaps.
        step_s: the grid's step.
        multiples: (m,) the lengths of windows, in samples.
    """
    is_there = np.isfinite(values)
    first = values[is_there][:1]
    phases = np.zeros(len(values) + 1)
    np.cumsum(np.where(is_there, values - first, 0.0), out=phases[1:])
    lost = None if is_there.all() else np.concatenate([[0], np.cumsum(~is_there)])
    squares, pairs = np.zeros(len(multiples)), np.zeros(len(multiples), np.int64)
    for place, m in enumerate(multiples.tolist()):
        stride = _stride(m, len(values))
        for begin in range(0, len(values) - 2 * m + 1, _BLOCK * stride):
            end = min(begin + _BLOCK * stride, len(values) - 2 * m + 1)
            here, later, last = (slice(begin + k * m, end + k * m, stride) for k in range(3))
            found = phases[last] + phases[here] - 2 * phases[later]
            if lost is not None:
                found = found[lost[last] == lost[here]]
            squares[place] += stride * (found @ found)
            pairs[place] += stride * len(found)
    with np.errstate(divide="ignore", invalid="ignore"):
        deviations = np.sqrt(squares / (2.0 * multiples**2 * pairs))
    return Curve(np.asarray(multiples * step_s, float), deviations, pairs)


def degrees_of_freedom(terms: Terms, step_s: float, multiple: int, pairs: int) -> float:
    """Compute an Allan variance's degrees of freedom from its `pairs` and the noise terms."""
    coarser = _stride(multiple, pairs + 2 * multiple)
    multiple, pairs, step_s = multiple // coarser, max(1, pairs // coarser), step_s * coarser
    g = terms.autocovariance(multiple, step_s, pairs)
    weights = 2.0 * (pairs - np.arange(len(g)))
    weights[0] = pairs
    return float(pairs**2 * g[0] ** 2 / (weights @ g**2))


def interval(deviations: Floats, degrees: Floats, confidence: float = 0.95) -> tuple[Floats, Floats]:
    """Compute chi-square intervals of the true deviations.

    Args:
        deviations: (n,), Allan deviations in any unit.
        degrees: (n,), the degrees of freedom of each variance.
        confidence: the probability with which an interval covers the truth.

    Returns:
        The lower and the upper ends, (n,) each, in the unit of the deviations.
    """
    tail = (1 - confidence) / 2
    low = deviations * np.sqrt(degrees / chi2.ppf(1 - tail, degrees))
    return low, deviations * np.sqrt(degrees / chi2.ppf(tail, degrees))
