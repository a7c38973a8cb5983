"""Fusion of estimates whose errors have unknown correlations: covariance intersection and related rules.

Jin, Lee, Hashimoto, DIND networks, 5.2, (14)-(15); Niehsen, Information Fusion Based on Fast Covariance
Intersection (2002); Franken, Huepper, Improved Fast Covariance Intersection (2005); Noack, Sijs,
Reinhardt, Hanebeck, Inverse Covariance Intersection (2017); Li, Nashashibi, Split CI (2013). A rule
fuses K estimates of one state. The rules are scalar loops, which compiled networks can call. A rule is
called as `fuse(count, parts, weights, mean, covariance, memory) -> gap`; the gap is infinite if a
covariance is singular.
"""

from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.families.networks.estimates import (
    Estimate,
    Fused,
    blend,
    determinant,
    inverted,
    one_of,
    transform,
)
from fuselog.replay.families.networks.pairwise import fuse_in_turn

Criterion = Literal["trace", "determinant"]
ITERATIONS = 10_000
# one kernel contains all rules and selects a rule by its number at run time
RULES = ("ci-trace", "ci-determinant", "niehsen", "franken", "naive", "inverse-ci", "split-ci")
CI_TRACE, CI_DETERMINANT, NIEHSEN, FRANKEN, NAIVE, INVERSE_CI, SPLIT_CI = range(len(RULES))


class Fusions(NamedTuple):
    """Fused mean (..., n), covariance (..., n, n), weights (..., K) and their `gap` (...,).

    By the Karush-Kuhn-Tucker conditions, no other weights improve the criterion (the logarithm of the
    trace, or the log determinant divided by n) by more than the gap. The gap is 0 for a rule without
    optimization. For a rule that fuses one estimate after another, weight i > 0 is the weight of the
    fusion of all estimates before i.
    """

    mean: Floats
    covariance: Floats
    weights: Floats
    gap: Floats


class FusionMemory(NamedTuple):
    """Scratch memory for the information matrices (K, n, n) of estimates and their next weights (K,)."""

    information: Floats
    better: Floats


def fusion_memory(count: int, states: int) -> FusionMemory:
    """Allocate memory for the fusion of at most `count` estimates."""
    return FusionMemory(np.empty((count, states, states)), np.empty(count))


def summed(count: int, weights: Floats, information: Floats, covariance: Floats) -> bool:
    """Compute the covariance of the weighted sum of information, (14); return False if it is singular.

    Args:
        count: number K of estimates to sum.
        weights, information: weights (K,) and information matrices (K, n, n); entries after the first K
            are ignored.
        covariance: (n, n), overwritten.
    """
    size = len(covariance)
    total = np.zeros((size, size))
    for i in range(count):
        for row in range(size):
            for column in range(row + 1):
                total[row, column] += weights[i] * information[i, row, column]
    return inverted(total, covariance)


def combined(
    count: int, weights: Floats, information: Floats, means: Floats, mean: Floats, covariance: Floats
) -> bool:
    """Compute mean and covariance of the weighted sum, (14) and (15); return False if it is singular.

    Args:
        count, weights, information: as for `summed`.
        means: means of the estimates, (K, n).
        mean, covariance: (n,), (n, n), overwritten.
    """
    if not summed(count, weights, information, covariance):
        return False
    size = len(mean)
    vector = np.zeros(size)
    for i in range(count):
        for row in range(size):
            for k in range(size):
                vector[row] += weights[i] * information[i, row, k] * means[i, k]
    transform(covariance, vector, mean)
    return True


def trace_slope(covariance: Floats, slope: Floats) -> None:
    """Compute P^2 / tr P, the slope; the criterion improves with weight i at the rate tr(I_i slope).

    Args:
        covariance, slope: P and the result, (n, n).
    """
    trace = 0.0
    for row in range(len(covariance)):
        trace += covariance[row, row]
        for column in range(row + 1):
            squared = 0.0
            for k in range(len(covariance)):
                squared += covariance[row, k] * covariance[column, k]
            slope[row, column] = squared
    for row in range(len(covariance)):
        for column in range(row + 1):
            slope[row, column] /= trace
            slope[column, row] = slope[row, column]


def determinant_slope(covariance: Floats, slope: Floats) -> None:
    """Compute P / n, the slope; the criterion improves with weight i at the rate tr(I_i slope).

    Args:
        covariance, slope: P and the result, (n, n).
    """
    size = len(covariance)
    for row in range(size):
        for column in range(size):
            slope[row, column] = covariance[row, column] / size


def weigh_optimally(
    by_trace: bool,
    count: int,
    covariances: Floats,
    memory: FusionMemory,
    weights: Floats,
    tolerance: float,
) -> float:
    """Iterate w_i <- w_i g_i^p, normalized, until the gap is within the tolerance.

    The power p is 1/2 for the trace and 1 for the determinant. At the minimum, no gain g_i = tr(I_i
    slope) exceeds 1, and the gains of positive weights are 1.

    Args:
        by_trace: whether to minimize the trace instead of the determinant.
        count, covariances, memory, weights, tolerance: as for `weigh`.

    Returns:
        The gap, see `Fusions`; infinity if a covariance is singular.
    """
    gap = np.inf
    size = covariances.shape[1]
    covariance, slope = np.empty((size, size)), np.empty((size, size))
    information, better = memory
    for i in range(count):
        weights[i] = 1.0 / count
    for _ in range(ITERATIONS):
        if not summed(count, weights, information, covariance):
            return np.inf
        if by_trace:
            trace_slope(covariance, slope)
        else:
            determinant_slope(covariance, slope)
        total, gap = 0.0, -np.inf
        for i in range(count):
            gain = 0.0
            for row in range(size):
                for k in range(size):
                    gain += information[i, row, k] * slope[row, k]
            gap = max(gap, gain - 1.0)
            better[i] = weights[i] * (np.sqrt(gain) if by_trace else gain)
            total += better[i]
        if gap <= tolerance:
            break
        for i in range(count):
            weights[i] = better[i] / total
    return gap


def weigh_by_traces(count: int, covariances: Floats, weights: Floats) -> None:
    """Set weights in proportion to 1 / tr P_i (Niehsen).

    Args:
        count, covariances, weights: as for `weigh`.
    """
    total = 0.0
    for i in range(count):
        trace = 0.0
        for row in range(covariances.shape[1]):
            trace += covariances[i, row, row]
        weights[i] = 1.0 / trace
        total += weights[i]
    for i in range(count):
        weights[i] /= total


def weigh_by_shares(count: int, information: Floats, weights: Floats) -> None:
    """Set weights in proportion to |sum of I| - |sum without I_i| + |I_i| (Franken and Huepper).

    Args:
        count, weights: as for `weigh`.
        information: (K, n, n).
    """
    size = information.shape[1]
    whole = np.zeros((size, size))
    rest = np.empty((size, size))
    for i in range(count):
        blend(1.0, whole, 1.0, information[i], whole)
    full = determinant(whole)
    total = 0.0
    for i in range(count):
        blend(1.0, whole, -1.0, information[i], rest)
        weights[i] = full - determinant(rest) + determinant(information[i])
        total += weights[i]
    for i in range(count):
        weights[i] /= total


def weigh_fully(count: int, weights: Floats) -> None:
    """Set all weights to 1, as if all errors were independent (naive Kalman fusion).

    Args:
        count, weights: as for `weigh`.
    """
    weights[:count] = 1.0


def weigh(
    rule: int, count: int, covariances: Floats, memory: FusionMemory, weights: Floats, tolerance: float
) -> float:
    """Compute the weights of a rule that sums weighted information; return their gap.

    Args:
        rule: number of the rule in `RULES`.
        count: number K of estimates.
        covariances: (K, n, n).
        memory: scratch memory with the information matrices of the estimates.
        weights: (K,), overwritten.
        tolerance: largest gap, see `Fusions`, at which the optimization ends.
    """
    if rule in (CI_TRACE, CI_DETERMINANT):
        by_trace = rule == CI_TRACE
        return weigh_optimally(by_trace, count, covariances, memory, weights, tolerance)
    if rule == NIEHSEN:
        weigh_by_traces(count, covariances, weights)
    elif rule == FRANKEN:
        weigh_by_shares(count, memory.information, weights)
    else:
        weigh_fully(count, weights)
    return 0.0


def fuse_together(
    rule: int, count: int, parts: Estimate, fused: Fused, tolerance: float, memory: FusionMemory
) -> float:
    """Fuse estimates by a rule that sums weighted information; return the gap."""
    information, (mean, covariance, weights) = memory.information, fused
    for i in range(count):
        if not inverted(parts.covariance[i], information[i]):
            return np.inf
    gap = weigh(rule, count, parts.covariance, memory, weights, tolerance)
    if not gap < np.inf or not combined(count, weights, information, parts.mean, mean, covariance):
        return np.inf
    return gap


def rule_number(name: str) -> int:
    """Return the number of a rule of RULES; raise BadInput for an unknown name."""
    if name not in RULES:
        raise BadInput(f"no fusion rule '{name}'; choose one of {', '.join(RULES)}")
    return RULES.index(name)


def fuse_by(
    rule: int, count: int, parts: Estimate, fused: Fused, tolerance: float, memory: FusionMemory
) -> float:
    """Fuse the first `count` estimates by the rule with the given number; return the gap.

    `tolerance` limits the gap if the weights are optimized together; otherwise, it limits the square of
    ten times the error of a single weight.
    """
    if rule in (INVERSE_CI, SPLIT_CI):
        return fuse_in_turn(rule == SPLIT_CI, count, parts, fused, tolerance)
    return fuse_together(rule, count, parts, fused, tolerance, memory)


def fuse_run(
    run: int, rule: int, tolerance: float, given: Estimate, fusions: Fusions, memory: FusionMemory
) -> None:
    """Fuse the estimates of one run."""
    into = Fused(fusions.mean[run], fusions.covariance[run], fusions.weights[run])
    count, parts = given.mean.shape[1], one_of(given, run)
    fusions.gap[run] = fuse_by(rule, count, parts, into, tolerance, memory)


_fuse_runs = compile_over_runs(fuse_run)


def fuse(
    name: str,
    means: ArrayLike,
    covariances: ArrayLike,
    independents: ArrayLike | None = None,
    tolerance: float = 1e-9,
) -> Fusions:
    """Fuse K estimates of one state, batch axes first.

    Args:
        name: one of RULES.
        means: (..., K, n).
        covariances: (..., K, n, n).
        independents: (..., K, n, n), for "split-ci": the parts of the covariances due to errors that
            are independent of all others.
        tolerance: largest gap of an optimized rule.

    Raises BadInput if shapes do not match, a value is not finite, a covariance is not symmetric and
    positive definite, an independent part exceeds its covariance, or the weights do not converge.
    """
    mean, covariance = np.asarray(means, float), np.asarray(covariances, float)
    if mean.ndim < 2 or covariance.shape != (*mean.shape, mean.shape[-1]) or mean.shape[-2] == 0:
        raise BadInput(
            f"means have shape {mean.shape} and covariances {covariance.shape}; expected (..., K, n) "
            "and (..., K, n, n) with at least one estimate"
        )
    known = np.zeros_like(covariance) if independents is None else np.asarray(independents, float)
    if known.shape != covariance.shape:
        raise BadInput(
            f"independent parts have shape {known.shape} and covariances {covariance.shape}; give one "
            "part for each covariance"
        )
    for part in (mean, covariance, known):
        if not np.isfinite(part).all():
            raise BadInput("an estimate is not finite; remove it")
    if not np.allclose(covariance, np.swapaxes(covariance, -1, -2), rtol=1e-9, atol=0):
        raise BadInput("a covariance is not symmetric; give the full matrix")
    least = np.linalg.eigvalsh(covariance)[..., 0]
    if np.any(least <= 0):
        raise BadInput(
            "a covariance is singular, but the rules need a positive variance of every component; give "
            "each component a variance"
        )
    if np.any(np.linalg.eigvalsh(covariance - known)[..., 0] < -1e-9 * least):
        raise BadInput("an independent part exceeds its covariance; it can be at most the covariance")
    batch, (count, size) = mean.shape[:-2], mean.shape[-2:]
    runs = int(np.prod(batch))
    fused = Fusions(
        np.empty((runs, size)), np.empty((runs, size, size)), np.empty((runs, count)), np.empty(runs)
    )
    _fuse_runs(
        runs,
        rule_number(name),
        tolerance,
        Estimate(
            mean.reshape(runs, count, size),
            covariance.reshape(runs, count, size, size),
            known.reshape(runs, count, size, size),
        ),
        fused,
        scratch=partial(fusion_memory, count, size),
    )
    if np.any(np.isinf(fused.gap)):
        raise BadInput(
            "a covariance is numerically singular; choose units in which its variances have similar "
            "magnitudes"
        )
    if np.any(fused.gap > tolerance):
        raise BadInput(
            f"the weights did not converge: the certificate is {fused.gap.max():.1e}, above {tolerance}"
        )
    return Fusions(*(part.reshape(batch + part.shape[1:]) for part in fused))
