"""Two headings that turn with each other, x+ = x + c (cos x2, sin x1) + drift, and angles modulo 2 pi.

The system of Kurz and Hanebeck, "Deterministic Sampling on the Torus for Bivariate Circular Estimation",
2016, section IV. Component-first: scalars and arrays alike.
"""

import numpy as np

from recorders.models.planar import Component


def turn_together(
    x1: Component, x2: Component, coupling: Component, drift1: Component, drift2: Component
) -> tuple[Component, Component]:
    """The next headings (rad, not wrapped) without noise."""
    return x1 + coupling * np.cos(x2) + drift1, x2 + coupling * np.sin(x1) + drift2
