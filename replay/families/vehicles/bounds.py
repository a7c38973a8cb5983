"""Total error of vehicles: exact for the Kalman filter, bounded for methods with more information.

All axes of all vehicles are equal and uncoupled, so one axis is sufficient. The filter assumes random
accelerations; the truth either has random accelerations (stochastic) or no accelerations
(deterministic).
"""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.families.vehicles.models import noise_moments
from fuselog.replay.engine.arrays import Floats

SETTLED = 2000


class Axis(NamedTuple):
    """Squared position errors of one axis, for a truth with random accelerations and for one without.

    `gain` (2,) has the last gains of position and velocity.
    """

    stochastic: Floats
    deterministic: Floats
    gain: Floats


def follow_axis(
    variance_m2: float,
    *,
    steps: int = SETTLED,
    acceleration_sigma_mps2: float = 0.5,
    step_s: float = 1.0,
    prior_variance: tuple[float, float] = (2.5, 1.0),
) -> Axis:
    """Filter one axis with fixes of a given variance for a number of steps."""
    position, cross, velocity = noise_moments(acceleration_sigma_mps2, step_s)
    noise = np.array([[position, cross], [cross, velocity]])
    transition = np.array([[1.0, step_s], [0.0, 1.0]])
    covariance, error = np.diag(prior_variance), np.zeros((2, 2))
    squared = np.empty((2, steps))
    gain = np.zeros(2)
    for step in range(steps):
        covariance = transition @ covariance @ transition.T + noise
        gain = covariance[:, 0] / (covariance[0, 0] + variance_m2)
        keep = np.eye(2) - np.outer(gain, [1.0, 0.0])
        covariance = keep @ covariance
        error = keep @ transition @ error @ transition.T @ keep.T + variance_m2 * np.outer(gain, gain)
        squared[:, step] = covariance[0, 0], error[0, 0]
    return Axis(squared[0], squared[1], gain)


class Bounds(NamedTuple):
    """Total errors of steady-state filters, in m, for each use of the infrastructure sensor.

    For the combinations of positions that the sensor measures, the error is that of a filter with fixes
    and sensor; for the other combinations, it is that of a filter with fixes only.
    """

    topology: float
    free_pose: float
    known_pose: float


def bounds(
    vehicles: int, fix_variance_m2: float, sensor_variance_m2: float, *, stochastic: bool
) -> Bounds:
    """Compute total errors; the sensor measures 1, all but 3, or all combinations (see `Bounds`)."""
    both = 1.0 / (1.0 / fix_variance_m2 + 1.0 / sensor_variance_m2)
    alone, together = (follow_axis(each) for each in (fix_variance_m2, both))
    kind = "stochastic" if stochastic else "deterministic"
    a, b = float(getattr(alone, kind)[-1]), float(getattr(together, kind)[-1])
    n = 2 * vehicles
    return Bounds(*(float(np.sqrt((n - k) * a + k * b)) for k in (1, n - 3, n)))


def exact_total_error(vehicles: int, fix_variance_m2: float, steps: int, *, stochastic: bool) -> float:
    """Compute the Kalman filter's root mean square total error over `steps` steps, in m."""
    axis = follow_axis(fix_variance_m2, steps=steps)
    squared = axis.stochastic if stochastic else axis.deterministic
    return float(np.sqrt(2 * vehicles * squared.mean()))
