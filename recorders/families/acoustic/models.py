"""Models of the measurements of a supersonic shot by an acoustic sensor, in the plane.

Osborne, Bar-Shalom, George and Kaplan, "Statistical Efficiency of Target Localization from Angle and
Shockwave Measurements", JAIF 2014. Angles are anticlockwise from the x axis, in rad. Component-first:
`Components` are a tuple of components or an array whose first axis is the component; components are
numbers or arrays and broadcast.
"""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.planar import Component, Components, wrap_angle

# Components of a state: the shooter's position and the bullet's direction.
SHOT_COMPONENTS = ("x_m", "y_m", "trajectory_rad")


class Medium(NamedTuple):
    """Speed of sound in the air, and the bullet's constant speed as a Mach number."""

    speed_of_sound_mps: float = 342.0
    mach_number: float = 2.0

    @property
    def mach_angle_rad(self) -> float:
        """Return half the opening angle of the shockwave's cone; eq (5)."""
        return float(np.arcsin(1.0 / self.mach_number))


class Noise(NamedTuple):
    """Standard deviations of a sensor's measurements; `position_m` is for its GPS position, per axis."""

    muzzle_blast_rad: float
    shockwave_rad: float
    time_difference_s: float
    position_m: float


def azimuth_range(shooter: Components, sensor: Components) -> tuple[Component, Component]:
    """Compute the muzzle blast's direction of arrival, eq (6) with atan2, and the distance in m."""
    x, y = shooter[0] - sensor[0], shooter[1] - sensor[1]
    return np.arctan2(y, x), np.hypot(x, y)


def fired_from(
    place: Components, velocity: Components, sensor: Components, speed_of_sound_mps: Component
) -> tuple[Component, Component]:
    """Find the position of a source when it emitted the sound that a sensor hears now.

    `place` is the current position of the source. The travel time of the sound follows from the current
    distance, and is corrected once. The remaining error is of second order in the ratio of the velocity
    to the speed of sound: 2 cm at 1 km and 1.5 m/s.
    """
    x, y = place
    for _ in range(2):
        travelled_s = np.hypot(x - sensor[0], y - sensor[1]) / speed_of_sound_mps
        x, y = place[0] - velocity[0] * travelled_s, place[1] - velocity[1] * travelled_s
    return x, y


def shockwave_side(azimuth: Component, trajectory: Component, medium: Medium) -> Component:
    """Find the side of the line of fire on which a sensor hears the shockwave: +1, -1, or 0 if unheard.

    A sensor hears the shockwave at angles to the line of fire between 0 and 90 deg minus the Mach angle,
    both excluded (figure 2). Eq (7) agrees, except for angles that need wrapping.
    """
    off_line = wrap_angle(azimuth - np.pi - trajectory)
    return np.where(np.abs(off_line) < 0.5 * np.pi - medium.mach_angle_rad, np.sign(off_line), 0.0)


def shockwave_azimuth(trajectory: Component, side: Component, medium: Medium) -> Component:
    """Compute the shockwave's direction of arrival; eq (7)."""
    return trajectory - side * (0.5 * np.pi + medium.mach_angle_rad)


def measured_side(azimuth: Component, shockwave: Component) -> Component:
    """Infer the side of the line of fire using only the two directions of arrival."""
    return -np.sign(wrap_angle(azimuth - shockwave))


def trajectory_from_shockwave(shockwave: Component, side: Component, medium: Medium) -> Component:
    """Compute the bullet's direction by inverting eq (7)."""
    return wrap_angle(shockwave + side * (0.5 * np.pi + medium.mach_angle_rad))


def clear_side(azimuth: Component, shockwave: Component, noise: Noise) -> Component:
    """Return the side that a sensor infers; 0 if it is ambiguous or no shockwave was heard.

    The side is ambiguous if the two directions of arrival are within three standard deviations of each
    other.
    """
    unsure = 3.0 * np.hypot(noise.muzzle_blast_rad, noise.shockwave_rad)
    is_sure = np.abs(wrap_angle(azimuth - shockwave)) >= unsure
    return np.where(is_sure, measured_side(azimuth, shockwave), 0.0)


def time_difference(distance: Component, separation: Component, medium: Medium) -> Component:
    """Compute the time in s from shockwave to muzzle blast.

    `separation` is the direction of the muzzle blast minus the direction of the shockwave.
    """
    return distance * (1.0 - np.cos(separation)) / medium.speed_of_sound_mps


def time_difference_gradient(
    distance: Component, separation: Component, medium: Medium
) -> tuple[Component, Component]:
    """Compute the derivatives of `time_difference` with respect to distance and separation."""
    speed = medium.speed_of_sound_mps
    return (1.0 - np.cos(separation)) / speed, distance * np.sin(separation) / speed


def range_from_time_difference(delay: Component, separation: Component, medium: Medium) -> Component:
    """Compute the distance to the shooter in m; eq (9)."""
    return medium.speed_of_sound_mps * delay / (1.0 - np.cos(separation))


def hear(
    shooter: Components, trajectory: Component, sensor: Components, medium: Medium
) -> tuple[Component, Component, Component]:
    """Compute both directions of arrival and the time difference; NaN if the shockwave is not heard."""
    azimuth, distance = azimuth_range(shooter, sensor)
    side = shockwave_side(azimuth, trajectory, medium)
    shockwave = np.where(side == 0.0, np.nan, shockwave_azimuth(trajectory, side, medium))
    return azimuth, wrap_angle(shockwave), time_difference(distance, azimuth - shockwave, medium)


def local_estimate_covariances(
    distance: Component, separation: Component, noise: Noise, medium: Medium
) -> tuple[Component, Component, Component]:
    """Compute the variance of the range estimate, and its covariances with azimuth and trajectory.

    The variance (m^2) is eq (26), with c^2 sigma_tau^2 in the numerator; the covariances (m rad) are eqs
    (17) and (18).
    """
    missing = 1.0 - np.cos(separation)
    lever = distance * np.sin(separation) / missing
    delay = medium.speed_of_sound_mps * noise.time_difference_s / missing
    angles = noise.muzzle_blast_rad**2 + noise.shockwave_rad**2
    return (
        delay**2 + lever**2 * angles,
        -lever * noise.muzzle_blast_rad**2,
        lever * noise.shockwave_rad**2,
    )


def local_estimate_covariance_gradients(
    distance: Component, separation: Component, noise: Noise, medium: Medium
) -> tuple[tuple[Component, Component], ...]:
    """Compute the derivatives of `local_estimate_covariances` with respect to distance and separation.

    With the chain rule these are eqs (63)-(77).
    """
    missing = 1.0 - np.cos(separation)
    sine = np.sin(separation)
    slope = sine / missing
    delay = medium.speed_of_sound_mps * noise.time_difference_s / missing
    angles = noise.muzzle_blast_rad**2 + noise.shockwave_rad**2
    # d(sine / missing) / d separation = -1 / missing
    return (
        (2.0 * distance * slope**2 * angles, -2.0 * slope * (delay**2 + distance**2 * angles / missing)),
        (-slope * noise.muzzle_blast_rad**2, distance / missing * noise.muzzle_blast_rad**2),
        (slope * noise.shockwave_rad**2, -distance / missing * noise.shockwave_rad**2),
    )


def sensor_components(sensor: int) -> list[str]:
    """Return the names of a sensor's coordinates in a state."""
    return [f"sensor_{sensor}_{axis}_m" for axis in "xy"]


def stated_metadata(noise: Noise, medium: Medium) -> dict[str, str]:
    """Return noise (`sigma_muzzle_blast_rad`, ...) and medium as metadata of a detection channel."""
    stated = {f"sigma_{name}": value for name, value in noise._asdict().items()} | medium._asdict()
    return {name: repr(value) for name, value in stated.items()}
