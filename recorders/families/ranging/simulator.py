"""A trolley in a warehouse whose tags measure ranges to anchors on the walls.

The trolley moves as in the model `ranging-pose`, with white accelerations. Ranges have white noise, a
common bias, a slowly varying error per anchor (a first-order Gauss-Markov process, the same for all
tags), and an excess if the line of sight is blocked.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.common_streams import prior_stream, stated_numbers, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.planes import in_frame
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
Point = tuple[float, float, float]

POSE = ("x_m", "y_m", "heading_rad", "vx_mps", "vy_mps", "turn_radps")


class Blocked(Parameters):
    """Temporarily blocked lines of sight; an anchor is blocked for all tags at the same time.

    Attributes:
        times_per_minute: mean number of times per minute that an anchor is blocked.
        duration_s: mean duration of a blockage.
        least_m: smallest excess of a blocked range.
        most_m: largest excess of a blocked range; excesses are uniformly distributed from `least_m` to
            this value.
    """

    times_per_minute: NonNegativeFloat = 0.0
    duration_s: PositiveFloat = 2.0
    least_m: NonNegativeFloat = 0.5
    most_m: PositiveFloat = 3.0


class RangingParameters(Parameters):
    """Tags on a moving trolley, the anchors to which they measure ranges, and the errors of the ranges.

    Anchors and tags are numbered from 0. All tags measure ranges to all anchors at the same time.
    Channels state only the white noise of ranges.

    Attributes:
        duration_s: length of the run.
        rate_hz: measurements per second.
        anchors_m: positions of the anchors (x, y, z).
        tags_m: positions of the tags on the trolley (forward, left, up).
        height_m: height of the trolley.
        acceleration_density: noise of the acceleration, in m/s^2/sqrt(Hz).
        turn_acceleration_density: noise of the angular acceleration, in rad/s^2/sqrt(Hz).
        sigma_range_m: standard deviation of a range's white noise.
        bias_range_m: bias of all ranges, measured minus true.
        error_sigma_m: standard deviation of the slowly varying error of every anchor.
        error_time_s: correlation time of the slowly varying error.
        blocked: blocked lines of sight.
        start_sigma_m: standard deviation of the initial position, per axis.
        start_sigma_rad: standard deviation of the initial heading.
        start_sigma_mps: standard deviation of the initial velocity, per axis.
        start_sigma_radps: standard deviation of the initial turn rate.
    """

    duration_s: Annotated[float, Field(gt=0)] = 60.0
    rate_hz: PositiveFloat = 10.0
    anchors_m: list[Point] = [
        (-10.0, -6.0, 3.0),
        (0.0, -6.0, 2.5),
        (10.0, -6.0, 3.0),
        (10.0, 6.0, 2.5),
        (0.0, 6.0, 3.0),
        (-10.0, 6.0, 2.5),
    ]
    tags_m: list[Point] = [(0.4, 0.0, 0.0), (-0.3, 0.3, 0.0), (-0.3, -0.3, 0.0)]
    height_m: float = 1.0
    acceleration_density: NonNegativeFloat = 0.01
    turn_acceleration_density: NonNegativeFloat = 0.05
    sigma_range_m: PositiveFloat = 0.05
    bias_range_m: float = 0.0
    error_sigma_m: NonNegativeFloat = 0.0
    error_time_s: PositiveFloat = 5.0
    blocked: Blocked = Blocked()
    start_sigma_m: PositiveFloat = 0.2
    start_sigma_rad: PositiveFloat = 0.2
    start_sigma_mps: PositiveFloat = 0.1
    start_sigma_radps: PositiveFloat = 0.1


def simulate(parameters: RangingParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput if there are no anchors or no tags."""
    for name in ("anchors_m", "tags_m"):
        if not getattr(parameters, name):
            raise BadInput(f"{name} is empty; give at least one point, such as [[0, 0, 2]]")
    start_rng, path_rng, error_rng, blocked_rng, noise_rng = rng.spawn(5)
    times_s = np.arange(int(parameters.duration_s * parameters.rate_hz + 1e-9) + 1) / parameters.rate_hz
    sigma = np.array(
        [
            *[parameters.start_sigma_m] * 2,
            parameters.start_sigma_rad,
            *[parameters.start_sigma_mps] * 2,
            parameters.start_sigma_radps,
        ]
    )
    truth = _path(parameters, len(times_s), sigma * start_rng.normal(size=6), path_rng)
    anchors, tags = np.array(parameters.anchors_m), np.array(parameters.tags_m)
    cosine, sine = np.cos(truth[:, 2, None]), np.sin(truth[:, 2, None])
    places = np.stack(  # (steps, tags, 3)
        [
            truth[:, :1] + cosine * tags[:, 0] - sine * tags[:, 1],
            truth[:, 1:2] + sine * tags[:, 0] + cosine * tags[:, 1],
            np.broadcast_to(parameters.height_m + tags[:, 2], (len(truth), len(tags))),
        ],
        axis=2,
    )
    ranges = np.linalg.norm(places[:, None] - anchors[:, None], axis=3)  # (steps, anchors, tags)
    error = _lasting(parameters, len(times_s), len(anchors), error_rng)
    error += _excess(parameters.blocked, times_s, len(anchors), blocked_rng)
    noise = parameters.sigma_range_m * noise_rng.normal(size=ranges.shape)
    ranges += parameters.bias_range_m + error[:, :, None] + noise
    shape = ranges.shape
    stated = ("height_m", "acceleration_density", "turn_acceleration_density", "sigma_range_m")
    anchor_id, tag_id = (np.broadcast_to(each, shape).ravel() for each in np.indices(shape)[1:])
    start_ns = simulation_stamps_ns([0.0])
    return Recording(
        [
            make_stream(
                "/anchors",
                schemas.LANDMARK,
                np.repeat(start_ns, len(anchors)),
                landmark_id=np.arange(len(anchors)),
                position_m=anchors,
            ),
            make_stream(
                "/tags",
                schemas.BODY_POINT,
                np.repeat(start_ns, len(tags)),
                metadata=in_frame("trolley"),
                point_id=np.arange(len(tags)),
                position_m=tags,
            ),
            prior_stream("/trolley/prior", start_ns, POSE, np.zeros(6), np.diag(sigma**2)),
            truth_stream("/trolley/truth", simulation_stamps_ns(times_s), POSE, truth),
            make_stream(
                "/trolley/ranges",
                schemas.ANCHOR_RANGE,
                simulation_stamps_ns(np.repeat(times_s, shape[1] * shape[2])),
                metadata=stated_numbers(parameters, *stated),
                anchor_id=anchor_id,
                tag_id=tag_id,
                range_m=ranges.ravel(),
            ),
        ]
    )


def _path(parameters: RangingParameters, steps: int, start: Floats, rng: np.random.Generator) -> Floats:
    """Draw the states (steps, 6) under white accelerations; they are exact at every step."""
    step_s = 1.0 / parameters.rate_hz
    place, mixed, speed = noise_moments(1.0, step_s)
    root = np.linalg.cholesky([[place, mixed], [mixed, speed]])
    density = np.array([*[parameters.acceleration_density] * 2, parameters.turn_acceleration_density])
    noise = rng.normal(size=(steps, 3, 2)) @ root.T * density[:, None]
    states = np.empty((steps, 6))
    states[0] = start
    for step in range(1, steps):
        states[step] = states[step - 1]
        states[step, :3] += step_s * states[step - 1, 3:] + noise[step, :, 0]
        states[step, 3:] += noise[step, :, 1]
    return states


def _lasting(
    parameters: RangingParameters, steps: int, anchors: int, rng: np.random.Generator
) -> Floats:
    """Draw the errors of every anchor (steps, anchors): first-order Gauss-Markov processes."""
    kept = np.exp(-1.0 / (parameters.rate_hz * parameters.error_time_s))
    error = parameters.error_sigma_m * rng.normal(size=(steps, anchors))
    for step in range(1, steps):
        error[step] = kept * error[step - 1] + np.sqrt(1.0 - kept**2) * error[step]
    return error


def _excess(blocked: Blocked, times_s: Floats, anchors: int, rng: np.random.Generator) -> Floats:
    """Draw the excess of blocked ranges (times, anchors)."""
    excess = np.zeros((len(times_s), anchors))
    for anchor in range(anchors):
        count = rng.poisson(blocked.times_per_minute * times_s[-1] / 60.0)
        begins_s = rng.uniform(0.0, times_s[-1], count)
        for begin_s, lasts_s in zip(begins_s, rng.exponential(blocked.duration_s, count), strict=True):
            inside = (times_s >= begin_s) & (times_s < begin_s + lasts_s)
            excess[inside, anchor] = rng.uniform(blocked.least_m, blocked.most_m, int(inside.sum()))
    return excess


RANGING = Simulator(
    "a trolley with tags among anchors: ranges with bias, slow errors and blocked lines of sight",
    RangingParameters,
    simulate,
)
