"""APE, RPE, alignment and association: by their definitions, and evo's own numbers on its own files."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.trajectories import Trajectory, read_trajectory
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.engine.vectors.tangent import difference
from fuselog.replay.judging.errors.alignment import Alignment, aligned, aligned_estimates, alignment_of
from fuselog.replay.judging.errors.trajectories import (
    Comparison,
    compare,
    estimated_offset_s,
    statistics,
    trajectory_metrics,
)
from fuselog.replay.judging.errors.trajectory_streams import trajectory_of

SECOND = 1_000_000_000


def walk(count: int = 200, seed: int = 0) -> Trajectory:
    """A smooth way through space."""
    generator = np.random.default_rng(seed)
    steps = np.cumsum(generator.normal(size=(count, 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(generator.normal(scale=0.1, size=(count, 3)), axis=0))
    times = 10 * SECOND + np.arange(count) * (SECOND // 10)
    return Trajectory("walk", np.cumsum(0.01 * steps, axis=0), turns.as_matrix(), times)


def disturbed(truth: Trajectory, alignment: Alignment, noise_m: float = 0.02) -> Trajectory:
    """The truth with noise, in a frame from which the alignment leads back."""
    generator = np.random.default_rng(1)
    noisy = truth.position_m + generator.normal(scale=noise_m, size=truth.position_m.shape)
    turned = (noisy - alignment.translation_m) / alignment.scale @ alignment.rotation
    return replace(truth, position_m=turned, rotation=alignment.rotation.T @ truth.rotation)


KITTI_APE = {
    "rmse": 1.3034497,
    "mean": 1.1569971,
    "median": 1.0656248,
    "std": 0.6002823,
    "max": 3.5879491,
}


def test_kitti_as_evo_has_it(trajectories: Path) -> None:
    """All of evo's stored results, error by error; its RPE of that time lacks the first pair."""
    names = "KITTI_00_ORB.txt", "KITTI_00_gt.txt"
    estimate, truth = (read_trajectory(trajectories / name) for name in names)
    done = compare(estimate, truth, Comparison("se3", 10.0, "m"))
    metrics = trajectory_metrics([done])
    for name, value in KITTI_APE.items():
        assert metrics[f"ape_translation_{name}_m"] == pytest.approx(value, abs=1e-7)
    assert metrics["ape_rotation_rmse_deg"] == pytest.approx(0.756300517, abs=1e-6)
    assert metrics["rpe_translation_rmse_m"] == pytest.approx(0.2367635, abs=1e-7)
    assert metrics["rpe_rotation_max_deg"] == pytest.approx(6.201584188, abs=1e-6)
    assert (metrics["poses"], metrics["rpe_pairs"]) == (4541, 354)
    for name, errors in (("ape", done.absolute_m), ("rpe", done.relative_m[1:])):
        with zipfile.ZipFile(trajectories / "res_files" / f"orb_{name}.zip") as stored:
            assert_allclose(errors, np.load(stored.open("error_array.npz")), atol=3e-7, rtol=0)
            told = json.loads(stored.read("stats.json"))
        assert statistics(errors) == pytest.approx(
            {key: told[key] for key in statistics(errors)}, abs=1e-6
        )


# What evo 1.38.1 says of freiburg1_xyz-rgbdslam_drift.txt: RMSE of APE (m, deg) and of RPE (m, deg) over
# 10 frames and over 0.5 m.
FREIBURG = {
    "none": [
        0.134185420489,
        36.177897051568,
        0.014610204866,
        0.701577033066,
        0.024082331200,
        0.909835517239,
    ],
    "se3": [
        0.013470118951,
        2.057702486683,
        0.014610204866,
        0.701577033066,
        0.024082331200,
        0.909835517239,
    ],
    "sim3": [
        0.013389416165,
        2.057702486683,
        0.014635787717,
        0.701577033066,
        0.024659760678,
        0.959249207607,
    ],
}


@pytest.mark.parametrize("align", list(FREIBURG))
def test_freiburg_as_evo_has_it(align: Any, trajectories: Path) -> None:
    names = "freiburg1_xyz-rgbdslam_drift.txt", "freiburg1_xyz-groundtruth.txt"
    estimate, truth = (read_trajectory(trajectories / name) for name in names)
    by_frames = compare(estimate, truth, Comparison(align, 10, "frames"))
    by_metres = compare(estimate, truth, Comparison(align, 0.5, "m"))
    errors = (
        *(by_frames.absolute_m, by_frames.absolute_deg, by_frames.relative_m, by_frames.relative_deg),
        *(by_metres.relative_m, by_metres.relative_deg),
    )
    found = [statistics(error)["rmse"] for error in errors if error is not None]
    assert found == pytest.approx(FREIBURG[align], abs=1e-9, rel=0)
    assert (len(by_frames.truth), by_frames.without_truth) == (785, 3)


def test_interpolated_as_evo_has_it(trajectories: Path) -> None:
    """Its limit is to the nearest pose, ours is the gap between two."""
    names = "freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt"
    estimate, truth = (read_trajectory(trajectories / name) for name in names)
    how = Comparison("se3", 10, association="interpolated", gap_limit_s=0.02)
    found = trajectory_metrics([compare(estimate, truth, how)])
    assert found["ape_translation_rmse_m"] == pytest.approx(0.013466959, abs=1e-7)
    assert found["rpe_translation_rmse_m"] == pytest.approx(0.014443918, abs=1e-7)
    assert found["ape_rotation_rmse_deg"] == pytest.approx(2.063553655, abs=1e-5)
    wider = compare(estimate, truth, replace(how, gap_limit_s=0.2))
    assert (found["poses"], len(wider.truth)) == (785, 788)


@pytest.mark.parametrize("align", ["yaw", "se2", "se3", "sim3"])
def test_alignments_are_the_best_of_their_kind(align: Any) -> None:
    """The known transform comes back, and no search finds a better one than where there is noise."""
    truth = walk()
    turn = [0.0, 0.0, 0.7] if align in ("yaw", "se2") else [0.4, -1.0, 2.0]
    shift = np.array([5.0, -2.0, 0.0 if align == "se2" else 3.0])
    scale = 1.7 if align == "sim3" else 1.0
    applied = Alignment(Rotation.from_rotvec(turn).as_matrix(), shift, scale)
    exact = disturbed(truth, applied, noise_m=0.0)
    found = alignment_of(exact.position_m, truth.position_m, align, "exact")
    for part, expected in zip(found, applied, strict=True):
        assert_allclose(part, expected, atol=1e-9)
    error = compare(exact, truth, Comparison(align))
    assert max(error.absolute_m.max(), error.relative_m.max()) < 1e-9
    assert error.absolute_deg is not None
    assert error.absolute_deg.max() < 1e-5

    noisy = disturbed(truth, applied)

    def squared_m2(parameters: np.ndarray) -> float:
        rotation = Rotation.from_rotvec(parameters[:3] * free[:3])
        at = Alignment(
            rotation.as_matrix(), parameters[3:6] * free[3:6], np.exp(parameters[6] * free[6])
        )
        return float(np.sum((aligned(noisy, at).position_m - truth.position_m) ** 2))

    free = np.array([turn[0] != 0, turn[1] != 0, 1, 1, 1, align != "se2", align == "sim3"], float)
    best = minimize(squared_m2, [*turn, *shift, np.log(scale)], method="BFGS")
    ours = compare(noisy, truth, Comparison(align))
    assert np.sum(ours.absolute_m**2) == pytest.approx(best.fun, rel=1e-6)


def test_reflections_are_no_rotations() -> None:
    """Where a mirror image would fit best (Umeyama, (43)), the best rotation is found."""
    truth = walk().position_m
    rotation = alignment_of(truth * [1, 1, -1], truth, "se3", "mirrored").rotation
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_relative_errors_by_hand() -> None:
    """A drift of 1 % along the way, over delta in each unit; pairs begin where the last one ended."""
    count = 41
    truth = np.zeros((count, 3))
    truth[:, 0] = 0.5 * np.arange(count)
    stamps = np.arange(count) * (SECOND // 4)
    rotation = Rotation.from_euler("z", np.arange(count)[:, None], degrees=True).as_matrix()
    true = Trajectory("truth", truth, np.tile(np.eye(3), (count, 1, 1)), stamps)
    estimate = Trajectory("estimate", 1.01 * truth, np.tile(np.eye(3), (count, 1, 1)), stamps)
    for delta, unit, poses in ((8, "frames", 8), (2.0, "s", 8), (4.0, "m", 8), (4.1, "m", 9)):
        done = compare(estimate, true, Comparison("none", delta, unit))  # type: ignore[arg-type]
        assert done.last.tolist() == list(range(poses, count, poses))
        assert_allclose(done.relative_m, 0.01 * 0.5 * poses)
    turned = compare(replace(estimate, rotation=rotation), true, Comparison("none", 8))
    assert turned.relative_deg is not None
    assert_allclose(turned.relative_deg, 8.0)
    # seen from the first pose: the turned estimate goes another way
    angle = np.radians(np.arange(0, count - 8, 8))
    expected = np.hypot(4.04 * np.cos(angle) - 4.0, 4.04 * np.sin(angle))
    assert_allclose(turned.relative_m, expected)


@pytest.mark.paper
@pytest.mark.parametrize("offset_s", [0.0, 0.437, -7.0])
def test_a_time_offset_is_found(offset_s: float) -> None:
    truth = walk(1000)
    estimate = disturbed(truth, Alignment(Rotation.from_rotvec([0, 1, 0.5]).as_matrix(), np.ones(3)))
    late = replace(estimate, time_ns=estimate.time_ns - round(offset_s * 1e9)).take(np.arange(100, 800))
    found = estimated_offset_s(late, truth, "se3")
    assert found == pytest.approx(offset_s, abs=0.01)
    how = Comparison("se3", association="interpolated", time_offset_s="estimate")
    done = compare(late, truth, how)
    assert (done.time_offset_s, len(done.truth)) == (found, 700)
    assert statistics(done.absolute_m)["rmse"] < 0.04


def test_an_offset_that_speeds_do_not_tell_is_found_by_the_positions() -> None:
    """A speed that grows evenly correlates with itself at every lag."""
    time_s = np.linspace(0, 20, 201)
    spiral = np.stack([time_s * np.cos(time_s), time_s * np.sin(time_s), 0.1 * time_s], axis=1)
    stamps = np.rint(time_s * 1e9).astype(np.int64)
    truth = Trajectory("truth", spiral, time_ns=stamps)
    noise = np.random.default_rng(3).normal(scale=0.05, size=spiral.shape)
    estimate = Trajectory("estimate", spiral + noise, time_ns=stamps + SECOND)
    for align in ("none", "se3", "sim3"):
        found = estimated_offset_s(estimate, truth, align)  # type: ignore[arg-type]
        assert found == pytest.approx(-1.0, abs=0.02)  # aligned, a shift in time is nearly a turn


@pytest.mark.parametrize("sigma_m", [0.02, 0.5])
def test_an_offset_ends_where_the_error_is_least(sigma_m: float) -> None:
    """Of laps whose speed repeats, and is lost in the noise of single poses."""
    rng, time_s = np.random.default_rng(7), np.arange(0.0, 60.0, 0.05)
    turn = 2.0 * np.pi / 7.0 * time_s
    lap = 4.0 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    way = lap * (1.0 + 0.2 * np.cos(turn))[:, None] + np.outer(time_s, [0.05, 0.0, 0.0])
    stamps = np.rint(time_s * 1e9).astype(np.int64)
    noisy = way[:900] + rng.normal(scale=sigma_m, size=(900, 3))
    estimate = Trajectory("estimate", noisy, time_ns=stamps[:900] + 3 * SECOND // 10)
    found = estimated_offset_s(estimate, Trajectory("truth", way, time_ns=stamps), "none")
    assert found == pytest.approx(-0.3, abs=0.03)


def test_an_offset_that_does_not_help_is_not_added() -> None:
    truth = walk(400)
    done = compare(truth, truth, Comparison(time_offset_s="estimate"))
    assert (done.time_offset_s, done.absolute_m.max()) == (0.0, 0.0)


def test_offsets_of_real_data(trajectories: Path) -> None:
    names = "freiburg1_xyz-rgbdslam_drift.txt", "freiburg1_xyz-groundtruth.txt"
    estimate, truth = (read_trajectory(trajectories / name) for name in names)
    own = estimated_offset_s(estimate, truth, "se3")
    assert abs(own) < 0.02
    shifted = replace(estimate, time_ns=estimate.time_ns - 350_000_000)
    assert estimated_offset_s(shifted, truth, "se3") == pytest.approx(own + 0.35, abs=1e-3)


def test_what_cannot_be_compared_is_told() -> None:
    truth = walk(50)
    line = Trajectory("line", np.outer(np.arange(50), [1.0, 2.0, 3.0]), time_ns=truth.time_ns)
    few = truth.take(np.arange(2))
    bare = replace(truth, time_ns=None)
    for estimate, true, how, words in (
        (line, line, {"align": "se3"}, ("line", "50 poses", "three not on one line")),
        (few, truth, {"align": "sim3"}, ("2 poses", "three not on one line")),
        (few.take(np.arange(1)), truth, {"align": "yaw"}, ("1 poses", "two different horizontal")),
        (
            replace(truth, time_ns=truth.time_ns + 10 * SECOND),
            truth,
            {},
            ("has no stamps within", "0.01 s"),
        ),
        (bare.take(np.arange(9)), truth, {}, ("no stamps", "9", "50", "give both with stamps")),
        (truth, truth, {"delta": 0}, ("delta is 0", "positive")),
        (truth, truth, {"delta": 1.5}, ("delta is 1.5 frames", "whole number")),
        (truth, truth, {"delta": 1e6, "delta_unit": "m"}, ("m long", "delta smaller than 1e+06")),
        (bare, bare, {"delta_unit": "s"}, ("has no stamps",)),
        (bare, bare, {"time_offset_s": "estimate"}, ("has no stamps",)),
        (truth, bare, {"time_offset_s": 1.0}, ("has no stamps",)),
        (line, truth, {"time_offset_s": "estimate"}, ("line", "speed never changes")),
        (truth, truth.take(np.arange(0)), {}, ("walk: has no poses",)),
        (truth, truth, {"align": "se4"}, ("align is 'se4'", "did you mean 'se3'")),
        (truth, truth, {"gap_limit_s": -1}, ("gap_limit_s is -1",)),
    ):
        with pytest.raises(BadInput) as raised:
            compare(estimate, true, Comparison(**how))  # type: ignore[arg-type]
        assert all(word in str(raised.value) for word in words), raised.value


def test_estimates_carry_their_covariance_through_the_alignment() -> None:
    """NEES against a truth in another frame is that against the truth in the estimate's own."""
    generator = np.random.default_rng(5)
    names = ["x_m", "vx_mps", "y_m", "vy_mps", "z_m", "vz_mps", "q_w", "q_x", "q_y", "q_z", "bias_mps2"]
    kinds = ["linear"] * 6 + ["quaternion"] * 4 + ["linear"]
    metadata = {"components": ",".join(names), "kinds": ",".join(kinds)}
    count, size = 30, 10

    def states() -> np.ndarray:
        state = generator.normal(size=(count, len(names)))
        state[:, 6:10] /= np.linalg.norm(state[:, 6:10], axis=1, keepdims=True)
        return state

    truth, mean = states(), states()
    root = generator.normal(size=(count, size, size))
    covariance = root @ root.transpose(0, 2, 1)
    fields = {"mean": mean, "covariance": covariance.reshape(count, -1)}
    stream = make_stream(
        "/estimates/e/pose", schemas.GAUSSIAN_ESTIMATE, np.arange(count), metadata=metadata, **fields
    )
    alignment = Alignment(Rotation.random(rng=generator).as_matrix(), np.array([1.0, 2, 3]), 2.5)
    moved = aligned_estimates(stream, alignment)
    true = {"mean": truth, "covariance": fields["covariance"]}
    there = aligned_estimates(replace(stream, columns={**stream.columns, **true}), alignment)["mean"]
    before = normalized_error_squared(difference(mean, truth, kinds), covariance)
    error = difference(moved["mean"], there, kinds)
    after = normalized_error_squared(error, moved["covariance"].reshape(count, size, size))
    assert_allclose(after, before, rtol=1e-9)
    path, path_there = trajectory_of(stream), trajectory_of(moved)
    assert path is not None
    assert path_there is not None
    assert_allclose(aligned(path, alignment).position_m, path_there.position_m)
    assert_allclose(aligned(path, alignment).rotation, path_there.rotation, atol=1e-12)


def test_a_planar_state_stays_in_its_plane() -> None:
    metadata = {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"}
    poses = np.array([[1.0, 0.0, 3.0], [0.0, 2.0, -1.0]])
    stream = make_stream(
        "/pose",
        schemas.GAUSSIAN_ESTIMATE,
        [0, 1],
        metadata=metadata,
        mean=poses,
        covariance=np.tile(np.diag([1.0, 4.0, 9.0]).ravel(), (2, 1)),
    )
    quarter = Alignment(Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix(), np.array([0.0, 10, 5]))
    moved = aligned_estimates(stream, quarter)
    assert_allclose(
        moved["mean"], [[0, 11, 3 + np.pi / 2 - 2 * np.pi], [-2, 10, np.pi / 2 - 1]], atol=1e-12
    )
    assert_allclose(moved["covariance"][0], np.diag([4.0, 1.0, 9.0]).ravel(), atol=1e-12)
    flipped = Alignment(Rotation.from_rotvec([np.pi, 0, 0]).as_matrix())
    with pytest.raises(BadInput, match="topic /pose: is planar, and the alignment would rotate it out"):
        aligned_estimates(stream, Alignment(Rotation.from_rotvec([1.0, 0, 0]).as_matrix()))
    with pytest.raises(BadInput, match="out of its plane"):
        aligned_estimates(stream, flipped)
