"""The algebra of axes and orientations, and exact samples of their noise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.noise import (
    saddlepoint,
    sample_bingham,
    sample_projected_gaussian,
)
from fuselog.recorders.models import orientation
from fuselog.recorders.recording import record_run


def units(count: int, d: int, seed: int = 0) -> np.ndarray:
    drawn = np.random.default_rng(seed).standard_normal((count, d))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def test_complex_product_is_that_of_complex_numbers():
    x, y = units(20, 2), units(20, 2, 1)
    product = (x[:, 0] + 1j * x[:, 1]) * (y[:, 0] + 1j * y[:, 1])
    expected = np.stack([product.real, product.imag], axis=-1)
    np.testing.assert_allclose(orientation.compose(x, y), expected, atol=1e-15)


def test_quaternion_product_and_rotation_are_those_of_scipy():
    x, y, v = units(20, 4), units(20, 4, 1), np.random.default_rng(2).standard_normal((20, 3))
    first, second = (Rotation.from_quat(each, scalar_first=True) for each in (x, y))
    product = Rotation.from_quat(orientation.compose(x, y), scalar_first=True)
    np.testing.assert_allclose(product.as_matrix(), (first * second).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(orientation.rotate(x, v), first.apply(v), atol=1e-14)


@pytest.mark.parametrize("d", [2, 4])
def test_matrices_conjugates_and_angles_belong_to_the_product(d):
    x, y = units(20, d), units(20, d, 1)
    product = orientation.compose(x, y)
    np.testing.assert_allclose(
        orientation.right_matrix(y) @ x[..., None], product[..., None], atol=1e-15
    )
    identity = np.broadcast_to(np.eye(d)[0], x.shape)
    np.testing.assert_allclose(orientation.compose(x, orientation.conjugate(x)), identity, atol=1e-15)
    angle = np.arccos(np.minimum(np.abs((x * y).sum(-1)), 1.0))
    np.testing.assert_allclose(orientation.axis_angle_between(x, -y), angle, atol=1e-7)


def test_small_angles_between_axes_keep_their_digits():
    tiny = Rotation.from_rotvec([2e-9, 0.0, 0.0]).as_quat(scalar_first=True)
    assert orientation.axis_angle_between([1.0, 0, 0, 0], tiny) == pytest.approx(1e-9, rel=1e-12)


@pytest.mark.parametrize(
    ("x", "message"),
    [
        ([[1.0, 0, 0, 0], [0.9, 0, 0, 0]], r"at \(1,\) has length 0.9"),
        ([0.0, 0.0], "has length 0"),
        ([1.0, np.nan], "has length nan"),
        ([1.0, 0.0, 0.0], "2 or 4 components"),
    ],
)
def test_what_is_no_unit_vector_is_refused(x, message):
    with pytest.raises(BadInput, match=message):
        orientation.require_unit(x, "measurement")


@pytest.mark.parametrize(
    ("z", "moments"),
    [
        ([-200.0, -200.0, -2.0, 0.0], [0.0025069842, 0.0025069842, 0.2762993334, 0.7186866981]),
        ([-500.0, -500.0, -500.0, 0.0], [0.0010010061, 0.0010010061, 0.0010010061, 0.9969969817]),
        ([0.0, 0.0, 0.0, 0.0], [0.25] * 4),
        ([-1e6, 0.0], [5e-7, 1.0 - 5e-7]),
    ],
)
def test_bingham_samples_have_its_second_moments(z, moments):
    """Fails where the envelope or its bound is wrong; five standard errors of 40,000 samples."""
    z = np.array(z)
    count, d = 40_000, len(z)
    x = sample_bingham(np.broadcast_to(np.eye(d), (count, d, d)), z, np.random.default_rng(1))
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1.0, atol=1e-15)
    error = (x**2).std(axis=0) / np.sqrt(count)
    assert np.all(np.abs((x**2).mean(axis=0) - moments) < 5.0 * error + 1e-9)
    assert abs((x[:, 0] * x[:, 1]).mean()) < 5.0 * np.abs(x[:, 0] * x[:, 1]).std() / np.sqrt(count)


def test_bingham_samples_take_batches_turn_with_the_axes_and_repeat_with_the_seed():
    axes, z = orientation.left_matrix(units(3, 4)), np.array([0.0, -50.0, -60.0, -70.0])
    wide = np.broadcast_to(axes[:, None], (3, 5, 4, 4))
    first, again = (sample_bingham(wide, z, np.random.default_rng(7)) for _ in range(2))
    assert first.shape == (3, 5, 4)
    assert first.tobytes() == again.tobytes()
    assert np.all(orientation.axis_angle_between(first, axes[:, None, :, 0]) < 0.6)


def test_saddlepoint_solves_its_equation():
    z = -(10.0 ** np.random.default_rng(0).uniform(-3, 9, (200, 4)))
    z[:, 3] = 0.0
    residual = (0.5 / (saddlepoint(z)[:, None] - z)).sum(axis=1) - 1.0
    assert np.abs(residual).max() < 1e-14


def test_projected_gaussians_are_unit_vectors_about_the_mean():
    x = sample_projected_gaussian(
        np.array([1.0, 0.0]), np.diag([1e-4, 1e-2]), (1000,), np.random.default_rng(0)
    )
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1.0, atol=1e-15)
    assert x[:, 1].std() == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize(("scenario", "field"), [("axis", "axis"), ("orientation", "quaternion")])
def test_turns_and_measurement_errors_are_each_runs_own(scenario, field):
    """Neither is the same in two runs, nor is one of them drawn from the other's random stream."""
    drawn = []
    for run in range(2):
        truth, measured = record_run(scenario, {}, 4, run)[0].streams
        state, seen = truth["state"], measured[field]
        drawn.append(orientation.compose(orientation.conjugate(state[:-1]), state[1:])[:, 1])
        drawn.append(orientation.compose(orientation.conjugate(state), seen)[1:, 1])
    correlation = np.corrcoef(drawn)[np.triu_indices(4, 1)]
    assert np.abs(correlation).max() < 4 / np.sqrt(99)


def test_infinite_concentrations_are_refused():
    with pytest.raises(BadInput, match="finite"):
        sample_bingham(np.eye(2), [-np.inf, 0.0], np.random.default_rng(0))
