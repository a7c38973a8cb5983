"""Interacting multiple models (IMM): one filter per mode, and probabilities of the modes.

Within dt seconds, an object changes from mode i to mode j with probability Pi_ij, where Pi = expm(rates
dt). Before a prediction, the Gaussians of the modes are mixed,

    c_j = sum_i mu_i Pi_ij,  mu_(i|j) = mu_i Pi_ij / c_j,

each mode predicts its own mixture, and every message makes mu_j proportional to mu_j N(v_j; 0, S_j).
Mixtures are computed in the tangent space of the most probable mode; the right Jacobian transforms
covariances to this space, and from there to the tangent space of the mixture's mean. Probabilities are
also stored as logarithms, because the probability of a mode that fits badly can be below the smallest
floating-point number.

Blom and Bar-Shalom, IEEE TAC 33(8), 1988; smoothed probabilities: Kim, Journal of Econometrics 60, 1994.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial

import numpy as np
from pydantic import field_validator

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged, join
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
    Gaussian,
    InnovationRecord,
    Interval,
    Measurement,
    Samples,
    Steps,
    UpdateRun,
)
from fuselog.replay.inference.linear_algebra.tuples import filling, range_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.settings import reading_settings
from fuselog.replay.inference.model.validation import switching_of
from fuselog.replay.inference.modes.mixing import (
    InteractingMemory,
    mixing,
    mixing_weights,
    mixture_memory,
    transition_matrix,
)
from fuselog.replay.inference.modes.mixture import (
    MixtureFilter,
    Mixtures,
    ModeBelief,
    UpdateMixture,
    mixture_update,
    predicting,
)
from fuselog.replay.inference.modes.mode_smoothing import smoothing_memory, smoothing_over_runs
from fuselog.replay.inference.run.filtering import FilterState
from fuselog.replay.inference.run.recursion import FilterEvents


class InteractingParameters(UnscentedParameters, RegressionParameters):  # type: ignore[explicit-any]
    """Filter of every mode, and additional outputs.

    Attributes:
        filter: the filter that every mode uses: ekf, iekf, ukf, lrkf, analytic or sqrt.
        smoothed_modes: whether to also output the mode probabilities given all data, on a separate topic
            at the end of the run; the state is not smoothed.
    """

    filter: str = "ekf"
    smoothed_modes: bool = False

    @field_validator("mode", mode="before")
    @classmethod
    def _no_mode(cls, mode: object) -> None:
        if mode is not None:
            raise ValueError(
                "imm uses all modes of a model; leave out `mode`, or use a filter for one mode"
            )


# Steps


def interacting_steps(bound_model: BoundModel, filters: Sequence[Steps]) -> Steps:
    """Make the steps of an interacting multiple model filter from the steps of the modes' filters.

    Args:
        bound_model: the bound model with all its modes and the sensors of the log.
        filters: steps of every mode's filter, in the order of the modes.
    """
    model, switching = bound_model.model, bound_model.model.switching
    assert switching is not None
    modes = len(filters)
    form = filters[0].form
    to_common_tangent, mix = mixing(model.kinds, form)
    fill_transition, fill_weights, predict_modes = (
        transition_matrix(modes),
        mixing_weights(modes),
        predicting(filters),
    )
    rates_of, fill_rates = switching.rates, filling(modes * (modes - 1))
    to_covariance = form.to_covariance

    def predict(run: int, belief: ModeBelief, interval: Interval, memory: InteractingMemory) -> bool:
        mean, covariance = belief.mean[run], belief.covariance[run]
        probability, log_probability = belief.probability[run], belief.log_probability[run]
        rates = rates_of(interval.parameters)
        is_new = memory.duration_s[0] != interval.duration_s
        for each in range_of(modes * (modes - 1)):
            is_new |= memory.rates[each] != rates[each]
        if is_new:
            memory.duration_s[0] = interval.duration_s
            fill_rates(memory.rates, rates)
            fill_transition(memory.rates, interval.duration_s, memory.transition)
        to_common_tangent(mean, covariance, probability, memory.mixture)
        fill_weights(probability, log_probability, memory)
        for mode in range(modes):
            mix(memory.weights[mode], memory.mixture, mean[mode], covariance[mode])
        return predict_modes(Gaussian(mean, covariance), interval, memory.filters)

    def estimate(
        run: int, belief: ModeBelief, mixtures: Mixtures, row: int, memory: InteractingMemory
    ) -> None:
        probability = mixtures.probability[row]
        probability[:] = belief.probability[run]
        to_common_tangent(belief.mean[run], belief.covariance[run], probability, memory.mixture)
        mix(probability, memory.mixture, mixtures.mean[row], mixtures.covariance[row])
        to_covariance(mixtures.covariance[row])

    def memory(sets: tuple[Samples, ...]) -> InteractingMemory:
        waiting = iter(sets)
        inner = tuple(each.memory(tuple(next(waiting) for _ in each.sampled)) for each in filters)
        return InteractingMemory(
            inner,
            rates=np.empty(modes * (modes - 1)),
            transition=np.empty((modes, modes)),
            duration_s=np.full(1, np.nan),
            weights=np.empty((modes, modes)),
            predicted=np.empty(modes),
            mixture=mixture_memory(bound_model, modes),
        )

    def of_run(update: UpdateMixture) -> UpdateRun:
        def update_run(
            run: int,
            belief: ModeBelief,
            measurement: Measurement,
            memory: InteractingMemory,
            record: InnovationRecord,
        ) -> int:
            weights = belief.probability[run], belief.log_probability[run]
            gaussians = Gaussian(belief.mean[run], belief.covariance[run])
            return update(gaussians, weights, measurement, memory, record)

        return update_run

    updates = tuple(
        of_run(mixture_update(bound_model, number, update))
        for number, update in enumerate(filters[0].updates)
    )
    sampled = tuple(dimension for each in filters for dimension in each.sampled)
    resumes_after_gap = all(each.resumes_after_gap for each in filters)
    return Steps(memory, predict, updates, estimate, sampled, resumes_after_gap, form)


# Estimator


class InteractingFilter(MixtureFilter):
    """Filter for all modes of a model."""

    @property
    def names(self) -> Sequence[str]:
        """Names of the modes."""
        return tuple(self.bound_model.model.modes or ())

    @cached_property
    def chain(self) -> tuple[Floats, Floats]:
        """Rates between the modes (M (M - 1),), and initial probabilities of the modes (M,)."""
        model = self.bound_model.model
        parameters = reading_settings(number_fields(model.parameters))(self.settings, 0)
        return switching_of(f"estimator {self.name}", model, parameters)

    def start(self, static: Mapping[str, Ragged]) -> FilterState:
        """Make the initial state of every run: its prior, in all modes; see `Filter.start`."""
        state, (_, initial) = super().start(static), self.chain
        mean, covariance = (
            np.repeat(each[:, None], len(initial), axis=1) for each in state.carried.belief
        )
        probability = np.tile(initial, (len(mean), 1))
        with np.errstate(divide="ignore"):
            belief = ModeBelief(mean, covariance, probability, np.log(probability))
        return state._replace(carried=state.carried._replace(belief=belief), kept=())

    @property
    def why_in_sequence(self) -> str:
        """See `Filter.why_in_sequence`."""
        if self.parameters.smoothed_modes:
            return "smoothed modes use later messages anyway (smoothed_modes)"
        return super().why_in_sequence

    def follow(self, state: FilterState, events: FilterEvents) -> tuple[FilterState, list[Ragged]]:
        """Filter events."""
        after, made = super().follow(state, events)
        if self.parameters.smoothed_modes:
            after = after._replace(kept=(*state.kept, made[1]))
        return after, made

    def finish(self, state: FilterState) -> list[Ragged]:
        """Filter the events that still wait, and smooth the mode probabilities if requested."""
        state, made = self.ended(state)
        return [*made, self.smoothed(join(state.kept))] if state.kept else made

    def smoothed(self, modes: Ragged) -> Ragged:
        """Return the probabilities of all modes given all data."""
        (rates, _), count = self.chain, len(self.bound_model.modes)
        time_ns, probability = modes.stream.publish_time_ns, modes["probability"].copy()
        arguments = (modes.offsets, time_ns, rates, probability)
        smoothing_over_runs(count)(modes.runs, *arguments, scratch=partial(smoothing_memory, count))
        return self.modes("smoothed_modes", time_ns, probability, modes.offsets)


# Method


def _lacks(model: Model, inner: Method) -> str:
    if len(model.modes or ()) < 2:
        return "several modes"
    if model.switching is None:
        return "the rates at which it changes between its modes"
    return inner.lacks(model)


@lru_cache(maxsize=64)
def _interacting(name: str, variant: str) -> Method:
    """Make the method that uses this filter for every mode."""
    inner = filter_with(name, variant)

    def steps(bound_model: BoundModel) -> Steps:
        bound_models = (bound_model._replace(motion=motion, modes=()) for motion in bound_model.modes)
        return interacting_steps(bound_model, [inner.steps(each) for each in bound_models])

    lacks = partial(_lacks, inner=inner)
    return replace(INTERACTING, steps=steps, sampling=inner.sampling, lacks=lacks, made_for=None)


def _made_for(parameters: InteractingParameters) -> Method:
    return _interacting(*named_filter(parameters.filter, "imm", "for the modes of an imm"))


INTERACTING = Method(
    "interacting multiple models; the filter of every mode follows the name, as in imm:ukf",
    InteractingParameters,
    no_steps,
    lacks=partial(_lacks, inner=FILTERS["ekf"]),
    variant="filter",
    made_for=_made_for,
    filtering=InteractingFilter,
    takes_all_modes=True,
)
