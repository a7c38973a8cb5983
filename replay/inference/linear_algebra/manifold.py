"""Operations on states on their manifold: boxplus, boxminus, and the right Jacobian.

Kinds and tangent spaces are defined in `fuselog.replay.engine.vectors.tangent`: a quaternion q
(Hamilton, w x y z) plus a rotation vector d is q exp(d/2), and an axis (a unit complex number) plus an
angle is its product with exp(i angle). Hertzberg et al., Information Fusion 14, 2013, define boxplus,
the addition of a step, and boxminus, the difference of two states; Sola, arXiv 1711.02508.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np

from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.vectors.tangent import TANGENT_WIDTHS, WIDTHS

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
SETTLED = 1e-15  # rad: smallest change of a mean of rotations that needs another iteration
SLIGHT = 1e-7  # rad: up to here, what is of second order in a change is below rounding


class Boxplus(Protocol):
    """Function that moves a state x (n,) by a tangent vector d (t,), in place."""

    def __call__(self, x: Floats, d: Sequence[float] | Floats, /) -> None: ...


class Boxminus(Protocol):
    """Function that fills row k of d (..., t) with a boxminus b, for states (n,)."""

    def __call__(
        self, a: Sequence[float] | Floats, b: Sequence[float] | Floats, d: Floats, k: int, /
    ) -> None: ...


class Turning(Protocol):
    """Function that multiplies a rotation's rows (t, m) by its (inverse) right Jacobian at d (t,)."""

    def __call__(self, d: Floats, rows: Floats, /) -> None: ...


class Recentre(Protocol):
    """Function that changes the centre of tangent vectors (L, t) by a shift (t,); see `recentring`."""

    def __call__(self, values: Floats, shift: Floats, /) -> bool: ...


def tangent_size(kinds: Sequence[str]) -> int:
    """Return the number of tangent components for components of these kinds."""
    return sum(width for _, _, _, width in manifold_blocks(kinds))


def manifold_blocks(kinds: Sequence[str]) -> list[tuple[str, int, int, int]]:
    """List kind, first component, first tangent component and size of each angle, axis and so on."""
    found, component, tangent = [], 0, 0
    while component < len(kinds):
        kind = kinds[component]
        found.append((kind, component, tangent, TANGENT_WIDTHS[kind]))
        component += WIDTHS[kind]
        tangent += TANGENT_WIDTHS[kind]
    return found


def curved_blocks(kinds: Sequence[str]) -> tuple[tuple[str, int, int, int], ...]:
    """Return the angles, axes and quaternions of `manifold_blocks`."""
    return tuple(each for each in manifold_blocks(kinds) if each[0] != "linear")


def is_flat(kinds: Sequence[str]) -> bool:
    """Test whether the tangent space equals the space itself, except for the wrapping of angles."""
    return set(kinds) <= {"linear", "angle"}


@lru_cache(maxsize=64)
def boxplus(kinds: tuple[str, ...], *, is_curved: bool = False) -> Boxplus:
    """Make `add(x, d)`, which moves the state x (n,) in place to x boxplus d, with d (t,).

    With `is_curved`, linear components are not changed.
    """
    parts = curved_blocks(kinds) if is_curved else tuple(manifold_blocks(kinds))

    def add(x: Floats, d: Sequence[float] | Floats) -> None:
        for kind, c, t, _ in parts:
            if kind in ("linear", "angle"):
                x[c] += d[t]
            elif kind == "axis":
                cosine, sine = np.cos(d[t]), np.sin(d[t])
                x[c], x[c + 1] = x[c] * cosine - x[c + 1] * sine, x[c] * sine + x[c + 1] * cosine
            else:
                turn = from_vector(d[t], d[t + 1], d[t + 2])
                w, i, j, k = product((x[c], x[c + 1], x[c + 2], x[c + 3]), turn)
                length = np.sqrt(w * w + i * i + j * j + k * k)
                x[c], x[c + 1], x[c + 2], x[c + 3] = w / length, i / length, j / length, k / length

    return add


@lru_cache(maxsize=64)
def boxminus(kinds: tuple[str, ...]) -> Boxminus:
    """Make `subtract(a, b, d, k)`, which fills row k of d (..., t) with a boxminus b, of states (n,)."""
    parts = tuple(manifold_blocks(kinds))

    def subtract(a: Sequence[float] | Floats, b: Sequence[float] | Floats, d: Floats, k: int) -> None:
        for kind, c, t, _ in parts:
            if kind == "linear":
                d[k, t] = a[c] - b[c]
            elif kind == "angle":
                change = a[c] - b[c]
                d[k, t] = change if abs(change) < np.pi else wrap_angle(change)
            elif kind == "axis":
                cosine = b[c] * a[c] + b[c + 1] * a[c + 1]
                sine = b[c] * a[c + 1] - b[c + 1] * a[c]
                sign = -1.0 if cosine < 0.0 else 1.0
                d[k, t] = np.arctan2(sign * sine, sign * cosine)
            else:
                p = (b[c], b[c + 1], b[c + 2], b[c + 3])
                q = (a[c], a[c + 1], a[c + 2], a[c + 3])
                d[k, t], d[k, t + 1], d[k, t + 2] = to_vector(*product(conjugate(p), q))

    return subtract


@lru_cache(maxsize=64)
def by_right_jacobian(kinds: tuple[str, ...], *, back: bool = False) -> Turning:
    """Make `reset(d, rows)`, which multiplies a rotation's rows (t, m) by its right Jacobian at d (t,).

    Applied from both sides, it transforms a covariance from the old mean to the mean moved by d: Jr P
    Jr'. With `back`, it multiplies by the inverse, for the opposite transformation.
    """
    factors_of = inverse_right_jacobian_factors if back else right_jacobian_factors
    turns = tuple(t for kind, _, t, _ in manifold_blocks(kinds) if kind == "quaternion")

    def reset(d: Floats, rows: Floats) -> None:
        for t in turns:
            x, y, z = d[t], d[t + 1], d[t + 2]
            first, second = factors_of(x * x + y * y + z * z)
            for column in range(rows.shape[1]):
                a, b, c = rows[t, column], rows[t + 1, column], rows[t + 2, column]
                u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
                rows[t, column] = a - first * u + second * (y * w - z * v)
                rows[t + 1, column] = b - first * v + second * (z * u - x * w)
                rows[t + 2, column] = c - first * w + second * (x * v - y * u)

    return reset


def right_jacobian_factors(squared: float) -> tuple[float, float]:
    """Compute the factors f, g of Jr(d) = I - f [d]x + g [d]x^2, from t^2 = |d|^2.

    They are (1 - cos t)/t^2 and (t - sin t)/t^3. Markley 2003; Mueller 2017.
    """
    angle = np.sqrt(squared)
    half = np.sinc(0.5 * angle / np.pi)
    if angle < 0.05:
        second = (1.0 - squared / 20.0 * (1.0 - squared / 42.0)) / 6.0
    else:
        second = (angle - np.sin(angle)) / (squared * angle)
    return 0.5 * half * half, second


def inverse_right_jacobian_factors(squared: float) -> tuple[float, float]:
    """Compute the factors of the inverse, I + [d]x/2 + (1 - t/2 cot t/2)/t^2 [d]x^2; Sola, (144)."""
    angle = np.sqrt(squared)
    if angle < 0.05:
        second = (1.0 + squared / 60.0 * (1.0 + squared / 42.0)) / 12.0
    else:
        second = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / squared
    return -0.5, second


@lru_cache(maxsize=64)
def recentring(kinds: tuple[str, ...]) -> Recentre:
    """Make `recentre(values, shift)`, which changes the centre of tangent vectors (L, t) by a shift.

    Linear components are not changed. The function returns whether the weighted sum of the values may
    still differ from zero, because an angle was wrapped or rotations have not converged.
    """
    parts = curved_blocks(kinds)

    def recentre(values: Floats, shift: Floats) -> bool:
        again = False
        for kind, _, t, _ in parts:
            if kind == "angle":
                for index in range(len(values)):
                    change = values[index, t] - shift[t]
                    if not abs(change) < np.pi:
                        change = wrap_angle(change)
                        again = True
                    values[index, t] = change
            elif kind == "axis":
                for index in range(len(values)):
                    change = values[index, t] - shift[t]
                    if not abs(change) < 0.5 * np.pi:
                        change = (change + 0.5 * np.pi) % np.pi - 0.5 * np.pi
                        again = True
                    values[index, t] = change
            else:
                x, y, z = shift[t], shift[t + 1], shift[t + 2]
                # `&` and `|` make one condition, and so one branch in C
                is_slight = (abs(x) < SLIGHT) & (abs(y) < SLIGHT) & (abs(z) < SLIGHT)
                if (abs(x) > SETTLED) | (abs(y) > SETTLED) | (abs(z) > SETTLED):  # they change
                    again = True
                    turned_back = conjugate(from_vector(x, y, z))
                    for index in range(len(values)):
                        a, b, c = values[index, t], values[index, t + 1], values[index, t + 2]
                        squared = a * a + b * b + c * c
                        if is_slight & (squared < 1.0):
                            turn = slightly_turned_back((a, b, c), squared, (x, y, z))
                        else:
                            turn = to_vector(*product(turned_back, from_vector(a, b, c)))
                        values[index, t], values[index, t + 1], values[index, t + 2] = turn
        return again

    return recentre


def slightly_turned_back(v: Vector, squared: float, d: Vector) -> Vector:
    """Return the rotation vector of exp(-d) exp(v), for |v|^2 < 1 and a slight rotation d.

    It is v - d + v x d / 2 - g v x (v x d), with g of `inverse_right_jacobian_factors` as a series.
    """
    (a, b, c), (x, y, z) = v, d
    second = (1.0 / 12.0) + squared * (
        (1.0 / 720.0) + squared * ((1.0 / 30240.0) + squared * (1.0 / 1209600.0))
    )
    i, j, k = b * z - c * y, c * x - a * z, a * y - b * x
    return (
        a - (x - 0.5 * i + second * (b * k - c * j)),
        b - (y - 0.5 * j + second * (c * i - a * k)),
        c - (z - 0.5 * k + second * (a * j - b * i)),
    )


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Compute the Hamilton product of two quaternions."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def conjugate(q: Quaternion) -> Quaternion:
    """Return the conjugate of a quaternion, which is the inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def from_vector(x: float, y: float, z: float) -> Quaternion:
    """Return the unit quaternion of a rotation vector."""
    half = 0.5 * np.sqrt(x * x + y * y + z * z + 1e-300)  # positive, so sine / half is 1 at 0
    cosine, sine = np.cos(half), np.sin(half)  # of the same number, because libm computes both together
    scale = 0.5 * sine / half
    return cosine, scale * x, scale * y, scale * z


def to_vector(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the shortest rotation vector of a unit quaternion or, equivalently, of its negative."""
    sign = -1.0 if w < 0.0 else 1.0
    length = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(length, sign * w)
    scale = 2.0 * sign * (angle / length if length > 0.0 else 1.0)
    return scale * x, scale * y, scale * z
