"""Interacting multiple models: a filter for each of a model's modes, and how probable each mode is.

Over dt seconds a thing goes from mode i to mode j with probability Pi_ij, Pi = expm(rates dt). To every
later stamp the modes' Gaussians are mixed,

    c_j = sum_i mu_i Pi_ij,  mu_(i|j) = mu_i Pi_ij / c_j,

each mode predicts its own mixture, and every message makes mu_j proportional to mu_j N(v_j; 0, S_j).
Mixtures lie in the tangent space of the likeliest mode; covariances are carried there, and from there to
that of the mixture's mean, by the right Jacobian. Probabilities are kept as logarithms too: those of a
mode that fits badly lie below the smallest number.

Blom and Bar-Shalom, IEEE TAC 33(8), 1988; smoothed probabilities: Kim, Journal of Econometrics 60, 1994.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from pydantic import field_validator

from recorders.log import make_stream, schemas
from replay.engine.arrays import Floats, Function, Integers
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.streams.blocks import Ragged, join
from replay.engine.streams.results import ALL_WELL, named
from replay.inference.kalman.methods import (
    FILTERS,
    Method,
    RegressionParameters,
    UnscentedParameters,
    filter_with,
    named_filter,
    no_steps,
)
from replay.inference.kalman.steps import Gaussian, Note, Steps
from replay.inference.kalman.update import noting, slots_of
from replay.inference.linear_algebra.covariances import COVARIANCES, Form
from replay.inference.linear_algebra.gaussian import keep_measured, whiten, wrap
from replay.inference.linear_algebra.manifold import (
    differencing,
    is_flat,
    resetting,
    retraction,
    tangent_size,
)
from replay.inference.linear_algebra.tuples import filling, range_of, total
from replay.inference.model.model import Model, switching_of
from replay.inference.model.parameters import number_fields
from replay.inference.model.settings import reading_settings
from replay.inference.model.stage import Stage
from replay.inference.run.filtering import Filter, State
from replay.inference.run.recursion import Estimates, Happenings, Innovations

TINY = 1e-280  # below it a probability loses digits
LONGEST, TERMS = 0.125, 10  # of the series of expm: its argument, and so many terms are exact to 3e-18

Matrix = tuple[tuple[float, ...], ...]  # its rows


class InteractingParameters(UnscentedParameters, RegressionParameters):
    """The filter of every mode.

    With `smoothed_modes` the probabilities of the modes given all data are written too, at the end of
    the run and on a topic of their own; the state is not smoothed.
    """

    filter: str = "ekf"
    smoothed_modes: bool = False

    @field_validator("mode", mode="before")
    @classmethod
    def _no_mode(cls, mode: Any) -> None:
        if mode is not None:
            raise ValueError("imm takes all modes of a model; leave out `mode`, or use a filter of one")


# The steps


class Belief(NamedTuple):
    """What is believed of the states, first axis = run: a Gaussian for each of M modes.

    Attributes:
        mean, covariance: (runs, M, n), (runs, M, t, t).
        probability, log_probability: (runs, M), of the modes.
    """

    mean: Floats
    covariance: Floats
    probability: Floats
    log_probability: Floats


class Mixtures(NamedTuple):
    """Estimates as the filter fills them in, see `recursion.Estimates`; and the modes' probabilities."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    probability: Floats


class Memory(NamedTuple):
    """What the steps of one core work in.

    Attributes:
        filters: the memory of every mode's filter.
        rates, transition: (M (M - 1),), and Pi (M, M).
        weights: (M, M), row j those of all modes in the mixture of mode j.
        predicted: (M,), the logarithms of c.
        centre: (n,), the mean in whose tangent space mixtures are made.
        away, carried: (M, t), (M, t, t), the modes' Gaussians there.
        shift: (t,), of a mixture.
        notes: what every mode's update tells, first axis = mode.
        open_gate: (m + 1,), bounds that let everything in.
    """

    filters: tuple[Any, ...]
    rates: Floats
    transition: Floats
    weights: Floats
    predicted: Floats
    centre: Floats
    away: Floats
    carried: Floats
    shift: Floats
    notes: Note
    open_gate: Floats


def interacting_steps(stage: Stage, filters: Sequence[Steps]) -> Steps:
    """The steps of an interacting multiple model whose modes have these filters."""
    model, switching = stage.model, stage.model.switching
    assert switching is not None
    modes, n, t = len(filters), model.size, model.tangent
    slots = len(slots_of(stage.sensors))
    most = max((len(sensor.measured) for sensor in stage.sensors), default=0)
    form = filters[0].form
    gather, mix = mixing(model.kinds, form)
    change, weigh, predict_modes = changing(modes), weighing(modes), predicting(filters)
    rates_of, fill_rates = switching.rates, filling(modes * (modes - 1))
    to_covariance = form.to_covariance

    def predict(
        run: int,
        belief: Belief,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        memory: Memory,
    ) -> bool:
        mean, covariance = belief.mean[run], belief.covariance[run]
        probability, log_probability = belief.probability[run], belief.log_probability[run]
        fill_rates(memory.rates, rates_of(parameters))
        change(memory.rates, duration_s, memory.transition)
        gather(mean, covariance, probability, memory)
        weigh(probability, log_probability, memory)
        for mode in range(modes):
            mix(memory.weights[mode], memory, mean[mode], covariance[mode])
        return predict_modes(
            Gaussian(mean, covariance), control, duration_s, parameters, use, memory.filters
        )

    def estimate(run: int, belief: Belief, mixtures: Mixtures, row: int, memory: Memory) -> None:
        probability = mixtures.probability[row]
        for mode in range(modes):
            probability[mode] = belief.probability[run, mode]
        gather(belief.mean[run], belief.covariance[run], probability, memory)
        mix(probability, memory, mixtures.mean[row], mixtures.covariance[row])
        to_covariance(mixtures.covariance[row])

    def memory(sets: tuple[Any, ...]) -> Memory:
        waiting = iter(sets)
        inner = tuple(each.memory(tuple(next(waiting) for _ in each.sampled)) for each in filters)
        notes = Note(np.empty((modes, slots)), np.empty((modes, slots, slots)), np.empty((modes, 3)))
        return Memory(
            inner,
            rates=np.empty(modes * (modes - 1)),
            transition=np.empty((modes, modes)),
            weights=np.empty((modes, modes)),
            predicted=np.empty(modes),
            centre=np.empty(n),
            away=np.empty((modes, t)),
            carried=np.empty((modes, t, t)),
            shift=np.empty(t),
            notes=notes,
            open_gate=np.full(most + 1, np.inf),
        )

    def of_run(update: Function) -> Function:
        def update_run(
            run: int,
            belief: Belief,
            data: Floats,
            parameters: Any,
            gate: Floats,
            use: int,
            memory: Memory,
            note: Note,
        ) -> int:
            weights = belief.probability[run], belief.log_probability[run]
            gaussians = Gaussian(belief.mean[run], belief.covariance[run])
            return update(gaussians, weights, data, parameters, gate, use, memory, note)

        return update_run

    updates = tuple(
        of_run(weighed_update(stage, number, update)) for number, update in enumerate(filters[0].updates)
    )
    sampled = tuple(dimension for each in filters for dimension in each.sampled)
    resumes = all(each.resumes for each in filters)
    return Steps(memory, predict, updates, estimate, sampled, resumes, form)


def predicting(filters: Sequence[Steps]) -> Function:
    """`predict(belief, ...)`: every mode's prediction of its own Gaussian; whether all are well."""
    predictions = tuple(each.predict for each in filters)

    def predict(
        belief: Any, control: Floats, duration_s: float, parameters: Any, use: int, memories: Any
    ) -> bool:
        well = True
        for mode in range_of(len(predictions)):
            predict_mode, memory = predictions[mode], memories[mode]
            well = predict_mode(mode, belief, control, duration_s, parameters, use, memory) and well
        return well

    return predict


def weighed_update(stage: Stage, number: int, update_mode: Function) -> Function:
    """The update of several Gaussians by sensor `number`, and of the probabilities of their modes.

    `update(gaussians, (probability, log_probability), data, ...)`, in place; see `Steps.updates`. A
    measurement that is in the gate of one mode is let in by all: likelihoods of different measurements
    do not compare. The innovation that is told is that of the mixture, whose covariance has the spread
    of the modes' innovations; the log-likelihood is log sum_j mu_j N(v_j; 0, S_j).
    """
    slots, measured = list(slots_of(stage.sensors)), stage.sensors[number].measured
    places = tuple(slots.index(name) for name in measured)
    angular = tuple(kind == "angle" for kind in measured.values())
    m, tell = len(measured), noting(stage, number)

    def blend(probability: Floats, memory: Any, note: Note) -> float:
        """Note the innovation of the mixture of all modes; returns its NIS."""
        innovation, notes = memory.filters[0].innovations[number], memory.notes
        difference, covariance, _ = innovation
        for i in range(m):
            first = notes.difference[0, places[i]]
            difference[i] = first
            for mode in range(1, len(probability)):
                away = wrap(notes.difference[mode, places[i]] - first, angular[i])
                difference[i] += probability[mode] * away
        for i in range(m):
            for j in range(i + 1):
                entry, row, column = 0.0, places[i], places[j]
                for mode in range(len(probability)):
                    spread = wrap(notes.difference[mode, row] - difference[i], angular[i])
                    spread *= wrap(notes.difference[mode, column] - difference[j], angular[j])
                    entry += probability[mode] * (notes.covariance[mode, row, column] + spread)
                covariance[i, j] = covariance[j, i] = entry
        tell(innovation, note)
        return whiten(innovation, keep_measured(innovation))[0]

    def update(
        gaussians: Gaussian,
        weights: tuple[Floats, Floats],
        data: Floats,
        parameters: Any,
        gate: Floats,
        use: int,
        memory: Any,
        note: Note,
    ) -> int:
        probability, log_probability = weights
        numbers, taken = memory.notes.numbers, 0
        for mode in range(len(probability)):
            numbers[mode, 2] = 0.0
        for bounds in (gate, memory.open_gate):
            for mode in range(len(probability)):
                if numbers[mode, 2] == 0.0:
                    own = Note(
                        memory.notes.difference[mode], memory.notes.covariance[mode], numbers[mode]
                    )
                    told = update_mode(
                        mode, gaussians, data, parameters, bounds, use, memory.filters[0], own
                    )
                    if told != ALL_WELL:
                        return told
                    taken += int(numbers[mode, 2])
            if taken == 0:
                break
        note.numbers[0] = blend(probability, memory, note)
        note.numbers[1] = 0.0
        note.numbers[2] = 1.0 if taken else 0.0
        if taken:
            note.numbers[1] = weigh(probability, log_probability, numbers)
        return ALL_WELL

    def weigh(probability: Floats, log_probability: Floats, numbers: Floats) -> float:
        """Weigh the modes by their likelihoods; returns the logarithm of the whole."""
        highest, total = -np.inf, 0.0
        for mode in range(len(probability)):
            log_probability[mode] += numbers[mode, 1]
            highest = max(highest, log_probability[mode])
        for mode in range(len(probability)):
            probability[mode] = np.exp(log_probability[mode] - highest)
            total += probability[mode]
        likelihood = highest + np.log(total)
        for mode in range(len(probability)):
            log_probability[mode] -= likelihood
            probability[mode] /= total
        return likelihood

    return update


# Modes


@lru_cache(maxsize=16)
def changing(modes: int) -> Function:
    """`change(rates, duration_s, transition)`: fills Pi = expm(rates dt), by uniformisation.

    With L dt added to its diagonal, L the fastest rate at which a mode is left, the matrix has no
    negative entry, so that no digit is lost; exp(-L dt) takes it back. The duration is halved until the
    series is short, and the result squared as often; what that leaves of the rows' sums is one.
    """
    changes = [(begin, end) for begin in range(modes) for end in range(modes) if begin != end]
    rate_of = tuple(
        tuple(changes.index((begin, end)) if begin != end else -1 for end in range(modes))
        for begin in range(modes)
    )
    identity = tuple(tuple(float(i == j) for j in range(modes)) for i in range(modes))

    def change(rates: Floats, duration_s: float, transition: Floats) -> None:
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

    return change


def matrix_product(left: Matrix, right: Matrix) -> Matrix:
    """The product of two matrices."""
    return tuple(
        tuple(
            total(tuple(row[k] * right[k][j] for k in range(len(right)))) for j in range(len(right[0]))
        )
        for row in left
    )


def weighing(modes: int) -> Function:
    """`weigh(probability, log_probability, memory)`: the probabilities become c.

    Row j of the memory's weights becomes mu_(i|j). Where c_j is next to nothing, logarithms still tell
    it; a mode that none with any probability leads to keeps its own Gaussian.
    """

    def weigh_by_logarithms(end: int, log_probability: Floats, memory: Memory) -> float:
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
        return highest + np.log(total)

    def weigh(probability: Floats, log_probability: Floats, memory: Memory) -> None:
        weights, predicted = memory.weights, memory.predicted
        for end in range(modes):
            total = 0.0
            for begin in range(modes):
                weights[end, begin] = probability[begin] * memory.transition[begin, end]
                total += weights[end, begin]
            if total < TINY:
                predicted[end] = weigh_by_logarithms(end, log_probability, memory)
                continue
            predicted[end] = np.log(total)
            for begin in range(modes):
                weights[end, begin] /= total
        for mode in range(modes):
            log_probability[mode] = predicted[mode]
            probability[mode] = np.exp(predicted[mode])

    return weigh


def mixing(kinds: tuple[str, ...], form: Form = COVARIANCES) -> tuple[Function, Function]:
    """`gather(mean, covariance, probability, memory)` and `mix(weights, memory, mean, covariance)`.

    The first carries the Gaussians of all modes to the tangent space of the likeliest; the second fills
    mean and covariance of a mixture of them.
    """
    add, subtract, flat = retraction(kinds), differencing(kinds), is_flat(kinds)
    reset, reset_back = resetting(kinds), resetting(kinds, back=True)
    n, t, turn, mix_covariance = len(kinds), tangent_size(kinds), form.turn, form.mix

    def gather(mean: Floats, covariance: Floats, probability: Floats, memory: Any) -> None:
        likeliest = likeliest_of(probability)
        centre, away = memory.centre, memory.away
        for row in range(n):
            centre[row] = mean[likeliest, row]
        for mode in range(len(probability)):
            carried = memory.carried[mode]
            subtract(mean[mode], centre, away, mode)
            for row in range(t):
                for column in range(t):
                    carried[row, column] = covariance[mode, row, column]
            if not flat:
                turn(reset_back, away[mode], carried)

    def mix(weights: Floats, memory: Any, mean: Floats, covariance: Floats) -> None:
        away, carried, shift = memory.away, memory.carried, memory.shift
        for row in range(t):
            entry = 0.0
            for mode in range(len(weights)):
                entry += weights[mode] * away[mode, row]
            shift[row] = entry
        mix_covariance(weights, away, shift, carried, covariance)
        for row in range(n):
            mean[row] = memory.centre[row]
        add(mean, shift)
        if not flat:
            turn(reset, shift, covariance)

    return gather, mix


def likeliest_of(probability: Floats) -> int:
    """The first mode than which none is more probable."""
    likeliest = 0
    for mode in range(1, len(probability)):
        if probability[mode] > probability[likeliest]:
            likeliest = mode
    return likeliest


class SmoothingMemory(NamedTuple):
    """What smoothing of one core works in: Pi (M, M), and the ratios of smoothed and predicted (M,)."""

    transition: Floats
    ratio: Floats


def smoothing_memory(modes: int) -> SmoothingMemory:
    """Memory for the smoothing of so many modes' probabilities."""
    return SmoothingMemory(np.empty((modes, modes)), np.empty(modes))


@lru_cache(maxsize=16)
def _smoothing(modes: int) -> Function:
    return compile_over_runs(smoothing(modes), allocates=False, title="the smoother of modes")


def smoothing(modes: int) -> Function:
    """`smooth(run, ...)`: probabilities (n, M) given the data so far become those given all of the run.

    mu_i(k|T) = mu_i(k) sum_j Pi_ij mu_j(k+1|T) / c_j(k+1), with c = Pi' mu(k).
    """
    change = changing(modes)

    def smooth(
        run: int,
        offsets: Integers,
        time_ns: Integers,
        rates: Floats,
        probability: Floats,
        memory: SmoothingMemory,
    ) -> None:
        transition, ratio = memory
        for row in range(offsets[run + 1] - 2, offsets[run] - 1, -1):
            change(rates, (time_ns[row + 1] - time_ns[row]) * 1e-9, transition)
            for end in range(modes):
                predicted = 0.0
                for begin in range(modes):
                    predicted += probability[row, begin] * transition[begin, end]
                ratio[end] = probability[row + 1, end] / predicted if predicted > 0.0 else 0.0
            for begin in range(modes):
                factor = 0.0
                for end in range(modes):
                    factor += transition[begin, end] * ratio[end]
                probability[row, begin] *= factor

    return smooth


# As an estimator


class Mixing(Filter, ABC):
    """A filter whose belief are several Gaussians, which tells their probabilities beside the state."""

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """What the Gaussians are of."""

    def no_results(self, due: Integers, noted: Integers, slots: int) -> tuple[Any, Innovations]:
        """Estimates and innovations to be filled in."""
        (end, time_ns, mean, covariance), innovations = super().no_results(due, noted, slots)
        probability = np.empty((len(mean), len(self.names)))
        return Mixtures(end, time_ns, mean, covariance, probability), innovations

    def told(self, mixtures: Mixtures, offsets: Integers, /) -> list[Ragged]:
        """The streams of the state and of the modes' probabilities."""
        modes = self.modes("modes", mixtures.time_ns, mixtures.probability, offsets)
        return [self.states(Estimates(*mixtures[:4]), offsets), modes]

    def modes(self, name: str, time_ns: Integers, probability: Floats, offsets: Integers) -> Ragged:
        """The stream of the modes' probabilities (n, M)."""
        stream = make_stream(
            f"/estimates/{self.name}/{name}",
            schemas.MODE_PROBABILITIES,
            time_ns,
            metadata=named(dict.fromkeys(self.names, "linear")),
            probability=probability,
        )
        return Ragged(stream, offsets)


class Interacting(Mixing):
    """A filter of all modes of a model."""

    @property
    def names(self) -> Sequence[str]:
        """The modes."""
        return tuple(self.stage.model.modes or ())

    @cached_property
    def chain(self) -> tuple[Floats, Floats]:
        """The rates between the modes (M (M - 1),), and their initial probabilities (M,)."""
        model = self.stage.model
        parameters = reading_settings(number_fields(model.parameters))(self.settings, 0)
        return switching_of(f"estimator {self.name}", model, parameters)

    def start(self, whole: Mapping[str, Ragged]) -> State:
        """The state at every run's prior, the same in all modes; see `Filter.start`."""
        state, (_, initial) = super().start(whole), self.chain
        mean, covariance = (
            np.repeat(each[:, None], len(initial), axis=1) for each in state.carried.belief
        )
        probability = np.tile(initial, (len(mean), 1))
        with np.errstate(divide="ignore"):
            belief = Belief(mean, covariance, probability, np.log(probability))
        return state._replace(carried=state.carried._replace(belief=belief), kept=())

    @property
    def cannot_rewind(self) -> str:
        """See `Filter.cannot_rewind`."""
        if self.parameters.smoothed_modes:
            return "smoothed modes use what came later in any case (smoothed_modes)"
        return super().cannot_rewind

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Filter events."""
        after, made = super().follow(state, happenings)
        if self.parameters.smoothed_modes:
            after = after._replace(kept=(*state.kept, made[1]))
        return after, made

    def finish(self, state: State) -> list[Ragged]:
        """What waited for a control, and, where asked for, the modes' probabilities given all data."""
        state, made = self.ended(state)
        return [*made, self.smoothed(join(state.kept))] if state.kept else made

    def smoothed(self, modes: Ragged) -> Ragged:
        """The probabilities of all modes given all data."""
        (rates, _), count = self.chain, len(self.stage.modes)
        time_ns, probability = modes.stream.publish_time_ns, modes["probability"].copy()
        arguments = (modes.offsets, time_ns, rates, probability)
        _smoothing(count)(modes.runs, *arguments, scratch=partial(smoothing_memory, count))
        return self.modes("smoothed_modes", time_ns, probability, modes.offsets)


# As a method


def _lacks(model: Model, inner: Method) -> str:
    if len(model.modes or ()) < 2:
        return "several modes"
    if model.switching is None:
        return "the rates at which it changes between its modes"
    return inner.lacks(model)


@lru_cache(maxsize=64)
def _interacting(name: str, variant: str) -> Method:
    """The method that gives every mode this filter."""
    inner = filter_with(name, variant)

    def steps(stage: Stage) -> Steps:
        stages = (stage._replace(motion=motion, modes=()) for motion in stage.modes)
        return interacting_steps(stage, [inner.steps(each) for each in stages])

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
    filtering=Interacting,
    takes_all_modes=True,
)
