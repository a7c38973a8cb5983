"""Conversion of PX4's frames to ours: NED to ENU, and for the body FRD to FLU (forward, left, up)."""

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.models.orientation import compose

Floats = NDArray[np.float64]
# The rotation from north, east, down to east, north, up: half a turn about north-east.
_TO_ENU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
# The rotation from forward, left, up to forward, right, down: half a turn about the forward axis.
_FROM_FLU = np.array([0.0, 1.0, 0.0, 0.0])


def to_enu(vectors: Floats) -> Floats:
    """Convert vectors (n, 3) from north, east, down to east, north, up."""
    return vectors[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def to_flu(vectors: Floats) -> Floats:
    """Convert vectors (n, 3) from forward, right, down to forward, left, up."""
    return vectors * [1.0, -1.0, -1.0]


def orientations(quaternions: Floats) -> Floats:
    """Convert rotations (n, 4; w, x, y, z) from a body's FRD to NED into those from its FLU to ENU."""
    return compose(compose(np.broadcast_to(_TO_ENU, quaternions.shape), quaternions), _FROM_FLU)
