"""Estimators of orientation from inertial samples for replay; see `inertial`."""

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.log import schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Given, Messages
from fuselog.replay.engine.api.outputs import Results
from fuselog.replay.engine.replaying.estimator import Estimator
from fuselog.replay.engine.streams.measurements import Vectors
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.directional.orientation.inertial import (
    InertialModel,
    InertialSamples,
    OrientationEstimates,
    attitudes,
    run_inertial_filter,
    start_inertial_filter,
)
from fuselog.replay.families.directional.orientation.magnetometers import with_magnetometer
from fuselog.replay.families.directional.orientation.reckoning import run_dead_reckoning, start_reckoning
from fuselog.replay.families.directional.orientation.resting import LONGEST_S, of_nine_axes, rests_of

ORIENTATION: Components = {f"orientation_{part}": "quaternion" for part in "wxyz"}
FIELDS = ("specific_force_mps2", "turn_rate_radps", "magnetic_field_ut")
Advance = Callable[
    [InertialModel, Any, InertialSamples, OrientationEstimates], tuple[Any, OrientationEstimates]
]


class InertialParameters(Parameters):
    """Noise and averaging of inertial samples, the same for all logs.

    Attributes:
        rest_s: duration of the stationary period at the start; if not set, it is detected in the log and
            is at most 20 s.
        block_s: averaging time, in s, of an attitude from accelerometer and magnetometer.
        attitude_sigma_deg: standard deviation of the attitude from accelerometer and magnetometer, in
            deg.
        drift_sigma_deg: random walk of the orientation due to the gyro's noise, in deg/sqrt(s).
        gap_s: time between two samples, in s, above which the orientation becomes unknown.
    """

    rest_s: NonNegativeFloat | None = None
    block_s: PositiveFloat = 1.0
    attitude_sigma_deg: Annotated[float, Field(gt=0, le=90)] = 10.0
    drift_sigma_deg: Annotated[float, Field(gt=0, le=90)] = 0.4
    gap_s: PositiveFloat = 0.1

    @property
    def model(self) -> InertialModel:
        """Return the model with angles in radians."""
        return InertialModel(
            rest_s=LONGEST_S if self.rest_s is None else self.rest_s,
            block_s=self.block_s,
            attitude_sigma_rad=math.radians(self.attitude_sigma_deg),
            drift_sigma_rad=math.radians(self.drift_sigma_deg),
            gap_s=self.gap_s,
        )


class GyroParameters(InertialParameters):
    """Noise and averaging of inertial samples, and treatment of the gyro's bias.

    Attributes:
        unbiased: whether the gyro's mean during the stationary period is subtracted.
    """

    unbiased: bool = True


def _follow_all(
    settings: tuple[InertialModel, Advance], messages: Messages, state: Any, results: Results
) -> None:
    """Process the samples of all runs; `value` has specific force, turn rate and magnetic field."""
    model, advance = settings
    force, rate, field = np.split(messages.value, 3, axis=1)
    samples = InertialSamples(messages.offsets, messages.time_ns, rate, force, field)
    after, _ = advance(model, state, samples, OrientationEstimates(results.mean, results.covariance))
    for part, changed in zip(state, after, strict=True):
        part[:] = changed


def of_inertial_samples(
    summary: str,
    parameters: type[Any],
    start: Callable[[Given[Any]], tuple[Any, Any]],
    *,
    follow: Callable[..., None] | None = None,
    follow_all: Callable[..., None] | None = None,
) -> Estimator[Any]:
    """Make an estimator of orientation from nine-axis samples; see `recursive`."""
    return recursive(
        summary,
        parameters=parameters,
        streams={"inertial": schemas.INERTIAL_SAMPLE},
        static={},
        components=ORIENTATION,
        truth="truth",
        vectors={"inertial": Vectors(dict.fromkeys(FIELDS, 3))},
        start=start,
        follow=follow,
        follow_all=follow_all,
    )


def _start_bingham(given: Given[InertialParameters]) -> tuple[tuple[InertialModel, Advance], Any]:
    return (given.parameters.model, run_inertial_filter), start_inertial_filter(
        given.runs, rests_of(given, given.runs)
    )


def _start_gyro(given: Given[GyroParameters]) -> tuple[tuple[InertialModel, Advance], Any]:
    advance = partial(run_dead_reckoning, unbiased=given.parameters.unbiased)
    return (given.parameters.model, advance), start_reckoning(given.runs, rests_of(given, given.runs))


def _start_triad(given: Given[InertialParameters]) -> tuple[tuple[InertialModel, Advance], Any]:
    def advance(
        model: InertialModel, state: Any, samples: InertialSamples, estimates: OrientationEstimates
    ) -> tuple[Any, OrientationEstimates]:
        return state, attitudes(model, samples, estimates)

    return (given.parameters.model, advance), start_reckoning(given.runs)


BINGHAM_INERTIAL = of_nine_axes(
    of_inertial_samples(
        "recursive Bingham filter for gyro increments and averaged TRIAD attitudes",
        InertialParameters,
        _start_bingham,
        follow_all=_follow_all,
    )
)
GYRO = of_nine_axes(
    of_inertial_samples(
        "dead reckoning with the gyro only, from the attitude of the initial rest",
        GyroParameters,
        _start_gyro,
        follow_all=_follow_all,
    )
)
TRIAD = with_magnetometer(
    of_inertial_samples(
        "TRIAD attitude from the accelerometer and magnetometer of every sample",
        InertialParameters,
        _start_triad,
        follow_all=_follow_all,
    )
)
