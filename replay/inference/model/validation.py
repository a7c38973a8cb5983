"""Checks of a model against its declarations (sizes, kinds, variances, rates) before any method runs."""

from functools import lru_cache

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import AnyArgument, Floats, Settings
from fuselog.replay.engine.vectors.tangent import are_kinds
from fuselog.replay.inference.model.functions import ModelFunction
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.tracing.functions import place_of


def check_state(where: str, model: Model) -> None:
    """Raise BadInput if the kinds of a state's components are invalid."""
    if not are_kinds(model.kinds):
        raise BadInput(
            f"{where}: the state has kinds {', '.join(model.kinds)}; give linear, angle, axis (two "
            "in a row) or quaternion (four in a row)"
        )


def check_motion(where: str, model: Model, motion: Motion, parameters: Settings) -> None:
    """Call the functions of a motion once, uncompiled.

    Args:
        where: name of the estimator, for error messages.
        model: model of the motion.
        motion: one of the motions of the model.
        parameters: a number for every parameter, in an object that records which names are read.

    Raises BadInput if a function fails or contradicts the model's declarations.
    """
    state, control = trial_state(model.kinds), (0.0,) * model.controls
    sizes = (model.tangent, motion.triangle(model.tangent))
    entering = ((0.0,) * motion.noises,) if motion.noises else ()
    _check(where, motion.move, (state, control, *entering, 1.0, parameters), (model.size,))
    if motion.noises and (motion.noise is None or motion.control_noise is not None):
        raise BadInput(
            f"{where}: noise that is not additive needs its variances, `noise`, and includes that of "
            "the control; leave out `control_noise`"
        )
    if motion.noise is not None:
        wanted = (motion.noises,) if motion.noises else sizes
        _check(where, motion.noise, (state, 1.0, parameters), wanted)
    if motion.gap_noise is not None:
        _check(where, motion.gap_noise, (state, 1.0, parameters), (model.tangent,))
    if motion.control_noise is not None:
        _check(where, motion.control_noise, (1.0, parameters), (model.controls,))


@lru_cache(maxsize=64)  # independent of the parameters, for which a search tries hundreds of values
def check_correction(where: str, model: Model) -> None:
    """Call the functions of a model's correction once, uncompiled; see `check_motion`."""
    if model.correct is not None:
        state, error = trial_state(model.kinds), (0.0,) * model.tangent
        _check(where, model.correct.along, (state,), (model.tangent,))
        for moved in (model.correct.move, model.correct.back):
            _check(where, moved, (state, error, error), (model.size,))
        _check(where, model.correct.step, (state, state, error), (model.tangent,))


def check_switching(where: str, model: Model, parameters: Settings) -> None:
    """Call the functions of a model's switching once, uncompiled; see `check_motion`."""
    assert model.modes
    assert model.switching
    modes, switching = len(model.modes), model.switching
    _check(where, switching.rates, (parameters,), (modes * (modes - 1),))
    if switching.initial is not None:
        _check(where, switching.initial, (parameters,), (modes,))


def switching_of(where: str, model: Model, parameters: Settings) -> tuple[Floats, Floats]:
    """Return the rates (M (M - 1),) between the modes of a model and the initial probabilities (M,).

    Args:
        where: name of the estimator, for error messages.
        model: model with M modes.
        parameters: parameters of the model's functions.

    Raises BadInput if a rate is negative or the probabilities are invalid.
    """
    assert model.modes
    assert model.switching
    names, switching = list(model.modes), model.switching
    rates = np.array(switching.rates(parameters), float)
    changes = [(begin, end) for begin in names for end in names if begin != end]
    for (begin, end), rate in zip(changes, rates.tolist(), strict=True):
        if not 0.0 <= rate < np.inf:
            raise BadInput(
                f"{where}: the rate from mode {begin} to {end} is {rate:g} per second; give zero or more"
            )
    initial = np.full(len(names), 1.0 / len(names))
    if switching.initial is not None:
        initial = np.array(switching.initial(parameters), float)
    if not (np.all(initial >= 0.0) and abs(initial.sum() - 1.0) < 1e-9):
        given = ", ".join(f"{name} {each:g}" for name, each in zip(names, initial, strict=True))
        raise BadInput(
            f"{where}: the initial probabilities of the modes are {given}; give numbers of zero or more "
            "with sum one"
        )
    return rates, initial


def check_sensor(where: str, model: Model, sensor: Sensor, parameters: Settings) -> None:
    """Call the functions of a sensor once, uncompiled; see `check_motion`.

    Args:
        where: name of the estimator, for error messages.
        model: model of the sensor.
        sensor: one of the sensors of the model.
        parameters: a number for every parameter, in an object that records which names are read.
    """
    where, size = f"{where}, sensor {sensor.topic}", len(sensor.measured)
    unknown = sorted(set(sensor.measured.values()) - {"linear", "angle"})
    if unknown:
        raise BadInput(f"{where}: measures a component of kind {unknown[0]}; give linear or angle")
    if sensor.control is not None:
        _check_interpolated(where, model, sensor.control)
    state, reference = trial_state(model.kinds), (1.0,) * sensor.reference_size
    entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
    _check(where, sensor.measure, (state, *entering, reference, parameters), (size,))
    if sensor.noise is None and (sensor.noises or not sensor.covariance):
        raise BadInput(
            f"{where}: has no noise; give `noise`, or `covariance`, the field that contains it"
        )
    if isinstance(sensor.covariance, str) and sensor.covariance and not sensor.vector:
        raise BadInput(
            f"{where}: the covariance {sensor.covariance} needs the field it belongs to; give `vector`"
        )
    if callable(sensor.covariance) and sensor.read is None:
        raise BadInput(
            f"{where}: `covariance` is a function, so the measurement needs one too; give `read`"
        )
    if sensor.noise is not None and not sensor.covariance:
        wanted = (sensor.noises,) if sensor.noises else (size, size * (size + 1) // 2)
        _check(where, sensor.noise, (parameters,), wanted)


def _check_interpolated(where: str, model: Model, control: Control) -> None:
    """Raise BadInput if a sensor's control is not interpolated, because measurements would be NaN."""
    driving = model.control
    if driving is None or driving.components != control.components:
        asked, given = (
            "none" if each is None else f"{each.topic} ({', '.join(each.components)})"
            for each in (control, driving)
        )
        raise BadInput(
            f"{where}: reads the control {asked}, but the model's is {given}; give both the same "
            "`control`"
        )
    if not driving.interpolated:
        raise BadInput(
            f"{where}: reads the control {control.topic} at its stamp, but the control is constant "
            "between messages; set interpolated=True in the model's Control, or leave out the sensor's "
            "`control`"
        )


def trial_state(kinds: tuple[str, ...]) -> tuple[float, ...]:
    """Return a state of distinct numbers and unit vectors, for trial calls of functions."""
    found: list[float] = []
    while len(found) < len(kinds):
        kind = kinds[len(found)]
        number = 0.1 * (1 + len(found))
        found += {"axis": [0.6, 0.8], "quaternion": [0.1, 0.5, -0.5, 0.7]}.get(kind, [number])
    return tuple(found)


def _check(
    where: str, function: ModelFunction, arguments: tuple[AnyArgument, ...], sizes: tuple[int, ...]
) -> None:
    with np.errstate(all="ignore"):
        try:
            found = function(*arguments)
        except Exception as error:
            what = f"{where}: {place_of(function)}"
            raise BadInput(f"{what} raised {type(error).__name__}: {error}") from error
    if isinstance(found, tuple) and len(found) in sizes:
        return
    what, wanted = f"{where}: {place_of(function)}", " or ".join(map(str, dict.fromkeys(sizes)))
    if not isinstance(found, tuple):
        raise BadInput(f"{what} returns a {type(found).__name__}; return a tuple of {wanted} components")
    raise BadInput(f"{what} returns {len(found)} components; {wanted} are needed")
