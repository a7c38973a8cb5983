"""A robot with odometry and what else a bag may have: poses, fixes, headings, a gyro; no prior."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from fuselog.pipeline.runs.initial_states import start_from
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.planar import drive, wrap_angle
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.estimators.dead_reckoning import RECKONING
from fuselog.replay.estimators.landmarks import (
    ROBOT,
    LocalizationParameters,
    align,
    antenna,
)
from tests.replay.inference.replays import bound, outputs

Floats = NDArray[np.float64]
STEPS, STEP_NS, EPOCH_NS = 60, 200_000_000, 5 * 10**9
STAMPS = EPOCH_NS + STEP_NS * np.arange(STEPS)
SLOW = STAMPS[7::10]
SIGMA = np.array([0.3, 0.2, 0.05])
# Of x, y and the turn about z; what a pose says of the others is larger, and correlated with them.
SPREAD = np.diag(SIGMA) @ [[1.0, 0.5, -0.3], [0.5, 1.0, 0.2], [-0.3, 0.2, 1.0]] @ np.diag(SIGMA)


pytestmark = pytest.mark.usefixtures("uncompiled")


def poses() -> Floats:
    """Where the robot is (STEPS, 3), on a circle."""
    found = [(20.0, -5.0, 2.5)]
    for _ in range(STEPS - 1):
        found.append(drive(found[-1], (1.0, 0.3), 0.2))
    return np.array(found)


def odometry(topic: str = "/odometry", **metadata: str) -> Stream:
    return make_stream(
        topic,
        schemas.ODOMETRY,
        STAMPS,
        metadata=metadata,
        forward_mps=np.full(STEPS, 1.0),
        turn_radps=np.full(STEPS, 0.3),
    )


def seen(*, topic: str = "/pose", known: bool = True) -> Stream:
    """Poses with errors and covariances, among those of a body in space."""
    true = poses()[7::10]
    noisy = true + np.random.default_rng(4).normal(size=true.shape) @ np.linalg.cholesky(SPREAD).T
    half, n = 0.5 * noisy[:, 2], len(true)
    covariance = np.tile(0.1 * np.eye(6) + 0.02, (n, 1, 1))
    covariance[np.ix_(range(n), [0, 1, 5], [0, 1, 5])] = SPREAD
    return make_stream(
        topic,
        schemas.POSE,
        SLOW,
        metadata={"frame_id": "map"},
        position_m=np.column_stack([noisy[:, :2], np.zeros(n)]),
        quaternion=np.column_stack([np.cos(half), np.zeros((n, 2)), np.sin(half)]),
        covariance=covariance.reshape(n, 36) if known else np.full((n, 36), np.nan),
    )


def fix(topic: str = "/fix") -> Stream:
    n = len(SLOW)
    return make_stream(
        topic,
        schemas.GEODETIC_FIX,
        SLOW,
        latitude_deg=np.full(n, 54.0),
        longitude_deg=np.full(n, 12.0),
        altitude_m=np.zeros(n),
        covariance_m2=np.ones((n, 2)),
    )


def log(*streams: Stream) -> MemorySource:
    return memory_source(Recording(list(streams)), RunMetadata("robot", epoch_ns=EPOCH_NS))


def test_a_robot_begins_at_its_first_pose() -> None:
    """There it is as uncertain as the pose says, and no more was assumed than is told."""
    found = outputs(ROBOT, "ekf", [log(odometry(), seen())])
    told = sentences_of(found["started"].stream)
    assert told[0] == "the log has no prior (/prior): the estimate starts at the first message of /pose"
    assert [each.split(":")[0] for each in told[1:]] == [
        "no channel states forward_noise_density",
        "no channel states turn_noise_density",
    ]
    estimates = found["pose"].stream
    assert estimates.publish_time_ns[0] == SLOW[0]
    assert_allclose(estimates["covariance"][0].reshape(3, 3), SPREAD, rtol=3e-3)
    error = estimates["mean"] - poses()[7:]
    error[:, 2] = wrap_angle(error[:, 2])
    assert (np.abs(error[-1]) < 3 * np.sqrt(np.diag(estimates["covariance"][-1].reshape(3, 3)))).all()
    nis = found["innovation"]["normalised_innovation_squared"]
    assert nis[0] < 1e-6
    assert (nis[1:] < 20.0).all()
    assert (nis[1:] > 1e-3).any()
    assert_array_equal(found["innovation"]["accepted"], 1)


def test_a_heading_that_fixes_do_not_tell_is_said() -> None:
    """By what is assumed of the odometry; that is said with what it means."""
    told = sentences_of(outputs(ROBOT, "ekf", [log(odometry(), fix())])["started"].stream)
    assert any(each.startswith("heading_rad: unknown at the start") for each in told)
    assert "(noise of the forward speed, in m/s/sqrt(Hz): " in "".join(told)
    known = outputs(ROBOT, "ekf", [log(odometry(), seen())])["started"].stream
    assert not any("unknown" in each for each in sentences_of(known))


def test_a_span_begins_at_its_own_first_pose() -> None:
    source = log(odometry(), seen())
    later = replace(source, start_ns=int(SLOW[2]) + 1)
    estimates = outputs(ROBOT, "ekf", [later])["pose"].stream
    assert estimates.publish_time_ns[0] == SLOW[3]
    (filtering,) = bound(ROBOT, "ekf", [later])
    with pytest.raises(BadInput, match=r"no prior in this log .*leave out --start-from"):
        start_from(filtering, [later], [], "publish_time")


def test_the_start_is_where_the_robot_is_and_not_its_antenna() -> None:
    """An antenna 2 m ahead was taken for the robot: NIS 1.2 to 4.4 on a car's log, now .89 to 1.12."""
    path = np.array([(0.0, 0.0, 0.0)] * 5)
    for step in range(4):
        path[step + 1] = drive(path[step], (4.0, 0.3), 0.5)
    turned, shift = 2.2, np.array([30.0, -7.0])
    cosine, sine = np.cos(turned), np.sin(turned)
    truth = np.column_stack(
        [path[:, :2] @ np.array([[cosine, sine], [-sine, cosine]]) + shift, path[:, 2] + turned]
    )
    robot = LocalizationParameters(
        forward_noise_density=0.01, turn_noise_density=0.01, lever_x_m=2.0, lever_y_m=0.6
    )
    places = np.stack(antenna(truth.T, None, robot), axis=1)
    solved = align(path, places, np.tile(1e-4 * np.eye(2), (5, 1, 1)), 2.0, robot)
    assert solved is not None
    assert_allclose(solved[0], truth[-1], atol=1e-12)


def test_what_a_log_states_is_not_assumed() -> None:
    stated = odometry(forward_noise_density="0.01", turn_noise_density="0.01")
    found = outputs(ROBOT, "ekf", [log(stated, seen())])
    assert len(found["started"]) == 1
    given = outputs(ROBOT, "ekf", [log(odometry(), seen())], forward_noise_density=0.01)
    assert len(given["started"]) == 2


def test_odometry_alone_begins_at_zero() -> None:
    """Also the model of odometry alone, which takes no fixes. A sighting needs its map all the same."""
    for model, others in ((ROBOT, ()), (RECKONING, (fix(), seen()))):
        found = outputs(model, "ekf", [log(odometry(), *others)])
        assert sentences_of(found["started"].stream)[0].endswith("at zero, the origin of its frame")
        end = found["pose"]["mean"][-1]
        wanted = (0.0, 0.0, 0.0)
        for _ in range(STEPS - 1):
            wanted = drive(wanted, (1.0, 0.3), 0.2)
        assert_allclose(end, [*wanted[:2], wrap_angle(wanted[2])], atol=1e-6)
    sighting = make_stream("/bearing", schemas.BEARING, SLOW, target_id=[1] * 6, bearing_rad=[0.1] * 6)
    assert bound(ROBOT, "ekf", [log(odometry(), sighting)]) == []


def test_sightings_need_a_prior_which_nothing_overrules() -> None:
    """They do not say where to begin, unless there are poses as well."""
    landmark = make_stream(
        "/landmarks", schemas.LANDMARK, STAMPS[:1], landmark_id=[1], position_m=[[0.0, 0.0]]
    )
    sighting = make_stream(
        "/range",
        schemas.RANGE,
        SLOW,
        metadata={"sigma_range_m": "0.5"},
        target_id=[1] * 6,
        range_m=[20.0] * 6,
    )
    assert bound(ROBOT, "ekf", [log(odometry(), landmark, sighting)]) == []
    assert len(bound(ROBOT, "ekf", [log(odometry(), landmark, sighting, seen())])) == 1
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS[:1],
        metadata={"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"},
        mean=poses()[:1],
        covariance=[0.01 * np.eye(3).ravel()],
    )
    with pytest.raises(BadInput, match="does not state forward_noise_density"):
        bound(ROBOT, "ekf", [log(odometry(), seen(), prior)])
    stated = odometry(forward_noise_density="0.01", turn_noise_density="0.01")
    assert "started" not in outputs(ROBOT, "ekf", [log(stated, seen(), prior)])


def test_poses_without_a_covariance() -> None:
    source = log(odometry(), seen(known=False))
    with pytest.raises(BadInput, match=r"can replace it: .*--set sigma_fix_m=...; give --set sigma_hea"):
        outputs(ROBOT, "ekf", [source])
    found = outputs(ROBOT, "ekf", [source], sigma_fix_m=0.3, sigma_heading_rad=0.05)
    assert len(found["skipped"]) == 0
    variances = np.diag(found["pose"]["covariance"][0].reshape(3, 3))
    assert_allclose(variances, [0.09, 0.09, 0.0025], rtol=2e-3)


def test_a_gyro_takes_the_place_of_the_wheels_where_it_is_asked_for() -> None:
    """Its turn rate, that is, not their speed: these wheels do not turn, and the gyro knows better."""
    straight = make_stream(
        "/odometry", schemas.ODOMETRY, STAMPS, forward_mps=[1.0] * STEPS, turn_radps=[0.0] * STEPS
    )
    gyro = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        STAMPS,
        specific_force_mps2=np.zeros((STEPS, 3)),
        turn_rate_radps=np.tile([0.0, 0.0, 0.3], (STEPS, 1)),
        magnetic_field_ut=np.full((STEPS, 3), np.nan),
    )
    alone = outputs(ROBOT, "ekf", [log(straight, gyro)])["pose"]["mean"]
    assert_allclose(alone[-1], [0.2 * (STEPS - 1), 0.0, 0.0], atol=1e-6)
    turned = outputs(ROBOT, "ekf", [log(straight, gyro)], topics={"turn_rate": "inertial"})["pose"][
        "mean"
    ]
    assert_allclose(turned[-1, 2], wrap_angle(0.06 * (STEPS - 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("stated", "density"),
    [
        ({"gyro_noise_density": "0.02"}, 0.02),
        ({"turn_noise_density": "0.03", "gyro_noise_density": "0.02"}, 0.03),
        ({}, 0.05),  # what is assumed, and not what the wheels state
    ],
)
def test_the_noise_is_that_of_what_drives(stated: dict[str, str], density: float) -> None:
    """Of a gyro in place of the wheels' turn rate; the wheels still state that of their speed."""
    wheels = {"forward_noise_density": "0.1", "turn_noise_density": "0.7"}
    driven = replace(odometry(), metadata=wheels)
    gyro = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        STAMPS,
        metadata=stated,
        specific_force_mps2=np.zeros((STEPS, 3)),
        turn_rate_radps=np.zeros((STEPS, 3)),
        magnetic_field_ut=np.full((STEPS, 3), np.nan),
    )
    for names, expected in (({"turn_rate": "inertial"}, density), ({}, 0.7)):
        made = outputs(ROBOT, "ekf", [log(driven, gyro)], topics=names)
        covariance = made["pose"]["covariance"].reshape(-1, 3, 3)
        grown = np.diff(covariance[:, 2, 2]) / (1e-9 * np.diff(STAMPS))
        assert_allclose(grown, expected**2, rtol=1e-6)
        told = " ".join(sentences_of(made["started"].stream))
        assert ("no channel states turn_noise_density: 0.05 is assumed" in told) == (expected == 0.05)
        assert "forward_noise_density" not in told


def test_a_message_that_says_nothing_does_not_drive_and_is_counted() -> None:
    """Of an accelerometer alone, in place of the wheels' turn rate."""
    half = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        STAMPS,
        specific_force_mps2=np.tile([0.0, 0.0, 9.8], (STEPS, 1)),
        turn_rate_radps=np.full((STEPS, 3), np.nan),
        magnetic_field_ut=np.full((STEPS, 3), np.nan),
    )
    made = outputs(ROBOT, "ekf", [log(odometry(), half)], topics={"turn_rate": "inertial"})
    assert np.isfinite(made["pose"]["mean"]).all()
    skipped = sentences_of(made["skipped"].stream)
    assert skipped == ["topic /inertial: the control is not finite"] * STEPS


def test_of_two_samples_of_one_stamp_both_drive() -> None:
    """Every second has the stamp of the one before: the mean turn rate of the two is 0.1 rad/s."""
    stamps = EPOCH_NS + 100_000_000 * (np.arange(201) // 2)
    turn = np.where(np.arange(201) % 2, 0.2, 0.0)
    wheels = make_stream(
        "/odometry", schemas.ODOMETRY, stamps, forward_mps=np.ones(201), turn_radps=0.0 * turn
    )
    gyro = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        stamps,
        specific_force_mps2=np.zeros((201, 3)),
        turn_rate_radps=turn[:, None] * [0.0, 0.0, 1.0],
        magnetic_field_ut=np.full((201, 3), np.nan),
    )
    names = {"turn_rate": "inertial"}
    mean = outputs(ROBOT, "ekf", [log(wheels, gyro)], topics=names)["pose"]["mean"]
    assert_allclose(mean[-1, 2], 1.0, atol=1e-6)


def test_headings_are_a_sensor() -> None:
    n = len(SLOW)
    half = 0.5 * poses()[7::10, 2]
    heading = make_stream(
        "/heading",
        schemas.ORIENTATION,
        SLOW,
        metadata={"covariance_rad2": "0.01,0,0,0,0.01,0,0,0,0.0004"},
        quaternion=np.column_stack([np.cos(half), np.zeros((n, 2)), np.sin(half)]),
    )
    with_fixes = outputs(ROBOT, "ekf", [log(odometry(), fix(), heading)])
    assert "at the first message of /heading" in sentences_of(with_fixes["started"].stream)[1]
    found = outputs(ROBOT, "ekf", [log(odometry(), seen(), heading)])["pose"]
    variance = found["covariance"][found.stream.publish_time_ns == SLOW[0], 8]
    assert_allclose(variance, 1 / (1 / 0.0025 + 1 / 0.0004), rtol=2e-3)


def test_a_pose_and_a_fix_in_planes_that_have_nothing_to_do_with_each_other() -> None:
    source = log(odometry(), seen(), fix())
    with pytest.raises(BadInput, match=r"on earth, /pose positions in frame map, and no channel"):
        bound(ROBOT, "ekf", [source])
    for left_out, streams in (("fix", ("/odometry", "/pose")), ("pose", ("/odometry", "/fix"))):
        (only,) = bound(ROBOT, "ekf", [source], topics={left_out: ""})
        assert only.streams == streams
