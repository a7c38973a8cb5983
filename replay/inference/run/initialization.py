"""Initialization of a filter in a log without a prior, and of the filter's tangent plane.

Such a log gets a prior at the first message that measures the state; see `start.Start`. The prior is
much wider than the message, so that the message itself, which is also processed as a measurement,
determines the estimate. If no channel states the origin of the tangent plane, the first geodetic fix is
used. All such decisions are reported on the topic `started`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream, Topic, make_stream, schemas
from fuselog.recorders.parameters import meanings
from fuselog.replay.engine.arrays import Columns, Floats, Numbers, Settings
from fuselog.replay.engine.replaying.estimator import Initialization, Initialized
from fuselog.replay.engine.streams.blocks import Block, Ragged, gather, merge_events
from fuselog.replay.engine.streams.geodetic import in_plane, origins_of
from fuselog.replay.engine.streams.results import gaussian_stream, named
from fuselog.replay.inference.model.binding import Found, measures_state
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Sensor
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.settings import complaint_of, reading_settings
from fuselog.replay.inference.run.broad_start import Reference, broad_priors
from fuselog.replay.inference.run.events import Context, data_columns, filter_events, sensor_table
from fuselog.replay.inference.run.first_messages import (
    Begun,
    Fact,
    first_of_runs,
    heads_of_runs,
    of_runs,
    run_count,
    started,
    state_by_message,
    unknown,
)
from fuselog.replay.inference.run.recursion import CONTROL, FilterEvents
from fuselog.replay.inference.run.timing import compensate_delays, delays_of

FOREVER_NS = np.iinfo(np.int64).max
HEAD = 16  # number of messages of a run that are tried first; one of them is usually usable
CERTAIN = 1e-6  # factor on standard deviations of a start that defines its own frame


@dataclass(frozen=True)
class Initializer:
    """Search for the start of a filter in the first messages of a log.

    Attributes:
        name: the part after `/estimates/` in the names of its output topics.
        found: its topics.
        bound_model: the bound model, with the sensors of the log.
        settings: (1 + sensors, fields), parameters of motion and sensors.
        assumed: parameters of motion and sensors that the log does not state.
    """

    name: str
    found: Found
    bound_model: BoundModel
    settings: Floats
    assumed: Mapping[str, float]

    @property
    def initialization(self) -> Initialization | None:
        """Method of finding the start in messages; None if no messages are needed for the start."""
        needs_origin = self.found.geodetic if self.found.origin is None else ()
        needs_messages = not self.found.has_prior or self._prior_check is not None
        wanted = [*needs_origin, *(self._starting if needs_messages else ())]
        topics = tuple(dict.fromkeys(topic.name for topic in wanted))
        is_free = not self.found.has_prior and not self.bound_model.model.finds_start and self._measuring
        return (
            Initialization(topics, self.find, self.find_broad if is_free else None) if topics else None
        )

    @property
    def _prior_check(self) -> Callable[[Mapping[str, Stream], Settings], list[str]] | None:
        start = self.bound_model.model.start
        return start.check_prior if start is not None else None

    @cached_property
    def _measuring(self) -> list[tuple[int, Sensor, Topic]]:
        """Sensors that measure components of the state directly, with their indices."""
        return [
            (number, sensor, topic)
            for number, (sensor, topic) in enumerate(self.found.sensors)
            if measures_state(self.bound_model.model, sensor)
        ]

    @property
    def _starting(self) -> list[Topic]:
        """Topics whose first message determines the start."""
        control = [] if self.found.control is None else [self.found.control]
        drives = [*control, *(topic for _, topic in self.found.fallbacks)]
        if self.bound_model.model.finds_start:
            return [*drives, *(topic for _, topic in self.found.sensors)]
        needs_drives = self._aligns or not self._measuring
        return [*(drives if needs_drives else []), *(topic for _, _, topic in self._measuring)]

    @property
    def _aligns(self) -> bool:
        """Whether the whole state can and must be determined from several fixes."""
        model = self.bound_model.model
        kinds = {sensor.topic: len(sensor.measured) for _, sensor, _ in self._measuring}
        can_align = bool(model.start and model.start.align)
        return can_align and len(kinds) == 1 and max(kinds.values()) < model.size

    def find(
        self, first: Mapping[str, Ragged], static: Mapping[str, Ragged], clock: Clock
    ) -> Initialized:
        """Find starts in the first messages.

        Args:
            first: first messages of every run, by topic.
            static: topics that the filter needs before it starts, by name.
            clock: clock by which the replay stamps estimates.

        Raises BadInput if no message can be used.
        """
        found: dict[str, Ragged] = {}
        streams: list[Ragged] = []
        facts: list[Fact] = []
        origins = (
            None if self.found.origin is None else np.tile(self.found.origin, (run_count(first), 1))
        )
        for topic in self.found.geodetic if origins is None else ():
            fixes = first[topic.name]
            time_ns, has_one, rows = first_of_runs(fixes, clock, None)
            found[topic.name] = of_runs(fixes.stream.take(rows[has_one]), has_one)
            origins = origins_of(found[topic.name])
            streams.append(self._origin_stream(found[topic.name]))
            what = f"no channel states the origin of the plane: the first fix of {topic.name} is used"
            facts.append(Fact(what, time_ns, has_one))
        if not self.found.has_prior:
            prior, begun = self._prior(first, static, clock, origins)
            found[self.found.prior.name] = prior
            facts += begun
        elif self._prior_check is not None:
            facts += self._checked_prior(self._prior_check, first, static, origins)
        return Initialized(found, [*streams, *started(self.name, facts)])

    def find_broad(
        self,
        first: Mapping[str, Ragged],
        _static: Mapping[str, Ragged],
        clock: Clock,
        times_ns: Sequence[int],
    ) -> list[Initialized]:
        """Find equally likely initial states of the runs at the given stamps; see `broad_priors`."""
        runs = run_count(first)
        origins = None if self.found.origin is None else np.tile(self.found.origin, (runs, 1))
        begun: dict[str, Ragged] = {}
        for topic in self.found.geodetic if origins is None else ():
            fixes = [first[topic.name].of_run(run).take(slice(0, 1)) for run in range(runs)]
            begun[topic.name] = gather(fixes)
            origins = origins_of(begun[topic.name])
        references: list[list[Reference]] = [[] for _ in range(runs)]
        for number, sensor, topic in self._measuring:
            for count in (HEAD, None):
                whole = first[topic.name]
                ragged = whole if count is None else heads_of_runs(whole, count)
                table = sensor_table(
                    self.bound_model, number, ragged, Context({}, origins), self.settings
                )
                _when, has_message, rows = first_of_runs(ragged, clock, table.source >= 0)
                if (has_message | (np.diff(whole.offsets) == 0)).all():
                    break
            for run in np.flatnonzero(has_message):
                state = state_by_message(self.bound_model, number, table.data[rows[run]])
                references[run].append((sensor.measured, *state))
        priors = broad_priors(self.bound_model.model, self.found.prior.name, times_ns, references)
        has_one = np.ones(runs, np.bool_)
        return [Initialized({**begun, prior.topic: of_runs(prior, has_one)}, []) for prior in priors]

    def _prior(
        self,
        first: Mapping[str, Ragged],
        static: Mapping[str, Ragged],
        clock: Clock,
        origins: Floats | None,
    ) -> tuple[Ragged, list["Fact"]]:
        """Make the priors of all runs, and the facts to report about them."""
        model, runs = self.bound_model.model, run_count(first)
        mean, sigma = unknown(model.state, model.start)
        covariance = np.tile(sigma**2 * np.eye(len(sigma)), (runs, 1, 1))
        begun = Begun(np.full(runs, FOREVER_NS), np.tile(mean, (runs, 1)), covariance)
        if model.finds_start:
            facts = self._found(first, static, origins, begun)
        elif self._measuring:
            facts = self._at_first(first, clock, origins, begun)
        else:
            facts = self._at_zero(first, clock, begun)
        if self._aligns:
            aligned = self._aligned(first, clock, origins, begun)
            others = [fact._replace(is_so=fact.is_so & ~aligned.is_so) for fact in facts]
            facts = [aligned, *others, self._unaligned(aligned, begun)]
        has_begun = begun.time_ns < FOREVER_NS
        facts += [
            Fact(self._assumption(name, number), begun.time_ns, has_begun)
            for name, number in self.assumed.items()
        ]
        stream = gaussian_stream(
            self.found.prior.name,
            begun.time_ns[has_begun],
            begun.mean[has_begun],
            begun.covariance[has_begun],
            named(model.state),
        )
        return of_runs(stream, has_begun), facts

    def _unaligned(self, aligned: "Fact", begun: "Begun") -> "Fact":
        """Report the components that fixes do not determine, for runs that start without alignment."""
        _, sensor, _ = self._measuring[0]
        measured = sensor.measured
        names = ", ".join(name for name in self.bound_model.model.state if name not in measured)
        text = (
            f"{names}: unknown at the start, since the path between the first fixes does not determine "
            "it with these noise densities; state the densities of your sensors, or give a prior"
        )
        return Fact(text, begun.time_ns, ~aligned.is_so & (begun.time_ns < FOREVER_NS))

    def _assumption(self, name: str, number: float) -> str:
        """Describe an assumed parameter, with its meaning if the model documents it."""
        meaning = meanings(self.bound_model.model.parameters).get(name, "")
        sentence = f"no channel states {name}: {number:g} is assumed; --set {name}=... sets it"
        return f"{sentence} ({meaning.rstrip('.')})" if meaning else sentence

    @property
    def _without(self) -> str:
        return f"the log has no prior ({self.found.prior.name})"

    def _at_zero(self, first: Mapping[str, Ragged], clock: Clock, begun: "Begun") -> list["Fact"]:
        """Start all runs at zero, at their first control; this defines the frame of the estimates."""
        for topic in self._starting:
            found_ns, has_one, _ = first_of_runs(first[topic.name], clock, None)
            begun.time_ns[has_one] = np.minimum(begun.time_ns, found_ns)[has_one]
        begun.covariance[:] *= CERTAIN**2
        where = "at zero, the origin of its frame"
        return [
            Fact(
                f"{self._without}: the estimate starts {where}",
                begun.time_ns,
                begun.time_ns < FOREVER_NS,
            )
        ]

    def _found(
        self,
        first: Mapping[str, Ragged],
        static: Mapping[str, Ragged],
        origins: Floats | None,
        begun: "Begun",
    ) -> list["Fact"]:
        """Start all runs at the states that the model finds; raise BadInput if it finds no state."""
        model = self.bound_model.model
        assert model.start is not None
        assert model.start.find is not None
        given, parameters = self._given(first, static, origins)
        how = [""] * len(begun.time_ns)
        for run in range(len(how)):
            try:
                streams = {name: ragged.of_run(run) for name, ragged in given.items()}
                found = model.start.find(streams, parameters)
            except BadInput as error:
                if run == len(how) - 1 and not any(how):
                    raise BadInput(f"estimator {self.name}: {error}") from error
                continue
            begun.time_ns[run], begun.mean[run] = found.time_ns, found.mean
            begun.covariance[run], how[run] = found.covariance, found.how
        return [
            Fact(f"{self._without}: the estimate starts {words}", begun.time_ns, np.array(how) == words)
            for words in dict.fromkeys(filter(None, how))
        ]

    def _given(
        self, first: Mapping[str, Ragged], static: Mapping[str, Ragged], origins: Floats | None
    ) -> tuple[dict[str, Ragged], Settings]:
        """Return first messages and maps by the topic names that the model uses, and the parameters."""
        model, control = self.bound_model.model, self.found.control
        given = {}
        if model.control is not None and control is not None:
            given[model.control.topic] = first[control.name]
        for sensor, topic in self.found.sensors:
            ragged = first[topic.name]
            if origins is not None and topic in self.found.geodetic:
                ragged = in_plane(ragged, origins)
            given.setdefault(sensor.topic, ragged)  # the first topic of each sensor
            given |= {each.topic: static[each.topic] for each in sensor.maps}
        return given, self._parameters()

    def _checked_prior(
        self,
        check_prior: Callable[[Mapping[str, Stream], Settings], list[str]],
        first: Mapping[str, Ragged],
        static: Mapping[str, Ragged],
        origins: Floats | None,
    ) -> list["Fact"]:
        """Check the prior of each run against its first messages with the model's `check_prior`."""
        given, parameters = self._given(first, static, origins)
        sentences = [
            check_prior({name: ragged.of_run(run) for name, ragged in given.items()}, parameters)
            for run in range(run_count(first))
        ]
        time_ns, _, _ = first_of_runs(next(iter(given.values())), "publish_time", None)
        return [
            Fact(text, time_ns, np.array([text in of_run for of_run in sentences]))
            for text in dict.fromkeys(text for of_run in sentences for text in of_run)
        ]

    def _at_first(
        self, first: Mapping[str, Ragged], clock: Clock, origins: Floats | None, begun: "Begun"
    ) -> list["Fact"]:
        """Start all runs at their first message that measures components of the state."""
        chosen = np.full(len(begun.time_ns), -1)
        for number, _, topic in self._measuring:
            ragged = first[topic.name]
            table = sensor_table(self.bound_model, number, ragged, Context({}, origins), self.settings)
            found_ns, has_one, rows = first_of_runs(ragged, clock, table.source >= 0)
            for run in np.flatnonzero(has_one & (found_ns < begun.time_ns)).tolist():
                begun.time_ns[run], chosen[run] = found_ns[run], number
                begun.mean[run], sigma = state_by_message(
                    self.bound_model, number, table.data[rows[run]]
                )
                begun.covariance[run] = sigma**2 * np.eye(len(sigma))
        if (chosen < 0).all():
            raise BadInput(
                f"estimator {self.name}: {self._without}, and no message can replace "
                f"it: {self._complaints()}"
            )
        return [
            Fact(
                f"{self._without}: the estimate starts at the first message of {topic.name}",
                begun.time_ns,
                chosen == number,
            )
            for number, _, topic in self._measuring
        ]

    def _aligned(
        self, first: Mapping[str, Ragged], clock: Clock, origins: Floats | None, begun: "Begun"
    ) -> "Fact":
        """Start each run just after the fixes that, with the path between them, determine the state.

        If several topics serve the same sensor, the fixes of the first topic are used.
        """
        numbers = [number for number, _, _ in self._measuring[:1]]
        sensors = tuple(self.found.sensors[number] for number in numbers)
        found = self.found._replace(sensors=sensors)
        bound_model = self.bound_model._replace(sensors=tuple(sensor for sensor, _ in sensors))
        settings = self.settings[[0, *(1 + number for number in numbers)]]
        others = {topic.name for _, _, topic in self._measuring[1:]}
        names = [topic.name for topic in self._starting if topic.name not in others]
        streams = {name: first[name] for name in names}
        block = Block(streams, merge_events(streams, clock))
        events, _ = filter_events(bound_model, found, block, Context({}, origins), settings)
        delays_ns = delays_of(bound_model, settings)
        if delays_ns.any():
            events, _ = compensate_delays(bound_model, events, delays_ns, is_end=True)
        is_aligned = np.zeros(len(begun.time_ns), bool)
        for run in range(len(is_aligned)):
            solved = self._align(events, run, bound_model)
            if solved is not None:
                begun.time_ns[run], begun.mean[run], begun.covariance[run] = solved
                is_aligned[run] = True
        return Fact(
            f"{self._without}: the estimate starts where the path fits the first fixes",
            begun.time_ns,
            is_aligned,
        )

    def _align(
        self, events: FilterEvents, run: int, bound_model: BoundModel
    ) -> tuple[int, Floats, Floats] | None:
        """Align a run with its first fixes; return stamp, mean, covariance at one of them, or None."""
        model = bound_model.model
        assert model.start is not None
        assert model.start.align is not None
        parameters = self._parameters()
        state, control = (0.0,) * model.size, np.zeros(model.controls)
        path: list[Numbers] = []
        places: list[Floats] = []
        spreads: list[Floats] = []
        begin, end = events.offsets[run : run + 2]
        _, first = data_columns(bound_model)
        before_ns, first_ns = 0, None
        for event in range(begin, end):
            time_ns, source = int(events.time_ns[event]), events.source[event]
            duration_s = (time_ns - before_ns) * 1e-9
            if event > begin and duration_s > 0.0:
                state = model.motion.move(state, tuple(control), duration_s, parameters)
            before_ns, data = time_ns, events.data[event]
            if source == CONTROL:
                own = data[first : first + len(control)]
                control = np.where(np.isnan(own), control, own)
            elif source >= 0:
                size = len(bound_model.sensors[source].measured)
                lower = np.zeros((size, size))
                lower[np.tril_indices(size)] = data[size : size + size * (size + 1) // 2]
                first_ns = time_ns if first_ns is None else first_ns
                path.append(state)
                places.append(data[:size])
                spreads.append(lower + np.tril(lower, -1).T)
                fixes = np.array(path), np.array(places), np.array(spreads)
                solved = model.start.align(*fixes, (time_ns - first_ns) * 1e-9, parameters)
                if solved is not None:
                    return time_ns + 1, *solved
        return None

    def _parameters(self) -> Settings:
        """Return the parameters; those of each sensor are the parameters of its first topic."""
        model = self.bound_model.model
        names, numbers = number_fields(model.parameters), self.settings.copy()
        for number, (_, topic) in reversed([*enumerate(self.found.sensors, start=1)]):
            for field, (owner, name) in model.owned.items():
                if owner == topic.name:
                    numbers[0, names.index(name)] = numbers[number, names.index(field)]
        return reading_settings(names)(numbers, 0)

    def _complaints(self) -> str:
        complaints = [
            complaint_of(self.bound_model.model, sensor, topic.name)
            for _, sensor, topic in self._measuring
        ]
        return "; ".join(complaints)

    def _origin_stream(self, fixes: Ragged) -> Ragged:
        """Make the stream of origins, as fixes on a separate topic."""
        stream = fixes.stream
        columns: dict[str, Columns] = {
            name: stream[name] for name in ("latitude_deg", "longitude_deg", "altitude_m")
        }
        topic = f"/estimates/{self.name}/origin"
        origins = make_stream(topic, schemas.GEODETIC_FIX, stream.publish_time_ns, **columns)
        return Ragged(origins, fixes.offsets)
