"""Rotations of vectors and quaternions, and initial matrices of orientation filters."""

import math

from numpy.typing import NDArray

from fuselog.replay.families.directional.distributions.bingham_kernels import Vector


def all_finite(rate: NDArray, force: NDArray, field: NDArray) -> bool:
    """Test whether all components of three vectors are finite.

    Args:
        rate, force, field: (3,).
    """
    total = 0.0
    for i in range(3):
        total += rate[i] + force[i] + field[i]
    return math.isfinite(total)


def fill_isotropic(sigma_rad: float, z: NDArray) -> None:
    """Write isotropic concentrations about the identity, in the order of a quaternion's components.

    Args:
        sigma_rad: standard deviation of a rotation about each axis.
        z: concentrations (4,), overwritten; the first belongs to the mode and is 0.
    """
    z[:] = -2.0 / sigma_rad**2
    z[0] = 0.0


def turn_quaternion(x_rad: float, y_rad: float, z_rad: float) -> tuple[float, float, float, float]:
    """Return the quaternion of a rotation vector."""
    x, y, z = 0.5 * x_rad, 0.5 * y_rad, 0.5 * z_rad
    angle = math.sqrt(x * x + y * y + z * z)
    scale = math.sin(angle) / angle if angle > 0.0 else 1.0
    return math.cos(angle), scale * x, scale * y, scale * z


def turn_back(turned: Vector, vector: NDArray) -> None:
    """Transform a fixed vector, in place, into the frame of a body that has rotated by a quaternion.

    Args:
        turned: unit quaternion (4,), w first.
        vector: (3,), overwritten.
    """
    w, x, y, z = turned[0], -turned[1], -turned[2], -turned[3]
    a, b, c = vector[0], vector[1], vector[2]
    d, e, f = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    vector[0] = a + w * d + y * f - z * e
    vector[1] = b + w * e + z * d - x * f
    vector[2] = c + w * f + x * e - y * d


def fill_diagonal(values: NDArray, out: NDArray) -> None:
    """Write a diagonal matrix.

    Args:
        values: (n,).
        out: (n, n), overwritten.
    """
    out[:] = 0.0
    for i in range(len(values)):
        out[i, i] = values[i]
