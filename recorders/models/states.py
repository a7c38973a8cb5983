"""How channels name the components of a state."""

from collections.abc import Sequence

# What moves in the plane with a velocity of its own.
PLANE_MOTION = ("x_m", "vx_mps", "y_m", "vy_mps")


def state_metadata(components: Sequence[str]) -> dict[str, str]:
    """The metadata of a channel of states: its components, and whether each is linear or an angle.

    An angle is a component in rad that wraps.
    """
    kinds = ["angle" if name.endswith("_rad") else "linear" for name in components]
    return {"components": ",".join(components), "kinds": ",".join(kinds)}
