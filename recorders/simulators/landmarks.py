"""Simulator of robots that drive among landmarks: odometry, ranges, bearings, fixes, truth.

Each odometry message states the velocity until the next message; the true velocity is the stated one
plus white noise. Robots are the targets 1, 2, ..., and landmarks have the numbers after them.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.common_streams import (
    fix_stream,
    outage_stream,
    prior_stream,
    stated_numbers,
    truth_stream,
)
from fuselog.recorders.log import Schema, Stream, make_stream, schemas
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.recorders.models.planar import drive, range_bearing, wrap_angle
from fuselog.recorders.models.states import POSE
from fuselog.recorders.recording import (
    SIMULATION_EPOCH_NS,
    Recording,
    Simulator,
    named_generator,
    simulation_stamps_ns,
)
from fuselog.recorders.simulators.landmarks_parameters import Fixes, LandmarksParameters, Sensor

SENSORS = {
    "range_bearing": schemas.RANGE_BEARING,
    "range": schemas.RANGE,
    "bearing": schemas.BEARING,
    "relative_bearing": schemas.RELATIVE_BEARING,
}
# See `named_generator`. These keep the logs of a seed unchanged; a new sensor needs no number.
NUMBERS = {
    "drive": 0,
    "prior": 1,
    "range_bearing": 2,
    "range": 3,
    "bearing": 4,
    "relative_bearing": 5,
    "fix": 6,
}


class Drive(NamedTuple):
    """The motion of one robot: poses (steps + 1, 3) at the odometry stamps, velocities (steps, 2)."""

    times_s: NDArray[np.float64]
    poses: NDArray[np.float64]
    true_velocity: NDArray[np.float64]
    odometry: NDArray[np.float64]

    def pose_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute exact poses (n, 3) at any times within the drive."""
        steps = np.searchsorted(self.times_s, times_s, side="right") - 1
        steps = np.clip(steps, 0, len(self.true_velocity) - 1)
        return np.stack(
            drive(self.poses[steps].T, self.true_velocity[steps].T, times_s - self.times_s[steps]),
            axis=1,
        )


class Sightings(NamedTuple):
    """The views of one sensor: their stamps (n,), and the true values of each target seen in a view."""

    times_s: NDArray[np.float64]
    look: NDArray[np.int64]
    target: NDArray[np.int64]
    range_m: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    outages_s: NDArray[np.float64]


def simulate(parameters: LandmarksParameters, rng: np.random.Generator) -> Recording:
    """Simulate one run; every robot and sensor has its own random generator, by name."""
    map_rng, *robot_rngs = rng.spawn(1 + parameters.robots)
    half = 0.5 * parameters.arena_m
    landmarks = map_rng.uniform(-half, half, (parameters.landmarks, 2))
    first_landmark = parameters.robots + 1
    streams = [
        make_stream(
            "/landmarks",
            schemas.LANDMARK,
            np.full(parameters.landmarks, SIMULATION_EPOCH_NS),
            landmark_id=np.arange(first_landmark, first_landmark + parameters.landmarks),
            position_m=landmarks,
        )
    ]
    by_name = [partial(named_generator, robot_rng, numbers=NUMBERS) for robot_rng in robot_rngs]
    drives = [_drive(parameters, number, rng_of("drive")) for number, rng_of in enumerate(by_name)]
    for number, rng_of in enumerate(by_name, start=1):
        streams += _robot_streams(parameters, number, drives, landmarks, rng_of)
    return Recording(streams)


def _drive(parameters: LandmarksParameters, number: int, rng: np.random.Generator) -> Drive:
    """Drive around the arena on a wavering circle."""
    steps = max(1, round(parameters.duration_s * parameters.odometry_rate_hz))
    step_s = 1.0 / parameters.odometry_rate_hz
    times_s = np.arange(steps + 1, dtype=np.float64) * step_s
    radius_m = parameters.arena_m * rng.uniform(0.25, 0.35)
    phase, period_s = rng.uniform(0, 2 * np.pi), rng.uniform(12, 20)
    forward = np.full(steps, parameters.speed_mps)
    turn = forward / radius_m * (1 + 0.6 * np.sin(2 * np.pi * times_s[:-1] / period_s + phase))
    odometry = np.stack([forward, turn if number % 2 == 0 else -turn], axis=1)
    density = [parameters.forward_noise_density, parameters.turn_noise_density]
    noise = rng.normal(size=(steps, 2)) * density / np.sqrt(step_s)
    scale = np.array([1 + parameters.forward_scale_error, 1.0])
    true_velocity: NDArray[np.float64] = (
        odometry * scale + np.array([0.0, parameters.turn_bias_radps]) + noise
    )
    start = rng.uniform(0, 2 * np.pi)
    turned = np.cumsum(true_velocity[:, 1] * step_s)
    heading: NDArray[np.float64] = start + np.pi / 2 + np.append(0.0, turned)
    if number % 2:
        heading += np.pi
    origin = np.zeros((3, steps))
    origin[2] = heading[:-1]
    moves = drive(origin, true_velocity.T, step_s)
    x = radius_m * np.cos(start) + np.append(0.0, np.cumsum(moves[0]))
    y = radius_m * np.sin(start) + np.append(0.0, np.cumsum(moves[1]))
    poses: NDArray[np.float64] = np.stack([x, y, heading], axis=1)
    return Drive(times_s, poses, true_velocity, odometry)


def _robot_streams(
    parameters: LandmarksParameters,
    number: int,
    drives: list[Drive],
    landmarks: NDArray[np.float64],
    rng_of: Callable[[str], np.random.Generator],
) -> list[Stream]:
    robot = drives[number - 1]
    prefix = f"/robot{number}"
    stamps_ns = simulation_stamps_ns(robot.times_s)
    truth = robot.poses.copy()
    truth[:, 2] = wrap_angle(truth[:, 2])
    sigma = np.array([parameters.prior_sigma_m, parameters.prior_sigma_m, parameters.prior_sigma_rad])
    prior = truth[0] + rng_of("prior").normal(size=3) * sigma
    streams = [
        prior_stream(f"{prefix}/prior", stamps_ns[0], POSE, prior, np.diag(sigma**2)),
        truth_stream(f"{prefix}/truth", stamps_ns, POSE, truth),
        make_stream(
            f"{prefix}/odometry",
            schemas.ODOMETRY,
            stamps_ns[:-1],
            log_time_ns=simulation_stamps_ns(robot.times_s[:-1] + parameters.odometry_latency_s),
            metadata=stated_numbers(parameters, "forward_noise_density", "turn_noise_density"),
            forward_mps=robot.odometry[:, 0],
            turn_radps=robot.odometry[:, 1],
        ),
    ]
    targets = _targets(parameters, number, drives, landmarks)
    for name, schema in SENSORS.items():
        sensor: Sensor = getattr(parameters, name)
        if sensor.rate_hz == 0:
            continue
        sensor_rng = rng_of(name)
        seen = _look(sensor, robot, targets, sensor_rng)
        look, columns = _measure(schema, sensor, seen, sensor_rng)
        streams.append(
            make_stream(
                f"{prefix}/{name}",
                schema,
                **_clocks(sensor, seen.times_s, look, sensor_rng),
                metadata=stated_numbers(sensor, "sigma_range_m", "sigma_bearing_rad"),
                **columns,
            )
        )
        if sensor.outages_per_minute > 0:
            streams.append(
                outage_stream(f"{prefix}/{name}/outages", simulation_stamps_ns(seen.outages_s))
            )
    return streams + _fix_streams(f"{prefix}/fix", parameters.fix, robot, rng_of)


def _fix_streams(
    topic: str, receiver: Fixes, robot: Drive, rng_of: Callable[[str], np.random.Generator]
) -> list[Stream]:
    """Simulate fixes in the plane or on the earth with their covariance, and their outages."""
    if receiver.rate_hz == 0:
        return []
    rng = rng_of("fix")
    times_s = np.arange(0, robot.times_s[-1] + 1e-9, 1.0 / receiver.rate_hz)
    outages_s, is_dead = _dead(receiver, times_s, robot.times_s[-1], rng)
    places = robot.pose_at(times_s)[:, :2] + receiver.sigma_m * rng.normal(size=(len(times_s), 2))
    times_s, places = times_s[~is_dead], places[~is_dead]
    fixes = fix_stream(topic, simulation_stamps_ns(times_s), places, receiver.sigma_m**2)
    if receiver.origin_deg is not None:
        latitude, longitude, altitude = out_of_tangent_plane(places.T, receiver.origin_deg)
        names = "origin_latitude_deg", "origin_longitude_deg"
        fixes = make_stream(
            topic,
            schemas.GEODETIC_FIX,
            fixes.publish_time_ns,
            metadata=dict(zip(names, map(repr, receiver.origin_deg), strict=True)),
            latitude_deg=latitude,
            longitude_deg=longitude,
            altitude_m=altitude,
            covariance_m2=fixes["covariance_m2"],
        )
    outages = outage_stream(f"{topic}/outages", simulation_stamps_ns(outages_s))
    return [fixes, outages] if receiver.outages_per_minute > 0 else [fixes]


def _targets(
    parameters: LandmarksParameters,
    number: int,
    drives: list[Drive],
    landmarks: NDArray[np.float64],
) -> Mapping[int, Drive | NDArray[np.float64]]:
    """Return the possible targets of robot `number`: points, and moving robots, by number."""
    seen: dict[int, Drive | NDArray[np.float64]] = {}
    if parameters.robots_see_each_other:
        seen = {other: each for other, each in enumerate(drives, start=1) if other != number}
    return seen | dict(enumerate(landmarks, start=parameters.robots + 1))


def _look(
    sensor: Sensor,
    robot: Drive,
    targets: Mapping[int, Drive | NDArray[np.float64]],
    rng: np.random.Generator,
) -> Sightings:
    """View all targets in range and field of view at the sensor's rate, except dropouts and outages."""
    times_s = np.arange(0, robot.times_s[-1] + 1e-9, 1.0 / sensor.rate_hz)
    outages_s, dead = _dead(sensor, times_s, robot.times_s[-1], rng)
    pose = robot.pose_at(times_s)
    places = np.empty((2, len(targets), len(times_s)))
    for place, each in zip(places.swapaxes(0, 1), targets.values(), strict=True):
        place[:] = each.pose_at(times_s)[:, :2].T if isinstance(each, Drive) else each[:, None]
    distance, bearing = range_bearing(pose.T[:, None, :], places)
    bearing = wrap_angle(bearing)
    half_view = np.radians(sensor.field_of_view_deg) / 2
    visible = (distance <= sensor.maximum_range_m) & (np.abs(bearing) <= half_view) & ~dead
    visible &= rng.uniform(size=visible.shape) >= sensor.dropout_probability
    look, target = np.nonzero(visible.T)
    numbers = np.array(list(targets), dtype=np.int64)
    return Sightings(
        times_s, look, numbers[target], distance.T[look, target], bearing.T[look, target], outages_s
    )


def _dead(
    sensor: Sensor | Fixes,
    times_s: NDArray[np.float64],
    duration_s: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Draw a sensor's outages (k, 2), start and end, and test which times (n,) are in one."""
    count = rng.poisson(sensor.outages_per_minute * duration_s / 60)
    starts_s = np.sort(rng.uniform(0, duration_s, count))
    outages_s = np.stack([starts_s, starts_s + sensor.outage_s], axis=1)
    is_dead = np.any((times_s[:, None] >= outages_s[:, 0]) & (times_s[:, None] < outages_s[:, 1]), 1)
    return outages_s, is_dead


def _range(sensor: Sensor, true_m: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Measure ranges with bias, noise, and outliers anywhere in the sensor's range."""
    measured = true_m + sensor.bias_range_m + rng.normal(size=len(true_m)) * sensor.sigma_range_m
    wild = rng.uniform(0, sensor.maximum_range_m, len(true_m))
    is_outlier = rng.uniform(size=len(true_m)) < sensor.outlier_probability
    return np.abs(np.where(is_outlier, wild, measured))


def _bearing(sensor: Sensor, true_rad: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Measure bearings with bias, noise, and outliers in any direction."""
    noise = rng.normal(size=len(true_rad)) * sensor.sigma_bearing_rad
    wild = rng.uniform(-np.pi, np.pi, len(true_rad))
    is_outlier = rng.uniform(size=len(true_rad)) < sensor.outlier_probability
    return wrap_angle(np.where(is_outlier, wild, true_rad + sensor.bias_bearing_rad + noise))


def _clocks(
    sensor: Sensor, times_s: NDArray[np.float64], look: NDArray[np.int64], rng: np.random.Generator
) -> dict[str, NDArray[np.int64]]:
    """Make the three clocks of every message; messages of one view share them."""
    delay_s = sensor.latency_s + sensor.latency_jitter_s * rng.exponential(size=len(times_s))
    return {
        "publish_time_ns": simulation_stamps_ns(times_s + sensor.stamp_offset_s)[look],
        "log_time_ns": simulation_stamps_ns(times_s + delay_s)[look],
        "sensor_time_ns": simulation_stamps_ns(times_s + sensor.clock_offset_s)[look],
    }


def _measure(
    schema: Schema, sensor: Sensor, seen: Sightings, rng: np.random.Generator
) -> tuple[NDArray[np.int64], dict[str, NDArray]]:
    """Return the view of every message, and the messages' columns."""
    names = [entry.name for entry in schema]
    columns: dict[str, NDArray] = {"target_id": seen.target}
    if "range_m" in names:
        columns["range_m"] = _range(sensor, seen.range_m, rng)
    if schema is schemas.RELATIVE_BEARING:
        bearing = _bearing(sensor, seen.bearing_rad, rng)
        first, second = _pairs(seen)
        columns = {
            "first_id": seen.target[first],
            "second_id": seen.target[second],
            "angle_rad": wrap_angle(bearing[first] - bearing[second]),
        }
        return seen.look[first], columns
    if "bearing_rad" in names:
        columns["bearing_rad"] = _bearing(sensor, seen.bearing_rad, rng)
    return seen.look, columns


def _pairs(seen: Sightings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of all pairs of targets that share a view."""
    first, second = np.triu_indices(int(np.bincount(seen.look).max(initial=0)), k=1)
    count = np.bincount(seen.look, minlength=len(seen.times_s))
    start = np.cumsum(count) - count
    look, pair = np.nonzero(second < count[:, None])
    return start[look] + first[pair], start[look] + second[pair]


LANDMARKS = Simulator(
    "robots with odometry drive among landmarks; range, bearing and relative-bearing sensors, fixes",
    LandmarksParameters,
    simulate,
)
