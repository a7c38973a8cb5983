"""What parameters of PX4's EKF2 mean for a model of ours."""

from collections.abc import Mapping

# EKF2's noise is the density over the root of its step: its variance is (step x noise)^2 in a step.
_DENSITIES = {
    "EKF2_GYR_NOISE": "gyro_noise_density",
    "EKF2_ACC_NOISE": "force_noise_density",
    "EKF2_GYR_B_NOISE": "gyro_bias_density",
    "EKF2_ACC_B_NOISE": "force_bias_density",
}
_STEP_US = "EKF2_PREDICT_US"
_DEFAULT_STEP_US = 10_000
_LEVERS = {"X": ("lever_x_m", 1.0), "Y": ("lever_y_m", -1.0), "Z": ("lever_z_m", -1.0)}


def stated_noise(parameters: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """What channels state of their noise, by the last part of their topics."""
    root_s = (1e-6 * parameters.get(_STEP_US, _DEFAULT_STEP_US)) ** 0.5
    stated = {
        ours: f"{parameters[name] * root_s:.6g}"
        for name, ours in _DENSITIES.items()
        if parameters.get(name, -1.0) >= 0.0 and root_s > 0.0
    }
    return {"inertial": stated} if stated else {}


def carried(parameters: Mapping[str, float]) -> dict[str, str]:
    """What becomes of the filter's parameters, by subject: channels' numbers, settings, or nothing."""
    notes = {}
    used = {_STEP_US}
    stated = [name for name in _DENSITIES if name in parameters]
    if stated:
        used |= {*stated}
        notes[", ".join(stated)] = "are noise densities that /vehicle/inertial states"
    settings = []
    if "EKF2_GPS_DELAY" in parameters:
        used.add("EKF2_GPS_DELAY")
        delay_s = 1e-3 * parameters["EKF2_GPS_DELAY"]
        settings += [f"{of}_delay_s={delay_s:g}" for of in ("fix", "velocity")]
    for axis, (name, sign) in _LEVERS.items():
        antenna, unit = f"EKF2_GPS_POS_{axis}", f"EKF2_IMU_POS_{axis}"
        if antenna in parameters:
            used |= {antenna, unit}
            lever_m = sign * (parameters[antenna] - parameters.get(unit, 0.0))
            settings += [f"{name}={lever_m:g}"] if lever_m else []
    if settings:
        notes["settings that the filter had"] = " ".join(f"--set {each}" for each in settings)
    rest = [name for name in parameters if name.startswith(("EKF2_", "CAL_")) and name not in used]
    if rest:
        notes["parameters without a meaning here"] = ", ".join(sorted(rest))
    return notes
