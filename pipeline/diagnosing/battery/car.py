"""Faults in logs of a car that is stationary for 10 s and then drives, with or without a prior.

Faults of the car and of its inertial unit are selected by name. The faults change the columns directly,
without the alterations that a diagnosis uses for corrections.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.simulators.car import Car, CarParameters, Floats, philox, stamps_ns, streams_of
from fuselog.recorders.simulators.car import drive as simulated
from fuselog.replay.engine.streams.sources import MemorySource

GRAVITY_MPS2 = 9.81
CLEAN: dict[str, Any] = {
    "duration_s": 100.0,
    "rest_s": 10.0,
    "begin": "any heading",
    "prior_sigma_m": 1.0,
    "first_fix_s": 0.0,
    "fix_sigma_m": 0.5,
    "compass_sigma_rad": 0.03,
}


def drive(seed: int, **changed: float) -> Car:
    """Simulate a car without faults; `changed` contains parameters of the simulation."""
    return simulated(CarParameters(**{**CLEAN, **changed}), philox(seed))._replace(seed=seed)


# Faults.


def late(by_s: float) -> Callable[[Car], Car]:
    """Make a fault in which fixes report the antenna's position from `by_s` earlier."""
    return lambda car: _seen(car._replace(fix_late_s=by_s), car)


def lever(forward_m: float, left_m: float) -> Callable[[Car], Car]:
    """Make a fault in which fixes refer to an antenna away from the car's reference point."""
    return lambda car: _seen(car._replace(lever_m=(forward_m, left_m)), car)


def _seen(car: Car, before: Car) -> Car:
    """Move fixes to the antenna's position, given its lever arm and the delay of fixes."""
    return car._replace(fix_m=car.fix_m + _antenna(car) - _antenna(before))


def _antenna(car: Car) -> Floats:
    x, y, heading = car.truth.at(car.fix_s - car.fix_late_s).T
    cos, sin = np.cos(heading), np.sin(heading)
    forward_m, left_m = car.lever_m
    return np.stack([x + forward_m * cos - left_m * sin, y + forward_m * sin + left_m * cos], axis=1)


def half_lost(car: Car) -> Car:
    """Drop half of the odometry, except its first message."""
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
    """Simulate the car with one or more of the `FAULTS`, applied in order."""
    return reduce(lambda car, name: FAULTS[name](car), names, drive(seed))


def recorded(car: Car, *, has_compass: bool = True, has_prior: bool = False) -> MemorySource:
    """Make a log of the car, in a form that `fl.write` accepts; a prior is centred on the true start."""
    return source(streams_of(car, has_compass=has_compass, has_prior=has_prior))


def source(streams: list[Stream]) -> MemorySource:
    """Make a recording of a car from streams."""
    return MemorySource({each.topic: each for each in streams}, RunMetadata("car", epoch_ns=0), "car")


def car(seed: int, stated: float = 1.0) -> MemorySource:
    """Make a log without a compass, in which fixes state `stated` times their true variance."""
    clean = drive(seed)
    return recorded(clean._replace(fix_variance_m2=stated * clean.fix_variance_m2), has_compass=False)


# The inertial unit.


class Unit(NamedTuple):
    """Samples of an inertial unit on the car, and the east and north velocities (m, 2) of a receiver."""

    sample_s: Floats
    force_mps2: Floats
    turn_radps: Floats
    velocity_s: Floats
    velocity_mps: Floats


def ride(seed: int) -> Unit:
    """Simulate the unit without a fault."""
    truth, rng = drive(seed, odometry_step_s=0.02).truth, philox(seed + 500_000)
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
    """Make a fault that maps each axis of the specific force to another axis or its opposite."""

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
    """Make a log of the unit and of the receiver's velocities."""
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
