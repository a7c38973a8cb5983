"""Definition of methods, and the methods that are Kalman filters, such as `ekf` and `ukf`.

Each method makes the steps of a filter for one model. `ekf` and `iekf` need only the functions of the
model; `ukf` and `lrkf:SAMPLING` sample them; `analytic` uses exact moments if the model provides them;
`sqrt` stores factors of covariances.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, NonNegativeFloat, NonNegativeInt, PositiveFloat

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import Parameters, build
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.kalman.forms import extended, sampled
from fuselog.replay.inference.kalman.iterated_update import iterated_update
from fuselog.replay.inference.kalman.predict import linear_motion, motion_noise
from fuselog.replay.inference.kalman.square_root import FACTORED
from fuselog.replay.inference.kalman.steps import (
    Innovate,
    Interval,
    Measurement,
    Predict,
    Steps,
    Workspace,
    gaussian_filter,
)
from fuselog.replay.inference.kalman.update import (
    kalman_update,
    linear_sensor,
    message_layout,
    residual_of,
    sensor_derivative,
)
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel, traced_sensor
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.parameters import CombinedParameters, number_fields
from fuselog.replay.inference.model.settings import trial_parameters
from fuselog.replay.inference.model.validation import trial_state
from fuselog.replay.inference.sampling import parse_sampling
from fuselog.replay.inference.sampling.names import Sampling, Unscented

# Function that makes a `fuselog.replay.inference.run.filtering.Filter`, which this module cannot import.
MakeFilter = Callable[..., Any]  # type: ignore[explicit-any]


def _as_list(value: object) -> object:
    return [each.strip() for each in value.split(",")] if isinstance(value, str) else value


class MethodParameters(Parameters):  # type: ignore[explicit-any]
    """Options of every method.

    Attributes:
        every_s: interval of estimates in addition to those at the stamps of the sensors.
        mode: name of the motion to use, if the model has several.
        estimate: names of parameters to add to the state; the initial estimate of each is its given
            value.
        estimate_sigma: initial standard deviation of such a parameter, in its unit, by name.
        estimate_drift: random walk of such a parameter, in its unit/sqrt(s), by name.
        estimate_time_s: time constant with which such a parameter returns to its value (Gauss-Markov
            process), in s, by name.
        topics: topics to use instead of those that the model names, such as {pose = "/amcl_pose/pose"}.
            An empty name leaves a sensor out; several names, separated by commas or in a list, are all
            used.
        of_topics: by topic, parameters that replace the general ones for this topic, as set by --set
            /gps2/fix.lever_x_m=0.4.
    """

    every_s: PositiveFloat | None = None
    mode: str | None = None
    estimate: list[str] | None = None
    estimate_sigma: dict[str, PositiveFloat] | None = None
    estimate_drift: dict[str, NonNegativeFloat] | None = None
    estimate_time_s: dict[str, PositiveFloat] | None = None
    topics: dict[str, Annotated[list[str], BeforeValidator(_as_list)]] | None = None
    of_topics: dict[str, dict[str, float]] | None = None


class UnscentedParameters(MethodParameters):  # type: ignore[explicit-any]
    """Options of methods that can use the unscented transform.

    Attributes:
        kappa: spread of the sigma points: 3 - n is Julier's choice, and 0 gives the cubature filter. The
            default of lrkf:ukf is 0.5, which gives all points the same weight; a name such as
            lrkf:ukf:kappa=0 sets another value. With the same kappa, ukf and lrkf:ukf are equal.
    """

    kappa: float = 0.0


class RegressionParameters(MethodParameters):  # type: ignore[explicit-any]
    """Options of methods that can use samples.

    Attributes:
        sampling: name of the sampling: ukf, or gf, rukf or s2kf with a number, such as s2kf-50.
        seed: seed of random samplings.
    """

    sampling: str = "ukf"
    seed: NonNegativeInt = 0


class SquareRootParameters(UnscentedParameters):  # type: ignore[explicit-any]
    """Options of square-root filters.

    Attributes:
        filter: the filter whose covariances are stored as factors.
    """

    filter: Literal["ekf", "ukf"] = "ekf"


@dataclass(frozen=True, eq=False)
class Method:
    """Method that estimates the state of any model.

    Attributes:
        summary: description in one line.
        parameters: type of its parameters.
        steps: function that makes the filter's steps for a bound model.
        sampling: function that makes the samples, for methods that use samples.
        lacks: function that describes what a model lacks for the method; "" if it lacks nothing.
        variant: parameter that is set by the part after the colon in a name such as `lrkf:s2kf-50`.
        made_for: function that returns the method that the parameters select, if there are several; it
            raises BadInput if the parameters name an unknown method.
        filtering: class that processes a log with the method, if it is not
            `fuselog.replay.inference.run.filtering.Filter`.
        takes_all_modes: whether the method uses all modes of a model instead of one motion.
        is_random: whether it draws random numbers, apart from its samples.
    """

    summary: str
    parameters: type[MethodParameters]
    steps: Callable[[BoundModel], Steps]
    sampling: Callable[[CombinedParameters], Sampling] | None = None
    lacks: Callable[[Model], str] = lambda _: ""
    variant: str | None = None
    made_for: Callable[[CombinedParameters], "Method"] | None = None
    filtering: MakeFilter | None = None
    takes_all_modes: bool = False
    is_random: bool = False


def _iterated(bound_model: BoundModel) -> Steps:
    updates = (iterated_update(bound_model, number) for number in range(len(bound_model.sensors)))
    return gaussian_filter(bound_model, linear_motion(bound_model), tuple(updates))


def _analytic(bound_model: BoundModel) -> Steps:
    motion = bound_model.motion
    predict = linear_motion(bound_model)
    if not motion.linear:
        predict = _exact_motion(bound_model)
    updates = tuple(
        kalman_update(
            bound_model,
            number,
            linear_sensor(bound_model, number) if sensor.linear else _exact_sensor(bound_model, number),
        )
        for number, sensor in enumerate(bound_model.sensors)
    )
    return gaussian_filter(bound_model, predict, updates)


def no_steps(bound_model: BoundModel) -> Steps:
    """Raise AssertionError, for methods whose actual steps are chosen by `Method.made_for`."""
    raise AssertionError("the method was not made for its parameters")


def _square_root(parameters: SquareRootParameters) -> Method:
    return _SQUARE_ROOTS[parameters.filter]


def _exact_motion(bound_model: BoundModel) -> Predict:
    model, motion = bound_model.model, bound_model.motion
    moments, add_noise = motion.moments, motion_noise(model, motion)
    assert moments is not None
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)

    def predict(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        control, duration_s, parameters, _ = interval
        state = read_state(mean)
        moments(mean, covariance, read_control(control), duration_s, parameters)
        add_noise(state, covariance, duration_s, parameters, work)
        return True

    return predict


def _exact_sensor(bound_model: BoundModel, number: int) -> Innovate:
    sensor = bound_model.sensors[number]
    moments, read_reference = sensor.moments, message_layout(sensor).reference
    assert moments is not None
    subtract = residual_of(sensor)

    def innovate(mean: Floats, covariance: Floats, measurement: Measurement, work: Workspace) -> bool:
        data, parameters, _, _ = measurement
        difference, spread, cross = work.innovations[number]
        predicted = work.predicted
        moments(mean, covariance, read_reference(data), parameters, predicted, spread, cross)
        subtract(data, predicted, difference)
        return True

    return innovate


def _lacks_slopes(model: Model) -> str:
    """Name a sensor whose components, linearised and including noise, are always linearly dependent.

    The covariance of their innovation is then singular, as for a coordinate and its square.
    """
    parameters = trial_parameters(model)
    for sensor in model.sensors:
        if sensor.noises and sensor.jacobian is None:
            m, reference = len(sensor.measured), (0.7,) * sensor.reference_size
            rows, gain = np.zeros((m, model.tangent)), np.zeros((m, sensor.noises))
            work = SimpleNamespace(predicted=np.empty(m), rows=rows, noise_gain=gain)
            try:
                own = traced_sensor(model, sensor, number_fields(model.parameters))
                sensor_derivative(model, own)(trial_state(model.kinds), reference, parameters, work)
            except Exception:  # reported when the model is bound, see `validation.check_sensor`
                continue
            if np.linalg.matrix_rank(np.concatenate([rows, gain], axis=1)) < m:
                return f"a regular linearisation of its sensor {sensor.topic}"
    return ""


def _lacks_moments(model: Model) -> str:
    motions = (model.modes or {"": model.motion}).values()
    if not all(motion.linear or motion.moments for motion in motions):
        return "exact moments of its motion"
    missing = [each.topic for each in model.sensors if not (each.linear or each.moments)]
    return f"exact moments of its sensor {missing[0]}" if missing else ""


FILTERS: Mapping[str, Method] = {
    "ekf": Method("extended Kalman filter", MethodParameters, extended, lacks=_lacks_slopes),
    "iekf": Method("iterated extended Kalman filter", MethodParameters, _iterated, lacks=_lacks_slopes),
    "ukf": Method(
        "unscented Kalman filter",
        UnscentedParameters,
        sampled,
        sampling=lambda parameters: Unscented(kappa=parameters.kappa),
    ),
    "lrkf": Method(
        "linear regression Kalman filter; the sampling follows the name, as in lrkf:s2kf-50",
        RegressionParameters,
        sampled,
        sampling=lambda parameters: parse_sampling(parameters.sampling),
        variant="sampling",
    ),
    "analytic": Method(
        "Kalman filter with the exact moments, which linear regression approximates",
        MethodParameters,
        _analytic,
        lacks=_lacks_moments,
    ),
    "sqrt": Method(
        "square-root filter for ill-conditioned covariances; the filter follows the name, as "
        "in sqrt:ukf",
        SquareRootParameters,
        no_steps,
        lacks=_lacks_slopes,
        variant="filter",
        made_for=_square_root,
    ),
}
_SQUARE_ROOTS = {
    "ekf": replace(FILTERS["ekf"], steps=partial(extended, parts=FACTORED)),
    "ukf": replace(FILTERS["ukf"], steps=partial(sampled, parts=FACTORED)),
}


def named_filter(text: str, method: str, use: str) -> tuple[str, str]:
    """Split a filter's name such as "lrkf:s2kf-50" into name and variant, for a method that contains it.

    Args:
        text: the given name.
        method: name of the method that uses the filter.
        use: use of the filter, in words, for the error message.

    Raises BadInput if there is no such filter.
    """
    name, _, variant = text.partition(":")
    if name not in FILTERS:
        raise BadInput(f"'{name}' is not a filter {use}; {choices(name, FILTERS)}")
    if variant and FILTERS[name].variant is None:
        raise BadInput(f"filter {name} has no variants; give '{method}:{name}' without ':{variant}'")
    return name, variant


@lru_cache(maxsize=64)
def filter_with(name: str, variant: str) -> Method:
    """Return a filter with its variant set, as in `lrkf:s2kf-50`."""
    chosen = FILTERS[name]
    if chosen.made_for is not None:
        given = {str(chosen.variant): variant} if variant else {}
        return chosen.made_for(build(chosen.parameters, given, f"filter {name}"))
    sampling = chosen.sampling
    if not variant or sampling is None:
        return chosen

    def sampling_of_variant(parameters: CombinedParameters) -> Sampling:
        return sampling(parameters.model_copy(update={chosen.variant: variant}))

    return replace(chosen, sampling=sampling_of_variant)
