"""Models of an axis-aligned rectangle; a sensor sees one noisy point of it at a time.

Sources: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.B; Baum, Faion and Hanebeck, "Modeling the Target Extent with Multiplicative Noise", FUSION
2012. Target = (half_x_m, half_y_m, x_m, y_m): half lengths of the sides, and the centre.
"""

from fuselog.recorders.models.planar import Component, Components

SCALE_VARIANCE = 1.0 / 3.0  # of a scale that is uniform in [-1, 1]


def surface_point(target: Components, scale: Components) -> tuple[Component, Component]:
    """Compute a point of the rectangle; `scale` (-1 to 1 per axis) is relative to the half sides."""
    return scale[0] * target[0] + target[2], scale[1] * target[1] + target[3]


def quadratic(point: Components) -> tuple[Component, Component, Component, Component]:
    """Return a point and its squared coordinates, which a linear filter needs to estimate the size."""
    return point[0], point[1], point[0] * point[0], point[1] * point[1]


def area_m2(target: Components) -> Component:
    """Compute the rectangle's area; its sign follows the half sides' signs, which are unobservable."""
    return 4.0 * target[0] * target[1]
