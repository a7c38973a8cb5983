"""Where a log has what a model needs: its topics, and the numbers that their channels state.

One binding for all models: the topics of a model are looked for under every prefix that has its prior,
as `/robot1/odometry` beside `/robot1/prior`; what is absent of its sensors is left out.
"""

from collections import namedtuple
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from recorders.log import Schema, Topic, schemas
from recorders.parameters import Parameters
from replay.engine.arrays import Floats, Function
from replay.engine.channels import resolved, stated
from replay.engine.geodetic import GEODETIC
from replay.engine.results import named
from replay.inference.generate import function_of
from replay.inference.model import (
    Control,
    Model,
    ModelParameters,
    Sensor,
    check_correct,
    check_motion,
    check_sensor,
    check_state,
    check_switching,
    switching_of,
)
from replay.inference.steps import Stage


class Found(NamedTuple):
    """Where a log has what a model needs.

    Attributes:
        prefix: of the thing's topics.
        prior: of a log without one, where it would be.
        truth: the topic that estimates are compared with.
        control: what drives the motion.
        sensors: those that the log has.
        has_prior: whether the log does; else see `replay.inference.opening`.
        instead: topics that take the place of some components of the control.
        origin: latitude, longitude (deg) and altitude (m) of the plane's origin (3,), where stated.
    """

    prefix: str
    prior: Topic
    truth: str
    control: Topic | None
    sensors: tuple[tuple[Sensor, Topic], ...]
    has_prior: bool = True
    instead: tuple[tuple[Control, Topic], ...] = ()
    origin: Floats | None = None

    @property
    def geodetic(self) -> tuple[Topic, ...]:
        """The topics of fixes that are latitude and longitude."""
        return tuple(topic for _, topic in self.sensors if topic.schema_name == GEODETIC)


def roles_of(model: Model) -> list[str]:
    """The topics that a model asks for, by the names that it has for them."""
    control = [model.control, *model.control.instead] if model.control else []
    maps = [each.topic for sensor in model.all_sensors for each in sensor.maps]
    sensors = [sensor.topic for sensor in model.all_sensors]
    drives = [each.topic for each in control]
    return list(dict.fromkeys([model.prior, model.truth, *drives, *maps, *sensors]))


class _Here(NamedTuple):
    """The topics under one prefix of a log; `names` says which of them stand for others."""

    topics: Mapping[str, Topic]
    prefix: str
    names: Mapping[str, str]

    def place(self, name: str) -> str:
        """A topic's full name."""
        return resolved(self.names.get(name, name), self.prefix)

    def topic(self, name: str, schema: Schema) -> Topic | None:
        """The topic of this name, if it has messages of the schema or such as serve for it."""
        found = self.topics.get(self.place(name))
        return found if found is not None and found.schema_name in serving(schema) else None

    def has(self, name: str) -> bool:
        """Whether there is a topic of this name, whatever it is."""
        return self.place(name) in self.topics


def serving(schema: Schema) -> tuple[str, ...]:
    """The schemas, by their full names, whose messages a sensor of this schema takes."""
    geodetic = (GEODETIC,) if schema is schemas.POSITION_FIX else ()
    return (schema.full_name, *geodetic)


def topics_of(
    model: Model, topics: Mapping[str, Topic], names: Mapping[str, str] | None = None
) -> list[Found]:
    """Everything in a log that is of this model; `names` are topics by the model's names for them."""
    names = names or {}
    begins = [model.prior]
    if model.start is not None:
        begins += [model.control.topic] if model.control else [each.topic for each in model.all_sensors]
    ends = [f"/{names.get(name, name).removeprefix('/')}" for name in begins]
    prefixes = dict.fromkeys(
        topic.removesuffix(end) for end in ends for topic in topics if topic.endswith(end)
    )
    found = (_found(model, _Here(topics, prefix, names)) for prefix in prefixes)
    return [each for each in found if each is not None]


def _found(model: Model, here: _Here) -> Found | None:
    """What there is of a model under one prefix; None where it does not fit.

    A log without the prior fits a model that can start without, if a sensor measures the state itself.
    One without sensors does if it has nothing of them: no sightings whose map is missing, say.
    """
    prior = here.topic(model.prior, schemas.GAUSSIAN_ESTIMATE)
    has_prior = prior is not None
    if not has_prior and (model.start is None or here.has(model.prior)):
        return None
    if prior is None:
        name = schemas.GAUSSIAN_ESTIMATE.full_name
        prior = Topic(here.place(model.prior), name, "protobuf", (), named(model.state), 0)
    control = here.topic(model.control.topic, model.control.schema) if model.control else None
    if model.control is not None and control is None:
        return None
    sensors = tuple(
        (sensor, topic)
        for sensor in model.all_sensors
        if (topic := here.topic(sensor.topic, sensor.schema)) is not None
        and topic.metadata.get("system", model.system) == model.system
        and all(here.topic(each.topic, each.schema) is not None for each in sensor.maps)
    )
    parts = {each.topic for each in model.all_sensors}
    parts |= {of.topic for each in model.all_sensors for of in each.maps}
    is_alone = (
        model.start is not None
        and not model.finds_start
        and control is not None
        and not any(map(here.has, parts))
    )
    if not sensors and model.needs_sensor and not is_alone:
        return None
    tells = model.finds_start or any(measures_state(model, sensor) for sensor, _ in sensors)
    if not has_prior and sensors and not tells:
        return None
    instead = tuple(
        (each, topic)
        for each in (model.control.instead if model.control else ())
        if (topic := here.topic(each.topic, each.schema)) is not None
    )
    truth = here.place(model.truth)
    return Found(here.prefix, prior, truth, control, sensors, has_prior, instead)


def measures_state(model: Model, sensor: Sensor) -> bool:
    """Whether a sensor measures components of the state by their names, with their covariance."""
    return bool(sensor.covariance) and sensor.measured.items() <= model.state.items()


def needs_of(model: Model) -> str:
    """What a log has to have for a model, in words; of one that can start without, what it may have."""
    words = [part.words for part in parts_of(model, _Here({}, "...", {}))]
    if model.start is None or model.control is None or not model.needs_sensor:
        return "; ".join(words)
    control, *maps, sensors = words
    of_maps = [f"those about a map need {each}" for each in maps]
    return "; ".join([control, sensors.replace("one of", "any of", 1), *of_maps])


def nearest(models: Mapping[str, Model], topics: Mapping[str, Topic]) -> str:
    """Which of the models comes nearest to fitting a log, and what the log lacks for it."""
    tried = [(name, nearest_parts(model, topics)) for name, model in models.items()]
    name, parts = max(tried, key=lambda one: _fit(one[1]))
    if not any(part.is_here for part in parts):
        return f"it has nothing that {' or '.join(models)} needs"
    missing = "; ".join(part.words for part in parts if not part.is_here)
    return f"model {name} comes nearest and lacks {missing}"


def elsewhere(models: Mapping[str, Model], topics: Mapping[str, Topic], names: Mapping[str, str]) -> str:
    """Which model the log's prior is of, where only its control has another name; empty where none is.

    As with several inertial units, of which one has to be chosen.
    """
    for name, model in models.items():
        control = model.control
        if control is None or control.topic in names:
            continue
        others = [
            each for each, topic in topics.items() if topic.schema_name == control.schema.full_name
        ]
        end = f"/{names.get(model.prior, model.prior)}"
        priors = [each for each in topics if each.endswith(end)]
        for prior in priors:
            place = resolved(control.topic, prior.rpartition("/")[0])
            if others and place not in topics and names_state(topics[prior], model, exactly=True):
                return (
                    f"{prior} is of model {name}, which needs {place} ({control.schema.full_name}); the "
                    f"log has {', '.join(others)} of that type: choose one, as with "
                    f"--set topics.{control.topic}={others[0]}"
                )
    return ""


def nearest_parts(model: Model, topics: Mapping[str, Topic]) -> list["Part"]:
    """What a model needs, under the prefix of a log that has most of it."""
    prefixes = dict.fromkeys(["...", *(topic.rpartition("/")[0] for topic in topics)])
    return max((parts_of(model, _Here(topics, each, {})) for each in prefixes), key=_fit)


def _fit(parts: Sequence["Part"]) -> int:
    return sum(1 if part.is_here else -1 for part in parts)


class Part(NamedTuple):
    """Something that a model needs, and whether a log has it."""

    words: str
    is_here: bool


def parts_of(model: Model, here: _Here) -> list[Part]:
    """All that a model needs under one prefix."""

    def part(name: str, schema: Schema, system: str = "") -> Part:
        place, known = here.place(name), here.topics.get(here.place(name))
        words = f"{place} ({schema.full_name}"
        words += f" of system {system})" if system else ")"
        if known is not None and known.schema_name not in serving(schema):
            return Part(f"{words}, which is {known.schema_name} here", is_here=False)
        is_of = known is not None and known.metadata.get("system", system) == system
        return Part(words, is_here=is_of)

    parts = []
    sensing = [sensor for sensor in model.all_sensors if here.has(sensor.topic)]
    starts = not sensing or model.finds_start or any(measures_state(model, each) for each in sensing)
    if model.start is None or here.has(model.prior) or not starts:
        words, is_here = part(model.prior, schemas.GAUSSIAN_ESTIMATE)
        if is_here:
            is_here = names_state(here.topics[here.place(model.prior)], model)
        parts.append(Part(f"{words} of {', '.join(model.state)}", is_here))
    if model.control is not None:
        parts.append(part(model.control.topic, model.control.schema))
    seeing = [sensor for sensor in model.sensors if not here.topics or here.has(sensor.topic)]
    maps = {each.topic: each for sensor in seeing for each in sensor.maps}
    parts += [part(topic, each.schema) for topic, each in maps.items()]
    sensors = [part(each.topic, each.schema, model.system) for each in model.all_sensors]
    if sensors and model.needs_sensor:
        own = len(model.sensors)
        words = ("one of " if own > 1 else "") + ", ".join(each.words for each in sensors[:own])
        words = ", or ".join([words, *(each.words for each in sensors[own:])])
        parts.append(Part(words, any(each.is_here for each in sensors)))
    return parts


def names_state(prior: Topic, model: Model, *, exactly: bool = False) -> bool:
    """Whether a prior's channel names all components of a model's state, and no others if `exactly`."""
    named = set(prior.metadata.get("components", "").split(","))
    return named == set(model.state) if exactly else named >= set(model.state)


@cache
def number_fields(parameters: type[Parameters]) -> tuple[str, ...]:
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
    return namedtuple("Settings", names)


@lru_cache(maxsize=64)
def reading_settings(names: tuple[str, ...]) -> Function:
    """`read(settings, row)`: a row of numbers as the NamedTuple."""
    entries = ", ".join(f"settings[row, {index}]" for index in range(len(names)))
    text = f"def read(settings, row):\n    return Settings({entries})\n"
    return function_of(text, Settings=settings_type(names))


def trial_parameters(model: Model) -> Any:
    """Parameters to try functions with: every number is one."""
    names = number_fields(model.parameters)
    return settings_type(names)(*(1.0,) * len(names))


class Recorder:
    """Parameters that remember in `read` which of them were; what is unset reads as one."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self.read: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        if name not in self._values:
            raise AttributeError(f"no parameter '{name}'; the model has {', '.join(self._values)}")
        self.read.add(name)
        value = self._values[name]
        return np.float64(
            1.0 if value is None else value
        )  # overflows to infinity, as compiled code does


def settings_of(label: str, stage: Stage, found: Found, parameters: ModelParameters) -> Floats:
    """The numbers (1 + sensors, fields) that motion and sensors get: given, or as channels state them.

    What is not given is looked for in the channels of the control, the prior and the sensors; a sensor
    looks in its own first. Raises BadInput where none states a number that is used, or one that the
    parameter does not allow, and where the model is not what it says.
    """
    model = stage.model
    names = number_fields(model.parameters)
    given = {name: getattr(parameters, name) for name in names}
    everything = _speaking(found)
    assumed = assumed_of(label, stage, found, parameters)
    given |= {name: number for name, number in assumed.items() if given[name] is None}
    needed = _needed(f"estimator {label}", stage, tuple(given.items()))
    own = [[], *([topic] for _, topic in found.sensors)]
    settings = np.array(
        [
            [
                stated([*first, *everything], name, model.parameters, needed=False)
                if given[name] is None
                else float(given[name])
                for name in names
            ]
            for first in own
        ]
    )
    lacking = [
        (row, name)
        for row, read in enumerate(needed)
        for column, name in enumerate(names)
        if name in read and np.isnan(settings[row, column])
    ]
    if lacking:
        row, _ = lacking[0]
        missing = list(dict.fromkeys(name for _, name in lacking))
        usual = model.start.parameters if model.start is not None else {}
        better = ", or numbers that you know better" if usual else ""
        mend = " ".join(f"--set {name}={usual.get(name, '...')}" for name in missing)
        raise BadInput(
            f"topic {[*own[row], *everything][0].name} does not state {', '.join(missing)}; give "
            f"{'it' if len(missing) == 1 else 'them'} with {mend}{better}"
        )
    if stage.modes:
        switching_of(f"estimator {label}", model, reading_settings(names)(settings, 0))
    return settings


def _speaking(found: Found) -> list[Topic]:
    """The topics whose channels state numbers, in the order in which they are asked."""
    control = [] if found.control is None else [found.control]
    instead, sensors = ([topic for _, topic in each] for each in (found.instead, found.sensors))
    return [*instead, *control, found.prior, *sensors]


def assumed_of(label: str, stage: Stage, found: Found, parameters: ModelParameters) -> dict[str, float]:
    """The parameters that are used, and assumed since a log without a prior does not state them."""
    start = stage.model.start
    if found.has_prior or start is None:
        return {}
    names = number_fields(stage.model.parameters)
    given = {name: getattr(parameters, name) for name in names}
    read = set().union(*_needed(f"estimator {label}", stage, tuple(given.items())))
    stating = _speaking(found)
    return {
        name: number
        for name, number in start.parameters.items()
        if name in read and given[name] is None and not any(name in each.metadata for each in stating)
    }


@lru_cache(maxsize=64)
def _needed(where: str, stage: Stage, given: tuple[tuple[str, Any], ...]) -> tuple[set[str], ...]:
    """The parameters that motion and sensors read; BadInput where the model is not what it says."""
    model, values = stage.model, dict(given)
    check_state(where, model)
    check_correct(where, model)
    motion, *sensors = recorders = [Recorder(values) for _ in range(1 + len(stage.sensors))]
    for each in stage.modes or (stage.motion,):
        check_motion(where, model, each, motion)
    if stage.modes:
        check_switching(where, model, motion)
    for sensor, recorder in zip(stage.sensors, sensors, strict=True):
        check_sensor(where, model, sensor, recorder)
    return tuple(each.read for each in recorders)


def complaint_of(model: Model, sensor: Sensor, topic: str) -> str:
    """Why a message was not used, and what would help; "" where no covariance can be missing."""
    if not sensor.covariance:
        return ""
    recorder = Recorder(dict.fromkeys(number_fields(model.parameters)))
    if sensor.noise is not None:
        sensor.noise(recorder)
    mend = "".join(f"; give --set {name}=..." for name in sorted(recorder.read))
    what = sensor.covariance if isinstance(sensor.covariance, str) else "its covariance"
    return f"topic {topic}: {what} is missing{mend}"
