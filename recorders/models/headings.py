"""Two headings that turn with each other, x+ = x + c (cos x2, sin x1) + drift, and angles modulo 2 pi.

The system of Kurz and Hanebeck, "Deterministic Sampling on the Torus for Bivariate Circular Estimation",
2016, section IV. Component-first: scalars and arrays alike.
"""

from typing import Any

import numpy as np

# A number, or an array of them: the annotation of everything a component may be.
Component = Any
Components = tuple[Any, ...]


def wrap_angle(angle_rad: Component) -> Component:
    """The equal angle in [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def turn_together(
    x1: Component, x2: Component, coupling: Component, drift1: Component, drift2: Component
) -> tuple[Component, Component]:
    """The next headings (rad, not wrapped) without noise."""
    return x1 + coupling * np.cos(x2) + drift1, x2 + coupling * np.sin(x1) + drift2
