"""Extended Kalman filter in two short functions, with the same results as the compiled filters.

Begin here to read how a filter works. `fuselog.replay.inference.kalman.predict` and
`fuselog.replay.inference.kalman.update` give the same results without allocating arrays. They also
support angles and rotations in the state, and measurements with missing components. A test compares the
results.
"""

from collections.abc import Callable

import numpy as np

from fuselog.replay.engine.arrays import Floats


def predict(
    mean: Floats,
    covariance: Floats,
    f: Callable[[Floats], Floats],
    F: Callable[[Floats], Floats],
    Q: Floats,
) -> tuple[Floats, Floats]:
    """Predict a Gaussian by a motion: x becomes f(x), and P becomes F P F' + Q.

    Args:
        mean: the mean x (n,).
        covariance: the covariance P (n, n).
        f: the motion: function of a state (n,) that returns the next state (n,).
        F: the motion's Jacobian (n, n) at a state.
        Q: the covariance (n, n) of the motion's noise.

    Returns:
        The predicted mean and covariance.
    """
    transition = F(mean)
    return f(mean), transition @ covariance @ transition.T + Q


def update(
    mean: Floats,
    covariance: Floats,
    measurement: Floats,
    h: Callable[[Floats], Floats],
    H: Callable[[Floats], Floats],
    R: Floats,
) -> tuple[Floats, Floats]:
    """Update a Gaussian by a measurement: x becomes x + K v, and P becomes P - K S K'.

    v = y - h(x) is the innovation, S = H P H' + R its covariance, and K = P H' S^-1 the Kalman gain.

    Args:
        mean: the mean x (n,).
        covariance: the covariance P (n, n).
        measurement: the measurement y (m,).
        h: the measurement function: function of a state (n,) that returns the expected measurement (m,).
        H: its Jacobian (m, n) at a state.
        R: the covariance (m, m) of the measurement's noise.

    Returns:
        The posterior mean and covariance.
    """
    predicted_measurement, slope = h(mean), H(mean)
    innovation = measurement - predicted_measurement
    innovation_covariance = slope @ covariance @ slope.T + R
    gain = np.linalg.solve(innovation_covariance, slope @ covariance).T
    return mean + gain @ innovation, covariance - gain @ innovation_covariance @ gain.T
