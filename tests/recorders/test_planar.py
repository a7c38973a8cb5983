"""The planar models: the arc against the textbook's formula, Jacobians against complex steps."""

from collections.abc import Callable

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fuselog.recorders.models.planar import drive, range_bearing, wrap_angle
from tests.bench.reference.landmarks import drive_jacobians, range_bearing_jacobian

angles = st.floats(-4, 4)
lengths = st.floats(-5, 5)
# turn rates of every size, exactly zero and denormal ones too: the arc becomes a straight line there
turn_rates = st.one_of(st.floats(-3, 3), st.floats(-1e-3, 1e-3), st.sampled_from([0.0, 5e-324, -1e-300]))


def complex_step(function: Callable, at: NDArray) -> NDArray[np.float64]:
    """The Jacobian (outputs, inputs) of an analytic function, exact to rounding (Squire and Trapp)."""
    steps = at + 1e-200j * np.eye(len(at))
    return np.array([np.imag(function(step)) for step in steps]).T / 1e-200


def central_differences(function: Callable, at: NDArray) -> NDArray[np.float64]:
    """The Jacobian (outputs, inputs) by sixth-order differences, good to about 1e-12."""
    columns = []
    for step in 1e-2 * np.eye(len(at)):
        pairs = [
            np.subtract(function(at + reach * step), function(at - reach * step)) for reach in (1, 2, 3)
        ]
        columns.append((45 * pairs[0] - 9 * pairs[1] + pairs[2]) / 60e-2)
    return np.array(columns).T


@given(lengths, lengths, angles, lengths, st.floats(0.01, 3) | st.floats(-3, -0.01))
def test_drive_is_the_arc_of_the_textbook(x, y, heading, forward, turn):
    """Thrun, Burgard, Fox, Probabilistic Robotics, (5.9); 0.7 s."""
    radius = forward / turn
    expected = (
        x - radius * np.sin(heading) + radius * np.sin(heading + 0.7 * turn),
        y + radius * np.cos(heading) - radius * np.cos(heading + 0.7 * turn),
        heading + 0.7 * turn,
    )
    np.testing.assert_allclose(drive((x, y, heading), (forward, turn), 0.7), expected, atol=1e-11)


def test_drive_without_turning_is_a_straight_line():
    assert drive((1.0, 2.0, 0.0), (3.0, 0.0), 2.0) == (7.0, 2.0, 0.0)


@given(angles, lengths, turn_rates, st.floats(1e-3, 2))
def test_drive_jacobians_are_the_derivatives_of_drive(heading, forward, turn, duration_s):
    """By pose and velocity, at turn rate zero as well; a wrong one makes an EKF inconsistent."""
    turn = 0.0 if abs(turn) < 1e-4 else turn  # the complex quotient sin(u) / u has no digits below
    by_heading, by_forward, by_turn = drive_jacobians((0.0, 0.0, heading), (forward, turn), duration_s)
    exact = complex_step(
        lambda inputs: drive(inputs[:3], inputs[3:], duration_s),
        np.array([0.0, 0.0, heading, forward, turn]),
    )
    ours = np.array(
        [
            [1, 0, by_heading[0], by_forward[0], by_turn[0]],
            [0, 1, by_heading[1], by_forward[1], by_turn[1]],
            [0, 0, 1, 0, duration_s],
        ]
    )
    np.testing.assert_allclose(ours, exact, rtol=0, atol=2e-11)


@given(st.floats(-9e-5, 9e-5))
def test_drive_jacobians_of_small_turns_are_those_of_their_series(half_turn):
    """Where the quotient loses digits: by differences, which are good to about 1e-12."""
    at = np.array([1.0, 3.0, half_turn])
    by_heading, by_forward, by_turn = drive_jacobians((0.0, 0.0, at[0]), at[1:], 2.0)
    found = central_differences(lambda x: np.array(drive((0.0, 0.0, x[0]), x[1:], 2.0)), at)[:2]
    np.testing.assert_allclose(np.transpose([by_heading, by_forward, by_turn]), found, atol=1e-9)


@given(angles, st.floats(0.5, 5), angles)
def test_range_bearing_jacobian_is_its_derivative(heading, distance, direction):
    """By the pose, all round the target (arctan2 has no complex step)."""
    pose = np.array([1.0, -2.0, heading])
    target = pose[:2] + distance * np.array([np.cos(direction), np.sin(direction)])

    def look(pose: NDArray) -> NDArray:
        measured_m, bearing = range_bearing(pose, target)
        return np.array([measured_m, direction - heading + wrap_angle(bearing - direction + heading)])

    np.testing.assert_allclose(
        range_bearing_jacobian(pose, target), central_differences(look, pose), atol=1e-9
    )


@given(st.floats(-1e4, 1e4))
def test_wrap_angle_is_the_equal_angle_within_half_a_turn(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped <= np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-11)


def test_models_take_arrays_as_they_take_scalars():
    """One source serves simulators (arrays) and compiled loops (scalars)."""
    poses = np.array([[0.0, 1.0, 2.0], [3.0, -1.0, 0.5]])
    velocity = np.array([[1.0, 0.0], [0.5, 0.3]])
    both = np.transpose(drive(poses.T, velocity.T, 0.1))
    alone = [drive(pose, each, 0.1) for pose, each in zip(poses, velocity, strict=True)]
    np.testing.assert_array_equal(both, alone)
