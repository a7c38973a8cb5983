"""Where inertial navigation starts from: levelled at rest, its heading from the course.

Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 2013,
section 5.6: roll and pitch from the specific force, of which gravity is all while nothing accelerates;
the gyro's bias from what it says at rest; the heading from the first course that is worth one.
"""

from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from recorders.errors import BadInput
from recorders.log import Stream
from recorders.models.inertial import from_mounting, product, rotation
from recorders.parameters import Parameters
from replay.engine.arrays import Floats

_NS = 1e-9


class AlignmentParameters(Parameters):
    """What is taken for rest and for a course, and how well the start is known then.

    The body rests until `rest_margin_s` before it first moves faster than `still_mps`. Its heading is
    the course at the first speed above `course_mps`, less what the gyro has turned until then; where
    there is none, the heading is unknown. Standard deviations are of the first position, its velocity,
    the tilt, the heading and the biases.
    """

    level_s: PositiveFloat = 1.0
    still_mps: PositiveFloat = 0.2
    rest_margin_s: NonNegativeFloat = 1.0
    course_mps: PositiveFloat = 1.0
    start_sigma_m: PositiveFloat = 0.05
    start_sigma_mps: PositiveFloat = 0.1
    tilt_sigma_rad: PositiveFloat = np.radians(3.0)
    heading_sigma_rad: PositiveFloat = np.radians(20.0)
    gyro_bias_sigma_radps: PositiveFloat = np.radians(0.2)
    force_bias_sigma_mps2: PositiveFloat = 0.3


class Start(NamedTuple):
    """The first Gaussian of a run: its stamp, mean (16,) and covariance (15, 15); see `navigation`."""

    time_ns: int
    mean: Floats
    covariance: Floats


def aligned(
    inertial: Stream,
    fix: Stream,
    velocity: Stream,
    mounting_rad: tuple[float, float, float],
    parameters: AlignmentParameters,
) -> Start:
    """Where to start from, at the first fix and velocity that the inertial samples have begun before.

    Args:
        inertial: samples of the unit, whose mounting is roll, pitch and yaw, see `from_mounting`.
        fix: positions in the plane, east, north, up.
        velocity: velocities there, of equal stamps.
        mounting_rad: how the unit is mounted.
        parameters: what is taken for granted.

    Raises BadInput where there is no such fix, or no samples to level.
    """
    time_ns = inertial.publish_time_ns
    force, rate = (
        np.stack(from_mounting(*mounting_rad, inertial[name].T), axis=1)
        for name in ("specific_force_mps2", "turn_rate_radps")
    )
    if not len(inertial):
        raise BadInput(f"topic {inertial.topic}: no samples to align with")
    covered = (fix.publish_time_ns >= time_ns[0]) & (fix.publish_time_ns <= time_ns[-1])
    common = np.flatnonzero(covered & np.isin(fix.publish_time_ns, velocity.publish_time_ns))
    if not len(common):
        raise BadInput(
            f"topics {fix.topic} and {velocity.topic}: no position and velocity of one stamp within the "
            f"span of {inertial.topic}; do their clocks agree?"
        )
    start_ns = int(fix.publish_time_ns[common[0]])
    first = int(np.searchsorted(velocity.publish_time_ns, start_ns))
    speed = np.hypot(*velocity["velocity_mps"].T[:2])

    def first_above(limit_mps: float) -> int:
        """The first velocity from the start on of a greater speed; their number where there is none."""
        return first + int(np.argmax(np.append(speed[first:] > limit_mps, True)))

    stamps_ns = np.append(velocity.publish_time_ns, time_ns[-1])
    still_ns = stamps_ns[first_above(parameters.still_mps)] - round(parameters.rest_margin_s / _NS)
    at_rest = time_ns < still_ns
    bias = rate[at_rest].mean(axis=0) if at_rest.any() else np.zeros(3)
    x, y, z = force[time_ns < time_ns[0] + round(parameters.level_s / _NS)].mean(axis=0)
    roll, pitch = np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))
    heading, heading_sigma_rad = 0.0, np.pi
    fast = first_above(parameters.course_mps)
    if fast < len(velocity):
        since = (time_ns >= start_ns) & (time_ns <= stamps_ns[fast])
        up = np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
        turned = np.trapezoid((rate[since] - bias) @ up, (time_ns[since] - start_ns) * _NS)
        east, north, _ = velocity["velocity_mps"][fast]
        heading, heading_sigma_rad = np.arctan2(north, east) - turned, parameters.heading_sigma_rad
    tilted = product(rotation(0.0, pitch, 0.0), rotation(roll, 0.0, 0.0))
    orientation = product(rotation(0.0, 0.0, heading), tilted)
    place, moving = fix["position_m"][common[0]], velocity["velocity_mps"][first]
    sigma = np.repeat(
        [
            parameters.start_sigma_m,
            parameters.start_sigma_mps,
            parameters.tilt_sigma_rad,
            parameters.gyro_bias_sigma_radps,
            parameters.force_bias_sigma_mps2,
        ],
        3,
    )
    sigma[8] = heading_sigma_rad
    mean = np.concatenate([place, moving, orientation, bias, np.zeros(3)])
    return Start(start_ns, mean, np.diag(sigma**2))
