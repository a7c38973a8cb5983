"""Noise as settings of other programs, in the units that each program uses.

A filter receives the largest value of the three axes, so the noise of no axis is understated. Continuous
densities are N in unit/sqrt(Hz) and K in unit/sqrt(s). For a standard deviation per step, N is divided
by the square root of the step.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import tomli_w

_PX4_STEP_S = 0.01  # EKF2_PREDICT_US
_FORCE, _RATE = "specific_force_mps2", "turn_rate_radps"


class Density(NamedTuple):
    """The noise of one field: the largest N and K of its axes, and the sampling step."""

    white: float
    walk: float
    step_s: float


class Densities(NamedTuple):
    """The exported noise densities by field, and doubts about them that users should read first."""

    topic: str
    fields: Mapping[str, Density]
    doubts: Sequence[str]

    def warned(self, mark: str, text: str) -> str:
        """Prepend the sentences to a text, as comments that begin with `mark`."""
        return "".join(f"{mark} {each}\n" for each in self.doubts) + text


def settings(found: Densities) -> str:
    """Format fuselog's settings for the model inertial: N and K, continuous."""
    names = {
        _FORCE: ("force_noise_density", "force_bias_density"),
        _RATE: ("gyro_noise_density", "gyro_bias_density"),
    }
    values = {
        name: float(f"{number:.6g}")
        for field, density in found.fields.items()
        for name, number in zip(names.get(field, ()), density, strict=False)
    }
    header = "# continuous: N in unit/sqrt(Hz), K in unit/sqrt(s); for --settings\n"
    return found.warned("#", header + tomli_w.dumps({"ekf": values})) if values else ""


def kalibr(topic: str, force: Density, rate: Density) -> str:
    """Format Kalibr's imu.yaml: N and K, continuous; Kalibr divides by the square root of the step."""
    return (
        "# continuous: Kalibr makes them discrete with update_rate; no safety factor is applied\n"
        f"rostopic: {topic}\n"
        f"update_rate: {1 / force.step_s:.6g}  # Hz\n"
        f"accelerometer_noise_density: {force.white:.6g}  # N, m/s^2/sqrt(Hz)\n"
        f"accelerometer_random_walk: {force.walk:.6g}  # K, m/s^3/sqrt(Hz)\n"
        f"gyroscope_noise_density: {rate.white:.6g}  # N, rad/s/sqrt(Hz)\n"
        f"gyroscope_random_walk: {rate.walk:.6g}  # K, rad/s^2/sqrt(Hz)\n"
    )


def px4(_: str, force: Density, rate: Density) -> str:
    """Format PX4's EKF2 parameters: discrete; N and K are divided by the square root of the step."""
    root = _PX4_STEP_S**0.5
    return (
        f"# discrete, for the filter's step of {_PX4_STEP_S:g} s (EKF2_PREDICT_US), over its root\n"
        f"EKF2_GYR_NOISE {rate.white / root:.6g}\n"
        f"EKF2_ACC_NOISE {force.white / root:.6g}\n"
        f"EKF2_GYR_B_NOISE {rate.walk / root:.6g}\n"
        f"EKF2_ACC_B_NOISE {force.walk / root:.6g}\n"
    )


def gtsam(_: str, force: Density, rate: Density) -> str:
    """Format GTSAM's preintegration parameters: N^2 and K^2, continuous."""
    return (
        "// continuous: N^2 and K^2; GTSAM divides by the step itself. A BetweenFactor of your own\n"
        "// over T seconds needs the standard deviation K sqrt(T)\n"
        f"params->setAccelerometerCovariance(I_3x3 * {force.white**2:.6g});\n"
        f"params->setGyroscopeCovariance(I_3x3 * {rate.white**2:.6g});\n"
        f"params->setBiasAccCovariance(I_3x3 * {force.walk**2:.6g});\n"
        f"params->setBiasOmegaCovariance(I_3x3 * {rate.walk**2:.6g});\n"
    )


def robot_localization(_: str, force: Density, rate: Density) -> str:
    """Format robot_localization's process noise, and the covariances of an inertial unit's messages."""
    return (
        "# process_noise_covariance is a variance per second of the state, or K^2 of a drifting state:\n"
        "# it describes your robot's motion, not N^2 of a sensor. Messages state a sensor's variance:\n"
        f"# angular_velocity_covariance {rate.white**2 / rate.step_s:.6g}  # (rad/s)^2, discrete\n"
        f"# linear_acceleration_covariance {force.white**2 / force.step_s:.6g}  # (m/s^2)^2, discrete\n"
        "# if you estimate a bias as a state, its process noise per second is\n"
        f"# turn rate {rate.walk**2:.6g}, specific force {force.walk**2:.6g}\n"
    )


def _of_unit(
    write: Callable[[str, Density, Density], str], mark: str = "#"
) -> Callable[[Densities], str]:
    """Make a writer of an inertial unit's file; it returns "" if one of the two sensors is missing."""

    def written(found: Densities) -> str:
        force, rate = found.fields.get(_FORCE), found.fields.get(_RATE)
        if force is None or rate is None:
            return ""
        return found.warned(mark, write(found.topic, force, rate))

    return written


FILES: Mapping[str, Callable[[Densities], str]] = {
    "settings.toml": settings,
    "kalibr-imu.yaml": _of_unit(kalibr),
    "px4.params": _of_unit(px4),
    "gtsam.cpp": _of_unit(gtsam, "//"),
    "robot_localization.yaml": _of_unit(robot_localization),
}
