"""A filter as a replay runs it: one model by one method, bound to the topics of a log."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from recorders.log import Topic, schemas
from replay.distributions import chi2
from replay.engine.arrays import Booleans, Floats, Function, Integers
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.streams.blocks import Block, Ragged, copied, of_runs, ragged_rows
from replay.engine.streams.failures import reason_stream
from replay.engine.streams.geodetic import origins_of
from replay.engine.streams.priors import gaussians
from replay.engine.streams.results import ALL_WELL, failures_of, innovation_stream, state_stream
from replay.inference.kalman.methods import Method
from replay.inference.kalman.steps import FAILURES, NOT_STARTED, Gaussian, Steps
from replay.inference.kalman.update import slots_of
from replay.inference.linear_algebra.covariances import Form
from replay.inference.model.binding import Found
from replay.inference.model.parameters import number_fields
from replay.inference.model.settings import complaint_of, reading_settings
from replay.inference.model.stage import Stage, title_of
from replay.inference.run.events import (
    World,
    as_measured,
    data_columns,
    delays_of,
    happenings_of,
    held,
    interpolated,
    joined,
    of_rows,
    points_of,
    times_alone,
    with_control,
    with_ticks,
)
from replay.inference.run.out_of_sequence import issued
from replay.inference.run.recursion import (
    Carried,
    Estimates,
    Happenings,
    Innovations,
    filled,
    no_results,
    recursion,
)
from replay.sampling.samplers import Sampler
from replay.sampling.sets import SampleSets, seeded_by_data, sets_by_runs


class State(NamedTuple):
    """What a filter carries from block to block.

    Attributes:
        carried: see `recursion.Carried`.
        world: what messages are read against.
        generators: of the randomised samples, for every sampled function and run.
        waiting: events that wait for the next message of an interpolated control.
        unsettled: events that wait for others which were measured before them and come later.
        kept: what a smoother keeps for its way back, or a filter for late messages.
        tick: (runs,) the number of the next extra estimate.
    """

    carried: Carried
    world: World
    generators: tuple[Any, ...]
    waiting: Happenings | None
    tick: Integers
    unsettled: Happenings | None = None
    kept: Any = None


@lru_cache(maxsize=64)
def _steps(stage: Stage, method: Method) -> Steps:
    """The steps that the loop over the runs is made of."""
    return method.steps(stage)


@lru_cache(maxsize=64)
def _compiled(stage: Stage, method: Method) -> tuple[Function, Steps]:
    """The loop over the runs, and its steps."""
    steps = _steps(stage, method)
    names = number_fields(stage.model.parameters)
    loop = recursion(stage, steps, reading_settings(names))
    title = title_of(stage.model, method.summary)
    return compile_over_runs(loop, allocates=False, title=title), steps


def samplers_of(stage: Stage, method: Method, parameters: Any) -> tuple[Sampler, ...]:
    """Of every sampled function; raises BadInput where the sampling is none of its dimension."""
    if method.sampling is None:
        return ()
    sampling = method.sampling(parameters)
    return tuple(sampling.at(dimension) for dimension in _steps(stage, method).sampled)


@dataclass(frozen=True)
class Filter:
    """One bound filter: `start`, `run` and `finish` of `replay.engine.replaying.estimator.Recursive`.

    Attributes:
        name: what its output topics begin with, after `/estimates/`.
        found: its topics.
        stage, method, parameters: what it is made of.
        settings: (1 + sensors, fields), see `settings_of`.
        samplers: one for each of `Steps.sampled`.
    """

    name: str
    found: Found
    stage: Stage
    method: Method
    parameters: Any
    settings: Floats
    samplers: tuple[Sampler, ...]

    def whole(self, topics: Mapping[str, Topic]) -> tuple[str, ...]:  # noqa: ARG002
        """The topics of a log that it starts from: the prior, where there is one, and the maps."""
        maps = (each.topic for sensor in self.stage.sensors for each in sensor.maps)
        prior = (self.found.prior.name,) if self.found.has_prior else ()
        return tuple(dict.fromkeys((*prior, *maps)))

    def start(self, whole: Mapping[str, Ragged]) -> State:
        """The state at every run's prior; a run whose prior cannot be used takes no part."""
        model = self.stage.model
        time_ns, mean, covariance = gaussians(whole[self.found.prior.name])
        control = np.tile(np.array(self.initial), (len(mean), 1))
        started = np.where(np.isfinite(mean.sum(axis=1)), ALL_WELL, NOT_STARTED)
        accepted_ns = np.repeat(time_ns[:, None], len(self.stage.sensors), axis=1)
        belief = Gaussian(mean, self.form.start(covariance))
        carried = Carried(belief, control, time_ns, accepted_ns, started)
        maps = {each.topic: each for sensor in self.stage.sensors for each in sensor.maps}
        points = {topic: points_of(whole[topic], asked) for topic, asked in maps.items()}
        waiting = None
        if model.control is not None and model.control.interpolated:  # what drives from there on
            runs, (width, _) = np.arange(len(mean) + 1), data_columns(self.stage)
            waiting = times_alone(runs, time_ns.copy(), width, is_due=False)
        world = World(points, self.origins(whole, len(mean)))
        return State(carried, world, (), waiting, np.zeros(len(mean), np.int64))

    def origins(self, whole: Mapping[str, Ragged], runs: int) -> Floats | None:
        """The origins of the planes (runs, 3), see `World`: as stated, else the first fixes."""
        if self.found.origin is not None:
            return np.tile(self.found.origin, (runs, 1))
        return next((origins_of(whole[topic.name]) for topic in self.found.geodetic), None)

    def run(self, state: State, block: Block) -> tuple[State, list[Ragged]]:
        """Filter a block."""
        happenings, lacking = happenings_of(self.stage, self.found, block, state.world, self.settings)
        passed_over = self.passed_over(block, lacking)
        after, made = self.through(state, happenings, is_end=False)
        return after, [*made, *passed_over]

    def through(
        self, state: State, happenings: Happenings, *, is_end: bool
    ) -> tuple[State, list[Ragged]]:
        """Filter the events that need not wait for others."""
        tick, waiting, unsettled = state.tick, None, None
        if self.delays_ns.any():
            if state.unsettled is not None:
                happenings = joined(state.unsettled, happenings)
            delays = self.delays_ns
            happenings, unsettled = as_measured(self.stage, happenings, delays, is_end=is_end)
        if self.parameters.every_s is not None:
            every_ns = round(self.parameters.every_s * 1e9)
            happenings, tick = with_ticks(happenings, state.carried.time_ns, tick, every_ns)
        if state.waiting is not None:
            happenings = joined(state.waiting, happenings)
        control = self.stage.model.control
        if control is not None and control.interpolated:
            happenings, waiting = interpolated(happenings, len(control.components), self.gap_ns)
            happenings = with_control(self.stage, happenings)
        state = state._replace(waiting=waiting, tick=tick, unsettled=unsettled)
        state, made = self.follow(state, happenings)
        return state, [*made, *self.not_driven(happenings)]

    def not_driven(self, happenings: Happenings) -> list[Ragged]:
        """What was not used since it was measured in a gap of the control, where that may have some."""
        control = self.stage.model.control
        if control is None or not control.gap or not _steps(self.stage, self.method).resumes:
            return []
        lost = (happenings.source >= 0) & np.isnan(happenings.data[:, -1])
        reasons = [
            f"topic {topic.name}: nothing is known while {control.topic} is silent for longer than "
            f"{control.gap}"
            for _, topic in self.found.sensors
        ]
        stream = reason_stream(
            f"/estimates/{self.name}/skipped",
            schemas.SKIPPED,
            happenings.time_ns[lost],
            happenings.source[lost],
            reasons,
        )
        return [Ragged(stream, ragged_rows(lost, happenings.offsets))]

    def passed_over(self, block: Block, lacking: Booleans) -> list[Ragged]:
        """What was not used since it lacks a covariance, if any topic may."""
        control = self.stage.model.control
        drops_controls = control is not None and control.interpolated
        if not drops_controls and not any(sensor.covariance for sensor in self.stage.sensors):
            return []
        sensors = {topic.name: sensor for sensor, topic in self.found.sensors}
        reasons = [
            complaint_of(self.stage.model, sensors[topic], topic)
            if topic in sensors
            else f"topic {topic}: it is not finite"
            for topic in block.streams
        ]
        events = block.events
        stream = reason_stream(
            f"/estimates/{self.name}/skipped",
            schemas.SKIPPED,
            events.time_ns[lacking],
            events.topic[lacking],
            reasons,
        )
        return [Ragged(stream, ragged_rows(lacking, events.offsets))]

    def finish(self, state: State) -> list[Ragged]:
        """What still waits for messages that do not come any more."""
        return self.ended(state)[1]

    def ended(self, state: State) -> tuple[State, list[Ragged]]:
        """The state after what waits for messages that do not come any more, and its outputs."""
        made: list[Ragged] = []
        if state.unsettled is not None:
            no_more = of_rows(state.unsettled, np.zeros(len(state.unsettled.time_ns), bool))
            state, made = self.through(state, no_more, is_end=True)
        if state.waiting is None:
            return state, made
        tail = with_control(self.stage, held(state.waiting, self.initial, self.gap_ns))
        state, last = self.follow(state, tail)
        return state, [*made, *last]

    @property
    def form(self) -> Form:
        """What stands for covariances in what it carries."""
        return _steps(self.stage, self.method).form

    @property
    def gap_ns(self) -> float:
        """How long an interpolated control may be silent."""
        control = self.stage.model.control
        if control is None or not control.gap:
            return np.inf
        names = number_fields(self.stage.model.parameters)
        return 1e9 * float(self.settings[0, names.index(control.gap)])

    @cached_property
    def delays_ns(self) -> Integers:
        """See `delays_of`."""
        return delays_of(self.stage, self.settings)

    @property
    def initial(self) -> tuple[float, ...]:
        """What drives the motion before the first message of the control."""
        control = self.stage.model.control
        return (control.initial or (0.0,) * len(control.components)) if control else ()

    @property
    def cannot_rewind(self) -> str:
        """Why it cannot go back for late messages; empty where it can."""
        control = self.stage.model.control
        if self.parameters.every_s is not None:
            return "there are no estimates between messages (every_s, --every) then"
        if control is not None and control.interpolated:
            return f"{control.topic} is interpolated, so that messages wait for the next one of it"
        if self.delays_ns.any():
            return "its messages are put where they were measured, and wait for each other"
        if any(each.redrawn for each in self.samplers):
            return "its samples are random, so that a message that is used again gets others"
        return ""

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Filter events."""
        after, estimated, made = self.filtered(state, happenings)
        states, *others = self.told(*estimated)
        return after, [issued(states, happenings, state.carried.time_ns), *others, *made]

    def filtered(
        self, state: State, happenings: Happenings
    ) -> tuple[State, tuple[Any, Integers], list[Ragged]]:
        """Filter events: the state after them, the estimates, their offsets, and the other outputs."""
        sensors = self.stage.sensors
        loop, steps = _compiled(self.stage, self.method)
        before, carried = state.carried, copied(state.carried)
        runs = len(before.time_ns)
        due = ragged_rows(happenings.is_due, happenings.offsets)
        noted = ragged_rows(happenings.source >= 0, happenings.offsets)
        slots = len(slots_of(sensors))
        estimates, innovations = self.no_results(due, noted, slots)
        if slots > min((len(sensor.measured) for sensor in sensors), default=slots):
            innovations.difference[:], innovations.covariance[:] = np.nan, np.nan
        settings = np.repeat(self.settings[None], runs, axis=0)
        generators = state.generators
        if any(each.redrawn for each in self.samplers):
            generators = _seeded(generators, happenings, len(self.samplers), self.parameters.seed)
        for part, sets in self.sets(generators, happenings):
            loop(
                part.stop - part.start,
                happenings._replace(offsets=happenings.offsets[part.start : part.stop + 1]),
                settings[part],
                self.gates,
                of_runs(carried, part),
                estimates._replace(end=estimates.end[part]),
                innovations._replace(end=innovations.end[part]),
                scratch=partial(steps.memory, sets),
            )
        made = [self.innovations(*filled(innovations, noted))] if sensors else []
        if (carried.failure != before.failure).any():
            failures = before.failure, carried.failure, carried.time_ns, FAILURES
            made.append(failures_of(f"/estimates/{self.name}", *failures))
        after = state._replace(carried=carried, generators=generators)
        return after, filled(estimates, due), made

    def sets(
        self, generators: tuple[Any, ...], happenings: Happenings
    ) -> Iterator[tuple[slice, tuple[Any, ...]]]:
        """Runs, and what the steps get for them: the samples of all functions."""
        return _sets(self.samplers, generators, happenings.offsets)

    def no_results(self, due: Integers, noted: Integers, slots: int) -> tuple[Any, Innovations]:
        """Estimates and innovations to be filled in, see `recursion.no_results`."""
        return no_results(due, noted, self.stage.model, slots)

    @cached_property
    def gates(self) -> Floats:
        """Bounds of the NIS (sensors + 1, largest measurement + 1), by the number of components.

        The last row is that of a gate that is open.
        """
        largest = max((len(sensor.measured) for sensor in self.stage.sensors), default=0)
        bounds = _nis_bounds(self.parameters.gate_probability, largest)
        gates = np.repeat(bounds[None], len(self.stage.sensors) + 1, axis=0)
        gates[-1] = np.inf
        return gates

    @property
    def truth(self) -> str:
        """The topic that the estimates are compared with."""
        return self.found.truth

    def told(self, estimates: Any, offsets: Integers, /) -> list[Ragged]:
        """The streams of what was estimated; run r owns offsets[r]:offsets[r + 1]."""
        return [self.states(estimates, offsets)]

    def states(self, estimates: Estimates, offsets: Integers) -> Ragged:
        """The stream of estimates; run r owns offsets[r]:offsets[r + 1]."""
        model = self.stage.model
        stream = state_stream(
            f"/estimates/{self.name}/{model.output}",
            estimates.time_ns,
            model.state,
            self.truth,
            estimates.mean,
            estimates.covariance,
        )
        return Ragged(stream, offsets)

    def innovations(self, innovations: Innovations, offsets: Integers) -> Ragged:
        """The stream of innovations, which needs a sensor; see `states`."""
        stream = innovation_stream(
            f"/estimates/{self.name}/innovation",
            innovations.time_ns,
            slots_of(self.stage.sensors),
            self.truth,
            target_id=innovations.target_id,
            accepted=innovations.numbers[:, 2].astype(np.uint32),
            innovation=innovations.difference,
            covariance=innovations.covariance,
            squared=innovations.numbers[:, 0],
            log_likelihood=innovations.numbers[:, 1],
        )
        return Ragged(stream, offsets)


@lru_cache(maxsize=64)
def _nis_bounds(probability: float, components: int) -> Floats:
    """The quantiles (components + 1,) of the NIS of so many components; nothing is always let in."""
    return np.append(np.inf, chi2.ppf(probability, np.arange(1, components + 1)))


def _seeded(
    generators: tuple[Any, ...], happenings: Happenings, count: int, seed: int
) -> tuple[Any, ...]:
    """Generators of every sampled function and run, from the seed and the run's first data."""
    runs = len(happenings.offsets) - 1
    before = generators or ((None,) * runs,) * count
    return tuple(
        seeded_by_data(each, happenings.data, happenings.offsets, seed, function)
        for function, each in enumerate(before)
    )


def _sets(
    samplers: Sequence[Sampler], generators: tuple[Any, ...], offsets: Integers
) -> Iterator[tuple[slice, tuple[SampleSets, ...]]]:
    """Runs, and the samples of all functions for them; the largest randomised ones say how many runs."""
    drawn = [index for index, each in enumerate(samplers) if each.redrawn]
    if not drawn:
        sets = tuple(next(sets_by_runs(each, (), offsets))[1] for each in samplers)
        yield slice(0, len(offsets) - 1), sets
        return
    largest = max(drawn, key=lambda index: samplers[index].count * (samplers[index].dimension + 1))
    for part, most in sets_by_runs(samplers[largest], generators[largest], offsets):
        span = offsets[part.start : part.stop + 1]
        others = (
            most if index == largest else next(sets_by_runs(each, generators[index][part], span))[1]
            for index, each in enumerate(samplers)
        )
        yield part, tuple(others)
