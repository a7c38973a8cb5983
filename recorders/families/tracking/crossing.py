"""Targets that cross, move side by side and manoeuvre, seen by a radar in scans with clutter.

Two targets cross at an angle in the middle of the run, two move side by side, and one turns left and
right. The whole scene is rotated at random, so that all runs differ.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.common_streams import truth_stream
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.planar import drive
from fuselog.recorders.models.states import PLANE_MOTION
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
Probability = Annotated[float, Field(gt=0, le=1)]

PLANE = ("x_m", "y_m")
# Duration of a straight course and angle of a turn of the turning target.
STRAIGHT_S, TURN_RAD = 15.0, np.pi / 2


class CrossingParameters(Parameters):
    """Five targets that move in a square, and the radar in its centre.

    Attributes:
        duration_s: length of the run.
        period_s: time between scans.
        side_m: side of the square.
        speed_mps: speed of every target.
        crossing_rad: angle at which two targets cross.
        gap_m: distance between the two targets that move side by side.
        turn_radps: turn rate of the target that turns left and right.
        sigma_m: standard deviation of a detection, per axis.
        detection_probability: probability that a scan detects a target.
        clutter_per_scan: mean number of false detections in a scan (Poisson), spread over the square.
    """

    duration_s: PositiveFloat = 90.0
    period_s: PositiveFloat = 1.0
    side_m: PositiveFloat = 1200.0
    speed_mps: PositiveFloat = 8.0
    crossing_rad: PositiveFloat = 0.4
    gap_m: PositiveFloat = 25.0
    turn_radps: PositiveFloat = 0.15
    sigma_m: PositiveFloat = 10.0
    detection_probability: Probability = 0.9
    clutter_per_scan: NonNegativeFloat = 50.0


def simulate(parameters: CrossingParameters, rng: np.random.Generator) -> Recording:
    """Record one run."""
    scene_rng, radar_rng = rng.spawn(2)
    scans = int(parameters.duration_s / parameters.period_s + 1e-9)
    times_s = parameters.period_s * np.arange(scans + 1, dtype=float)
    states = _states(parameters, times_s, scene_rng.uniform(-np.pi, np.pi))
    stamps_ns = simulation_stamps_ns(times_s)
    truths = [
        truth_stream(f"/target{number}/truth", stamps_ns, PLANE_MOTION, state)
        for number, state in enumerate(states, start=1)
    ]
    return Recording([*_radar(parameters, stamps_ns, states[:, :, 0::2], radar_rng), *truths])


def _states(parameters: CrossingParameters, times_s: Floats, turned_rad: float) -> Floats:
    """Compute the true states (targets, n, 4), x, vx, y, vy."""
    half_s, speed, half_rad = 0.5 * times_s[-1], parameters.speed_mps, 0.5 * parameters.crossing_rad
    north, south = 0.25 * parameters.side_m, -0.25 * parameters.side_m
    side_by_side = [south - 0.5 * parameters.gap_m, south + 0.5 * parameters.gap_m]
    straight = [
        (times_s - half_s, (0.0, 0.0, -half_rad)),
        (times_s - half_s, (0.0, 0.0, half_rad)),
        *((times_s - half_s, (0.0, y, 0.0)) for y in side_by_side),
    ]
    poses = [np.stack(drive(pose, (speed, 0.0), span_s)) for span_s, pose in straight]
    poses.append(_weaving(parameters, times_s, (-0.25 * parameters.side_m, north)))
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    states = []
    for x, y, heading in poses:
        along = heading + turned_rad
        place = cos * x - sin * y, sin * x + cos * y
        states.append(
            np.stack([place[0], speed * np.cos(along), place[1], speed * np.sin(along)], axis=1)
        )
    return np.array(states)


def _weaving(parameters: CrossingParameters, times_s: Floats, begin: tuple[float, float]) -> Floats:
    """Compute poses (3, n) of the target that alternates straight courses with turns left and right."""
    poses, pose, begin_s = np.empty((3, len(times_s))), (*begin, 0.0), 0.0
    way = -1.0
    while begin_s <= times_s[-1]:
        for span_s, turn_radps in (
            (STRAIGHT_S, 0.0),
            (TURN_RAD / parameters.turn_radps, way * parameters.turn_radps),
        ):
            own = (times_s >= begin_s) & (times_s < begin_s + span_s)
            poses[:, own] = drive(pose, (parameters.speed_mps, turn_radps), times_s[own] - begin_s)
            x, y, heading = drive(pose, (parameters.speed_mps, turn_radps), span_s)
            pose, begin_s = (float(x), float(y), float(heading)), begin_s + span_s
        way = -way
    return poses


def _radar(
    parameters: CrossingParameters,
    stamps_ns: NDArray[np.int64],
    places: Floats,
    rng: np.random.Generator,
) -> list[Stream]:
    """Simulate the scans and their detections in random order; `places` are (targets, n, 2)."""
    half_m, scans = 0.5 * parameters.side_m, []
    for scan in range(len(stamps_ns)):
        is_seen = rng.uniform(size=len(places)) < parameters.detection_probability
        error_m = parameters.sigma_m * rng.normal(size=(len(places), 2))
        count = rng.poisson(parameters.clutter_per_scan)
        clutter = rng.uniform(-half_m, half_m, (count, 2))
        scans.append(rng.permutation(np.concatenate([(places[:, scan] + error_m)[is_seen], clutter])))
    counts, number = np.array([len(seen) for seen in scans]), np.arange(len(scans))
    stated = {
        "sigma_m": parameters.sigma_m,
        "detection_probability": min(parameters.detection_probability, 0.999),
        "clutter_per_m2": max(parameters.clutter_per_scan, 1e-3) / parameters.side_m**2,
    }
    return [
        make_stream(
            "/radar/scan",
            schemas.SCAN,
            stamps_ns,
            metadata={name: repr(value) for name, value in stated.items()},
            scan_id=number,
            detections=counts,
        ),
        make_stream(
            "/radar/detection",
            schemas.DETECTION,
            np.repeat(stamps_ns, counts),
            scan_id=np.repeat(number, counts),
            position_m=np.concatenate(scans),
        ),
    ]


CROSSING = Simulator(
    "targets that cross, move side by side and turn; a radar's unordered scans with clutter",
    CrossingParameters,
    simulate,
)
