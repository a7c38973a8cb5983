"""A car that drives for 100 s after 10 s at rest: wheels, fixes, perhaps a compass; and what may be wrong.

Every fault is put into the columns themselves, not by what a diagnosis undoes it with.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recorders.log import RunMetadata, Stream, make_stream, schemas
from replay.engine.streams.sources import MemorySource

Floats = NDArray[np.float64]
ODOMETRY, FIX, HEADING = "/car/odometry", "/car/fix", "/car/heading"
STEP_S, STEPS = 0.1, 1000
DENSITIES = 0.05, 0.01  # of speed and turn rate, in m/s/sqrt(Hz) and rad/s/sqrt(Hz)
SIGMA_FIX_M, SIGMA_COMPASS_RAD = 0.5, 0.03
STARTS = np.array([1.0, 1.0, 0.1])  # standard deviations of a prior, where there is one


@dataclass(frozen=True)
class Drive:
    """What was measured, and what is stated of it.

    Attributes:
        odometry_s, speed, turn: stamps (1000,) and readings, in s, m/s and rad/s.
        fix_s, place: stamps (201,) and positions (201, 2), in s and m.
        compass_s, compass: stamps (501,) and headings in rad.
        start: the true state (x, y, heading) at the begin.
        densities: of the noise of speed and turn rate, as stated.
        variance: of a fix, as stated, in m^2.
    """

    odometry_s: Floats
    speed: Floats
    turn: Floats
    fix_s: Floats
    place: Floats
    compass_s: Floats
    compass: Floats
    start: Floats
    densities: tuple[float, float] = DENSITIES
    variance: float = SIGMA_FIX_M**2


def drive(seed: int, lever: tuple[float, float] = (0.0, 0.0)) -> Drive:
    """A drive without a fault; the antenna is `lever` (forward, left) in m from the point that drives."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    start = np.array([0.0, 0.0, 2.0 * np.pi * rng.uniform()])
    noise = rng.standard_normal((STEPS, 2)), rng.standard_normal((201, 2)), rng.standard_normal(501)
    middle_s = (np.arange(STEPS) + 0.5) * STEP_S
    ramp = np.clip((middle_s - 10.0) / 5.0, 0.0, 1.0)
    speed = ramp * (8.0 + 3.0 * np.sin(0.4 * (middle_s - 10.0)))
    turn = ramp * (0.25 * np.sin(0.21 * middle_s) + 0.15 * np.sin(0.53 * middle_s))
    heading = start[2] + np.concatenate([[0.0], np.cumsum(turn * STEP_S)])
    chord = speed * STEP_S * np.sinc(0.5 * turn * STEP_S / np.pi)
    about = heading[:-1] + 0.5 * turn * STEP_S
    steps = chord[:, None] * _towards(about)
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    antenna = path + lever[0] * _towards(heading) + lever[1] * _towards(heading + 0.5 * np.pi)
    spread = np.array(DENSITIES) / STEP_S**0.5
    return Drive(
        odometry_s=np.arange(STEPS) * STEP_S,
        speed=speed + spread[0] * noise[0][:, 0],
        turn=turn + spread[1] * noise[0][:, 1],
        fix_s=np.arange(201) * 0.5,
        place=antenna[::5] + SIGMA_FIX_M * noise[1],
        compass_s=np.arange(501) * 0.2,
        compass=heading[::2] + SIGMA_COMPASS_RAD * noise[2],
        start=start,
    )


def _towards(angle: Floats) -> Floats:
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _half_lost(drive: Drive, seed: int) -> Drive:
    kept = np.random.Generator(np.random.Philox(key=seed + 10**6)).random(STEPS) < 0.5
    kept[0] = True
    return replace(
        drive, odometry_s=drive.odometry_s[kept], speed=drive.speed[kept], turn=drive.turn[kept]
    )


def _plain(fault: Callable[[Drive], Drive]) -> Callable[[int], Drive]:
    return lambda seed: fault(drive(seed))


# What is planted, by its name: seed -> the drive with it.
FAULTS: Mapping[str, Callable[[int], Drive]] = {
    "nothing": drive,
    "late": _plain(lambda car: replace(car, fix_s=car.fix_s + 0.3)),
    "turn sign": _plain(lambda car: replace(car, turn=-car.turn)),
    "speed x 3.6": _plain(lambda car: replace(car, speed=car.speed * 3.6)),
    "speed / 3.6": _plain(lambda car: replace(car, speed=car.speed / 3.6)),
    "speed x 0.3048": _plain(lambda car: replace(car, speed=car.speed * 0.3048)),
    "lever": lambda seed: drive(seed, (2.0, 0.6)),
    "variance x 4": _plain(lambda car: replace(car, variance=4.0 * car.variance)),
    "variance / 16": _plain(lambda car: replace(car, variance=car.variance / 16.0)),
    "sigma as variance": _plain(lambda car: replace(car, variance=car.variance**0.5)),
    "axes exchanged": _plain(lambda car: replace(car, place=car.place[:, ::-1])),
    "degrees": _plain(lambda car: replace(car, turn=np.degrees(car.turn))),
    "gyro bias": _plain(lambda car: replace(car, turn=car.turn + 0.02)),
    "gyro drift": _plain(lambda car: replace(car, turn=car.turn + 0.0004 * car.odometry_s)),
    "clock": _plain(lambda car: replace(car, odometry_s=car.odometry_s * 1.06)),
    "late 18 s": _plain(lambda car: replace(car, fix_s=car.fix_s + 18.0)),
    "half lost": lambda seed: _half_lost(drive(seed), seed),
    "gyro density": _plain(lambda car: replace(car, densities=(DENSITIES[0], DENSITIES[1] / 5.0))),
    "compass offset": _plain(lambda car: replace(car, compass=car.compass + np.radians(4.5))),
    "compass from north": _plain(lambda car: replace(car, compass=0.5 * np.pi - car.compass)),
}


def log_of(drive: Drive, *, has_compass: bool = False, has_prior: bool = False) -> MemorySource:
    """A drive as a log, with a prior about the true start if that is asked for."""
    streams = [
        make_stream(
            ODOMETRY,
            schemas.ODOMETRY,
            _stamps(drive.odometry_s),
            metadata={
                "forward_noise_density": repr(drive.densities[0]),
                "turn_noise_density": repr(drive.densities[1]),
            },
            forward_mps=drive.speed,
            turn_radps=drive.turn,
        ),
        make_stream(
            FIX,
            schemas.POSITION_FIX,
            _stamps(drive.fix_s),
            position_m=drive.place,
            covariance_m2=np.tile(drive.variance * np.eye(2).ravel(), (len(drive.place), 1)),
        ),
    ]
    if has_compass:
        half, nil = 0.5 * drive.compass, np.zeros(len(drive.compass))
        streams.append(
            make_stream(
                HEADING,
                schemas.ORIENTATION,
                _stamps(drive.compass_s),
                metadata={"covariance_rad2": f"1,1,{SIGMA_COMPASS_RAD**2!r}"},
                quaternion=np.stack([np.cos(half), nil, nil, np.sin(half)], axis=1),
            )
        )
    if has_prior:
        streams.append(_prior(drive.start))
    by_topic: dict[str, Stream] = {stream.topic: stream for stream in streams}
    return MemorySource(by_topic, RunMetadata("car", epoch_ns=0), "car")


def _prior(start: Floats) -> Stream:
    return make_stream(
        "/car/prior",
        schemas.GAUSSIAN_ESTIMATE,
        np.zeros(1, np.int64),
        metadata={"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"},
        mean=start[None],
        covariance=np.diag(STARTS**2).ravel()[None],
    )


def _stamps(times_s: Floats) -> NDArray[np.int64]:
    return np.rint(times_s * 1e9).astype(np.int64)
