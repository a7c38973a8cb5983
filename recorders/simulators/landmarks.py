"""Simulator of robots that drive among landmarks: odometry, ranges, bearings, fixes, truth.

Each odometry message states the velocity until the next message; the true velocity is the stated one
plus white noise. Robots are the targets 1, 2, ...; the numbers of the landmarks follow.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
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
from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.log import Schema, Stream, make_stream, schemas
from fuselog.recorders.log.streams import divide
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

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Rngs = Callable[[str], list[np.random.Generator]]  # the generators of runs, by name
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


class Drives(NamedTuple):
    """The motion of one robot in several runs, at the odometry stamps that all runs share.

    Attributes:
        times_s: (steps + 1,).
        poses: (3, runs, steps + 1).
        true_velocity, odometry: (2, runs, steps).
    """

    times_s: Floats
    poses: Floats
    true_velocity: Floats
    odometry: Floats

    def poses_at(self, times_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Compute exact poses, each component (runs, n), at any times (n,) within the drive."""
        steps = np.searchsorted(self.times_s, times_s, side="right") - 1
        steps = np.clip(steps, 0, self.odometry.shape[2] - 1)
        elapsed_s = times_s - self.times_s[steps]
        return drive(self.poses[:, :, steps], self.true_velocity[:, :, steps], elapsed_s)


class Targets(NamedTuple):
    """Targets that a robot may see.

    Attributes:
        numbers: (targets,), first those of the robots.
        robots: the other robots.
        points: (runs, points, 2) the landmarks.
    """

    numbers: Integers
    robots: list[Drives]
    points: Floats


class Sightings(NamedTuple):
    """The views of one sensor in several runs: the true values of each target seen in a view.

    Attributes:
        times_s: (views,) stamps of the views of a run.
        view: (n,) number of the view, counted through all runs.
        cuts: (runs + 1,) first sighting of each run.
        target: (n,) number of the target.
        range_m, bearing_rad: (n,).
        outages_s: for each run, the starts and ends (k, 2) of the sensor's outages.
    """

    times_s: Floats
    view: Integers
    cuts: list[int]
    target: Integers
    range_m: Floats
    bearing_rad: Floats
    outages_s: list[Floats]


def simulate(parameters: LandmarksParameters, rng: np.random.Generator) -> Recording:
    """Simulate one run; every robot and sensor has its own random generator, by name."""
    return simulate_runs(parameters, [rng])[0]


def simulate_runs(
    parameters: LandmarksParameters, rngs: Sequence[np.random.Generator]
) -> list[Recording]:
    """Simulate several runs together, each with its generator; see `simulate`."""
    map_rngs, *robot_rngs = zip(*(rng.spawn(1 + parameters.robots) for rng in rngs), strict=True)
    half, points = 0.5 * parameters.arena_m, (parameters.landmarks, 2)
    landmarks = np.array([map_rng.uniform(-half, half, points) for map_rng in map_rngs])
    first_landmark = parameters.robots + 1
    targets = np.arange(first_landmark, first_landmark + parameters.landmarks)
    maps = make_stream(
        "/landmarks",
        schemas.LANDMARK,
        np.full(landmarks.shape[:2], SIMULATION_EPOCH_NS).ravel(),
        landmark_id=np.tile(targets, len(rngs)),
        position_m=landmarks.reshape(-1, 2),
    )
    streams: list[list[Stream]] = [[] for _ in rngs]
    _add(streams, maps)
    by_name = [_by_name(of_runs) for of_runs in robot_rngs]
    drives = [_drive(parameters, number, rngs_of("drive")) for number, rngs_of in enumerate(by_name)]
    for number, rngs_of in enumerate(by_name, start=1):
        robot = _robot_streams(parameters, number, drives, landmarks, rngs_of)
        for together, own in zip(streams, robot, strict=True):
            together += own
    return [Recording(together) for together in streams]


def _by_name(robot_rngs: Sequence[np.random.Generator]) -> Rngs:
    return lambda name: [named_generator(rng, name, NUMBERS) for rng in robot_rngs]


def _drive(parameters: LandmarksParameters, number: int, rngs: Sequence[np.random.Generator]) -> Drives:
    """Drive around the arena on a wavering circle."""
    steps = max(1, round(parameters.duration_s * parameters.odometry_rate_hz))
    step_s = 1.0 / parameters.odometry_rate_hz
    times_s = np.arange(steps + 1, dtype=np.float64) * step_s
    circles, noise, starts = [], np.empty((2, len(rngs), steps)), []
    for rng, own in zip(rngs, noise.swapaxes(0, 1), strict=True):
        circles.append([rng.uniform(0.25, 0.35), rng.uniform(0, 2 * np.pi), rng.uniform(12, 20)])
        own[:] = rng.normal(size=(steps, 2)).T
        starts.append([rng.uniform(0, 2 * np.pi)])
    radius_m, phase, period_s = np.array(circles).T[:, :, None]
    radius_m, start = parameters.arena_m * radius_m, np.array(starts)
    forward = np.full((len(rngs), steps), parameters.speed_mps)
    turn = forward / radius_m * (1 + 0.6 * np.sin(2 * np.pi * times_s[:-1] / period_s + phase))
    odometry = np.stack([forward, turn if number % 2 == 0 else -turn])
    density = np.array([parameters.forward_noise_density, parameters.turn_noise_density])
    noise = noise * density[:, None, None] / np.sqrt(step_s)
    scale, bias = np.array(
        [[1 + parameters.forward_scale_error, 1.0], [0.0, parameters.turn_bias_radps]]
    )
    true_velocity: Floats = odometry * scale[:, None, None] + bias[:, None, None] + noise
    heading = start + np.pi / 2 + _summed(true_velocity[1] * step_s)
    if number % 2:
        heading += np.pi
    x, y, _ = drive((0.0, 0.0, heading[:, :-1]), true_velocity, step_s)
    poses = radius_m * np.cos(start) + _summed(x), radius_m * np.sin(start) + _summed(y), heading
    return Drives(times_s, np.stack(poses), true_velocity, odometry)


def _summed(steps: Floats) -> Floats:
    """Sum steps (runs, n) from zero: (runs, n + 1)."""
    sums = np.zeros((len(steps), steps.shape[1] + 1))
    np.cumsum(steps, axis=1, out=sums[:, 1:])
    return sums


def _robot_streams(
    parameters: LandmarksParameters,
    number: int,
    drives: list[Drives],
    landmarks: Floats,
    rngs_of: Rngs,
) -> list[list[Stream]]:
    """Simulate the streams of a robot, for each run."""
    robot = drives[number - 1]
    prefix = f"/robot{number}"
    stamps_ns = simulation_stamps_ns(robot.times_s)
    logged_ns = simulation_stamps_ns(robot.times_s[:-1] + parameters.odometry_latency_s)
    x, y, heading = robot.poses
    truth = np.stack([x, y, wrap_angle(heading)], axis=2)
    sigma = np.array([parameters.prior_sigma_m, parameters.prior_sigma_m, parameters.prior_sigma_rad])
    priors = truth[:, 0] + [rng.normal(size=3) * sigma for rng in rngs_of("prior")]
    runs, covariance = len(truth), np.diag(sigma**2)
    streams: list[list[Stream]] = [[] for _ in priors]
    prior_ns, covariances = np.full(runs, stamps_ns[0]), np.tile(covariance, (runs, 1, 1))
    _add(streams, prior_stream(f"{prefix}/prior", prior_ns, POSE, priors, covariances))
    truth_ns = np.tile(stamps_ns, runs)
    _add(streams, truth_stream(f"{prefix}/truth", truth_ns, POSE, truth.reshape(-1, 3)))
    odometry = make_stream(
        f"{prefix}/odometry",
        schemas.ODOMETRY,
        np.tile(stamps_ns[:-1], runs),
        log_time_ns=np.tile(logged_ns, runs),
        metadata=stated_numbers(parameters, "forward_noise_density", "turn_noise_density"),
        forward_mps=robot.odometry[0].ravel(),
        turn_radps=robot.odometry[1].ravel(),
    )
    _add(streams, odometry)
    targets = _targets(parameters, number, drives, landmarks)
    for name, schema in SENSORS.items():
        sensor: Sensor = getattr(parameters, name)
        if sensor.rate_hz == 0:
            continue
        rngs = rngs_of(name)
        seen = _look(sensor, robot, targets, rngs)
        view, cuts, columns = _measure(schema, sensor, seen, rngs)
        columns |= _clocks(sensor, seen.times_s, view, rngs)
        metadata = stated_numbers(sensor, "sigma_range_m", "sigma_bearing_rad")
        _add(streams, make_stream(f"{prefix}/{name}", schema, metadata=metadata, **columns), cuts)
        if sensor.outages_per_minute > 0:
            for together, outages_s in zip(streams, seen.outages_s, strict=True):
                outages_ns = simulation_stamps_ns(outages_s)
                together.append(outage_stream(f"{prefix}/{name}/outages", outages_ns))
    for together, fixes in zip(
        streams, _fix_streams(f"{prefix}/fix", parameters.fix, robot, rngs_of), strict=True
    ):
        together += fixes
    return streams


def _add(streams: list[list[Stream]], of_runs: Stream, cuts: Sequence[int] | None = None) -> None:
    """Divide a stream of all runs, equally by default, and add each run's part to its streams."""
    if cuts is None:
        cuts = [run * len(of_runs) // len(streams) for run in range(len(streams) + 1)]
    for together, own in zip(streams, divide(of_runs, cuts), strict=True):
        together.append(own)


def _fix_streams(topic: str, receiver: Fixes, robot: Drives, rngs_of: Rngs) -> list[list[Stream]]:
    """Simulate each run's fixes, in the plane or on the earth, with covariances and outages."""
    if receiver.rate_hz == 0:
        return [[] for _ in range(robot.poses.shape[1])]
    all_s = np.arange(0, robot.times_s[-1] + 1e-9, 1.0 / receiver.rate_hz)
    x, y, _ = robot.poses_at(all_s)
    streams = []
    for true, rng in zip(np.stack([x, y], axis=2), rngs_of("fix"), strict=True):
        outages_s, is_dead = _dead(receiver, all_s, robot.times_s[-1], rng)
        places = true + receiver.sigma_m * rng.normal(size=(len(all_s), 2))
        times_s, places = all_s[~is_dead], places[~is_dead]
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
        streams.append([fixes])
        if receiver.outages_per_minute > 0:
            streams[-1].append(outage_stream(f"{topic}/outages", simulation_stamps_ns(outages_s)))
    return streams


def _targets(
    parameters: LandmarksParameters, number: int, drives: list[Drives], landmarks: Floats
) -> Targets:
    """Return the targets that robot `number` may see."""
    others: list[int] = []
    if parameters.robots_see_each_other:
        others = [other for other in range(1, len(drives) + 1) if other != number]
    points = np.arange(parameters.landmarks) + parameters.robots + 1
    numbers = np.concatenate([np.array(others, np.int64), points])
    return Targets(numbers, [drives[other - 1] for other in others], landmarks)


def _look(
    sensor: Sensor,
    robot: Drives,
    targets: Targets,
    rngs: Sequence[np.random.Generator],
) -> Sightings:
    """View all targets in range and field of view at the sensor's rate, except dropouts and outages."""
    times_s = np.arange(0, robot.times_s[-1] + 1e-9, 1.0 / sensor.rate_hz)
    places = np.empty((2, len(rngs), len(times_s), len(targets.numbers)))
    for number, other in enumerate(targets.robots):
        places[..., number] = other.poses_at(times_s)[:2]
    places[..., len(targets.robots) :] = np.moveaxis(targets.points, 2, 0)[:, :, None]
    pose = np.stack(robot.poses_at(times_s))[:, :, :, None]
    distance, bearing = range_bearing(pose, places)
    _wrap(bearing.reshape(-1))
    half_view = np.radians(sensor.field_of_view_deg) / 2
    visible = (distance <= sensor.maximum_range_m) & (np.abs(bearing) <= half_view)
    outages_s = []
    for own, rng in zip(visible, rngs, strict=True):
        outages, dead = _dead(sensor, times_s, robot.times_s[-1], rng)
        outages_s.append(outages)
        own &= ~dead[:, None]
        if sensor.dropout_probability > 0.0 or not _skip(rng, own.size):
            is_lost = rng.uniform(size=own.shape[::-1]) < sensor.dropout_probability
            own &= ~is_lost.T
    run, view, target = np.nonzero(visible)
    view += run * len(times_s)
    cuts = np.searchsorted(run, range(len(rngs) + 1)).tolist()
    return Sightings(
        times_s, view, cuts, targets.numbers[target], distance[visible], bearing[visible], outages_s
    )


def _skip(rng: np.random.Generator, count: int) -> bool:
    """Skip numbers of a uniform distribution; return False if the generator has to draw them."""
    bits = rng.bit_generator
    if isinstance(bits, np.random.PCG64):
        bits.advance(count)
        return True
    return False


def _dead(
    sensor: Sensor | Fixes,
    times_s: Floats,
    duration_s: float,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Draw a sensor's outages (k, 2), start and end, and test which times (n,) are in an outage."""
    count = rng.poisson(sensor.outages_per_minute * duration_s / 60)
    if not count:
        return np.empty((0, 2)), np.zeros(len(times_s), np.bool_)
    starts_s = np.sort(rng.uniform(0, duration_s, count))
    outages_s = np.stack([starts_s, starts_s + sensor.outage_s], axis=1)
    is_dead = np.any((times_s[:, None] >= outages_s[:, 0]) & (times_s[:, None] < outages_s[:, 1]), 1)
    return outages_s, is_dead


def _noisy(
    sensor: Sensor,
    exact: Floats,
    sigma: float,
    ends: tuple[float, float],
    cuts: Sequence[int],
    rngs: Sequence[np.random.Generator],
) -> Floats:
    """Add noise to values (n,), and replace outliers by values anywhere between two ends.

    The noise does not depend on whether there are outliers; without outliers, their random numbers are
    skipped.
    """
    noise, place, chance = np.empty((3, len(exact)))
    for rng, (first, end) in zip(rngs, pairwise(cuts), strict=True):
        rng.standard_normal(out=noise[first:end])
        if sensor.outlier_probability > 0.0 or not _skip(rng, 2 * (end - first)):
            rng.random(out=place[first:end])
            rng.random(out=chance[first:end])
    measured: Floats = exact + noise * sigma
    if sensor.outlier_probability > 0.0:
        wild = ends[0] + (ends[1] - ends[0]) * place
        measured = np.where(chance < sensor.outlier_probability, wild, measured)
    return measured


def _range(sensor: Sensor, seen: Sightings, rngs: Sequence[np.random.Generator]) -> Floats:
    """Measure ranges with bias, noise, and outliers anywhere in the sensor's range."""
    exact, ends = seen.range_m + sensor.bias_range_m, (0.0, sensor.maximum_range_m)
    return np.abs(_noisy(sensor, exact, sensor.sigma_range_m, ends, seen.cuts, rngs))


def _bearing(sensor: Sensor, seen: Sightings, rngs: Sequence[np.random.Generator]) -> Floats:
    """Measure bearings with bias, noise, and outliers in any direction."""
    exact, ends = seen.bearing_rad + sensor.bias_bearing_rad, (-np.pi, np.pi)
    measured = _noisy(sensor, exact, sensor.sigma_bearing_rad, ends, seen.cuts, rngs)
    _wrap(measured)
    return measured


def wrap(angles: Floats) -> None:
    """Wrap angles (n,) in place; see `wrap_angle`."""
    for place in range(len(angles)):
        angles[place] = wrap_angle(angles[place])


_wrap = compiled(wrap)


def _clocks(
    sensor: Sensor, times_s: Floats, view: Integers, rngs: Sequence[np.random.Generator]
) -> dict[str, Integers]:
    """Make the three clocks of every message; messages of one view share them."""
    jitter_s = np.concatenate([rng.exponential(size=len(times_s)) for rng in rngs])
    delay_s = sensor.latency_s + sensor.latency_jitter_s * jitter_s
    all_s = np.tile(times_s, len(rngs))
    return {
        "publish_time_ns": simulation_stamps_ns(all_s + sensor.stamp_offset_s)[view],
        "log_time_ns": simulation_stamps_ns(all_s + delay_s)[view],
        "sensor_time_ns": simulation_stamps_ns(all_s + sensor.clock_offset_s)[view],
    }


def _measure(
    schema: Schema, sensor: Sensor, seen: Sightings, rngs: Sequence[np.random.Generator]
) -> tuple[Integers, list[int], dict[str, NDArray]]:
    """Return the view of every message, the first message of each run, and the messages' columns."""
    names = [entry.name for entry in schema]
    columns: dict[str, NDArray] = {"target_id": seen.target}
    if "range_m" in names:
        columns["range_m"] = _range(sensor, seen, rngs)
    if schema is schemas.RELATIVE_BEARING:
        bearing = _bearing(sensor, seen, rngs)
        first, second = _pairs(seen.view)
        columns = {
            "first_id": seen.target[first],
            "second_id": seen.target[second],
            "angle_rad": wrap_angle(bearing[first] - bearing[second]),
        }
        return seen.view[first], np.searchsorted(first, seen.cuts).tolist(), columns
    if "bearing_rad" in names:
        columns["bearing_rad"] = _bearing(sensor, seen, rngs)
    return seen.view, seen.cuts, columns


def _pairs(view: Integers) -> tuple[Integers, Integers]:
    """Return the rows of all pairs of targets that share a view (n,)."""
    count = np.bincount(view)
    first, second = np.triu_indices(int(count.max(initial=0)), k=1)
    start = np.cumsum(count) - count
    of_view, pair = np.nonzero(second < count[:, None])
    return start[of_view] + first[pair], start[of_view] + second[pair]


LANDMARKS = Simulator(
    "robots with odometry drive among landmarks; range, bearing and relative-bearing sensors, fixes",
    LandmarksParameters,
    simulate,
    simulate_runs,
)
