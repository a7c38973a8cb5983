"""Companions for Foxglove: what its own library decodes, and that nothing else of fuselog sees them."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fuselog.recorders.log import Stream, make_stream, open_log, read_streams, schemas, write_log

Fuselog = Callable[..., Any]
RECORD = ("record", "landmarks", "--seed", "3", "--set", "duration_s=3")
STAMPS = np.array([10**9, 2 * 10**9, 3 * 10**9])


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def decoded(path: str) -> dict[str, list[Any]]:
    """The companions of a log by topic, as Foxglove's own classes read them."""
    found: dict[str, list[Any]] = {}
    with Path(path).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for schema, channel, message, read in reader.iter_decoded_messages():
            assert schema is not None
            if schema.name.startswith("foxglove."):
                name = schema.name.removeprefix("foxglove.")
                known = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
                own = known.FromString(message.data)
                assert str(own) == str(read)  # the log's own description says the same
                assert message.publish_time >= 10**9
                parts = [*getattr(own, "entities", ()), *getattr(own, "transforms", ())] or [own]
                stamps = {each.timestamp.ToNanoseconds() for each in parts}
                assert stamps == {message.publish_time}
                found.setdefault(channel.topic, []).append(own)
    return found


def places(messages: list[Any]) -> np.ndarray:
    return np.array([[getattr(each.pose.position, axis) for axis in "xyz"] for each in messages])


def rotations(messages: list[Any]) -> Rotation:
    quaternions = [[getattr(each.pose.orientation, axis) for axis in "xyzw"] for each in messages]
    return Rotation.from_quat(quaternions)


def test_a_recorded_log_has_its_truth_and_map_beside_the_same_streams(fuselog: Fuselog) -> None:
    assert fuselog(*RECORD, "-o", "plain.mcap").code == 0
    assert fuselog(*RECORD, "--foxglove", "-o", "both.mcap").code == 0
    plain, both = open_log("plain.mcap"), open_log("both.mcap")
    assert both.topics.keys() == plain.topics.keys()
    assert both.run == plain.run
    streams = read_streams(plain, list(plain.topics))
    for topic, stream in read_streams(both, list(both.topics)).items():
        for name, column in stream.columns.items():
            assert_array_equal(column, streams[topic][name])
    found = decoded("both.mcap")
    truth = streams["/robot1/truth"]
    poses = found["/foxglove/robot1/truth/pose"]
    assert_allclose(places(poses)[:, :2], truth["state"][:, :2])
    turned = Rotation.from_euler("z", truth["state"][:, 2:])
    assert_allclose((rotations(poses) * turned.inv()).magnitude(), 0.0, atol=1e-7)
    assert [each.timestamp.ToNanoseconds() for each in poses] == truth.publish_time_ns.tolist()
    (transform,) = found["/foxglove/robot1/truth/transforms"][-1].transforms
    assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "robot1")
    assert_allclose([transform.translation.x, transform.translation.y], truth["state"][-1, :2])
    (scene,) = found["/foxglove/landmarks/scene"]
    spheres = [each.spheres[0].pose.position for each in scene.entities]
    assert_allclose([[each.x, each.y] for each in spheres], streams["/landmarks"]["position_m"])
    assert [each.texts[0].text for each in scene.entities] == [
        str(number) for number in streams["/landmarks"]["landmark_id"]
    ]
    log = open_log("both.mcap")
    with pytest.warns(FutureWarning, match="'companions' was renamed to 'mirrors'"):
        assert log.companions == log.mirrors != {}
    said = fuselog("info", "both.mcap")
    assert "Foxglove mirror, for viewers: " in said.out
    assert "/foxglove/" not in said.out


def test_estimates_have_their_ellipses_and_replays_do_not_see_companions(fuselog: Fuselog) -> None:
    assert fuselog(*RECORD, "--foxglove", "-o", "run.mcap").code == 0
    replay = ("replay", "run.mcap", "-e", "dead-reckoning", "-o")
    assert fuselog(*replay, "est.mcap", "--foxglove").code == 0
    topic = "/estimates/dead-reckoning/robot1/pose"
    estimates = read_streams(open_log("est.mcap"), [topic])[topic]
    found = decoded("est.mcap")
    assert_allclose(places(found[f"/foxglove{topic}/pose"])[:, :2], estimates["mean"][:, :2])
    scenes = found[f"/foxglove{topic}/ellipse"]
    lines = [scene.entities[0].lines[0] for scene in scenes]
    outline = np.array([[[point.x, point.y] for point in line.points] for line in lines])
    away = outline - estimates["mean"][:, None, :2]
    precision = np.linalg.inv(estimates["covariance"].reshape(-1, 3, 3)[:, :2, :2])
    squared = np.einsum("nvi,nij,nvj->nv", away, precision, away)
    assert_allclose(squared, chi2.ppf(0.95, 2), rtol=1e-6)
    assert fuselog(*RECORD, "-o", "run.mcap").code == 0
    assert fuselog(*replay, "again.mcap").code == 0
    assert not open_log("again.mcap").mirrors
    again = read_streams(open_log("again.mcap"), [topic])[topic]
    assert_array_equal(again["mean"], estimates["mean"])


def seen() -> list[Stream]:
    """Poses, fixes, tracks, particles and detections, as a log of one's own holds them."""
    turned = Rotation.from_euler("z", [[0.1], [0.2], [0.3]]).as_quat(scalar_first=True)
    state = {"components": "x_m,y_m", "kinds": "linear,linear"}
    twice = np.repeat(STAMPS, 2)
    unit = np.tile(np.eye(2).ravel(), (6, 1))
    spots = np.arange(12.0).reshape(6, 2)
    return [
        make_stream(
            "/odom",
            schemas.POSE,
            STAMPS,
            metadata={"frame_id": "odom", "child_frame_id": "base"},
            position_m=np.arange(9.0).reshape(3, 3),
            quaternion=turned,
            covariance=np.full((3, 36), np.nan),
        ),
        make_stream(
            "/gps",
            schemas.GEODETIC_FIX,
            STAMPS,
            latitude_deg=[49.0, 49.1, 49.2],
            longitude_deg=[8.0, 8.1, 8.2],
            altitude_m=[100.0, 101.0, 102.0],
            covariance_m2=[[1, 0, 0, 4], [np.nan] * 4, [2, 1, 1, 3]],
        ),
        make_stream(
            "/course",
            schemas.COURSE_FIX,
            STAMPS,
            position_m=spots[:3],
            course_rad=[0.0, 0.5, np.nan],
            speed_mps=np.ones(3),
        ),
        make_stream(
            "/estimates/phd/track",
            schemas.TRACK_ESTIMATE,
            twice,
            metadata=state,
            track_id=np.tile([4, 7], 3),
            mean=spots,
            covariance=unit,
        ),
        make_stream(
            "/estimates/pf/particle",
            schemas.DENSITY_ESTIMATE,
            twice,
            metadata=state,
            weight=np.full(6, 0.5),
            mean=spots,
            covariance=0 * unit,
        ),
        make_stream(
            "/radar/detections",
            schemas.DETECTION,
            twice,
            metadata={"frame_id": "radar"},
            scan_id=np.repeat([1, 2, 3], 2),
            position_m=spots,
        ),
        make_stream("/temperature", schemas.VECTOR_MEASUREMENT, STAMPS, value=np.ones((3, 1))),
    ]


def test_orientations_and_moving_sights_are_poses_and_other_streams_are_named(fuselog: Fuselog) -> None:
    made = fuselog("record", "moving-los", "--set", "duration_s=2", "--foxglove", "-o", "los.mcap")
    assert "los.mcap: omitted, because Foxglove has no message for them: /prior, /truth" in made.err
    topic = "/sensor1/moving_line_of_sight"
    sights = read_streams(open_log("los.mcap"), [topic])[topic]
    poses = decoded("los.mcap")[f"/foxglove{topic}/pose"]
    assert_allclose(places(poses), sights["position_m"])
    azimuth, elevation = sights["azimuth_rad"], sights["elevation_rad"]
    level = np.cos(elevation)
    seen = np.stack([np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level], axis=1)
    turned = Rotation.from_quat(sights["quaternion"], scalar_first=True)
    assert_allclose(rotations(poses).apply([1.0, 0.0, 0.0]), turned.apply(seen), atol=1e-12)
    assert len(set(sights["target_id"])) > 1
    made = fuselog("record", "orientation", "--set", "steps=3", "--foxglove", "-o", "turned.mcap")
    assert "Foxglove" not in made.err
    topics = read_streams(open_log("turned.mcap"), ["/quaternion", "/truth"])
    found = decoded("turned.mcap")
    for topic, field in (("/quaternion", "quaternion"), ("/truth", "state")):
        poses = found[f"/foxglove{topic}/pose"]
        assert_allclose(places(poses), 0.0)
        wanted = Rotation.from_quat(topics[topic][field], scalar_first=True)
        assert_allclose((rotations(poses) * wanted.inv()).magnitude(), 0.0, atol=1e-7)


def test_any_log_goes_to_foxglove(fuselog: Fuselog) -> None:
    streams = seen()
    write_log("own.mcap", streams)
    said = fuselog("export", "own.mcap", "--to", "foxglove")
    assert said.code == 0
    assert "because Foxglove has no message for them: /temperature" in said.err
    found = decoded("own-foxglove.mcap")
    poses = found["/foxglove/odom/pose"]
    assert {each.frame_id for each in poses} == {"odom"}
    assert_allclose(places(poses), streams[0]["position_m"])
    assert_allclose(rotations(poses).as_euler("zyx")[:, 0], [0.1, 0.2, 0.3])
    assert found["/foxglove/odom/transforms"][0].transforms[0].child_frame_id == "base"
    fixes = found["/foxglove/gps/location"]
    assert_allclose([each.latitude for each in fixes], [49.0, 49.1, 49.2])
    assert_allclose([each.altitude for each in fixes], [100.0, 101.0, 102.0])
    assert fixes[2].position_covariance == [2, 1, 0, 1, 3, 0, 0, 0, 0]
    assert [each.position_covariance_type for each in fixes] == [3, 0, 3]
    headings = rotations(found["/foxglove/course/pose"]).as_euler("zyx")[:2, 0]
    assert_allclose(headings, np.pi / 2 - np.array([0.0, 0.5]))  # clockwise from north
    scenes = found["/foxglove/estimates/phd/track/scene"]
    assert [[each.id for each in scene.entities] for scene in scenes] == [["4", "7"]] * 3
    assert scenes[2].entities[1].spheres[0].pose.position.y == 11.0
    for topic in ("/foxglove/estimates/pf/particle/poses", "/foxglove/radar/detections/poses"):
        spots = [[pose.position.x, pose.position.y] for each in found[topic] for pose in each.poses]
        assert_allclose(spots, np.arange(12.0).reshape(6, 2))
    assert found["/foxglove/radar/detections/poses"][0].frame_id == "radar"


def test_fixes_with_the_diagonals_of_their_covariances(fuselog: Fuselog) -> None:
    columns = {"latitude_deg": [49.0], "longitude_deg": [8.0], "altitude_m": [100.0]}
    gps, car = (
        make_stream(topic, schemas.GEODETIC_FIX, STAMPS[:1], **columns, covariance_m2=[diagonal])
        for topic, diagonal in (("/gps", [4.0, 9.0, 1.0]), ("/car", [4.0, 9.0]))
    )
    write_log("own.mcap", [gps, car])
    assert fuselog("export", "own.mcap", "--to", "foxglove").code == 0
    found = decoded("own-foxglove.mcap")
    for topic, height in (("gps", 1.0), ("car", 0.0)):
        (fix,) = found[f"/foxglove/{topic}/location"]
        assert fix.position_covariance == [4, 0, 0, 0, 9, 0, 0, 0, height]


def test_what_has_no_message_and_a_place_that_is_taken_are_refused(fuselog: Fuselog) -> None:
    write_log("air.mcap", seen()[-1:])
    said = fuselog("export", "air.mcap", "--to", "foxglove")
    assert said.code == 2
    assert "air.mcap: has nothing that Foxglove can show; export it as csv" in said.err
    assert [each.name for each in Path().iterdir()] == ["air.mcap"]
    write_log("own.mcap", seen())
    Path("taken.mcap").write_text("a note")
    assert fuselog("export", "own.mcap", "--to", "foxglove", "-o", "taken.mcap").code == 2
    assert Path("taken.mcap").read_text() == "a note"


def test_parts_of_a_log_say_that_its_companions_are_left_out(fuselog: Fuselog) -> None:
    assert fuselog(*RECORD, "--foxglove", "-o", "run.mcap").code == 0
    said = fuselog("cut", "run.mcap", "--end", "1", "-o", "part.mcap")
    assert said.code == 0
    assert "the Foxglove mirror is not copied" in said.err
    assert "--to foxglove" in said.err
    assert not open_log("part.mcap").mirrors
    assert open_log("part.mcap").topics
