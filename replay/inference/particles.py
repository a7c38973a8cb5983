"""The bootstrap particle filter: many states, each moved with noise of its own and then weighed.

Wherever noise enters, by addition, through the control or by the motion itself, it is drawn. What was
measured weighs the particles by its likelihood; they are resampled before a prediction where few of them
count. Mean and covariance are those of the weighted particles, in the tangent space.

Gordon, Salmond and Smith, IEE Proceedings F 140(2), 1993; systematic resampling: Kitagawa 1996.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt

from recorders.log import make_stream, schemas
from replay.engine.arrays import Floats, Function, Integers
from replay.engine.blocks import Ragged
from replay.engine.compile import compiled
from replay.engine.philox import WORDS, Words, fill_normals, philox, run_key, unit
from replay.engine.results import ALL_WELL, named
from replay.inference.binding import trial_parameters
from replay.inference.estimators import Filter, State
from replay.inference.gaussian import (
    LOG_TWO_PI,
    Innovation,
    cholesky,
    keep_measured,
    no_innovation,
    semidefinite_cholesky,
    whiten,
    widening,
    wrap,
)
from replay.inference.generate import (
    Input,
    adding_noise,
    derivative,
    differencing,
    filling,
    lower_of,
    moments_of,
    offset_of,
    retraction,
    tuple_of,
    weighted_mean_of,
)
from replay.inference.happenings import joined, of_rows
from replay.inference.methods import Method, MethodParameters, no_steps
from replay.inference.model import Model, Sensor, trial_state
from replay.inference.recursion import Estimates, Happenings, Innovations
from replay.inference.regression import settling
from replay.inference.steps import (
    NOT_EXPLAINED,
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    Gaussian,
    Note,
    Stage,
    Steps,
    Workspace,
    note_numbers,
    nothing,
    noting,
    reading,
    sensor_noise,
    workspace,
)
from replay.sampling.resampling import choose_systematically

MOST_PARTICLES = 1_000_000


class ParticleParameters(MethodParameters):
    """The number of particles, and when they are resampled.

    That is where their effective number, 1 / sum w^2, is below the share `resample_below` of all. With
    `cloud` every estimate comes with all its particles. Random numbers depend on `seed` and on the
    run's first measurement.
    """

    particles: Annotated[int, Field(ge=1, le=MOST_PARTICLES)] = 1000
    resample_below: Annotated[float, Field(ge=0, le=1)] = 0.5
    seed: NonNegativeInt = 0
    cloud: bool = False


class Cloud(NamedTuple):
    """The particles of all runs; first axis = run.

    Attributes:
        prior: what they are drawn from.
        states: (runs, N, n).
        weight: (runs, N), of sum 1.
        offsets, shift: (runs, N, t), (runs, t) to work in: the states as seen from their mean.
        key, counter: (runs, 2), (runs,) of the run's random numbers; the counter is 0 where nothing was
            drawn yet.
    """

    prior: Gaussian
    states: Floats
    weight: Floats
    offsets: Floats
    shift: Floats
    key: Words
    counter: Integers


class Clouds(NamedTuple):
    """Estimates as the recursion fills them in (`recursion.Estimates`), with all particles or none.

    `effective` (n,) is the effective number of particles.
    """

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    effective: Floats
    states: Floats
    weight: Floats


class SensorMemory(NamedTuple):
    """What the update by one sensor of m components works in.

    Attributes:
        innovation: of the cloud as a whole.
        differences: (N, m) measured less predicted.
        noise: (1 or N, m, m) its covariance, then its factor; one for each particle where it differs.
        determinant: (1 or N,) log det of the covariance.
        kept: (m,) the components that are used.
    """

    innovation: Innovation
    differences: Floats
    noise: Floats
    determinant: Floats
    kept: Integers


class ParticleMemory(NamedTuple):
    """What the steps of one core work in.

    Attributes:
        least_effective: the effective number below which particles are resampled.
        numbers, words, drawn: normals, what they are made of, and normals as (N, noises of the motion).
        control, noise: (controls,), (noises of the motion,) as drawn for one particle.
        lower: (t, t) factor of the covariance of additive noise.
        chosen, spare: (N,), (N, n) for resampling.
        likelihood: (N,) logarithms.
        sensors: one for each sensor.
        work: for derivatives by noise.
    """

    least_effective: float
    numbers: Floats
    words: Words
    drawn: Floats
    control: Floats
    noise: Floats
    lower: Floats
    chosen: Integers
    spare: Floats
    likelihood: Floats
    sensors: tuple[SensorMemory, ...]
    work: Workspace


def particle_steps(stage: Stage, particles: int, resample_below: float) -> Steps:
    """The steps of a bootstrap filter."""
    model, motion, sensors = stage.model, stage.motion, stage.sensors
    n, t = model.size, model.tangent
    by_control = model.controls if motion.control_noise else 0
    noises = by_control + (motion.noises or (t if motion.noise else 0))

    def memory(_: tuple[Any, ...]) -> ParticleMemory:
        numbers = np.empty(-(-particles * noises // WORDS) * WORDS)
        return ParticleMemory(
            least_effective=resample_below * particles,
            numbers=numbers,
            words=np.empty(len(numbers), np.uint64),
            drawn=numbers[: particles * noises].reshape(particles, noises),
            control=np.empty(model.controls),
            noise=np.empty(motion.noises),
            lower=np.empty((t, t)),
            chosen=np.empty(particles, np.int64),
            spare=np.empty((particles, n)),
            likelihood=np.empty(particles),
            sensors=tuple(_sensor_memory(each, particles) for each in sensors)
            or (_sensor_memory(None, particles),),
            work=workspace(stage),
        )

    updates = tuple(weighing(stage, number) for number in range(len(sensors)))
    return Steps(memory, moving(stage, by_control), updates, summing_up(model))


def _sensor_memory(sensor: Sensor | None, particles: int) -> SensorMemory:
    m, noises = (len(sensor.measured), sensor.noises) if sensor else (0, 0)
    count = particles if noises else 1
    return SensorMemory(
        no_innovation(0, m),
        np.empty((particles, m)),
        np.empty((count, m, m)),
        np.empty(count),
        np.empty(m, np.int64),
    )


# Motion


def moving(stage: Stage, by_control: int) -> Function:
    """The prediction: every particle moves with noise of its own, after resampling where that is due.

    The first `by_control` draws of a particle are errors of the control.
    """
    model, motion = stage.model, stage.motion
    read_state, fill, add = tuple_of(model.size), filling(model.size), retraction(model.kinds)
    drive, move = _driving(stage), _moved(stage, by_control)
    is_additive = motion.noise is not None and not motion.noises
    spread = _additive_noise(stage, by_control) if is_additive else _no_noise
    scatter = add if is_additive else nothing

    def predict(
        run: int,
        cloud: Cloud,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        memory: ParticleMemory,
    ) -> bool:
        states, offsets, key = cloud.states[run], cloud.offsets[run], cloud.key[run]
        cloud.counter[run] = resample(states, cloud.weight[run], key, cloud.counter[run], memory)
        cloud.counter[run] = fill_normals(memory.numbers, memory.words, key, cloud.counter[run])
        if not spread(states, offsets, duration_s, parameters, memory):
            return False
        for i in range(len(states)):
            drawn = memory.drawn[i]
            driven = drive(control, drawn, duration_s, parameters, memory)
            fill(states[i], move(read_state(states[i]), driven, drawn, duration_s, parameters, memory))
            scatter(states[i], offsets[i])
        return True

    return predict


def resample(states: Floats, weight: Floats, key: Words, counter: int, memory: ParticleMemory) -> int:
    """Resample where the effective number of particles is too small; returns the counter after it."""
    if not effective_number(weight) < memory.least_effective:
        return counter
    choose_systematically(weight, unit(philox(counter + 1, key)[0]), memory.chosen)
    for i in range(len(weight)):
        for k in range(states.shape[1]):
            memory.spare[i, k] = states[memory.chosen[i], k]
    for i in range(len(weight)):
        weight[i] = 1.0 / len(weight)
        for k in range(states.shape[1]):
            states[i, k] = memory.spare[i, k]
    return counter + 1


def effective_number(weight: Floats) -> float:
    """How many particles of equal weight are worth as much as these (N,): 1 / sum w^2."""
    squared = 0.0
    for i in range(len(weight)):
        squared += weight[i] * weight[i]
    return 1.0 / squared


def _driving(stage: Stage) -> Function:
    """`drive(control, drawn, duration_s, parameters, memory)`: what drives a particle, as a tuple."""
    controls, variances = stage.model.controls, stage.motion.control_noise
    read, fill = tuple_of(controls), filling(controls)
    if variances is None:

        def as_stated(
            control: Floats, drawn: Floats, duration_s: float, parameters: Any, memory: ParticleMemory
        ) -> Any:
            return read(control)

        return as_stated

    def with_error(
        control: Floats, drawn: Floats, duration_s: float, parameters: Any, memory: ParticleMemory
    ) -> Any:
        fill(memory.control, variances(duration_s, parameters))
        for k in range(controls):
            memory.control[k] = control[k] + np.sqrt(memory.control[k]) * drawn[k]
        return read(memory.control)

    return with_error


def _moved(stage: Stage, first: int) -> Function:
    """`moved(state, driven, drawn, duration_s, parameters, memory)`: a state after the motion."""
    move, variances, noises = stage.motion.move, stage.motion.noise, stage.motion.noises
    if not noises:

        def without(
            state: Any,
            driven: Any,
            drawn: Floats,
            duration_s: float,
            parameters: Any,
            memory: ParticleMemory,
        ) -> Any:
            return move(state, driven, duration_s, parameters)

        return without
    assert variances is not None
    read, fill = tuple_of(noises), filling(noises)

    def with_noise(
        state: Any,
        driven: Any,
        drawn: Floats,
        duration_s: float,
        parameters: Any,
        memory: ParticleMemory,
    ) -> Any:
        fill(memory.noise, variances(state, duration_s, parameters))
        for k in range(noises):
            memory.noise[k] = np.sqrt(memory.noise[k]) * drawn[first + k]
        return move(state, driven, read(memory.noise), duration_s, parameters)

    return with_noise


def _no_noise(
    states: Floats, offsets: Floats, duration_s: float, parameters: Any, memory: ParticleMemory
) -> bool:
    return True


def _additive_noise(stage: Stage, first: int) -> Function:
    """`spread(states, offsets, duration_s, parameters, memory)`: draws of the additive noise.

    They are tangent vectors, at the states before they move. Noise is factored anew only where it is
    not that of the particle before. False where a covariance is not positive semidefinite.
    """
    t, noise = stage.model.tangent, stage.motion.noise
    assert noise is not None
    read_state = tuple_of(stage.model.size)
    add_noise = adding_noise(t, stage.motion.noise_block)
    read_lower, offset, fill = lower_of(t), offset_of(t), filling(t)

    def factored(lower: Floats, variances: Any) -> bool:
        for row in range(t):
            for column in range(t):
                lower[row, column] = 0.0
        add_noise(lower, variances)
        return semidefinite_cholesky(lower, lower, t)

    def spread(
        states: Floats, offsets: Floats, duration_s: float, parameters: Any, memory: ParticleMemory
    ) -> bool:
        before, drawn = noise(read_state(states[0]), duration_s, parameters), memory.drawn[:, first:]
        if not factored(memory.lower, before):
            return False
        lower = read_lower(memory.lower)
        for i in range(len(states)):
            found = noise(read_state(states[i]), duration_s, parameters)
            if found != before:
                before = found
                if not factored(memory.lower, found):
                    return False
                lower = read_lower(memory.lower)
            fill(offsets[i], offset(lower, drawn, i))
        return True

    return spread


# Sensors


def weighing(stage: Stage, number: int) -> Function:
    """The update by sensor `number`: every particle is weighed by the likelihood of what was measured.

    What is told of the innovation, its NIS and the gate are of the cloud's first two moments; the
    log-likelihood is that of the weighted particles. A component that no particle predicts is left out,
    and a particle that lacks another one keeps its share of the weight: nothing is said of it.
    """
    sensor = stage.sensors[number]
    m, tell = len(sensor.measured), noting(stage, number)
    compare, likelihood = _comparing(stage, number), _likelihood(stage, number)
    angular = tuple(kind == "angle" for kind in sensor.measured.values())

    def update(
        run: int,
        cloud: Cloud,
        data: Floats,
        parameters: Any,
        gate: Floats,
        use: int,
        memory: ParticleMemory,
        note: Note,
    ) -> int:
        present = 0
        for j in range(m):
            present += not np.isnan(data[j])
        if present == 0:
            return NOTHING_MEASURED
        weight, own = cloud.weight[run], memory.sensors[number]
        compare(cloud.states[run], data, parameters, memory)
        kept = keep_predicted(own)
        innovate(weight, own, kept, angular)
        tell(own.innovation, note)
        size = keep_measured(own.innovation)
        squared, determinant = whiten(own.innovation, size)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        accepted = size > 0 and squared <= gate[size]
        note_numbers(note, squared, determinant, size, accepted, 1.0)
        if not accepted:
            return ALL_WELL
        factor_kept(own, kept)
        for i in range(len(weight)):
            memory.likelihood[i] = likelihood(cloud.states[run], i, data, parameters, own, kept)
        note.numbers[1] = reweigh(weight, memory.likelihood)
        return NOT_EXPLAINED if np.isnan(note.numbers[1]) else ALL_WELL

    return update


def _comparing(stage: Stage, number: int) -> Function:
    """`compare(states, data, parameters, memory)`: fills a sensor's differences and its noise."""
    model, sensor = stage.model, stage.sensors[number]
    m, measure = len(sensor.measured), sensor.measure
    angular = tuple(kind == "angle" for kind in sensor.measured.values())
    read_state, read_about, fill = tuple_of(model.size), reading(sensor).about, filling(m)
    add_noise = sensor_noise(sensor)

    def predict_alike(
        states: Floats, i: int, data: Floats, parameters: Any, memory: ParticleMemory
    ) -> None:
        fill(memory.work.predicted, measure(read_state(states[i]), read_about(data), parameters))

    predict = predict_alike
    if sensor.noises:
        entering = Input("noise", ("linear",) * sensor.noises, "noise_gain", zero=True)
        kinds = tuple(sensor.measured.values())
        inputs, rest = [Input("state", model.kinds), entering], ("about", "parameters")
        linearise = derivative(measure, inputs, kinds, rest, "predicted")

        def predict_with_noise(
            states: Floats, i: int, data: Floats, parameters: Any, memory: ParticleMemory
        ) -> None:
            linearise(read_state(states[i]), read_about(data), parameters, memory.work)
            no_covariance(memory.sensors[number].noise[i])
            add_noise(memory.sensors[number].noise[i], data, parameters, memory.work)

        predict = predict_with_noise

    def compare(states: Floats, data: Floats, parameters: Any, memory: ParticleMemory) -> None:
        own = memory.sensors[number]
        if len(own.noise) == 1:
            no_covariance(own.noise[0])
            add_noise(own.noise[0], data, parameters, memory.work)
        for i in range(len(states)):
            predict(states, i, data, parameters, memory)
            for j in range(m):
                own.differences[i, j] = wrap(data[j] - memory.work.predicted[j], angular[j])

    return compare


def no_covariance(matrix: Floats) -> None:
    """Fill a matrix with zeros."""
    for row in range(len(matrix)):
        for column in range(len(matrix)):
            matrix[row, column] = 0.0


def keep_predicted(own: SensorMemory) -> int:
    """Note the components that are measured and that some particle predicts; returns how many."""
    size = 0
    for j in range(len(own.kept)):
        for i in range(len(own.differences)):
            if not np.isnan(own.differences[i, j]):
                own.kept[size] = j
                size += 1
                break
    return size


def is_told(own: SensorMemory, i: int, size: int) -> bool:
    """Whether a particle predicts all components that are used."""
    for a in range(size):
        if np.isnan(own.differences[i, own.kept[a]]):
            return False
    return size > 0


def innovate(weight: Floats, own: SensorMemory, size: int, angular: tuple[bool, ...]) -> None:
    """Fill the innovation of the cloud: mean and covariance of the differences, and the noise.

    The differences are taken from that of the first particle which has one, where no angle is cut.
    """
    mean, spread, _ = own.innovation
    for j in range(len(mean)):
        mean[j] = np.nan
        for k in range(len(mean)):
            spread[j, k] = 0.0
    for a in range(size):
        mean[own.kept[a]] = 0.0
    first, total = -1, 0.0
    for i in range(len(weight)):
        if not is_told(own, i, size):
            continue
        first = i if first < 0 else first
        total += weight[i]
        noise = own.noise[i if len(own.noise) > 1 else 0]
        for a in range(size):
            j = own.kept[a]
            away = wrap(own.differences[i, j] - own.differences[first, j], angular[j])
            mean[j] += weight[i] * away
            for b in range(a + 1):
                k = own.kept[b]
                other = wrap(own.differences[i, k] - own.differences[first, k], angular[k])
                spread[j, k] += weight[i] * (away * other + noise[j, k])
    for a in range(size):
        j = own.kept[a]
        mean[j] = mean[j] / total
        for b in range(a + 1):
            k = own.kept[b]
            spread[j, k] = spread[k, j] = spread[j, k] / total - mean[j] * mean[k]
    for a in range(size):
        j = own.kept[a]
        mean[j] = wrap(own.differences[first, j] + mean[j], angular[j])


def factor_kept(own: SensorMemory, size: int) -> None:
    """Make of the noise of the components that are used its factor, at the front, and log det.

    That is NaN where the covariance is not positive definite.
    """
    for number in range(len(own.noise)):
        noise, determinant = own.noise[number], 1.0
        for a in range(size):
            for b in range(a + 1):
                noise[a, b] = noise[own.kept[a], own.kept[b]]
        if not cholesky(noise, noise, size):
            own.determinant[number] = np.nan
            continue
        for a in range(size):
            determinant *= noise[a, a]
        own.determinant[number] = 2.0 * np.log(determinant)


def _likelihood(stage: Stage, number: int) -> Function:
    """`likelihood(states, i, data, parameters, own, size)`: log p of what was measured, at particle i.

    The model's own, or that of Gaussian noise; NaN where the particle says nothing of it.
    """
    sensor = stage.sensors[number]
    if sensor.log_likelihood is None:
        return gaussian_likelihood
    stated, read_state, read = sensor.log_likelihood, tuple_of(stage.model.size), reading(sensor)
    read_measured, read_about = read.measured, read.about

    def likelihood(
        states: Floats, i: int, data: Floats, parameters: Any, own: SensorMemory, size: int
    ) -> float:
        return stated(read_state(states[i]), read_measured(data), read_about(data), parameters)

    return likelihood


def gaussian_likelihood(
    states: Floats, i: int, data: Floats, parameters: Any, own: SensorMemory, size: int
) -> float:
    """See `_likelihood`; the difference becomes L^-1 v. The noise itself widens, see `widening`."""
    number = i if len(own.noise) > 1 else 0
    difference, factor, squared = own.differences[i], own.noise[number], 0.0
    for a in range(size):
        entry = difference[own.kept[a]]
        for b in range(a):
            entry -= factor[a, b] * difference[b]
        difference[a] = entry / factor[a, a]
        squared += difference[a] * difference[a]
    factor = widening(squared, size, parameters)
    known = own.determinant[number] + size * LOG_TWO_PI
    return -0.5 * (squared / factor + known + size * np.log(factor))


def reweigh(weight: Floats, likelihood: Floats) -> float:
    """Multiply weights (N,) of sum 1 by likelihoods, whose logarithms are given, and norm them.

    Returns log sum w p. Where a likelihood is NaN, the particle gets the mean of the others. NaN, and
    weights of no use, where none is above zero.
    """
    best = -np.inf
    for i in range(len(weight)):
        if weight[i] > 0.0 and likelihood[i] > best:
            best = likelihood[i]
    share, total = 0.0, 0.0
    for i in range(len(weight)):
        if not np.isnan(likelihood[i]):
            share += weight[i]
            weight[i] *= np.exp(likelihood[i] - best)
            total += weight[i]
    mean = total / share
    for i in range(len(weight)):
        weight[i] *= 1.0 / mean if not np.isnan(likelihood[i]) else 1.0
    return best + np.log(mean) if best > -np.inf else np.nan


# Estimates


def summing_up(model: Model) -> Function:
    """The estimate: intrinsic mean and covariance of the weighted particles, and these where wanted."""
    n, t = model.size, model.tangent
    subtract, settle, moments = differencing(model.kinds), settling(model.kinds), moments_of(0, t)
    weighted_mean, straight = weighted_mean_of(n), set(model.kinds) <= {"linear"}

    def estimate(run: int, cloud: Cloud, clouds: Clouds, row: int, _: ParticleMemory) -> None:
        states, weight, offsets = cloud.states[run], cloud.weight[run], cloud.offsets[run]
        mean, covariance, shift = clouds.mean[row], clouds.covariance[row], cloud.shift[run]
        if straight:
            weighted_mean(weight, states, mean)
            moments(weight, states, states, mean, covariance, covariance)
        else:
            for k in range(n):
                mean[k] = states[0, k]
            for i in range(len(states)):
                subtract(states[i], mean, offsets, i)
            settle(weight, offsets, mean, shift)
            moments(weight, offsets, offsets, shift, covariance, covariance)
        clouds.effective[row] = effective_number(weight)
        for i in range(clouds.states.shape[1]):
            clouds.weight[row, i] = weight[i]
            for k in range(n):
                clouds.states[row, i, k] = states[i, k]

    return estimate


# As an estimator

_draw_normals = compiled(fill_normals)


class ParticleFilter(Filter):
    """A filter whose runs begin when their first measurement, which seeds them, is there."""

    def start(self, whole: Mapping[str, Ragged]) -> State:
        """The state at every run's prior, see `Filter.start`."""
        state = super().start(whole)
        prior, particles = state.carried.belief, self.parameters.particles
        runs, n = prior.mean.shape
        t = self.stage.model.tangent
        cloud = Cloud(
            prior,
            np.zeros((runs, particles, n)),
            np.full((runs, particles), 1.0 / particles),
            np.zeros((runs, particles, t)),
            np.zeros((runs, t)),
            np.zeros((runs, 2), np.uint64),
            np.zeros(runs, np.int64),
        )
        return state._replace(carried=state.carried._replace(belief=cloud))

    @property
    def cannot_rewind(self) -> str:
        """See `Filter.cannot_rewind`."""
        return "all particles would have to be kept for every message of the window"

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Filter events of the runs in which something was measured; those of the others wait."""
        if state.kept is not None:
            happenings = joined(state.kept, happenings)
        sensed = np.flatnonzero(happenings.source >= 0)
        place = np.searchsorted(sensed, happenings.offsets)
        is_new = (place[1:] > place[:-1]) & (state.carried.belief.counter == 0)
        first = {run: sensed[place[run]] for run in np.flatnonzero(is_new).tolist()}
        columns = happenings.time_ns, happenings.source, happenings.data
        after = self.begun(state, {run: [each[at] for each in columns] for run, at in first.items()})
        is_ready = np.repeat(after.carried.belief.counter > 0, np.diff(happenings.offsets))
        waiting = None if is_ready.all() else of_rows(happenings, ~is_ready)
        ready = happenings if is_ready.all() else of_rows(happenings, is_ready)
        return super().follow(after._replace(kept=waiting), ready)

    def finish(self, state: State) -> list[Ragged]:
        """What waited for a control or a measurement that did not come; then the prior seeds the run."""
        state, made = self.ended(state)
        if state.kept is None:
            return made
        prior = state.carried.belief.prior
        unseeded = np.flatnonzero(state.carried.belief.counter == 0).tolist()
        after = self.begun(state, {run: [prior.mean[run], prior.covariance[run]] for run in unseeded})
        return [*made, *super().follow(after._replace(kept=None), state.kept)[1]]

    def begun(self, state: State, seeds: Mapping[int, list[Any]]) -> State:
        """The state with particles drawn from the priors of some runs, each seeded by its data."""
        if not seeds:
            return state
        carried = state.carried
        cloud = carried.belief._replace(
            states=carried.belief.states.copy(),
            key=carried.belief.key.copy(),
            counter=carried.belief.counter.copy(),
        )
        for run, first in seeds.items():
            cloud.key[run] = run_key(self.parameters.seed, map(np.asarray, first))
            cloud.counter[run] = 1
            if carried.failure[run] == ALL_WELL:
                cloud.counter[run] = draw(self.stage.model, cloud, run)
        return state._replace(carried=carried._replace(belief=cloud))

    def no_results(self, due: Integers, noted: Integers, slots: int) -> tuple[Any, Innovations]:
        """Estimates, with particles where they are wanted, and innovations to be filled in."""
        (end, times, mean, covariance), innovations = super().no_results(due, noted, slots)
        rows, particles = len(times), self.parameters.particles * self.parameters.cloud
        states = np.empty((rows, particles, self.stage.model.size))
        weight = np.empty((rows, particles))
        return Clouds(end, times, mean, covariance, np.empty(rows), states, weight), innovations

    def told(self, clouds: Clouds, offsets: Integers, /) -> list[Ragged]:
        """The streams of estimates and of the effective number, and where they are wanted particles."""
        model, (rows, particles) = self.stage.model, clouds.weight.shape
        stem = f"/estimates/{self.name}"
        effective = make_stream(
            f"{stem}/effective",
            schemas.EFFECTIVE_PARTICLES,
            clouds.time_ns,
            particles=np.full(rows, self.parameters.particles),
            effective=clouds.effective,
        )
        made = [self.states(Estimates(*clouds[:4]), offsets), Ragged(effective, offsets)]
        if self.parameters.cloud:
            metadata = {**named(model.state), "truth": self.truth}
            size = make_stream(
                f"{stem}/particles",
                schemas.ESTIMATE_SIZE,
                clouds.time_ns,
                metadata=metadata,
                elements=np.full(rows, particles),
            )
            cloud = make_stream(
                f"{stem}/particle",
                schemas.DENSITY_ESTIMATE,
                np.repeat(clouds.time_ns, particles),
                metadata=metadata,
                weight=clouds.weight.ravel(),
                mean=clouds.states.reshape(-1, model.size),
                covariance=np.zeros((rows * particles, model.tangent**2)),
            )
            made += [Ragged(size, offsets), Ragged(cloud, offsets * particles)]
        return made


def draw(model: Model, cloud: Cloud, run: int) -> int:
    """Draw the particles of a run from its prior; returns its counter after that."""
    states, t = cloud.states[run], model.tangent
    numbers = np.empty(-(-len(states) * t // WORDS) * WORDS)
    counter = _draw_normals(numbers, np.empty(len(numbers), np.uint64), cloud.key[run], 0)
    lower = np.linalg.cholesky(cloud.prior.covariance[run])
    drawn = numbers[: len(states) * t].reshape(len(states), t)
    states[:] = cloud.prior.mean[run]
    # not by the matrix product, whose round-off depends on the number of cores
    retraction(model.kinds)(states.T, np.einsum("rk,ik->ri", lower, drawn))
    return counter


# As a method


@lru_cache(maxsize=64)
def _of_so_many(particles: int, resample_below: float) -> Method:
    def steps(stage: Stage) -> Steps:
        return particle_steps(stage, particles, resample_below)

    return Method(**{**vars(BOOTSTRAP), "steps": steps, "made_for": None})


def _made_for(parameters: ParticleParameters) -> Method:
    return _of_so_many(parameters.particles, parameters.resample_below)


def _lacks_likelihood(model: Model) -> str:
    """A sensor whose noise enters other than linearly, and which states no likelihood."""
    parameters = trial_parameters(model)
    for sensor in model.sensors:
        if not sensor.noises or sensor.log_likelihood is not None:
            continue
        about = (0.7,) * sensor.about_size
        steps = np.linspace(0.3, 0.7, sensor.noises)
        with np.errstate(all="ignore"):
            try:
                at = [
                    np.array(
                        sensor.measure(trial_state(model.kinds), tuple(k * steps), about, parameters)
                    )
                    for k in range(3)
                ]
            except Exception:  # is said when the model is bound, see `model.check_sensor`
                continue
        if not np.allclose(at[2] - at[1], at[1] - at[0], rtol=1e-9, atol=1e-9, equal_nan=True):
            return f"a likelihood of its sensor {sensor.topic}"
    return ""


BOOTSTRAP = Method(
    "bootstrap particle filter; the number of particles follows the name, as in particles:2000",
    ParticleParameters,
    no_steps,
    lacks=_lacks_likelihood,
    variant="particles",
    made_for=_made_for,
    filtering=ParticleFilter,
)
