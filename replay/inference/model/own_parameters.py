"""Parameters of single topics, such as the lever arms of two receivers.

This is a transformation of models: a topic's sensor reads the topic's parameter in place of the general
one. An example of a name is `/gps2/fix.lever_x_m`; the parameter has the value of `lever_x_m` unless it
is set. Methods, augmented states and exported C code treat this parameter like any other.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, TypeVar, cast

import numpy as np
from pydantic import create_model

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import Parameters, build, field_of, meanings
from fuselog.replay.engine.arrays import AnyArgument, Settings
from fuselog.replay.inference.model.augmentation import OfModel
from fuselog.replay.inference.model.binding import Found
from fuselog.replay.inference.model.model import Model, Sensor
from fuselog.replay.inference.model.parameters import CombinedParameters, number_fields
from fuselog.replay.inference.model.settings import TracedParameters
from fuselog.replay.inference.model.validation import trial_state
from fuselog.replay.tracing.reads import pure

Value = TypeVar("Value")
Tables = Mapping[str, Mapping[str, object]]


def with_own_parameters(
    model: Model, found: Found, tables: Tables, parameters: Parameters
) -> tuple[Model, Found, CombinedParameters]:
    """Return a model whose topics have separate parameters; also return its topics and parameters.

    A topic gets its own parameters if parameters are set for this topic, or if several topics serve the
    same sensor.

    Args:
        model: the model.
        found: its topics.
        tables: parameters that are set for single topics, by topic and name.
        parameters: parameters that are set for all topics.
    """
    kinds = [sensor.topic for sensor, _ in found.sensors]
    own = tuple(
        (number, topic.name)
        for number, (sensor, topic) in enumerate(found.sensors)
        if topic.name in tables or kinds.count(sensor.topic) > len(_uses(model, sensor))
    )
    if not own:
        return model, found, parameters
    sensors = tuple(sensor for sensor, _ in found.sensors)
    model, sensors = _transformed(model, sensors, own)
    values = {
        field: tables.get(topic, {}).get(name, getattr(parameters, name))
        for field, (topic, name) in model.owned.items()
    }
    pairs = zip(sensors, found.sensors, strict=True)
    kind = _with_fields(type(parameters), tuple(model.owned.items()))
    given = {name: getattr(parameters, name) for name in type(parameters).model_fields}
    found = found._replace(sensors=tuple((each, topic) for each, (_, topic) in pairs))
    return model, found, kind(**given, **values)


def check_tables(label: str, model: Model, found: Sequence[Found], tables: Tables) -> None:
    """Raise BadInput if a topic in `tables` is unused or its sensor ignores a parameter given there."""
    for topic, table in tables.items():
        sensors = [sensor for each in found for sensor, own in each.sensors if own.name == topic]
        if not sensors:
            taken = dict.fromkeys(own.name for each in found for _, own in each.sensors)
            raise BadInput(
                f"estimator {label}: parameters are set for {topic}, but no sensor uses this topic; "
                f"{choices(topic, taken)}; --set topics.KIND=TOPIC,TOPIC uses several of a kind"
            )
        known = dict.fromkeys(name for sensor in sensors for name in read_by(model, sensor))
        for name in table:
            if name not in known:
                raise BadInput(
                    f"estimator {label}: {topic}.{name}: its sensor has no such parameter; "
                    f"{choices(name, known)}"
                )
        build(model.parameters, table, f"estimator {label}: {topic}")


@lru_cache(maxsize=256)
def read_by(model: Model, sensor: Sensor) -> tuple[str, ...]:
    """List the parameters that a sensor reads, but the motion does not."""
    names, state = number_fields(model.parameters), trial_state(model.kinds)
    read, moving = (TracedParameters(dict.fromkeys(names)) for _ in range(2))
    with np.errstate(all="ignore"):
        entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
        sensor.measure(state, *entering, (1.0,) * sensor.reference_size, read)
        if sensor.noise is not None:
            sensor.noise(read)
        for motion in (model.motion, *(model.modes or {}).values()):
            entering = ((0.0,) * motion.noises,) if motion.noises else ()
            motion.move(state, (0.0,) * model.controls, *entering, 1.0, moving)
    own = (read.read | {sensor.delay}) - moving.read
    return tuple(name for name in names if name in own)


def _uses(model: Model, sensor: Sensor) -> list[Sensor]:
    """List the model's sensors that read the same kind of topic as this sensor."""
    return [each for each in model.all_sensors if each.topic == sensor.topic]


@lru_cache(maxsize=64)
def _transformed(
    model: Model, sensors: tuple[Sensor, ...], own: tuple[tuple[int, str], ...]
) -> tuple[Model, tuple[Sensor, ...]]:
    """Make the sensors at these indices read the parameters of their topics.

    Raises BadInput if the names of two topics differ only in punctuation.
    """
    names = {number: _fields_of(topic, read_by(model, sensors[number])) for number, topic in own}
    owned: dict[str, tuple[str, str]] = {}
    for number, topic in own:
        for name, field in names[number].items():
            if owned.setdefault(field, (topic, name)) != (topic, name):
                raise BadInput(
                    f"the parameters of {topic} and {owned[field][0]} would have the same names; rename "
                    "one of the topics with fuselog relabel"
                )
    made = replace(
        model,
        parameters=_with_fields(model.parameters, tuple(owned.items())),
        augmentable=_with_owned(model.augmentable, owned),
        calibration=_with_owned(model.calibration, owned),
        owned=owned,
    )
    changed = [
        _sensor(sensor, names[number]) if number in names else sensor
        for number, sensor in enumerate(sensors)
    ]
    return made, tuple(changed)


def _fields_of(topic: str, names: Iterable[str]) -> dict[str, str]:
    return {name: field_of(f"{topic}.{name}") for name in names}


def _with_owned(given: Mapping[str, Value], owned: Mapping[str, tuple[str, str]]) -> dict[str, Value]:
    return {**given, **{field: given[name] for field, (_, name) in owned.items() if name in given}}


@lru_cache(maxsize=64)
def _with_fields(
    parameters: type[Parameters], owned: tuple[tuple[str, tuple[str, str]], ...]
) -> type[CombinedParameters]:
    """Add the topics' own parameters to a parameter type, with the bounds of the general parameters."""
    said, fields, lines = meanings(parameters), dict[str, AnyArgument](), list[str]()
    for field, (topic, name) in owned:
        entry = parameters.model_fields[name]
        bounds: AnyArgument = (
            Annotated[(entry.annotation, *entry.metadata)] if entry.metadata else entry.annotation
        )
        fields[field] = bounds | None, None
        lines.append(f"    {field}: {said.get(name, name).rstrip('.')}; of {topic}.")
    doc = "\n".join(["Parameters of single topics.", "", "Attributes:", *lines])
    made = create_model(f"{parameters.__name__}OfTopics", __base__=parameters, __doc__=doc, **fields)
    made.OWNED = dict(owned)  # type: ignore[attr-defined]
    return made


def _sensor(sensor: Sensor, fields: Mapping[str, str]) -> Sensor:
    """Return the sensor with its functions changed to read the topic's own parameters."""

    def reading(function: OfModel | None, place: int = -1) -> OfModel | None:
        return function and _reading(function, place, fields)

    return replace(
        sensor,
        measure=_reading(sensor.measure, -1, fields),
        noise=reading(sensor.noise),
        log_likelihood=reading(sensor.log_likelihood),
        jacobian=reading(sensor.jacobian, 2),
        moments=reading(sensor.moments, 3),
        delay=fields.get(sensor.delay, sensor.delay),
        stated={fields.get(name, name): read for name, read in sensor.stated.items()},
    )


@pure
class _Own:
    """Parameters, some of which are replaced by a topic's own parameters."""

    def __init__(self, parameters: Settings, fields: tuple[tuple[str, str], ...]) -> None:
        self._parameters, self._fields = parameters, dict(fields)

    def __getattr__(self, name: str) -> float:
        value: float = getattr(self._parameters, self._fields.get(name, name))
        return value


def _reading(function: OfModel, place: int, fields: Mapping[str, str]) -> OfModel:
    """Wrap a function so that the parameters, its argument number `place`, become those of a topic.

    The wrapper counts as unchanged as long as the wrapped function is unchanged; see
    `fuselog.replay.tracing.reads`.
    """
    pairs = tuple(fields.items())

    def read(*arguments: AnyArgument) -> object:
        given = list(arguments)
        given[place] = _Own(given[place], pairs)
        return function(*given)

    return cast(OfModel, read)
