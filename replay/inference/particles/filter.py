"""Particle-filter method and filter; a run's first measurement seeds its random numbers."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Self

import numpy as np
from pydantic import Field, NonNegativeInt, model_validator

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.arrays import Columns, Integers
from fuselog.replay.engine.philox import WORDS, fill_normals, run_key
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.engine.streams.results import ALL_WELL, named
from fuselog.replay.inference.kalman.methods import Method, MethodParameters, no_steps
from fuselog.replay.inference.kalman.steps import (
    Samples,
    Steps,
    workspace,
)
from fuselog.replay.inference.linear_algebra.gaussian import (
    no_innovation,
)
from fuselog.replay.inference.linear_algebra.manifold import boxplus
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model, Sensor
from fuselog.replay.inference.model.settings import trial_parameters
from fuselog.replay.inference.model.validation import trial_state
from fuselog.replay.inference.particles.particles import (
    Cloud,
    Clouds,
    ParticleMemory,
    SensorMemory,
    moving,
    resampling,
    summing_up,
)
from fuselog.replay.inference.particles.progressive import kernel_of, renewing
from fuselog.replay.inference.particles.update import weighing
from fuselog.replay.inference.run.filtering import Filter, FilterState
from fuselog.replay.inference.run.recursion import EstimateRows, FilterEvents, InnovationRows
from fuselog.replay.inference.run.timing import join_events, select_events

MOST_PARTICLES = 1_000_000


class ParticleParameters(MethodParameters):  # type: ignore[explicit-any]
    """Number and resampling of particles.

    Random numbers depend on `seed` and on the run's first measurement.

    Attributes:
        particles: number of particles.
        resample_below: fraction of effective particles, (1 / sum w^2) / particles, below which the
            particles are resampled.
        seed: seed of the random numbers.
        cloud: whether to also output all particles of every estimate.
        progressive: whether to process a measurement in several parts if it would reduce the fraction of
            effective particles below `resample_below`, and to spread resampled particles by a Gaussian
            kernel.
    """

    particles: Annotated[int, Field(ge=1, le=MOST_PARTICLES)] = 1000
    resample_below: Annotated[float, Field(ge=0, le=1)] = 0.5
    seed: NonNegativeInt = 0
    cloud: bool = False
    progressive: bool = False

    @model_validator(mode="after")
    def _parts_are_possible(self) -> Self:
        if self.progressive and self.resample_below == 1.0:
            raise ValueError("with progressive, resample_below must be less than 1; reduce it")
        return self


def particle_steps(
    bound_model: BoundModel, particles: int, resample_below: float, *, progressive: bool
) -> Steps:
    """Make the steps of a bootstrap filter.

    Args:
        bound_model: the bound model.
        particles: number of particles.
        resample_below: fraction of effective particles below which the particles are resampled.
        progressive: see `ParticleParameters`.
    """
    model, motion, sensors = bound_model.model, bound_model.motion, bound_model.sensors
    n, t = model.size, model.tangent
    by_control = model.controls if motion.control_noise else 0
    noises = by_control + (motion.noises or (t if motion.noise else 0))

    def memory(_: tuple[Samples, ...]) -> ParticleMemory:
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
            work=workspace(bound_model),
            kernel=kernel_of(particles if progressive else 0, n, t),
        )

    updates = tuple(
        weighing(bound_model, number, progressive=progressive) for number in range(len(sensors))
    )
    renew = renewing(model) if progressive else resampling
    return Steps(memory, moving(bound_model, by_control, renew), updates, summing_up(model))


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


_draw_normals = compiled(fill_normals)


class ParticleFilter(Filter):
    """Particle filter; processing of a run begins when its first measurement arrives, which seeds it."""

    def start(self, static: Mapping[str, Ragged]) -> FilterState:
        """Make the initial state of every run from its prior; see `Filter.start`."""
        state = super().start(static)
        prior, particles = state.carried.belief, self.parameters.particles
        runs, n = prior.mean.shape
        t = self.bound_model.model.tangent
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
    def why_in_sequence(self) -> str:
        """See `Filter.why_in_sequence`."""
        return "all particles would have to be stored for every message of the window"

    def follow(self, state: FilterState, events: FilterEvents) -> tuple[FilterState, list[Ragged]]:
        """Filter the events of runs that have a measurement; keep the events of other runs for later."""
        if state.kept is not None:
            events = join_events(state.kept, events)
        sensed = np.flatnonzero(events.source >= 0)
        place = np.searchsorted(sensed, events.offsets)
        is_new = (place[1:] > place[:-1]) & (state.carried.belief.counter == 0)
        first = {run: sensed[place[run]] for run in np.flatnonzero(is_new).tolist()}
        columns = events.time_ns, events.source, events.data
        after = self.begun(state, {run: [each[at] for each in columns] for run, at in first.items()})
        is_ready = np.repeat(after.carried.belief.counter > 0, np.diff(events.offsets))
        waiting = None if is_ready.all() else select_events(events, ~is_ready)
        ready = events if is_ready.all() else select_events(events, is_ready)
        after, made = super().follow(after._replace(kept=waiting), ready)
        return after, [*made, *self.cautions(events.time_ns, first, len(place) - 1)]

    def cautions(self, time_ns: Integers, first: Mapping[int, int], runs: int) -> list[Ragged]:
        """Report the constant estimated parameters of starting runs on the topic `started`."""
        options = self.parameters
        moving = {*(options.estimate_time_s or ())}
        moving |= {name for name, drift in (options.estimate_drift or {}).items() if drift}
        constant = [name for name in options.estimate or () if name not in moving]
        if not constant or not first:
            return []
        stream = reason_stream(
            f"/estimates/{self.name}/started",
            schemas.STARTED,
            time_ns[[*first.values()]],
            np.zeros(len(first), np.int64),
            [
                f"{', '.join(constant)} is constant, so particles keep the values that were drawn "
                "at the start; give estimate_drift, or use a Gaussian filter such as ekf"
            ],
        )
        return [Ragged(stream, np.searchsorted([*first], np.arange(runs + 1)))]

    def finish(self, state: FilterState) -> list[Ragged]:
        """Filter the events that still wait for a control or a measurement.

        If a run has no measurement, its prior seeds the random numbers.
        """
        state, made = self.ended(state)
        if state.kept is None:
            return made
        prior = state.carried.belief.prior
        unseeded = np.flatnonzero(state.carried.belief.counter == 0).tolist()
        after = self.begun(state, {run: [prior.mean[run], prior.covariance[run]] for run in unseeded})
        return [*made, *super().follow(after._replace(kept=None), state.kept)[1]]

    def begun(self, state: FilterState, seeds: Mapping[int, list[Columns]]) -> FilterState:
        """Draw particles from the priors of some runs, with a generator seeded by each run's data."""
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
                cloud.counter[run] = draw(self.bound_model.model, cloud, run)
        return state._replace(carried=carried._replace(belief=cloud))

    def no_results(
        self, due: Integers, recorded: Integers, innovation_size: int
    ) -> tuple[Clouds, InnovationRows]:
        """Allocate arrays for estimates, with particles if requested, and for innovations."""
        (end, times, mean, covariance), innovations = super().no_results(due, recorded, innovation_size)
        rows, particles = len(times), self.parameters.particles * self.parameters.cloud
        states = np.empty((rows, particles, self.bound_model.model.size))
        weight = np.empty((rows, particles))
        return Clouds(end, times, mean, covariance, np.empty(rows), states, weight), innovations

    def output_streams(self, clouds: Clouds, offsets: Integers, /) -> list[Ragged]:
        """Make the streams of estimates, of the effective number and, if requested, of particles."""
        model, (rows, particles) = self.bound_model.model, clouds.weight.shape
        stem = f"/estimates/{self.name}"
        effective = make_stream(
            f"{stem}/effective",
            schemas.EFFECTIVE_PARTICLES,
            clouds.time_ns,
            particles=np.full(rows, self.parameters.particles),
            effective=clouds.effective,
        )
        made = [self.states(EstimateRows(*clouds[:4]), offsets), Ragged(effective, offsets)]
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
    """Draw the particles of a run from its prior, and return the counter of its generator."""
    states, t = cloud.states[run], model.tangent
    numbers = np.empty(-(-len(states) * t // WORDS) * WORDS)
    counter = _draw_normals(numbers, np.empty(len(numbers), np.uint64), cloud.key[run], 0)
    lower = np.linalg.cholesky(cloud.prior.covariance[run])
    drawn = numbers[: len(states) * t].reshape(len(states), t)
    states[:] = cloud.prior.mean[run]
    # not a matrix product, whose rounding depends on the number of cores
    boxplus(model.kinds)(states.T, np.einsum("rk,ik->ri", lower, drawn))
    return counter


@lru_cache(maxsize=64)
def _of_so_many(particles: int, resample_below: float, progressive: bool) -> Method:
    def steps(bound_model: BoundModel) -> Steps:
        return particle_steps(bound_model, particles, resample_below, progressive=progressive)

    return Method(**{**vars(BOOTSTRAP), "steps": steps, "made_for": None})


def _made_for(parameters: ParticleParameters) -> Method:
    return _of_so_many(parameters.particles, parameters.resample_below, parameters.progressive)


def _lacks_likelihood(model: Model) -> str:
    """Return the name of a sensor with non-additive noise and no likelihood function."""
    parameters = trial_parameters(model)
    for sensor in model.sensors:
        if not sensor.noises or sensor.log_likelihood is not None:
            continue
        reference = (0.7,) * sensor.reference_size
        steps = np.linspace(0.3, 0.7, sensor.noises)
        with np.errstate(all="ignore"):
            try:
                at = [
                    np.array(
                        sensor.measure(trial_state(model.kinds), tuple(k * steps), reference, parameters)
                    )
                    for k in range(3)
                ]
            except Exception:  # reported when the model is bound, see `validation.check_sensor`
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
    is_random=True,
)
