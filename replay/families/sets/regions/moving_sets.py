"""Motion of sets of positions and headings that contain a robot; odometry errors are bounded.

A set of positions is a shapely geometry, which may have several pieces; a set of headings is one
interval. Every computed set contains the exact result: offsets by a disc are polygons around the exact
offset, and a margin covers rounding errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fuselog.recorders.extras import AtFirstUse
from fuselog.recorders.models.planar import drive, wrap_angle
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.sets.regions.feasible_sets import Arena
from fuselog.replay.families.sets.regions.pseudo_ellipsoids import PseudoEllipsoid, monomials, outline

if TYPE_CHECKING:
    import shapely
else:
    shapely = AtFirstUse("shapely", "papers", "guaranteed sets over time")

ROUNDING_M = 1e-7
ON_A_LINE_M = 1e-10  # a vertex is removed if it is closer than this to the line between its neighbours
# Segments of an offset per quarter circle. GEOS rounds their number, so that a segment may span 1.5
# times the angle, and simplifies its input by up to 1 % of the distance, so offsets are widened.
QUARTER_SEGMENTS = 8
WIDER = 1.01 / np.cos(1.5 * 0.25 * np.pi / QUARTER_SEGMENTS)
L8_NODES = 48
L8_SAMPLES = 24
L8_STEPS = 60
L8_MOST_GROWTH = 3.0


class Headings(NamedTuple):
    """An interval of headings; all headings if the half width is pi."""

    middle_rad: float
    half_rad: float


ALL_HEADINGS = Headings(0.0, np.pi)


class Odometry(NamedTuple):
    """Poses (n, 3) from odometry alone, and velocities (n, 2) that apply from each stamp to the next."""

    time_ns: Integers
    pose: Floats
    velocity: Floats

    def pose_at(self, time_ns: Integers) -> Floats:
        """Compute poses (m, 3) at any stamps; before the first stamp the robot is stationary."""
        row = np.maximum(np.searchsorted(self.time_ns, time_ns, side="right") - 1, 0)
        duration_s = np.maximum((time_ns - self.time_ns[row]) * 1e-9, 0.0)
        return np.stack(drive(self.pose[row].T, self.velocity[row].T, duration_s), axis=1)


class Growth(NamedTuple):
    """Bound of the error of odometry over a span of time: `offset` + `rate` × duration in s."""

    offset: float
    rate: float

    def over(self, span_s: Any) -> Any:
        """Compute the largest error over a span, or over each of several spans."""
        return self.offset + self.rate * span_s


class Motion(NamedTuple):
    """Motion of a robot between two stamps, relative to its pose at the first.

    The true displacement is within `position_error_m` of `displacement_m` (2,), and the true turn within
    `turn_error_rad` of `turn_rad`.
    """

    displacement_m: Floats
    position_error_m: float
    turn_rad: float
    turn_error_rad: float


def odometry_of(time_ns: Integers, velocity: Floats) -> Odometry:
    """Integrate poses from the origin, with velocities that are constant until the next stamp.

    Args:
        time_ns: (n,), the stamps.
        velocity: (n, 2), forward velocity in m/s and turn rate in rad/s.
    """
    duration_s = np.diff(time_ns, append=time_ns[-1:]) * 1e-9
    heading = np.concatenate([[0.0], np.cumsum(velocity[:, 1] * duration_s)])[:-1]
    x, y, _ = drive((0.0, 0.0, heading), velocity.T, duration_s)
    place = np.cumsum(np.stack([x, y], axis=1), axis=0)
    return Odometry(
        time_ns,
        np.column_stack([np.concatenate([np.zeros((1, 2)), place[:-1]]), heading]),
        velocity,
    )


def relative_pose(first: Floats, second: Floats) -> Floats:
    """Compute a second pose relative to a first one: displacement, and rotation without wrapping.

    Args:
        first: (..., 3), x, y in m and heading in rad.
        second: (..., 3), in the same units.

    Returns:
        (..., 3), in the axes of the first.
    """
    away = second[..., :2] - first[..., :2]
    cosine, sine = np.cos(first[..., 2]), np.sin(first[..., 2])
    ahead = cosine * away[..., 0] + sine * away[..., 1]
    left = cosine * away[..., 1] - sine * away[..., 0]
    return np.stack([ahead, left, second[..., 2] - first[..., 2]], axis=-1)


def common_headings(one: Headings, other: Headings) -> Headings | None:
    """Return the intersection of two intervals of headings, or None if they do not overlap.

    If wide intervals overlap at both ends, their intersection is not an interval; the result is then the
    narrower of the two intervals, which contains the intersection.
    """
    apart = float(wrap_angle(other.middle_rad - one.middle_rad))
    if one.half_rad + other.half_rad >= 2.0 * np.pi - abs(apart):
        return min(one, other, key=lambda each: each.half_rad)
    low = max(-one.half_rad, apart - other.half_rad)
    high = min(one.half_rad, apart + other.half_rad)
    if low > high:
        return None
    return Headings(float(wrap_angle(one.middle_rad + 0.5 * (low + high))), 0.5 * (high - low))


def all_headings_of(one: Headings, other: Headings) -> Headings:
    """Return the smallest interval that contains both intervals."""
    apart = float(wrap_angle(other.middle_rad - one.middle_rad))
    low = min(-one.half_rad, apart - other.half_rad)
    high = max(one.half_rad, apart + other.half_rad)
    if high - low >= 2.0 * np.pi:
        return ALL_HEADINGS
    return Headings(float(wrap_angle(one.middle_rad + 0.5 * (low + high))), 0.5 * (high - low))


def turned(headings: Headings, motion: Motion, direction: int = 1) -> Headings:
    """Compute headings after a motion; with direction -1, compute the headings before it."""
    middle = float(wrap_angle(headings.middle_rad + direction * motion.turn_rad))
    return Headings(middle, min(headings.half_rad + motion.turn_error_rad, np.pi))


def moved(
    places: shapely.Geometry, headings: Headings, motion: Motion, direction: int = 1
) -> shapely.Geometry:
    """Compute the positions of a robot after a motion; with direction -1, compute those before it.

    `headings` apply before the motion. The displacements for all headings are on an arc, and the set is
    offset by a disc that contains this arc. If the headings span half a circle or more, the centre of
    the disc is the origin.
    """
    half = min(headings.half_rad, 0.5 * np.pi)
    length = float(np.hypot(*motion.displacement_m))
    bearing = float(np.arctan2(motion.displacement_m[1], motion.displacement_m[0]))
    way = headings.middle_rad + bearing
    along = direction * length * np.cos(half)
    radius = length * np.sin(half) + motion.position_error_m + ROUNDING_M
    shifted = shapely.transform(
        places, lambda points: points + along * np.array([np.cos(way), np.sin(way)])
    )
    return shifted.buffer(radius * WIDER, quad_segs=QUARTER_SEGMENTS)


def directions(places: shapely.Geometry, target: Floats) -> Headings:
    """Compute the directions from a set to a point; all directions if the point is in its hull.

    Args:
        places: the set.
        target: the point (2,), in m.
    """
    hull = places.convex_hull
    if hull.covers(shapely.Point(target)):
        return ALL_HEADINGS
    away = target - shapely.get_coordinates(hull)
    middle = float(np.arctan2(*(target - shapely.get_coordinates(hull.centroid)[0])[::-1]))
    apart = wrap_angle(np.arctan2(away[:, 1], away[:, 0]) - middle)
    return Headings(
        float(wrap_angle(middle + 0.5 * (apart.min() + apart.max()))),
        float(0.5 * (apart.max() - apart.min())) + ROUNDING_M,
    )


def from_rings(rings: Sequence[Floats]) -> shapely.Geometry:
    """Make a set from its borders (n, 2); holes have the opposite orientation."""
    places: shapely.Geometry = shapely.Polygon()
    for ring in rings:
        places = places.symmetric_difference(shapely.make_valid(shapely.Polygon(ring)))
    return places


def corners_of(places: shapely.Geometry) -> shapely.Geometry:
    """Remove vertices on straight edges of a set, because their presence depends on rounding."""
    return shapely.simplify(places, ON_A_LINE_M)


def to_rings(places: shapely.Geometry) -> list[Floats]:
    """Return the borders (n, 2) of a set, with the set on their left."""
    found = []
    for part in shapely.get_parts(corners_of(places)):
        if isinstance(part, shapely.Polygon) and not part.is_empty:
            upright = shapely.orient_polygons(part)
            found += [
                shapely.get_coordinates(ring)[:-1] for ring in (upright.exterior, *upright.interiors)
            ]
    return found


def within_l8(places: shapely.Geometry) -> shapely.Geometry:
    """Enclose a set in a pseudo-ellipsoid with L = 8, as a polygon.

    The result is the level set of the smallest ellipsoid around the monomials T of the set's points,
    enlarged until it contains the set. The weights of these points are computed by the multiplicative
    updates of Titterington, 1976, which need no step length. A set that is too thin for the grid of the
    border is returned unchanged.
    """
    low, high = np.reshape(places.bounds, (2, 2))
    origin, scale_m = 0.5 * (low + high), 0.5 * float(np.max(high - low))
    arena = Arena(low - scale_m, high + scale_m)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, L8_SAMPLES).T), axis=-1).reshape(-1, 2)
    inside = grid[shapely.contains_xy(places, grid[:, 0], grid[:, 1])]
    points = np.concatenate([shapely.get_coordinates(places), inside])
    raised = monomials((points - origin) / scale_m, 8)
    lifted = np.column_stack([raised, np.ones(len(raised))])
    weights = np.full(len(lifted), 1.0 / len(lifted))
    for _ in range(L8_STEPS):
        information = np.linalg.pinv(lifted.T @ (weights[:, None] * lifted), hermitian=True)
        value = np.einsum("ni,ij,nj->n", lifted, information, lifted)
        weights *= value
        weights /= weights.sum()
    level = float(value.max())
    while level < L8_MOST_GROWTH * value.max():
        around = PseudoEllipsoid(
            information[:8, :8], -information[:8, 8], float(information[8, 8]) - level, origin, scale_m
        )
        found = from_rings(outline(around, arena, L8_NODES).rings)
        if found.covers(places):
            return found
        level *= 1.05
    return places
