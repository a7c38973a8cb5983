"""Parameters as part of the state: a sensor's bias, a scale factor, a time offset that is estimated too.

A transformation of models: the state gets a component for each, which the model's functions read in
place of the parameter; so derivatives, samples and smoothers have it without knowing of it. Its prior
has the parameter's value for a mean, and stands beside the log's; between measurements it is a random
walk, or a first-order Gauss-Markov process that comes back to that mean. In the same way the state gets
the error of what is measured about each point of a map: noise that is not white, as of ranges to an
anchor. Methods see a model as any other. Bar-Shalom, Li and Kirubarajan, 2001, section 8.2.
"""

import re
from collections.abc import Callable, KeysView, Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, create_model

from recorders.errors import BadInput, choices
from replay.engine.arrays import Floats, Function
from replay.engine.blocks import Ragged
from replay.engine.priors import gaussians
from replay.engine.results import gaussian_stream
from replay.engine.tangent import Kind
from replay.inference.binding import Recorder, number_fields, settings_type
from replay.inference.generate import function_of, tuple_of
from replay.inference.model import Model, ModelParameters, Motion, Sensor, trial_state
from replay.inference.steps import Stage

ERROR = "error_"
Names = tuple[str, ...]
Start = Callable[[Mapping[str, Ragged]], Any]


class Walk(NamedTuple):
    """What is known of something in the state: a random walk, or one that comes back to its mean.

    Attributes:
        sigma: its standard deviation at first.
        drift: the density of its walk, per square root of a second.
        time_s: how fast it comes back, with noise that keeps up its sigma; infinite for never.
    """

    sigma: float
    drift: float
    time_s: float


def estimated(label: str, model: Model, parameters: Any) -> dict[str, Walk]:
    """What is to be estimated beside the state, by the names of its components, as the settings say.

    Raises BadInput where the model does not let one of them, one stands twice, or has no sigma.
    """
    asked = parameters.estimate or []
    options = {
        "estimate_sigma": parameters.estimate_sigma or {},
        "estimate_drift": parameters.estimate_drift or {},
        "estimate_time_s": parameters.estimate_time_s or {},
    }
    found: dict[str, Walk] = {}
    for asks in asked:
        where = f"estimator {label}: estimate = {asks}"
        names = _components(where, model, asks)
        if not names.isdisjoint(found):
            raise BadInput(f"{where}: stands there twice; name it once")
        sigma, drift, time_s = (given.get(asks) for given in options.values())
        if sigma is None:
            raise BadInput(
                f"{where}: how well is it known beforehand? give its standard deviation, "
                f"estimate_sigma.{asks}=..."
            )
        if time_s is not None and any(_kind(model, name) != "linear" for name in names):
            raise BadInput(
                f"{where}: is an angle, which has no mean to come back to; leave out "
                f"estimate_time_s.{asks}, and give estimate_drift.{asks} instead"
            )
        found |= dict.fromkeys(names, Walk(sigma, drift or 0.0, time_s or np.inf))
    for option, given in options.items():
        for name in given.keys() - set(asked):
            raise BadInput(f"estimator {label}: {option}.{name}: `estimate` lacks {name}; add it there")
    return found


def _components(where: str, model: Model, asks: str) -> KeysView[str]:
    """The components of the state for an entry of `estimate`: a parameter, or errors by number.

    `range_m[3]` is the error of what is measured as range_m about point 3, `range_m[0:8]` are those
    about points 0 to 7, `range_m[0:8,0:3]` those of all pairs with points 0 to 2 of the second map.
    """
    errors = re.fullmatch(r"(\w+)\[([\d:, ]+)\]", asks)
    if errors is None:
        if asks not in model.estimable:
            known = choices(asks, model.estimable)
            raise BadInput(f"{where}: is no parameter that this model lets be estimated; {known}")
        return dict.fromkeys([asks]).keys()
    measured, numbers = errors.groups()
    maps = max((len(each.maps) for each in model.sensors if measured in each.measured), default=0)
    spans = [re.fullmatch(r" *(\d+)(?::(\d+))? *", each) for each in numbers.split(",")]
    ranges = [
        range(int(each[1]), int(each[2] or int(each[1]) + 1)) for each in spans if each is not None
    ]
    if len(spans) > maps or len(ranges) < len(spans) or not all(ranges):
        raise BadInput(
            f"{where}: expected NUMBER or FIRST:END in the brackets, with a comma before those of a "
            f"second map; {measured} is measured about the points of {maps} maps in this model"
        )
    entries = ("_".join(map(str, pair)) for pair in product(*ranges))
    return dict.fromkeys(f"{ERROR}{measured}_{each}" for each in entries).keys()


def _error_of(name: str) -> tuple[str, tuple[int, ...]]:
    """What is measured, and about which points, of a component that is its error; "" of any other."""
    found = re.fullmatch(rf"{ERROR}(.+?)((?:_\d+)+)", name)
    return (found[1], tuple(map(int, found[2].split("_")[1:]))) if found else ("", ())


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


def with_walks(settings: Floats, walks: Mapping[str, Walk]) -> Floats:
    """Numbers of motion and sensors with those that an augmented model has beside them."""
    numbers = np.array([number for walk in walks.values() for number in walk])
    return np.concatenate([settings, np.tile(numbers, (len(settings), 1))], axis=1)


def begin(
    label: str, topic: str, stage: Stage, walks: Mapping[str, Walk], settings: Floats
) -> Callable[[Start], Start]:
    """What makes of the start of an augmented model's filter one from the log's own prior on `topic`.

    `stage` and `settings` are those of the model itself. Raises BadInput where a parameter that is to be
    estimated has no value.
    """
    fields = number_fields(stage.model.parameters)
    means = np.array([settings[0, fields.index(name)] if name in fields else 0.0 for name in walks])
    for name, mean in zip(walks, means, strict=True):
        if not np.isfinite(mean):
            raise BadInput(f"estimator {label}: estimate = {name}: give its likely value, {name}=...")
    variances = np.array([walk.sigma**2 for walk in walks.values()])

    def extended(prior: Ragged) -> Ragged:
        time_ns, mean, covariance = gaussians(prior)
        runs, t, k = len(mean), covariance.shape[1], len(walks)
        wider = np.zeros((runs, t + k, t + k))
        wider[:, :t, :t] = covariance
        wider[:, range(t, t + k), range(t, t + k)] = variances
        longer = np.concatenate([mean, np.tile(means, (runs, 1))], axis=1)
        return Ragged(gaussian_stream(topic, time_ns, longer, wider, {}), prior.offsets)

    def begun(start: Start) -> Start:
        return (lambda whole: start({**whole, topic: extended(whole[topic])})) if walks else start

    return begun


@lru_cache(maxsize=64)
def _augmented(model: Model, names: Names) -> Model:
    walks: dict[str, Any] = {
        f"{part}_{name}": (NonNegativeFloat, 1.0) for name in names for part in Walk._fields
    }
    parameters: type[ModelParameters] = create_model(
        f"{model.parameters.__name__}Augmented", __base__=model.parameters, **walks
    )
    modes = model.modes and {
        name: _augmented_motion(model, motion, names) for name, motion in model.modes.items()
    }
    return replace(
        model,
        state={**model.state, **{name: _kind(model, name) for name in names}},
        parameters=parameters,
        sensors=tuple(_augmented_sensor(model, sensor, names) for sensor in model.sensors),
        motion=_augmented_motion(model, model.motion, names),
        modes=modes,
        estimable={},
    )


def _kind(model: Model, name: str) -> Kind:
    """The kind of a component: the parameter's, or that of what it is the error of."""
    measured, _ = _error_of(name)
    if not measured:
        return model.estimable[name]
    return next(each.measured[measured] for each in model.sensors if measured in each.measured)


@lru_cache(maxsize=256)
def _augmented_motion(model: Model, motion: Motion, names: Names) -> Motion:
    """The motion, in which the parameters walk about or come back to what they were given as."""
    n, t = model.size, model.tangent
    stay = [_stay(model, name, f"state[{n + index}]") for index, name in enumerate(names)]
    drifts = [_spread(model, name) for name in names]
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


def _stay(model: Model, name: str, state: str) -> str:
    """A component of this name after a step; an angle has no mean to come back to."""
    if _kind(model, name) == "angle":
        return state
    mean = f"parameters.{name}" if name in number_fields(model.parameters) else "0.0"
    kept = f"np.exp(-duration_s / parameters.time_s_{name})"
    return f"{kept} * {state} + (1.0 - {kept}) * {mean}"


def _spread(model: Model, name: str) -> str:
    """The variance that a step adds to it."""
    walk = f"parameters.drift_{name} ** 2 * duration_s"
    if _kind(model, name) == "angle":
        return walk
    lost = f"1.0 - np.exp(-2.0 * duration_s / parameters.time_s_{name})"
    return f"{walk} + ({lost}) * parameters.sigma_{name} ** 2"


@lru_cache(maxsize=256)
def _augmented_sensor(model: Model, sensor: Sensor, names: Names) -> Sensor:
    arguments, passed = "state", "first(state)"
    if sensor.noises:
        arguments, passed = "state, noise", "first(state), noise"
    entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
    recorder, about = _recorder(model), (1.0,) * sensor.about_size
    sensor.measure(trial_state(model.kinds), *entering, about, recorder)
    numbered = [_error_of(name) for name in names]
    is_numbered = any(measured in sensor.measured for measured, _ in numbered)
    measured, first_number = _entries(len(sensor.measured)), sensor.about_size
    for index, (component, numbers) in enumerate(numbered):
        if component in sensor.measured:
            same = [f"(about[{first_number + k}] == {number})" for k, number in enumerate(numbers)]
            place = list(sensor.measured).index(component)
            measured[place] += f" + 1.0 * {' * '.join(same)} * state[{model.size + index}]"
    passed_about = "own_about(about)" if is_numbered else "about"
    measure = _reading(
        model,
        names,
        sensor.measure,
        f"{arguments}, about",
        f"{passed}, {passed_about}",
        measured,
        own_about=tuple_of(sensor.about_size),
    )
    log_likelihood = None  # one that the model states knows of no errors beside it
    if sensor.log_likelihood is not None and not is_numbered:
        log_likelihood = _reading(
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
        is_numbered=is_numbered,
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
    places = {name: f"state[{size + index}]" for index, name in enumerate(names) if name in fields}
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
