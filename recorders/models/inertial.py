"""Inertial navigation in east, north, up: the motion according to an inertial unit.

The body's axes are forward, left, up; a unit quaternion w, x, y, z rotates vectors from the body's axes
to the plane's. Component-first, as in `planar`. Groves, Principles of GNSS, Inertial, and Multisensor
Integrated Navigation Systems, 2nd edition, 2013, chapters 2 and 5.
"""

import numpy as np

from fuselog.recorders.models.geodesy import (
    ECCENTRICITY_SQUARED,
    FLATTENING,
    SEMI_MAJOR_M,
    SEMI_MINOR_M,
)
from fuselog.recorders.models.planar import Component, Components

EARTH_RATE_RADPS = 7.292115e-5
EARTH_CONSTANT_M3PS2 = 3.986004418e14
EQUATOR_GRAVITY_MPS2 = 9.7803253359
SOMIGLIANA = 0.00193185265241
_CENTRIFUGAL = EARTH_RATE_RADPS**2 * SEMI_MAJOR_M**2 * SEMI_MINOR_M / EARTH_CONSTANT_M3PS2

Vector = tuple[Component, Component, Component]


def gravity(latitude_deg: Component, height_m: Component) -> Component:
    """Compute normal gravity in m/s2 at a height above the WGS 84 ellipsoid, by Somigliana's formula.

    NIMA TR8350.2, 3rd edition, (4-1) and (4-3).
    """
    squared = np.sin(np.radians(latitude_deg)) ** 2
    on_ellipsoid = (
        EQUATOR_GRAVITY_MPS2
        * (1.0 + SOMIGLIANA * squared)
        / np.sqrt(1.0 - ECCENTRICITY_SQUARED * squared)
    )
    ratio = height_m / SEMI_MAJOR_M
    first = 1.0 + FLATTENING + _CENTRIFUGAL - 2.0 * FLATTENING * squared
    return on_ellipsoid * (1.0 - 2.0 * first * ratio + 3.0 * ratio * ratio)


def earth_rate(latitude_deg: Component) -> Vector:
    """Compute the rotation of the local tangent plane with the earth, in rad/s about east, north, up."""
    latitude = np.radians(latitude_deg)
    return 0.0, EARTH_RATE_RADPS * np.cos(latitude), EARTH_RATE_RADPS * np.sin(latitude)


def cross(a: Components, b: Components) -> Vector:
    """Compute the cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def product(p: Components, q: Components) -> tuple[Component, Component, Component, Component]:
    """Multiply two quaternions (Hamilton product)."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def rotation(x: Component, y: Component, z: Component) -> Components:
    """Convert a rotation vector to a unit quaternion."""
    half = 0.5 * np.sqrt(x * x + y * y + z * z)
    scale = 0.5 * np.sinc(half / np.pi)
    return np.cos(half), scale * x, scale * y, scale * z


def into_plane(q: Components, v: Components) -> Vector:
    """Rotate a vector from the body's to the plane's axes: v + 2 w (u x v) + 2 u x (u x v)."""
    w, x, y, z = q
    a, b, c = cross((x, y, z), v)
    d, e, f = cross((x, y, z), (a, b, c))
    return v[0] + 2.0 * (w * a + d), v[1] + 2.0 * (w * b + e), v[2] + 2.0 * (w * c + f)


def into_body(q: Components, v: Components) -> Vector:
    """Rotate a vector from the plane's to the body's axes."""
    w, x, y, z = q
    return into_plane((w, -x, -y, -z), v)


def from_mounting(roll: Component, pitch: Component, yaw: Component, v: Components) -> Vector:
    """Rotate a vector from a unit's axes to the body's, given the mounting angles in rad.

    The rotation is by `roll` about the forward axis, then by `pitch` about the left axis, then by `yaw`
    about the up axis.
    """
    sine, cosine = np.sin(roll), np.cos(roll)
    x, y, z = v[0], cosine * v[1] - sine * v[2], sine * v[1] + cosine * v[2]
    sine, cosine = np.sin(pitch), np.cos(pitch)
    x, z = cosine * x + sine * z, cosine * z - sine * x
    sine, cosine = np.sin(yaw), np.cos(yaw)
    return cosine * x - sine * y, sine * x + cosine * y, z


def strapdown(
    state: Components, force: Components, rate: Components, duration_s: Component, place: Components
) -> Components:
    """Compute position, velocity and quaternion after a step with constant force and turn rate.

    Args:
        state: position (m), velocity (m/s) and quaternion before the step.
        force: specific force in the body's axes, m/s2.
        rate: inertial turn rate in the body's axes, rad/s.
        duration_s: duration of the step.
        place: latitude (deg) and height (m) of the plane's origin.
    """
    px, py, pz, vx, vy, vz, qw, qx, qy, qz = state
    earth = earth_rate(place[0])
    ex, ey, ez = into_body((qw, qx, qy, qz), earth)
    half_s = 0.5 * duration_s
    half = rotation((rate[0] - ex) * half_s, (rate[1] - ey) * half_s, (rate[2] - ez) * half_s)
    middle = product((qw, qx, qy, qz), half)
    fx, fy, fz = into_plane(middle, force)
    cx, cy, cz = cross(earth, (vx, vy, vz))
    ax, ay, az = fx - 2.0 * cx, fy - 2.0 * cy, fz - 2.0 * cz - gravity(place[0], place[1])
    qw, qx, qy, qz = product(middle, half)
    return (
        px + duration_s * (vx + half_s * ax),
        py + duration_s * (vy + half_s * ay),
        pz + duration_s * (vz + half_s * az),
        vx + duration_s * ax,
        vy + duration_s * ay,
        vz + duration_s * az,
        qw,
        qx,
        qy,
        qz,
    )


def triad(force: Components, field: Components) -> tuple[float, float, float, float]:
    """Compute the orientation in which force is up and field is north; NaN if the two are parallel."""
    up = unit(force)
    east = unit(cross(field, up))
    north = cross(up, east)
    # 4 q q^T of the rotation matrix with these rows; its largest column has no cancellation
    a, b, c = up[1] - north[2], east[2] - up[0], north[0] - east[1]
    d, e, f = east[1] + north[0], east[2] + up[0], north[2] + up[1]
    w, x = 1.0 + east[0] + north[1] + up[2], 1.0 + east[0] - north[1] - up[2]
    y, z = 1.0 - east[0] + north[1] - up[2], 1.0 - east[0] - north[1] + up[2]
    column, most = (w, a, b, c), w
    for other, size in (((a, x, d, e), x), ((b, d, y, f), y), ((c, e, f, z), z)):
        if size > most:
            column, most = other, size
    w, x, y, z = column
    length = np.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


def unit(vector: Components) -> Components:
    """Return the direction of a vector of three components; NaN for a zero vector."""
    x, y, z = vector[0], vector[1], vector[2]
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def distance(tag: Components, anchor: Components) -> Component:
    """Compute the distance between two points in space."""
    dx, dy, dz = tag[0] - anchor[0], tag[1] - anchor[1], tag[2] - anchor[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)
