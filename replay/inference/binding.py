"""Where a log has what a model needs: its topics, and the numbers that their channels state.

One binding for all models: the topics of a model are looked for under every prefix that has its prior,
as `/robot1/odometry` beside `/robot1/prior`; what is absent of its sensors is left out.
"""

from collections import namedtuple
from collections.abc import Mapping
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from recorders.log import Schema, Topic, schemas
from replay.engine.arrays import Floats, Function
from replay.engine.channels import bindings, stated
from replay.inference.generate import function_of
from replay.inference.model import (
    Model,
    ModelParameters,
    Sensor,
    check_motion,
    check_sensor,
    check_state,
    check_switching,
    switching_of,
)
from replay.inference.steps import Stage


class Found(NamedTuple):
    """Where a log has what a model needs: the prefix, and the topics of prior, control and sensors."""

    prefix: str
    prior: Topic
    control: Topic | None
    sensors: tuple[tuple[Sensor, Topic], ...]


def topics_of(model: Model, topics: Mapping[str, Topic]) -> list[Found]:
    """Everything in a log that is of this model."""
    needed = {model.prior: schemas.GAUSSIAN_ESTIMATE}
    if model.control is not None:
        needed[model.control.topic] = model.control.schema
    senses = {sensor.topic: sensor.schema for sensor in model.sensors}
    maps = {sensor.about.topic: sensor.about.schema for sensor in model.sensors if sensor.about}
    found = []
    for prefix, here in bindings(topics, {**needed, **senses, **maps}, [*senses, *maps]):
        sensors = tuple(
            (sensor, here[sensor.topic])
            for sensor in model.sensors
            if sensor.topic in here
            and here[sensor.topic].metadata.get("system", model.system) == model.system
            and (sensor.about is None or sensor.about.topic in here)
        )
        if sensors or not model.needs_sensor:
            control = here[model.control.topic] if model.control is not None else None
            found.append(Found(prefix, here[model.prior], control, sensors))
    return found


def needs_of(model: Model) -> str:
    """What a log has to have for a model, in words."""
    return "; ".join(part.words for part in _parts(model, {}, "..."))


def nearest(models: Mapping[str, Model], topics: Mapping[str, Topic]) -> str:
    """Which of the models comes nearest to fitting a log, and what the log lacks for it."""
    prefixes = dict.fromkeys(["...", *(topic.rpartition("/")[0] for topic in topics)])
    tried = [(name, _parts(model, topics, each)) for name, model in models.items() for each in prefixes]
    name, parts = max(tried, key=lambda one: sum(1 if part.is_here else -1 for part in one[1]))
    if not any(part.is_here for part in parts):
        return f"it has nothing that {' or '.join(models)} needs"
    missing = "; ".join(part.words for part in parts if not part.is_here)
    return f"model {name} comes nearest and lacks {missing}"


class _Part(NamedTuple):
    """Something that a model needs, and whether a log has it."""

    words: str
    is_here: bool


def _parts(model: Model, topics: Mapping[str, Topic], prefix: str) -> list[_Part]:
    """All that a model needs under one prefix."""

    def part(name: str, schema: Schema, system: str = "") -> _Part:
        place = name if name.startswith("/") else f"{prefix}/{name}"
        found = topics.get(place)
        if found is not None and found.schema_name != schema.full_name:
            found = None
        words = f"{place} ({schema.full_name}"
        words += f" of system {system})" if system else ")"
        if place in topics and found is None:
            words += f", which is {topics[place].schema_name} here"
        return _Part(words, found is not None and found.metadata.get("system", system) == system)

    words, is_here = part(model.prior, schemas.GAUSSIAN_ESTIMATE)
    if is_here:
        is_here = names_state(topics[f"{prefix}/{model.prior}"], model)
    parts = [_Part(f"{words} of {', '.join(model.state)}", is_here)]
    if model.control is not None:
        parts.append(part(model.control.topic, model.control.schema))
    maps = {sensor.about.topic: sensor.about for sensor in model.sensors if sensor.about}
    parts += [part(topic, each.schema) for topic, each in maps.items()]
    sensors = [part(each.topic, each.schema, model.system) for each in model.sensors]
    if sensors and model.needs_sensor:
        words = ("one of " if len(sensors) > 1 else "") + ", ".join(each.words for each in sensors)
        parts.append(_Part(words, any(each.is_here for each in sensors)))
    return parts


def names_state(prior: Topic, model: Model) -> bool:
    """Whether a prior's channel names all components of a model's state."""
    return set(model.state) <= set(prior.metadata.get("components", "").split(","))


@cache
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
    everything = [topic for topic in (found.control, found.prior) if topic is not None]
    everything += [topic for _, topic in found.sensors]
    needed = _needed(f"estimator {label}", stage, tuple(given.items()))
    own = [[], *([topic] for _, topic in found.sensors)]
    settings = np.array(
        [
            [
                stated([*first, *everything], name, model.parameters, needed=name in read)
                if given[name] is None
                else float(given[name])
                for name in names
            ]
            for first, read in zip(own, needed, strict=True)
        ]
    )
    if stage.modes:
        switching_of(f"estimator {label}", model, reading_settings(names)(settings, 0))
    return settings


@lru_cache(maxsize=64)
def _needed(where: str, stage: Stage, given: tuple[tuple[str, Any], ...]) -> tuple[set[str], ...]:
    """The parameters that motion and sensors read; BadInput where the model is not what it says."""
    model, values = stage.model, dict(given)
    check_state(where, model)
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
    return f"topic {topic}: {sensor.covariance} is missing{mend}"
