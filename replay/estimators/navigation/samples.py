"""The inertial samples and velocities that an alignment uses."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.inertial import from_mounting
from fuselog.recorders.models.states import NAVIGATION
from fuselog.recorders.units import STANDARD_GRAVITY_MPS2
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.measurements import read_fixes
from fuselog.replay.engine.vectors.components import components_of

USUAL_SIGMA_M, USUAL_SIGMA_MPS = 10.0, 0.5  # for receivers that do not state their accuracy
VELOCITY = components_of(NAVIGATION[3:6])
NS = 1e-9


class ImuSamples(NamedTuple):
    """Samples of an inertial unit in body axes: times (n,), specific forces and turn rates (n, 3)."""

    time_ns: Integers
    force: Floats
    rate: Floats


class GnssMotion(NamedTuple):
    """Velocities (n, 3) of a receiver, their covariances (n, 3, 3) and times of measurement (n,)."""

    topic: str
    time_ns: Integers
    mps: Floats
    covariance: Floats

    def first_above(self, row: int, limit_mps: float) -> int | None:
        """Return the first row, from `row` on, whose horizontal speed exceeds the limit."""
        faster = np.flatnonzero(np.hypot(*self.mps[row:, :2].T) > limit_mps)
        return row + int(faster[0]) if len(faster) else None


def mounted(sample: Any, parameters: Any) -> Any:
    """Rotate one measurement of the unit, or columns of measurements, to the body's axes."""
    roll, pitch = parameters.mounting_roll_rad, parameters.mounting_pitch_rad
    return from_mounting(roll, pitch, parameters.mounting_yaw_rad, sample)


def read_samples(inertial: Stream, parameters: Any) -> ImuSamples:
    """Return the finite samples with their times of measurement."""
    columns = [
        np.stack(mounted(inertial[name].T, parameters), axis=1)
        for name in ("specific_force_mps2", "turn_rate_radps")
        if len(inertial)
    ]
    finite = np.isfinite(np.hstack(columns)).all(axis=1) if columns else np.zeros(0, bool)
    if not finite.any():
        raise BadInput(
            f"topic {inertial.topic}: no sample has both specific force and turn rate, as a start needs"
        )
    time_ns = inertial.publish_time_ns[finite] - round(parameters.inertial_delay_s / NS)
    force, rate = (column[finite] for column in columns)
    return ImuSamples(time_ns, force, rate)


def stated_or(sigma: float | None, otherwise: Any) -> Any:
    """Return a parameter, or `otherwise` if it is None or NaN."""
    return otherwise if sigma is None or np.isnan(sigma) else sigma


def read_motion(streams: Mapping[str, Stream], parameters: Any) -> GnssMotion | None:
    """Return the finite velocities; None if there are none."""
    stream = streams.get("velocity")
    if stream is None:
        return None
    sigma = stated_or(parameters.sigma_velocity_mps, USUAL_SIGMA_MPS)
    found = read_fixes(stream, "velocity_mps", "covariance_m2ps2", VELOCITY, sigma)
    finite = np.isfinite(found.value).all(axis=1)
    if not finite.any():
        return None
    time_ns = stream.publish_time_ns - round(parameters.velocity_delay_s / NS)
    return GnssMotion(stream.topic, time_ns[finite], found.value[finite], found.covariance[finite])


PLUMB_SIGMA_RAD = 1e-4  # deflection of the plumb line from the ellipsoid's normal


def unsteadiness(samples: ImuSamples, motion: GnssMotion | None, parameters: Any) -> float:
    """Compute the standard deviation, in m/s2, of the mean specific force of the first samples.

    It includes the spread of the samples and the change of the velocity during this time.
    """
    begin_ns = samples.time_ns[0]
    until_ns = begin_ns + round(parameters.level_s / NS)
    spread = samples.force[samples.time_ns < until_ns].std(axis=0)
    changed = np.zeros(3)
    if motion is not None:
        ends = np.interp([begin_ns, until_ns], motion.time_ns, np.arange(len(motion.time_ns)))
        first, last = np.rint(ends).astype(int)
        changed = (motion.mps[last] - motion.mps[first]) / parameters.level_s
    plumb = PLUMB_SIGMA_RAD * STANDARD_GRAVITY_MPS2
    return float(np.sqrt(np.mean(spread**2) + np.mean(changed[:2] ** 2) + plumb**2))
