"""Models of the line of sight of an optical sensor whose attitude may be biased.

Belfadel, Osborne and Bar-Shalom, "Bias Estimation and Observability for Optical Sensor Measurements with
Targets of Opportunity", JAIF 2014. Component-first: `Components` are a tuple of components or an array
whose first axis is the component; components are numbers or arrays and broadcast.
"""

import numpy as np

from fuselog.recorders.models.planar import Component, Components

Triple = tuple[Component, Component, Component]
ANGLES = ("yaw", "pitch", "roll")
SENSORS, TARGETS = 3, 2  # moving ones; the number of static ones is not limited


def azimuth_elevation(x: Components) -> tuple[Component, Component]:
    """Compute the angles in rad to the point `x` (3, ...) in the sensor's frame, y up; eq (3), atan2."""
    return np.arctan2(x[0], x[2]), np.arctan2(x[1], np.hypot(x[0], x[2]))


def azimuth_elevation_gradients(x: Components) -> tuple[Triple, Triple]:
    """Differentiate azimuth and elevation with respect to `x` (rad/m); eqs (71)-(76), (74) corrected."""
    ground = np.hypot(x[0], x[2])
    squared = ground**2 + x[1] ** 2
    azimuth = (x[2] / ground**2, 0.0 * x[1], -x[0] / ground**2)
    slope = -x[1] / (ground * squared)
    return azimuth, (x[0] * slope, ground / squared, x[2] * slope)


def rotate(attitude: Components, x: Components) -> Triple:
    """Rotate `x` into the frame of a sensor with attitude (yaw, pitch, roll) in rad.

    That is Rz(yaw) Ry(pitch) Rx(roll) x with active rotations, as in the paper's appendix and tables;
    its eq (1) has every angle negated.
    """
    yaw, pitch, roll = attitude
    return _about_z(yaw, _about_y(pitch, _about_x(roll, x)))


def line_of_sight(
    target: Components, sensor: Components, attitude: Components
) -> tuple[Component, Component]:
    """Compute a target's azimuth and elevation in rad, eqs (2)-(4); `attitude` includes the bias."""
    return azimuth_elevation(rotate(attitude, _subtract(target, sensor)))


def line_of_sight_gradients(
    target: Components, sensor: Components, attitude: Components
) -> tuple[tuple[Component, ...], tuple[Component, ...]]:
    """Differentiate azimuth and elevation with respect to target (rad/m) and attitude (rad/rad).

    The chain rule is applied backwards through the three rotations. The result equals eqs (45)-(103) of
    the appendix with the misprints in (67), (74), (89), (92) and (102) corrected.
    """
    yaw, pitch, roll = attitude
    offset = _subtract(target, sensor)
    pitched = _about_y(pitch, _about_x(roll, offset))
    seen = _about_z(yaw, pitched)

    def pull_back(gradient: Triple) -> tuple[Component, ...]:
        by_pitched = _about_z(-yaw, gradient)
        by_target = _about_x(-roll, _about_y(-pitch, by_pitched))
        return (
            *by_target,
            gradient[1] * seen[0] - gradient[0] * seen[1],
            by_pitched[0] * pitched[2] - by_pitched[2] * pitched[0],
            by_target[2] * offset[1] - by_target[1] * offset[2],
        )

    azimuth, elevation = azimuth_elevation_gradients(seen)
    return pull_back(azimuth), pull_back(elevation)


def direction(azimuth: Component, elevation: Component, attitude: Components) -> Triple:
    """Compute the unit vector, in the common frame, for which a sensor measures these angles."""
    yaw, pitch, roll = attitude
    level = np.cos(elevation)
    seen = (level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth))
    return _about_x(-roll, _about_y(-pitch, _about_z(-yaw, seen)))


def turning_vector(attitude: Components, change: Components) -> Triple:
    """Compute the small rotation of the scene, in the common frame, that cancels a change of attitude.

    If this rotation is applied to the scene about the sensor while the attitude changes by `change`
    (yaw, pitch, roll), the sensor's measurements stay the same.
    """
    _, pitch, roll = attitude
    yawed, pitched, rolled = change
    zero = 0.0 * rolled
    by_yaw = _about_x(-roll, _about_y(-pitch, (zero, zero, yawed)))
    by_pitch = _about_x(-roll, (zero, pitched, zero))
    return -by_yaw[0] - by_pitch[0] - rolled, -by_yaw[1] - by_pitch[1], -by_yaw[2] - by_pitch[2]


def _subtract(x: Components, y: Components) -> Triple:
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


def _about_x(angle: Component, x: Components) -> Triple:
    cosine, sine = np.cos(angle), np.sin(angle)
    return x[0], cosine * x[1] - sine * x[2], sine * x[1] + cosine * x[2]


def _about_y(angle: Component, x: Components) -> Triple:
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * x[0] + sine * x[2], x[1], cosine * x[2] - sine * x[0]


def _about_z(angle: Component, x: Components) -> Triple:
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * x[0] - sine * x[1], sine * x[0] + cosine * x[1], x[2]


def target_components(target: int) -> list[str]:
    """Return the names of a target's coordinates in a state."""
    return [f"target_{target}_{axis}_m" for axis in "xyz"]


def bias_components(sensor: int) -> list[str]:
    """Return the names of a sensor's attitude biases in a state."""
    return [f"sensor_{sensor}_{angle}_bias_rad" for angle in ANGLES]


def moving_target_components(target: int) -> list[str]:
    """Return the names of a moving target's coordinates and velocities in a state."""
    return target_components(target) + [f"target_{target}_v{axis}_mps" for axis in "xyz"]


def clock_component(sensor: int) -> str:
    """Return the name of a sensor's clock offset (positive if ahead) in a state."""
    return f"sensor_{sensor}_clock_s"
