"""Mixing of the Gaussians of modes: transition matrix, mixing weights, and moments of mixtures."""

from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.kalman.steps import CoreMemory, InnovationRecord
from fuselog.replay.inference.kalman.update import innovation_components
from fuselog.replay.inference.linear_algebra.covariances import COVARIANCES, Form
from fuselog.replay.inference.linear_algebra.manifold import (
    boxminus,
    boxplus,
    by_right_jacobian,
    is_flat,
    tangent_size,
)
from fuselog.replay.inference.linear_algebra.tuples import total
from fuselog.replay.inference.model.bound_model import BoundModel

TINY = 1e-280  # smaller probabilities lose digits
LONGEST, TERMS = (
    0.125,
    10,
)  # series of expm: largest argument; terms for an error of 3e-18
Matrix = tuple[tuple[float, ...], ...]  # rows of a matrix


class MixtureMemory(NamedTuple):
    """Working memory for a mixture of M Gaussians.

    Attributes:
        centre: (n,) mean in whose tangent space mixtures are computed.
        away, carried: (M, t), (M, t, t) the Gaussians in that tangent space.
        shift: (t,) mean of a mixture in that tangent space.
        records: innovations of the updates of all Gaussians; the first axis is the mode.
        open_gate: (m + 1,) bounds that accept every measurement.
    """

    centre: Floats
    away: Floats
    carried: Floats
    shift: Floats
    records: InnovationRecord
    open_gate: Floats


def mixture_memory(bound_model: BoundModel, count: int) -> MixtureMemory:
    """Allocate memory for mixtures of `count` Gaussians."""
    n, t, m = (
        bound_model.model.size,
        bound_model.model.tangent,
        len(innovation_components(bound_model.sensors)),
    )
    most = max((len(sensor.measured) for sensor in bound_model.sensors), default=0)
    records = InnovationRecord(np.empty((count, m)), np.empty((count, m, m)), np.empty((count, 3)))
    away, carried = np.empty((count, t)), np.empty((count, t, t))
    return MixtureMemory(np.empty(n), away, carried, np.empty(t), records, np.full(most + 1, np.inf))


class InteractingMemory(NamedTuple):
    """Working memory of the steps of one core.

    Attributes:
        filters: memory of every mode's filter.
        rates, transition: (M (M - 1),), and Pi (M, M) over the duration.
        duration_s: (1,) duration for which the transition was computed; NaN before the first
            computation.
        weights: (M, M) row j has the weights with which all modes enter the mixture of mode j.
        predicted: (M,) c, the predicted probabilities, or their logarithms if they are tiny.
        mixture: memory for the modes' Gaussians.
    """

    filters: tuple[CoreMemory, ...]
    rates: Floats
    transition: Floats
    duration_s: Floats
    weights: Floats
    predicted: Floats
    mixture: MixtureMemory


class FillTransition(Protocol):
    """Function that fills Pi (M, M) for a duration from the rates between modes (M (M - 1),)."""

    def __call__(self, rates: Floats, duration_s: float, transition: Floats, /) -> None: ...


class FillWeights(Protocol):
    """Function that predicts probabilities (M,) and their logarithms, and fills the mixing weights."""

    def __call__(
        self, probability: Floats, log_probability: Floats, memory: InteractingMemory, /
    ) -> None: ...


class ToCommonTangent(Protocol):
    """Function that transforms means (M, n) and covariances (M, t, t) to one common tangent space.

    This is the tangent space of the most probable mode.
    """

    def __call__(
        self, mean: Floats, covariance: Floats, probability: Floats, memory: MixtureMemory, /
    ) -> None: ...


class MixModes(Protocol):
    """Function that fills the mean (n,) and covariance (t, t) of a mixture with these weights (M,)."""

    def __call__(
        self, weights: Floats, memory: MixtureMemory, mean: Floats, covariance: Floats, /
    ) -> None: ...


@lru_cache(maxsize=16)
def transition_matrix(modes: int) -> FillTransition:
    """Make `fill_transition(rates, duration_s, transition)`, which computes Pi = expm(rates dt).

    The method is uniformisation: with L dt added to the diagonal, where L is the fastest rate of leaving
    a mode, the matrix has no negative entries, so no digits cancel; the factor exp(-L dt) compensates
    for this. The duration is halved until the series is short, and the result is squared once per
    halving; finally, the rows are normalised to a sum of one.
    """
    changes = [(begin, end) for begin in range(modes) for end in range(modes) if begin != end]
    rate_of = tuple(
        tuple(changes.index((begin, end)) if begin != end else -1 for end in range(modes))
        for begin in range(modes)
    )
    identity = tuple(tuple(float(i == j) for j in range(modes)) for i in range(modes))

    def fill_transition(rates: Floats, duration_s: float, transition: Floats) -> None:
        leaving = tuple(total(tuple(rates[each] for each in row if each >= 0)) for row in rate_of)
        fastest = max(*leaving)
        span_s, doublings = duration_s, 0
        while fastest * span_s > LONGEST:
            span_s, doublings = 0.5 * span_s, doublings + 1
        a = tuple(
            tuple(
                span_s * (rates[rate_of[i][j]] if i != j else fastest - leaving[i]) for j in range(modes)
            )
            for i in range(modes)
        )
        p = identity
        for power in range(TERMS, 0, -1):  # I + A (I + A / 2 (I + A / 3 ...))
            scale, times = 1.0 / power, matrix_product(a, p)
            p = tuple(
                tuple(identity[i][j] + scale * times[i][j] for j in range(modes)) for i in range(modes)
            )
        factor = np.exp(-fastest * span_s)
        p = tuple(tuple(factor * each for each in row) for row in p)
        for _ in range(doublings):
            p = matrix_product(p, p)
        for i, row in enumerate(p):
            whole = total(row)
            for j, entry in enumerate(row):
                transition[i, j] = entry / whole

    return fill_transition


def matrix_product(left: Matrix, right: Matrix) -> Matrix:
    """Compute the product of two matrices."""
    return tuple(
        tuple(
            total(tuple(row[k] * right[k][j] for k in range(len(right)))) for j in range(len(right[0]))
        )
        for row in left
    )


def mixing_weights(modes: int) -> FillWeights:
    """Make `fill_weights(probability, log_probability, memory)`, which predicts probabilities.

    The probabilities are replaced by c, and row j of the weights in memory becomes mu_(i|j). If c_j is
    tiny, it is computed from logarithms; a mode that cannot be reached from any mode with positive
    probability keeps its own Gaussian.
    """

    def weigh_by_logarithms(end: int, log_probability: Floats, memory: InteractingMemory) -> float:
        weights, transition = memory.weights, memory.transition
        highest, total = -np.inf, 0.0
        for begin in range(modes):
            weights[end, begin] = 1.0 if begin == end else 0.0
            if transition[begin, end] > 0.0:
                highest = max(highest, log_probability[begin])
        if highest == -np.inf:
            return highest
        for begin in range(modes):
            weights[end, begin] = transition[begin, end]
            if transition[begin, end] > 0.0:
                weights[end, begin] *= np.exp(log_probability[begin] - highest)
            total += weights[end, begin]
        for begin in range(modes):
            weights[end, begin] /= total
        logarithm: float = highest + np.log(total)
        return logarithm

    def fill_weights(probability: Floats, log_probability: Floats, memory: InteractingMemory) -> None:
        weights, predicted = memory.weights, memory.predicted
        for end in range(modes):
            total = 0.0
            for begin in range(modes):
                weights[end, begin] = probability[begin] * memory.transition[begin, end]
                total += weights[end, begin]
            predicted[end] = total
            if total < TINY:
                predicted[end] = weigh_by_logarithms(end, log_probability, memory)
                continue
            for begin in range(modes):
                weights[end, begin] /= total
        for mode in range(modes):
            is_tiny = predicted[mode] <= 0.0
            log_probability[mode] = predicted[mode] if is_tiny else np.log(predicted[mode])
            probability[mode] = np.exp(predicted[mode]) if is_tiny else predicted[mode]

    return fill_weights


def mixing(kinds: tuple[str, ...], form: Form = COVARIANCES) -> tuple[ToCommonTangent, MixModes]:
    """Make the two functions that mix the Gaussians of all modes.

    Returns:
        `to_common_tangent(mean, covariance, probability, memory)`, which transforms the Gaussians to the
        tangent space of the most probable mode, and `mix(weights, memory, mean, covariance)`, which
        fills mean and covariance of a mixture of them.
    """
    add, subtract, flat = boxplus(kinds), boxminus(kinds), is_flat(kinds)
    reset, reset_back = by_right_jacobian(kinds), by_right_jacobian(kinds, back=True)
    t, turn, mix_covariances = tangent_size(kinds), form.turn, form.mix

    def to_common_tangent(
        mean: Floats, covariance: Floats, probability: Floats, memory: MixtureMemory
    ) -> None:
        likeliest = likeliest_of(probability)
        centre, away = memory.centre, memory.away
        centre[:] = mean[likeliest]
        for mode in range(len(probability)):
            carried = memory.carried[mode]
            subtract(mean[mode], centre, away, mode)
            carried[:, :] = covariance[mode]
            if not flat:
                turn(reset_back, away[mode], carried)

    def mix(weights: Floats, memory: MixtureMemory, mean: Floats, covariance: Floats) -> None:
        away, carried, shift = memory.away, memory.carried, memory.shift
        for row in range(t):
            entry = 0.0
            for mode in range(len(weights)):
                entry += weights[mode] * away[mode, row]
            shift[row] = entry
        mix_covariances(weights, away, shift, carried, covariance)
        mean[:] = memory.centre
        add(mean, shift)
        if not flat:
            turn(reset, shift, covariance)

    return to_common_tangent, mix


def likeliest_of(probability: Floats) -> int:
    """Return the index of the most probable mode, the first of several with the same probability."""
    likeliest = 0
    for mode in range(1, len(probability)):
        if probability[mode] > probability[likeliest]:
            likeliest = mode
    return likeliest
