"""Relative bearings: the angle between two landmarks as seen by a robot in the plane.

Component-first, as in `planar`. The angle needs no heading and is positive if the first landmark is
anticlockwise of the second.
"""

import numpy as np

from fuselog.recorders.models.planar import Component, Components


def relative_bearing(position: Components, first: Components, second: Components) -> Component:
    """Compute the bearing of `first` minus that of `second` (rad), in (-pi, pi] except at a landmark."""
    first_x, first_y = first[0] - position[0], first[1] - position[1]
    second_x, second_y = second[0] - position[0], second[1] - position[1]
    cross = second_x * first_y - second_y * first_x
    return np.arctan2(cross, first_x * second_x + first_y * second_y)
