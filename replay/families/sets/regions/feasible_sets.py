"""Exact sets of the positions that agree with bounded relative bearings: areas, boxes, borders.

Briechle, Hanebeck, Localization of a Mobile Robot Using Relative Bearing Measurements (2004), (2)-(4),
(20), (21). Every set is an intersection of generalised discs a |x|^2 + b'x + c <= 0: discs, their
complements, half-planes. With |b|^2 - 4 a c = 1, the left side approximates the distance from the
border.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.sets.models import relative_bearing
from fuselog.recorders.models.planar import drive, wrap_angle
from fuselog.replay.engine.arrays import Floats, Integers


class Pairs(NamedTuple):
    """Relative bearings of a frame: landmarks `first`, `second` (n, 2), `angle_rad` (n,), and bound.

    angle = bearing of first - bearing of second, with an error of at most `bound_rad`.
    """

    first: Floats
    second: Floats
    angle_rad: Floats
    bound_rad: float


class Arena(NamedTuple):
    """Rectangle that is known to contain the robot."""

    low: Floats
    high: Floats


class Arcs(NamedTuple):
    """Border of a set as arcs with the set on the left; a set without a border is empty.

    Each arc begins at `start` (m, 2) in direction `heading_rad` (m,) and has `length` (m,) and constant
    `curvature` (m,), which is negative if the set is outside the circle.
    """

    start: Floats
    heading_rad: Floats
    curvature: Floats
    length: Floats

    def at(self, distance: Floats) -> Floats:
        """Compute the points (m, 2) at `distance` (m,) along the arcs."""
        pose = (*self.start.T, self.heading_rad)
        return np.stack(drive(pose, (1.0, self.curvature), distance)[:2], axis=-1)


def make_pairs(first: ArrayLike, second: ArrayLike, angle_rad: ArrayLike, bound_rad: float) -> Pairs:
    """Make the relative bearings of a frame after checking them.

    Raises BadInput if shapes differ, a value is not finite, two landmarks coincide, or the bound is not
    above 0 and below pi / 2 (with a larger bound, the set is not an intersection of discs).

    Args:
        first: (n, 2), the first landmark of each pair, in m.
        second: (n, 2), the second landmark of each pair, in m.
        angle_rad: (n,), bearing of the first minus bearing of the second.
        bound_rad: the largest error of an angle.
    """
    pairs = Pairs(
        np.asarray(first, float).reshape(-1, 2),
        np.asarray(second, float).reshape(-1, 2),
        np.asarray(angle_rad, float).reshape(-1),
        float(bound_rad),
    )
    if not 0 < pairs.bound_rad < 0.5 * np.pi:
        raise BadInput(f"bound {bound_rad} rad: the bound must be above 0 and below pi / 2")
    if not len(pairs.first) == len(pairs.second) == len(pairs.angle_rad):
        raise BadInput(
            f"{len(pairs.first)} first and {len(pairs.second)} second landmarks for "
            f"{len(pairs.angle_rad)} angles; expected one of each per relative bearing"
        )
    if not all(np.isfinite(part).all() for part in pairs[:3]):
        raise BadInput("a landmark or an angle is not finite; remove that relative bearing")
    if np.any(np.all(pairs.first == pairs.second, axis=1)):
        raise BadInput(
            "the two landmarks of a pair are at the same position, so their angle is undefined; remove "
            "that pair"
        )
    return pairs


def arena_around(points: ArrayLike, margin_m: float) -> Arena:
    """Return the rectangle around points, enlarged by a margin on every side.

    Args:
        points: (n, 2), in m.
        margin_m: width of the margin.
    """
    places = np.asarray(points, float)
    return Arena(places.min(axis=0) - margin_m, places.max(axis=0) + margin_m)


def excess_rad(pairs: Pairs, points: Floats) -> Floats:
    """Compute by how much each pair's error exceeds its bound at points; it is <= 0 in the set.

    This is the exact membership test, (4). It is NaN at a landmark itself, where the angle is undefined.

    Args:
        pairs: the relative bearings of a frame.
        points: (..., 2), in m.

    Returns:
        (..., n), in rad.
    """
    seen = relative_bearing((points[..., None, 0], points[..., None, 1]), pairs.first.T, pairs.second.T)
    excess: Floats = np.abs(wrap_angle(seen - pairs.angle_rad)) - pairs.bound_rad
    on_landmark = np.all(points[..., None, :] == pairs.first, -1) | np.all(
        points[..., None, :] == pairs.second, -1
    )
    return np.where(on_landmark, np.nan, excess)


def circles(pairs: Pairs, angle_rad: Floats) -> Floats:
    """Compute the coefficients a, b_x, b_y, c (n, 4) of the discs D(g) of (20), (21) for angles g.

    In D(g), sin(gamma - g) >= 0: its circle passes through both landmarks and, on one side of their
    chord, subtends the chord at the angle g. The sign of (20) requires that Delta_perp is rotated by +90
    degrees, which the paper does not state. If the sine is zero, the disc is a half-plane.

    Args:
        pairs: the n relative bearings of a frame.
        angle_rad: g (n,).
    """
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    sine = np.where(np.abs(sine) < 1e-15, 0.0, sine)
    first, second = pairs.first.T, pairs.second.T
    chord = second - first
    distance = np.hypot(*chord)
    dot = np.sum(first * second, axis=0)
    cross = first[0] * second[1] - first[1] * second[0]
    linear = -sine * (first + second) + cosine * np.stack([-chord[1], chord[0]])
    return np.stack([sine, *linear, sine * dot + cosine * cross], axis=1) / distance[:, None]


def discs(pairs: Pairs) -> Floats:
    """Compute two generalised discs per pair (n, 2, 4); their intersection is the exact set.

    With g1 = angle - bound and g2 = angle + bound, the set is D(g1) without D(g2). This is a lune, or a
    lens if g2 exceeds pi, or the outside of two discs if g1 is below 0; all cases use the same formula.
    """
    lower = circles(pairs, pairs.angle_rad - pairs.bound_rad)
    upper = circles(pairs, pairs.angle_rad + pairs.bound_rad)
    return np.stack([lower, -upper], axis=1)


def half_planes(arena: Arena) -> Floats:
    """Return the arena's four sides as generalised discs (4, 4)."""
    sides = np.zeros((4, 4))
    sides[[0, 1], [1, 2]] = -1.0
    sides[[2, 3], [1, 2]] = 1.0
    sides[:, 3] = *arena.low, *-arena.high
    return sides


def evaluate(constraints: Floats, points: Floats) -> Floats:
    """Compute the values a |x|^2 + b'x + c of constraints (k, 4) at points (..., 2): (..., k).

    Args:
        constraints: (k, 4), a, b_x, b_y, c.
        points: x (..., 2).
    """
    squared = np.sum(points**2, axis=-1)[..., None]
    linear = points @ constraints[:, 1:3].T
    return constraints[:, 0] * squared + linear + constraints[:, 3]


def exact_set(pairs: Pairs, arena: Arena) -> Arcs:
    """Compute the exact feasible set (4) of a frame inside an arena; an empty set has no arcs."""
    constraints = np.concatenate([discs(pairs).reshape(-1, 4), half_planes(arena)])
    return intersection(constraints, arena)


def intersection(constraints: Floats, arena: Arena) -> Arcs:
    """Compute the border of an intersection of generalised discs and the arena.

    Args:
        constraints: (k, 4), a, b_x, b_y, c.
        arena: arena whose sides are among the constraints.
    """
    pieces = _cut(constraints, arena)
    middle = pieces.at(0.5 * pieces.length)
    tolerance = 1e-11 * float(np.linalg.norm(arena.high - arena.low))
    owner = np.repeat(np.arange(len(constraints)), len(pieces.length) // len(constraints))
    value = evaluate(constraints, middle)
    other = np.arange(len(constraints))
    # if two constraints share a border, it belongs to the first
    good = (value < -tolerance) | ((value <= tolerance) & (other > owner[:, None]))
    good[np.arange(len(owner)), owner] = True
    kept = good.all(axis=1) & (pieces.length > tolerance)
    return Arcs(*(part[kept] for part in pieces))


def _cut(constraints: Floats, arena: Arena) -> Arcs:
    """Cut each circle at its intersections with all others, into 2 k + 1 pieces.

    A circle is traversed from its point nearest to the centre of the arena. With tau = tan(h s) / h,
    where h is half the curvature and s the distance along the circle, any other constraint is
    quadratic in tau, for discs and for lines. The circle's own constraint is left out: it is zero
    everywhere, so its roots would only be rounding errors.
    """
    centre = 0.5 * (arena.low + arena.high)
    reach = 4.0 * float(np.linalg.norm(arena.high - arena.low))
    half_curvature = constraints[:, 0]
    slope = constraints[:, 1:3] + 2.0 * half_curvature[:, None] * centre
    offset = evaluate(constraints, centre)
    steepness = np.hypot(*slope.T)
    safe = np.where(steepness > 0, steepness, 1.0)[:, None]
    outward = np.where(steepness[:, None] > 0, slope / safe, [1.0, 0.0])
    base = centre - outward * (2.0 * offset / (steepness + 1.0))[:, None]
    normal = 2.0 * half_curvature[:, None] * base + constraints[:, 1:3]
    direction = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    value = evaluate(constraints, base)
    gradient = 2.0 * half_curvature[None, :, None] * base[:, None] + constraints[None, :, 1:3]
    along = np.einsum("kmi,ki->km", gradient, direction)
    inward = -np.einsum("kmi,ki->km", gradient, normal)
    h = half_curvature[:, None]
    tau = _roots(half_curvature + h * inward + h**2 * value, along, value)
    tau[np.diag_indices(len(tau))] = np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = np.arctan(h[..., None] * tau) / h[..., None]
        end = np.minimum(0.5 * np.pi / np.abs(half_curvature), reach)
        distance = np.where(np.abs(h[..., None] * tau) < 1e-12, tau, turned).reshape(len(h), -1)
    distance = np.where(np.isfinite(distance), distance, 0.0).clip(-end[:, None], end[:, None])
    cuts = np.sort(np.concatenate([-end[:, None], distance, end[:, None]], axis=1), axis=1)
    count = cuts.shape[1] - 1
    heading = np.repeat(np.arctan2(direction[:, 1], direction[:, 0]), count)
    curvature = np.repeat(2.0 * half_curvature, count)
    begin = cuts[:, :-1].ravel()
    whole = Arcs(np.repeat(base, count, axis=0), heading, curvature, begin)
    return Arcs(whole.at(begin), heading + curvature * begin, curvature, np.diff(cuts, axis=1).ravel())


def _roots(quadratic: Floats, linear: Floats, constant: Floats) -> Floats:
    """Find real roots (..., 2) of quadratics without cancellation; missing ones are NaN or infinite."""
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(linear**2 - 4.0 * quadratic * constant)
        half = -0.5 * (linear + np.where(linear < 0, -root, root))
        return np.stack([half / quadratic, constant / half], axis=-1)


def area(border: Arcs) -> float:
    """Compute the enclosed area by Green's theorem, from chords and circular segments."""
    end = border.at(border.length)
    chords = border.start[:, 0] * end[:, 1] - border.start[:, 1] * end[:, 0]
    turn = border.curvature * border.length
    small = np.abs(turn) < 1e-3
    safe = np.where(small, 1.0, turn)
    ratio = np.where(small, turn / 6.0 * (1 - turn**2 / 20.0), (safe - np.sin(safe)) / safe**2)
    return float(0.5 * np.sum(chords + border.length**2 * ratio))


def box(border: Arcs) -> Arena:
    """Compute the tightest axis-parallel box; raise BadInput for an empty set."""
    if len(border.length) == 0:
        raise BadInput("the set is empty and has no bounding box")
    points = [border.start, border.at(border.length)]
    turn = border.curvature * border.length
    for quarter in range(4):
        # the distance at which the arc is parallel to an axis and a coordinate has an extremum
        wanted = quarter * 0.5 * np.pi - border.heading_rad
        ahead = np.where(turn < 0, -((-wanted) % (2 * np.pi)), wanted % (2 * np.pi))
        reached = np.abs(ahead) <= np.abs(turn)
        bent = np.where(border.curvature == 0, 1.0, border.curvature)
        points.append(border.at(np.where(reached, ahead / bent, 0.0)))
    every = np.concatenate(points)
    return Arena(every.min(axis=0), every.max(axis=0))


def rings(border: Arcs, relative_tolerance: float = 1e-3) -> list[Floats]:
    """Compute closed polygons (n, 2) around the set; the set is on their left.

    The polygons contain the set: their vertices are on concave arcs and outside convex ones. The area of
    the polygons exceeds the area of the set by at most the relative tolerance.
    """
    tolerance_m = relative_tolerance * max(area(border), 1e-12) / max(border.length.sum(), 1e-12)
    end = border.at(border.length)
    left = set(range(len(border.length)))
    found: list[Floats] = []
    while left:
        current = left.pop()
        origin = border.start[current]
        corners = [_vertices(border, current, tolerance_m)]
        while left:
            candidates = np.array(sorted(left))
            gaps = np.linalg.norm(border.start[candidates] - end[current], axis=1)
            if np.linalg.norm(origin - end[current]) <= gaps.min():
                break
            current = int(candidates[np.argmin(gaps)])
            left.remove(current)
            corners.append(_vertices(border, current, tolerance_m))
        found.append(np.concatenate(corners))
    return found


def signed_area(ring: Floats) -> float:
    """Compute the area inside a polygon (n, 2), positive if it runs anticlockwise."""
    following = np.roll(ring, -1, axis=0)
    return float(0.5 * np.sum(ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]))


def _vertices(border: Arcs, index: int, tolerance_m: float) -> Floats:
    """Compute vertices along an arc, except its end; on convex arcs, they are tangent intersections."""
    length, curvature = border.length[index], border.curvature[index]
    pieces = int(np.ceil(length * np.sqrt(max(abs(curvature) / (4 * tolerance_m), 1.0 / length)) + 1e-9))
    pieces = max(pieces, int(np.ceil(abs(length * curvature))))
    step = length / pieces
    convex = curvature > 0
    along = step * (np.arange(pieces) + (0.5 if convex else 0.0))
    arc = Arcs(*(np.repeat(part[index : index + 1], pieces, axis=0) for part in border))
    points = arc.at(along)
    if not convex:
        return points
    heading = border.heading_rad[index] + curvature * along
    outward = np.stack([np.sin(heading), -np.cos(heading)], axis=1)
    beyond = (1.0 / np.cos(0.5 * step * curvature) - 1.0) / curvature
    return np.concatenate([border.start[index : index + 1], points + beyond * outward])


def to_blame(pairs: Pairs, arena: Arena) -> Integers:
    """Find the pairs that contradict all other pairs, worst first; none if the exact set is not empty.

    These are the pairs that are violated at the point in the arena with the fewest violations. This
    point is one of the intersections of the circles; ties are resolved by the smallest total excess.
    """
    if len(exact_set(pairs, arena).length):
        return np.empty(0, np.int64)
    constraints = np.concatenate([discs(pairs).reshape(-1, 4), half_planes(arena)])
    places = _cut(constraints, arena).start
    margin = 1e-9 * (arena.high - arena.low)
    inside = np.all((places >= arena.low - margin) & (places <= arena.high + margin), axis=1)
    excess = np.nan_to_num(excess_rad(pairs, places[inside]), nan=0.0)
    violated = excess > 1e-9
    score = violated.sum(axis=1) + np.where(violated, excess, 0.0).sum(axis=1) / (
        np.pi * len(pairs.angle_rad)
    )
    best = excess[np.argmin(score)]
    return np.argsort(-best)[: int((best > 1e-9).sum())]
