"""Bags of ROS 2 with the estimates, truths, poses and geodetic fixes of a log.

    estimate     PoseWithCovarianceStamped, or Odometry if it has an orientation and a velocity;
                 TFMessage on /tf if it has an orientation;
                 NavSatFix on TOPIC/fix if the origin of its local tangent plane is known
    truth        PoseStamped
    Pose         PoseWithCovarianceStamped
    GeodeticFix  NavSatFix

Units, axes and frames are those of REP 103 and REP 105. Covariances are row-major and refer to positions
and to rotations about the fixed axes. Unknown covariances are zero. A robot in the plane has zero
height, roll and pitch with zero variances, as in amcl. If a covariance is known only in part, the other
variances are `UNKNOWN`, as in configurations of diff_drive_controller.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.log import Log, Schema, Stream, read_blocks, schemas
from fuselog.recorders.log.planes import BODY, Origin, common_origin, in_plane, stated_in, world_of
from fuselog.recorders.models.geodesy import out_of_tangent_plane, tangent_axes
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.geodetic import covariances_of_fixes
from fuselog.replay.engine.streams.planes import HEADING, VECTORS
from fuselog.replay.engine.vectors.components import in_world_axes, stated_components
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.judging.errors.trajectory_streams import trajectory_of

UNKNOWN = 1e6
BASE, TRANSFORMS = "base_link", "/tf"
# Rows of the position, rotation and velocity in the covariance of a body.
PLACE, TURN, VELOCITY = range(3), range(3, 6), range(6, 9)
# The version of metadata.yaml; ROS before Jazzy does not read later ones.
_VERSION: Literal[8] = 8
# Messages of ROS are Python objects, about 5 kB for each row, so blocks are small.
_BLOCK_MESSAGES = 1 << 14
_STORE = get_typestore(Stores.ROS2_JAZZY)


class _Sent(NamedTuple):
    """A message, its topic in ROS, and the row of the stream from which it was made."""

    topic: str
    message: Any
    row: int


class _Bodies(NamedTuple):
    """Positions (n, 3), quaternions x, y, z, w (n, 4), and velocities (n, 3) or None, of bodies.

    The covariance (n, 9, 9) is of position, rotation and velocity along the fixed axes; it is zero if
    unknown.
    """

    position_m: Floats
    quaternion: Floats
    covariance: Floats
    velocity_mps: Floats | None = None


def write_bag(
    log: Log, topics: Sequence[str], folder: Path, storage: StoragePlugin, notes: list[str]
) -> list[str]:
    """Write topics of a log to the new bag `folder`; notes report what its messages do not contain.

    Returns the topics that have messages. Raises BadInput if two topics would have the same name in ROS,
    or if ROS cannot represent a stamp.
    """
    origin = common_origin({name: topic.metadata for name, topic in log.topics.items()})
    frames = _body_frames(log, topics)
    written, omitted = Counter[str](), Counter[str]()
    connections: dict[tuple[str, str], Any] = {}
    with Writer(folder, version=_VERSION, storage_plugin=storage) as bag:
        for block in read_blocks(log, topics, block_messages=_BLOCK_MESSAGES):
            for topic, stream in block.items():
                known = in_plane(stream.take(_finite(stream)), origin)
                omitted[topic] += len(stream) - len(known)
                if not len(known):
                    continue
                _check_stamps(log, known)
                notes += [] if topic in written else _lacking(known)
                written[topic] += len(known)
                for name, message, row in _messages(known, frames.get(topic, "")):
                    key, kind = (name if name == TRANSFORMS else topic, name), message.__msgtype__
                    if key not in connections:
                        if any(each.topic == name for each in bag.connections):
                            raise BadInput(
                                f"{log.path}: two topics would have the same name {name} in ROS; export "
                                f"{topic} alone with --topic"
                            )
                        connections[key] = bag.add_connection(name, kind, typestore=_STORE)
                    raw = _STORE.serialize_cdr(message, kind)
                    bag.write(connections[key], int(known.log_time_ns[row]), raw)
    notes += [
        f"{topic}: {count} messages are not finite and were omitted"
        for topic, count in omitted.items()
        if count
    ]
    return [topic for topic in topics if topic in written]


def _body_frames(log: Log, topics: Sequence[str]) -> dict[str, str]:
    """Return the body's frame for each topic of estimates: as stated, or `base_link`.

    A frame can have only one parent, so if several topics state the same frame, each gets its own frame,
    named after the topic and the stated frame.
    """
    stated = {
        topic: log.topics[topic].metadata.get(BODY) or BASE
        for topic in topics
        if log.topics[topic].schema_name == schemas.GAUSSIAN_ESTIMATE.full_name
    }
    counts = Counter(stated.values())
    return {
        topic: frame if counts[frame] == 1 else f"{topic.strip('/')}/{frame}"
        for topic, frame in stated.items()
    }


def _finite(stream: Stream) -> NDArray[np.bool_]:
    """Test which messages (n,) have a finite state or position."""
    needed = {"mean", "state", "position_m", "quaternion", "latitude_deg", "longitude_deg"}
    columns = [stream[name].reshape(len(stream), -1) for name in needed & set(stream.columns)]
    return np.isfinite(np.hstack(columns)).all(axis=1)


def _check_stamps(log: Log, stream: Stream) -> None:
    if stream.publish_time_ns.min() < 0 or stream.publish_time_ns.max() >= 10**9 << 31:
        raise BadInput(
            f"{log.path}: topic {stream.topic}: has a stamp before 1970 or after 2038-01-19, which ROS "
            "cannot state; export it as csv"
        )


def _lacking(stream: Stream) -> list[str]:
    """Write sentences on what the messages of a state do not contain."""
    if not (_is(stream, schemas.GAUSSIAN_ESTIMATE) or _is(stream, schemas.TRUTH_STATE)):
        return []
    rows, found = _rows(stream), []
    if not _is_turned(rows):
        found.append(f"{stream.topic}: has no orientation; the identity is written instead")
    others = [name for name in _tangent(stream) if name not in rows and name != HEADING]
    if others:
        found.append(f"{stream.topic}: omitted, because ROS has no field for them: {some_of(others)}")
    return found


def _tangent(stream: Stream) -> dict[str, str]:
    """Return the names and kinds of the rows of a state's covariance."""
    stated = stated_components(stream.metadata, {}, f"topic {stream.topic}")
    return dict(tangent_components(list(stated), list(stated.values())))


def _rows(stream: Stream) -> dict[str, int]:
    """Return the row in the covariance of `_Bodies` for each row of a state's covariance, by name.

    Velocities of truths are not written, and neither are velocities of estimates without an orientation,
    because Odometry states velocities along the axes of the body.
    """
    kinds = _tangent(stream)
    turns = [name for name, kind in kinds.items() if kind == "rotation"]
    rows = dict(zip(VECTORS[0], PLACE, strict=True))
    if len(turns) == len(TURN):
        rows |= dict(zip(turns, TURN, strict=True))
    elif kinds.get(HEADING) == "angle":
        rows[HEADING] = TURN[-1]
    if _is_turned(rows) and "mean" in stream.columns and set(VECTORS[1][:2]) <= set(kinds):
        rows |= dict(zip(VECTORS[1], VELOCITY, strict=True))
    return {name: row for name, row in rows.items() if name in kinds}


def _is_turned(rows: Mapping[str, int]) -> bool:
    return any(row in TURN for row in rows.values())


def _bodies(stream: Stream) -> _Bodies:
    """Read the bodies (n,) of finite estimates, truths or poses."""
    covariance = np.zeros((len(stream), 9, 9))
    if _is(stream, schemas.POSE):
        stated = stream["covariance"].reshape(-1, 6, 6)
        covariance[:, :6, :6] = np.where(np.isfinite(stated).all((1, 2), keepdims=True), stated, 0.0)
        return _Bodies(stream["position_m"], stream["quaternion"][:, [1, 2, 3, 0]], covariance)
    trajectory, rows, names = trajectory_of(stream), _rows(stream), list(_tangent(stream))
    assert trajectory is not None
    position_m, quaternion = trajectory.position_m, np.tile([0.0, 0.0, 0.0, 1.0], (len(stream), 1))
    if trajectory.rotation is not None:
        quaternion = Rotation.from_matrix(trajectory.rotation).as_quat()
    if _is(stream, schemas.TRUTH_STATE):
        return _Bodies(position_m, quaternion, covariance)
    stated = in_world_axes(stream)["covariance"].reshape(-1, len(names), len(names))
    here, there = [names.index(name) for name in rows], [*rows.values()]
    covariance[:, np.array(there)[:, None], there] = stated[:, np.array(here)[:, None], here]
    if not _is_turned(rows):
        covariance[:, TURN, TURN] = UNKNOWN * _is_stated(covariance)[:, None]
    if VELOCITY[0] not in there:
        return _Bodies(position_m, quaternion, covariance)
    velocity_mps = np.zeros((len(stream), 3))
    for axis, name in enumerate(VECTORS[1]):
        if name in rows:
            velocity_mps[:, axis] = stream["mean"][:, stream.components.index(name)]
    return _Bodies(position_m, quaternion, covariance, velocity_mps)


def _is_stated(covariance: Floats) -> NDArray[np.bool_]:
    """Test which covariances (n, d, d) are known, that is, not zero."""
    is_stated: NDArray[np.bool_] = (covariance != 0.0).any(axis=(1, 2))
    return is_stated


def _messages(stream: Stream, body: str) -> Iterator[_Sent]:
    """Make the messages of finite data; `body` is the frame of the estimated body."""
    name, headers = _ros_name(stream.topic), _headers(stream)
    if _is(stream, schemas.GEODETIC_FIX):
        place = tuple(stream[each] for each in ("latitude_deg", "longitude_deg", "altitude_m"))
        yield from _fixes(name, headers, place, covariances_of_fixes(stream))
        return
    bodies = _bodies(stream)
    poses = [
        _made("geometry_msgs/msg/Pose", position=_point(place), orientation=_quaternion(turn))
        for place, turn in zip(bodies.position_m, bodies.quaternion, strict=True)
    ]
    if _is(stream, schemas.TRUTH_STATE):
        kind, fields = "geometry_msgs/msg/PoseStamped", [{"pose": pose} for pose in poses]
    else:
        covariances = bodies.covariance[:, :6, :6]
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        fields = [{"pose": _stated("Pose", *each)} for each in zip(poses, covariances, strict=True)]
    if bodies.velocity_mps is not None:
        kind = "nav_msgs/msg/Odometry"
        for each, twist in zip(fields, _twists(bodies, bodies.velocity_mps), strict=True):
            each |= {"child_frame_id": body, "twist": twist}
    for row, (header, each) in enumerate(zip(headers, fields, strict=True)):
        yield _Sent(name, _made(kind, header=header, **each), row)
    if not _is(stream, schemas.GAUSSIAN_ESTIMATE):
        return
    if _is_turned(_rows(stream)):
        for row, (header, pose) in enumerate(zip(headers, poses, strict=True)):
            yield _Sent(TRANSFORMS, _transform(header, body, pose), row)
    origin = stated_in(stream.topic, stream.metadata)
    if origin is not None:
        yield from _fixes(f"{name}/fix", headers, *_on_earth(stream, bodies, origin))


def _twists(bodies: _Bodies, velocity_mps: Floats) -> list[Any]:
    """Make the twists of moving bodies along their own axes; the turn rate is unknown."""
    back = Rotation.from_quat(bodies.quaternion).as_matrix().swapaxes(1, 2)
    jacobian = np.zeros((len(back), 3, 9))
    # a small rotation r of the body about the fixed axes changes R' v by R' (v x r)
    jacobian[:, :, TURN] = back @ np.cross(velocity_mps[:, None], np.eye(3)).swapaxes(1, 2)
    jacobian[:, :, VELOCITY] = back
    covariance = np.zeros((len(back), 6, 6))
    covariance[:, :3, :3] = jacobian @ bodies.covariance @ jacobian.swapaxes(1, 2)
    covariance[:, TURN, TURN] = UNKNOWN * _is_stated(bodies.covariance)[:, None]
    along, still = (back @ velocity_mps[:, :, None])[:, :, 0], _point(np.zeros(3), "Vector3")
    return [
        _stated(
            "Twist",
            _made("geometry_msgs/msg/Twist", linear=_point(linear, "Vector3"), angular=still),
            each,
        )
        for linear, each in zip(along, covariance, strict=True)
    ]


def _on_earth(stream: Stream, bodies: _Bodies, origin: Origin) -> tuple[tuple[Floats, ...], Floats]:
    """Convert positions in a plane to latitudes, longitudes, altitudes, and covariances (n, 3, 3)."""
    latitude_deg, longitude_deg, altitude_m = out_of_tangent_plane(tuple(bodies.position_m.T), origin)
    turn = tangent_axes(latitude_deg, longitude_deg) @ tangent_axes(*origin[:2]).T
    covariance = turn @ bodies.covariance[:, :3, :3] @ turn.swapaxes(1, 2)
    covariance[~_is_stated(covariance)] = np.nan
    if VECTORS[0][2] not in stream.components:
        altitude_m = np.full(len(stream), np.nan)
        covariance[:, 2] = covariance[:, :, 2] = np.nan
    return (latitude_deg, longitude_deg, altitude_m), covariance


def _fixes(
    name: str, headers: Sequence[Any], place: Sequence[Floats], covariance: Floats
) -> Iterator[_Sent]:
    """Make fixes from latitudes, longitudes, altitudes and covariances (n, 3, 3), NaN if unknown."""
    covariance, status = covariance.copy(), _made("sensor_msgs/msg/NavSatStatus", status=0, service=0)
    flat = ~np.isfinite(covariance).all(axis=(1, 2))
    covariance[flat, 2] = covariance[flat, :, 2] = 0.0
    covariance[flat, 2, 2] = UNKNOWN
    covariance[~np.isfinite(covariance).all(axis=(1, 2))] = 0.0
    for row, (header, *degrees_and_m) in enumerate(zip(headers, *place, strict=True)):
        latitude, longitude, altitude = map(float, degrees_and_m)
        fix = _made(
            "sensor_msgs/msg/NavSatFix",
            header=header,
            status=status,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=covariance[row].ravel(),
            position_covariance_type=3 if covariance[row].any() else 0,
        )
        yield _Sent(name, fix, row)


def _ros_name(topic: str) -> str:
    """Return a topic's name with only the characters that ROS allows.

    >>> _ros_name("/estimates/smoother:ekf/2/pose")
    '/estimates/smoother_ekf/_2/pose'
    """
    parts = filter(None, re.sub(r"[^A-Za-z0-9/]+", "_", topic).split("/"))
    return "".join(f"/_{part}" if part[0].isdigit() else f"/{part}" for part in parts)


def _is(stream: Stream, schema: Schema) -> bool:
    return stream.schema.full_name == schema.full_name


def _made(kind: str, **fields: Any) -> Any:
    """Make a message of ROS."""
    return _STORE.types[kind](**fields)


def _headers(stream: Stream) -> list[Any]:
    frame, headers = world_of(stream.metadata), []
    for stamp_ns in stream.publish_time_ns.tolist():
        seconds, rest_ns = divmod(stamp_ns, 10**9)
        stamp = _made("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest_ns)
        headers.append(_made("std_msgs/msg/Header", stamp=stamp, frame_id=frame))
    return headers


def _point(numbers: Floats, kind: str = "Point") -> Any:
    return _made(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", numbers.tolist(), strict=True)))


def _quaternion(numbers: Floats) -> Any:
    return _made("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", numbers.tolist(), strict=True)))


def _stated(kind: str, value: Any, covariance: Floats) -> Any:
    """Make a pose or twist with its covariance (6, 6)."""
    fields = {kind.lower(): value, "covariance": covariance.ravel()}
    return _made(f"geometry_msgs/msg/{kind}WithCovariance", **fields)


def _transform(header: Any, body: str, pose: Any) -> Any:
    """Make the transform that has the pose of a body."""
    place = pose.position
    shift = _made("geometry_msgs/msg/Vector3", x=place.x, y=place.y, z=place.z)
    moved = _made("geometry_msgs/msg/Transform", translation=shift, rotation=pose.orientation)
    kind = "geometry_msgs/msg/TransformStamped"
    return _made(
        "tf2_msgs/msg/TFMessage",
        transforms=[_made(kind, header=header, child_frame_id=body, transform=moved)],
    )
