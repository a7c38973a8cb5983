"""Errors and interpolation on the circle, of axes and of orientations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.engine.vectors.covariances import is_positive_definite, normalized_error_squared
from fuselog.replay.engine.vectors.tangent import (
    are_kinds,
    between,
    difference,
    named_now,
    tangent_components,
    truth_at,
)
from fuselog.replay.judging.errors.evaluation import errors_of
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.metrics.metrics import ACCURACY

QUATERNION = ["quaternion"] * 4


def as_array(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def test_a_rotation_without_a_stem_has_a_sensible_name():
    """By the old one it is still found where a person wrote it."""
    two = ["qw", "qx", "qy", "qz", "pw", "px", "py", "pz"]
    assert [name for name, _ in tangent_components(two, QUATERNION * 2)] == [
        *(f"rotation_{axis}_rad" for axis in "xyz"),
        *(f"pw_{axis}_rad" for axis in "xyz"),
    ]
    attitude = ["attw", "attx", "atty", "attz"]
    assert tangent_components(attitude, QUATERNION)[0] == ("att_x_rad", "rotation")
    given = {"qw_z_rad": 0.1, "rotation_x_rad": 0.2}
    assert named_now(given, two[:4], QUATERNION) == {"rotation_z_rad": 0.1, "rotation_x_rad": 0.2}


def test_errors_of_orientations_are_rotation_vectors_in_the_body_frame():
    """Against SciPy, for either sign of each quaternion."""
    generator = np.random.default_rng(0)
    truth = Rotation.random(50, rng=generator)
    error = generator.uniform(-1.7, 1.7, (50, 3))
    estimate = truth * Rotation.from_rotvec(error)
    signs = generator.choice([-1.0, 1.0], (2, 50, 1))
    found = difference(signs[0] * as_array(estimate), signs[1] * as_array(truth), QUATERNION)
    np.testing.assert_allclose(found, error, atol=1e-12)


def test_tiny_errors_keep_their_digits():
    turn = np.array([[1.0, 1e-9, 0.0, 0.0]])
    np.testing.assert_allclose(
        difference(turn, np.eye(4)[:1], QUATERNION), [[2e-9, 0.0, 0.0]], rtol=1e-12
    )


def test_an_axis_equals_its_negative():
    angle = np.array([0.1, 1.5, -1.5, 3.0])
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    truth = np.tile([-1.0, 0.0], (4, 1))
    expected = [[0.1], [1.5], [-1.5], [3.0 - np.pi]]
    np.testing.assert_allclose(difference(axes, truth, ["axis", "axis"]), expected, atol=1e-12)


def test_interpolation_is_slerp_by_the_short_way():
    generator = np.random.default_rng(1)
    ends = Rotation.random(2, rng=generator)
    weight = np.linspace(0.0, 1.0, 7)
    left, right = np.zeros(7, int), np.ones(7, int)
    expected = as_array(Slerp([0.0, 1.0], ends)(weight))
    for sign in (1.0, -1.0):
        found = between(as_array(ends) * [[1.0], [sign]], left, right, weight, QUATERNION)
        np.testing.assert_allclose(np.abs((found * expected).sum(axis=1)), 1.0, atol=1e-14)


def test_kinds_of_one_state_stand_side_by_side():
    mixed = ["linear", *QUATERNION, "angle", "axis", "axis"]
    names = ["x_m", "body_w", "body_x", "body_y", "body_z", "heading_rad", "line_x", "line_y"]
    assert are_kinds(mixed)
    assert not are_kinds(["quaternion"] * 3)
    assert not are_kinds(["axis", "linear", "axis"])
    assert [name for name, _ in tangent_components(names, mixed)] == [
        "x_m",
        "body_x_rad",
        "body_y_rad",
        "body_z_rad",
        "heading_rad",
        "line_rad",
    ]
    states = np.array([[1.0, 1, 0, 0, 0, 3.0, 1, 0], [3.0, 0, 1, 0, 0, -3.0, 0, 1]])
    half = between(states, np.array([0]), np.array([1]), np.array([0.5]), mixed)[0]
    np.testing.assert_allclose(half[:5], [2.0, 0.5**0.5, 0.5**0.5, 0, 0], atol=1e-12)
    assert abs(half[5]) == pytest.approx(np.pi)


def test_truth_over_a_gap_is_unknown():
    states = as_array(Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.4]]))
    truth = make_stream("/truth", schemas.TRUTH_STATE, [0, 10**8, 10**9], state=states)
    found = truth_at(truth, np.array([5 * 10**7, 5 * 10**8]), QUATERNION, 0.2)
    np.testing.assert_allclose(Rotation.from_quat(found[0], scalar_first=True).magnitude(), 0.1)
    assert np.isnan(found[1]).all()


def judged(kinds: list[str]):
    """Errors of estimates that are off by (.01, -.02, .02) rad sigma .01 rad each."""
    named = {"components": ",".join(f"body_{part}" for part in "wxyz"), "kinds": ",".join(kinds)}
    truth = Rotation.random(20, rng=np.random.default_rng(3))
    estimate = truth * Rotation.from_rotvec([0.01, -0.02, 0.02])
    time_ns = np.arange(20) * 10**7
    recording = Recording(
        [make_stream("/truth", schemas.TRUTH_STATE, time_ns, metadata=named, state=as_array(truth))], 0
    )
    estimates = make_stream(
        "/estimates/one/state",
        schemas.GAUSSIAN_ESTIMATE,
        time_ns,
        metadata={**named, "truth": "/truth"},
        mean=-as_array(estimate),
        covariance=np.tile(1e-4 * np.eye(3).ravel(), (20, 1)),
    )
    return errors_of(gather([estimates]), [Truths(memory_source(recording, RunMetadata("none")))])


def test_nees_and_total_error_are_those_of_the_rotation():
    errors = judged(QUATERNION)
    np.testing.assert_allclose(errors.nees, 9.0, rtol=1e-9)
    numbers = ACCURACY.of(errors)
    assert numbers["orientation_rmse_deg"] == pytest.approx(np.degrees(0.03))
    assert numbers["body_y_rmse_rad"] == pytest.approx(0.02)


def test_half_a_quaternion_is_bad_input():
    with pytest.raises(BadInput, match="a quaternion four"):
        judged(["quaternion", "quaternion", "quaternion", "linear"])


def test_of_no_component_at_all_nothing_is_said():
    """Neither an NEES, which would be zero, nor that a covariance is one."""
    none = np.empty((3, 0, 0))
    assert np.isnan(normalized_error_squared(np.empty((3, 0)), none)).all()
    assert not is_positive_definite(none).any()
