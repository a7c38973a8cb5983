"""Filters of systems in discrete time: every measurement is one time step.

A system says how its filters predict and innovate; this runs them over a log or an ensemble. Its log has
`/prior`, and a topic of measurements whose metadata names the system and its noise.
"""

import copy
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log import Topic, make_stream, schemas
from replay.blocks import Block, Events, Ragged, of_runs
from replay.compile import compile_over_runs
from replay.components import Components
from replay.engine import Bound, Recursive
from replay.estimators.gaussian import (
    ALL_WELL,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    Floats,
    Function,
    Innovation,
    SampleMemory,
    correct,
    failures_of,
    is_finite,
    no_innovation,
)
from replay.measurements import read_vectors
from replay.priors import gaussians
from replay.sampling.samplers import Sampler
from replay.sampling.sets import Generators, SampleSets, seeded_by_data, sets_by_runs

PRIOR, TRUTH = "/prior", "/truth"


class Steps(NamedTuple):
    """A filter's steps before the Kalman update; both tell whether the covariance is positive definite.

    predict(mean, covariance, noise, step, memory) moves mean (n,) and covariance (n, n) in place.
    innovate(mean, covariance, measured, noise, innovation, step, memory) fills the innovation. One of
    them may use the step's samples.
    """

    predict: Function
    innovate: Function


class System(NamedTuple):
    """One kind of system: the measurements' topic and column, names, and its filters by kind.

    `reads` are the components of a measurement. `noise` names what the topic's metadata states and the
    filters use, `measured` and `state` the components, `sampled` the dimension that a filter samples in.
    `memory(noise, sets)` makes what the steps work in.
    """

    topic: str
    column: str
    reads: Components
    noise: tuple[str, ...]
    measured: tuple[str, ...]
    state: tuple[str, ...]
    sampled: int
    memory: Callable[[Floats, SampleSets], SampleMemory]
    steps: Mapping[str, Steps]


class Carried(NamedTuple):
    """What a filter carries from block to block; first axis = run; see `gaussian.FAILURES`."""

    mean: Floats
    covariance: Floats
    time_ns: NDArray[np.int64]
    failure: NDArray[np.int64]


class Results(NamedTuple):
    """What the kernel fills; first axis = measurement; NaN where a run failed before."""

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats


def copy_gaussian(mean: Floats, covariance: Floats, to_mean: Floats, to_covariance: Floats) -> None:
    """Copy a mean and its covariance."""
    for i in range(len(mean)):
        to_mean[i] = mean[i]
        for j in range(len(mean)):
            to_covariance[i, j] = covariance[i, j]


def stepwise(steps: Steps) -> Function:
    """The loop over the measurements of one run, specialised to a filter; changes `carried` in place."""
    predict, innovate = steps

    def step(
        row: int,
        mean: Floats,
        covariance: Floats,
        measured: Floats,
        noise: Floats,
        gate: Floats,
        results: Results,
        scratch: tuple[Innovation, SampleMemory],
    ) -> int:
        """Take one measurement in; returns what failed, ALL_WELL where nothing did."""
        innovation, memory = scratch
        if not predict(mean, covariance, noise, row, memory):
            return NOT_POSITIVE_DEFINITE
        if not innovate(mean, covariance, measured, noise, innovation, row, memory):
            return NOT_POSITIVE_DEFINITE
        difference, spread = results.innovation[row], results.innovation_covariance[row]
        copy_gaussian(innovation.difference, innovation.covariance, difference, spread)
        squared, _ = correct(mean, covariance, innovation, gate)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        if not is_finite(mean, covariance):
            return NOT_FINITE
        copy_gaussian(mean, covariance, results.mean[row], results.covariance[row])
        results.squared[row] = squared
        return ALL_WELL

    def filter_run(
        run: int,
        offsets: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        measured: Floats,
        noise: Floats,
        gate: Floats,
        carried: Carried,
        results: Results,
        scratch: tuple[Innovation, SampleMemory],
    ) -> None:
        mean, covariance = carried.mean[run], carried.covariance[run]
        for row in range(offsets[run], offsets[run + 1]):
            if carried.failure[run] != ALL_WELL:
                break
            carried.time_ns[run] = time_ns[row]
            carried.failure[run] = step(
                row, mean, covariance, measured[row], noise, gate, results, scratch
            )

    return filter_run


@lru_cache(maxsize=16)
def _compiled(steps: Steps) -> Function:
    return compile_over_runs(stepwise(steps), allocates=False)


class Filter(NamedTuple):
    """One bound filter: the system, which of its filters, and where its samples come from."""

    name: str
    system: System
    kind: str
    noise: Floats
    sampler: Sampler
    seed: int


State = tuple[Carried, Generators]


def bind_system(
    name: str,
    topics: Mapping[str, Topic],
    systems: Mapping[str, System],
    kind: str,
    sampler_at: Callable[[int], Sampler],
    seed: int = 0,
) -> list[Bound]:
    """Bind a filter to the log of one of the systems; [] where the log is of something else.

    `sampler_at` gives the samples for a dimension. Raises BadInput where there are none, or where the
    measurements' metadata does not state the noise.
    """
    for label, system in systems.items():
        topic = topics.get(system.topic)
        if topic is not None and topic.metadata.get("system") == label and PRIOR in topics:
            noise = np.array([_stated(topic, each) for each in system.noise])
            settings = Filter(name, system, kind, noise, sampler_at(system.sampled), seed)
            priors: dict[str, Components] = {PRIOR: dict.fromkeys(system.state, "linear")}
            step = partial(run, settings=settings)
            return [Recursive(name, (topic.name,), (PRIOR,), start, step, priors)]
    return []


def _stated(topic: Topic, name: str) -> float:
    try:
        return float(topic.metadata[name])
    except (KeyError, ValueError):
        raise BadInput(f"topic {topic.name} does not state {name}; record it again") from None


def start(whole: Mapping[str, Ragged]) -> State:
    """The state at every run's prior."""
    time_ns, mean, covariance = gaussians(whole[PRIOR])
    return Carried(mean, covariance, time_ns, np.full(len(mean), ALL_WELL)), (None,) * len(mean)


def run(state: State, block: Block, *, settings: Filter) -> tuple[State, list[Ragged]]:
    """Filter a block; see `replay.engine.Recursive`."""
    before, generators = state
    system, offsets = settings.system, block.events.offsets
    stream = block.streams[system.topic].stream
    measured = read_vectors(stream, system.column, system.reads)[block.events.source]
    if settings.sampler.redrawn:
        generators = seeded_by_data(generators, measured, offsets, settings.seed)
    after = copy.deepcopy(before)
    results = _blank_results(system, len(measured))
    loop = _compiled(system.steps[settings.kind])
    for runs, sets in sets_by_runs(settings.sampler, generators, offsets):
        loop(
            runs.stop - runs.start,
            offsets[runs.start : runs.stop + 1],
            block.events.time_ns,
            measured,
            settings.noise,
            np.full(len(system.measured) + 1, np.inf),
            of_runs(after, runs),
            results,
            scratch=partial(_scratch, settings, sets),
        )
    return (after, generators), _outputs(settings, block.events, results, before, after)


def _scratch(settings: Filter, sets: SampleSets) -> tuple[Innovation, SampleMemory]:
    system = settings.system
    memory = system.memory(settings.noise, sets)
    return no_innovation(len(system.state), len(system.measured)), memory


def _blank_results(system: System, count: int) -> Results:
    size, values = len(system.state), len(system.measured)
    shapes = [(size,), (size, size), (values,), (values, values), ()]
    return Results(*(np.full((count, *shape), np.nan) for shape in shapes))


def _outputs(
    settings: Filter, events: Events, results: Results, before: Carried, after: Carried
) -> list[Ragged]:
    """Estimate and innovation of every measurement, and the failures of this block."""
    system, topic = settings.system, f"/estimates/{settings.name}"
    done = np.flatnonzero(np.isfinite(results.squared))
    offsets = np.searchsorted(done, events.offsets)
    estimates = make_stream(
        f"{topic}/state",
        schemas.GAUSSIAN_ESTIMATE,
        events.time_ns[done],
        metadata={
            "components": ",".join(system.state),
            "kinds": ",".join(["linear"] * len(system.state)),
            "truth": TRUTH,
        },
        mean=results.mean[done],
        covariance=results.covariance[done].reshape(-1, len(system.state) ** 2),
    )
    innovations = make_stream(
        f"{topic}/innovation",
        schemas.INNOVATION,
        events.time_ns[done],
        metadata={
            "components": ",".join(system.measured),
            "kinds": ",".join(["linear"] * len(system.measured)),
        },
        target_id=np.zeros(len(done), np.int64),
        accepted=np.ones(len(done), np.int64),
        innovation=results.innovation[done],
        covariance=results.innovation_covariance[done].reshape(-1, len(system.measured) ** 2),
        normalised_innovation_squared=results.squared[done],
    )
    return [
        Ragged(estimates, offsets),
        Ragged(innovations, offsets),
        failures_of(topic, before.failure, after.failure, after.time_ns),
    ]
