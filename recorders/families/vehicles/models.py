"""Motion of vehicles in the plane; state = (x, vx, y, vy).

Source: Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016, (12)-(14). Component-first: scalars or arrays.
"""

import numpy as np

from fuselog.recorders.models.planar import Component, Components


def turn(
    state: Components, turn_rate_radps: Component, duration_s: Component
) -> tuple[Component, Component, Component, Component]:
    """Compute the state after a coordinated turn (14), or at constant velocity (12) if the rate is 0."""
    angle = turn_rate_radps * duration_s
    along = duration_s * np.sinc(angle / np.pi)
    across = duration_s * 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2
    cosine, sine = np.cos(angle), np.sin(angle)
    x, vx, y, vy = state
    return (
        x + along * vx - across * vy,
        cosine * vx - sine * vy,
        y + across * vx + along * vy,
        sine * vx + cosine * vy,
    )


def noise_moments(
    acceleration_sigma_mps2: Component, duration_s: Component
) -> tuple[Component, Component, Component]:
    """Compute the position's variance, its covariance with the velocity, and the velocity's variance.

    The acceleration is random and constant over the duration. This is (13) with T^4/4, T^3/2 and T^2;
    the paper prints T^2/4, T^2/2 and T, which is the same for the paper's T = 1.
    """
    velocity = (acceleration_sigma_mps2 * duration_s) ** 2
    return 0.25 * velocity * duration_s**2, 0.5 * velocity * duration_s, velocity
