"""Converts PX4's frames into ours: NED into ENU, and of the body FRD into FLU (forward, left, up)."""

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.models.orientation import compose

Floats = NDArray[np.float64]
# The rotation from north, east, down to east, north, up: half a turn about north-east.
_TO_ENU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
# That from forward, left, up to forward, right, down: half a turn about the forward axis.
_FROM_FLU = np.array([0.0, 1.0, 0.0, 0.0])


def to_enu(vectors: Floats) -> Floats:
    """Turn vectors (n, 3) of north, east, down into east, north, up."""
    return vectors[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def to_flu(vectors: Floats) -> Floats:
    """Turn vectors (n, 3) of forward, right, down into forward, left, up."""
    return vectors * [1.0, -1.0, -1.0]


def orientations(quaternions: Floats) -> Floats:
    """Turn rotations (n, 4; w, x, y, z) from a body's FRD to NED into those from its FLU to ENU."""
    return compose(compose(np.broadcast_to(_TO_ENU, quaternions.shape), quaternions), _FROM_FLU)
