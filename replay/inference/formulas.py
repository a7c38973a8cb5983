"""Formulas of the functions of a model and their derivatives, with the names of its components."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fuselog.recorders.registry import load
from fuselog.replay.engine.arrays import AnyArgument
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.inference.model.bound_model import bound_model_of
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.tracing.formulas import formulas_of
from fuselog.replay.tracing.functions import Argument, Shape, TracedFunction

Names = Sequence[str]
# Names of the entries of each argument: entries of a tuple, or rows and columns of an array. Numbers and
# parameters need no names.
Given = Mapping[str, Names | tuple[Names, ...] | None]
DIFFERENTIATED = ("state", "control", "noise")


def formulas(model: str | Model) -> str:
    """Return the functions of a model and their derivatives as readable text.

    The components after a step of the motion are called next_...; an expression that a function uses
    more than once is on a line of its own (v1, v2, ...). Derivatives that are not listed are zero.
    Derivatives are with respect to the stored components, even for orientations; the methods convert
    them to the tangent space.

    Args:
        model: name of a registered model (see `models`), or a model.

    Returns:
        The text, one paragraph per function.

    Raises BadInput if the name is unknown or a function cannot be traced.

    >>> print(formulas("robot").partition("v3")[0].strip())
    motion, move:
      v1 = turn_scale * turn_radps + turn_bias_radps
      v2 = 0.5 * v1 * duration_s
    """
    return "\n\n".join(
        "\n".join([f"{function}:", *(f"  {line}" for line in lines)])
        for function, lines in formulas_by_function(model).items()
    )


def formulas_by_function(model: str | Model) -> dict[str, list[str]]:
    """Return the lines of `formulas` for each function, by titles such as "motion, move"."""
    found = load("models", model, Model) if isinstance(model, str) else model
    motions = found.modes or {"": found.motion}
    bound_model = bound_model_of(found, found.motion, found.all_sensors, tuple(motions.values()))
    parts = [
        (f"mode {name}" if name else "motion", _of_motion(found, motion))
        for name, motion in zip(motions, bound_model.modes, strict=True)
    ]
    parts += [
        (f"sensor {each.topic} ({', '.join(each.measured)})", _of_sensor(found, each))
        for each in bound_model.sensors
    ]
    if bound_model.model.switching is not None:
        changes = [f"rate of {a} to {b}" for a in motions for b in motions if a != b]
        rates = _lines(bound_model.model.switching.rates, {"parameters": None}, changes)
        parts.append(("switching", iter([("rates", rates)])))
    return {f"{part}, {function}": lines for part, made in parts for function, lines in made if lines}


def _of_motion(model: Model, motion: Motion) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the lines of each function of a motion; missing functions have no lines."""
    state, axes = list(model.state), _axes(model)
    control = model.control.components if model.control else ()
    noise = [f"noise{number}" for number in range(1, motion.noises + 1)]
    end: Given = {"duration_s": None, "parameters": None}
    entering = {"noise": noise} if noise else {}
    driven: Given = {"control": control, **end}
    following = [f"next_{each}" for each in state]
    yield "move", _lines(motion.move, {"state": state, "control": control, **entering, **end}, following)
    spread = [f"variance of {each}" for each in noise] or _spread(axes, motion.noise_block)
    yield "noise", _lines(motion.noise, {"state": state, **end}, spread, [])
    yield "control_noise", _lines(motion.control_noise, end, _spread(control), [])
    yield "gap_noise", _lines(motion.gap_noise, {"state": state, **end}, _spread(axes), [])
    by_hand: Given = {"by_state": (axes, axes), "by_control": (axes, control)}
    yield "jacobians", _lines(motion.jacobians, {"state": state, **driven, **by_hand})
    gaussian: Given = {"mean": (state,), "covariance": (axes, axes)}
    yield "moments", _lines(motion.moments, {**gaussian, **driven})


def _of_sensor(model: Model, sensor: Sensor) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the lines of each function of a sensor."""
    state, axes, measured = list(model.state), _axes(model), list(sensor.measured)
    noise = [f"noise{number}" for number in range(1, sensor.noises + 1)]
    entering = {"noise": noise} if noise else {}
    reference: Given = {"reference": reference_names(sensor), "parameters": None}
    names = [f"measured_{each}" if each in model.state else each for each in measured]
    yield "measure", _lines(sensor.measure, {"state": state, **entering, **reference}, names)
    spread = [f"variance of {each}" for each in noise] or _spread(measured)
    yield "noise", _lines(sensor.noise, {"parameters": None}, spread)
    yield (
        "jacobian",
        _lines(sensor.jacobian, {"state": state, **reference, "by_state": (measured, axes)}),
    )
    gaussian: Given = {"mean": (state,), "covariance": (axes, axes)}
    filled: Given = {
        "predicted": (measured,),
        "spread": (measured, measured),
        "cross": (axes, measured),
    }
    yield "moments", _lines(sensor.moments, {**gaussian, **reference, **filled})
    values = [f"measured_{each}" for each in measured]
    given: Given = {"state": state, "measured": values, **reference}
    yield "log_likelihood", _lines(sensor.log_likelihood, given, ["log_likelihood"])


def _axes(model: Model) -> list[str]:
    """Return the names of the components of the tangent space."""
    return [name for name, _ in tangent_components(list(model.state), model.kinds)]


def reference_names(sensor: Sensor) -> list[str]:
    """Return the names of the entries of `reference`; see `Sensor.reference_size`."""
    names = [f"{_topic(each.topic)}_{name}" for each in sensor.maps for name in each.components]
    names += sensor.control.components if sensor.control else ()
    for name, size in sensor.fields.items():
        names += [name] if size == 1 else [f"{name}_{entry}" for entry in range(size)]
    return names + ([f"{_topic(each.topic)}_number" for each in sensor.maps] * sensor.is_numbered)


def _topic(name: str) -> str:
    return name.rpartition("/")[2].replace("-", "_")


def _spread(axes: Names, block: int = 0) -> list[str]:
    """Name the entries of a covariance: the lower triangle of the first axes, then other variances."""
    block = block or len(axes)
    names = [
        f"variance of {axes[row]}" if row == column else f"covariance of {axes[row]} and {axes[column]}"
        for row in range(block)
        for column in range(row + 1)
    ]
    return names + [f"variance of {name}" for name in axes[block:]]


def _lines(
    function: object, given: Given, returned: Names = (), by: Names = DIFFERENTIATED
) -> list[str]:
    """Write the formulas of a traced function.

    If the function returns fewer values than there are names, the values are variances.
    """
    if function is None:
        return []
    assert isinstance(function, TracedFunction)
    function = TracedFunction(function.function, function.arguments)  # a graph without earlier traces
    result = function.result
    if len(returned) > len(result.returned):
        returned = [name for name in returned if name.startswith("variance")]
    names: dict[tuple[int, object], str] = {}
    for number, (argument, kind) in enumerate(zip(given, function.arguments, strict=True)):
        for entry, name in _entries(argument, given[argument], kind):
            names[number, entry] = f"{argument}.{name}" if name in names.values() else name
    outputs = dict(zip(returned, result.returned, strict=True))
    outputs |= {f"{names[argument, place]} becomes": node for argument, place, node in result.written}
    places = [number for number, argument in enumerate(given) if argument in by and returned]
    return formulas_of(
        function, names, outputs, {place: name for place, name in names.items() if place[0] in places}
    )


def _entries(argument: str, named: AnyArgument, kind: Argument) -> Iterator[tuple[object, str]]:
    """Yield the index of each entry of an argument, and its name."""
    if isinstance(kind, Shape):
        for place in np.ndindex(kind.sizes):
            parts = ", ".join(names[index] for names, index in zip(named, place, strict=True))
            yield place, f"{argument}[{parts}]"
    elif isinstance(kind, tuple):
        yield from zip(kind, kind, strict=True)
    elif kind is None:
        yield None, argument
    else:
        yield from enumerate(named)
