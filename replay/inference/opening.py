"""Where a filter begins in a log that does not say so, and where its plane lies.

A log without a prior gets one at the first message that measures the state, see `model.Start`. It is so
much wider than that message that the message itself, used like any other, is what counts. The origin of
a plane that no channel states is the first geodetic fix. All of it is told, on the topic `started`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from recorders.errors import BadInput
from recorders.log import Clock, Topic, make_stream, schemas
from replay.engine.arrays import Booleans, Floats, Integers
from replay.engine.blocks import Ragged, ragged_rows
from replay.engine.estimator import Opened, Opening
from replay.engine.failures import reason_stream
from replay.engine.geodetic import in_plane, origins_of
from replay.engine.results import gaussian_stream, named
from replay.engine.tangent import tangent_components, things
from replay.inference.binding import Found, complaint_of, number_fields, reading_settings
from replay.inference.happenings import World, sensor_table
from replay.inference.model import Aligned, Sensor, Start
from replay.inference.steps import Stage

WIDER = 30.0  # of a message's standard deviations: a prior that is worth a thousandth beside it
ALIGNING = 1 << 16  # messages of a run that an alignment looks at: ten minutes at 100 Hz
CERTAIN = 1e-6  # of the standard deviations of a start: a thing alone knows where its frame is


@dataclass(frozen=True)
class Beginning:
    """What a filter looks for in the first messages of a log.

    Attributes:
        name: what its output topics begin with, after `/estimates/`.
        found: its topics.
        stage: the model as the log states it, with the sensors at hand.
        settings: (1 + sensors, fields) numbers of motion and sensors.
        assumed: the parameters among them that the log does not state.
    """

    name: str
    found: Found
    stage: Stage
    settings: Floats
    assumed: Mapping[str, float]

    @property
    def opening(self) -> Opening | None:
        """How it is found; None where the log states all."""
        needs_origin = self.found.geodetic if self.found.origin is None else ()
        wanted = [*needs_origin, *(() if self.found.has_prior else self._starting)]
        topics = tuple(dict.fromkeys(topic.name for topic in wanted))
        if not topics:
            return None
        return Opening(topics, self.find, ALIGNING if self._aligns else Opening.messages)

    @property
    def _aligns(self) -> bool:
        """Whether the start takes more than one message."""
        start = self.stage.model.start
        return not self.found.has_prior and start is not None and start.align is not None

    @cached_property
    def _measuring(self) -> list[tuple[int, Sensor, Topic]]:
        """The sensors that measure components of the state by their names, with their numbers."""
        state = self.stage.model.state
        return [
            (number, sensor, topic)
            for number, (sensor, topic) in enumerate(self.found.sensors)
            if sensor.covariance and sensor.measured.items() <= state.items()
        ]

    @property
    def _starting(self) -> list[Topic]:
        """The topics whose first message is where to begin."""
        if self._measuring and not self._aligns:
            return [topic for _, _, topic in self._measuring]
        control = [] if self.found.control is None else [self.found.control]
        return [*control, *(topic for _, topic in self.found.sensors)]

    def find(self, first: Mapping[str, Ragged], clock: Clock) -> Opened:
        """What is found in the first messages; raises BadInput where none of them can be used."""
        whole: dict[str, Ragged] = {}
        told: list[Ragged] = []
        reasons: list[tuple[str, Integers, Booleans]] = []
        origins = None if self.found.origin is None else np.tile(self.found.origin, (_runs(first), 1))
        for topic in self.found.geodetic if origins is None else ():
            fixes = first[topic.name]
            origins, has_one = origins_of(fixes), np.diff(fixes.offsets) > 0
            whole[topic.name] = _first_rows(fixes)
            told.append(self._told_origin(whole[topic.name]))
            time_ns = np.zeros(len(has_one), np.int64)
            time_ns[has_one] = whole[topic.name].stream.times(clock)
            what = f"no channel states the origin of the plane: it is the first fix of {topic.name}"
            reasons.append((what, time_ns, has_one))
        if not self.found.has_prior:
            if self._aligns:
                prior, found = self._aligned(first, origins)
            else:
                prior, found = self._prior(first, clock, origins)
            whole[self.found.prior.name] = prior
            reasons += found
        return Opened(whole, [*told, *self._told(reasons)])

    def _prior(
        self, first: Mapping[str, Ragged], clock: Clock, origins: Floats | None
    ) -> tuple[Ragged, list[tuple[str, Integers, Booleans]]]:
        """The priors of all runs, and what is to be told of them."""
        model, runs = self.stage.model, _runs(first)
        start = model.start
        assert start is not None
        mean, sigma = _anywhere(model.state, start)
        mean, sigma = np.tile(mean, (runs, 1)), np.tile(sigma, (runs, 1))
        time_ns, chosen = np.full(runs, np.iinfo(np.int64).max), np.full(runs, -1)
        without = f"the log has no prior ({self.found.prior.name}): it begins"
        if not self._measuring:
            for topic in self._starting:
                found_ns, has_one, _ = _first_of(first[topic.name], clock, None)
                time_ns = np.where(has_one, np.minimum(time_ns, found_ns), time_ns)
            if not self.found.sensors:
                sigma *= CERTAIN
            where = "anywhere" if self.found.sensors else "at zero, where its frame is"
            begun = time_ns < np.iinfo(np.int64).max
            reasons = [(f"{without} {where}", time_ns, begun)]
        else:
            for number, _, topic in self._measuring:
                ragged = first[topic.name]
                table = sensor_table(self.stage, number, ragged, World({}, origins), self.settings)
                found_ns, has_one, rows = _first_of(ragged, clock, table.source >= 0)
                is_first = has_one & (found_ns < time_ns)
                time_ns[is_first], chosen[is_first] = found_ns[is_first], number
                self._narrow(number, table.data, rows, is_first, mean, sigma)
            begun = chosen >= 0
            if not begun.any():
                raise BadInput(f"estimator {self.name}: {without} nowhere: {self._complaints()}")
            reasons = [
                (f"{without} at the first message of {topic.name}", time_ns, chosen == number)
                for number, _, topic in self._measuring
            ]
        reasons += self._assumed(time_ns, begun)
        covariance = (sigma**2)[:, :, None] * np.eye(sigma.shape[1])
        stream = gaussian_stream(
            self.found.prior.name, time_ns[begun], mean[begun], covariance[begun], named(model.state)
        )
        return Ragged(stream, np.append(0, np.cumsum(begun))), reasons

    def _aligned(
        self, first: Mapping[str, Ragged], origins: Floats | None
    ) -> tuple[Ragged, list[tuple[str, Integers, Booleans]]]:
        """The priors of all runs that an alignment finds, and what is to be told of them.

        Raises BadInput where it finds none.
        """
        model, runs = self.stage.model, _runs(first)
        assert model.start is not None
        assert model.start.align is not None
        assert model.control is not None
        assert self.found.control is not None
        parameters = reading_settings(number_fields(model.parameters))(self.settings, 0)
        given = {model.control.topic: first[self.found.control.name]}
        for sensor, topic in self.found.sensors:
            own = first[topic.name]
            if origins is not None and topic in self.found.geodetic:
                own = in_plane(own, origins)
            given[sensor.topic] = own
        starts: dict[int, Aligned] = {}
        for run in range(runs):
            try:
                streams = {name: ragged.of_run(run) for name, ragged in given.items()}
                starts[run] = model.start.align(streams, parameters)
            except BadInput as error:
                if run == runs - 1 and not starts:
                    raise BadInput(f"estimator {self.name}: {error}") from error
        time_ns, begun = np.zeros(runs, np.int64), np.zeros(runs, bool)
        for run, start in starts.items():
            time_ns[run], begun[run] = start.time_ns, True
        without = f"the log has no prior ({self.found.prior.name}): it begins"
        reasons = [
            (
                f"{without} {how}",
                time_ns,
                np.array([run in starts and starts[run].how == how for run in range(runs)]),
            )
            for how in dict.fromkeys(start.how for start in starts.values())
        ]
        reasons += self._assumed(time_ns, begun)
        mean = np.array([start.mean for start in starts.values()])
        covariance = np.array([start.covariance for start in starts.values()])
        name, components = self.found.prior.name, named(model.state)
        stream = gaussian_stream(name, time_ns[begun], mean, covariance, components)
        return Ragged(stream, np.append(0, np.cumsum(begun))), reasons

    def _assumed(self, time_ns: Integers, begun: Booleans) -> list[tuple[str, Integers, Booleans]]:
        """What is to be told of the parameters that no channel states."""
        return [
            (
                f"no channel states {name}: {number:g} is assumed; --set {name}=... sets it",
                time_ns,
                begun,
            )
            for name, number in self.assumed.items()
        ]

    def _narrow(
        self,
        number: int,
        data: Floats,
        rows: Integers,
        which: Booleans,
        mean: Floats,
        sigma: Floats,
    ) -> None:
        """Put what a sensor's rows (runs,) measure into the means and sigmas of some runs, in place."""
        model, sensor = self.stage.model, self.stage.sensors[number]
        start_mean, start_sigma = _anywhere(model.state, model.start)
        mean[which], sigma[which] = start_mean, start_sigma
        components = [name for name, _ in tangent_components(list(model.state), model.kinds)]
        diagonal = np.cumsum(np.arange(1, len(sensor.measured) + 1)) - 1
        for place, name in enumerate(sensor.measured):
            measured = data[rows[which], place]
            own = np.sqrt(data[rows[which], len(sensor.measured) + diagonal[place]])
            is_there = ~np.isnan(measured)
            column, row = list(model.state).index(name), components.index(name)
            mean[which, column] = np.where(is_there, measured, start_mean[column])
            sigma[which, row] = np.where(
                is_there, np.minimum(WIDER * own, start_sigma[row]), start_sigma[row]
            )

    def _complaints(self) -> str:
        complaints = [
            complaint_of(self.stage.model, sensor, topic.name) for _, sensor, topic in self._measuring
        ]
        return "; ".join(complaints)

    def _told_origin(self, fixes: Ragged) -> Ragged:
        """The origins as fixes, on a topic of their own."""
        stream = fixes.stream
        columns: dict[str, Any] = {
            name: stream[name] for name in ("latitude_deg", "longitude_deg", "altitude_m")
        }
        topic = f"/estimates/{self.name}/origin"
        told = make_stream(topic, schemas.GEODETIC_FIX, stream.publish_time_ns, **columns)
        return Ragged(told, fixes.offsets)

    def _told(self, reasons: list[tuple[str, Integers, Booleans]]) -> list[Ragged]:
        """What was assumed, on the topic `started`: a message for each sentence and run."""
        if not reasons:
            return []
        texts, times, which = zip(*reasons, strict=True)
        is_said = np.stack(which, axis=1)
        stream = reason_stream(
            f"/estimates/{self.name}/started",
            schemas.STARTED,
            np.stack(times, axis=1)[is_said],
            np.nonzero(is_said)[1],
            texts,
        )
        return [Ragged(stream, np.append(0, np.cumsum(is_said.sum(axis=1))))]


def _runs(first: Mapping[str, Ragged]) -> int:
    return next(iter(first.values())).runs


def _anywhere(state: Mapping[str, Any], start: Start | None) -> tuple[Floats, Floats]:
    """The mean (n,) and standard deviations (t,) of a state of which nothing is known."""
    assert start is not None
    kinds = list(state.values())
    mean = np.zeros(len(kinds))
    for kind, columns in things(kinds):
        if kind in ("axis", "quaternion"):
            mean[columns.start] = 1.0
    names = [name for name, _ in tangent_components(list(state), kinds)]
    return mean, np.array([start.sigmas[name] for name in names])


def _first_of(
    ragged: Ragged, clock: Clock, usable: Booleans | None
) -> tuple[Integers, Booleans, Integers]:
    """The first usable message of every run (runs,): its stamp, whether there is one, its row."""
    every = np.arange(len(ragged)) if usable is None else np.flatnonzero(usable)
    place = np.searchsorted(every, ragged.offsets)
    has_one = place[1:] > place[:-1]
    rows = np.zeros(ragged.runs, np.int64)
    rows[has_one] = every[place[:-1][has_one]]
    time_ns = np.zeros(ragged.runs, np.int64)
    time_ns[has_one] = ragged.stream.times(clock)[rows[has_one]]
    return time_ns, has_one, rows


def _first_rows(ragged: Ragged) -> Ragged:
    """The first message of every run that has one."""
    is_first = np.zeros(len(ragged), bool)
    is_first[ragged.offsets[:-1][np.diff(ragged.offsets) > 0]] = True
    return Ragged(ragged.stream.take(is_first), ragged_rows(is_first, ragged.offsets))
