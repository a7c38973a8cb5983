"""Simulates a car that drives after 10 s at rest: wheels, a gyroscope, fixes, a compass; prior or none.

Its faults by name, the inertial unit that may ride with it, with its own, and logs of both. Faults are
put into the columns themselves, not by what a diagnosis undoes them with.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.common_streams import fix_stream, prior_stream
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.replay.engine.streams.sources import MemorySource

Floats = NDArray[np.floating]
DURATION_S, REST_S, RAMP_S = 100.0, 10.0, 5.0
FIX_SIGMA_M, COMPASS_SIGMA_RAD = 0.5, 0.03
FIX_STEP_S, COMPASS_STEP_S = 0.5, 0.2
FORWARD_DENSITY, TURN_DENSITY = 0.05, 0.01
GRAVITY_MPS2 = 9.81
START_SIGMAS = np.array([1.0, 1.0, 0.1])  # of a prior, in m and rad


class Truth(NamedTuple):
    """Describes how the car drives: speeds, turn rates (n,) of each step, poses (n + 1, 3) between."""

    step_s: float
    speed_mps: Floats
    turn_radps: Floats
    pose: Floats

    def at(self, times_s: Floats) -> Floats:
        """Interpolate poses (m, 3) at any times, exactly; before the begin the car rests."""
        step = np.clip(times_s // self.step_s, 0, len(self.speed_mps) - 1).astype(int)
        since_s = np.maximum(times_s - step * self.step_s, 0.0)
        return self.pose[step] + arcs(
            self.pose[step, 2], self.speed_mps[step], self.turn_radps[step], since_s
        )


class Noise(NamedTuple):
    """States the noise of the sensors: densities of the wheels, standard deviations of the others."""

    forward_density: float = FORWARD_DENSITY
    turn_density: float = TURN_DENSITY
    fix_sigma_m: float = FIX_SIGMA_M
    compass_sigma_rad: float = COMPASS_SIGMA_RAD


NOISE = Noise()


class Car(NamedTuple):
    """Holds what a log of the car has: stamps in s, SI units; the heading anticlockwise from east."""

    seed: int
    truth: Truth
    odometry_s: Floats
    speed_mps: Floats
    turn_radps: Floats
    fix_s: Floats
    fix_m: Floats
    compass_s: Floats
    compass_rad: Floats
    fix_variance_m2: float = FIX_SIGMA_M**2
    turn_density: float = TURN_DENSITY
    forward_density: float = FORWARD_DENSITY
    compass_sigma_rad: float = COMPASS_SIGMA_RAD
    fix_late_s: float = 0.0
    lever_m: tuple[float, float] = (0.0, 0.0)


def arcs(heading_rad: Floats, speed_mps: Floats, turn_radps: Floats, duration_s: Floats) -> Floats:
    """Compute how poses change along exact arcs.

    Args:
        heading_rad: (n,), before each step.
        speed_mps: (n,), forward.
        turn_radps: (n,), anticlockwise.
        duration_s: (n,), of each step.

    Returns:
        (n, 3), what is added to x and y in m, and to the heading in rad.
    """
    turned = turn_radps * duration_s
    chord = speed_mps * duration_s * np.sinc(0.5 * turned / np.pi)
    about = heading_rad + 0.5 * turned
    return np.stack([chord * np.cos(about), chord * np.sin(about), turned], axis=-1)


def philox(key: int) -> np.random.Generator:
    """Return the sheet's P(key)."""
    return np.random.Generator(np.random.Philox(key=key))


def drive(seed: int, step_s: float = 0.1, noise: Noise = NOISE, duration_s: float = DURATION_S) -> Car:
    """Return the car without a fault."""
    rng, n = philox(seed), round(duration_s / step_s)
    fix_s = np.arange(round(duration_s / FIX_STEP_S) + 1) * FIX_STEP_S
    compass_s = np.arange(round(duration_s / COMPASS_STEP_S) + 1) * COMPASS_STEP_S
    start_rad = 2.0 * np.pi * rng.uniform()
    odometry, fixes = rng.standard_normal((n, 2)), rng.standard_normal((len(fix_s), 2))
    compass = rng.standard_normal(len(compass_s))
    since_s = (np.arange(n) + 0.5) * step_s
    ramp = np.clip((since_s - REST_S) / RAMP_S, 0.0, 1.0)
    speed = ramp * (8.0 + 3.0 * np.sin(0.4 * (since_s - REST_S)))
    turn = ramp * (0.25 * np.sin(0.21 * since_s) + 0.15 * np.sin(0.53 * since_s))
    before_rad = start_rad + np.concatenate([[0.0], np.cumsum(turn * step_s)])
    steps = arcs(before_rad[:-1], speed, turn, np.full(n, step_s))
    start = np.array([[0.0, 0.0, start_rad]])
    truth = Truth(step_s, speed, turn, start + np.concatenate([0.0 * start, np.cumsum(steps, axis=0)]))
    of_wheels = np.array([noise.forward_density, noise.turn_density]) / step_s**0.5 * odometry
    return Car(
        seed,
        truth,
        np.arange(n) * step_s,
        speed + of_wheels[:, 0],
        turn + of_wheels[:, 1],
        fix_s,
        truth.at(fix_s)[:, :2] + noise.fix_sigma_m * fixes,
        compass_s,
        truth.at(compass_s)[:, 2] + noise.compass_sigma_rad * compass,
        noise.fix_sigma_m**2,
        noise.turn_density,
        noise.forward_density,
        noise.compass_sigma_rad,
    )


# Faults.


def late(by_s: float) -> Callable[[Car], Car]:
    """Make fixes say where the antenna was so long before."""
    return lambda car: _seen(car._replace(fix_late_s=by_s), car)


def lever(forward_m: float, left_m: float) -> Callable[[Car], Car]:
    """Make fixes those of an antenna beside the car's own point."""
    return lambda car: _seen(car._replace(lever_m=(forward_m, left_m)), car)


def _seen(car: Car, before: Car) -> Car:
    """Move fixes to where the antenna is, by its place and by how late they are."""
    return car._replace(fix_m=car.fix_m + _antenna(car) - _antenna(before))


def _antenna(car: Car) -> Floats:
    x, y, heading = car.truth.at(car.fix_s - car.fix_late_s).T
    cos, sin = np.cos(heading), np.sin(heading)
    forward_m, left_m = car.lever_m
    return np.stack([x + forward_m * cos - left_m * sin, y + forward_m * sin + left_m * cos], axis=1)


def half_lost(car: Car) -> Car:
    """Drop half of the odometry, but for its first."""
    kept = philox(car.seed + 10**6).random(len(car.odometry_s)) < 0.5
    kept[0] = True
    return car._replace(
        odometry_s=car.odometry_s[kept], speed_mps=car.speed_mps[kept], turn_radps=car.turn_radps[kept]
    )


FAULTS: dict[str, Callable[[Car], Car]] = {
    "nothing": lambda car: car,
    "fixes .3 s late": late(0.3),
    "turn rate's sign": lambda car: car._replace(turn_radps=-car.turn_radps),
    "speed x 3.6": lambda car: car._replace(speed_mps=3.6 * car.speed_mps),
    "speed / 3.6": lambda car: car._replace(speed_mps=car.speed_mps / 3.6),
    "speed x .3048": lambda car: car._replace(speed_mps=0.3048 * car.speed_mps),
    "lever (2, .6) m": lever(2.0, 0.6),
    "fix variance x 4": lambda car: car._replace(fix_variance_m2=4.0 * car.fix_variance_m2),
    "fix variance / 16": lambda car: car._replace(fix_variance_m2=car.fix_variance_m2 / 16.0),
    "sd written as variance": lambda car: car._replace(fix_variance_m2=car.fix_variance_m2**0.5),
    "E, N exchanged": lambda car: car._replace(fix_m=car.fix_m[:, ::-1]),
    "degrees as radians": lambda car: car._replace(turn_radps=np.degrees(car.turn_radps)),
    "gyro bias .02": lambda car: car._replace(turn_radps=car.turn_radps + 0.02),
    "gyro bias .0004 t": lambda car: car._replace(turn_radps=car.turn_radps + 0.0004 * car.odometry_s),
    "odometry clock 6 % fast": lambda car: car._replace(odometry_s=1.06 * car.odometry_s),
    "fixes 18 s late": late(18.0),
    "half of the odometry lost": half_lost,
    "gyro density / 5": lambda car: car._replace(turn_density=car.turn_density / 5.0),
    "compass + 4.5 deg": lambda car: car._replace(compass_rad=car.compass_rad + np.radians(4.5)),
    "compass clockwise from north": lambda car: car._replace(compass_rad=np.pi / 2 - car.compass_rad),
}


def faulty(seed: int, *names: str) -> Car:
    """Return the car with one of the `FAULTS`, or with several, put one after the other."""
    return reduce(lambda car, name: FAULTS[name](car), names, drive(seed))


def stamps_ns(times_s: Floats) -> NDArray[np.int64]:
    """Return stamps (n,) in ns."""
    return np.rint(1e9 * times_s).astype(np.int64)


def recorded(car: Car, *, has_compass: bool = True, has_prior: bool = False) -> MemorySource:
    """Return the car as a log, which `fl.write` writes; a prior is about the true start."""
    half = 0.5 * car.compass_rad
    zero = np.zeros_like(half)
    wheels = make_stream(
        "/car/odometry",
        schemas.ODOMETRY,
        stamps_ns(car.odometry_s),
        metadata={
            "forward_noise_density": repr(car.forward_density),
            "turn_noise_density": repr(car.turn_density),
        },
        forward_mps=car.speed_mps,
        turn_radps=car.turn_radps,
    )
    fixes = fix_stream("/car/fix", stamps_ns(car.fix_s), car.fix_m, car.fix_variance_m2)
    compass = make_stream(
        "/car/heading",
        schemas.ORIENTATION,
        stamps_ns(car.compass_s),
        metadata={"covariance_rad2": ",".join(3 * [repr(car.compass_sigma_rad**2)])},
        quaternion=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
    )
    pose = ("x_m", "y_m", "heading_rad")
    prior = prior_stream("/car/prior", 0, pose, car.truth.pose[0], np.diag(START_SIGMAS**2))
    return source([wheels, fixes, *[compass] * has_compass, *[prior] * has_prior])


def source(streams: list[Stream]) -> MemorySource:
    """Make a recording of a car from streams."""
    return MemorySource({each.topic: each for each in streams}, RunMetadata("car", epoch_ns=0), "car")


def car(seed: int, stated: float = 1.0) -> MemorySource:
    """Return the log without a compass; its fixes state so many times their variance."""
    clean = drive(seed)
    return recorded(clean._replace(fix_variance_m2=stated * clean.fix_variance_m2), has_compass=False)


# The inertial unit.


class Unit(NamedTuple):
    """Describes an inertial unit on the car, and velocities (m, 2) east and north of a receiver."""

    sample_s: Floats
    force_mps2: Floats
    turn_radps: Floats
    velocity_s: Floats
    velocity_mps: Floats


def ride(seed: int) -> Unit:
    """Return the unit without a fault."""
    truth, rng = drive(seed, 0.02).truth, philox(seed + 500_000)
    n = len(truth.speed_mps)
    force, turn = rng.standard_normal((n, 3)), rng.standard_normal(n)
    velocity = rng.standard_normal((500, 2))
    sample_s, velocity_s = (np.arange(n) + 0.5) * truth.step_s, np.arange(500) * 0.2
    acceleration = [
        np.gradient(truth.speed_mps, sample_s),
        truth.speed_mps * truth.turn_radps,
        np.full(n, GRAVITY_MPS2),
    ]
    heading = truth.at(velocity_s)[:, 2]
    speed = np.interp(velocity_s, sample_s, truth.speed_mps)
    along = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return Unit(
        sample_s,
        np.stack(acceleration, axis=1) + np.array([0.05, -0.05, 0.05]) + 0.05 * force,
        truth.turn_radps + 0.003 + 0.005 * turn,
        velocity_s,
        along + 0.1 * velocity,
    )


def remapped(*axes: tuple[int, int]) -> Callable[[Unit], Unit]:
    """Make each axis of the force another one with a sign."""

    def put(unit: Unit) -> Unit:
        return unit._replace(
            force_mps2=np.stack([sign * unit.force_mps2[:, axis] for axis, sign in axes], axis=1)
        )

    return put


UNIT_FAULTS: dict[str, Callable[[Unit], Unit]] = {
    "nothing": lambda unit: unit,
    "accelerometer in g": lambda unit: unit._replace(force_mps2=unit.force_mps2 / GRAVITY_MPS2),
    "gravity's sign": remapped((0, 1), (1, 1), (2, -1)),
    "turn rate's sign": lambda unit: unit._replace(turn_radps=-unit.turn_radps),
    "degrees": lambda unit: unit._replace(turn_radps=np.degrees(unit.turn_radps)),
    "mounted 90 deg": remapped((1, 1), (0, -1), (2, 1)),
    "mounted 180 deg": remapped((0, -1), (1, -1), (2, 1)),
    "unit late .3 s": lambda unit: unit._replace(sample_s=unit.sample_s + 0.3),
    "E, N exchanged": lambda unit: unit._replace(velocity_mps=unit.velocity_mps[:, ::-1]),
}


def recorded_unit(unit: Unit) -> MemorySource:
    """Return the log of the unit and of the receiver's velocities."""
    zero = np.zeros_like(unit.turn_radps)
    samples = make_stream(
        "/car/inertial",
        schemas.INERTIAL_SAMPLE,
        stamps_ns(unit.sample_s),
        specific_force_mps2=unit.force_mps2,
        turn_rate_radps=np.stack([zero, zero, unit.turn_radps], axis=1),
        magnetic_field_ut=np.empty((len(zero), 0)),
    )
    velocities = make_stream(
        "/car/velocity",
        schemas.VELOCITY_FIX,
        stamps_ns(unit.velocity_s),
        velocity_mps=unit.velocity_mps,
        covariance_m2ps2=np.tile(0.01 * np.eye(2).ravel(), (len(unit.velocity_s), 1)),
    )
    return source([samples, velocities])
