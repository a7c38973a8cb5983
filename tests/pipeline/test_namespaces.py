"""A bag whose sensors have a namespace each, and a truth table in the plane of a stated origin."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from tests.pipeline.test_planes import HERE, POSE, SIGMA_M, STAMPS_NS, car, driven
from tests.recorders.test_ros import Maker, Sent, write_bag

pytestmark = pytest.mark.usefixtures("blank_figures")

SIGMA_MPS, SIGMA_RADPS = 0.05, 0.02
TRUTH = f"""
[origin]
latitude_deg = {HERE.latitude_deg}
longitude_deg = {HERE.longitude_deg}
[[tables]]
files = "truth.csv"
time = {{ column = "t", unit = "s" }}
[[tables.streams]]
topic = "/survey/truth"
becomes = "TruthState"
fields = {{ state = ["east", "north", "heading"] }}
components = "x_m,y_m,heading_rad"
kinds = "linear,linear,angle"
"""


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Odometry on /wheel/odom, fixes on /gps/fix, an inertial unit on /imu/data, beside truth.csv."""
    folder, make, rng = tmp_path_factory.mktemp("bag"), Maker(), np.random.default_rng(10)
    poses, velocity = driven()
    measured = velocity + rng.normal(size=velocity.shape) * [SIGMA_MPS, SIGMA_RADPS]
    sent: list[Sent] = []
    twist = np.diag([SIGMA_MPS**2, 1e-3, 1e-3, 1e-3, 1e-3, SIGMA_RADPS**2]).ravel()
    for stamp_ns, (forward, turn) in zip(STAMPS_NS.tolist(), measured.tolist(), strict=True):
        given: dict[str, Any] = dict.fromkeys(
            [f"twist__twist__{of}__{axis}" for of in ("linear", "angular") for axis in "xyz"], 0.0
        )
        given |= {"twist__twist__linear__x": forward, "twist__twist__angular__z": turn}
        odometry = make("nav_msgs/msg/Odometry", stamp_ns, twist__covariance=twist, **given)
        sent.append(("/wheel/odom", stamp_ns, odometry))
        unit = {
            "linear_acceleration": {"x": 0.0, "y": 2.0 * turn, "z": 9.82},
            "angular_velocity": {"x": 0.0, "y": 0.0, "z": turn},
        }
        sample = make(
            "sensor_msgs/msg/Imu",
            stamp_ns,
            **{f"{of}__{axis}": value for of, each in unit.items() for axis, value in each.items()},
            linear_acceleration_covariance=(0.01 * np.eye(3)).ravel(),
            angular_velocity_covariance=[0.0] * 9,
        )
        sent.append(("/imu/data", stamp_ns, sample))
    rows = slice(0, None, 20)
    seen = poses[rows, :2] + SIGMA_M * rng.normal(size=(len(poses[rows]), 2))
    places = zip(*out_of_tangent_plane(seen.T, HERE), STAMPS_NS[rows].tolist(), strict=True)
    for latitude, longitude, altitude, stamp_ns in places:
        fix = make(
            "sensor_msgs/msg/NavSatFix",
            stamp_ns,
            latitude=float(latitude),
            longitude=float(longitude),
            altitude=float(altitude),
            position_covariance=(SIGMA_M**2 * np.eye(3)).ravel(),
            position_covariance_type=2,
        )
        sent.append(("/gps/fix", stamp_ns, fix))
    write_bag(folder / "bag", "mcap", sorted(sent, key=lambda each: each[1]), make.store)
    table = np.column_stack([STAMPS_NS * 1e-9, poses])
    np.savetxt(folder / "truth.csv", table, "%.6f", ",", header="t,east,north,heading", comments="")
    (folder / "truth.toml").write_text(TRUTH)
    return folder


@pytest.fixture(scope="module")
def log(bag: Path, fuselog: Callable[..., Any]) -> Path:
    """Bag and table imported, and merged."""
    for command in (
        ("import", "ros", bag / "bag", "-o", bag / "sensors.mcap"),
        (
            "import",
            "table",
            bag / "truth.csv",
            "--mapping",
            bag / "truth.toml",
            "-o",
            bag / "truth.mcap",
        ),
        ("merge", bag / "sensors.mcap", bag / "truth.mcap", "-o", bag / "log.mcap"),
    ):
        done = fuselog(*command)
        assert done.code == 0, done.err
    return bag / "log.mcap"


@pytest.mark.paper
def test_three_namespaces_and_a_truth_are_one_robot(fuselog: Callable[..., Any], log: Path) -> None:
    """It is judged right without an alignment, and what is not used is named with what would use it."""
    told = fuselog("info", log).out
    assert "robot: -e ekf" in told
    assert "from /wheel/odometry, /gps/fix" in told
    both = fuselog("replay", log, "-e", "ekf")
    assert both.code == 2
    assert "models inertial and robot fit this log; choose with --model" in both.err
    replay = ("replay", log, "-e", "ekf", "--model", "robot")
    said = fuselog(*replay, "--json")
    assert said.code == 0, said.err
    metrics = said.json["metrics"]
    assert metrics["ekf.position_rmse_m.wheel"] < SIGMA_M
    assert 1.5 < metrics["ekf.nees.wheel"] < 5.0
    unused = "the estimator does not use this topic; with --set topics.turn_rate=/imu/inertial it does"
    printed = fuselog(*replay).out
    assert f"/imu/inertial: 1200 of 1200 not used: {unused}" in printed
    assert "is assumed" not in printed  # the noise of the wheels is that of their covariance
    assert "/wheel/odometry: forward_noise_density: 0.0111803, of a standard deviation of 0.05" in told
    pose = fl.open(log.with_suffix(".estimates.mcap"))["/estimates/ekf/wheel/pose"]
    assert pose.metadata["truth"] == "/survey/truth"
    assert pose.metadata["origin_latitude_deg"] == "60.0"


def test_two_of_a_kind_are_not_taken_unasked(fuselog: Callable[..., Any], tmp_path: Path) -> None:
    """A second receiver: neither is the robot's until one is named. Two odometries are two robots."""
    odometry, fix, truth = car(HERE.metadata, HERE.metadata)
    path, twice = tmp_path / "receivers.mcap", tmp_path / "robots.mcap"
    prior = fl.make_stream(
        "/prior",
        fl.schemas.GAUSSIAN_ESTIMATE,
        STAMPS_NS[:1],
        metadata=POSE,
        mean=driven()[0][:1],
        covariance=[np.diag([1.0, 1.0, 0.01]).ravel()],
    )
    wheel, receivers = replace(odometry, topic="/wheel/odometry"), ("/gps1/fix", "/gps2/fix")
    fixes = [replace(fix, topic=topic) for topic in receivers]
    fl.write(path, [wheel, *fixes, replace(truth, topic="/truth"), prior])
    said = fuselog("replay", path, "-e", "ekf")
    assert said.code == 0, said.err
    takes = f"with --set topics.fix={','.join(receivers)} it does"
    for topic in receivers:
        assert f"{topic}: 60 of 60 not used: the estimator does not use this topic; {takes}" in said.out
    one = fuselog("replay", path, "-e", "ekf", "--set", "topics.fix=/gps1/fix", "--json")
    assert one.json["metrics"]["ekf.position_rmse_m.wheel"] < SIGMA_M
    assert one.json["metrics"]["ekf.nis_per_component.wheel"] == pytest.approx(1.0, abs=0.5)
    fl.write(twice, [wheel, odometry, fixes[0], replace(prior, topic="/wheel/prior")])
    told = fuselog("replay", twice, "-e", "ekf", "-o", tmp_path / "estimates.mcap")
    assert told.code == 0, told.err
    assert set(fl.open(tmp_path / "estimates.mcap")) >= {
        "/estimates/ekf/wheel/pose",
        "/estimates/ekf/car/pose",
    }
    assert "ekf: /gps1/fix: 60 of 60 not used" in told.out
