"""A robot in the plane and its sensors: pose = (x, y, heading), velocity = (forward, turn).

Functions are component-first: every component may be a scalar or an array, so that simulators (arrays
over time) and estimators (scalars in a compiled loop) share the same source.
"""

from typing import Any

import numpy as np

# A number, or an array of numbers: the annotation of a component.
Component = Any
Components = Any


def wrap_angle(angle: Component) -> Component:
    """Wrap an angle to [-pi, pi).

    >>> round(float(wrap_angle(3 * np.pi / 2) / np.pi), 12)
    -0.5
    """
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def drive(
    pose: Components, velocity: Components, duration_s: Component
) -> tuple[Component, Component, Component]:
    """Compute the pose after `duration_s` at a constant velocity (m/s) and turn rate (rad/s): an arc.

    >>> quarter_circle = drive((0.0, 0.0, 0.0), (np.pi / 2, np.pi / 2), 1.0)
    >>> [round(float(each), 6) for each in quarter_circle]
    [1.0, 1.0, 1.570796]
    """
    half_turn = 0.5 * velocity[1] * duration_s
    chord = velocity[0] * duration_s * np.sinc(half_turn / np.pi)
    direction = pose[2] + half_turn
    return (
        pose[0] + chord * np.cos(direction),
        pose[1] + chord * np.sin(direction),
        pose[2] + velocity[1] * duration_s,
    )


def range_bearing(pose: Components, target: Components) -> tuple[Component, Component]:
    """Compute distance (m) and bearing (rad, not wrapped) from a pose to a point."""
    dx = target[0] - pose[0]
    dy = target[1] - pose[1]
    return np.sqrt(dx * dx + dy * dy), np.arctan2(dy, dx) - pose[2]


def into_frame(pose: Components, point: Components) -> tuple[Component, Component]:
    """Compute a point's position (x, y) in the frame of a sensor with pose (x, y, heading)."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = point[0] - pose[0], point[1] - pose[1]
    return cosine * dx + sine * dy, cosine * dy - sine * dx


def out_of_frame(pose: Components, point: Components) -> tuple[Component, Component]:
    """Convert a point from the frame of a sensor with this pose to coordinates (x, y) in the plane."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return (
        pose[0] + cosine * point[0] - sine * point[1],
        pose[1] + sine * point[0] + cosine * point[1],
    )
