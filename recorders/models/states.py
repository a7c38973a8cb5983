"""Names of the components of a state, as in channels."""

from collections.abc import Sequence

# States of bodies that move in the plane, without and with their own velocity.
POSE = ("x_m", "y_m", "heading_rad")
PLANE_MOTION = ("x_m", "vx_mps", "y_m", "vy_mps")
ORIENTATION = tuple(f"orientation_{part}" for part in "wxyz")
# The state of inertial navigation: position, velocity, orientation, and biases.
NAVIGATION = (
    *("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
    *ORIENTATION,
    *(f"gyro_bias_{axis}_radps" for axis in "xyz"),
    *(f"accelerometer_bias_{axis}_mps2" for axis in "xyz"),
)


def state_metadata(components: Sequence[str]) -> dict[str, str]:
    """Return the metadata of a channel of states: components, and their kinds.

    A component in rad is an angle that wraps; the components named in ORIENTATION form a quaternion.
    """
    kinds = [
        "quaternion" if name in ORIENTATION else "angle" if name.endswith("_rad") else "linear"
        for name in components
    ]
    return {"components": ",".join(components), "kinds": ",".join(kinds)}
