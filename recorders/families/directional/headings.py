"""Models of two angles modulo 2 pi. Component-first for scalars and arrays, in rad and not wrapped."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fuselog.recorders.models.planar import Component

Correlation = Annotated[float, Field(gt=-1, lt=1)]


def turn_together(
    x1: Component, x2: Component, coupling: Component, drift1: Component, drift2: Component
) -> tuple[Component, Component]:
    """Compute the next values of two coupled headings, x + c (cos x2, sin x1) + drift, without noise.

    This is the system of Kurz and Hanebeck, "Deterministic Sampling on the Torus for Bivariate Circular
    Estimation", 2016, section IV.
    """
    return x1 + coupling * np.cos(x2) + drift1, x2 + coupling * np.sin(x1) + drift2


def turn_on(
    direction: Component, turn: Component, coupling: Component, drift1: Component, drift2: Component
) -> tuple[Component, Component]:
    """Compute the next direction and the next turn, without noise; a fraction of each turn persists.

    The turn is an angle too: a turn by more than half a revolution is the same as the opposite turn.
    """
    return direction + turn + drift1, coupling * np.sin(turn) + drift2


def equal_sigmas(sigma: float, correlation: float) -> NDArray[np.float64]:
    """Return the covariance (2, 2) of two numbers with the same standard deviation."""
    return sigma**2 * np.array([[1.0, correlation], [correlation, 1.0]])
