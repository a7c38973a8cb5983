"""Robots that share positions: one sighting against the library, and the sheet on MRCLAM set 6."""

import numpy as np
import pytest

from fuselog.pipeline.runs.recorded import replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.models.planar import range_bearing
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.metrics.metrics import ACCURACY, CONSISTENCY
from tests.bench.reference.landmarks import range_bearing_jacobian
from tests.replay.families.networks.test_covariance_intersection import fuse_sighting

pytestmark = pytest.mark.paper

POSES = np.array([[0.0, 0.0, 0.3], [2.0, 1.0, -1.0]])
COVARIANCES = np.array(
    [
        [[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]],
        [[0.25, -0.05, 0.01], [-0.05, 0.16, 0.0], [0.01, 0.0, 0.04]],
    ]
)
SEEN = np.array([2.4, 0.2])
SIGMAS = np.array([0.1, 0.05])


def two_robots(seen=SEEN):
    """Robot 1 sees robot 2 once; nothing moves."""
    streams = [
        make_stream("/landmarks", schemas.LANDMARK, [0], landmark_id=[9], position_m=[[5.0, 5.0]])
    ]
    for robot in (1, 2):
        noise = {"forward_noise_density": "0", "turn_noise_density": "0"}
        streams += [
            make_stream(
                f"/robot{robot}/prior",
                schemas.GAUSSIAN_ESTIMATE,
                [0],
                metadata={"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"},
                mean=POSES[robot - 1 : robot],
                covariance=COVARIANCES[robot - 1].reshape(1, 9),
            ),
            make_stream(
                f"/robot{robot}/odometry",
                schemas.ODOMETRY,
                [2],
                metadata=noise,
                forward_mps=[0.0],
                turn_radps=[0.0],
            ),
            make_stream(
                f"/robot{robot}/range_bearing",
                schemas.RANGE_BEARING,
                [1] if robot == 1 else [],
                metadata={"sigma_range_m": str(SIGMAS[0]), "sigma_bearing_rad": str(SIGMAS[1])},
                target_id=[2] if robot == 1 else [],
                range_m=[seen[0]] if robot == 1 else [],
                bearing_rad=[seen[1]] if robot == 1 else [],
            ),
        ]
    return memory_source(Recording(streams), RunMetadata("two robots", {}, 0, 0, 0))


def estimates(source, mode, **parameters):
    bound = bind("cooperative", [source], {"mode": mode, "anchors": (), **parameters})
    outputs = collect(replay([source], bound))
    poses = [outputs[f"/estimates/cooperative/robot{robot}/pose"] for robot in (1, 2)]
    return [(pose["mean"][0], pose["covariance"][0].reshape(3, 3)) for pose in poses]


def linearised():
    """The sighting's innovation and its rows by both robots' poses."""
    expected = range_bearing(POSES[0], POSES[1, :2])
    rows = np.array(range_bearing_jacobian(POSES[0], POSES[1, :2]))
    by_seen = np.hstack([-rows[:, :2], np.zeros((2, 1))])
    return SEEN - expected, (rows, by_seen)


@pytest.mark.parametrize("criterion", ["trace", "determinant"])
def test_ci_of_one_sighting_is_the_librarys(criterion):
    """Each robot takes it as a measurement of itself that rests on the other one's old estimate."""
    innovation, rows = linearised()
    for side, (mean, covariance) in enumerate(estimates(two_robots(), "ci", criterion=criterion)):
        shared = rows[1 - side] @ COVARIANCES[1 - side] @ rows[1 - side].T
        noise = np.diag(SIGMAS**2)
        expected = fuse_sighting(
            POSES[side], COVARIANCES[side], rows[side], innovation, shared, noise, criterion
        )
        # the weight is found to the root of rounding
        np.testing.assert_allclose(mean, expected[0], rtol=1e-6)
        np.testing.assert_allclose(covariance, expected[1], rtol=1e-6, atol=1e-9)


def test_naive_and_joint_fusion_of_one_sighting_are_the_textbooks():
    innovation, rows = linearised()
    whole, both = np.zeros((6, 6)), np.hstack(rows)
    whole[:3, :3], whole[3:, 3:] = COVARIANCES
    gain = whole @ both.T @ np.linalg.inv(both @ whole @ both.T + np.diag(SIGMAS**2))
    mean, covariance = POSES.ravel() + gain @ innovation, whole - gain @ both @ whole
    for mode in ("joint", "naive"):  # alike after the first one
        for side, found in enumerate(estimates(two_robots(), mode)):
            part = slice(3 * side, 3 * side + 3)
            np.testing.assert_allclose(found[0], mean[part], rtol=1e-9)
            np.testing.assert_allclose(found[1], covariance[part, part], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("mode", ["ci", "naive", "joint"])
def test_an_impossible_sighting_changes_nothing(mode):
    """CI may take it where it is worth nothing, at a weight that leaves it no influence."""
    source = two_robots(SEEN + np.array([50.0, 0.0]))
    for side, (mean, covariance) in enumerate(estimates(source, mode)):
        np.testing.assert_allclose(mean, POSES[side], atol=1e-6)
        np.testing.assert_allclose(covariance, COVARIANCES[side], atol=1e-7)


@pytest.mark.parametrize("mode", ["ci", "naive", "joint"])
def test_a_sighting_on_the_very_spot_changes_nothing(mode, monkeypatch):
    """Where both robots are thought to be in one place it has no bearing, and no derivative."""
    monkeypatch.setattr(f"{__name__}.POSES", np.array([POSES[0], POSES[0]]))
    for side, (mean, covariance) in enumerate(estimates(two_robots(), mode)):
        np.testing.assert_array_equal(mean, POSES[side])
        np.testing.assert_array_equal(covariance, COVARIANCES[side])


def test_an_anchor_that_is_not_there_is_refused():
    with pytest.raises(BadInput, match="anchor 3 is not one of the robots 1, 2"):
        bind("cooperative:ci", [two_robots()], {})


@pytest.fixture(scope="module")
def judged(mrclam6_log):
    found = {}
    for mode in ("alone", "naive", "ci", "joint"):
        estimators = {mode: {"kind": f"cooperative:{mode}"}}
        errors = replay_ensemble([mrclam6_log], estimators, gap_limit_s=0.2).errors
        rmse = np.array([ACCURACY.of(each)["position_rmse_m"] for each in errors])
        found[mode] = rmse, np.array([CONSISTENCY.of(each)["position_nees"] for each in errors])
    return found


def test_ci_is_consistent_and_naive_fusion_is_not(judged):
    assert judged["ci"][1].max() <= 2.5
    assert judged["naive"][1].mean() > 2 * judged["ci"][1].mean()
    assert judged["naive"][1].min() > 4


def test_robots_without_a_map_gain_by_those_they_meet(judged):
    alone, ci = judged["alone"][0], judged["ci"][0]
    assert np.all(ci < 0.5)
    assert np.all(ci[[0, 1, 3, 4]] < 0.3 * alone[[0, 1, 3, 4]])


def test_rmse_of_ci_and_of_the_joint_filter_are_the_sheets(judged):
    np.testing.assert_allclose(judged["ci"][0], [0.22, 0.31, 0.16, 0.42, 0.31], rtol=0.12)
    np.testing.assert_allclose(judged["joint"][0], [0.16, 0.21, 0.14, 0.24, 0.18], rtol=0.1)
