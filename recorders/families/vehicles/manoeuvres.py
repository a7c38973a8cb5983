"""A vehicle that drives, turns, brakes, stands and starts again, and its position fixes.

The vehicle drives at a constant speed between manoeuvres. A turn is an arc at that speed; the vehicle
stops only on straight parts. The durations of driving and standing are random.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.common_streams import fix_stream, prior_stream, stated_numbers, truth_stream
from fuselog.recorders.models.planar import drive
from fuselog.recorders.models.states import PLANE_MOTION
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]


class ManoeuvresParameters(Parameters):
    """A vehicle that drives straight, turns, stops and starts, and its position fixes.

    standard deviation of the acceleration that the prior's channel states for driving straight; the true
    acceleration is zero then.

    Attributes:
        duration_s: length of the run.
        speed_mps: speed except while braking, standing or starting.
        straight_s: mean duration of a straight part (exponential).
        turn_radps: turn rate in a turn.
        brake_mps2: deceleration when stopping.
        start_mps2: acceleration when starting again.
        standing_s: mean duration of a stop (exponential).
        acceleration_sigma_mps2: standard deviation of the acceleration that the prior's channel states
            for driving straight; the truth has none.
        fix_rate_hz: position fixes per second.
        fix_sigma_m: standard deviation of a fix, per axis.
        prior_sigma_m: standard deviation of the position in the prior, per axis.
        prior_sigma_mps: standard deviation of the velocity in the prior, per axis.
    """

    duration_s: PositiveFloat = 120.0
    speed_mps: PositiveFloat = 10.0
    straight_s: PositiveFloat = 8.0
    turn_radps: PositiveFloat = 0.3
    brake_mps2: PositiveFloat = 2.5
    start_mps2: PositiveFloat = 2.0
    standing_s: PositiveFloat = 8.0
    acceleration_sigma_mps2: NonNegativeFloat = 0.2
    fix_rate_hz: PositiveFloat = 2.0
    fix_sigma_m: PositiveFloat = 1.0
    prior_sigma_m: PositiveFloat = 2.0
    prior_sigma_mps: PositiveFloat = 1.0


class Part(NamedTuple):
    """A part of a drive: duration, turn rate, and acceleration along the track."""

    duration_s: float
    turn_radps: float
    acceleration_mps2: float


def simulate(parameters: ManoeuvresParameters, rng: np.random.Generator) -> Recording:
    """Record one run."""
    drive_rng, fix_rng, prior_rng = rng.spawn(3)
    count = int(parameters.duration_s * parameters.fix_rate_hz + 1e-9)
    times_s = np.arange(count + 1) / parameters.fix_rate_hz
    states = _states(parameters, times_s, drive_rng)
    stamps_ns = simulation_stamps_ns(times_s)
    sigma = np.array([parameters.prior_sigma_m, parameters.prior_sigma_mps] * 2)
    fixes = states[1:, 0::2] + parameters.fix_sigma_m * fix_rng.normal(size=(count, 2))
    motion = {"turn_rate_radps": "0.0", **stated_numbers(parameters, "acceleration_sigma_mps2")}
    prior = states[0] + sigma * prior_rng.normal(size=4)
    return Recording(
        [
            prior_stream(
                "/vehicle1/prior", stamps_ns[0], PLANE_MOTION, prior, np.diag(sigma**2), motion
            ),
            truth_stream("/vehicle1/truth", stamps_ns, PLANE_MOTION, states),
            fix_stream("/vehicle1/fix", stamps_ns[1:], fixes, parameters.fix_sigma_m**2),
        ]
    )


def _states(parameters: ManoeuvresParameters, times_s: Floats, rng: np.random.Generator) -> Floats:
    """Compute the true states (n, 4), x, vx, y, vy, at times within the drive."""
    states, begin_s = np.empty((len(times_s), 4)), 0.0
    pose, speed = (0.0, 0.0, rng.uniform(-np.pi, np.pi)), parameters.speed_mps

    def after(part: Part, span_s: Floats) -> tuple[Floats, ...]:
        """Compute poses and speeds at durations after the beginning of a part."""
        mean_mps = speed + 0.5 * part.acceleration_mps2 * span_s
        moved = drive(pose, (mean_mps, part.turn_radps), span_s)
        return *moved, speed + part.acceleration_mps2 * span_s

    while begin_s <= times_s[-1]:
        for part in _parts(parameters, rng):
            span_s = times_s - begin_s
            own = (span_s >= 0.0) & (span_s < part.duration_s)
            x, y, heading, along = after(part, span_s[own])
            states[own] = np.stack([x, along * np.cos(heading), y, along * np.sin(heading)], axis=1)
            *place, end_mps = (float(each) for each in after(part, np.array(part.duration_s)))
            pose, speed = (place[0], place[1], place[2]), max(end_mps, 0.0)
            begin_s += part.duration_s
    return states


def _parts(parameters: ManoeuvresParameters, rng: np.random.Generator) -> list[Part]:
    """Draw a straight part and the manoeuvre after it: a turn, or a stop and a start."""
    straight = Part(rng.exponential(parameters.straight_s), 0.0, 0.0)
    if rng.uniform() < 0.5:
        way, angle = rng.choice([-1.0, 1.0]), rng.uniform(np.pi / 3, 5 * np.pi / 6)
        return [straight, Part(angle / parameters.turn_radps, way * parameters.turn_radps, 0.0)]
    brake_mps2, start_mps2 = parameters.brake_mps2, parameters.start_mps2
    return [
        straight,
        Part(parameters.speed_mps / brake_mps2, 0.0, -brake_mps2),
        Part(rng.exponential(parameters.standing_s), 0.0, 0.0),
        Part(parameters.speed_mps / start_mps2, 0.0, start_mps2),
    ]


MANOEUVRES = Simulator(
    "a vehicle that drives straight, turns, stops and starts; its fixes", ManoeuvresParameters, simulate
)
