"""Gaussian-sum filter (`bank`), which splits a prior that is too wide in an angle.

The prior is split along the widest direction of its angles, such as an unknown heading, into adjacent
Gaussians. Each Gaussian is filtered separately; every message weights the Gaussians by its likelihood,
and the estimate is the mixture of all Gaussians. Members with negligible probability are removed, and
the remaining ones are merged when they agree, so the sum eventually costs no more than one filter.

Magill, Optimal Adaptive Estimation of Sampled Stochastic Processes, IEEE TAC 10(4), 1965.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, field_validator

from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.engine.vectors.tangent import TANGENT_WIDTHS, manifold_blocks
from fuselog.replay.inference.kalman.methods import (
    FILTERS,
    Method,
    RegressionParameters,
    UnscentedParameters,
    filter_with,
    named_filter,
    no_steps,
)
from fuselog.replay.inference.kalman.steps import (
    CoreMemory,
    Gaussian,
    InnovationRecord,
    Interval,
    Measurement,
    Samples,
    Steps,
    UpdateRun,
)
from fuselog.replay.inference.linear_algebra.gaussian import cholesky, copy_gaussian
from fuselog.replay.inference.linear_algebra.manifold import boxplus
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.modes.mixing import MixtureMemory, likeliest_of, mixing, mixture_memory
from fuselog.replay.inference.modes.mixture import MixtureFilter, Mixtures, UpdateMixture, mixture_update
from fuselog.replay.inference.run.filtering import FilterState

IMPOSSIBLE = 1e-6  # a member with less than this fraction of the highest probability is removed
ALIKE = 1e-9  # relative difference below which variances count as equal, because of rounding
AGREED = 0.1  # mean squared distance below which the members are merged


class GaussianSumParameters(UnscentedParameters, RegressionParameters):  # type: ignore[explicit-any]
    """The filter that every member uses, and the number of members.

    The standard deviation of a member is half the distance between neighbouring members, so that the sum
    of all members is smooth. A narrower prior has fewer members; a prior that is no wider than a member
    is not split. The number is odd: with an even number, every member has an exact opposite, and
    rounding would decide whether the opposite is half a turn to the left or to the right; this decision
    would change the mean.

    Attributes:
        filter: the filter of every member: ekf, iekf, ukf, lrkf, analytic or sqrt.
        members: number of members for a whole turn; odd.
    """

    filter: str = "ekf"
    members: Annotated[int, Field(ge=9, le=721)] = 45

    @field_validator("members")
    @classmethod
    def _odd(cls, members: int) -> int:
        if members % 2 == 0:
            raise ValueError(
                f"the number of members must be odd, so that no two are opposite; give {members + 1}"
            )
        return members


class GaussianSumBelief(NamedTuple):
    """Gaussians of all runs (the first axis); of each run's M rows, the remaining members are first.

    Attributes:
        mean, covariance: (runs, M, n), (runs, M, t, t).
        probability, log_probability: (runs, M).
        member: (runs, M) original index of each member.
        left: (runs,) number of remaining members.
    """

    mean: Floats
    covariance: Floats
    probability: Floats
    log_probability: Floats
    member: Integers
    left: Integers


class GaussianSumMemory(NamedTuple):
    """Working memory of one core: for the members' filter, for their mixture, and `factor` (t, t)."""

    filters: tuple[CoreMemory]
    mixture: MixtureMemory
    factor: Floats


def gaussian_sum_steps(bound_model: BoundModel, inner: Steps, members: int) -> Steps:
    """Make the steps of a Gaussian sum with at most `members` filters.

    Args:
        bound_model: the bound model, with the sensors of the log.
        inner: steps of the filter of one member.
        members: largest number of members.
    """
    t = bound_model.model.tangent
    to_common_tangent, mix = mixing(bound_model.model.kinds, inner.form)
    to_covariance = inner.form.to_covariance
    predict_member = inner.predict

    def predict(
        run: int, belief: GaussianSumBelief, interval: Interval, memory: GaussianSumMemory
    ) -> bool:
        gaussians, well = Gaussian(belief.mean[run], belief.covariance[run]), True
        for each in range(belief.left[run]):
            predicted = predict_member(each, gaussians, interval, memory.filters[0])
            well = predicted and well
        return well

    def keep_possible(run: int, belief: GaussianSumBelief) -> None:
        """Remove members of negligible probability, and move the others to the front."""
        mean, covariance = belief.mean[run], belief.covariance[run]
        probability, log_probability = belief.probability[run], belief.log_probability[run]
        count = belief.left[run]
        least = IMPOSSIBLE * probability[likeliest_of(probability[:count])]
        kept, total = 0, 0.0
        for each in range(count):
            if probability[each] >= least:
                if kept < each:
                    copy_gaussian(mean[each], covariance[each], mean[kept], covariance[kept])
                    probability[kept], log_probability[kept] = probability[each], log_probability[each]
                    belief.member[run, kept] = belief.member[run, each]
                total += probability[kept]
                kept += 1
        for each in range(kept):
            probability[each] /= total
            log_probability[each] -= np.log(total)
        belief.left[run] = kept

    def merge_agreeing(run: int, belief: GaussianSumBelief, memory: GaussianSumMemory) -> None:
        """Merge all Gaussians into one if their means differ little compared to the covariance."""
        count = belief.left[run]
        mean, covariance = belief.mean[run, :count], belief.covariance[run, :count]
        probability = belief.probability[run, :count]
        mixture, factor = memory.mixture, memory.factor
        to_common_tangent(mean, covariance, probability, mixture)
        likeliest = likeliest_of(probability)
        factor[:, :] = mixture.carried[likeliest]
        to_covariance(factor)
        if not cholesky(factor, factor, t):
            return
        apart = 0.0
        for each in range(count):
            for row in range(t):
                entry = mixture.away[each, row]
                for k in range(row):
                    entry -= factor[row, k] * mixture.shift[k]
                mixture.shift[row] = entry / factor[row, row]
                apart += probability[each] * mixture.shift[row] * mixture.shift[row]
        if apart < AGREED:
            mix(probability, mixture, mean[0], covariance[0])
            belief.member[run, 0] = belief.member[run, likeliest]
            probability[0], belief.log_probability[run, 0] = 1.0, 0.0
            belief.left[run] = 1

    def of_run(update: UpdateMixture) -> UpdateRun:
        def update_run(
            run: int,
            belief: GaussianSumBelief,
            measurement: Measurement,
            memory: GaussianSumMemory,
            record: InnovationRecord,
        ) -> int:
            count = belief.left[run]
            weights = belief.probability[run, :count], belief.log_probability[run, :count]
            gaussians = Gaussian(belief.mean[run, :count], belief.covariance[run, :count])
            outcome = update(gaussians, weights, measurement, memory, record)
            if outcome == ALL_WELL and count > 1:
                keep_possible(run, belief)
                merge_agreeing(run, belief, memory)
            return outcome

        return update_run

    def estimate(
        run: int, belief: GaussianSumBelief, mixtures: Mixtures, row: int, memory: GaussianSumMemory
    ) -> None:
        count = belief.left[run]
        probability = belief.probability[run, :count]
        mixtures.probability[row] = 0.0
        for each in range(count):
            mixtures.probability[row, belief.member[run, each]] = probability[each]
        to_common_tangent(
            belief.mean[run, :count], belief.covariance[run, :count], probability, memory.mixture
        )
        mix(probability, memory.mixture, mixtures.mean[row], mixtures.covariance[row])
        to_covariance(mixtures.covariance[row])

    def memory(sets: tuple[Samples, ...]) -> GaussianSumMemory:
        mixture = mixture_memory(bound_model, members)
        return GaussianSumMemory((inner.memory(sets),), mixture, np.empty((t, t)))

    updates = (
        of_run(mixture_update(bound_model, number, update))
        for number, update in enumerate(inner.updates)
    )
    return inner._replace(memory=memory, predict=predict, updates=tuple(updates), estimate=estimate)


def widest(kinds: Sequence[str], covariance: Floats) -> tuple[Floats, float]:
    """Find the direction (t,) in the angles along which the variance is largest, and that variance.

    If several directions have the same variance, the first angle or orientation is used, with a
    direction as close as possible to its first axis.

    Args:
        kinds: kinds of the state's components.
        covariance: (t, t), in the tangent space.
    """
    direction, variance, begin = np.zeros(len(covariance)), -1.0, 0
    for kind, _ in manifold_blocks(kinds):
        end = begin + TANGENT_WIDTHS[kind]
        if kind != "linear":
            variances, axes = np.linalg.eigh(covariance[begin:end, begin:end])
            if variances[-1] > (1.0 + ALIKE) * variance:
                direction[:], variance = 0.0, float(variances[-1])
                alike = axes[:, variances >= (1.0 - ALIKE) * variance]
                within = alike @ alike.T  # projection of every axis onto the widest directions
                axis = within[:, np.argmax(np.round(np.diagonal(within), 9))]
                direction[begin:end] = axis / np.linalg.norm(axis)
        begin = end
    return direction, variance


def split(kinds: tuple[str, ...], mean: Floats, covariance: Floats, members: int) -> tuple[Floats, ...]:
    """Split a Gaussian into a row of narrower ones along its widest angle.

    Args:
        kinds: kinds of the state's components.
        mean, covariance: (n,), (t, t).
        members: largest number of members, spread over a whole turn.

    Returns:
        The weights (members,), zero for unused members; the means (members, n); the covariance (t, t) of
        each. The covariance of the mixture is that of the given Gaussian, except for its part beyond
        half a turn.
    """
    direction, variance = widest(kinds, covariance)
    apart = 2.0 * np.pi / members
    offsets, own = (np.arange(members) - members // 2) * apart, (0.5 * apart) ** 2
    weights, means = np.zeros(members), np.tile(mean, (members, 1))
    if variance <= own:
        weights[members // 2] = 1.0
        return weights, means, covariance
    weights = np.exp(-0.5 * offsets**2 / (variance - own))
    weights[weights < IMPOSSIBLE] = 0.0
    gain, add = covariance @ direction / variance, boxplus(kinds)
    for each in np.flatnonzero(weights):
        add(means[each], offsets[each] * gain)
    return weights / weights.sum(), means, covariance - (variance - own) * np.outer(gain, gain)


class GaussianSumFilter(MixtureFilter):
    """Gaussian-sum filter; the probabilities of its members are on the topic `modes`."""

    @property
    def names(self) -> Sequence[str]:
        """Names of the members, which state their angles relative to the prior's mean."""
        count = self.parameters.members
        return [f"turned_{360.0 * (each - count // 2) / count:g}_deg" for each in range(count)]

    def start(self, static: Mapping[str, Ragged]) -> FilterState:
        """Make the initial state of every run from its prior, which is split; see `Filter.start`."""
        state, members = super().start(static), self.parameters.members
        mean, covariance = state.carried.belief
        runs = len(mean)
        belief = GaussianSumBelief(
            np.repeat(mean[:, None], members, axis=1),
            np.repeat(covariance[:, None], members, axis=1),
            np.zeros((runs, members)),
            np.zeros((runs, members)),
            np.zeros((runs, members), np.int64),
            np.ones(runs, np.int64),
        )
        for run in np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2))).tolist():
            prior = covariance[run].copy()
            self.form.to_covariance(prior)
            weights, means, narrow = split(self.bound_model.model.kinds, mean[run], prior, members)
            member = np.flatnonzero(weights)
            count = len(member)
            belief.mean[run, :count], belief.covariance[run] = means[member], self.form.start(narrow)
            belief.probability[run, :count] = weights[member]
            belief.log_probability[run, :count] = np.log(weights[member])
            belief.member[run, :count], belief.left[run] = member, count
        return state._replace(carried=state.carried._replace(belief=belief))


def _lacks(model: Model, inner: Method) -> str:
    if set(model.kinds) == {"linear"}:
        return "an angle or an orientation in its state, along which to split its prior"
    return inner.lacks(model)


@lru_cache(maxsize=64)
def _gaussian_sum(name: str, variant: str, members: int) -> Method:
    """Make the method that uses the filter of this name for up to `members` members."""
    inner = filter_with(name, variant)

    def steps(bound_model: BoundModel) -> Steps:
        return gaussian_sum_steps(bound_model, inner.steps(bound_model), members)

    lacks = partial(_lacks, inner=inner)
    return replace(GAUSSIAN_SUM, steps=steps, sampling=inner.sampling, lacks=lacks, made_for=None)


def _made_for(parameters: GaussianSumParameters) -> Method:
    name, variant = named_filter(parameters.filter, "bank", "for the members of a Gaussian sum")
    return _gaussian_sum(name, variant, parameters.members)


GAUSSIAN_SUM = Method(
    "Gaussian-sum filter, which splits a wide prior; the filter follows the name, as in bank:ekf",
    GaussianSumParameters,
    no_steps,
    lacks=partial(_lacks, inner=FILTERS["ekf"]),
    variant="filter",
    made_for=_made_for,
    filtering=GaussianSumFilter,
)
