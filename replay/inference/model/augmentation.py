"""Augmentation of a state by parameters, such as a sensor's bias, a scale factor or a time offset.

This is a transformation of models: each parameter becomes a component of the state, which the functions
of the model read in place of the parameter. Derivatives, samples and smoothers then include the
component without special treatment, because the result is an ordinary model. The prior of the component
is appended to the prior of the log; its mean is the value of the parameter. Between measurements, the
component changes as described in `fuselog.replay.inference.model.gauss_markov`. Errors of the points of
a map are added in the same way; see `fuselog.replay.inference.model.point_errors`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, TypeVar, cast

import numpy as np

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import field_of
from fuselog.replay.engine.arrays import AnyArgument, Floats, Numbers, Settings
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.priors import gaussians
from fuselog.replay.engine.streams.results import gaussian_stream
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.corrections import correcting_more
from fuselog.replay.inference.model.functions import ModelFunction, MotionNoise
from fuselog.replay.inference.model.gauss_markov import (
    GaussMarkov,
    added_variance,
    remaining_share,
    with_gauss_markov_parameters,
)
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import CombinedParameters, number_fields, settings_type
from fuselog.replay.inference.model.point_errors import (
    Errors,
    PointError,
    motion_with_errors,
    point_errors,
    sensor_with_errors,
    with_point_errors,
)
from fuselog.replay.inference.model.settings import TracedParameters
from fuselog.replay.inference.model.validation import trial_state

Names = tuple[str, ...]
OfModel = TypeVar("OfModel", bound=ModelFunction)
# (static topics) -> initial state of an estimator.
Start = Callable[[Mapping[str, Ragged]], object]


class Added(NamedTuple):
    """Components that are added to the state (parameters, then point errors), with their processes."""

    parameters: Names
    errors: Errors
    processes: tuple[GaussMarkov, ...]

    @property
    def names(self) -> Names:
        """Names of the components, in their order."""
        return self.parameters + tuple(each.name for each in self.errors)


def estimated(label: str, model: Model, parameters: CombinedParameters) -> Added:
    """Return the components that the settings add to the state.

    Args:
        label: label of the estimator, for error messages.
        model: the model whose parameters are requested.
        parameters: settings with `estimate` and its options.

    Raises BadInput if the model does not list a requested parameter as `augmentable`, if a parameter is
    named twice, or if it has no sigma.
    """
    asked = list(map(field_of, parameters.estimate or []))
    options = {
        option: {field_of(key): value for key, value in (getattr(parameters, option) or {}).items()}
        for option in ("estimate_sigma", "estimate_drift", "estimate_time_s")
    }
    for option, given in options.items():
        for name in given.keys() - set(asked):
            raise BadInput(
                f"estimator {label}: {option}.{name}: {name} is not in `estimate`; add it there"
            )
    named: dict[str, GaussMarkov] = {}
    errors: dict[PointError, GaussMarkov] = {}
    for asks in asked:
        where = f"estimator {label}: estimate = {asks}"
        own = point_errors(where, model, asks)
        if not own and asks not in model.augmentable:
            known = choices(asks, model.augmentable)
            raise BadInput(f"{where}: this model cannot estimate a parameter of this name; {known}")
        if asks in named or not errors.keys().isdisjoint(own):
            raise BadInput(f"{where}: the parameter is named twice; name it once")
        sigma, drift, time_s = (given.get(asks) for given in options.values())
        if sigma is None:
            raise BadInput(
                f"{where}: its uncertainty at the start is missing; give its standard deviation, "
                f"estimate_sigma.{asks}=..."
            )
        if time_s is not None and model.augmentable.get(asks) == "angle":
            raise BadInput(
                f"{where}: an angle cannot return to a mean; give "
                f"estimate_drift.{asks} instead of estimate_time_s.{asks}"
            )
        process = GaussMarkov(sigma, drift or 0.0, time_s or np.inf)
        if own:
            errors |= dict.fromkeys(own, process)
        else:
            named[asks] = process
    return Added(tuple(named), tuple(errors), (*named.values(), *errors.values()))


def check_augmentable(where: str, model: Model) -> None:
    """Raise BadInput if `augmentable` does not map parameters of the model to "linear" or "angle"."""
    if not isinstance(model.augmentable, Mapping):
        raise BadInput(
            f"{where}: augmentable is a {type(model.augmentable).__name__}; expected a mapping from "
            'parameter to kind, such as {"length_m": "linear"}'
        )
    known = number_fields(model.parameters)
    for name, kind in model.augmentable.items():
        if name not in known:
            raise BadInput(
                f"{where}: augmentable: '{name}' is not a parameter of the model; {choices(name, known)}"
            )
        if kind not in ("linear", "angle"):
            raise BadInput(f"{where}: augmentable: {name} is of kind '{kind}'; expected linear or angle")


def augmented(model: Model, names: Names, errors: Errors = ()) -> Model:
    """Add parameters and errors to the state of a model; if there are none, return the model itself.

    >>> from fuselog.replay.estimators.landmarks import ROBOT
    >>> list(augmented(ROBOT, ("bias_range_m",)).state)
    ['x_m', 'y_m', 'heading_rad', 'bias_range_m']
    """
    model = _augmented(model, names) if names else model
    return with_point_errors(model, errors) if errors else model


def augmented_model(bound_model: BoundModel, added: Added) -> BoundModel:
    """Add parameters and errors to the state of a bound model.

    Args:
        bound_model: the bound model, with the sensors of the log.
        added: components to add to its state.
    """
    names, errors = added.parameters, added.errors
    if names:
        model, sensors = bound_model.model, bound_model.sensors
        motions = [
            _augmented_motion(model, each, names) for each in (bound_model.motion, *bound_model.modes)
        ]
        sensors = tuple(_augmented_sensor(model, each, names) for each in sensors)
        bound_model = BoundModel(_augmented(model, names), motions[0], sensors, tuple(motions[1:]))
    if errors:
        model, sensors = bound_model.model, bound_model.sensors
        motions = [
            motion_with_errors(model, each, errors) for each in (bound_model.motion, *bound_model.modes)
        ]
        sensors = tuple(sensor_with_errors(model, each, errors) for each in sensors)
        bound_model = BoundModel(
            with_point_errors(model, errors), motions[0], sensors, tuple(motions[1:])
        )
    return bound_model


def with_gauss_markov(settings: Floats, added: Added) -> Floats:
    """Append the parameters of the added processes to the settings of motion and sensors.

    Args:
        settings: (1 + sensors, fields).
        added: components that are added to the state.
    """
    if not added.processes:
        return settings
    numbers = np.ravel(added.processes)
    return np.concatenate([settings, np.tile(numbers, (len(settings), 1))], axis=1)


def begin(
    label: str, topic: str, bound_model: BoundModel, added: Added, settings: Floats
) -> Callable[[Start], Start]:
    """Make the function that extends the prior on `topic` to the augmented state.

    Args:
        label: label of the estimator, for error messages.
        topic: topic of the prior.
        bound_model: the bound model before augmentation.
        added: components that are added to its state.
        settings: (1 + sensors, fields), before augmentation.

    Raises BadInput if a parameter to be estimated has no value.
    """
    fields = number_fields(bound_model.model.parameters)
    means = np.array(
        [settings[0, fields.index(name)] if name in fields else 0.0 for name in added.names]
    )
    for name, mean in zip(added.names, means, strict=True):
        if not np.isfinite(mean):
            raise BadInput(
                f"estimator {label}: estimate = {name}: the start value is missing; give {name}=..."
            )
    variances = np.array([process.sigma**2 for process in added.processes])

    def extended(prior: Ragged) -> Ragged:
        time_ns, mean, covariance = gaussians(prior)
        runs, t, k = len(mean), covariance.shape[1], len(added.processes)
        wider = np.zeros((runs, t + k, t + k))
        wider[:, :t, :t] = covariance
        wider[:, range(t, t + k), range(t, t + k)] = variances
        longer = np.concatenate([mean, np.tile(means, (runs, 1))], axis=1)
        return Ragged(gaussian_stream(topic, time_ns, longer, wider, {}), prior.offsets)

    def begun(start: Start) -> Start:
        return (
            (lambda static: start({**static, topic: extended(static[topic])}))
            if added.processes
            else start
        )

    return begun


@lru_cache(maxsize=64)
def _augmented(model: Model, names: Names) -> Model:
    modes = model.modes and {
        name: _augmented_motion(model, motion, names) for name, motion in model.modes.items()
    }
    return replace(
        model,
        state={**model.state, **{name: model.augmentable[name] for name in names}},
        parameters=with_gauss_markov_parameters(model.parameters, names),
        sensors=tuple(_augmented_sensor(model, sensor, names) for sensor in model.sensors),
        motion=_augmented_motion(model, model.motion, names),
        modes=modes,
        correct=correcting_more(model, len(names)),
        augmentable={},
    )


@lru_cache(maxsize=256)
def _augmented_motion(model: Model, motion: Motion, names: Names) -> Motion:
    """Extend a motion by components that are random walks or return to their given values."""
    n, t, noises = model.size, model.tangent, motion.noises
    given = motion.noise or _no_noise(t)
    state, parameters = trial_state(model.kinds), _traced(model)
    is_triangle = not noises and len(given(state, 1.0, parameters)) != t
    entering = ((0.0,) * noises,) if noises else ()
    parameters = _traced(model)
    motion.move(state, (0.0,) * model.controls, *entering, 1.0, parameters)
    reads_none = not parameters.read & set(names)
    move_own = _reading(model, names, motion.move)
    angular = tuple(model.augmentable[name] == "angle" for name in names)

    def move(state: Numbers, control: Numbers, *others: AnyArgument) -> Numbers:
        *entering, duration_s, parameters = others
        own = (each[:noises] for each in entering)
        moved = list(move_own(state, control, *own, duration_s, parameters))
        for index, name in enumerate(names):
            stay = state[n + index]
            if not angular[index]:  # an angle has no mean to return to
                share = remaining_share(name, duration_s, parameters)
                stay = share * stay + (1.0 - share) * getattr(parameters, name)
            moved.append(stay + entering[0][noises + index] if noises else stay)
        return tuple(moved)

    def with_spreads(function: MotionNoise, *, is_triangle: bool = False) -> MotionNoise:
        own = _reading(model, names, function)

        def noise(state: Numbers, duration_s: float, parameters: Settings) -> Numbers:
            found = list(own(state, duration_s, parameters))
            for index, name in enumerate(names):
                found += [0.0] * (t + index) if is_triangle else []
                found.append(added_variance(name, duration_s, parameters))
            return tuple(found)

        return noise

    return replace(
        motion,
        move=move,
        noise=with_spreads(given, is_triangle=is_triangle),
        gap_noise=motion.gap_noise and with_spreads(motion.gap_noise),
        noises=noises + len(names) if noises else 0,
        linear=motion.linear and reads_none,
        jacobians=None,
        moments=None,
    )


@lru_cache(maxsize=256)
def _augmented_sensor(model: Model, sensor: Sensor, names: Names) -> Sensor:
    entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
    parameters, reference = _traced(model), (1.0,) * sensor.reference_size
    sensor.measure(trial_state(model.kinds), *entering, reference, parameters)
    return replace(
        sensor,
        measure=_reading(model, names, sensor.measure),
        log_likelihood=sensor.log_likelihood and _reading(model, names, sensor.log_likelihood),
        linear=sensor.linear and not parameters.read & set(names),
        jacobian=None,
        moments=None,
    )


def _reading(model: Model, names: Names, function: OfModel) -> OfModel:
    """Make a function of the augmented state that reads the estimated parameters from the state."""
    n, fields = model.size, number_fields(model.parameters)
    settings = settings_type(fields)
    places = tuple((field, n + names.index(field) if field in names else -1) for field in fields)

    def read(state: Numbers, *others: AnyArgument) -> object:
        *given, parameters = others
        own = (getattr(parameters, name) if at < 0 else state[at] for name, at in places)
        return function(state[:n], *given, settings(*own))

    return cast(OfModel, read)


def _no_noise(size: int) -> MotionNoise:
    def no_noise(state: Numbers, duration_s: float, parameters: Settings) -> Numbers:
        return (0.0,) * size

    return no_noise


def _traced(model: Model) -> TracedParameters:
    return TracedParameters(dict.fromkeys(number_fields(model.parameters)))
