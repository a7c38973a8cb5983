"""Estimators made of a model and a method: which topics they take, and what they say.

One binding for all models: the topics of a model are looked for under every prefix that has its prior,
as `/robot1/odometry` beside `/robot1/prior`; what is absent of its sensors is left out.
"""

import copy
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import create_model
from scipy.stats import chi2

from recorders.errors import BadInput, choices
from recorders.log import Schema, Stream, Topic, make_stream, schemas
from recorders.models.planar import wrap_angle
from recorders.parameters import Parameters, build
from recorders.registry import available, load
from replay.blocks import Block, Ragged, filled_rows, of_runs, ragged_rows
from replay.compile import compile_over_runs
from replay.engine import Bound, Estimator, Recursive
from replay.estimators.gaussian import failures_of
from replay.inference.generate import function_of
from replay.inference.methods import METHODS, Method
from replay.inference.model import (
    Map,
    Model,
    ModelParameters,
    Motion,
    Sensor,
    check_motion,
    check_sensor,
    check_state,
)
from replay.inference.recursion import (
    CONTROL,
    NOTHING,
    Carried,
    Estimates,
    Happenings,
    Innovations,
    recursion,
)
from replay.inference.steps import (
    ALL_WELL,
    NOT_STARTED,
    Gaussian,
    Stage,
    Steps,
    reading,
    slots_of,
)
from replay.sampling.samplers import Sampler
from replay.sampling.sets import SampleSets, seeded_by_data, sets_by_runs

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Function = Callable[..., Any]


@dataclass(frozen=True)
class Points:
    """The points of a map in all runs end to end: keys are run * 2^32 + number, sorted; places (n, d)."""

    keys: Integers
    places: Floats

    def rows(self, run: Integers, number: Integers) -> Integers:
        """The rows of the points with these numbers in these runs; -1 where there is none."""
        keys = (run << 32) + number
        if len(self.keys) == 0:
            return np.full(len(keys), -1)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[rows] == keys, rows, -1)


def points_of(ragged: Ragged, asked: Map) -> Points:
    """The points of all runs; raises BadInput where they have fewer coordinates than asked for."""
    places = ragged[asked.point]
    if len(ragged) and places.shape[1] < asked.size:
        raise BadInput(
            f"topic {asked.topic}: {asked.point} has {places.shape[1]} coordinates; "
            f"{asked.size} are needed"
        )
    run = np.repeat(np.arange(ragged.runs), np.diff(ragged.offsets))
    keys = (run << 32) + ragged[asked.number]
    order = np.argsort(keys, kind="stable")
    return Points(keys[order], np.ascontiguousarray(places[order, : asked.size]))


class Found(NamedTuple):
    """Where a log has what a model needs: the prefix, and the topics of prior, control and sensors."""

    prefix: str
    prior: Topic
    control: Topic | None
    sensors: tuple[tuple[Sensor, Topic], ...]


def topics_of(model: Model, topics: Mapping[str, Topic]) -> list[Found]:
    """Everything in a log that is of this model."""
    found = []
    for name, prior in topics.items():
        prefix, _, leaf = name.rpartition("/")
        if leaf != model.prior or prior.schema_name != schemas.GAUSSIAN_ESTIMATE.full_name:
            continue
        if set(prior.metadata.get("components", "").split(",")) != set(model.state):
            continue
        control = None
        if model.control is not None:
            control = _topic(topics, prefix, model.control.topic, model.control.schema)
            if control is None:
                continue
        sensors = tuple(
            (sensor, topic)
            for sensor in model.sensors
            if (topic := _topic(topics, prefix, sensor.topic, sensor.schema)) is not None
            and topic.metadata.get("system", model.system) == model.system
            and (sensor.about is None or _topic(topics, "", sensor.about.topic, sensor.about.schema))
        )
        if sensors or not model.needs_sensor:
            found.append(Found(prefix, prior, control, sensors))
    return found


def _topic(topics: Mapping[str, Topic], prefix: str, name: str, schema: Schema) -> Topic | None:
    topic = topics.get(name if name.startswith("/") else f"{prefix}/{name}")
    return topic if topic is not None and topic.schema_name == schema.full_name else None


def needs_of(model: Model) -> str:
    """What a log has to have for a model, in words."""
    parts = [f".../{model.prior} of {', '.join(model.state)}"]
    if model.control is not None:
        parts.append(f".../{model.control.topic} ({model.control.schema.full_name})")
    maps = {sensor.about.topic: sensor.about for sensor in model.sensors if sensor.about}
    parts += [f"{topic} ({each.schema.full_name})" for topic, each in maps.items()]
    sensors = [
        f"{'' if each.topic.startswith('/') else '.../'}{each.topic} ({each.schema.full_name})"
        for each in model.sensors
    ]
    if sensors and model.needs_sensor:
        one_of = "one of " if len(sensors) > 1 else ""
        parts.append(one_of + ", ".join(sensors))
    return "; ".join(parts)


def combined(model: Model, method: Method) -> type[ModelParameters]:
    """The parameters of a model and of a method, in one type."""
    name = f"{model.parameters.__name__}With{method.parameters.__name__}"
    return create_model(name, __base__=(method.parameters, model.parameters))


def modelled(model: Model, method: str, **defaults: Any) -> Estimator[Any]:
    """The estimator that estimates the state of one model by one method."""
    chosen = METHODS[method]
    lacking = chosen.lacks(model)
    if lacking:
        raise BadInput(f"method {method} needs {lacking}")
    return Estimator(
        f"{model.summary}, {chosen.summary}",
        needs_of(model),
        combined(model, chosen),
        partial(bind_model, model=model, method=chosen),
        variant=chosen.variant,
    )


def of_any_model(method: str) -> Estimator[Any]:
    """The estimator that estimates, by one method, the state of the registered model that fits a log."""
    chosen = METHODS[method]
    return Estimator(
        f"{chosen.summary}, of any model (`fuselog models` lists them)",
        "a log of one of the models that `fuselog models` lists",
        _any_parameters(chosen),
        partial(_bind_fitting, method=chosen),
        variant=chosen.variant,
    )


def registered_models() -> dict[str, Model]:
    """All models by name."""
    return {name: load("models", name, Model) for name in available("models")}


@lru_cache(maxsize=16)
def _any_parameters(method: Method) -> type[Parameters]:
    """All parameters of all models, none of them set, with those of a method and the model's name.

    What one model wants of a parameter is checked when the log has told which model it is.
    """
    fields: dict[str, Any] = {"model": (str | None, None)}
    for model in registered_models().values():
        for name, field in model.parameters.model_fields.items():
            if name not in method.parameters.model_fields:
                same = fields.get(name, (field.annotation,))[0] == field.annotation
                fields[name] = (field.annotation if same else Any, None)
    return create_model(f"Any{method.parameters.__name__}", __base__=method.parameters, **fields)


def _bind_fitting(
    label: str, topics: Mapping[str, Topic], values: Parameters, *, method: Method
) -> list[Bound]:
    """Bind the model that is named, or else the one that fits.

    Raises BadInput where none fits, several do, the method cannot serve it, or it has no such parameter.
    """
    models = registered_models()
    given = {name: getattr(values, name) for name in values.model_fields_set}
    named = given.pop("model", None)
    if named is not None and named not in models:
        raise BadInput(f"estimator {label}: no model '{named}'; {choices(named, models)}")
    fitting = [name for name in ([named] if named else models) if topics_of(models[name], topics)]
    if len(fitting) > 1:
        raise BadInput(
            f"estimator {label}: models {' and '.join(fitting)} fit this log; choose one with --model NAME"
        )
    if not fitting:
        tried = [named] if named else list(models)
        raise BadInput(
            f"estimator {label}: no model fits this log, which has {', '.join(topics) or 'no topics'}. "
            + " ".join(f"{name} needs {needs_of(models[name])}." for name in tried)
        )
    (name,) = fitting
    lacking = method.lacks(models[name])
    if lacking:
        raise BadInput(f"estimator {label}: model {name} lacks {lacking}, which this method needs")
    parameters = build(
        combined(models[name], method), given, f"estimator {label}, model {name}"
    )
    return bind_model(label, topics, parameters, model=models[name], method=method)


def bind_model(
    label: str, topics: Mapping[str, Topic], parameters: Any, *, model: Model, method: Method
) -> list[Bound]:
    """A filter for everything in the log that is of this model."""
    bound: list[Bound] = []
    for found in topics_of(model, topics):
        stage = Stage(model, model.motion, tuple(sensor for sensor, _ in found.sensors))
        numbers = settings_of(label, stage, found, parameters)
        name = label + found.prefix
        filtering = Filter(name, found, stage, method, parameters, numbers)
        maps = {sensor.about.topic: sensor.about for sensor in stage.sensors if sensor.about}
        control = [found.control.name] if found.control else []
        streams = (*control, *(topic.name for _, topic in found.sensors))
        whole = (found.prior.name, *maps)
        bound.append(Recursive(name, streams, whole, filtering.start, filtering.run))
    return bound


# Parameters as numbers


def number_fields(parameters: type[ModelParameters]) -> tuple[str, ...]:
    """The parameters that model functions may read: all that are numbers."""
    schema = parameters.model_json_schema()["properties"]
    numeric = ("number", "integer", "boolean", "null")
    return tuple(
        name
        for name, entry in schema.items()
        if all(each.get("type") in numeric for each in entry.get("anyOf", [entry]))
    )


@lru_cache(maxsize=64)
def settings_type(names: tuple[str, ...]) -> type[Any]:
    """The NamedTuple that model functions get as their parameters."""
    return namedtuple("Settings", names)  # type: ignore[misc] # noqa: PYI024


@lru_cache(maxsize=64)
def reading_settings(names: tuple[str, ...]) -> Function:
    """`read(settings, row)`: a row of numbers as the NamedTuple."""
    entries = ", ".join(f"settings[row, {index}]" for index in range(len(names)))
    text = f"def read(settings, row):\n    return Settings({entries})\n"
    return function_of(text, Settings=settings_type(names))


class _Recorder:
    """Parameters that remember which of them were read; what is unset reads as one."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self.read: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        if name not in self._values:
            raise AttributeError(f"no parameter '{name}'; the model has {', '.join(self._values)}")
        self.read.add(name)
        value = self._values[name]
        return 1.0 if value is None else float(value)


def settings_of(
    label: str, stage: Stage, found: Found, parameters: ModelParameters
) -> Floats:
    """The numbers (1 + sensors, fields) that motion and sensors get: given, or as channels state them.

    What is not given is looked for in the channels of the control, the prior and the sensors; a sensor
    looks in its own first. Raises BadInput where none states a number that is used, or the model is not
    what it says.
    """
    names = number_fields(stage.model.parameters)
    given = {name: getattr(parameters, name) for name in names}
    everything = [topic for topic in (found.control, found.prior) if topic is not None]
    everything += [topic for _, topic in found.sensors]
    check_state(label, stage.model)
    recorders = [_Recorder(given) for _ in range(1 + len(found.sensors))]
    check_motion(label, stage.model, stage.motion, recorders[0])
    for (sensor, _), recorder in zip(found.sensors, recorders[1:], strict=True):
        check_sensor(label, stage.model, sensor, recorder)
    own = [[], *([topic] for _, topic in found.sensors)]
    return np.array(
        [
            [
                _stated([*first, *everything], name, needed=name in recorder.read)
                if given[name] is None
                else float(given[name])
                for name in names
            ]
            for first, recorder in zip(own, recorders, strict=True)
        ]
    )


def _stated(topics: Sequence[Topic], name: str, *, needed: bool) -> float:
    """The first number of this name that a channel states; NaN where none does and none is needed."""
    stating = [topic for topic in topics if name in topic.metadata]
    if not stating and needed:
        raise BadInput(f"topic {topics[0].name} does not state {name}; give it with --set {name}=...")
    if not stating:
        return np.nan
    text = stating[0].metadata[name]
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise BadInput(f"topic {stating[0].name} states {name} = {text}, which is no number")
    return value


# The filter of one thing


class State(NamedTuple):
    """What a filter carries from block to block.

    Attributes:
        carried: see `recursion.Carried`.
        points: of every map, by its topic.
        generators: of the randomised samples, for every sampled function and run.
        waiting: events that wait for the next message of an interpolated control.
        tick: (runs,) the number of the next extra estimate.
    """

    carried: Carried
    points: Mapping[str, Points]
    generators: tuple[Any, ...]
    waiting: Happenings | None
    tick: Integers


@lru_cache(maxsize=64)
def _compiled(
    model: Model, motion: Motion, sensors: tuple[Sensor, ...], method: Method, names: tuple[str, ...]
) -> tuple[Function, Steps]:
    """The loop over the runs, and the steps that it was made of."""
    stage = Stage(model, motion, sensors)
    steps = method.steps(stage)
    loop = recursion(stage, steps, reading_settings(names))
    return compile_over_runs(loop, allocates=False), steps


@dataclass(frozen=True)
class Filter:
    """One bound filter; its `start` and `run` are what `replay.engine.Recursive` asks for.

    Attributes:
        name: what its output topics begin with, after `/estimates/`.
        found: its topics.
        stage, method, parameters: what it is made of.
        settings: (1 + sensors, fields), see `settings_of`.
    """

    name: str
    found: Found
    stage: Stage
    method: Method
    parameters: Any
    settings: Floats

    def start(self, whole: Mapping[str, Ragged]) -> State:
        """The state at every run's prior; a run whose prior cannot be used takes no part."""
        model, prior = self.stage.model, whole[self.found.prior.name]
        rows, tangent = prior.offsets[:-1], self.stage.model.tangent
        mean = prior["mean"][rows]
        covariance = prior["covariance"][rows].reshape(-1, tangent, tangent)
        initial = model.control.initial if model.control else ()
        carried = Carried(
            Gaussian(mean, covariance),
            np.tile(np.array(initial or (0.0,) * model.controls), (prior.runs, 1)),
            prior.stream.publish_time_ns[rows],
            np.where(np.isfinite(mean.sum(axis=1)), ALL_WELL, NOT_STARTED),
        )
        maps = {each.about.topic: each.about for each in self.stage.sensors if each.about}
        points = {topic: points_of(whole[topic], asked) for topic, asked in maps.items()}
        return State(carried, points, (), None, np.zeros(prior.runs, np.int64))

    def run(self, state: State, block: Block) -> tuple[State, list[Ragged]]:
        """Filter a block."""
        happenings = happenings_of(self.stage, self.found, block, state.points)
        tick, waiting = state.tick, None
        if self.parameters.every_s is not None:
            every_ns = round(self.parameters.every_s * 1e9)
            happenings, tick = with_ticks(happenings, state.carried.time_ns, tick, every_ns)
        if state.waiting is not None:
            happenings = joined(state.waiting, happenings)
        control = self.stage.model.control
        if control is not None and control.interpolated:
            happenings, waiting = interpolated(happenings, len(control.components))
        return self.follow(state._replace(waiting=waiting, tick=tick), happenings)

    def finish(self, state: State) -> list[Ragged]:
        """What still waits for a control that does not come any more."""
        if state.waiting is None:
            return []
        return self.follow(state, held(state.waiting, self.stage.model.controls))[1]

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Filter events."""
        model, sensors = self.stage.model, self.stage.sensors
        names = number_fields(model.parameters)
        loop, steps = _compiled(model, self.stage.motion, sensors, self.method, names)
        before, carried = state.carried, copy.deepcopy(state.carried)
        runs = len(before.time_ns)
        estimates = Estimates(*_room(happenings.is_due, happenings.offsets, model.size, model.tangent))
        slots = len(slots_of(sensors))
        noted = _room(happenings.source >= 0, happenings.offsets, slots, slots)
        innovations = Innovations(*noted, numbers=np.empty((len(noted[1]), 3)))
        if slots > min((len(sensor.measured) for sensor in sensors), default=slots):
            innovations.difference[:], innovations.covariance[:] = np.nan, np.nan
        starts = estimates.end.copy(), innovations.end.copy()
        settings = np.broadcast_to(self.settings, (runs, *self.settings.shape)).copy()
        generators = state.generators
        sampler = self.method.sampling(self.parameters) if self.method.sampling else None
        samplers = [sampler.at(each) for each in steps.sampled] if sampler else []
        if any(each.redrawn for each in samplers):
            generators = _seeded(
                generators, happenings, len(samplers), self.parameters.seed
            )
        for part, sets in _sets(samplers, generators, happenings.offsets):
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
        made = self.outputs(happenings, estimates, innovations, starts)
        made.append(
            failures_of(f"/estimates/{self.name}", before.failure, carried.failure, carried.time_ns)
        )
        return state._replace(carried=carried, generators=generators), made

    @cached_property
    def gates(self) -> Floats:
        """Bounds of the NIS (sensors, largest measurement + 1), by the number of components."""
        largest = max((len(sensor.measured) for sensor in self.stage.sensors), default=0)
        gates = np.full((max(len(self.stage.sensors), 1), largest + 1), np.inf)
        probability = self.parameters.gate_probability
        gates[:, 1:] = chi2.ppf(probability, np.arange(1, largest + 1))
        return gates

    def outputs(
        self,
        happenings: Happenings,
        estimates: Estimates,
        innovations: Innovations,
        starts: tuple[Integers, Integers],
    ) -> list[Ragged]:
        """The streams of what the recursion filled in."""
        model, sensors = self.stage.model, self.stage.sensors
        prefix = self.found.prefix
        truth = model.truth if model.truth.startswith("/") else f"{prefix}/{model.truth}"
        rows, offsets = filled_rows(np.append(starts[0], len(estimates.event)), estimates.end)
        mean = estimates.mean[rows]
        for index, kind in enumerate(model.kinds):
            if kind == "angle":
                mean[:, index] = wrap_angle(mean[:, index])
        state = make_stream(
            f"/estimates/{self.name}/{model.output}",
            schemas.GAUSSIAN_ESTIMATE,
            happenings.time_ns[estimates.event[rows]],
            metadata={**_named(model.state), "truth": truth},
            mean=mean,
            covariance=estimates.covariance[rows].reshape(len(mean), model.tangent**2),
        )
        made = [Ragged(state, offsets)]
        if not sensors:
            return made
        rows, offsets = filled_rows(np.append(starts[1], len(innovations.event)), innovations.end)
        event, slots = innovations.event[rows], slots_of(sensors)
        numbers = innovations.numbers[rows]
        stream = make_stream(
            f"/estimates/{self.name}/innovation",
            schemas.INNOVATION,
            happenings.time_ns[event],
            metadata={**_named(slots), "truth": truth},
            target_id=happenings.target_id[event],
            accepted=numbers[:, 2].astype(np.int64),
            innovation=innovations.difference[rows],
            covariance=innovations.covariance[rows].reshape(len(event), len(slots) ** 2),
            normalised_innovation_squared=numbers[:, 0],
            log_likelihood=numbers[:, 1],
        )
        return [*made, Ragged(stream, offsets)]


def _named(components: Mapping[str, str]) -> dict[str, str]:
    return {"components": ",".join(components), "kinds": ",".join(components.values())}


def _room(
    wanted: NDArray[np.bool_], offsets: Integers, size: int, spread: int
) -> tuple[Integers, Integers, Floats, Floats]:
    """Room for a row of every event that is wanted: where the runs' rows begin, and empty columns."""
    starts = ragged_rows(wanted, offsets)
    rows = int(starts[-1])
    return (
        starts[:-1].copy(),
        np.empty(rows, np.int64),
        np.empty((rows, size)),
        np.empty((rows, spread, spread)),
    )


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
    """Runs, and the samples of every function for them; the largest randomised one says how many runs."""
    drawn = [index for index, each in enumerate(samplers) if each.redrawn]
    if not drawn:
        sets = tuple(next(sets_by_runs(each, (), offsets))[1] for each in samplers)
        yield slice(0, len(offsets) - 1), sets
        return
    largest = max(drawn, key=lambda index: samplers[index].count * (samplers[index].dimension + 1))
    for part, most in sets_by_runs(samplers[largest], generators[largest], offsets):
        span = offsets[part.start : part.stop + 1]
        others = (
            most
            if index == largest
            else next(sets_by_runs(each, generators[index][part], span))[1]
            for index, each in enumerate(samplers)
        )
        yield part, tuple(others)


# Events


def happenings_of(
    stage: Stage, found: Found, block: Block, points: Mapping[str, Points]
) -> Happenings:
    """A block's messages as the recursion takes them."""
    events, control = block.events, stage.model.control
    width = max((reading(sensor).width for sensor in stage.sensors), default=0)
    start = width if control is not None and control.interpolated else 0
    width = max(width, start + stage.model.controls)
    tables, sources, targets = [], [], []
    first = 0
    if control is not None and found.control is not None:
        ragged = block.streams[found.control.name]
        table = np.full((len(ragged), width), np.nan)
        read = control.read or partial(_fields, names=control.components)
        table[:, start : start + stage.model.controls] = read(ragged.stream)
        tables.append(table)
        sources.append(np.full(len(ragged), CONTROL))
        targets.append(np.zeros(len(ragged), np.int64))
        first = 1
    for number, (sensor, topic) in enumerate(found.sensors):
        ragged = block.streams[topic.name]
        table, known, target = _table(sensor, ragged, points, width)
        tables.append(table)
        sources.append(np.where(known, number, NOTHING))
        targets.append(target)
    order = events.source
    is_node = events.is_last
    if first and not (control is not None and control.estimates) and found.sensors:
        stamp = np.cumsum(events.is_last) - events.is_last
        sensed = np.zeros(int(stamp[-1]) + 1 if len(stamp) else 0, bool)
        sensed[stamp[events.topic >= first]] = True
        is_node = events.is_last & sensed[stamp]
    return Happenings(
        events.offsets,
        events.time_ns,
        _ordered(sources, order),
        _ordered(tables, order),
        is_node,
        _ordered(targets, order),
    )


def _ordered(parts: list[Any], order: Integers) -> Any:
    """Columns of all topics laid end to end, in the order of events; a single topic is in it already."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)[order]


def _fields(stream: Stream, names: Sequence[str]) -> Floats:
    columns = [stream[name] for name in names]
    return columns[0][:, None] if len(columns) == 1 else np.stack(columns, axis=1)


def _table(
    sensor: Sensor, ragged: Ragged, points: Mapping[str, Points], width: int
) -> tuple[Floats, NDArray[np.bool_], Integers]:
    """A sensor's messages as data (n, width), which of them can be used, and what they are about."""
    m, stream = len(sensor.measured), ragged.stream
    read = sensor.read or partial(_fields, names=tuple(sensor.measured))
    measured = np.asarray(read(stream), float)
    if measured.shape != (len(stream), m):
        raise BadInput(
            f"topic {stream.topic}: the model reads {measured.shape[1:]} components of it; "
            f"{m} are measured"
        )
    if width == m:
        table = np.ascontiguousarray(measured)
    else:
        table = np.full((len(stream), width), np.nan)
        table[:, :m] = measured
    known, target, at = np.ones(len(stream), bool), np.zeros(len(stream), np.int64), m
    if sensor.about is not None:
        target = stream[sensor.about.of].astype(np.int64)
        run = np.repeat(np.arange(ragged.runs), np.diff(ragged.offsets))
        places = points[sensor.about.topic]
        rows = places.rows(run, target)
        known = rows >= 0
        if len(places.places):
            table[:, at : at + sensor.about.size] = places.places[rows]
        at += sensor.about.size
    if sensor.covariance:
        lower = np.tril_indices(m)
        table[:, at : at + len(lower[0])] = stream[sensor.covariance].reshape(-1, m, m)[:, *lower]
    return table, known, target


def joined(first: Happenings, second: Happenings) -> Happenings:
    """The events of two blocks, run by run."""
    runs = len(first.offsets) - 1
    run = np.concatenate([np.repeat(np.arange(runs), np.diff(each.offsets)) for each in (first, second)])
    order = np.argsort(run, kind="stable")
    columns = (
        np.concatenate([one, other])[order] for one, other in zip(first[1:], second[1:], strict=True)
    )
    return Happenings(first.offsets + second.offsets, *columns)


def _of_rows(happenings: Happenings, chosen: NDArray[np.bool_]) -> Happenings:
    columns = (column[chosen] for column in happenings[1:])
    return Happenings(ragged_rows(chosen, happenings.offsets), *columns)


def interpolated(happenings: Happenings, controls: int) -> tuple[Happenings, Happenings]:
    """Events with the control at their stamps, linear between messages; and those still to wait.

    What comes after a run's last control message waits for the next, with that message before it.
    """
    data, is_control = happenings.data.copy(), happenings.source == CONTROL
    ready, waiting = np.zeros(len(data), bool), np.ones(len(data), bool)
    columns = range(data.shape[1] - controls, data.shape[1])
    for begin, end in pairwise(happenings.offsets):
        at = begin + np.flatnonzero(is_control[begin:end])
        if not len(at):
            continue
        inside = slice(begin, at[-1] + 1)
        times_ns, wanted_ns = (happenings.time_ns[rows] - happenings.time_ns[begin] for rows in (at, inside))
        for column in columns:
            data[inside, column] = np.interp(wanted_ns, times_ns, data[at, column])
        ready[inside], waiting[begin : at[-1]] = True, False
    return _of_rows(happenings._replace(data=data), ready), _of_rows(happenings, waiting)


def held(happenings: Happenings, controls: int) -> Happenings:
    """Events that wait for a control message that does not come: the last one holds."""
    data = happenings.data.copy()
    for begin, end in pairwise(happenings.offsets):
        if begin < end:
            data[begin:end, -controls:] = data[begin, -controls:]
    return happenings._replace(data=data)


def with_ticks(
    happenings: Happenings, start_ns: Integers, tick: Integers, every_ns: int
) -> tuple[Happenings, Integers]:
    """Events, and between them one every so often, at which an estimate is wanted."""
    times, runs, ticks = [], [], tick.copy()
    for run, (begin, end) in enumerate(pairwise(happenings.offsets)):
        if begin == end:
            continue
        last_ns = happenings.time_ns[end - 1]
        first = max(int(tick[run]), -(-int(start_ns[run]) // every_ns))
        stop = max(int(last_ns) // every_ns + 1, first)
        wanted = np.arange(first, stop) * every_ns
        own = happenings.time_ns[begin:end][happenings.is_due[begin:end]]
        wanted = wanted[~np.isin(wanted, own)]
        ticks[run] = stop
        times.append(wanted)
        runs.append(np.full(len(wanted), run))
    if not times:
        return happenings, ticks
    time_ns, run = np.concatenate(times), np.concatenate(runs)
    count = len(time_ns)
    extra = Happenings(
        np.searchsorted(run, np.arange(len(happenings.offsets))),
        time_ns,
        np.full(count, NOTHING),
        np.full((count, happenings.data.shape[1]), np.nan),
        np.ones(count, bool),
        np.zeros(count, np.int64),
    )
    together = joined(happenings, extra)
    run = np.repeat(np.arange(len(tick)), np.diff(together.offsets))
    order = np.lexsort((together.time_ns, run))
    return Happenings(together.offsets, *(column[order] for column in together[1:])), ticks
