"""Parameters as part of the state: a sensor's bias, a scale factor, a time offset that is estimated too.

A transformation of models: the state gets a component for each, which the model's functions read in
place of the parameter; so derivatives, samples and smoothers have it without knowing of it. Its prior
has the parameter's value for a mean, and stands beside the log's; between measurements it moves as
`replay.inference.walks` says. Methods see a model as any other. Errors about the points of a map are
added in the same way, see `replay.inference.point_errors`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput, choices
from replay.engine.arrays import Floats, Function
from replay.engine.blocks import Ragged
from replay.engine.priors import gaussians
from replay.engine.results import gaussian_stream
from replay.inference.corrections import correcting_more
from replay.inference.generate import function_of, tuple_of
from replay.inference.model import Model, Motion, Sensor, trial_state
from replay.inference.parameters import number_fields, settings_type
from replay.inference.point_errors import (
    Errors,
    PointError,
    motion_with_errors,
    point_errors,
    sensor_with_errors,
    with_point_errors,
)
from replay.inference.settings import TracedParameters
from replay.inference.stage import Stage
from replay.inference.walks import Walk, kept, spread, with_walk_parameters

Names = tuple[str, ...]
Start = Callable[[Mapping[str, Ragged]], Any]


class Added(NamedTuple):
    """What is estimated beside the state: parameters, then errors about points, and how each moves."""

    parameters: Names
    errors: Errors
    walks: tuple[Walk, ...]

    @property
    def names(self) -> Names:
        """The components, in their order."""
        return self.parameters + tuple(each.name for each in self.errors)


def estimated(label: str, model: Model, parameters: Any) -> Added:
    """What is to be estimated beside the state, as the settings say.

    Raises BadInput where what the model lists as `estimable` is none of its parameters, it does not list
    one that is asked for, one stands twice, or has no sigma.
    """
    check_estimable(f"estimator {label}", model)
    asked = parameters.estimate or []
    options = {
        "estimate_sigma": parameters.estimate_sigma or {},
        "estimate_drift": parameters.estimate_drift or {},
        "estimate_time_s": parameters.estimate_time_s or {},
    }
    for option, given in options.items():
        for name in given.keys() - set(asked):
            raise BadInput(f"estimator {label}: {option}.{name}: `estimate` lacks {name}; add it there")
    named: dict[str, Walk] = {}
    errors: dict[PointError, Walk] = {}
    for asks in asked:
        where = f"estimator {label}: estimate = {asks}"
        own = point_errors(where, model, asks)
        if not own and asks not in model.estimable:
            known = choices(asks, model.estimable)
            raise BadInput(f"{where}: is not a parameter that can be estimated with this model; {known}")
        if asks in named or not errors.keys().isdisjoint(own):
            raise BadInput(f"{where}: is named twice; name it once")
        sigma, drift, time_s = (given.get(asks) for given in options.values())
        if sigma is None:
            raise BadInput(
                f"{where}: its uncertainty at the start is missing; give its standard deviation, "
                f"estimate_sigma.{asks}=..."
            )
        if time_s is not None and model.estimable.get(asks) == "angle":
            raise BadInput(
                f"{where}: is an angle, which cannot return to a mean; give "
                f"estimate_drift.{asks} in place of estimate_time_s.{asks}"
            )
        walk = Walk(sigma, drift or 0.0, time_s or np.inf)
        if own:
            errors |= dict.fromkeys(own, walk)
        else:
            named[asks] = walk
    return Added(tuple(named), tuple(errors), (*named.values(), *errors.values()))


def check_estimable(where: str, model: Model) -> None:
    """Raise BadInput where `estimable` is no mapping from parameters of the model to linear or angle."""
    if not isinstance(model.estimable, Mapping):
        raise BadInput(
            f"{where}: estimable is a {type(model.estimable).__name__}; it is a mapping from parameter "
            'to kind, such as {"length_m": "linear"}'
        )
    known = number_fields(model.parameters)
    for name, kind in model.estimable.items():
        if name not in known:
            raise BadInput(
                f"{where}: estimable: '{name}' is no parameter of the model; {choices(name, known)}"
            )
        if kind not in ("linear", "angle"):
            raise BadInput(f"{where}: estimable: {name} is of kind '{kind}'; known are linear and angle")


def augmented(model: Model, names: Names, errors: Errors = ()) -> Model:
    """The model with these parameters and errors in its state; the model itself where there are none.

    >>> from replay.estimators.landmarks import ROBOT
    >>> list(augmented(ROBOT, ("bias_range_m",)).state)
    ['x_m', 'y_m', 'heading_rad', 'bias_range_m']
    """
    model = _augmented(model, names) if names else model
    return with_point_errors(model, errors) if errors else model


def augmented_stage(stage: Stage, added: Added) -> Stage:
    """The same of a model as a method takes it."""
    names, errors = added.parameters, added.errors
    if names:
        model, sensors = stage.model, stage.sensors
        motions = [_augmented_motion(model, each, names) for each in (stage.motion, *stage.modes)]
        sensors = tuple(_augmented_sensor(model, each, names) for each in sensors)
        stage = Stage(_augmented(model, names), motions[0], sensors, tuple(motions[1:]))
    if errors:
        model, sensors = stage.model, stage.sensors
        motions = [motion_with_errors(model, each, errors) for each in (stage.motion, *stage.modes)]
        sensors = tuple(sensor_with_errors(model, each, errors) for each in sensors)
        stage = Stage(with_point_errors(model, errors), motions[0], sensors, tuple(motions[1:]))
    return stage


def with_walks(settings: Floats, added: Added) -> Floats:
    """Numbers of motion and sensors with those that an augmented model has beside them."""
    numbers = np.ravel(added.walks)
    return np.concatenate([settings, np.tile(numbers, (len(settings), 1))], axis=1)


def begin(
    label: str, topic: str, stage: Stage, added: Added, settings: Floats
) -> Callable[[Start], Start]:
    """What makes of the start of an augmented model's filter one from the log's own prior on `topic`.

    `stage` and `settings` are those of the model itself. Raises BadInput where a parameter that is to be
    estimated has no value.
    """
    fields = number_fields(stage.model.parameters)
    means = np.array(
        [settings[0, fields.index(name)] if name in fields else 0.0 for name in added.names]
    )
    for name, mean in zip(added.names, means, strict=True):
        if not np.isfinite(mean):
            raise BadInput(
                f"estimator {label}: estimate = {name}: its value at the start is missing; give "
                f"{name}=..."
            )
    variances = np.array([walk.sigma**2 for walk in added.walks])

    def extended(prior: Ragged) -> Ragged:
        time_ns, mean, covariance = gaussians(prior)
        runs, t, k = len(mean), covariance.shape[1], len(added.walks)
        wider = np.zeros((runs, t + k, t + k))
        wider[:, :t, :t] = covariance
        wider[:, range(t, t + k), range(t, t + k)] = variances
        longer = np.concatenate([mean, np.tile(means, (runs, 1))], axis=1)
        return Ragged(gaussian_stream(topic, time_ns, longer, wider, {}), prior.offsets)

    def begun(start: Start) -> Start:
        return (lambda whole: start({**whole, topic: extended(whole[topic])})) if added.walks else start

    return begun


@lru_cache(maxsize=64)
def _augmented(model: Model, names: Names) -> Model:
    modes = model.modes and {
        name: _augmented_motion(model, motion, names) for name, motion in model.modes.items()
    }
    return replace(
        model,
        state={**model.state, **{name: model.estimable[name] for name in names}},
        parameters=with_walk_parameters(model.parameters, names),
        sensors=tuple(_augmented_sensor(model, sensor, names) for sensor in model.sensors),
        motion=_augmented_motion(model, model.motion, names),
        modes=modes,
        correct=correcting_more(model, len(names)),
        estimable={},
    )


@lru_cache(maxsize=256)
def _augmented_motion(model: Model, motion: Motion, names: Names) -> Motion:
    """The motion, in which the parameters walk about or come back to what they were given as."""
    n, t = model.size, model.tangent
    stay = [_stay(model, name, f"state[{n + index}]") for index, name in enumerate(names)]
    drifts = [spread(name) for name in names]
    given = motion.noise or _no_noise(t)
    state, parameters = trial_state(model.kinds), _traced(model)
    variances = _entries(len(given(state, 1.0, parameters)))
    if not motion.noises and len(variances) != t:  # rows of a lower triangle
        for index, drift in enumerate(drifts):
            variances += ["0.0"] * (t + index) + [drift]
    else:
        variances += drifts
    arguments, passed = "state, control", "first(state), control"
    if motion.noises:
        stay = [f"{place} + noise[{motion.noises + index}]" for index, place in enumerate(stay)]
        arguments, passed = f"{arguments}, noise", f"{passed}, first_noises(noise)"
    entering = ((0.0,) * motion.noises,) if motion.noises else ()
    parameters = _traced(model)
    motion.move(state, (0.0,) * model.controls, *entering, 1.0, parameters)
    reads_none = not parameters.read & set(names)
    lost = motion.lost and _reading(
        model,
        names,
        motion.lost,
        "state, duration_s",
        "first(state), duration_s",
        [*_entries(t), *drifts],
    )
    return replace(
        motion,
        lost=lost,
        move=_reading(
            model,
            names,
            motion.move,
            f"{arguments}, duration_s",
            f"{passed}, duration_s",
            _entries(n) + stay,
            first_noises=tuple_of(motion.noises),
        ),
        noise=_reading(model, names, given, "state, duration_s", "first(state), duration_s", variances),
        noises=motion.noises + len(names) if motion.noises else 0,
        linear=motion.linear and reads_none,
        jacobians=None,
        moments=None,
    )


def _kept(model: Model, name: str) -> str:
    """The share that a component of this name keeps in a step; an angle has no mean to come back to."""
    return "1.0" if model.estimable[name] == "angle" else kept(name)


def _stay(model: Model, name: str, state: str) -> str:
    """A component of this name after a step."""
    if model.estimable[name] == "angle":
        return state
    return f"{kept(name)} * {state} + (1.0 - {kept(name)}) * parameters.{name}"


@lru_cache(maxsize=256)
def _augmented_sensor(model: Model, sensor: Sensor, names: Names) -> Sensor:
    arguments, passed = "state", "first(state)"
    if sensor.noises:
        arguments, passed = "state, noise", "first(state), noise"
    entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
    parameters, about = _traced(model), (1.0,) * sensor.about_size
    sensor.measure(trial_state(model.kinds), *entering, about, parameters)
    measured = _entries(len(sensor.measured))
    measure = _reading(model, names, sensor.measure, f"{arguments}, about", f"{passed}, about", measured)
    log_likelihood = sensor.log_likelihood and _reading(
        model,
        names,
        sensor.log_likelihood,
        "state, measured, about",
        "first(state), measured, about",
        None,
    )
    return replace(
        sensor,
        measure=measure,
        log_likelihood=log_likelihood,
        linear=sensor.linear and not parameters.read & set(names),
        jacobian=None,
        moments=None,
    )


def _reading(
    model: Model,
    names: Names,
    function: Function,
    arguments: str,
    passed: str,
    entries: list[str] | None,
    **others: Any,
) -> Function:
    """A model's function of the augmented state, which reads the estimated parameters from there.

    `entries` is what it returns, of what the function itself `found`; just that for None.
    """
    returned = "found" if entries is None else f"({', '.join(entries)},)"
    return function_of(
        f"def augmented({arguments}, parameters):\n"
        f"    found = inner({passed}, own(state, parameters))\n"
        f"    return {returned}\n",
        inner=function,
        own=_own_parameters(number_fields(model.parameters), names, model.size),
        first=tuple_of(model.size),
        **others,
    )


@lru_cache(maxsize=64)
def _own_parameters(fields: Names, names: Names, size: int) -> Function:
    """`own(state, parameters)`: a model's parameters, the estimated ones from the augmented state."""
    places = {name: f"state[{size + index}]" for index, name in enumerate(names)}
    values = ", ".join(places.get(field, f"parameters.{field}") for field in fields)
    text = f"def own(state, parameters):\n    return Settings({values})\n"
    return function_of(text, Settings=settings_type(fields))


def _no_noise(size: int) -> Function:
    zeros = ", ".join(["0.0"] * size)
    return function_of(f"def no_noise(state, duration_s, parameters):\n    return ({zeros},)\n")


def _entries(count: int) -> list[str]:
    return [f"found[{index}]" for index in range(count)]


def _traced(model: Model) -> TracedParameters:
    return TracedParameters(dict.fromkeys(number_fields(model.parameters)))
