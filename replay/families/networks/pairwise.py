"""Fusion of two estimates by inverse and split covariance intersection, and the weight of a sighting."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.families.networks.estimates import (
    Estimate,
    Fused,
    blend,
    determinant,
    golden,
    inverted,
    one_of,
    put,
    steps_for,
    transform,
)
from fuselog.replay.inference.linear_algebra.gaussian import multiply

SIGHTING_STEPS = 40


def mix_inverse(weight: float, pair: Estimate, fused: Estimate) -> bool:
    """Fuse two estimates by inverse CI: I_a + I_b minus the inverse of w P_a + (1 - w) P_b."""
    size, shares = len(fused.mean), (weight, 1.0 - weight)
    covariance, information = np.zeros((3, size, size)), np.empty((3, size, size))
    for i in range(2):
        for row in range(size):
            for k in range(size):
                covariance[i, row, k] = pair.covariance[i, row, k]
                covariance[2, row, k] += shares[i] * pair.covariance[i, row, k]
                fused.independent[row, k] = 0.0
    for i in range(3):
        if not inverted(covariance[i], information[i]):
            return False
    total, vector, common = np.empty((size, size)), np.zeros(size), information[2]
    blend(1.0, information[0], 1.0, information[1], total)
    blend(1.0, total, -1.0, common, total)
    if not inverted(total, fused.covariance):
        return False
    for i in range(2):
        for row in range(size):
            for k in range(size):
                entry = information[i, row, k] - shares[i] * common[row, k]
                vector[row] += entry * pair.mean[i, k]
    transform(fused.covariance, vector, fused.mean)
    return True


def mix_split(weight: float, pair: Estimate, fused: Estimate) -> bool:
    """Fuse two estimates by split CI: only the correlated parts are divided by the weights."""
    size, shares = len(fused.mean), (weight, 1.0 - weight)
    part, information = np.empty((size, size)), np.empty((2, size, size))
    for i in range(2):
        inverse = 1.0 / shares[i]
        blend(inverse, pair.covariance[i], 1.0 - inverse, pair.independent[i], part)
        if not inverted(part, information[i]):
            return False
    blend(1.0, information[0], 1.0, information[1], part)
    if not inverted(part, fused.covariance):
        return False
    gain, spread, moved = np.empty((size, size)), np.empty((size, size)), np.empty(size)
    for i in range(2):
        multiply(fused.covariance, information[i], gain)
        multiply(gain, pair.independent[i], part)
        multiply(part, gain.T, spread)
        transform(gain, pair.mean[i], moved)
        for row in range(size):
            fused.mean[row] = moved[row] + (fused.mean[row] if i > 0 else 0.0)
            for k in range(size):
                before = fused.independent[row, k] if i > 0 else 0.0
                fused.independent[row, k] = before + spread[row, k]
    return True


def trace_at(is_split: bool, weight: float, pair: Estimate, fused: Estimate) -> float:
    """Fuse two estimates with a weight; return the fused trace, or infinity if they cannot be fused."""
    is_fused = mix_split(weight, pair, fused) if is_split else mix_inverse(weight, pair, fused)
    if not is_fused:
        return np.inf
    trace = 0.0
    for row in range(len(fused.mean)):
        trace += fused.covariance[row, row]
    return trace


class Stake(NamedTuple):
    """Quantities of a state (n,) that determine the weight of a sighting with Jacobian H (m, n).

    Attributes:
        states: n.
        trace: trace of the covariance P.
        spread: H P H' (m, m).
        square: H P P H' (m, m).
    """

    states: int
    trace: float
    spread: Floats
    square: Floats


def sighting_weight(by_trace: bool, stake: Stake, shared: Floats, own: Floats) -> float:
    """Find the best weight w for a sighting, which measures part of a state and uses another estimate.

    One part of the measurement's noise has an unknown correlation with the state; the other part, the
    sensor's noise, is independent. The fusion uses P / w and the noise shared / (1 - w) + own, where w
    minimizes the trace (which depends on the units of the state) or the determinant (which does not).
    The weight is above 0, because 0 would discard all components that the measurement does not observe.

    With R = shared / (1 - w) + own and S = H P H' / w + R, the fused covariance has the trace tr P / w -
    tr(S^-1 H P P H') / w^2 and a determinant proportional to |R| / (w^n |S|). Trace and log determinant
    are convex in w.

    Args:
        by_trace: whether to minimize the trace instead of the determinant.
        stake: projections of the state's covariance onto the measurement.
        shared, own: the correlated and the independent part of the noise, (m, m).

    Returns:
        The weight; NaN if a covariance is singular.
    """
    noise, total, precision = np.empty_like(own), np.empty_like(own), np.empty_like(own)
    section = np.empty(7)
    value, weight = np.inf, 0.5
    for step in range(SIGHTING_STEPS):
        weight = golden(step, SIGHTING_STEPS, value, section)
        blend(1.0 / (1.0 - weight), shared, 1.0, own, noise)
        blend(1.0 / weight, stake.spread, 1.0, noise, total)
        if not inverted(total, precision):
            return np.nan
        if by_trace:
            value = stake.trace / weight
            for row in range(len(own)):
                for column in range(len(own)):
                    value -= precision[row, column] * stake.square[row, column] / weight**2
        else:
            value = np.log(determinant(noise) / determinant(total)) - stake.states * np.log(weight)
    return weight if np.isfinite(value) else np.nan


def fuse_in_turn(is_split: bool, count: int, parts: Estimate, into: Fused, tolerance: float) -> float:
    """Fuse one estimate after another, each with the weight that minimizes the trace."""
    (mean, covariance, weights), steps = into, steps_for(tolerance)
    size = len(mean)
    pair = Estimate(np.empty((2, size)), np.empty((2, size, size)), np.empty((2, size, size)))
    fused = Estimate(mean, covariance, np.empty((size, size)))
    weights[0] = 1.0
    put(one_of(parts, 0), fused)
    for i in range(1, count):
        put(fused, one_of(pair, 0))
        put(one_of(parts, i), one_of(pair, 1))
        section = np.empty(7)
        trace = np.inf
        for step in range(steps):
            weights[i] = golden(step, steps, trace, section)
            trace = trace_at(is_split, weights[i], pair, fused)
        if trace == np.inf:
            return np.inf
    return 0.0
