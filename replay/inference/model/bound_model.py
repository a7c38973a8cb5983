"""Bound models: models with traced functions of their motion and of the sensors in a log."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar, cast

from fuselog.recorders.registry import available
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.tracing.functions import Argument, Shape, traced

Part = TypeVar("Part")


class BoundModel(NamedTuple):
    """Model with one motion and the sensors that are in the log.

    `modes` are the motions of all modes in order, for a method that uses all of them. Use
    `bound_model_of` to make a bound model with traced functions.
    """

    model: Model
    motion: Motion
    sensors: tuple[Sensor, ...]
    modes: tuple[Motion, ...] = ()


def bound_model_of(
    model: Model,
    motion: Motion,
    sensors: Sequence[Sensor] = (),
    modes: Sequence[Motion] = (),
    names: tuple[str, ...] | None = None,
) -> BoundModel:
    """Make a bound model of a motion, some sensors and optionally all modes, with traced functions.

    `names` are the parameters that functions may read, by default the model's. Equal parts are the same
    objects in every call.

    Raises BadInput if a function cannot be traced.
    """
    names = number_fields(model.parameters) if names is None else names
    return BoundModel(
        traced_model(model, names),
        traced_motion(model, motion, names),
        tuple(traced_sensor(model, sensor, names) for sensor in sensors),
        tuple(traced_motion(model, mode, names) for mode in modes),
    )


def title_of(model: Model, summary: str) -> str:
    """Return the name of a method's kernel, for messages while the kernel is compiled.

    The model's registered name is used if its module is already loaded; nothing is imported.

    Args:
        model: the model.
        summary: summary of the method.
    """
    found = (
        (name, getattr(sys.modules.get(entry.module), entry.attr, None))
        for name, entry in available("models").items()
    )
    named = [name for name, known in found if getattr(known, "summary", None) == model.summary]
    return f"the {summary.partition(';')[0]} of {named[0] if named else model.summary}"


def traced_motion(model: Model, motion: Motion, names: tuple[str, ...]) -> Motion:
    """Return the motion with traced functions."""
    n, t, controls = model.size, model.tangent, model.controls
    entering = (motion.noises,) if motion.noises else ()
    driven = (controls, None, names)
    return _with_traced(
        motion,
        move=(n, controls, *entering, None, names),
        noise=(n, None, names),
        control_noise=(None, names),
        gap_noise=(n, None, names),
        jacobians=(n, *driven, Shape((t, t)), Shape((t, controls))),
        moments=(Shape((n,)), Shape((t, t)), *driven),
    )


def traced_sensor(model: Model, sensor: Sensor, names: tuple[str, ...]) -> Sensor:
    """Return the sensor with traced functions."""
    n, t, m, reference = model.size, model.tangent, len(sensor.measured), sensor.reference_size
    entering = (sensor.noises,) if sensor.noises else ()
    filled = (Shape((m,)), Shape((m, m)), Shape((t, m)))
    return _with_traced(
        sensor,
        measure=(n, *entering, reference, names),
        noise=(names,),
        jacobian=(n, reference, names, Shape((m, t))),
        moments=(Shape((n,)), Shape((t, t)), reference, names, *filled),
        log_likelihood=(n, m, reference, names),
    )


def traced_model(model: Model, names: tuple[str, ...]) -> Model:
    """Return the model with traced switching; motion and sensors are not changed."""
    if model.switching is None:
        return model
    switching = _with_traced(model.switching, rates=(names,))
    return model if switching is model.switching else _same_again(model, switching=switching)


def _with_traced(part: Part, **arguments: tuple[Argument, ...]) -> Part:
    functions = {name: getattr(part, name) for name in arguments}
    made = {name: traced(each, *arguments[name]) for name, each in functions.items()}
    changed = {name: each for name, each in made.items() if each is not functions[name]}
    return _same_again(part, **changed) if changed else part


_KNOWN: dict[tuple[object, ...], tuple[object, object]] = {}


def _same_again(part: Part, **changes: object) -> Part:
    """Return a motion, sensor or model with these changes; repeated calls return the same object."""
    key = id(part), *((name, id(each)) for name, each in changes.items())
    known = _KNOWN.get(key)
    if known is None:
        known = _KNOWN[key] = part, replace(part, **changes)  # type: ignore[type-var]
    return cast(Part, known[1])
