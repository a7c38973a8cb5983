"""Counterparts of PX4's EKF2 parameters in the model `inertial`, and reasons why others have none."""

from collections.abc import Mapping
from fnmatch import fnmatchcase

from fuselog.recorders.errors import some_of

# EKF2's noise is a density divided by the root of its step: its variance in a step is (step x noise)^2.
_DENSITIES = {
    "EKF2_GYR_NOISE": "gyro_noise_density",
    "EKF2_ACC_NOISE": "force_noise_density",
    "EKF2_GYR_B_NOISE": "gyro_bias_density",
    "EKF2_ACC_B_NOISE": "force_bias_density",
}
_NAMED = 3  # names listed for parameters that share a reason; /vehicle/parameters has all
_STEP_US = "EKF2_PREDICT_US"
_DEFAULT_STEP_US = 10_000
# For each parameter, our settings and the factor to their unit.
_SETTINGS = {
    "EKF2_GPS_DELAY": (("fix_delay_s", "velocity_delay_s"), 1e-3),
    "EKF2_ABIAS_INIT": (("force_bias_sigma_mps2",), 1.0),
    "EKF2_GBIAS_INIT": (("gyro_bias_sigma_radps",), 1.0),
    "EKF2_ANGERR_INIT": (("tilt_sigma_rad",), 1.0),
}
_LEVERS = {"X": ("lever_x_m", 1.0), "Y": ("lever_y_m", -1.0), "Z": ("lever_z_m", -1.0)}
# Reasons why parameters are not used, by their names; the first pattern that matches counts.
_REASONS = {
    "CAL_*": "were applied before sensor_combined and vehicle_imu were logged; accelerometer_N, "
    "gyro_N and magnetometer_N are raw sensor readings",
    "EKF2_*_GATE": "test single components; gate_probability tests all components of a message together",
    "EKF2_GPS_?_NOISE": "are lower limits in EKF2; here fixes have the noise that they state",
    "EKF2_MAG_NOISE": "is in gauss; with the magnetometer, set sigma_field_ut to 100 times this value",
    "EKF2_*": "have no counterpart in the model inertial",
}


def stated_noise(parameters: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """Return the noise densities that channels state, by the last part of their topics."""
    root_s = (1e-6 * parameters.get(_STEP_US, _DEFAULT_STEP_US)) ** 0.5
    stated = {
        ours: f"{parameters[name] * root_s:.6g}"
        for name, ours in _DENSITIES.items()
        if parameters.get(name, -1.0) >= 0.0 and root_s > 0.0
    }
    return {"inertial": stated} if stated else {}


def carried(parameters: Mapping[str, float]) -> dict[str, str]:
    """Describe the use of parameters, by subject: metadata, settings, or a reason why unused."""
    notes = {}
    stated = [name for name in _DENSITIES if name in parameters]
    if stated:
        notes[", ".join(stated)] = "are noise densities that /vehicle/inertial states"
    used = {_STEP_US, *stated}
    settings = []
    for name, (ours, unit) in _SETTINGS.items():
        if name in parameters:
            used.add(name)
            settings += [f"{each}={unit * parameters[name]:.6g}" for each in ours]
    for axis, (lever, sign) in _LEVERS.items():
        antenna, imu = f"EKF2_GPS_POS_{axis}", f"EKF2_IMU_POS_{axis}"
        if antenna in parameters:
            used |= {antenna, imu}
            lever_m = sign * (parameters[antenna] - parameters.get(imu, 0.0))
            settings += [f"{lever}={lever_m:.6g}"] if lever_m else []
    if settings:
        notes["settings that the filter had"] = " ".join(f"--set {each}" for each in settings)
    rest: dict[str, list[str]] = {}
    for name in sorted(parameters.keys() - used):
        pattern = next((each for each in _REASONS if fnmatchcase(name, each)), None)
        if pattern is not None:
            rest.setdefault(pattern, []).append(name)
    notes |= {some_of(names, _NAMED): _REASONS[pattern] for pattern, names in rest.items()}
    return notes
