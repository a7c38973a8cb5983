"""Parameters as part of the state: a sensor's bias, a scale factor, a time offset that is estimated too.

A transformation of models: the state gets a component for each, which the model's functions read in
place of the parameter; so derivatives, samples and smoothers have it without knowing of it. Its prior
has the parameter's value for a mean, and stands beside the log's; between measurements it is a random
walk. Methods see a model as any other.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import NonNegativeFloat, create_model

from recorders.errors import BadInput, choices
from replay.engine.arrays import Floats, Function
from replay.engine.blocks import Ragged
from replay.engine.priors import gaussians
from replay.engine.results import gaussian_stream
from replay.inference.binding import Recorder, number_fields, settings_type
from replay.inference.generate import function_of, tuple_of
from replay.inference.model import Model, ModelParameters, Motion, Sensor, trial_state
from replay.inference.steps import Stage

Names = tuple[str, ...]
Start = Callable[[Mapping[str, Ragged]], Any]


def estimated(label: str, model: Model, parameters: Any) -> Names:
    """The parameters that are to be estimated, as the settings say.

    Raises BadInput where the model does not let one of them, one stands twice, or has no sigma.
    """
    names: Names = tuple(parameters.estimate or ())
    sigmas, drifts = parameters.estimate_sigma or {}, parameters.estimate_drift or {}
    for number, name in enumerate(names):
        where = f"estimator {label}: estimate = {name}"
        if name not in model.estimable:
            known = choices(name, model.estimable)
            raise BadInput(f"{where}: is no parameter that this model lets be estimated; {known}")
        if name in names[:number]:
            raise BadInput(f"{where}: stands there twice; name it once")
        if name not in sigmas:
            raise BadInput(
                f"{where}: how well is it known beforehand? give its standard deviation, "
                f"estimate_sigma.{name}=..."
            )
    for option, given in (("estimate_sigma", sigmas), ("estimate_drift", drifts)):
        for name in given.keys() - set(names):
            raise BadInput(f"estimator {label}: {option}.{name}: `estimate` lacks {name}; add it there")
    return names


def augmented(model: Model, names: Names) -> Model:
    """The model with these parameters in its state; the model itself where there are none.

    >>> from replay.estimators.landmarks import ROBOT
    >>> list(augmented(ROBOT, ("bias_range_m",)).state)
    ['x_m', 'y_m', 'heading_rad', 'bias_range_m']
    """
    return _augmented(model, names) if names else model


def augmented_stage(stage: Stage, names: Names) -> Stage:
    """The same of a model as a method takes it."""
    if not names:
        return stage
    model = stage.model
    sensors = (_augmented_sensor(model, sensor, names) for sensor in stage.sensors)
    motion, *modes = (_augmented_motion(model, each, names) for each in (stage.motion, *stage.modes))
    return Stage(augmented(model, names), motion, tuple(sensors), tuple(modes))


def with_drifts(settings: Floats, names: Names, parameters: Any) -> Floats:
    """Numbers of motion and sensors with the drifts that an augmented model has beside them."""
    drifts = [(parameters.estimate_drift or {}).get(name, 0.0) for name in names]
    return np.concatenate([settings, np.tile(drifts, (len(settings), 1))], axis=1)


def begin(
    label: str, topic: str, stage: Stage, names: Names, settings: Floats, parameters: Any
) -> Callable[[Start], Start]:
    """What makes of the start of an augmented model's filter one from the log's own prior on `topic`.

    `stage` and `settings` are those of the model itself. Raises BadInput where a parameter that is to be
    estimated has no value.
    """
    fields = number_fields(stage.model.parameters)
    means = np.array([settings[0, fields.index(name)] for name in names])
    for name, mean in zip(names, means, strict=True):
        if not np.isfinite(mean):
            raise BadInput(f"estimator {label}: estimate = {name}: give its likely value, {name}=...")
    variances = np.array([parameters.estimate_sigma[name] ** 2 for name in names])

    def extended(prior: Ragged) -> Ragged:
        time_ns, mean, covariance = gaussians(prior)
        runs, t, k = len(mean), covariance.shape[1], len(names)
        wider = np.zeros((runs, t + k, t + k))
        wider[:, :t, :t] = covariance
        wider[:, range(t, t + k), range(t, t + k)] = variances
        longer = np.concatenate([mean, np.tile(means, (runs, 1))], axis=1)
        return Ragged(gaussian_stream(topic, time_ns, longer, wider, {}), prior.offsets)

    def begun(start: Start) -> Start:
        return (lambda whole: start({**whole, topic: extended(whole[topic])})) if names else start

    return begun


@lru_cache(maxsize=64)
def _augmented(model: Model, names: Names) -> Model:
    drifts: dict[str, Any] = {_drift(name): (NonNegativeFloat, 0.0) for name in names}
    parameters: type[ModelParameters] = create_model(
        f"{model.parameters.__name__}Augmented", __base__=model.parameters, **drifts
    )
    modes = model.modes and {
        name: _augmented_motion(model, motion, names) for name, motion in model.modes.items()
    }
    return replace(
        model,
        state={**model.state, **{name: model.estimable[name] for name in names}},
        parameters=parameters,
        sensors=tuple(_augmented_sensor(model, sensor, names) for sensor in model.sensors),
        motion=_augmented_motion(model, model.motion, names),
        modes=modes,
        estimable={},
    )


def _drift(name: str) -> str:
    return f"drift_{name}"


@lru_cache(maxsize=256)
def _augmented_motion(model: Model, motion: Motion, names: Names) -> Motion:
    """The motion, in which the parameters stay what they are but for their drift."""
    n, t = model.size, model.tangent
    stay = [f"state[{n + index}]" for index in range(len(names))]
    drifts = [f"parameters.{_drift(name)} ** 2 * duration_s" for name in names]
    given = motion.noise or _no_noise(t)
    state, recorder = trial_state(model.kinds), _recorder(model)
    variances = _entries(len(given(state, 1.0, recorder)))
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
    recorder = _recorder(model)
    motion.move(state, (0.0,) * model.controls, *entering, 1.0, recorder)
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
        linear=motion.linear and not recorder.read & set(names),
        jacobians=None,
        moments=None,
    )


@lru_cache(maxsize=256)
def _augmented_sensor(model: Model, sensor: Sensor, names: Names) -> Sensor:
    arguments, passed = "state", "first(state)"
    if sensor.noises:
        arguments, passed = "state, noise", "first(state), noise"
    entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
    recorder, about = _recorder(model), (1.0,) * sensor.about_size
    sensor.measure(trial_state(model.kinds), *entering, about, recorder)
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
        linear=sensor.linear and not recorder.read & set(names),
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


def _recorder(model: Model) -> Recorder:
    return Recorder(dict.fromkeys(number_fields(model.parameters)))
