"""Filter in a replay: one model and one method, bound to the topics of a log."""

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.compiling.notices import done_once
from fuselog.recorders.compiling.scratch import Scratch
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.log.planes import in_frame
from fuselog.recorders.log.streams import computed_stream
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Floats, Integers, RowSlice
from fuselog.replay.engine.streams.blocks import Block, Findings, Ragged, copied, of_runs, ragged_rows
from fuselog.replay.engine.streams.ensembles import FEW_MESSAGES
from fuselog.replay.engine.streams.geodetic import origins_of
from fuselog.replay.engine.streams.priors import gaussians
from fuselog.replay.engine.streams.results import ALL_WELL, failures_of, named, rows_of, wrapped
from fuselog.replay.inference.kalman.methods import Method
from fuselog.replay.inference.kalman.steps import (
    FAILURES,
    NOT_STARTED,
    CoreMemory,
    EstimatesToFill,
    Gaussian,
    Samples,
    Steps,
)
from fuselog.replay.inference.kalman.update import innovation_components
from fuselog.replay.inference.linear_algebra.covariances import Form
from fuselog.replay.inference.model.binding import Found
from fuselog.replay.inference.model.bound_model import BoundModel, title_of
from fuselog.replay.inference.model.parameters import CombinedParameters, number_fields
from fuselog.replay.inference.model.settings import (
    origin_parameters,
    placed_settings,
    reading_settings,
)
from fuselog.replay.inference.run.events import (
    Context,
    data_columns,
    events_of,
    not_driven,
    own_variances,
    passed_over,
    points_of,
)
from fuselog.replay.inference.run.out_of_sequence import issued
from fuselog.replay.inference.run.recursion import (
    EstimateRows,
    FilterEvents,
    InnovationRows,
    RecursionState,
    RunInputs,
    RunResults,
    filled,
    no_results,
    recorded_innovations,
    recursion,
)
from fuselog.replay.inference.run.samples import sample_sets, seeded_generators
from fuselog.replay.inference.run.timing import (
    add_output_times,
    compensate_delays,
    delays_of,
    fill_control,
    hold_control,
    interpolate_control,
    join_events,
    output_times,
    select_events,
)
from fuselog.replay.inference.sampling.samplers import Sampler

# History of a smoother for its backward pass, or of a filter for reprocessing, each of its own type.
Kept = Any  # type: ignore[explicit-any]


class FilterState(NamedTuple):
    """State of a filter between blocks.

    Attributes:
        carried: see `recursion.RecursionState`.
        context: maps and origins to which messages refer.
        generators: random generators of samples, for every sampled function and run.
        waiting: events that wait for the next message of an interpolated control.
        unsettled: events that wait because messages with earlier measurement times may still arrive.
        kept: history of a smoother for its backward pass, or of a filter for reprocessing.
        next_output: (runs,) number of the next output time.
    """

    carried: RecursionState
    context: Context
    generators: tuple[Samples, ...]
    waiting: FilterEvents | None
    next_output: Integers
    unsettled: FilterEvents | None = None
    kept: Kept = None


@lru_cache(maxsize=64)
def _steps(bound_model: BoundModel, method: Method) -> Steps:
    return method.steps(bound_model)


@lru_cache(maxsize=64)
def _compiled(bound_model: BoundModel, method: Method) -> tuple[OverRuns, Steps]:
    """Make the loop over the runs, which is compiled at its first call, and the steps that it calls."""
    with done_once():
        steps = _steps(bound_model, method)
        names = number_fields(bound_model.model.parameters)
        loop = recursion(bound_model, steps, reading_settings(names))
        title = title_of(bound_model.model, method.summary)
        return compile_over_runs(loop, title=title), steps


def samplers_of(
    bound_model: BoundModel, method: Method, parameters: CombinedParameters
) -> tuple[Sampler, ...]:
    """Make a sampler for each sampled function.

    Args:
        bound_model: the bound model.
        method: method whose `sampling` makes the samples.
        parameters: parameters of the method.

    Raises BadInput if the sampling does not exist in the required dimension.
    """
    if method.sampling is None:
        return ()
    sampling = method.sampling(parameters)
    return tuple(sampling.at(dimension) for dimension in _steps(bound_model, method).sampled)


@dataclass(frozen=True)
class Filter:
    """Bound filter, with the functions `start`, `run` and `finish` of an `estimator.Recursive`.

    Attributes:
        name: the part after `/estimates/` in the names of its output topics.
        found: its topics.
        bound_model, method, parameters: the bound model, the method and its parameters.
        settings: (1 + sensors, fields); see `settings_of`.
        samplers: one sampler for each of `Steps.sampled`.
        each_run: (runs, 1 + sensors, fields), the settings if each run has its own.
    """

    name: str
    found: Found
    bound_model: BoundModel
    method: Method
    parameters: CombinedParameters
    settings: Floats
    samplers: tuple[Sampler, ...]
    each_run: Floats | None = None
    is_bound: ClassVar[bool] = False

    def static(self, topics: Mapping[str, Topic]) -> tuple[str, ...]:  # noqa: ARG002
        """List the topics needed before the start: the prior, if the log has one, and the maps."""
        maps = (each.topic for sensor in self.bound_model.sensors for each in sensor.maps)
        prior = (self.found.prior.name,) if self.found.has_prior else ()
        return tuple(dict.fromkeys((*prior, *maps)))

    def start(self, static: Mapping[str, Ragged]) -> FilterState:
        """Make the initial state of every run from its prior; runs that lack a valid prior fail."""
        model = self.bound_model.model
        time_ns, mean, covariance = gaussians(static[self.found.prior.name])
        control = np.tile(np.array(self.initial), (len(mean), 1))
        started = np.where(np.isfinite(mean.sum(axis=1)), ALL_WELL, NOT_STARTED)
        accepted_ns = np.repeat(time_ns[:, None], len(self.bound_model.sensors), axis=1)
        belief = Gaussian(mean, self.form.start(covariance))
        carried = RecursionState(belief, control, time_ns, accepted_ns, started)
        maps = {each.topic: each for sensor in self.bound_model.sensors for each in sensor.maps}
        points = {
            topic: static[topic].findings.once(asked, partial(points_of, static[topic], asked))
            for topic, asked in maps.items()
        }
        waiting = None
        if model.control is not None and model.control.interpolated:  # the control at the start
            runs, (width, _) = np.arange(len(mean) + 1), data_columns(self.bound_model)
            waiting = output_times(runs, time_ns.copy(), width, wants_estimate=False)
        context = Context(points, self.origins(static, len(mean)))
        return FilterState(carried, context, (), waiting, np.zeros(len(mean), np.int64))

    @cached_property
    def steps(self) -> Steps:
        """Steps that the loop over the runs calls."""
        return _steps(self.bound_model, self.method)

    @property
    def form(self) -> Form:
        """Form in which covariances are stored."""
        return self.steps.form

    def origins(self, static: Mapping[str, Ragged], runs: int) -> Floats | None:
        """Return the origins of tangent planes (runs, 3), as stated or from the first fixes."""
        if self.found.origin is not None:
            return np.tile(self.found.origin, (runs, 1))
        return next((origins_of(static[topic.name]) for topic in self.found.geodetic), None)

    def settings_of_runs(self, context: Context, runs: int) -> Floats:
        """Repeat the settings for each run (runs, 1 + sensors, fields); see `placed_settings`."""
        names, of = number_fields(self.bound_model.model.parameters), (self.found, self.parameters)
        settings = self.settings if self.each_run is None else self.each_run
        return placed_settings(settings, names, *of, context.origins, runs)

    def run(self, state: FilterState, block: Block) -> tuple[FilterState, list[Ragged]]:
        """Filter a block."""
        events, without_covariance = events_of(
            self.bound_model, self.found, block, state.context, self.settings
        )
        skipped = passed_over(self.name, self.bound_model, self.found, block, without_covariance)
        state, events = self.ready(state, events, is_end=False)
        after, made = self.follow(state, events)
        return after, [*made, *self.gaps(events), *skipped]

    def ready(
        self, state: FilterState, events: FilterEvents, *, is_end: bool
    ) -> tuple[FilterState, FilterEvents]:
        """Return the events that need not wait, and a state that contains the waiting events."""
        if not self.waits and self.parameters.every_s is None:
            return state, events
        next_output, waiting, unsettled = state.next_output, None, None
        if self.has_delays:
            if state.unsettled is not None:
                events = join_events(state.unsettled, events)
            delays = self.delays_ns
            events, unsettled = compensate_delays(self.bound_model, events, delays, is_end=is_end)
        if self.parameters.every_s is not None:
            every_ns = round(self.parameters.every_s * 1e9)
            events, next_output = add_output_times(events, state.carried.time_ns, next_output, every_ns)
        if state.waiting is not None:
            events = join_events(state.waiting, events)
        control = self.bound_model.model.control
        if control is not None and control.interpolated:
            events, waiting = interpolate_control(events, len(control.components), self.gap_ns)
            events = fill_control(self.bound_model, events)
        after = state._replace(waiting=waiting, next_output=next_output, unsettled=unsettled)
        return after, events

    def gaps(self, events: FilterEvents) -> list[Ragged]:
        """Report the gaps of the control after which the filter continues."""
        control = self.bound_model.model.control
        if control is None or not control.gap or not self.steps.resumes_after_gap:
            return []
        return [not_driven(self.name, control, self.found, events)]

    def finish(self, state: FilterState) -> list[Ragged]:
        """Filter the events that still wait for messages."""
        return self.ended(state)[1]

    def ended(self, state: FilterState) -> tuple[FilterState, list[Ragged]]:
        """Filter the events that still wait for messages; return the state and the outputs."""
        made: list[Ragged] = []
        if state.unsettled is not None:
            no_more = select_events(state.unsettled, np.zeros(len(state.unsettled.time_ns), bool))
            state, events = self.ready(state, no_more, is_end=True)
            state, made = self.follow(state, events)
            made += self.gaps(events)
        if state.waiting is None:
            return state, made
        tail = fill_control(self.bound_model, hold_control(state.waiting, self.initial, self.gap_ns))
        state, last = self.follow(state, tail)
        return state, [*made, *last]

    @cached_property
    def waits(self) -> bool:
        """Whether events may have to wait for later messages."""
        control = self.bound_model.model.control
        return self.has_delays or (control is not None and control.interpolated)

    @property
    def has_end(self) -> bool:
        """Whether `finish` may return outputs."""
        return self.waits or type(self).finish is not Filter.finish

    @property
    def gap_ns(self) -> float:
        """Longest time without messages of an interpolated control."""
        control = self.bound_model.model.control
        if control is None or not control.gap:
            return np.inf
        names = number_fields(self.bound_model.model.parameters)
        return 1e9 * float(self.settings[0, names.index(control.gap)])

    @cached_property
    def delays_ns(self) -> Integers:
        """Delays of messages; see `delays_of`."""
        return delays_of(self.bound_model, self.settings if self.each_run is None else self.each_run)

    @cached_property
    def has_delays(self) -> bool:
        """Whether messages of a topic are moved to their times of measurement."""
        return bool(self.delays_ns.any())

    @property
    def initial(self) -> tuple[float, ...]:
        """Control before its first message."""
        control = self.bound_model.model.control
        return (control.initial or (0.0,) * len(control.components)) if control else ()

    @cached_property
    def beside_settings(self) -> Hashable:
        """Key of the filter's definition; it excludes settings that only the loop over runs reads."""
        names = {*number_fields(self.bound_model.model.parameters)} - {"gate_probability"} | {
            "of_topics"
        }
        return (
            self.name,
            self.bound_model,
            self.method,
            repr({name: value for name, value in self.parameters if name not in names}),
            origin_parameters(self.found, self.parameters),
            self.has_delays,
            self.gap_ns,
            *(
                own_variances(self.bound_model, number, self.settings).tobytes()
                for number, sensor in enumerate(self.bound_model.sensors)
                if sensor.covariance
            ),
        )

    @property
    def why_in_sequence(self) -> str:
        """Reason why the filter needs its messages in order; empty if it can reprocess messages."""
        control = self.bound_model.model.control
        if self.parameters.every_s is not None:
            return "it does not support estimates between messages (every_s, --every)"
        if control is not None and control.interpolated:
            return f"{control.topic} is interpolated, so messages have to wait for its next message"
        if self.has_delays:
            return "messages are moved to their times of measurement and have to wait for each other"
        if self.is_random:
            return "its samples are random, and would differ if a message were processed again"
        return ""

    def follow(self, state: FilterState, events: FilterEvents) -> tuple[FilterState, list[Ragged]]:
        """Filter events."""
        after, estimated, made = self.filtered(state, events)
        states, *others = self.output_streams(*estimated)
        return after, [issued(states, events, state.carried.time_ns), *others, *made]

    def filtered(
        self, state: FilterState, events: FilterEvents
    ) -> tuple[FilterState, tuple[EstimatesToFill, Integers], list[Ragged]]:
        """Filter events; return the state after them, estimates, their offsets, and other outputs."""
        sensors = self.bound_model.sensors
        loop, _ = _compiled(self.bound_model, self.method)
        before, carried = state.carried, copied(state.carried)
        runs = len(before.time_ns)
        due, recorded = self.rows_due(events)
        innovation_size = len(self.measured)
        estimates, innovations = self.no_results(due, recorded, innovation_size)
        if any(len(sensor.measured) < innovation_size for sensor in sensors):
            innovations.difference[:], innovations.covariance[:] = np.nan, np.nan
        settings, generators = self.settings_of_runs(state.context, runs), state.generators
        if self.is_random:
            generators = seeded_generators(generators, events, len(self.samplers), self.parameters.seed)
        for part, scratch in self.parts(generators, events):
            inputs = RunInputs(events, settings, self.gates)
            results = RunResults(estimates, innovations)
            if part is None:
                loop(runs, inputs, carried, results, scratch=scratch)
                continue
            own = events._replace(offsets=events.offsets[part.start : part.stop + 1])
            inputs = RunInputs(own, settings[part], self.gates)
            ends = estimates.end[part], innovations.end[part]
            results = RunResults(estimates._replace(end=ends[0]), innovations._replace(end=ends[1]))
            loop(part.stop - part.start, inputs, of_runs(carried, part), results, scratch=scratch)
        made = [self.innovations(*filled(innovations, recorded))] if sensors else []
        if carried.failure.tobytes() != before.failure.tobytes():
            failures = before.failure, carried.failure, carried.time_ns, FAILURES
            made.append(failures_of(f"/estimates/{self.name}", *failures))
        after = FilterState(carried, state.context, generators, *state[3:])
        return after, filled(estimates, due), made

    def rows_due(self, events: FilterEvents) -> tuple[Integers, Integers]:
        """Return the first row (runs + 1,) of each run in estimates and in innovations.

        They are stored for few events, because a short log is often replayed again. The events are
        stored with them, so that no other events can have their id.
        """
        if len(events.time_ns) > FEW_MESSAGES:
            return _rows_due(events)
        (due, recorded), _ = self._stored.once(id(events), lambda: (_rows_due(events), events))
        return due, recorded

    @cached_property
    def _stored(self) -> Findings:
        return Findings(2)

    def parts(
        self, generators: tuple[Samples, ...], events: FilterEvents
    ) -> Iterator[tuple["RowSlice | None", Callable[[], CoreMemory]]]:
        """Yield slices of runs (None for all), and functions that make the working memory of a core."""
        if not self.is_random:
            yield None, self.scratch
            return
        for part, sets in sample_sets(self.samplers, generators, events.offsets):
            yield part, partial(self.steps.memory, sets)

    @cached_property
    def is_random(self) -> bool:
        """Whether new samples are drawn for every event."""
        return any(each.redrawn for each in self.samplers)

    @cached_property
    def scratch(self) -> Scratch:
        """Working memory of each core, with samples that are used for every event."""
        [(_, sets)] = sample_sets(self.samplers, (), np.zeros(1, np.int64))
        return Scratch(partial(self.steps.memory, sets))

    def no_results(
        self, due: Integers, recorded: Integers, innovation_size: int
    ) -> tuple[EstimatesToFill, InnovationRows]:
        """Allocate arrays for estimates and innovations; see `recursion.no_results`."""
        return no_results(due, recorded, self.bound_model.model, innovation_size)

    @cached_property
    def gates(self) -> Floats:
        """Bounds of the NIS (sensors + 1, largest measurement + 1), by number of components.

        The last row is an open gate.
        """
        largest = max((len(sensor.measured) for sensor in self.bound_model.sensors), default=0)
        bounds = _nis_bounds(self.parameters.gate_probability, largest)
        gates = np.repeat(bounds[None], len(self.bound_model.sensors) + 1, axis=0)
        gates[-1] = np.inf
        return gates

    @property
    def truth(self) -> str:
        """Topic with which the estimates are compared."""
        return self.found.truth

    def output_streams(self, estimates: EstimatesToFill, offsets: Integers, /) -> list[Ragged]:
        """Make the streams of estimates; rows offsets[r]:offsets[r + 1] belong to run r."""
        return [self.states(estimates, offsets)]

    def states(self, estimates: EstimateRows, offsets: Integers) -> Ragged:
        """Make the stream of states; rows offsets[r]:offsets[r + 1] belong to run r."""
        model, (_, time_ns, mean, covariance) = self.bound_model.model, estimates
        columns = {
            "sensor_time_ns": time_ns,
            "mean": wrapped(mean, model.state),
            "covariance": rows_of(covariance),
        }
        topic, metadata = f"/estimates/{self.name}/{model.output}", self.state_metadata
        schema = schemas.GAUSSIAN_ESTIMATE
        return Ragged(computed_stream(topic, schema, time_ns, columns, metadata), offsets)

    @cached_property
    def state_metadata(self) -> Mapping[str, str]:
        """Metadata of the channel of the states."""
        return {**named(self.bound_model.model.state), "truth": self.truth, **in_frame(self.found.frame)}

    @cached_property
    def measured(self) -> Mapping[str, str]:
        """Names and kinds of the components of all innovations."""
        return innovation_components(self.bound_model.sensors)

    @cached_property
    def innovation_metadata(self) -> Mapping[str, str]:
        """Metadata of the channel of the innovations."""
        return {**named(self.measured), "truth": self.truth}

    def innovations(self, innovations: InnovationRows, offsets: Integers) -> Ragged:
        """Make the stream of innovations of a filter with sensors; see `states`."""
        topic = f"/estimates/{self.name}/innovation"
        return recorded_innovations(topic, self.innovation_metadata, innovations, offsets)


def _rows_due(events: FilterEvents) -> tuple[Integers, Integers]:
    offsets = events.offsets
    return ragged_rows(events.wants_estimate, offsets), ragged_rows(events.source >= 0, offsets)


@lru_cache(maxsize=64)
def _nis_bounds(probability: float, components: int) -> Floats:
    """Compute the quantiles (components + 1,) of the NIS; infinity for zero components."""
    return np.append(np.inf, chi2.ppf(probability, np.arange(1, components + 1)))
