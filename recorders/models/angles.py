"""Angles on the circle."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def wrap(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """The same angle in [-pi, pi)."""
    return (np.asarray(angle_rad) + np.pi) % (2.0 * np.pi) - np.pi
