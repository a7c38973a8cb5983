"""Reads the inertial samples and velocities that an alignment begins with."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from recorders.log import Stream
from recorders.models.inertial import from_mounting
from recorders.models.states import NAVIGATION
from replay.engine.arrays import Floats, Integers
from replay.engine.streams.measurements import read_fixes
from replay.engine.vectors.components import components_of

STANDARD_GRAVITY_MPS2 = 9.80665
USUAL_SIGMA_M, USUAL_SIGMA_MPS = 10.0, 0.5  # of a receiver that does not say how well it measures
VELOCITY = components_of(NAVIGATION[3:6])
NS = 1e-9


class InertialSamples(NamedTuple):
    """A unit's samples in the body's axes: times (n,), specific force and turn rate (n, 3)."""

    time_ns: Integers
    force: Floats
    rate: Floats


class ReceiverVelocities(NamedTuple):
    """A receiver's velocities: when they were of (n,), velocities (n, 3), covariances (n, 3, 3)."""

    topic: str
    time_ns: Integers
    mps: Floats
    covariance: Floats

    def first_above(self, row: int, limit_mps: float) -> int | None:
        """The first row from this one on with a greater horizontal speed."""
        faster = np.flatnonzero(np.hypot(*self.mps[row:, :2].T) > limit_mps)
        return row + int(faster[0]) if len(faster) else None


def mounted(sample: Any, parameters: Any) -> Any:
    """What the unit measures, in the body's axes; three components, or columns of them."""
    roll, pitch = parameters.mounting_roll_rad, parameters.mounting_pitch_rad
    return from_mounting(roll, pitch, parameters.mounting_yaw_rad, sample)


def read_samples(inertial: Stream, parameters: Any) -> InertialSamples:
    """The finite samples at the times at which they were measured."""
    columns = [
        np.stack(mounted(inertial[name].T, parameters), axis=1)
        for name in ("specific_force_mps2", "turn_rate_radps")
        if len(inertial)
    ]
    finite = np.isfinite(np.hstack(columns)).all(axis=1) if columns else np.zeros(0, bool)
    if not finite.any():
        raise BadInput(f"topic {inertial.topic}: has no samples to begin with")
    time_ns = inertial.publish_time_ns[finite] - round(parameters.inertial_delay_s / NS)
    force, rate = (column[finite] for column in columns)
    return InertialSamples(time_ns, force, rate)


def stated_or(sigma: float | None, otherwise: Any) -> Any:
    """A parameter that may not be given, which is None, or NaN among the numbers that a filter has."""
    return otherwise if sigma is None or np.isnan(sigma) else sigma


def read_motion(streams: Mapping[str, Stream], parameters: Any) -> ReceiverVelocities | None:
    """The velocities that are finite; None where there are none."""
    stream = streams.get("velocity")
    if stream is None:
        return None
    sigma = stated_or(parameters.sigma_velocity_mps, USUAL_SIGMA_MPS)
    found = read_fixes(stream, "velocity_mps", "covariance_m2ps2", VELOCITY, sigma)
    finite = np.isfinite(found.value).all(axis=1)
    if not finite.any():
        return None
    time_ns = stream.publish_time_ns - round(parameters.velocity_delay_s / NS)
    return ReceiverVelocities(
        stream.topic, time_ns[finite], found.value[finite], found.covariance[finite]
    )
