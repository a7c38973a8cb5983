"""Fuses estimates whose errors correlate in an unknown way: covariance intersection and kin.

Jin, Lee, Hashimoto, DIND networks, 5.2, (14)-(15); Niehsen, Information Fusion Based on Fast Covariance
Intersection (2002); Franken, Huepper, Improved Fast Covariance Intersection (2005); Noack, Sijs,
Reinhardt, Hanebeck, Inverse Covariance Intersection (2017); Li, Nashashibi, Split CI (2013). A rule
fuses K estimates of one state: scalar loops, so that networks compile it, called `fuse(count, parts,
weights, mean, covariance, memory) -> gap`, infinity where a covariance is singular.
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
# by their numbers, which are known only when a kernel runs: one kernel has them all
RULES = ("ci-trace", "ci-determinant", "niehsen", "franken", "naive", "inverse-ci", "split-ci")
CI_TRACE, CI_DETERMINANT, NIEHSEN, FRANKEN, NAIVE, INVERSE_CI, SPLIT_CI = range(len(RULES))


class Fusions(NamedTuple):
    """Holds mean (..., n), covariance (..., n, n), weights (..., K) and their certificate `gap` (...,).

    By the conditions of Karush, Kuhn and Tucker no weights better the criterion (the trace's logarithm,
    or the determinant's divided by n) by more than the gap; it is 0 where a rule optimises nothing. A
    rule that fuses one after another states, at i > 0, the weight of what was fused before i.
    """

    mean: Floats
    covariance: Floats
    weights: Floats
    gap: Floats


class FusionMemory(NamedTuple):
    """Holds the informations (K, n, n) of K estimates that are fused, and weights (K,) to come."""

    information: Floats
    better: Floats


def fusion_memory(count: int, states: int) -> FusionMemory:
    """Allocate memory for the fusion of so many estimates at most."""
    return FusionMemory(np.empty((count, states, states)), np.empty(count))


def summed(count: int, weights: Floats, information: Floats, covariance: Floats) -> bool:
    """Fill the covariance of the weighted sum of informations, (14); False where it is singular.

    Args:
        count: K, how many are summed.
        weights, information: of each, (K,), (K, n, n); more of them are left alone.
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
    """Fill mean and covariance of the weighted sum, (14) and (15); False where it is singular.

    Args:
        count, weights, information: as for `summed`.
        means: (K, n), of the estimates.
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
    """Fill P^2 / tr P: the criterion gains tr(I_i slope) by weight i.

    Args:
        covariance, slope: P and what is filled, (n, n).
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
    """Fill P / n: the criterion gains tr(I_i slope) by weight i.

    Args:
        covariance, slope: P and what is filled, (n, n).
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
    """Fill weights by w_i <- w_i g_i^p, normalised, until none can gain more than the tolerance.

    For the trace p is 1/2, for the determinant 1. At the least criterion no gain g_i = tr(I_i slope)
    exceeds 1, and those of weights above 0 are 1.

    Args:
        by_trace: whether the trace is least, or the determinant.
        count, covariances, memory, weights, tolerance: as for `weigh`.

    Returns:
        The gap, see `Fusions`; infinity where a covariance is singular.
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
    """Weigh in proportion to 1 / tr P_i: Niehsen.

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
    """Weigh by what is lost from |sum of I| without I_i, plus |I_i|: Franken and Huepper.

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
    """Weigh each by 1, as if all errors were independent: naive Kalman fusion.

    Args:
        count, weights: as for `weigh`.
    """
    weights[:count] = 1.0


def weigh(
    rule: int, count: int, covariances: Floats, memory: FusionMemory, weights: Floats, tolerance: float
) -> float:
    """Fill the weights of a rule that adds up weighted informations; returns their certificate.

    Args:
        rule: its number in `RULES`.
        count: K, how many estimates there are.
        covariances: (K, n, n).
        memory: with their informations.
        weights: (K,), overwritten.
        tolerance: how much the criterion may still gain.
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
    """Add up weighted informations."""
    information, (mean, covariance, weights) = memory.information, fused
    for i in range(count):
        if not inverted(parts.covariance[i], information[i]):
            return np.inf
    gap = weigh(rule, count, parts.covariance, memory, weights, tolerance)
    if not gap < np.inf or not combined(count, weights, information, parts.mean, mean, covariance):
        return np.inf
    return gap


def rule_number(name: str) -> int:
    """Return the number of a rule of RULES; raises BadInput for another name."""
    if name not in RULES:
        raise BadInput(f"no fusion rule '{name}'; there are: {', '.join(RULES)}")
    return RULES.index(name)


def fuse_by(
    rule: int, count: int, parts: Estimate, fused: Fused, tolerance: float, memory: FusionMemory
) -> float:
    """Fuse the first `count` estimates by the rule of a number; returns the certificate.

    `tolerance` bounds the gap where weights are optimised together, and the square of ten times a
    single weight's error.
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
        independents: (..., K, n, n), for "split-ci": the parts independent of all other errors.
        tolerance: what the certificate of an optimised rule must reach.

    Raises BadInput where shapes do not fit, a number is not finite, a covariance is not symmetric and
    positive definite, an independent part exceeds its covariance, or the weights do not converge.
    """
    mean, covariance = np.asarray(means, float), np.asarray(covariances, float)
    if mean.ndim < 2 or covariance.shape != (*mean.shape, mean.shape[-1]) or mean.shape[-2] == 0:
        raise BadInput(
            f"means {mean.shape} and covariances {covariance.shape}: (..., K, n) and (..., K, n, n) "
            "of one estimate or more are needed"
        )
    known = np.zeros_like(covariance) if independents is None else np.asarray(independents, float)
    if known.shape != covariance.shape:
        raise BadInput(
            f"independent parts {known.shape}, covariances {covariance.shape}; give one part for each "
            "covariance"
        )
    for part in (mean, covariance, known):
        if not np.isfinite(part).all():
            raise BadInput("an estimate is not finite; leave it out")
    if not np.allclose(covariance, np.swapaxes(covariance, -1, -2), rtol=1e-9, atol=0):
        raise BadInput("a covariance is not symmetric; give the full matrix")
    least = np.linalg.eigvalsh(covariance)[..., 0]
    if np.any(least <= 0):
        raise BadInput(
            "a covariance is singular; a certain component cannot be fused by rules; give it a variance"
        )
    if np.any(np.linalg.eigvalsh(covariance - known)[..., 0] < -1e-9 * least):
        raise BadInput("an independent part exceeds its covariance; give at most the covariance")
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
            "a covariance is singular to working precision; choose units in which its variances are "
            "alike"
        )
    if np.any(fused.gap > tolerance):
        raise BadInput(
            f"the weights did not converge: the certificate is {fused.gap.max():.1e}, not {tolerance}"
        )
    return Fusions(*(part.reshape(batch + part.shape[1:]) for part in fused))
