"""Names the components of a state, as channels do."""

from collections.abc import Sequence

# What moves in the plane with a velocity of its own.
POSE = ("x_m", "y_m", "heading_rad")
PLANE_MOTION = ("x_m", "vx_mps", "y_m", "vy_mps")
ORIENTATION = tuple(f"orientation_{part}" for part in "wxyz")
# What an inertial unit is navigated by: where it is, how it is turned, and its biases.
NAVIGATION = (
    *("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
    *ORIENTATION,
    *(f"gyro_bias_{axis}_radps" for axis in "xyz"),
    *(f"accelerometer_bias_{axis}_mps2" for axis in "xyz"),
)


def state_metadata(components: Sequence[str]) -> dict[str, str]:
    """Return the metadata of a channel of states: its components, and of what kind each is.

    An angle is a component in rad that wraps; those of ORIENTATION are a quaternion.
    """
    kinds = [
        "quaternion" if name in ORIENTATION else "angle" if name.endswith("_rad") else "linear"
        for name in components
    ]
    return {"components": ",".join(components), "kinds": ",".join(kinds)}
