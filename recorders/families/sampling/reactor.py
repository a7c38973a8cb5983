"""Models of a gas that reacts in a closed vessel, 2A -> B, in discrete time.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
(29) and (30). The state is the partial pressures (a, b), for which the paper states no unit.
"""

from fuselog.recorders.models.planar import Component, Components

CONSUMED = -0.32
PRODUCED = 0.16


def react(pressures: Components, duration_s: Component) -> tuple[Component, Component]:
    """Compute the pressures after one time step, without noise."""
    reacted = duration_s * pressures[0] * pressures[0]
    return pressures[0] + CONSUMED * reacted, pressures[1] + PRODUCED * reacted


def total_pressure(pressures: Components) -> tuple[Component]:
    """Compute the sensor's reading without noise."""
    return (pressures[0] + pressures[1],)
