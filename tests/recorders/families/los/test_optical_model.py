"""Lines of sight: the rotation's sense, the gradients, and what turns unseen."""

from collections.abc import Callable

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fuselog.recorders.families.los.models import (
    direction,
    line_of_sight,
    line_of_sight_gradients,
    rotate,
    turning_vector,
)

angle = st.floats(-3.0, 3.0)
coordinate = st.floats(-1e4, 1e4)


def test_gradients_equal_a_complex_step(complex_step: Callable) -> None:
    """A wrong sign or term in any of the twelve derivatives (the print has five) breaks this."""
    rng = np.random.default_rng(1)
    target, sensor = rng.uniform(-1e4, 1e4, (2, 3, 500))
    attitude = rng.uniform(-np.pi, np.pi, (3, 500))
    exact = complex_step(
        lambda x: line_of_sight(x[:3], sensor, x[3:]), np.concatenate([target, attitude])
    )
    ours = np.array(line_of_sight_gradients(target, sensor, attitude))
    scale = np.abs(exact).max(axis=1, keepdims=True)
    assert np.abs((ours - exact) / scale).max() < 1e-14


def test_rotations_are_active_and_roll_comes_first() -> None:
    """Yaw takes x to y; eq (1) as printed would take it to -y."""
    quarter = np.pi / 2
    np.testing.assert_allclose(rotate((quarter, 0.0, 0.0), (1.0, 0.0, 0.0)), (0, 1, 0), atol=1e-15)
    np.testing.assert_allclose(rotate((0.0, quarter, 0.0), (0.0, 0.0, 1.0)), (1, 0, 0), atol=1e-15)
    np.testing.assert_allclose(rotate((quarter, 0.0, quarter), (0.0, 0.0, 1.0)), (1, 0, 0), atol=1e-15)


@given(st.tuples(coordinate, coordinate, coordinate), st.tuples(angle, angle, angle))
def test_direction_inverts_line_of_sight(offset: tuple, attitude: tuple) -> None:
    """The unit vector of the measured angles is the one to the target, for every attitude."""
    length = np.linalg.norm(offset)
    if length < 1e-3:
        return
    azimuth, elevation = line_of_sight(offset, (0.0, 0.0, 0.0), attitude)
    np.testing.assert_allclose(
        direction(azimuth, elevation, attitude), np.array(offset) / length, atol=1e-12
    )


def test_turning_vector_keeps_what_a_sensor_sees() -> None:
    """A wrong turning vector would name the wrong unobservable axis: angles must not change at once."""
    rng = np.random.default_rng(2)
    attitude, change = rng.uniform(-1, 1, (2, 3))
    offset = rng.uniform(-1, 1, 3)
    step = 1e-6
    turned = offset + step * np.cross(np.array(turning_vector(attitude, change)), offset)
    before = np.array(line_of_sight(offset, np.zeros(3), attitude))
    after = np.array(line_of_sight(turned, np.zeros(3), attitude + step * change))
    assert np.abs(after - before).max() < 100 * step**2
