"""Correction of a body's state together with its heading, which may be very uncertain.

Measurements of an inertial unit act in the plane after a rotation by the heading; fixes act in the plane
itself. For a given heading, both act linearly. As a function of the heading, the mean of any other part
of the state is therefore a sum of two terms, one of which rotates with the heading: the mean moves on a
circle. For position and velocity, in the plane, the term of the inertial samples rotates. For tilt and
biases, in the body's axes, the term of the fixes rotates, in the opposite direction. The covariance
contains the tangent of the circle, which determines its radius. A filter that moves along the tangent
mistakes the distance from the circle for information about the heading: it would find the heading of a
body at rest, which is impossible.

An innovation is a vector in the plane, so its contribution to tilt and biases rotates in the body's
axes. In the backward pass of a smoother, steps are vectors in the body's axes, because the biases do not
depend on the heading.

If all terms rotate, this is the invariant filter: Barrau and Bonnabel, The Invariant Extended Kalman
Filter as a Stable Observer, IEEE Transactions on Automatic Control 62(4), 2017.
"""

import numpy as np

from fuselog.recorders.models.inertial import Vector, cross, into_body, product
from fuselog.recorders.models.planar import Component, Components
from fuselog.replay.inference.model.model import Correction

UP = 0.0, 0.0, 1.0


def heading(state: Components) -> Components:
    """Return the error state (15,) of a heading error of 1 rad: a rotation about the vertical axis."""
    x, y, z = into_body(state[6:10], UP)
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


def move(state: Components, step: Components, slope: Components) -> Components:
    """Return the state after an update; see `fuselog.replay.inference.model.model.Correction`."""
    return _moved(state, step, slope, 0.0)


def move_back(state: Components, step: Components, slope: Components) -> Components:
    """Return the state after a step of a smoother's backward pass."""
    return _moved(state, step, slope, 1.0)


def step_to(state: Components, target: Components, slope: Components) -> Components:
    """Return the step (15,) of a backward pass that moves the state to the target."""
    orientation = state[6:10]
    up = into_body(orientation, UP)
    down = _times(-1.0, up)
    w, x, y, z = product((orientation[0], *_times(-1.0, orientation[1:])), target[6:10])
    reference = _dot(up, (x, y, z))
    turn = 2.0 * np.arctan2(reference, w) if w >= 0.0 else 2.0 * np.arctan2(-reference, -w)
    half = 0.5 * turn
    w, x, y, z = product((np.cos(half), *_times(-np.sin(half), up)), (w, x, y, z))
    tilt = 2.0 * x / w, 2.0 * y / w, 2.0 * z / w
    px, py, pz = _back(_less(target[0:3], state[0:3]), slope[0:3], UP, turn, turn)
    vx, vy, vz = _back(_less(target[3:6], state[3:6]), slope[3:6], UP, turn, turn)
    x, y, z = _plus(_times(turn, up), _back(tilt, _across(up, slope[6:9]), down, turn, 0.0))
    gx, gy, gz = _back(_less(target[10:13], state[10:13]), slope[9:12], down, turn, 0.0)
    bx, by, bz = _back(_less(target[13:16], state[13:16]), slope[12:15], down, turn, 0.0)
    return px, py, pz, vx, vy, vz, x, y, z, gx, gy, gz, bx, by, bz


WITH_HEADING = Correction(heading, move, step_to, move_back)


def _moved(state: Components, step: Components, slope: Components, of_body: float) -> Components:
    """Return the state after a step whose residual is in axes of the body (1) or of the plane (0)."""
    orientation = state[6:10]
    up = into_body(orientation, UP)
    down = _times(-1.0, up)
    turn = _dot(up, step[6:9])
    half, forward, backward = 0.5 * turn, of_body * turn, (1.0 - of_body) * turn
    px, py, pz = _plus(state[0:3], _forth(step[0:3], slope[0:3], UP, turn, forward))
    vx, vy, vz = _plus(state[3:6], _forth(step[3:6], slope[3:6], UP, turn, forward))
    x, y, z = _forth(_across(up, step[6:9]), _across(up, slope[6:9]), down, turn, backward)
    gx, gy, gz = _plus(state[10:13], _forth(step[9:12], slope[9:12], down, turn, backward))
    bx, by, bz = _plus(state[13:16], _forth(step[12:15], slope[12:15], down, turn, backward))
    turned = product(orientation, (np.cos(half), *_times(np.sin(half), up)))
    qw, qx, qy, qz = product(turned, (1.0, 0.5 * x, 0.5 * y, 0.5 * z))
    scale = 1.0 / np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = scale * qw, scale * qx, scale * qy, scale * qz
    return px, py, pz, vx, vy, vz, qw, qx, qy, qz, gx, gy, gz, bx, by, bz


def _forth(
    step: Components, slope: Components, axis: Components, turn: Component, swing: Component
) -> Vector:
    """Return the change of a vector: a move along its circle, plus the rotated remainder of its step."""
    rest = _less(step, _times(turn, slope))
    return _plus(_arc(slope, axis, turn), _rotated(rest, axis, swing))


def _back(
    change: Components, slope: Components, axis: Components, turn: Component, swing: Component
) -> Vector:
    """Return the step that causes a given change of a vector; the inverse of `_forth`."""
    rest = _rotated(_less(change, _arc(slope, axis, turn)), axis, -swing)
    return _plus(_times(turn, slope), rest)


def _arc(slope: Components, axis: Components, turn: Component) -> Vector:
    """Return the chord of a turn about an axis, on the circle that starts with the given tangent."""
    once = cross(axis, slope)
    bent = _plus(_times(1.0 - np.cos(turn), once), _times(turn - np.sin(turn), cross(axis, once)))
    return _plus(_times(turn, slope), bent)


def _rotated(vector: Components, axis: Components, angle: Component) -> Vector:
    """Rotate a vector about the unit vector of an axis by Rodrigues' formula."""
    once = cross(axis, vector)
    turned = _plus(_times(np.sin(angle), once), _times(1.0 - np.cos(angle), cross(axis, once)))
    return _plus(vector, turned)


def _across(axis: Components, vector: Components) -> Vector:
    """Return the component of a vector that is perpendicular to the unit vector of an axis."""
    return _less(vector, _times(_dot(axis, vector), axis))


def _dot(a: Components, b: Components) -> Component:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _plus(a: Components, b: Components) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _less(a: Components, b: Components) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _times(factor: Component, vector: Components) -> Vector:
    return factor * vector[0], factor * vector[1], factor * vector[2]
