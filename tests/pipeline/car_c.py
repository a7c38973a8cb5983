"""Car C of the sheet of sensors, section 2: wheels, fixes of an antenna, a compass; each errs."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pipeline.diagnosing.battery.car import Floats, Truth, arcs, philox, stamps_ns
from recorders.log import RunMetadata, make_stream, schemas
from recorders.recording import Recording
from replay.engine.streams.sources import MemorySource, memory_source

Motion = Callable[[Floats], tuple[Floats, Floats]]
STEP_S = 0.1
# speed's and turn rate's factor, turn rate's bias, lever, delay of fixes, angle of the compass
TRUTH = np.array([1.03, 0.98, 0.01, 1.2, -0.4, 0.15, 0.05])
NAMES = (
    *("forward_scale", "turn_scale", "turn_bias_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "bias_heading_rad"),
)


def rich(time_s: Floats) -> tuple[Floats, Floats]:
    """Speed and turn rate that determine everything."""
    return 8.0 + 3.0 * np.sin(0.4 * time_s), 0.25 * np.sin(0.21 * time_s) + 0.15 * np.sin(0.53 * time_s)


class Measured(NamedTuple):
    """What the car's log has: odometry (n, 2), fixes (m, 2) and their stamps, compass and its stamps."""

    odometry: Floats
    fix_s: Floats
    fix_m: Floats
    compass_s: Floats
    compass_rad: Floats


def drive(seed: int | None, motion: Motion = rich, duration_s: float = 120.0) -> Measured:
    """Drive; without noise where there is no seed."""
    n, m = round(duration_s / STEP_S), round(2.0 * duration_s) - 1
    fix_s, compass_s = 1.0 + 0.5 * np.arange(m), 0.2 * np.arange(round(5.0 * duration_s) + 1)
    rng = philox(seed or 0)
    draws = [rng.standard_normal(size) for size in (3, (n, 2), (m, 2), len(compass_s))]
    start, wheels, fixes, compass = (each * (seed is not None) for each in draws)
    speed, turn = motion((np.arange(n) + 0.5) * STEP_S)
    begin = start * [10.0, 10.0, 0.1]
    before = begin[2] + np.concatenate([[0.0], np.cumsum(turn * STEP_S)])
    moved = np.cumsum(arcs(before[:-1], speed, turn, np.full(n, STEP_S)), axis=0)
    truth = Truth(STEP_S, speed, turn, begin + np.concatenate([np.zeros((1, 3)), moved]))
    a_v, a_w, b_w, l_x, l_y, tau, psi = TRUTH
    pose = truth.at(fix_s - tau)
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    arm = np.stack([cosine * l_x - sine * l_y, sine * l_x + cosine * l_y], axis=1)
    noise = np.array([0.05, 0.01]) / np.sqrt(STEP_S) * wheels
    return Measured(
        np.stack([a_v * (speed + noise[:, 0]), a_w * (turn + noise[:, 1]) + b_w], axis=1),
        fix_s,
        pose[:, :2] + arm + 0.3 * fixes,
        compass_s,
        truth.at(compass_s)[:, 2] + psi + 0.02 * compass,
    )


def recorded(car: Measured, sigmas: tuple[float, float, float] = (10.0, 10.0, 0.1)) -> MemorySource:
    """The car as a log, whose prior is about the origin."""
    half, zero = 0.5 * car.compass_rad, np.zeros_like(car.compass_rad)
    streams = [
        make_stream(
            "/car/odometry",
            schemas.ODOMETRY,
            stamps_ns(STEP_S * np.arange(len(car.odometry))),
            metadata={"forward_noise_density": "0.05", "turn_noise_density": "0.01"},
            forward_mps=car.odometry[:, 0],
            turn_radps=car.odometry[:, 1],
        ),
        make_stream(
            "/car/fix",
            schemas.POSITION_FIX,
            stamps_ns(car.fix_s),
            position_m=car.fix_m,
            covariance_m2=np.tile([0.09, 0.0, 0.0, 0.09], (len(car.fix_s), 1)),
        ),
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
