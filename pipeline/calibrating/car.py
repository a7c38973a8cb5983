"""Simulates a car whose calibration is to be found: wheels, fixes of an antenna, a compass; each errs.

Scales and the bias are of the readings by the motion here; the model's, of the motion by the readings,
are in `OURS`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.diagnosing.battery.car import Floats, Truth, arcs, philox, stamps_ns
from fuselog.recorders.common_streams import fix_stream
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

Motion = Callable[[Floats], tuple[Floats, Floats]]
SPEED_MPS, CIRCLE_S = 8.0, 15.708
# speed's and turn rate's factor, turn rate's bias, lever, delay of fixes, angle of the compass
TRUTH = np.array([1.03, 0.98, 0.01, 1.2, -0.4, 0.15, 0.05])
# the same as the model has them
OURS = np.array([1.0 / TRUTH[0], 1.0 / TRUTH[1], -TRUTH[2] / TRUTH[1], *TRUTH[3:]])
NAMES = (
    *("forward_scale", "turn_scale", "turn_bias_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "bias_heading_rad"),
)


def rich(time_s: Floats) -> tuple[Floats, Floats]:
    """Return a speed and a turn rate that determine everything."""
    return 8.0 + 3.0 * np.sin(0.4 * time_s), 0.25 * np.sin(0.21 * time_s) + 0.15 * np.sin(0.53 * time_s)


def straight(time_s: Floats) -> tuple[Floats, Floats]:
    """Drive straight on at 8 m/s."""
    return np.full_like(time_s, SPEED_MPS), 0.0 * time_s


def changing_speed(time_s: Floats) -> tuple[Floats, Floats]:
    """Drive straight on, now slower and now faster."""
    return SPEED_MPS + 4.0 * np.sin(0.4 * time_s), 0.0 * time_s


def circle(time_s: Floats) -> tuple[Floats, Floats]:
    """Return a circle of 20 m."""
    return np.full_like(time_s, SPEED_MPS), np.full_like(time_s, 0.4)


def circles(time_s: Floats) -> tuple[Floats, Floats]:
    """Drive such circles to the left and to the right, in turn."""
    is_left = time_s // CIRCLE_S % 2 == 0
    return np.full_like(time_s, SPEED_MPS), np.where(is_left, 0.4, -0.4)


def slalom(time_s: Floats) -> tuple[Floats, Floats]:
    """Return a slalom at 8 m/s."""
    return np.full_like(time_s, SPEED_MPS), 0.4 * np.sin(0.8 * time_s)


MOTIONS: dict[str, Motion] = {
    "straight": straight,
    "changing speed": changing_speed,
    "circle": circle,
    "circles in both senses": circles,
    "slalom": slalom,
    "turns at changing speed": rich,
}


class Steps(NamedTuple):
    """States the times between messages of wheels, fixes and compass, in s."""

    odometry_s: float = 0.1
    fix_s: float = 0.5
    compass_s: float = 0.2


STEPS = Steps()


class Measured(NamedTuple):
    """Holds what the car's log has, each with its stamps: odometry (n, 2), fixes (m, 2), compass."""

    odometry_s: Floats
    odometry: Floats
    fix_s: Floats
    fix_m: Floats
    compass_s: Floats
    compass_rad: Floats


def drive(
    seed: int | None,
    motion: Motion = rich,
    duration_s: float = 120.0,
    errors: Floats = TRUTH,
    steps: Steps = STEPS,
) -> Measured:
    """Simulate a drive of the car, and what its sensors measure.

    Args:
        seed: of the noise and of the first pose; without one there is no noise, and the car starts at
            zero.
        motion: gives speeds in m/s and turn rates in rad/s at times (n,) in s.
        duration_s: how long it drives.
        errors: (7,), what is wrong with the sensors, as `TRUTH` has it.
        steps: how often each sensor measures.

    Returns:
        What was measured, with its stamps.
    """
    step_s = steps.odometry_s
    n, m = round(duration_s / step_s), round(duration_s / steps.fix_s) - 1
    fix_s = steps.fix_s * (2.0 + np.arange(m))
    compass_s = steps.compass_s * np.arange(round(duration_s / steps.compass_s) + 1)
    rng = philox(seed or 0)
    draws = [rng.standard_normal(size) for size in (3, (n, 2), (m, 2), len(compass_s))]
    start, wheels, fixes, compass = (each * (seed is not None) for each in draws)
    speed, turn = motion((np.arange(n) + 0.5) * step_s)
    begin = start * [10.0, 10.0, 0.1]
    before = begin[2] + np.concatenate([[0.0], np.cumsum(turn * step_s)])
    moved = np.cumsum(arcs(before[:-1], speed, turn, np.full(n, step_s)), axis=0)
    truth = Truth(step_s, speed, turn, begin + np.concatenate([np.zeros((1, 3)), moved]))
    a_v, a_w, b_w, l_x, l_y, tau, psi = errors
    pose = truth.at(fix_s - tau)
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    arm = np.stack([cosine * l_x - sine * l_y, sine * l_x + cosine * l_y], axis=1)
    noise = np.array([0.05, 0.01]) / np.sqrt(step_s) * wheels
    return Measured(
        step_s * np.arange(n),
        np.stack([a_v * (speed + noise[:, 0]), a_w * (turn + noise[:, 1]) + b_w], axis=1),
        fix_s,
        pose[:, :2] + arm + 0.3 * fixes,
        compass_s,
        truth.at(compass_s)[:, 2] + psi + 0.02 * compass,
    )


def recorded(car: Measured, sigmas: tuple[float, float, float] = (10.0, 10.0, 0.1)) -> MemorySource:
    """Return the car as a log, whose prior is about the origin."""
    half, zero = 0.5 * car.compass_rad, np.zeros_like(car.compass_rad)
    streams = [
        make_stream(
            "/car/odometry",
            schemas.ODOMETRY,
            stamps_ns(car.odometry_s),
            metadata={"forward_noise_density": "0.05", "turn_noise_density": "0.01"},
            forward_mps=car.odometry[:, 0],
            turn_radps=car.odometry[:, 1],
        ),
        fix_stream("/car/fix", stamps_ns(car.fix_s), car.fix_m, 0.09),
        make_stream(
            "/car/heading",
            schemas.ORIENTATION,
            stamps_ns(car.compass_s),
            metadata={"covariance_rad2": "0.0004,0.0004,0.0004"},
            quaternion=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
        ),
        make_stream(
            "/car/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [0],
            metadata={"components": "x_m,y_m,heading_rad"},
            mean=np.zeros((1, 3)),
            covariance=np.diag(np.square(sigmas)).reshape(1, 9),
        ),
    ]
    return memory_source(Recording(streams), RunMetadata("car C", epoch_ns=0))
