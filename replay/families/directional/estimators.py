"""Estimators of axes, orientations and pairs of headings for replay.

The algorithms are in `bingham` and `torus`; this module binds them to streams. The channel states the
noise and the prior; parameters override them.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat, ValidationError

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.headings import Correlation, equal_sigmas
from fuselog.recorders.families.directional.noise import DirectionalNoise
from fuselog.recorders.log import Schema, schemas
from fuselog.recorders.models.orientation import AXIS_KINDS, ORIENTATION_KINDS
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Given, Messages
from fuselog.replay.engine.api.outputs import Results
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.replaying.estimator import Estimator
from fuselog.replay.engine.streams.measurements import Vectors
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.directional.bingham import (
    BinghamNoise,
    Gaussian,
    GaussianNoise,
    Steps,
    make_steps,
    run_bingham_filter,
    run_kalman_filter,
)
from fuselog.replay.families.directional.distributions import bingham
from fuselog.replay.families.directional.distributions.bingham import Bingham, make_bingham
from fuselog.replay.families.directional.distributions.wrapped_normal import WrappedNormal
from fuselog.replay.families.directional.torus import (
    HeadingModel,
    make_heading_model,
    run_toroidal_filter,
    run_unscented_filter,
)

# (states of all runs, their measurements) -> the states after them; it fills the results.
Advance = Callable[[Any, Messages, Results], Any]


class BinghamParameters(Parameters):
    """Distributions of the prior and the noise; by default, those that the channel of the log states.

    Attributes:
        prior: distribution of the orientation at the start.
        system: distribution of the rotation in a step.
        measurement: distribution of the rotation error of a measurement.
    """

    prior: DirectionalNoise | None = None
    system: DirectionalNoise | None = None
    measurement: DirectionalNoise | None = None


class KalmanParameters(BinghamParameters):
    """Distributions of the prior and the noise, and the way in which noise is added.

    Attributes:
        rotated: whether the noise is rotated into the state's frame; the paper adds it without rotation.
    """

    rotated: bool = False


class HeadingsFilterParameters(Parameters):
    """Parameters of the model of `headings`; by default, the values that the channel of the log states.

    Attributes:
        coupling_rad: in each step, the first heading changes by this angle times the cosine of the
            second, and the second by this angle times the sine of the first.
        drift1_rad: additional change of the first heading per step.
        drift2_rad: additional change of the second heading per step.
        system_sigma_rad: standard deviation of a heading's noise per step.
        system_correlation: correlation of the two headings' noises.
        measurement_sigma_rad: standard deviation of a measured heading.
        measurement_correlation: correlation of the two measured headings' errors.
    """

    coupling_rad: float | None = None
    drift1_rad: float | None = None
    drift2_rad: float | None = None
    system_sigma_rad: PositiveFloat | None = None
    system_correlation: Correlation | None = None
    measurement_sigma_rad: PositiveFloat | None = None
    measurement_correlation: Correlation | None = None


class TorusParameters(HeadingsFilterParameters):
    """Parameters of the model of `headings`, and of the samples of the filter.

    Attributes:
        central_weight: weight of the central sample among the five (w5 in the paper).
    """

    central_weight: Annotated[float, Field(ge=0, le=0.5)] = 0.2


class UnscentedTorusParameters(HeadingsFilterParameters):
    """Parameters of the model of `headings`, and treatment of the innovation's angles.

    Attributes:
        wrapped: whether the innovation is wrapped to [-pi, pi); if not, only the angles are reduced
            modulo 2 pi.
    """

    wrapped: bool = True


class Distributions(NamedTuple):
    """The prior and both noises."""

    prior: DirectionalNoise
    system: DirectionalNoise
    measurement: DirectionalNoise


def follow_all(advance: Advance, messages: Messages, state: Any, results: Results) -> None:
    """Process the measurements of all runs."""
    for part, changed in zip(state, advance(state, messages, results), strict=True):
        part[:] = changed


def distributions(given: Given[Any], topic: str, d: int) -> Distributions:
    """Return the prior and the noise; raise BadInput if one is missing or does not have d components."""
    found = {}
    for name in Distributions._fields:
        value = getattr(given.parameters, name)
        try:
            found[name] = value or DirectionalNoise.model_validate_json(
                given.topics[topic].metadata[name]
            )
        except (KeyError, ValidationError):
            raise BadInput(
                f"topic {given.topics[topic].name} does not state its {name}; give it with "
                f"--set {name}.diagonal=[...]"
            ) from None
        if len(found[name].diagonal) != d:
            raise BadInput(
                f"{name} has {len(found[name].diagonal)} numbers for {d} components; give one for each"
            )
    return Distributions(**found)


def as_bingham(noise: DirectionalNoise) -> Bingham:
    """Return the Bingham distribution, or fit one to a Gaussian's projection on the sphere."""
    d = len(noise.diagonal)
    if noise.distribution == "bingham":
        return make_bingham(np.eye(d), noise.diagonal)
    try:
        return bingham.fit_projected_gaussian(np.eye(d)[0], np.diag(noise.diagonal))
    except BadInput as error:
        raise BadInput(f"Gaussian noise with the variances {noise.diagonal}: {error}") from None


def as_covariance(noise: DirectionalNoise) -> Floats:
    """Return the Gaussian's covariance (d, d), or that of a Bingham distribution by (57)."""
    if noise.distribution == "gaussian":
        return np.diag(noise.diagonal)
    return bingham.hemisphere_covariance(as_bingham(noise))


def _start_bingham(topic: str, d: int, given: Given[BinghamParameters]) -> tuple[Advance, Bingham]:
    stated = distributions(given, topic, d)
    noise = BinghamNoise(as_bingham(stated.system), as_bingham(stated.measurement))

    def advance(state: Bingham, messages: Messages, results: Results) -> Bingham:
        after, found = run_bingham_filter(noise, state, _steps(messages), results.covariance)
        results.mean[:] = found.mode
        return after

    return advance, _widened(as_bingham(stated.prior), given.runs)


def _start_kalman(topic: str, d: int, given: Given[KalmanParameters]) -> tuple[Advance, Gaussian]:
    stated = distributions(given, topic, d)
    noise = GaussianNoise(as_covariance(stated.system), as_covariance(stated.measurement))
    mode = np.eye(d)[0] if stated.prior.distribution == "gaussian" else as_bingham(stated.prior).mode

    def advance(state: Gaussian, messages: Messages, results: Results) -> Gaussian:
        rotated, steps = given.parameters.rotated, _steps(messages)
        after, found = run_kalman_filter(noise, state, steps, results.covariance, rotated=rotated)
        results.mean[:] = found.mean
        return after

    return advance, _widened(Gaussian(mode, as_covariance(stated.prior)), given.runs)


def _steps(messages: Messages) -> Steps:
    """Make steps without control input."""
    count, d = messages.value.shape
    return make_steps(messages.offsets, np.tile(np.eye(d)[0], (count, 1)), messages.value)


def _widened(state: Any, runs: int) -> Any:
    """Repeat a state without batch axes for every run."""
    return type(state)(*(np.repeat(part[None], runs, axis=0) for part in state))


def heading_model(given: Given[Any]) -> HeadingModel:
    """Return the model defined by the parameters; the channel defines those that are not set."""
    stated = {name: given.stated("headings", name) for name in HeadingsFilterParameters.model_fields}
    system, measurement = (
        equal_sigmas(stated[f"{which}_sigma_rad"], stated[f"{which}_correlation"])
        for which in ("system", "measurement")
    )
    drift_rad = (stated["drift1_rad"], stated["drift2_rad"])
    return make_heading_model(stated["coupling_rad"], drift_rad, system, measurement)


def _start_headings(
    filter_of: Callable[[Any], Callable[..., tuple[WrappedNormal, WrappedNormal]]], given: Given[Any]
) -> tuple[Advance, WrappedNormal]:
    model, run_filter = heading_model(given), filter_of(given.parameters)
    _, mean, covariance = given.prior("prior")

    def advance(state: WrappedNormal, messages: Messages, results: Results) -> WrappedNormal:
        after, found = run_filter(model, state, messages.offsets, messages.value)
        results.mean[:], results.covariance[:] = found
        return after

    return advance, WrappedNormal(mean, covariance)


def _of_unit_vectors(
    summary: str,
    parameters: type[Any],
    schema: Schema,
    kinds: Mapping[str, str],
    start: Callable[[str, int, Given[Any]], tuple[Advance, Any]],
) -> Estimator[Any]:
    topic = {schemas.AXIS: "axis", schemas.ORIENTATION: "quaternion"}[schema]
    return recursive(
        summary,
        parameters=parameters,
        streams={topic: schema},
        static={},
        components=kinds,  # type: ignore[arg-type]
        truth="truth",
        vectors={topic: Vectors({topic: len(kinds)})},
        start=partial(start, topic, len(kinds)),
        follow_all=follow_all,
    )


HeadingFilter = partial[tuple[WrappedNormal, WrappedNormal]]


def _of_headings(
    summary: str, parameters: type[Any], filter_of: Callable[[Any], HeadingFilter]
) -> Estimator[Any]:
    components: Components = {"heading1_rad": "angle", "heading2_rad": "angle"}
    return recursive(
        summary,
        parameters=parameters,
        streams={"headings": schemas.VECTOR_MEASUREMENT},
        static={"prior": schemas.GAUSSIAN_ESTIMATE},
        components=components,
        truth="truth",
        vectors={"headings": Vectors({"value": components})},
        start=partial(_start_headings, filter_of),
        follow_all=follow_all,
    )


def _toroidal(parameters: TorusParameters) -> HeadingFilter:
    return partial(run_toroidal_filter, central_weight=parameters.central_weight)


def _unscented(parameters: UnscentedTorusParameters) -> HeadingFilter:
    return partial(run_unscented_filter, wrapped=parameters.wrapped)


_BINGHAM = "recursive Bingham filter for "
_KALMAN = "Kalman filter, modified for unit vectors, for "
_AXIS, _ORIENTATION = (schemas.AXIS, AXIS_KINDS), (schemas.ORIENTATION, ORIENTATION_KINDS)
BINGHAM_AXIS = _of_unit_vectors(f"{_BINGHAM}an axis", BinghamParameters, *_AXIS, _start_bingham)
KALMAN_AXIS = _of_unit_vectors(f"{_KALMAN}an axis", KalmanParameters, *_AXIS, _start_kalman)
BINGHAM_ORIENTATION = _of_unit_vectors(
    f"{_BINGHAM}an orientation", BinghamParameters, *_ORIENTATION, _start_bingham
)
KALMAN_ORIENTATION = _of_unit_vectors(
    f"{_KALMAN}an orientation", KalmanParameters, *_ORIENTATION, _start_kalman
)
TORUS = _of_headings("recursive toroidal filter for two headings", TorusParameters, _toroidal)
UKF_TORUS = _of_headings(
    "unscented Kalman filter for two headings", UnscentedTorusParameters, _unscented
)
