"""A walker with position fixes: FilterPy's KalmanFilter as a program, `-e "exec:python walker.py"`.

The state is x, y and their velocities, driven by white acceleration.
"""

import numpy as np
from client import serve
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter

DESCRIPTION = {
    "summary": "constant velocity with position fixes, by FilterPy",
    "topics": [{"topic": "fix", "fields": ["position_m[2]", "covariance_m2[4]"]}],
    "prior": "prior",
    "truth": "truth",
    "state": dict.fromkeys(["x_m", "vx_mps", "y_m", "vy_mps"], "linear"),
    "innovation": {"x_m": "linear", "y_m": "linear"},
    "parameters": {
        "acceleration_sigma_mps2": {
            "default": 0.5,
            "minimum": 0,
            "unit": "m/s^2",
            "role": "process noise",
        }
    },
}


class Walker:
    """FilterPy's filter, with steps of the duration between messages."""

    def __init__(self, parameters, seed):
        self.variance = parameters[0] ** 2
        self.filter = KalmanFilter(dim_x=4, dim_z=2)
        self.filter.H = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])

    def start(self, time_ns, mean, covariance):
        self.time_ns = time_ns
        self.filter.x, self.filter.P = np.array(mean), np.array(covariance)

    def predict(self, time_ns):
        duration_s = (time_ns - self.time_ns) * 1e-9
        if duration_s > 0:
            axis = np.array([[1.0, duration_s], [0.0, 1.0]])
            noise = Q_discrete_white_noise(2, duration_s, self.variance, block_size=2)
            self.filter.predict(F=np.kron(np.eye(2), axis), Q=noise)
            self.time_ns = time_ns

    def take(self, topic, time_ns, fields):
        self.predict(time_ns)
        self.filter.update(fields[:2], R=np.reshape(fields[2:], (2, 2)))
        return self.filter.y, self.filter.S, True

    def state(self):
        return self.filter.x, self.filter.P


if __name__ == "__main__":
    serve(DESCRIPTION, Walker)
