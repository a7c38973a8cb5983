"""Axes and orientations as unit complex numbers and quaternions, where x and -x are equal.

The algebra of Kurz, Gilitschenski, Julier, Hanebeck, "Recursive Bingham Filter", JAIF 9(2), 2014,
section 5.3. Quaternions are (w, x, y, z); all arrays keep their components on the last axis.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.errors import BadInput

# Basis elements multiply as e_j e_k = SIGNS[j, k] e_(j xor k). The complex numbers are the first two.
SIGNS = np.array(
    [[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0]]
)
SIGNS.setflags(write=False)
XOR = np.bitwise_xor.outer(np.arange(4), np.arange(4))

AXIS_KINDS = {"axis_x": "axis", "axis_y": "axis"}
ORIENTATION_KINDS = {f"orientation_{part}": "quaternion" for part in "wxyz"}


def left_matrix(left: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix (..., d, d) of y -> left (+) y, for `left` (..., d) with d = 2 or 4."""
    left = np.asarray(left, float)
    d = left.shape[-1]
    other = XOR[:d, :d]
    return left[..., other] * SIGNS[other, np.arange(d)]


def right_matrix(right: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix (..., d, d) of x -> x (+) right, for `right` (..., d) with d = 2 or 4."""
    right = np.asarray(right, float)
    d = right.shape[-1]
    other = XOR[:d, :d]
    return right[..., other] * SIGNS[np.arange(d), other]


def compose(left: ArrayLike, right: ArrayLike) -> NDArray[np.float64]:
    """Multiply unit complex numbers (24), or quaternions (34).

    Args:
        left: (..., d), d = 2 or 4.
        right: (..., d), the rotation that is applied first.

    Returns:
        The products (..., d).
    """
    return np.einsum("...ij,...j->...i", left_matrix(left), np.asarray(right, float))


def conjugate(x: ArrayLike) -> NDArray[np.float64]:
    """Return the inverse of a unit complex number or quaternion (..., d)."""
    x = np.asarray(x, float)
    return x * np.where(np.arange(x.shape[-1]) == 0, 1.0, -1.0)


def rotate(orientation: ArrayLike, vector: ArrayLike) -> NDArray[np.float64]:
    """Rotate vectors by orientations (33).

    Args:
        orientation: (..., 4), unit quaternions.
        vector: (..., 3), in the axes of the body.

    Returns:
        (..., 3), in the axes to which the orientations refer.
    """
    vector = np.asarray(vector, float)
    pure = np.concatenate([np.zeros_like(vector[..., :1]), vector], axis=-1)
    return compose(compose(orientation, pure), conjugate(orientation))[..., 1:]


def heading(orientation: ArrayLike) -> NDArray[np.float64]:
    """Compute the heading in rad, anticlockwise from x, of bodies with orientations (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(orientation, float), -1, 0)
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def axis_angle_between(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Compute the angle between axes (67)-(68).

    For quaternions it is half the angle of the rotation from one orientation to the other.

    Args:
        a: (..., d), unit vectors, d = 2 or 4.
        b: (..., d), like `a`.

    Returns:
        (...), in rad, 0 to pi/2.
    """
    relative = compose(conjugate(a), b)
    return np.arctan2(np.linalg.norm(relative[..., 1:], axis=-1), np.abs(relative[..., 0]))


def require_unit(x: ArrayLike, what: str, tolerance: float = 1e-6) -> NDArray[np.float64]:
    """Scale every vector of `x` (..., d) to exactly unit length.

    Raises BadInput if d is not 2 or 4, or a length differs from 1 by more than `tolerance`.

    Args:
        x: (..., d), with d = 2 or 4.
        what: name in messages.
        tolerance: how far a length may differ from 1.

    Returns:
        The scaled vectors (..., d).
    """
    x = np.asarray(x, float)
    if x.ndim == 0 or x.shape[-1] not in (2, 4):
        raise BadInput(f"{what}: shape {x.shape}; give vectors of 2 or 4 components on the last axis")
    length = np.linalg.norm(x, axis=-1)
    wrong = ~(np.abs(length - 1.0) <= tolerance)
    if wrong.any():
        index = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise BadInput(
            f"{what}: the vector at {index} has length {length[index]:.9g}; scale it to unit length"
        )
    return x / length[..., None]
