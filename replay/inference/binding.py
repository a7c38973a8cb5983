"""Where a log has what a model needs: its topics, and the numbers that their channels state.

One binding for all models: the topics of a model are looked for under every prefix that has its prior,
as `/robot1/odometry` beside `/robot1/prior`; what is absent of its sensors is left out.
"""

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log import Schema, Topic, schemas
from recorders.parameters import ParametersType, build
from replay.inference.generate import function_of
from replay.inference.model import (
    Model,
    ModelParameters,
    Sensor,
    check_motion,
    check_sensor,
    check_state,
)
from replay.inference.steps import Stage

Floats = NDArray[np.float64]
Function = Callable[..., Any]


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
    where = f"estimator {label}"
    check_state(where, model)
    recorders = [_Recorder(given) for _ in range(1 + len(found.sensors))]
    check_motion(where, model, stage.motion, recorders[0])
    for (sensor, _), recorder in zip(found.sensors, recorders[1:], strict=True):
        check_sensor(where, model, sensor, recorder)
    own = [[], *([topic] for _, topic in found.sensors)]
    return np.array(
        [
            [
                stated(model.parameters, [*first, *everything], name, needed=name in recorder.read)
                if given[name] is None
                else float(given[name])
                for name in names
            ]
            for first, recorder in zip(own, recorders, strict=True)
        ]
    )


def stated(
    parameters: type[ParametersType], topics: Sequence[Topic], name: str, *, needed: bool = True
) -> float:
    """The first number that one of the channels states for a parameter; NaN where none needs to.

    Raises BadInput where none states it though it is needed, or the parameter does not take it.
    """
    for topic in topics:
        if name in topic.metadata:
            text = topic.metadata[name]
            try:
                value = float(text)
            except ValueError:
                raise BadInput(
                    f"topic {topic.name} states {name} = {text}, which is no number"
                ) from None
            build(parameters, {name: value}, f"topic {topic.name}")
            return value
    if needed:
        raise BadInput(f"topic {topics[0].name} does not state {name}; give it with --set {name}=...")
    return np.nan
