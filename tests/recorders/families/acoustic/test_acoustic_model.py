"""The sound of a shot: who hears what, and the gradients of the paper's appendix."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fuselog.recorders.families.acoustic import models as acoustic
from fuselog.recorders.families.acoustic.models import Medium, Noise
from fuselog.recorders.models.planar import wrap_angle

MEDIUM = Medium()
NOISE = Noise(0.07, 0.05, 1e-3, 2.0)
angle = st.floats(-10.0, 10.0)


@given(st.floats(-1e6, 1e6))
def test_wrap_is_the_same_angle_in_half_open_interval(value: float) -> None:
    wrapped = float(wrap_angle(value))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(value), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(value), abs=1e-9)


@given(st.tuples(angle, angle), angle, st.floats(0.02, 1.04), st.sampled_from([-1.0, 1.0]))
def test_range_trajectory_and_side_come_back(
    sensor: tuple, trajectory: float, off_line: float, side: float
) -> None:
    """A sensor that hears the shockwave works out range, trajectory and side without error."""
    azimuth = trajectory + np.pi + side * off_line
    shooter = (sensor[0] + 80.0 * np.cos(azimuth), sensor[1] + 80.0 * np.sin(azimuth))
    blast, shockwave, delay = acoustic.hear(shooter, trajectory, sensor, MEDIUM)
    assert acoustic.shockwave_side(blast, trajectory, MEDIUM) == side
    assert acoustic.measured_side(blast, shockwave) == side
    found = acoustic.trajectory_from_shockwave(shockwave, side, MEDIUM)
    assert wrap_angle(found - trajectory) == pytest.approx(0.0, abs=1e-9)
    distance = acoustic.range_from_time_difference(delay, blast - shockwave, MEDIUM)
    assert distance == pytest.approx(80.0, rel=1e-9)


@pytest.mark.parametrize("trajectory", [-3.0, 0.1, 3.1])
def test_shockwave_is_heard_within_sixty_degrees_of_the_line_of_fire(trajectory: float) -> None:
    """Eq (7) without wrapping loses sensors whose azimuth jumps at 180 deg."""
    off_line = np.radians([-61.0, -59.0, -1.0, 1.0, 59.0, 61.0])
    side = acoustic.shockwave_side(wrap_angle(off_line + np.pi + trajectory), trajectory, MEDIUM)
    np.testing.assert_array_equal(side, [0.0, -1.0, -1.0, 1.0, 1.0, 0.0])


def test_shockwave_on_the_line_of_fire_is_not_heard() -> None:
    """There the two branches of eq (7) contradict each other."""
    assert acoustic.shockwave_side(np.pi, 0.0, MEDIUM) == 0.0


def test_gradients_equal_a_complex_step(complex_step: Callable) -> None:
    """Wrong derivatives of the delay or of eqs (17), (18), (26) break the step or the trace term."""
    rng = np.random.default_rng(1)
    x = np.stack([rng.uniform(1.0, 500.0, 200), rng.uniform(0.3, 2.0, 200)])
    exact = complex_step(lambda x: [acoustic.time_difference(x[0], x[1], MEDIUM)], x)[0]
    np.testing.assert_allclose(acoustic.time_difference_gradient(*x, MEDIUM), exact, rtol=1e-13)
    exact = complex_step(lambda x: acoustic.local_estimate_covariances(*x, NOISE, MEDIUM), x)
    ours = np.array(acoustic.local_estimate_covariance_gradients(*x, NOISE, MEDIUM))
    np.testing.assert_allclose(ours, exact, rtol=1e-12)


def test_appendix_b_says_the_same() -> None:
    """Eqs (63), (68) and (73) by trajectory are minus our derivatives by separation."""
    distance, separation = 80.0, 1.3
    variance, with_azimuth, _ = acoustic.local_estimate_covariances(distance, separation, NOISE, MEDIUM)
    gradients = acoustic.local_estimate_covariance_gradients(distance, separation, NOISE, MEDIUM)
    sine, missing = np.sin(separation), 1.0 - np.cos(separation)
    delay = (MEDIUM.speed_of_sound_mps * NOISE.time_difference_s / missing) ** 2
    printed_63 = 2.0 / sine * (variance + delay * np.cos(separation))
    assert -gradients[0][1] == pytest.approx(printed_63, rel=1e-12)
    assert -gradients[1][1] == pytest.approx(-distance * NOISE.muzzle_blast_rad**2 / missing, rel=1e-12)
    assert -gradients[2][1] == pytest.approx(distance * NOISE.shockwave_rad**2 / missing, rel=1e-12)
    assert gradients[1][0] == pytest.approx(with_azimuth / distance, rel=1e-12)
