"""Settings: the numbers that a model's functions read, from parameters or from channels of a log."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic
from fuselog.recorders.log.planes import ORIGIN
from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.engine.streams.channels import stated
from fuselog.replay.inference.model.binding import Found
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters, number_fields, settings_type
from fuselog.replay.inference.model.validation import (
    check_correction,
    check_motion,
    check_sensor,
    check_state,
    check_switching,
    switching_of,
)

# (settings (1 + sensors, fields), row) -> the parameters in this row; row 0 is for the motion, the
# others are for the sensors.
ReadSettings = Callable[[Floats, int], Settings]


@lru_cache(maxsize=64)
def reading_settings(names: tuple[str, ...]) -> ReadSettings:
    """Make the function that converts a row of numbers to the NamedTuple of parameters."""
    kind = settings_type(names)

    def read(settings: Floats, row: int) -> Settings:
        return kind(*(settings[row, index] for index in range(len(names))))

    return read


def trial_parameters(model: Model) -> Settings:
    """Make parameters with the value 1 for trial calls of functions."""
    names = number_fields(model.parameters)
    return settings_type(names)(*(1.0,) * len(names))


class TracedParameters:
    """Parameters that record in `read` the names that functions read; unset parameters are 1."""

    def __init__(self, values: Mapping[str, float | None]) -> None:
        self._values = values
        self.read: set[str] = set()

    def __getattr__(self, name: str) -> float:
        if name not in self._values:
            raise AttributeError(f"no parameter '{name}'; the model has {', '.join(self._values)}")
        self.read.add(name)
        value = self._values[name]
        # overflows to infinity, as compiled code does
        return np.float64(1.0 if value is None else value)


def settings_of(
    label: str,
    bound_model: BoundModel,
    found: Found,
    parameters: ModelParameters,
    assumed: Mapping[str, float],
) -> Floats:
    """Collect the numbers (1 + sensors, fields) of motion and sensors from parameters and channels.

    A number that is not given is read from the channels of the control, the prior and the sensors; for a
    sensor, its own channel is read first.

    Args:
        label: label of the estimator, for error messages.
        bound_model: the bound model, with the sensors of the log.
        found: its topics.
        parameters: parameters given by the user.
        assumed: parameters that are assumed, see `assumed_of`.

    Raises BadInput if no channel states a needed number, if a channel states an invalid value of a
    parameter, or if the model does not match its declarations.
    """
    model = bound_model.model
    names = number_fields(model.parameters)
    given = {name: getattr(parameters, name) for name in names}
    everything = _stating(found)
    given |= {name: number for name, number in assumed.items() if given[name] is None}
    given |= _of_origin(bound_model, found, parameters)
    needed = _needed(f"estimator {label}", bound_model, tuple(given.items()))
    own = [[], *([topic] for _, topic in found.sensors)]
    settings = np.array(
        [
            [
                _stated(found, [*first, *everything], model.kind_of(name), model.parameters)
                if given[name] is None
                else float(given[name])
                for name in names
            ]
            for first in own
        ]
    )
    for row, (sensor, topic) in enumerate(found.sensors, start=1):
        for name, read in sensor.stated.items():
            is_stated = model.kind_of(name) in topic.metadata
            if given[name] is None and not is_stated and not np.isnan(read(topic.metadata)):
                settings[row, names.index(name)] = read(topic.metadata)
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
        better = ", or with better values if you know them" if usual else ""
        remedy = " ".join(
            f"--set {model.key_of(name)}={usual.get(model.kind_of(name), '...')}" for name in missing
        )
        asked = ", ".join(map(model.kind_of, missing))
        raise BadInput(
            f"topic {[*own[row], *everything][0].name} does not state {asked}; give "
            f"{'it' if len(missing) == 1 else 'them'} with {remedy}{better}"
        )
    if bound_model.modes:
        switching_of(f"estimator {label}", model, reading_settings(names)(settings, 0))
    return settings


def _stated(
    found: Found, topics: Sequence[Topic], name: str, parameters: type[ModelParameters]
) -> float:
    """Return the value that channels state for a parameter; NaN if no channel states it.

    If a fallback replaces the control, the noise is read from the topic of the fallback.
    """
    for drive, topic in found.fallbacks:
        for other in drive.noise.get(name, ()):
            if other in topic.metadata:
                return stated([topic], other, parameters, stands_for=name)
        if name in drive.noise:
            return np.nan
    return stated(topics, name, parameters, needed=False)


def origin_parameters(found: Found, parameters: ModelParameters) -> tuple[str, ...]:
    """List the coordinates of the tangent plane's origin that neither parameters nor channels state.

    The coordinates are then taken from the origin of the tangent plane into which fixes are projected,
    so that, for example, gravity matches the position.
    """
    stating = _stating(found)
    return tuple(
        name
        for name in ORIGIN
        if found.geodetic
        and name in type(parameters).model_fields
        and getattr(parameters, name) is None
        and not any(name in each.metadata for each in stating)
    )


def _of_origin(bound_model: BoundModel, found: Found, parameters: ModelParameters) -> dict[str, float]:
    """Return the coordinates that `origin_parameters` lists, or typical values before the first fix."""
    start = bound_model.model.start
    usual = start.parameters if start is not None else {}
    return {
        name: usual.get(name, 0.0) if found.origin is None else float(found.origin[ORIGIN.index(name)])
        for name in origin_parameters(found, parameters)
    }


def placed_settings(
    settings: Floats,
    names: Sequence[str],
    found: Found,
    parameters: ModelParameters,
    origins: Floats | None,
    runs: int,
) -> Floats:
    """Repeat the settings (1 + sensors, fields) for each run; insert the origin of its tangent plane.

    The result is not to be changed, since for one run it may be a view of the settings.

    Args:
        settings: see `settings_of`; or (runs, 1 + sensors, fields) if each run has its own.
        names: names of the columns.
        found: topics of the model.
        parameters: parameters given by the user.
        origins: (runs, 3) origin of each run's tangent plane, which is the run's first fix if no origin
            is stated; None without fixes.
        runs: number of runs.
    """
    own_origins = origins if found.origin is None else None
    if own_origins is None and runs == 1:
        return settings.reshape(1, *settings.shape[-2:])
    placed = np.empty((runs, *settings.shape[-2:]))
    placed[:] = settings
    if own_origins is None:
        return placed
    known = np.isfinite(own_origins[:, 0])
    for name in origin_parameters(found, parameters):
        placed[known, :, names.index(name)] = own_origins[known, ORIGIN.index(name), None]
    return placed


def _stating(found: Found) -> list[Topic]:
    """List the topics whose channels may state parameters, in order of precedence."""
    control = [] if found.control is None else [found.control]
    fallbacks, sensors = ([topic for _, topic in each] for each in (found.fallbacks, found.sensors))
    return [*fallbacks, *control, found.prior, *sensors]


def assumed_of(
    label: str, bound_model: BoundModel, found: Found, parameters: ModelParameters
) -> dict[str, float]:
    """Return the parameters that are assumed because a log without a prior does not state them.

    Args:
        label: label of the estimator, for error messages.
        bound_model: the bound model, with the sensors of the log.
        found: its topics.
        parameters: parameters given by the user.
    """
    start = bound_model.model.start
    if found.has_prior or start is None:
        return {}
    names = number_fields(bound_model.model.parameters)
    given = {name: getattr(parameters, name) for name in names}
    read = set().union(*_needed(f"estimator {label}", bound_model, tuple(given.items())))
    stating, model = _stating(found), bound_model.model
    usual = {name: start.parameters.get(model.kind_of(name)) for name in names}
    return {
        name: number
        for name, number in usual.items()
        if number is not None
        and name in read
        and given[name] is None
        and np.isnan(_stated(found, stating, model.kind_of(name), model.parameters))
        and name not in origin_parameters(found, parameters)
    }


@lru_cache(maxsize=64)
def _needed(
    where: str, bound_model: BoundModel, given: tuple[tuple[str, float | None], ...]
) -> tuple[set[str], ...]:
    """Return the parameters that motion and sensors read; raise BadInput for wrong declarations."""
    model, values = bound_model.model, dict(given)
    check_state(where, model)
    check_correction(where, model)
    motion, *sensors = traced = [TracedParameters(values) for _ in range(1 + len(bound_model.sensors))]
    for each in bound_model.modes or (bound_model.motion,):
        check_motion(where, model, each, motion)
    if bound_model.modes:
        check_switching(where, model, motion)
    for sensor, parameters in zip(bound_model.sensors, sensors, strict=True):
        check_sensor(where, model, sensor, parameters)
    return tuple(each.read for each in traced)


def complaint_of(model: Model, sensor: Sensor, topic: str) -> str:
    """Explain why a message was skipped and how to use it; empty if no covariance can be missing."""
    if not sensor.covariance:
        return ""
    parameters = TracedParameters(dict.fromkeys(number_fields(model.parameters)))
    if sensor.noise is not None:
        sensor.noise(parameters)
    remedy = "".join(f"; give --set {model.key_of(name)}=..." for name in sorted(parameters.read))
    what = sensor.covariance if isinstance(sensor.covariance, str) else "its covariance"
    return f"topic {topic}: {what} is missing{remedy}"
