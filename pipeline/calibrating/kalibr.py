"""Output of a calibration in Kalibr's YAML format, with mountings, time shifts and sensor errors.

T_sensor_body converts a point from the body's axes to the sensor's, and a message was measured at its
stamp plus timeshift_sensor_body. For a camera, Kalibr calls these T_cam_imu and timeshift_cam_imu.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FILE = "kalibr-calibration.yaml"
HEAD = (
    "# T_sensor_body: converts a point from body axes to sensor axes, in m, as Kalibr's T_cam_imu\n"
    "# timeshift_sensor_body: measured at the stamp plus this, in s, as Kalibr's timeshift_cam_imu\n"
)
DELAY = "_delay_s"
LEVER = ("lever_x_m", "lever_y_m", "lever_z_m")
MOUNTING = ("mounting_roll_rad", "mounting_pitch_rad", "mounting_yaw_rad")
HEADING = "bias_heading_rad"


def kalibr_yaml(values: Mapping[str, float], held: Sequence[str]) -> str:
    """Format the values of a calibration, with a comment on those that are not determined.

    >>> print(kalibr_yaml({"lever_x_m": 1.2, "fix_delay_s": 0.15}, []).removeprefix(HEAD).strip())
    fix:
      T_sensor_body:
      - [1, 0, 0, -1.2]
      - [0, 1, 0, 0]
      - [0, 0, 1, 0]
      - [0, 0, 0, 1]
      timeshift_sensor_body: -0.15
    >>> print(kalibr_yaml({"/gps2/fix.fix_delay_s": 0.2}, []).removeprefix(HEAD).strip())
    /gps2/fix:
      timeshift_sensor_body: -0.2
    """
    sensors: dict[str, list[str]] = {}
    for topic in dict.fromkeys(name.rpartition(".")[0] for name in values):
        own = {
            name.rpartition(".")[2]: value
            for name, value in values.items()
            if name.rpartition(".")[0] == topic
        }
        if {*LEVER} & {*own}:
            arm = np.array([own.get(name, 0.0) for name in LEVER])
            sensors[topic or "fix"] = _transform(np.eye(3), -arm)
        if HEADING in own:
            turned = Rotation.from_euler("z", own[HEADING]).as_matrix()
            sensors[topic or "heading"] = _transform(turned.T, np.zeros(3))
        if {*MOUNTING} & {*own}:
            angles = [own.get(name, 0.0) for name in reversed(MOUNTING)]
            turned = Rotation.from_euler("ZYX", angles).as_matrix()
            sensors[topic or "inertial"] = _transform(turned.T, np.zeros(3))
        for name, value in own.items():
            if name.endswith(DELAY):
                shift = f"timeshift_sensor_body: {-value:.6g}"
                sensors.setdefault(topic or name.removesuffix(DELAY), []).append(shift)
            elif name not in (*LEVER, *MOUNTING, HEADING):
                key = f"{topic}.{name}" if topic else name
                sensors.setdefault("errors", []).append(f"{key}: {value:.6g}")
    unknown = f"# not determined, left at the start values: {', '.join(held)}\n" if held else ""
    blocks = [f"{name}:\n" + "".join(f"  {line}\n" for line in lines) for name, lines in sensors.items()]
    return HEAD + unknown + "".join(blocks)


def _transform(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> list[str]:
    """Format the lines of T_sensor_body."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    rows = [", ".join(f"{entry + 0.0:.6g}" for entry in row) for row in matrix]
    return ["T_sensor_body:", *(f"- [{row}]" for row in rows)]
