"""Models of the targets of a tracker: any registered model with a position, or constant velocity."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import PositiveFloat

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Topic
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.models.planar import Components
from fuselog.recorders.models.states import PLANE_MOTION
from fuselog.recorders.parameters import build
from fuselog.recorders.registry import load
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.channels import stated
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.families.tracking.association.tracker import Newborn
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model, Motion
from fuselog.replay.inference.model.parameters import ModelParameters, number_fields, settings_type
from fuselog.replay.inference.model.settings import TracedParameters
from fuselog.replay.inference.model.validation import check_motion, check_switching, switching_of
from fuselog.replay.inference.run.first_messages import unknown

POSITION, VELOCITY = ("x_m", "y_m"), ("vx_mps", "vy_mps")


class TargetParameters(ModelParameters):
    """Parameters of targets that move at constant velocity.

    Attributes:
        acceleration_density: power spectral density of the acceleration, in m^2/s^3.
    """

    acceleration_density: PositiveFloat = 0.1


def move(state: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """Predict the state, assuming constant velocity."""
    x, vx, y, vy = state
    return x + duration_s * vx, vx, y + duration_s * vy, vy


def acceleration_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Compute the lower triangle of the covariance that white acceleration adds to (x, vx, y, vy)."""
    place, mixed, velocity = noise_moments(parameters.acceleration_density, duration_s)
    return place, mixed, velocity, 0.0, 0.0, place, 0.0, 0.0, mixed, velocity


TARGET = Model(
    "a target in the plane at constant velocity",
    dict.fromkeys(PLANE_MOTION, "linear"),
    TargetParameters,
    (),
    Motion(move, acceleration_noise, linear=True),
    needs_sensor=False,
)


class Targets(NamedTuple):
    """Assumptions about the targets.

    Attributes:
        bound_model: bound model of the targets, with one motion or with all modes.
        parameters: the parameters of the model; NaN for those that are not used.
        newborn: a target of which only the position is known.
    """

    bound_model: BoundModel
    parameters: Any
    newborn: Newborn


def targets_of(where: str, parameters: Any, scans: Sequence[Topic]) -> Targets:
    """Build the targets from the parameters of a tracker; read missing parameters from channels.

    Raises BadInput, with a message that begins with `where`, if the model cannot describe a target or if
    a parameter is missing.
    """
    name = parameters.model
    if name is None:
        if parameters.motion or parameters.mode:
            raise BadInput(f"{where}: motion and mode need a model; set model=... too")
        given: Mapping[str, Any] = {"acceleration_density": parameters.acceleration_density}
        model = TARGET
    else:
        where, given = f"{where}: model {name}", parameters.motion
        model = load("models", name, Model)
    _check(where, model)
    bound_model = _bound_model_of(where, model, parameters.mode)
    values = build(model.parameters, given, where)
    names = number_fields(model.parameters)
    traced = TracedParameters({each: getattr(values, each) for each in names})
    for motion in bound_model.modes or (bound_model.motion,):
        check_motion(where, model, motion, traced)
    if bound_model.modes:
        check_switching(where, model, traced)
    numbers = {}
    for each in names:
        number = getattr(values, each)
        if number is None:
            number = stated(scans, each, model.parameters, needed=False)
        if np.isnan(number) and each in traced.read:
            raise BadInput(
                f"{where}: no channel of {', '.join(topic.name for topic in scans)} states {each}; set "
                f"it with --set motion.{each}=..."
            )
        numbers[each] = float(number)
    mode, own = np.ones(1), settings_type(names)(**numbers)
    if bound_model.modes:
        _, mode = switching_of(where, model, own)
    mean, sigma = _unknown(where, model, parameters.birth_sigma_mps)
    return Targets(bound_model, own, Newborn(mean, np.diag(sigma**2), mode))


def _check(where: str, model: Model) -> None:
    if any(model.state.get(name) != "linear" for name in POSITION):
        raise BadInput(
            f"{where}: the state has no position x_m, y_m, which sensors measure; use another model"
        )
    if model.control is not None:
        raise BadInput(
            f"{where}: the model is driven by {model.control.topic}, which is not recorded for targets; "
            "use a model without a control"
        )


def _bound_model_of(where: str, model: Model, mode: str | None) -> BoundModel:
    """Bind the model with the motion of the named mode, or with all of its modes."""
    if mode is not None:
        if not model.modes or mode not in model.modes:
            raise BadInput(f"{where}: no mode '{mode}'; {choices(mode, model.modes or ())}")
        return BoundModel(model, model.modes[mode], ())
    if model.modes and model.switching is not None:
        return BoundModel(model, model.motion, (), tuple(model.modes.values()))
    return BoundModel(model, model.motion, ())


def _unknown(where: str, model: Model, sigma_mps: float) -> tuple[Floats, Floats]:
    """Return mean (n,) and sigmas (t,) of a target of which only the position is known."""
    mean, sigma = unknown(model.state, model.start)
    for row, (name, _) in enumerate(tangent_components(list(model.state), model.kinds)):
        if name in POSITION:
            sigma[row] = 0.0
        elif name in VELOCITY:
            sigma[row] = sigma_mps
        elif np.isnan(sigma[row]):
            raise BadInput(
                f"{where}: detections do not measure {name}, and the model states no initial "
                "uncertainty of it; add its sigma to the start of the model"
            )
    return mean, sigma
