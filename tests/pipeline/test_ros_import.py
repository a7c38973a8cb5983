"""Bags of ROS from the command line and from Python."""

import re
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

import fuselog as fl
from fuselog.pipeline.api.estimates import judge_estimates
from fuselog.recorders.recording import import_log
from fuselog.replay.engine import chi2
from tests.recorders.test_ros import START_NS, STEP_NS, Maker, Sent, imported, refusal, write_bag
from tests.replay.timeline.test_timeline import read


@pytest.mark.paper
def test_a_bag_becomes_a_log_and_info_says_how(
    fuselog: Callable[..., Any], real_data: Path, tmp_path: Path
) -> None:
    """`info` leads to `import`, whose log is what Python imports; a refused one leaves nothing."""
    bag, out = real_data / "nav2_turtlebot.mcap", tmp_path / "nav.mcap"
    told = fuselog("info", str(bag))
    assert told.code == 0
    assert f"fuselog import ros {bag} -o NAME.mcap" in told.out
    said = fuselog("import", "ros", str(bag), "-o", str(out), "--clock", "bag")
    assert said.code == 0
    assert "/odom: 2639 nav_msgs/msg/Odometry as /odometry, /odometry_twist, /odometry_pose" in said.out
    log, direct = fl.open(out), fl.import_("ros", bag, clock="bag")
    assert log.run.parameters["clock"] == "bag"
    assert set(log) == set(direct)
    assert_array_equal(log["/pose"]["position_m"], direct["/pose"]["position_m"])
    refused = tmp_path / "refused.mcap"
    hole = fuselog("import", "ros", str(bag), "-o", str(refused), "--set", "transforms=map:nowhere")
    assert hole.code == 2
    assert hole.err.count("\n") == 1
    assert "no transform has the frame 'nowhere'" in hole.err
    assert not refused.exists()
    none = fuselog("import", "mrclam", str(tmp_path), "-o", str(refused), "--clock", "bag")
    assert (none.code, "no parameter 'clock'" in none.err) == (2, True)


def test_info_of_a_bag_that_is_no_mcap(
    fuselog: Callable[..., Any], real_data: Path, tmp_path: Path
) -> None:
    """Topics, types and counts of a folder and a .db3 file; nothing beside them is made."""
    with tarfile.open(real_data / "trajectories.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    folder = tmp_path / "trajectories" / "tf_example"
    before = sorted(folder.iterdir())
    for path in (folder, folder / "tf_example.db3"):
        told = fuselog("info", str(path))
        assert told.code == 0
        assert "tf2_msgs/msg/TFMessage" in told.out
        assert "517" in told.out
        assert f"fuselog import ros {path}" in told.out
        assert fuselog("info", str(path), "--json").json["topics"][1]["messages"] == 517
    assert sorted(folder.iterdir()) == before


@pytest.mark.paper
def test_from_the_bag_to_a_picture(fuselog: Callable[..., Any], real_data: Path, tmp_path: Path) -> None:
    """No line of own code: odometry with the poses of AMCL, and alone; both clocks on the timeline."""
    log, rrd, estimates = (tmp_path / name for name in ("nav.mcap", "nav.rrd", "estimates.mcap"))
    bag = str(real_data / "nav2_turtlebot.mcap")
    assert fuselog("import", "ros", bag, "-o", str(log)).code == 0
    said = fuselog("info", str(log), "--all").out
    assert "robot: -e ekf iekf ukf lrkf sqrt smoother bank particles; from /odometry, /pose" in said
    assert "vehicle: needs prior (fuselog.GaussianEstimate) of x_m, vx_mps, y_m, vy_mps; fix" in said
    shorter = fuselog("info", str(log)).out
    assert "robot: -e" in shorter
    assert "vehicle: needs" not in shorter
    assert re.search(r"^  .*vehicle.*: do not fit; --all lists what they need$", shorter, re.MULTILINE)
    both = ["-e", "ekf", "-e", "smoother:ekf"]
    done = fuselog("replay", str(log), *both, "--save", str(rrd), "-o", str(estimates))
    assert done.code == 0
    for words in (
        "ekf: the log has no prior (/prior): the estimate starts at the first message of /pose",
        "smoother:ekf: no channel states turn_noise_density: 0.05 is assumed; --set turn_noise_density=",
    ):
        assert words in done.out
    source, made = fl.open(log), fl.open(estimates)
    poses = made["/estimates/smoother:ekf/pose"]
    seen = source["/pose"]
    rows = np.searchsorted(poses.publish_time_ns, seen.publish_time_ns)
    apart_m = np.hypot(*(poses["mean"][rows, :2] - seen["position_m"][:, :2]).T)
    assert len(rows) == 135
    assert np.median(apart_m) < 0.1
    drawn, driven = read(rrd)["/plots/odometry/forward_mps/forward_mps"], source["/odometry"]
    assert_array_equal(drawn["utc"], driven.log_time_ns)
    assert_array_equal(drawn["sim_time"], driven.publish_time_ns - seen.publish_time_ns[0])
    alone = fuselog("replay", str(log), "-e", "ekf", "--set", "topics.pose=", "-o", str(estimates))
    assert alone.code == 0
    assert "the estimate starts at zero, the origin of its frame" in alone.out
    own = source["/odometry_pose"]
    steps_m = np.hypot(*np.diff(own["position_m"][:, :2], axis=0).T)
    reckoned = fl.open(estimates)["/estimates/ekf/pose"]["mean"]
    assert len(reckoned) == 2639
    assert np.hypot(*np.diff(reckoned[:, :2], axis=0).T).sum() == pytest.approx(steps_m.sum(), rel=0.01)


def test_an_imported_odometry_is_replayed(real_data: Path, tmp_path: Path) -> None:
    """Dead reckoning over the odometry comes to where the robot's own reckoning does."""
    source = fl.import_("ros", real_data / "nav2_turtlebot.mcap")
    own = source["/odometry_pose"]
    w, x, y, z = own["quaternion"].T
    heading_rad = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    begin = [[*own["position_m"][0, :2], heading_rad[0]]]
    prior = fl.make_stream(
        "/prior",
        fl.schemas.GAUSSIAN_ESTIMATE,
        own.publish_time_ns[:1],
        metadata={"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"},
        mean=begin,
        covariance=[np.diag([1e-4, 1e-4, 1e-4]).ravel()],
    )
    path = tmp_path / "with-prior.mcap"
    fl.write(path, [*(source[topic] for topic in ("/odometry", "/odometry_pose")), prior])
    settings = {"forward_noise_density": 0.01, "turn_noise_density": 0.01, "kind": "dead-reckoning"}
    replay = fl.replay(path, {"reckoned": settings})
    (topic,) = [each for each in replay.estimates[0] if each.endswith("/pose")]
    reckoned = replay.estimates[0][topic]
    rows = np.searchsorted(own.publish_time_ns, reckoned.publish_time_ns)
    apart_m = np.hypot(*(reckoned["mean"][:, :2] - own["position_m"][rows, :2]).T)
    travelled_m = np.hypot(*np.diff(own["position_m"][:, :2], axis=0).T).sum()
    assert travelled_m > 10.0
    assert apart_m.max() < 0.02 * travelled_m


def test_the_poses_of_another_filter_are_judged(tmp_path: Path) -> None:
    """NEES of a filter whose odometry states right covariances, about the fixed axes as ROS has them."""
    make, rng, sent = Maker(), np.random.default_rng(0), list[Sent]()
    covariance = np.diag([0.01, 0.04, 0.09, 1e-4, 4e-4, 0.04])
    for step in range(300):
        at = START_NS + step * STEP_NS
        turn = Rotation.from_euler("zyx", [0.05 * step, 0.8 * np.sin(0.07 * step), np.cos(0.05 * step)])
        error = rng.multivariate_normal(np.zeros(6), covariance)
        estimate = Rotation.from_rotvec(error[3:]) * turn
        poses = (
            ("/odometry/filtered", "nav_msgs/msg/Odometry", "pose__pose", error[:3], estimate),
            ("/mocap", "geometry_msgs/msg/PoseStamped", "pose", np.zeros(3), turn),
        )
        for topic, name, path, place, orientation in poses:
            given = {f"{path}__position__{axis}": float(place[i]) for i, axis in enumerate("xyz")}
            given |= {
                f"{path}__orientation": orientation.as_quat(),
                "pose__covariance": covariance.ravel(),
            }
            sent.append((topic, at, make(name, at, **given)))
    path = write_bag(tmp_path / "bag", "mcap", sent, make.store)
    settings = {"estimates": "/odometry/filtered", "truth": "/mocap"}
    streams, notes = imported(path, **settings)
    assert set(streams) == {"/truth", "/estimates/odometry_filtered/pose"}
    why = "since filters must not use data from another filter"
    assert notes[f"/odometry/filtered: odometry_twist left out, {why}"] == "300"
    import_log("ros", path, settings, tmp_path / "log.mcap")
    judged = judge_estimates([tmp_path / "log.mcap"], comparison={}).judge.metrics
    low, high = np.asarray(chi2.ppf(np.array([0.025, 0.975]), 6 * 300)) / 300
    assert low < judged["odometry_filtered.nees"] < high
    assert "has no topic /mocup" in refusal(path, estimates="/mocup")
