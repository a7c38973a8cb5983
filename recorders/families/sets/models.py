"""Models relative bearings: the angle between two landmarks as a robot in the plane sees them.

Component-first, as in `planar`. Needs no heading. Signed: positive where the first landmark lies
anticlockwise of the second.
"""

import numpy as np

from fuselog.recorders.models.planar import Component, Components


def relative_bearing(position: Components, first: Components, second: Components) -> Component:
    """Compute bearing of `first` minus bearing of `second`, rad in (-pi, pi]; not on a landmark."""
    first_x, first_y = first[0] - position[0], first[1] - position[1]
    second_x, second_y = second[0] - position[0], second[1] - position[1]
    cross = second_x * first_y - second_y * first_x
    return np.arctan2(cross, first_x * second_x + first_y * second_y)
