"""The importer of ROS logs: equal to rosbags' own reading, clocks, transforms, losses, bad input."""

import json
import re
import shutil
import sqlite3
import tarfile
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation, Slerp

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros import importer
from fuselog.recorders.importers.ros.choosing import RosParameters
from fuselog.recorders.importers.ros.files.bags import open_bag
from fuselog.recorders.importers.ros.layouts import Messages, MessageType, by_size, definitions_of
from fuselog.recorders.importers.ros.messages import TYPES
from fuselog.recorders.log import Stream, open_log, read_streams
from fuselog.recorders.models.inertial import from_mounting
from fuselog.recorders.recording import import_log, import_run

pytestmark = pytest.mark.paper

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
VISION = {
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
    "vision_msgs/msg/Detection2D": "std_msgs/Header header\nBoundingBox2D bbox\nstring id",
    "vision_msgs/msg/BoundingBox2D": "Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/msg/Pose2D": "Point2D position\nfloat64 theta",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nBoundingBox3D bbox\nstring id",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "my_robot_msgs/msg/Wheels": "string note\nWheel left\nWheel right\n"
    "builtin_interfaces/Time at\nint16[3] raw",
    "my_robot_msgs/msg/Wheel": "int8 gear\nfloat32 speed",
}
FORMATS = ["bag", "bag-lz4", "db3", "mcap"]
Sent = tuple[str, int, Any]


def store_of(form: str = "mcap") -> Typestore:
    """The types of ROS 1 or 2, with those that are made up here."""
    return types_of(Stores.ROS1_NOETIC if form.startswith("bag") else Stores.ROS2_HUMBLE)


@cache
def types_of(stores: Stores) -> Typestore:
    store = get_typestore(stores)
    for name, text in VISION.items():
        store.register(get_types_from_msg(text, name))
    return store


class Maker:
    """Makes messages of any type with random numbers; given paths have given values."""

    def __init__(self, form: str = "mcap", seed: int = 1) -> None:
        self.store, self.generator = store_of(form), np.random.default_rng(seed)

    def __call__(self, name: str, stamp_ns: int = START_NS, **given: Any) -> Any:
        """A message; `pose__position__x=1.0` gives the field pose.position.x."""
        values = {
            "header.frame_id": "map", "header.stamp": stamp_ns, "child_frame_id": "base_link",
            "range": 2.0, "min_range": 1.0, "max_range": 4.0,
            "status.status": 0, "latitude": 48.5, "longitude": 9.25,
        }  # fmt: skip
        values |= {path.replace("__", "."): value for path, value in given.items()}
        return self._make(name, "", values)

    def _make(self, name: str, path: str, given: Mapping[str, Any]) -> Any:
        if name.endswith("/Time"):
            stamp_ns = given.get(path, START_NS)
            return self.store.types[name](stamp_ns // 10**9, stamp_ns % 10**9)
        fields = {}
        for field, description in self.store.fielddefs[name][1]:
            place = f"{path}.{field}" if path else field
            fields[field] = self._value(description, place, given)
        if name.endswith("/Quaternion"):
            turn = given.get(path, Rotation.random(rng=self.generator).as_quat())
            fields = dict(zip("xyzw", map(float, turn), strict=True))
        return self.store.types[name](**fields)

    def _value(self, description: Any, path: str, given: Mapping[str, Any]) -> Any:
        kind, of = description
        if kind is Nodetype.NAME:
            return self._make(of, path, given)
        if kind is Nodetype.BASE:
            if path in given:
                return given[path]
            if of[0] == "string":
                return "x" * int(self.generator.integers(0, 4))
            return self._number(of[0])
        inner, count = of
        count = count if kind is Nodetype.ARRAY else given.get(path, 2)
        if inner[0] is Nodetype.NAME:
            return [self._make(inner[1], f"{path}.{number}", given) for number in range(count)]
        if path in given and not isinstance(given[path], int):
            return np.array(given[path], float)
        dtype = {"float32": "f4", "float64": "f8"}.get(inner[1][0], inner[1][0])
        if dtype.startswith("f"):
            return self.generator.normal(size=count).astype("f4").astype(dtype)
        return np.array([self._number(inner[1][0]) for _ in range(count)], dtype)

    def _number(self, name: str) -> Any:
        if name.startswith("float"):
            return float(np.float32(self.generator.normal()))
        return (
            bool(self.generator.integers(2)) if name == "bool" else int(self.generator.integers(1, 100))
        )


def write_bag(place: Path, form: str, sent: list[Sent], store: Typestore) -> Path:
    """A bag of messages: topic, the bag's stamp, message."""
    connections: dict[str, Any] = {}
    if form.startswith("bag"):
        place = place.with_suffix(".bag")
        bag1 = Ros1Writer(place)
        if form == "bag-lz4":
            bag1.set_compression(Ros1Writer.CompressionFormat.LZ4)
        bag1.chunk_threshold = 4000
        with bag1:
            for topic, stamp_ns, message in sent:
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = bag1.add_connection(topic, name, typestore=store)
                bag1.write(connections[topic], stamp_ns, store.serialize_ros1(message, name))
        return place
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    with Ros2Writer(place, version=9, storage_plugin=plugin) as bag2:
        for topic, stamp_ns, message in sent:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag2.add_connection(topic, name, typestore=store)
            bag2.write(connections[topic], stamp_ns, store.serialize_cdr(message, name))
    return place


def imported(path: Path, **parameters: Any) -> tuple[dict[str, Stream], dict[str, str]]:
    """The streams and the notes of a bag."""
    recording, run = import_run("ros", path, parameters)
    return {stream.topic: stream for stream in recording.streams}, run.notes


def refusal(path: Path, **parameters: Any) -> str:
    """Why a bag is refused; nothing is written."""
    target = path.parent / "refused.mcap"
    before = set(path.parent.iterdir())
    with pytest.raises(BadInput) as refused:
        import_log("ros", path, parameters, target)
    assert set(path.parent.iterdir()) == before
    return str(refused.value).replace(f"{path}: ", "")


def field_of(message: Any, path: str) -> Any:
    """What rosbags has under a path."""
    for part in path.split("."):
        message = message[int(part)] if part.isdigit() else getattr(message, part)
    return message


EACH = 8  # messages of a type


@pytest.mark.parametrize("form", FORMATS)
def test_every_type_is_read_as_rosbags_reads_it(form: str, tmp_path: Path) -> None:
    """Every number of every message of every type that is taken, whatever the lengths of its texts."""
    make = Maker(form)
    names = [name for name in TYPES if name in make.store.fielddefs]
    sent = [
        (
            "/" + name.replace("/msg/", "/"),
            START_NS + number * STEP_NS,
            make(name, START_NS + number * STEP_NS),
        )
        for number in range(EACH)
        for name in names
    ]
    path = write_bag(tmp_path / "bag", form, sent, make.store)
    checked = 0
    with AnyReader([path]) as theirs, open_bag(path) as ours:
        readers: dict[str, MessageType] = {}
        found: dict[str, list[Messages]] = {}
        for batch in ours.batches(lambda _: True):
            each = batch.connection
            if each.topic not in readers:
                definitions = definitions_of(each.type_name, each.definition, "ros2_humble")
                readers[each.topic] = MessageType(each.type_name, definitions, each.encoding)
            reader = readers[each.topic]
            for which, raw in by_size(batch.data, batch.begins, batch.lengths):
                for messages in reader.read(raw, which):
                    assert isinstance(messages, Messages), messages
                    stamps = batch.log_time_ns[messages.rows]
                    found.setdefault(each.topic, []).append((messages, stamps))
        left = {
            (connection.topic, stamp_ns): theirs.deserialize(raw, connection.msgtype)
            for connection, stamp_ns, raw in theirs.messages()
        }
        for topic, own in found.items():
            for messages, stamps in own:
                expected = [left.pop((topic, stamp_ns)) for stamp_ns in stamps.tolist()]
                for place in messages.layout.numbers:
                    numbers = [field_of(each, place) for each in expected]
                    assert_array_equal(messages.numbers(place), numbers)
                    checked += len(numbers)
                for place in messages.layout.texts:
                    texts = [field_of(each, place) for each in expected]
                    assert [each.decode() for each in messages.text(place)] == texts
        assert not left
    assert checked > EACH * len(names)
    streams, _ = imported(path, clock="bag")
    assert {stream.topic.rpartition("/")[2] for stream in streams.values()} >= {
        "fix", "inertial", "magnetic_field", "odometry", "odometry_twist", "odometry_pose", "twist",
        "pose",
        "position", "orientation", "range", "value", *(["scan", "detections"]),
    }  # fmt: skip
    lengths = {name: len(stream) for name, stream in streams.items()}
    assert {name for name, length in lengths.items() if length != EACH} == {
        name for name in lengths if name.endswith("detections")
    }


def test_a_pose_without_a_covariance_may_be_a_goal(tmp_path: Path) -> None:
    """It is named by its topic, so that no model takes it for a measurement; a name may be given."""
    make = Maker()
    sent: list[Sent] = [
        ("/amcl_pose", START_NS, make("geometry_msgs/msg/PoseWithCovarianceStamped", START_NS)),
        ("/goal_pose", START_NS, make("geometry_msgs/msg/PoseStamped", START_NS)),
    ]
    both = write_bag(tmp_path / "both", "mcap", sent, make.store)
    assert set(imported(both)[0]) == {"/pose", "/goal_pose/pose"}
    goal = write_bag(tmp_path / "goal", "mcap", sent[1:], make.store)
    assert set(imported(goal)[0]) == {"/goal_pose/pose"}
    named = imported(both, names={"/goal_pose": "/reference"})[0]
    assert set(named) == {"/pose", "/reference/pose"}


def test_poses_that_are_the_truth(tmp_path: Path) -> None:
    """Of a topic that is named: positions, the heading and the orientation, by these names."""
    make = Maker()
    half = 0.25
    turned = make(
        "nav_msgs/msg/Odometry",
        START_NS,
        **{f"pose__pose__position__{name}": value for name, value in zip("xyz", (3, 4, 5), strict=True)},
        pose__pose__orientation=[0.0, 0.0, np.sin(half), np.cos(half)],
    )
    sent: list[Sent] = [("/r1/mocap", START_NS, turned)]
    path = write_bag(tmp_path / "bag", "mcap", sent, make.store)
    streams = imported(path, truth="/r1/mocap")[0]
    truth = streams["/r1/truth"]
    assert "/r1/odometry_pose" not in streams
    names = "x_m,y_m,z_m,heading_rad,orientation_w,orientation_x,orientation_y,orientation_z"
    assert truth.metadata["components"] == names
    assert_allclose(truth["state"], [[3, 4, 5, 0.5, np.cos(half), 0, 0, np.sin(half)]], atol=1e-12)
    placed = imported(path, truth="/r1/mocap", origin=[48.0, 11.0])[0]
    stated = {topic for topic, each in placed.items() if "origin_latitude_deg" in each.metadata}
    assert stated == {"/r1/truth"}
    assert placed["/r1/truth"].metadata["origin_longitude_deg"] == "11.0"
    adrift = imported(path, origin=[48.0, 11.0])[0]["/r1/odometry_pose"]
    assert "origin_latitude_deg" not in adrift.metadata
    level: list[Sent] = [*sent, ("/level", START_NS, make("std_msgs/msg/Float64", data=0.75))]
    other = write_bag(tmp_path / "other", "mcap", level, make.store)
    for name, words in (
        ("/level", "truth = /level: this topic has no poses"),
        ("/mocap", "has no topic /mocap"),
    ):
        with pytest.raises(BadInput, match=words):
            imported(other, truth=name)


def test_what_the_streams_say(tmp_path: Path) -> None:
    """Fields, units, covariances, frames and clocks of each kind, number by number."""
    make = Maker()
    own = np.diag([4.0, 5.0, 6.0]).ravel()
    one = START_NS + 5
    sent: list[Sent] = [
        ("/gps", make("sensor_msgs/msg/NavSatFix", one, latitude=48.5, longitude=9.25, altitude=300.0,
                      position_covariance=own, position_covariance_type=3, header__frame_id="gps_link")),
        ("/imu", make("sensor_msgs/msg/Imu", one, orientation_covariance=[-1.0] * 9,
                      angular_velocity__x=0.25, linear_acceleration__z=9.5,
                      angular_velocity_covariance=own, linear_acceleration_covariance=[0.0] * 9)),
        ("/mag", make("sensor_msgs/msg/MagneticField", one, magnetic_field__x=2e-5,
                      magnetic_field_covariance=own * 1e-12)),
        ("/r1/odom", make("nav_msgs/msg/Odometry", one, twist__twist__linear__x=0.5,
                          twist__twist__angular__z=-0.125, pose__covariance=[0.0] * 36)),
        ("/boxes", make("vision_msgs/msg/Detection3DArray", one, detections=3)),
        ("/boxes", make("vision_msgs/msg/Detection3DArray", one + 1, detections=0)),
        ("/heat", make("sensor_msgs/msg/Temperature", one, temperature=21.5)),
        ("/level", make("std_msgs/msg/Float64", data=0.75)),
    ]  # fmt: skip
    sent = [(topic, START_NS + 10, message) for topic, message in sent]
    streams, notes = imported(write_bag(tmp_path / "bag", "mcap", sent, make.store))
    fix = streams["/fix"]
    assert [fix[name].tolist() for name in ("latitude_deg", "longitude_deg", "altitude_m")] == [
        [48.5],
        [9.25],
        [300],
    ]
    assert fix["covariance_m2"].tolist() == [own.tolist()]
    assert fix.metadata == {"frame_id": "gps_link"}
    stamps = fix.publish_time_ns[0], fix.log_time_ns[0], fix["sensor_time_ns"][0]
    assert stamps == (one, START_NS + 10, one)
    inertial = streams["/inertial"]
    assert inertial["turn_rate_radps"][0, 0] == 0.25
    assert inertial["specific_force_mps2"][0, 2] == 9.5
    assert inertial.metadata["turn_rate_covariance_rad2ps2"] == "4,0,0,0,5,0,0,0,6"
    assert inertial.metadata["specific_force_covariance_m2ps4"] == ",".join(["nan"] * 9)
    assert "/orientation" not in streams
    why = "orientation_covariance[0] is -1"
    assert notes[f"/imu: orientation dropped: without an orientation: {why}"] == "1"
    assert_allclose(streams["/magnetic_field"]["magnetic_field_ut"][0, 0], 20.0)
    assert_allclose(streams["/magnetic_field"]["covariance_ut2"][0], own)
    odometry = streams["/r1/odometry"]
    assert (odometry["forward_mps"].tolist(), odometry["turn_radps"].tolist()) == ([0.5], [-0.125])
    assert np.isnan(streams["/r1/odometry_pose"]["covariance"]).all()
    assert odometry.metadata == {"frame_id": "map", "child_frame_id": "base_link"}
    centres = [sent[4][2].detections[number].bbox.center.position for number in range(3)]
    assert streams["/detections"]["position_m"].tolist() == [
        [each.x, each.y, each.z] for each in centres
    ]
    assert streams["/detections"]["scan_id"].tolist() == [0, 0, 0]
    assert streams["/scan"]["detections"].tolist() == [3, 0]
    left_out = "without the sizes, turns, classes and ids of their boxes"
    assert notes[f"/boxes: detections kept {left_out}"] == "3"
    # two topics that would have one name keep their own
    assert streams["/heat/value"].metadata["components"] == "temperature_degc"
    assert streams["/level/value"]["value"].tolist() == [[0.75]]


def test_a_real_log_with_two_clocks(real_data: Path, tmp_path: Path) -> None:
    """Stamps of simulated time in the headers and of a wall clock in the bag; both are kept and told."""
    path = real_data / "nav2_turtlebot.mcap"
    streams, notes = imported(path)
    lengths = {topic: len(stream) for topic, stream in streams.items() if not topic.startswith("/tf")}
    assert lengths == {
        "/odometry": 2639, "/odometry_twist": 2639, "/odometry_pose": 2639, "/pose": 135,
    }  # fmt: skip
    assert sum(len(stream) for topic, stream in streams.items() if topic.startswith("/tf")) == 7284
    with AnyReader([path]) as bag:
        odom = [each for each in bag.connections if each.topic == "/odom"]
        sent = [(stamp, bag.deserialize(raw, each.msgtype)) for each, stamp, raw in bag.messages(odom)]
    of_sent = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for _, message in sent]
    assert_array_equal(streams["/odometry"].publish_time_ns, of_sent)
    assert_array_equal(streams["/odometry"].log_time_ns, [stamp for stamp, _ in sent])
    assert_array_equal(streams["/odometry"]["forward_mps"], [m.twist.twist.linear.x for _, m in sent])
    place = [m.pose.pose.orientation for _, m in sent]
    assert_allclose(
        streams["/odometry_pose"]["quaternion"], [[q.w, q.x, q.y, q.z] for q in place], atol=1e-12
    )
    assert notes["header clock"] == "924.102 s to 1026.400 s"
    assert notes["bag clock"] == "2026-05-08 09:59:13 UTC to 2026-05-08 10:00:50 UTC"
    assert notes["bag clock minus header clock"] == "1778233423.590 to 1778233429.498 s"
    by_bag, _ = imported(path, clock="bag")
    assert_array_equal(by_bag["/odometry"].publish_time_ns, by_bag["/odometry"].log_time_ns)
    assert_array_equal(by_bag["/odometry"]["sensor_time_ns"], of_sent)
    run, messages = import_log("ros", path, {}, tmp_path / "nav.mcap")
    log = open_log(tmp_path / "nav.mcap")
    assert (log.run, messages) == (run, sum(map(len, streams.values())))
    assert_array_equal(
        read_streams(log, ["/pose"])["/pose"]["covariance"], streams["/pose"]["covariance"]
    )


def test_named_transforms_are_composed(real_data: Path) -> None:
    """Two transforms that move and one that does not, against SciPy's interpolation."""
    path = real_data / "nav2_turtlebot.mcap"
    chain = imported(path, transforms="map:base_footprint")[0]["/tf/map/base_footprint"]
    parts = imported(path)[0]
    above, below = parts["/tf/map/odom"], parts["/tf/odom/base_link"]
    assert chain.metadata == {"frame_id": "map", "child_frame_id": "base_footprint"}

    def rotations(stream: Stream) -> Rotation:
        return Rotation.from_quat(stream["quaternion"], scalar_first=True)

    stamps, first = np.unique(above.publish_time_ns, return_index=True)
    between = Slerp(stamps * 1e-9, rotations(above)[first])(chain.publish_time_ns * 1e-9)
    offset = np.stack(
        [
            np.interp(chain.publish_time_ns, stamps, above["position_m"][first, axis])
            for axis in range(3)
        ],
        axis=1,
    )
    rows = np.searchsorted(below.publish_time_ns, chain.publish_time_ns)
    assert_array_equal(below.publish_time_ns[rows], chain.publish_time_ns)
    assert_allclose(chain["position_m"], offset + between.apply(below["position_m"][rows]), atol=1e-6)
    error = (between * rotations(below)[rows]).inv() * rotations(chain)
    assert error.magnitude().max() < 1e-6
    assert 2600 < len(chain) < 2639


@pytest.mark.parametrize("is_static", [True, False])
def test_mountings_in_transforms_are_told_with_their_settings(tmp_path: Path, is_static: bool) -> None:
    """Over a mast, as sent once or as ever the same; of a frame that moves on the body, that it does."""
    make, turn = Maker(), Rotation.from_euler("xyz", [0.1, -0.4, 2.0])
    links = [
        ("base_link", "mast", (0.5, 0.1, 0.2), Rotation.from_euler("z", 90, degrees=True)),
        ("mast", "antenna", (0.3, 0.0, 1.0), Rotation.identity()),
        ("base_link", "unit", (0.1, 0.0, 0.3), turn),
    ]
    transform = "geometry_msgs/msg/TransformStamped"
    message_type = make.store.types["tf2_msgs/msg/TFMessage"]
    sent: list[Sent] = []
    for step in range(4):
        stamp_ns = START_NS + step * STEP_NS
        moving = [("base_link", "arm", (0.1 * step, 0.0, 0.0), Rotation.identity())]
        fixed = links if not (is_static and step) else []
        for topic, pairs in (("/tf_static" if is_static else "/tf", fixed), ("/tf", moving)):
            parts = [
                make(transform, stamp_ns, header__frame_id=parent, child_frame_id=child,
                     transform__rotation=about.as_quat(),
                     transform__translation__x=place[0], transform__translation__y=place[1],
                     transform__translation__z=place[2])
                for parent, child, place, about in pairs
            ]  # fmt: skip
            if parts:
                sent.append((topic, stamp_ns, message_type(transforms=parts)))
        sent.append(("/imu", stamp_ns, make("sensor_msgs/msg/Imu", stamp_ns, header__frame_id="unit")))
        for topic, frame in (("/fix", "antenna"), ("/arm/fix", "arm")):
            fix = make("sensor_msgs/msg/NavSatFix", stamp_ns, header__frame_id=frame)
            sent.append((topic, stamp_ns, fix))
    _, notes = imported(write_bag(tmp_path / "bag", "mcap", sent, make.store))
    told = {key: note for key, note in notes.items() if key.endswith(", mounting")}
    assert set(told) == {"/fix, mounting", "/inertial, mounting", "/arm/fix, mounting"}
    assert told["/arm/fix, mounting"].startswith("its frame arm moves in base_link, but lever arms")
    assert told["/arm/fix, mounting"].endswith('transforms=["base_link:arm"]\' imports the motion')
    assert told["/fix, mounting"] == (
        "its frame antenna is 0.5, 0.4, 1.2 m forward, left and up of base_link; used by "
        "--set lever_x_m=0.5 --set lever_y_m=0.4 for the model robot, or "
        "--set lever_x_m=0.4 --set lever_y_m=0.4 --set lever_z_m=0.9 for the model inertial"
    )
    angles = [float(each) for each in re.findall(r"mounting_\w+_rad=(\S+)", told["/inertial, mounting"])]
    vector = np.array([1.0, 2.0, 3.0])
    assert from_mounting(*angles, vector) == pytest.approx(turn.apply(vector), abs=1e-4)


def test_quaternions_not_of_unit_length_are_scaled_or_left_out(tmp_path: Path) -> None:
    """Poses, the truth made of poses, and transforms; zeros have no direction, and are never scaled."""
    make, pose = Maker(), "geometry_msgs/msg/PoseStamped"
    message_type = make.store.types["tf2_msgs/msg/TFMessage"]
    turns = [[0.0, 0.0, 0.6, 0.8], [0.0, 0.0, 1.2, 1.6], [0.0, 0.0, 0.0, 0.0]]
    sent: list[Sent] = []
    for step, turn in enumerate(turns):
        at = START_NS + step * STEP_NS
        for topic in ("/pose", "/mocap"):
            sent.append((topic, at, make(pose, at, pose__orientation=turn)))
        link = make("geometry_msgs/msg/TransformStamped", at, transform__rotation=turn)
        sent.append(("/tf", at, message_type(transforms=[link])))
    path = write_bag(tmp_path / "bag", "mcap", sent, make.store)
    for setting, kept in (("normalise", 2), ("skip", 1)):
        streams, notes = imported(path, truth="/mocap", quaternions=setting)
        of_poses = (streams[topic]["quaternion"] for topic in ("/pose/pose", "/tf/map/base_link"))
        for found in (*of_poses, streams["/truth"]["state"][:, 4:]):
            assert_allclose(found, [[0.8, 0.0, 0.0, 0.6]] * kept, atol=1e-12)
        fact = "a quaternion that is not of unit length"
        for what in ("/pose: pose", "/mocap: truth", "/tf: transforms"):
            assert notes[f"{what} dropped: {fact}"] == str(3 - kept)
            scaled = notes.get(f"{what} kept with a quaternion that was scaled to unit length")
            assert scaled == ("1" if setting == "normalise" else None)
    assert "topic /pose: 2 of its quaternions are not of unit length" in refusal(path)
    assert "topic /mocap: 2 of its" in refusal(path, topics="/mocap", truth="/mocap")
    assert "topic /tf: frame base_link in map: 2 of its" in refusal(path, topics="/tf")


def test_a_sqlite_bag(real_data: Path, tmp_path: Path) -> None:
    """A .db3 file alone and in its folder; a pair of frames against its direction."""
    with tarfile.open(real_data / "trajectories.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    folder = tmp_path / "trajectories" / "tf_example"
    pose = imported(folder)[0]["/tf/odom/base_footprint"]
    assert len(pose) == 517
    back = imported(folder / "tf_example.db3", transforms="base_link:odom")[0]["/tf/base_link/odom"]
    assert_allclose(
        Rotation.from_quat(pose["quaternion"], scalar_first=True).apply(back["position_m"]),
        -pose["position_m"],
        atol=1e-12,
    )


def odometry_bag(place: Path, form: str, count: int, first: int = 0) -> Path:
    """Odometry with an x that counts, 100 a second."""
    make, sent = Maker(form), []
    some = [make("nav_msgs/msg/Odometry") for _ in range(20)]  # a message takes long to make
    for number in range(first, first + count):
        stamp_ns, one = START_NS + number * STEP_NS, some[number % 20]
        stamp = replace(one.header.stamp, sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        position = replace(one.pose.pose.position, x=float(number))
        pose = replace(one.pose, pose=replace(one.pose.pose, position=position))
        sent.append(
            ("/odom", stamp_ns, replace(one, header=replace(one.header, stamp=stamp), pose=pose))
        )
    return write_bag(place, form, sent, make.store)


def test_rows_of_a_database_that_are_no_messages_are_counted(tmp_path: Path) -> None:
    path = next(odometry_bag(tmp_path / "bag", "db3", 6).glob("*.db3"))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE messages SET timestamp = 'soon' WHERE id = 2")
        database.execute("UPDATE messages SET data = 7 WHERE id = 3")
        database.execute("UPDATE messages SET topic_id = 9 WHERE id = 4")
    with open_bag(path) as bag:
        assert sum(len(each.log_time_ns) for each in bag.batches(lambda _: True)) == 3
        assert bag.losses == [
            f"{path}: 1 messages have no topic and are lost",
            f"{path}: 2 rows of messages have no integer stamp or no bytes, and are lost",
        ]
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE topics SET name = CAST(x'2fff' AS TEXT)")
    with (
        pytest.raises(BadInput, match=r"cannot be read as a sqlite3 bag .*UTF-8"),
        open_bag(path),
    ):
        pass


def test_records_of_a_bag_that_are_no_messages_are_counted(tmp_path: Path) -> None:
    """A record of another kind; an index that was cut off behind the first of two topics."""
    make, path = Maker("bag"), tmp_path / "bag.bag"
    level = make("std_msgs/msg/Float64")
    write_bag(path, "bag", [(f"/{k % 2}", START_NS + k, level) for k in range(10)], make.store)
    whole = path.read_bytes()

    def read(content: bytes) -> tuple[int, list[str]]:
        path.write_bytes(content)
        with open_bag(path) as bag:
            return sum(len(each.begins) for each in bag.batches(lambda _: True)), bag.losses

    count, (loss,) = read(whole.replace(b"op=\x02", b"op=\x0c", 3))
    assert count == 7
    assert loss.endswith("3 records are not messages of its topics, and are lost")
    count, (loss,) = read(whole[: whole.rindex(b"topic=/1") - 30])
    assert count == 10
    assert "it was cut off" in loss


@pytest.mark.parametrize("longest", [300, 9000])
def test_a_database_that_was_cut_off_gives_no_message_that_is_not_whole(
    longest: int, tmp_path: Path
) -> None:
    """Cuts within pages and between them; messages in a page, and on further pages."""
    path = tmp_path / "bag.db3"
    rows = [(1, START_NS + k, bytes([1 + k % 255]) * (1 + k * 37 % longest)) for k in range(700)]
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)"
        )
        database.execute("INSERT INTO topics VALUES (1, '/a', 'a/msg/B', 'cdr')")
        database.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    whole, cut = path.read_bytes(), tmp_path / "cut.db3"
    remedy = f"`sqlite3 {cut} .recover | sqlite3 whole.db3`"
    for size in np.linspace(0.2 * len(whole), len(whole), 20).astype(int).tolist():
        cut.write_bytes(whole[:size])
        with open_bag(cut) as bag:
            found = [
                batch.data[begin : begin + length].tobytes()
                for batch in bag.batches(lambda _: True)
                for begin, length in zip(batch.begins, batch.lengths, strict=True)
            ]
            assert found == [row[2] for row in rows[: len(found)]]
            assert any(remedy in loss for loss in bag.losses) == (len(found) < len(rows))
    assert len(found) == len(rows)


def counted(path: Path) -> tuple[list[int], dict[str, str]]:
    """The numbers that the odometry of a bag counts, and the notes."""
    streams, notes = imported(path)
    return streams["/odometry_pose"]["position_m"][:, 0].astype(int).tolist(), notes


@pytest.mark.parametrize("form", FORMATS)
def test_a_split_bag_is_one_log(form: str, tmp_path: Path) -> None:
    """The files of a folder, numbers in order; a missing one is told."""
    suffix = form.partition("-")[0]
    folder = tmp_path / "split"
    folder.mkdir()
    for number in (2, 10):
        path = odometry_bag(tmp_path / f"part{number}", form, 50, 50 * (number == 10))
        source = path if path.is_file() else next(path.glob(f"*.{suffix}"))
        shutil.move(source, folder / f"drive_{number}.{suffix}")
    assert counted(folder)[0] == list(range(100))
    about = {"relative_file_paths": [f"drive_{number}.{suffix}" for number in (2, 10, 11)]}
    (folder / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": about}))
    numbers, notes = counted(folder)
    assert numbers == list(range(100))
    assert notes["lost (1)"].endswith(f"drive_11.{suffix}: is missing, although metadata.yaml names it")


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_compressed_bags(plugin: str, mode: str, tmp_path: Path) -> None:
    """Files or messages that ROS 2 compressed one by one, though nothing may say so."""
    make, path = Maker(), tmp_path / "bag"
    bag = Ros2Writer(path, version=9, storage_plugin=StoragePlugin[plugin])
    bag.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with bag:
        topic = bag.add_connection("/level", "std_msgs/msg/Float64", typestore=make.store)
        for number in range(10):
            message = make("std_msgs/msg/Float64", data=float(number))
            bag.write(topic, START_NS + number, make.store.serialize_cdr(message, message.__msgtype__))
    assert imported(path)[0]["/value"]["value"][:, 0].tolist() == list(range(10))
    (path / "metadata.yaml").unlink()
    assert imported(path)[0]["/value"]["value"][:, 0].tolist() == list(range(10))


@pytest.mark.parametrize("form", ["bag", "bag-lz4", "mcap"])
def test_a_bag_that_was_cut_off(form: str, tmp_path: Path) -> None:
    """What is whole is imported, from the first message on, and what was lost is said."""
    path = odometry_bag(tmp_path / "bag", form, 3000)
    file = path if path.is_file() else next(path.glob("*.[dm]*"))
    cut = tmp_path / f"cut{file.suffix}"
    cut.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.6)])
    numbers, notes = counted(cut)
    assert 500 < len(numbers) < 2500
    assert numbers == list(range(len(numbers)))
    assert any(key.startswith("lost") for key in notes), notes
    told = re.search(r"its last (\d+) bytes are not a complete message", " ".join(notes.values()))
    assert (told is not None) == (form == "bag")
    assert told is None or 0 < int(told[1]) < 1000  # of a message


def test_what_is_dropped_is_counted(tmp_path: Path) -> None:
    """Stamps that repeat or go back, fixes that are NaN or none, and what is not taken."""
    make = Maker()
    steps = [0, 1, 1, 3, 2, 4, 5]
    sent: list[Sent] = [
        (
            "/gps",
            START_NS + number * STEP_NS,
            make(
                "sensor_msgs/msg/NavSatFix",
                START_NS + step * STEP_NS,
                latitude=np.nan if number == 5 else 48.0,
                altitude=np.nan,
                status__status=-1 if number == 6 else 0,
            ),
        )
        for number, step in enumerate(steps)
    ]
    sent += [("/scan", START_NS, make("sensor_msgs/msg/LaserScan"))] * 3
    path = write_bag(tmp_path / "bag", "mcap", sent, make.store)
    streams, notes = imported(path)
    assert len(streams["/fix"]) == 5
    assert np.isnan(streams["/fix"]["altitude_m"]).all()
    assert notes["/fix: stamps repeat, but are kept"] == "1"
    assert notes["/fix: stamps go back in time, so they are sorted"] == "1"
    assert notes["/gps: fix dropped: NaN or infinite"] == "1"
    assert notes["/gps: fix dropped: without a fix"] == "1"
    assert notes["not taken, /scan"] == "3 sensor_msgs/msg/LaserScan"
    run, _ = import_log("ros", path, {}, tmp_path / "out.mcap")
    written = read_streams(open_log(tmp_path / "out.mcap"), ["/fix"])["/fix"]
    assert (np.diff(written.publish_time_ns) >= 0).all()
    assert run.notes == notes


def test_halves_that_a_message_says_it_has_not_are_missing(tmp_path: Path) -> None:
    """A covariance that begins with -1: what stands beside it is no measurement, row by row."""
    make, none = Maker(), [-1.0, *[0.0] * 8]
    kinds = {
        "whole": {},
        "accelerometer": {"angular_velocity_covariance": none, "angular_velocity__z": np.nan},
        "gyro": {"linear_acceleration_covariance": none},
        "neither": {"angular_velocity_covariance": none, "linear_acceleration_covariance": none},
    }
    sent: list[Sent] = [
        ("/imu", START_NS + number, make("sensor_msgs/msg/Imu", START_NS + number, **given))
        for number, given in enumerate(kinds.values())
    ]
    no_twist = [-1.0, *[0.0] * 35]
    sent += [
        ("/odom", START_NS + number,
         make("nav_msgs/msg/Odometry", START_NS + number, twist__covariance=[own] * 36))
        for number, own in enumerate((1.0, -1.0))
    ]  # fmt: skip
    sent[-1][2].twist.covariance[:] = no_twist
    denied = {
        "/amcl_pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", "pose__covariance", 36),
        "/velocity": ("geometry_msgs/msg/TwistWithCovarianceStamped", "twist__covariance", 36),
        "/mag": ("sensor_msgs/msg/MagneticField", "magnetic_field_covariance", 9),
    }
    sent += [
        (topic, START_NS + number, make(kind, START_NS + number, **{field: [own] + [0.0] * (width - 1)}))
        for topic, (kind, field, width) in denied.items()
        for number, own in enumerate((1.0, -1.0))
    ]
    streams, notes = imported(write_bag(tmp_path / "bag", "mcap", sent, make.store))
    inertial = streams["/inertial"]
    assert inertial.publish_time_ns.tolist() == [START_NS + number for number in range(3)]
    assert np.isfinite(inertial["specific_force_mps2"]).all(axis=1).tolist() == [True, True, False]
    assert np.isfinite(inertial["turn_rate_radps"]).all(axis=1).tolist() == [True, False, True]
    without = "/imu: inertial kept without"
    assert notes[f"{without} specific forces: linear_acceleration_covariance[0] is -1"] == "1"
    assert notes[f"{without} turn rates: angular_velocity_covariance[0] is -1"] == "1"
    assert notes["/imu: inertial dropped: without specific forces and turn rates"] == "1"
    names = ("/odometry", "/odometry_twist", "/pose", "/twist", "/magnetic_field")
    assert [len(streams[name]) for name in names] == [1] * 5
    assert notes["/odom: odometry dropped: without a twist: twist.covariance[0] is -1"] == "1"


def test_what_stands_beside_the_messages_is_told(tmp_path: Path) -> None:
    """Attachments and metadata of an MCAP bag; an attachment whose name is not whole is a loss."""
    make, name, path = Maker(), "std_msgs/msg/Float64", tmp_path / "bag.mcap"
    definition, _ = make.store.generate_msgdef(name, ros_version=2)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(name, "ros2msg", definition.encode())
        channel = writer.register_channel("/level", "cdr", schema)
        level = bytes(make.store.serialize_cdr(make(name, data=0.75), name))
        writer.add_message(channel, START_NS, level, START_NS)
        writer.add_metadata("vendor", {"firmware": "7"})
        for words in (b"one", b"two"):
            writer.add_attachment(0, 0, "camera.yaml", "text/plain", words)
        writer.finish()
    streams, notes = imported(path)
    assert streams["/value"]["value"].tolist() == [[0.75]]
    assert notes["not taken, attachment camera.yaml"] == "2, not a topic"
    assert notes["not taken, metadata vendor"] == "1, not a topic"
    head = (11).to_bytes(4, "little") + b"camera.yaml"
    path.write_bytes(path.read_bytes().replace(head, b"\xff" * 3 + head[3:], 1))
    _, notes = imported(path)
    assert "its name is incomplete" in notes["lost (1)"]
    assert notes["not taken, attachment camera.yaml"].startswith("1, ")


def test_noise_densities_are_those_of_stated_covariances(tmp_path: Path) -> None:
    """By the step of 10 ms; zeros, -1 and what no sensor has state nothing, and the last is told."""
    make, stamps = Maker(), [START_NS + number * STEP_NS for number in range(9)]
    twist = np.diag([0.04, 1.0, 1.0, 1.0, 1.0, 0.0009]).ravel()
    own, absurd, zeros = np.diag([0.01, 0.01, 0.04]).ravel(), 1e6 * np.eye(3).ravel(), [0.0] * 9
    cases: list[tuple[str, str, dict[str, Any]]] = [
        ("/a/odom", "nav_msgs/msg/Odometry", {"twist__covariance": twist}),
        ("/b/odom", "nav_msgs/msg/Odometry", {"twist__covariance": [0.0] * 36}),
        ("/a/imu", "sensor_msgs/msg/Imu",
         {"linear_acceleration_covariance": own, "angular_velocity_covariance": absurd}),
        ("/b/imu", "sensor_msgs/msg/Imu",
         {"linear_acceleration_covariance": zeros, "angular_velocity_covariance": [-1.0, *zeros[1:]]}),
    ]  # fmt: skip
    sent = [
        (topic, stamp, make(kind, stamp, **given)) for stamp in stamps for topic, kind, given in cases
    ]
    streams, notes = imported(write_bag(tmp_path / "bag", "mcap", sent, make.store))
    stated = {
        topic: {
            name: float(value) for name, value in streams[topic].metadata.items() if "density" in name
        }
        for topic in ("/a/odometry", "/b/odometry", "/a/inertial", "/b/inertial")
    }
    assert stated == {
        "/a/odometry": {
            "forward_noise_density": pytest.approx(0.02),
            "turn_noise_density": pytest.approx(0.003),
        },
        "/b/odometry": {},
        "/a/inertial": {"force_noise_density": pytest.approx(0.1 * 0.02**0.5, rel=1e-5)},
        "/b/inertial": {},
    }
    assert notes["/a/odometry: forward_noise_density"] == (
        "0.02, of a standard deviation of 0.2 m/s every 0.01 s"
    )
    absurd_note = "not stated, since a standard deviation of 1e+03 rad/s is implausible for a sensor"
    assert notes["/a/inertial: gyro_noise_density"] == absurd_note


def test_frames_and_constants_that_change(tmp_path: Path) -> None:
    """A second frame of a topic is another stream; a covariance that changes is told."""
    make = Maker()
    own = np.eye(3).ravel()
    sent: list[Sent] = [
        ("/point", START_NS + number, make("geometry_msgs/msg/PointStamped", header__frame_id=frame))
        for number, frame in enumerate(["map", "odom", "map", "gps"])
    ]
    sent += [
        ("/imu", START_NS + number,
         make("sensor_msgs/msg/Imu", angular_velocity_covariance=own * (1 + number),
              linear_acceleration_covariance=own, orientation_covariance=own))
        for number in range(3)
    ]  # fmt: skip
    streams, notes = imported(write_bag(tmp_path / "bag", "db3", sent, make.store))
    assert (len(streams["/position"]), len(streams["/position/odom"])) == (2, 1)
    for frame in ("odom", "gps"):  # longer and as long as the first one's
        assert streams[f"/position/{frame}"].metadata == {"frame_id": frame}
    fact = "kept although turn_rate_covariance_rad2ps2 differs from the first, which is stated"
    assert notes[f"/imu: inertial {fact}"] == "2"


def test_messages_of_ones_own_by_a_mapping(tmp_path: Path) -> None:
    """Fields by their paths, scaled, with a stamp of their own; what is wrong with a mapping is told."""
    make = Maker()
    name = "my_robot_msgs/msg/Wheels"
    sent: list[Sent] = [
        ("/wheels", START_NS + number, make(name, at=START_NS - 1000 + number, left__speed=3.5))
        for number in range(3)
    ]
    path = write_bag(tmp_path / "bag", "db3", sent, make.store)
    mapping = tmp_path / "mapping.toml"
    text = f"""[messages."{name}"]
becomes = "VectorMeasurement"
name = "wheels"
fields = {{ value = ["left.speed", "right.speed", "raw"] }}
factors = {{ value = 2.0 }}
components = "left_mps,right_mps,a,b,c"
stamp = "at"
"""
    mapping.write_text(text)
    wheels = imported(path, mapping=str(mapping))[0]["/wheels"]
    expected = [[2 * 3.5, 2 * m.right.speed, *(2.0 * m.raw)] for _, _, m in sent]
    assert wheels["value"].tolist() == expected
    assert wheels.components == ["left_mps", "right_mps", "a", "b", "c"]
    assert wheels.publish_time_ns.tolist() == [START_NS - 1000, START_NS - 999, START_NS - 998]
    mapping.write_text(text.replace("factors = { value = 2.0 }", 'units = { value = "km/h" }'))
    assert "the unit 'km/h' does not fit: a has no unit" in refusal(path, mapping=str(mapping))
    in_units = 'units = { value = ["km/h", "cm/s", "", "", ""] }\nwhere = { "left.speed" = 3.5 }'
    mapping.write_text(text.replace("factors = { value = 2.0 }", in_units))
    wheels = imported(path, mapping=str(mapping))[0]["/wheels"]
    expected = [[3.5 / 3.6, m.right.speed / 100, *m.raw] for _, _, m in sent]
    np.testing.assert_allclose(wheels["value"], expected)
    for old, new, sentence in [
        (
            '"left.speed"',
            '"left.sped"',
            f"the mapping of {name}: this type has no numeric field 'left.sped'; did you mean",
        ),
        (
            "VectorMeasurement",
            "VectorMesurement",
            "fuselog has no message 'VectorMesurement'; did you mean",
        ),
        ("{ value =", "{ values =", "VectorMeasurement has no field 'values'; did you mean 'value'?"),
        ("msg/Wheels", "msg/Wheel", f"is of type my_robot_msgs/msg/Wheel; did you mean '{name}'?"),
    ]:
        mapping.write_text(text.replace(old, new))
        assert sentence in refusal(path, mapping=str(mapping))


def test_bad_input_is_one_sentence_and_nothing_is_written(tmp_path: Path) -> None:
    """What is not a bag, not in it, or cannot be."""
    make = Maker()

    def bag(name: str, *sent: Any) -> Path:
        messages = [(topic, START_NS, message) for topic, message in sent]
        return write_bag(tmp_path / name, "mcap", messages, make.store)

    pose = "geometry_msgs/msg/PoseStamped"
    turned = bag("turned", ("/pose", make(pose, pose__orientation=[0.0, 0.0, 0.0, 0.5])))
    assert refusal(turned).startswith(
        "topic /pose: 1 of its quaternions is not of unit length, the first of length 0.5; check "
    )
    far = bag("far", ("/gps", make("sensor_msgs/msg/NavSatFix", latitude=90.5)))
    assert refusal(far) == "topic /gps: a latitude is 90.5 deg, beyond 90; check the column and its unit"
    scan = bag("scan", ("/scan", make("sensor_msgs/msg/LaserScan")), ("/pose", make(pose)))
    assert refusal(scan, topics="/scan") == (
        "topic /scan cannot be imported: it is sensor_msgs/msg/LaserScan; describe it with "
        "--set mapping=FILE.toml"
    )
    assert refusal(scan, topics="/pos") == "has no topic /pos; did you mean '/pose'?"
    level = "std_msgs/msg/Float64"
    many = bag("many", *((f"/{letter}", make(level)) for letter in "hgfedcba"))
    assert refusal(many, topics="/zzz").endswith("available: /a, /b, /c, /d, /e, /f, /g, /h")
    mixed = bag("mixed", ("/pose", make(pose, 5_000_000_000)), ("/level", make("std_msgs/msg/Float64")))
    assert refusal(mixed) == (
        "mixed time bases: the stamps of /level (no header, the bag's) and of /pose are 1.7e+09 s "
        "apart; use --clock bag, or topics of one clock with --set topics=[...]"
    )
    assert len(imported(mixed, clock="bag")[0]) == 2
    sent = {
        "transforms": 1,
        "transforms.0.header.frame_id": "odom",
        "transforms.0.child_frame_id": "base",
    }
    other = {**sent, "transforms.0.header.frame_id": "map", "transforms.0.child_frame_id": "odometry"}
    tf = "tf2_msgs/msg/TFMessage"
    hole = bag("hole", ("/tf", make(tf, **sent)), ("/tf", make(tf, **other)))
    assert refusal(hole, transforms="map:base") == (
        "no transforms lead from 'map' to 'base': from 'map' they end at 'map', from 'base' at 'odom'; "
        "record the missing transform, or name another pair"
    )
    assert "no transform has the frame 'bas'" in refusal(hole, transforms=["map:bas"])
    assert "expected a pair of frames" in refusal(hole, transforms="map")
    (tmp_path / "empty").mkdir()
    assert refusal(tmp_path / "empty").startswith("contains no bag; give a .bag, .db3 or .mcap file")
    for name in ("a.bag", "a.db3", "a.mcap", "a.txt"):
        (tmp_path / name).write_text("no bag at all" * 10)
        assert refusal(tmp_path / name)


def test_big_endian_and_damaged_messages(tmp_path: Path) -> None:
    """Plain CDR of either byte order; a message shorter than its type is counted and left out."""
    make, path = Maker(), tmp_path / "bag"
    name = "geometry_msgs/msg/PointStamped"
    messages = [make(name, START_NS + number) for number in range(4)]
    with Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/point", name, typestore=make.store)
        for number, message in enumerate(messages):
            raw = make.store.serialize_cdr(message, name, little_endian=number % 2 == 0)
            bag.write(topic, START_NS + number, raw)
        bag.write(topic, START_NS + 4, raw[:-8])
    streams, notes = imported(path)
    expected = [[m.point.x, m.point.y, m.point.z] for m in messages]
    assert streams["/position"]["position_m"].tolist() == expected
    told = "/point: cannot be decoded (it is shorter than its definition says) and are left out"
    assert notes[told] == "1"


def test_a_bag_is_imported_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small blocks give the same log as one block; so do composed transforms."""
    make = Maker()
    sent: list[Sent] = []
    for number in range(200):
        stamp = START_NS + number * STEP_NS
        pairs = [("map", "odom")] * (number % 10 == 0) + [("odom", "base_link")]
        for parent, child in pairs:
            frames = {"transforms.0.header.frame_id": parent, "transforms.0.child_frame_id": child}
            stamped = {"transforms": 1, "transforms.0.header.stamp": stamp, **frames}
            sent.append(("/tf", stamp, make("tf2_msgs/msg/TFMessage", **stamped)))
        sent.append(("/odom", stamp, make("nav_msgs/msg/Odometry", stamp)))
    path = write_bag(tmp_path / "bag", "bag", sent, make.store)
    whole, notes = imported(path, transforms="map:base_link")
    monkeypatch.setattr(importer, "_BLOCK_MESSAGES", 25)
    found = importer.read(path, RosParameters(transforms=["map:base_link"]))
    sizes = [max(map(len, block)) for block in found.blocks if block]
    assert len(sizes) > 10
    assert max(sizes) < 50
    in_blocks, notes_of_blocks = imported(path, transforms="map:base_link")
    assert notes_of_blocks == notes
    for topic, stream in whole.items():
        assert_array_equal(in_blocks[topic].publish_time_ns, stream.publish_time_ns)
        for name, column in stream.columns.items():
            assert_allclose(in_blocks[topic][name], column, atol=1e-12)
    assert len(whole["/tf/map/base_link"]) == 191
