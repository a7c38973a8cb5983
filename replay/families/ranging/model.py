"""Models that locate tags from ranges to anchors with known positions, as with ultra-wideband radios.

`ranging-pose` uses several tags on a body in the plane and also estimates the body's heading;
`ranging-position` uses one tag. Velocities are random walks. Besides white noise, the models include
three other errors of ranges: a bias (`bias_range_m`), an error of each anchor or anchor-tag pair that
lasts for seconds, and outliers when the line of sight is blocked. All three are options, see
`fuselog.replay.inference.model.augmentation` and `fuselog.replay.inference.linear_algebra.inflation`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.models.inertial import distance
from fuselog.recorders.models.planar import Components
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.vectors.tangent import Kind
from fuselog.replay.estimators.navigation.sensors import ANCHORS, RANGE, TAGS
from fuselog.replay.inference.model.model import Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start, Started

HEADINGS = 8  # from which the search for a pose begins
_NS = 1e-9


class RangingParameters(ModelParameters):
    """Noise of motion and ranges, bias, height of the tag, and search for the initial state.

    The initial state is found by least squares from the first ranges, starting at positions on all
    sides of the anchors' centre.

    Attributes:
        acceleration_density: noise of the acceleration, in m/s^2/sqrt(Hz).
        sigma_range_m: standard deviation of a range.
        bias_range_m: bias of ranges: measured minus true.
        height_m: height at which the tag moves.
        range_delay_s: delay of ranges: time from the measurement to the stamp.
        start_s: duration of the initial span of ranges, from which the initial state is found.
        start_reach_m: distance from the anchors' centre to the positions, on all sides of it, at which
            the search starts.
        start_sigma_m: standard deviation of the initial position, per axis.
        start_sigma_mps: standard deviation of the initial velocity, per axis.
    """

    acceleration_density: NonNegativeFloat | None = None
    sigma_range_m: PositiveFloat | None = None
    bias_range_m: float = 0.0
    height_m: float | None = None
    range_delay_s: float = 0.0
    start_s: PositiveFloat = 1.0
    start_reach_m: PositiveFloat = 5.0
    start_sigma_m: PositiveFloat = 2.0
    start_sigma_mps: PositiveFloat = 1.0


class PoseRangingParameters(RangingParameters):
    """Noise of the body's rotation, and uncertainty of its initial heading and turn rate.

    Attributes:
        turn_acceleration_density: noise of the angular acceleration, in rad/s^2/sqrt(Hz).
        start_sigma_rad: standard deviation of the initial heading.
        start_sigma_radps: standard deviation of the initial turn rate.
    """

    turn_acceleration_density: NonNegativeFloat | None = None
    start_sigma_m: PositiveFloat = 0.2
    start_sigma_mps: PositiveFloat = 0.5
    start_sigma_rad: PositiveFloat = 0.3
    start_sigma_radps: PositiveFloat = 0.5


def move(state: Components, control: Components, duration_s: Any, parameters: Any) -> Components:
    """Predict position and velocity, assuming constant velocity."""
    x, y, vx, vy = state
    return x + duration_s * vx, y + duration_s * vy, vx, vy


def move_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Compute the rows of the lower triangle of the process noise covariance."""
    place, mixed, speed = noise_moments(parameters.acceleration_density**2, duration_s)
    return place, 0.0, place, mixed, 0.0, speed, 0.0, mixed, 0.0, speed


def move_pose(state: Components, control: Components, duration_s: Any, parameters: Any) -> Components:
    """Predict a pose and its velocities, assuming constant velocity and turn rate."""
    x, y, heading, vx, vy, turn = state
    return x + duration_s * vx, y + duration_s * vy, heading + duration_s * turn, vx, vy, turn


def move_pose_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Compute the rows of the lower triangle of the process noise covariance."""
    place, mixed, speed = noise_moments(parameters.acceleration_density**2, duration_s)
    angle, turning, turn = noise_moments(parameters.turn_acceleration_density**2, duration_s)
    # fmt: off
    return (
        place,
        0.0, place,
        0.0, 0.0, angle,
        mixed, 0.0, 0.0, speed,
        0.0, mixed, 0.0, 0.0, speed,
        0.0, 0.0, turning, 0.0, 0.0, turn,
    )
    # fmt: on


def see(state: Components, anchor: Components, parameters: Any) -> Components:
    """Compute the measured range to an anchor."""
    here = state[0], state[1], parameters.height_m
    return (distance(here, anchor) + parameters.bias_range_m,)


def see_by_tag(state: Components, reference: Components, parameters: Any) -> Components:
    """Compute the measured range from a tag to an anchor; `reference` is the anchor, then the tag."""
    cosine, sine = np.cos(state[2]), np.sin(state[2])
    ahead, left, up = reference[3], reference[4], reference[5]
    tag = (
        state[0] + cosine * ahead - sine * left,
        state[1] + sine * ahead + cosine * left,
        parameters.height_m + up,
    )
    return (distance(tag, reference) + parameters.bias_range_m,)


def see_noise(parameters: Any) -> Components:
    """Return the variance of a range."""
    return (parameters.sigma_range_m**2,)


def find_position(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Find the position that best fits the first ranges; see `RangingParameters` and `find_pose`."""
    time_ns, ranges, anchors, _ = first_ranges(streams, parameters, 3)

    def residuals(place: Floats) -> Floats:
        return see(place, anchors.T, parameters)[0] - ranges

    found = best_fit(residuals, around(anchors, parameters), parameters)
    sigma = np.repeat([parameters.start_sigma_m, parameters.start_sigma_mps], 2)
    return Started(time_ns, np.append(found, [0.0, 0.0]), np.diag(sigma**2), HOW)


def find_pose(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Find the pose of a stationary body that best fits the first ranges; start from several headings.

    Args:
        streams: `ranges`, the map of anchors, and the tags.
        parameters: `PoseRangingParameters`.

    Raises BadInput if no span of `start_s` contains enough ranges.
    """
    time_ns, ranges, anchors, tags = first_ranges(streams, parameters, 4)

    def residuals(pose: Floats) -> Floats:
        return see_by_tag(pose, (*anchors.T, *tags.T), parameters)[0] - ranges

    starts = [
        np.append(place, heading)
        for place in around(anchors, parameters)
        for heading in np.arange(HEADINGS) * (2.0 * np.pi / HEADINGS)
    ]
    found = best_fit(residuals, starts, parameters)
    sigma = np.array(
        [
            *[parameters.start_sigma_m] * 2,
            parameters.start_sigma_rad,
            *[parameters.start_sigma_mps] * 2,
            parameters.start_sigma_radps,
        ]
    )
    return Started(time_ns, np.append(found, np.zeros(3)), np.diag(sigma**2), HOW)


def first_ranges(
    streams: Mapping[str, Stream], parameters: Any, least: int
) -> tuple[int, Floats, Floats, Floats]:
    """Find the first span of length `start_s` with at least three anchors and `least` anchor-tag pairs.

    Returns the stamp of the first range, the ranges (n,), their anchors (n, 3) and their tags (n, 3).
    The tags are zeros for a model without tags. Raises BadInput if there is no such span.
    """
    stream = streams["ranges"]
    time_ns, pairs = stream.publish_time_ns, np.stack([stream["anchor_id"], stream["tag_id"]], axis=1)
    anchors, tags = (places(streams.get(each.topic), each) for each in (ANCHORS, TAGS))
    known = [a in anchors and (not tags or t in tags) for a, t in pairs.tolist()]
    rows = np.flatnonzero(known & np.isfinite(stream["range_m"]))
    ends = np.searchsorted(time_ns[rows], time_ns[rows] + round(parameters.start_s / _NS), side="right")
    for begin, end in enumerate(ends.tolist()):
        if end - begin < least:
            continue
        span = rows[begin:end]
        _, firsts = np.unique(pairs[span], axis=0, return_index=True)
        chosen = span[np.sort(firsts)]
        if len(chosen) >= least and len(np.unique(pairs[chosen, 0])) >= 3:
            of = np.array(
                [[*anchors[a], *tags.get(t, (0.0, 0.0, 0.0))] for a, t in pairs[chosen].tolist()]
            )
            delay_ns = round(parameters.range_delay_s / _NS)
            return int(time_ns[rows[begin]]) - delay_ns, stream["range_m"][chosen], of[:, :3], of[:, 3:]
    raise BadInput(
        f"topic {stream.topic}: no span of {parameters.start_s:g} s has ranges of {least} pairs of "
        f"anchor and tag, with three anchors of {ANCHORS.topic}; use a longer start_s, or "
        "add a prior to the log"
    )


def places(points: Stream | None, asked: Map) -> dict[int, Floats]:
    """Return the position (3,) of each point of a map, by the point's number."""
    if points is None:
        return {}
    return dict(zip(points[asked.number].tolist(), points[asked.point], strict=True))


def around(anchors: Floats, parameters: Any) -> list[Floats]:
    """Return positions (2,) on four sides of the anchors' centre, from which a search begins.

    Args:
        anchors: (n, 3), in m; repeated anchors count once.
        parameters: parameters with `start_reach_m`, the distance of the positions from the centre.
    """
    middle, reach = np.unique(anchors, axis=0).mean(axis=0)[:2], parameters.start_reach_m
    return [middle + reach * np.array(side) for side in ((1, 0), (-1, 0), (0, 1), (0, -1))]


def best_fit(residuals: Any, starts: list[Floats], parameters: Any) -> Floats:
    """Find the best of several robust least-squares fits that begin at different points.

    Args:
        residuals: function that maps a position or pose (k,) to the residuals (n,) of ranges, in m.
        starts: positions or poses (k,) from which to search.
        parameters: parameters with `sigma_range_m`; residuals above three times this value have less
            weight.
    """
    from scipy.optimize import least_squares  # slow to import

    scale = 3.0 * parameters.sigma_range_m
    fits = [least_squares(residuals, start, loss="soft_l1", f_scale=scale) for start in starts]
    return min(fits, key=lambda fit: float(fit.cost)).x


HOW = "at the best fit to its first ranges"
VELOCITY: Mapping[str, Kind] = {"vx_mps": "linear", "vy_mps": "linear"}
ERRORS: Mapping[str, Kind] = {"bias_range_m": "linear", "height_m": "linear"}
# Default for logs that do not state it: a radio outdoors, on an object that is pushed or driven slowly.
ASSUMED = {"acceleration_density": 0.5, "sigma_range_m": 0.1, "height_m": 1.0}
RANGING_POSITION = Model(
    "position in the plane from ranges to anchors",
    {"x_m": "linear", "y_m": "linear", **VELOCITY},
    RangingParameters,
    (
        Sensor(
            "ranges",
            schemas.ANCHOR_RANGE,
            RANGE,
            see,
            see_noise,
            reference=ANCHORS,
            delay="range_delay_s",
        ),
    ),
    Motion(move, move_noise, linear=True),
    start=Start({}, ASSUMED, find=find_position),
    augmentable=ERRORS,
    takes_fixes=False,
)
RANGING_POSE = Model(
    "pose in the plane from ranges between anchors and tags on the body",
    {"x_m": "linear", "y_m": "linear", "heading_rad": "angle", **VELOCITY, "turn_radps": "linear"},
    PoseRangingParameters,
    (
        Sensor(
            "ranges",
            schemas.ANCHOR_RANGE,
            RANGE,
            see_by_tag,
            see_noise,
            reference=(ANCHORS, TAGS),
            delay="range_delay_s",
        ),
    ),
    Motion(move_pose, move_pose_noise, linear=True),
    start=Start({}, {**ASSUMED, "turn_acceleration_density": 1.0}, find=find_pose),
    augmentable=ERRORS,
    takes_fixes=False,
)
