"""A point with constant velocity except for white noise; state = (positions, velocities).

Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 6.2.2.
"""

from fuselog.recorders.models.planar import Component


def noise_moments(
    acceleration_density: Component, duration_s: Component
) -> tuple[Component, Component, Component]:
    """Compute, for each axis, the variances of position and velocity, and their covariance.

    Returns the position's variance, its covariance with velocity, and the velocity's variance.
    `acceleration_density` is the power spectral density of the acceleration, m^2/s^3.
    """
    velocity = acceleration_density * duration_s
    return velocity * duration_s**2 / 3.0, velocity * duration_s / 2.0, velocity
