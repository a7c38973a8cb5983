"""Reference: an error-state Kalman filter in plain NumPy, as a textbook has it.

Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 2013,
chapter 14, in a local plane; to be timed against and for nothing else.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.log import Stream
from fuselog.recorders.models.inertial import earth_rate, gravity

Floats = NDArray[np.float64]


def filtered(streams: Mapping[str, Stream], densities: Floats, place: tuple[float, float]) -> Floats:
    """Position and velocity (n, 6) after each fix and its velocity, which have stamps of samples.

    Args:
        streams: `prior`, `inertial`, `fix` and `velocity`.
        densities: of force, turn rate, bias of the gyro, bias of the accelerometer.
        place: latitude (deg) and height (m) of the plane's origin.
    """
    prior, unit, fix, moving = (streams[name] for name in ("prior", "inertial", "fix", "velocity"))
    mean, covariance = prior["mean"][0], prior["covariance"][0].reshape(15, 15)
    position, velocity, gyro_bias, force_bias = mean[:3], mean[3:6], mean[10:13], mean[13:]
    body = _matrix(mean[6:10])
    earth, down = np.array(earth_rate(place[0])), np.array([0.0, 0.0, -gravity(*place)])
    rows = {int(stamp): row for row, stamp in enumerate(fix.publish_time_ns)}
    noise = np.repeat(np.concatenate([[0.0], densities[:2], densities[2:]]), 3) ** 2
    found: list[Any] = []
    times_s = (unit.publish_time_ns - unit.publish_time_ns[0]) * 1e-9
    force, rate = unit["specific_force_mps2"], unit["turn_rate_radps"]
    for sample in range(len(times_s)):
        if sample:
            step_s = times_s[sample] - times_s[sample - 1]
            felt = 0.5 * (force[sample] + force[sample - 1]) - force_bias
            turn = 0.5 * (rate[sample] + rate[sample - 1]) - gyro_bias - body.T @ earth
            middle = body @ _turned(0.5 * step_s * turn)
            acceleration = middle @ felt + down - 2.0 * np.cross(earth, velocity)
            position = position + step_s * velocity + 0.5 * step_s**2 * acceleration
            velocity = velocity + step_s * acceleration
            step = np.eye(15)
            step[:3, 3:6] = step_s * np.eye(3)
            step[3:6, 6:9] = -step_s * middle @ _skew(felt)
            step[3:6, 12:] = -step_s * middle
            step[6:9, 6:9] = _turned(-step_s * turn)
            step[6:9, 9:12] = -step_s * np.eye(3)
            body = body @ _turned(step_s * turn)
            covariance = step @ covariance @ step.T + np.diag(noise * step_s)
        row = rows.get(int(unit.publish_time_ns[sample]))
        if row is None:
            continue
        for first, value, spread in (
            (0, fix["position_m"][row], fix["covariance_m2"][row]),
            (3, moving["velocity_mps"][row], moving["covariance_m2ps2"][row]),
        ):
            own = np.zeros((3, 15))
            own[:, first : first + 3] = np.eye(3)
            innovation = own @ covariance @ own.T + spread.reshape(3, 3)
            gain = np.linalg.solve(innovation, own @ covariance).T
            change = gain @ (value - (velocity if first else position))
            rest = np.eye(15) - gain @ own
            covariance = rest @ covariance @ rest.T + gain @ spread.reshape(3, 3) @ gain.T
            position, velocity = position + change[:3], velocity + change[3:6]
            body = body @ _turned(change[6:9])
            gyro_bias, force_bias = gyro_bias + change[9:12], force_bias + change[12:]
        found.append(np.concatenate([position, velocity]))
    return np.array(found)


def _matrix(quaternion: Floats) -> Floats:
    return np.array(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def _skew(v: Floats) -> Floats:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _turned(v: Floats) -> Floats:
    """Rodrigues' formula."""
    angle, across = float(np.linalg.norm(v)), _skew(v)
    ratio = float(np.sinc(angle / np.pi))
    half = float(np.sinc(0.5 * angle / np.pi))
    return np.eye(3) + ratio * across + 0.5 * half**2 * across @ across
