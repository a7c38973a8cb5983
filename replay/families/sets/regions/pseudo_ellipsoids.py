"""Pseudo-ellipsoids: sets of positions that are ellipsoids in a space of monomials.

Briechle, Hanebeck (2004), III and IV. For each of the two generalised discs of a pair, the exact set is
between two circles: with u = (z - centre) / half width, |u| <= 1, and u is linear in the monomials [x,
y, x^2, y^2] of L = 4. With L = 8, [x, y, x^2, y^2, xy, x s, y s, s^2] and s = x^2 + y^2, u^2 is linear
as well, and the parabola (u, u^2) is inside an ellipse. Every fused set is {sum of weighted slacks >=
0}.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import contourpy
import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.families.sets.regions.feasible_sets import Arena, Pairs, discs, evaluate, signed_area

Order = Literal[4, 8]
Weighting = Literal["area", "batch", "determinant", "equal"]
Size = Callable[[Floats], float]
SEARCH_NODES = 120
PRIOR_VARIANCE = 1e2  # of "determinant", in squared half arenas
ROUNDING = 1e-11


class PseudoEllipsoid(NamedTuple):
    """The set T'A T - 2 b'T + c <= 0 of monomials T (order,) of (x - origin) / scale.

    A prior without information, as in section V, is represented by zeros; a huge covariance would lose
    digits.
    """

    information: Floats
    vector: Floats
    constant: float
    origin: Floats
    scale_m: float


class Grid(NamedTuple):
    """Nodes x (n,) and y (n,), and points (n, n, 2), whose rows are along y."""

    x: Floats
    y: Floats
    points: Floats


class Outline(NamedTuple):
    """Border of a set as closed polygons (n, 2), with holes in the opposite direction, and its area."""

    rings: list[Floats]
    area_m2: float


def monomials(points: Floats, order: Order) -> Floats:
    """Compute T(x) of (9), (25): points (..., 2) to (..., order).

    Args:
        points: (..., 2), scaled.
        order: number of monomials.
    """
    x, y = points[..., 0], points[..., 1]
    squared = x**2 + y**2
    columns = [x, y, x**2, y**2]
    if order == 8:
        columns += [x * y, x * squared, y * squared, squared**2]
    return np.stack(columns, axis=-1)


def ring_coefficients(pairs: Pairs, arena: Arena) -> Floats:
    """Compute two rings u = a |x|^2 + b'x + c per pair (2 n, 4), with |u| <= 1 on the exact set.

    If the set is bounded, these are the rings of (22), (23), clamped at a centre in the set; (23) omits
    the offset -d^2/4 of its interval. Otherwise, the arena limits the values.
    """
    flipped = pairs.angle_rad < 0
    first = np.where(flipped[:, None], pairs.second, pairs.first)
    second = np.where(flipped[:, None], pairs.first, pairs.second)
    upright = Pairs(first, second, np.abs(pairs.angle_rad), pairs.bound_rad)
    bounded = (upright.angle_rad > pairs.bound_rad)[:, None]
    low = np.fmax(
        np.where(bounded, _least_on_axis(upright), np.nan),
        _least_in_arena(discs(upright).reshape(-1, 4), arena).reshape(-1, 2),
    )
    scaled = discs(upright) * (-2.0 / low)[..., None]
    scaled[..., 3] += 1.0
    return scaled.reshape(-1, 4)


def _least_on_axis(pairs: Pairs) -> Floats:
    """Find the smallest values (n, 2) of both discs over bounded sets, on the bisector of the chord.

    At height t above the chord of length c, f_g = (sin g (t^2 - c^2/4) - cos g c t) / c; the set extends
    between the tops of both circles, at the heights c/2 cot(g/2).
    """
    angle = pairs.angle_rad[:, None] + pairs.bound_rad * np.array([-1.0, 1.0])
    chord = np.linalg.norm(pairs.second - pairs.first, axis=1)[:, None]
    sign = np.array([1.0, -1.0])
    sine, cosine = sign * np.sin(angle), sign * np.cos(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        tops = 0.5 * chord / np.tan(0.5 * angle)
        centre = np.clip(0.5 * chord * cosine / sine, tops[:, 1:], tops[:, :1])

    def value(height: Floats) -> Floats:
        return (sine * (height**2 - chord**2 / 4) - cosine * chord * height) / chord

    with np.errstate(invalid="ignore"):
        ends = np.minimum(value(tops[:, :1]), value(tops[:, 1:]))
        return np.where(sine > 0, value(centre), ends)


def _least_in_arena(constraints: Floats, arena: Arena) -> Floats:
    """Compute lower bounds (k,) of the functions over the arena; all are tight except those of discs."""
    x, y = np.meshgrid(*np.stack(arena, axis=1))
    corners = evaluate(constraints, np.stack([x.ravel(), y.ravel()], axis=1)).min(axis=0)
    with np.errstate(divide="ignore"):
        bottom = np.where(constraints[:, 0] > 0, -0.25 / constraints[:, 0], np.inf)
    return np.minimum(corners, bottom)


def slack(ring: Floats, points: Floats, order: Order) -> Floats:
    """Compute the ring's slack (...,) at points: 1 - u^2, or (9/4) u^2 (1 - u^2) for order 8.

    Args:
        ring: coefficients of u, (4,), see `ring_coefficients`.
        points: (..., 2), in the ring's unit.
        order: number of monomials.
    """
    squared = evaluate(ring[None], points)[..., 0] ** 2
    return 1.0 - squared if order == 4 else 2.25 * squared * (1.0 - squared)


def measurement(ring: Floats, order: Order) -> tuple[Floats, Floats, Floats]:
    """Compute H (m, order), z (m,) and V (m, m) of a ring: e'V^-1 e = 1 - slack with e = z - H T.

    Args:
        ring: coefficients of u, (4,).
        order: number of monomials.
    """
    a, bx, by, c = ring
    row = np.array([bx, by, a, a])
    if order == 4:
        return row[None], np.array([-c]), np.eye(1)
    squared = np.array(
        [
            2 * c * bx,
            2 * c * by,
            bx**2 + 2 * a * c,
            by**2 + 2 * a * c,
            2 * bx * by,
            2 * a * bx,
            2 * a * by,
            a**2,
        ]
    )
    rows = np.stack([np.append(row, np.zeros(4)), squared])
    return rows, np.array([-c, 2 / 3 - c**2]), np.diag([4 / 3, 4 / 9])


def fuse(prior: PseudoEllipsoid, ring: Floats, weight: float) -> PseudoEllipsoid:
    """Fuse a ring by (18) in information form, that is, by adding to each parameter of the set.

    Args:
        prior: the set before the fusion.
        ring: coefficients of u, (4,), in the prior's scaled positions.
        weight: weight of the ring, 0 or more.
    """
    rows, value, size = measurement(ring, order_of(prior))
    weighted = weight * np.linalg.inv(size)
    return prior._replace(
        information=prior.information + rows.T @ weighted @ rows,
        vector=prior.vector + rows.T @ weighted @ value,
        constant=prior.constant + float(value @ weighted @ value) - weight,
    )


def order_of(ellipsoid: PseudoEllipsoid) -> Order:
    """Return the number of monomials."""
    return 4 if len(ellipsoid.vector) == 4 else 8


def room(ellipsoid: PseudoEllipsoid, points: Floats) -> Floats:
    """Compute the fused slack at points (..., 2), which is >= 0 in the set.

    Args:
        ellipsoid: the set.
        points: (..., 2), in m.

    Returns:
        (...).
    """
    raised = monomials((points - ellipsoid.origin) / ellipsoid.scale_m, order_of(ellipsoid))
    quadratic = np.einsum("...i,...i->...", raised @ ellipsoid.information, raised)
    return 2 * raised @ ellipsoid.vector - quadratic - ellipsoid.constant


def most_room(ellipsoid: PseudoEllipsoid) -> float:
    """Compute the greatest fused slack over all monomials, s of (7), but at least its rounding error.

    Raises BadInput if the slack is negative beyond rounding, because the sets then have no common point.
    """
    centre = np.linalg.lstsq(ellipsoid.information, ellipsoid.vector)[0]
    most = float(ellipsoid.vector @ centre) - ellipsoid.constant
    error = ROUNDING * abs(ellipsoid.constant)
    if most < -error:
        raise BadInput("the sets of the pairs have no common point; use a larger bound")
    return max(most, error)


def fit(
    pairs: Pairs, arena: Arena, order: Order, weighting: Weighting = "area", sweeps: int = 1
) -> PseudoEllipsoid:
    """Fuse all pairs of a frame, each of them as two rings.

    Args:
        pairs: the frame.
        arena: rectangle that is known to contain the robot.
        order: the number L of monomials, 4 or 8.
        weighting: "area" minimises the area of the set at every step, "batch" minimises it over all
            weights together; "determinant" minimises the determinant of C^e, starting from a wide prior;
            "equal" uses equal weights. The paper mentions "area" but gives no procedure for it.
        sweeps: number of times that the rings are fused; fusing a set repeatedly is valid.

    Returns the set, which contains the exact set for any weights. Raises BadInput if the filter finds
    that the sets have no common point.
    """
    origin = 0.5 * (arena.low + arena.high)
    scale_m = 0.5 * float(np.max(arena.high - arena.low))
    near = Arena(*((side - origin) / scale_m for side in arena))
    first, second = ((ends - origin) / scale_m for ends in pairs[:2])
    rings = ring_coefficients(pairs._replace(first=first, second=second), near)
    if weighting == "determinant":
        return _smallest_ellipsoid(rings, order, sweeps)._replace(origin=origin, scale_m=scale_m)
    fused = _nothing(order)._replace(origin=origin, scale_m=scale_m)
    for ring, weight in zip(rings, _weights(rings, near, order, weighting, sweeps), strict=True):
        fused = fuse(fused, ring, weight)
    most_room(fused)
    return fused


def _nothing(order: Order) -> PseudoEllipsoid:
    """Make a set with zero information: the whole space."""
    return PseudoEllipsoid(np.zeros((order, order)), np.zeros(order), 0.0, np.zeros(2), 1.0)


def _weights(rings: Floats, arena: Arena, order: Order, weighting: Weighting, sweeps: int) -> Floats:
    """Find weights (k,) of the rings, with a sum of one."""
    from scipy.optimize import minimize, minimize_scalar  # slow to import

    count = len(rings)
    equal = np.full(count, 1.0 / count)
    if weighting == "equal":
        return equal
    if weighting == "batch":
        area_of = _area_over(rings, equal, arena, order)
        simplex = np.concatenate([np.zeros((1, count)), 0.5 * np.eye(count)])
        options = {"initial_simplex": simplex, "xatol": 1e-2, "fatol": 1e-4 * area_of(equal)}
        best = minimize(
            lambda logarithms: area_of(_shares(logarithms)),
            simplex[0],
            method="Nelder-Mead",
            options=options,
        )
        return _shares(best.x)
    weights = np.eye(count)[0]
    for step in range(1, sweeps * count):
        fresh = np.eye(count)[step % count]
        area_of = _area_over(rings, 0.5 * (weights + fresh), arena, order)

        def size(
            logarithm: float, old: Floats = weights, fresh: Floats = fresh, area_of: Size = area_of
        ) -> float:
            return area_of(old + np.exp(logarithm) * fresh)

        best = minimize_scalar(size, bounds=(-6.0, 4.0), method="bounded", options={"xatol": 0.02})
        weights = weights + np.exp(best.x) * fresh
        weights /= weights.sum()
    return weights


def _shares(logarithms: Floats) -> Floats:
    share = np.exp(logarithms - logarithms.max())
    return share / share.sum()


def _area_over(rings: Floats, weights: Floats, arena: Arena, order: Order) -> Size:
    """Make a function that computes the area of the fused set for weights near the given weights.

    The area is computed in a window; a set that extends beyond it is treated as larger than the window.
    """
    window = _window(lambda points: _fused(rings, weights, points, order), arena, SEARCH_NODES)
    grid = _grid(window, SEARCH_NODES)
    slacks = np.stack([slack(ring, grid.points, order) for ring in rings])
    open_sides = np.concatenate([window.low > arena.low, window.high < arena.high])

    def size(chosen: Floats) -> float:
        values = np.tensordot(chosen, slacks, 1)
        sides = np.stack([values[:, 0], values[0], values[:, -1], values[-1]])
        leaves = np.any((sides >= 0).any(axis=1) & open_sides)
        return _outline(values, grid).area_m2 + leaves * float(np.prod(window.high - window.low))

    return size


def _fused(rings: Floats, weights: Floats, points: Floats, order: Order) -> Floats:
    return sum(
        (weight * slack(ring, points, order) for ring, weight in zip(rings, weights, strict=True)),
        np.zeros(points.shape[:-1]),
    )


def _smallest_ellipsoid(rings: Floats, order: Order, sweeps: int) -> PseudoEllipsoid:
    """Fuse by (7) and (18), with the lambda that minimises the determinant of C^e.

    C^e is s A^-1, with the information A and the greatest slack s, and a weight is lambda times s. The
    prior is wide but proper, because the first determinants would otherwise be infinite; it remains part
    of the result.
    """
    from scipy.optimize import minimize_scalar  # slow to import

    fused = _nothing(order)._replace(information=np.eye(order) / PRIOR_VARIANCE, constant=-1.0)
    for ring in np.tile(rings, (sweeps, 1)):
        most = most_room(fused)

        def log_volume(
            logarithm: float,
            before: PseudoEllipsoid = fused,
            ring: Floats = ring,
            most: float = most,
        ) -> float:
            after = fuse(before, ring, most * float(np.exp(logarithm)))
            sizes = np.linalg.eigvalsh(after.information)
            # with a narrow ring, some eigenvalues of the wide prior are lost by rounding
            sizes = np.maximum(sizes, np.finfo(float).eps * sizes[-1])
            return float(order * np.log(most_room(after)) - np.log(sizes).sum())

        best = minimize_scalar(log_volume, bounds=(-9.0, 4.0), method="bounded")
        fused = fuse(fused, ring, most * float(np.exp(best.x)))
    return fused


def outline(ellipsoid: PseudoEllipsoid, arena: Arena, nodes: int = 400) -> Outline:
    """Compute the part of the set inside the arena, on a grid of `nodes` x `nodes` points around it."""
    window = _window(lambda points: room(ellipsoid, points), arena, nodes)
    grid = _grid(window, nodes)
    return _outline(room(ellipsoid, grid.points), grid)


def _grid(window: Arena, nodes: int) -> Grid:
    x, y = (np.linspace(low, high, nodes) for low, high in zip(*window, strict=True))
    return Grid(x, y, np.stack(np.meshgrid(x, y), axis=-1))


def _window(values: Callable[[Floats], Floats], arena: Arena, nodes: int) -> Arena:
    """Find a window, inside the arena, around the area where values are >= 0, plus a margin."""
    window = arena
    for _ in range(8):
        grid = _grid(window, nodes)
        row, column = np.nonzero(values(grid.points) >= 0)
        if len(row) == 0:
            return window
        low = np.array([grid.x[column.min()], grid.y[row.min()]])
        high = np.array([grid.x[column.max()], grid.y[row.max()]])
        cell = (window.high - window.low) / (nodes - 1)
        margin = 0.1 * (high - low) + 2 * cell
        closer = Arena(np.maximum(low - margin, arena.low), np.minimum(high + margin, arena.high))
        if np.all(closer.high - closer.low > 0.8 * (window.high - window.low)):
            return closer
        window = closer
    return window


def _outline(values: Floats, grid: Grid) -> Outline:
    """Compute the outline of the area where values are >= 0, clipped at the border of the grid."""
    tiny = 1e-9 * (grid.x[-1] - grid.x[0])
    x, y = (np.concatenate([[a[0] - tiny], a, [a[-1] + tiny]]) for a in (grid.x, grid.y))
    closed = np.pad(values, 1, constant_values=-float(np.abs(values).max()))
    lines = contourpy.contour_generator(x, y, closed, line_type="Separate").lines(0.0)
    rings = [np.asarray(line)[:-1] for line in lines]
    return Outline(rings, abs(sum(map(signed_area, rings))))
