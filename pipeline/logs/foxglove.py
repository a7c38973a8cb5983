"""The Foxglove mirror of a log's streams: messages that Foxglove can show without fuselog.

Only viewers use these messages: no replay reads them, and they are not counted as a log's streams. The
schemas are Foxglove's own, https://docs.foxglove.dev/docs/sdk/schemas.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any
from zlib import crc32

import numpy as np
from google.protobuf.message import Message
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import some_of
from fuselog.recorders.extras import extra
from fuselog.recorders.log import Log, Mirror, Stream, schemas
from fuselog.recorders.log.mirrors import MIRROR_OF
from fuselog.recorders.log.planes import body_of, world_of
from fuselog.replay.engine.streams.geodetic import covariances_of_fixes
from fuselog.replay.engine.streams.measurements import PLANE, covariances_of
from fuselog.replay.engine.vectors.tangent import manifold_blocks
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.judging.errors.trajectory_streams import trajectory_of
from fuselog.replay.timeline.drawing.canvas import PALETTE, TRUTH

with extra("foxglove", "messages of Foxglove"):
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

POINT_M = 0.3
LABEL_PX = 12.0
LINE_PX = 2.0
# Time in seconds for which a viewer shows a track after its last message.
TRACK_S = 60

Made = Iterator[tuple[str, Message, int]]


def mirrors(stream: Stream) -> Iterator[Mirror]:
    """Yield the Foxglove messages that mirror a stream, or a block of one.

    Poses, fixes, truths and estimates with a position become PoseInFrame and, with an orientation,
    FrameTransforms. Orientations without a position become poses at the origin. Lines of sight of moving
    sensors become poses at the sensor, with the x axis along the line. 95 % ellipses, tracks and
    landmarks become SceneUpdate, particles and detections become PosesInFrame, and geodetic fixes become
    LocationFix. The topic is `/foxglove`, followed by the stream's topic and a word for the content.
    Priors have no mirror.
    """
    make = _MAKERS.get(stream.schema.full_name)
    is_stated = stream.topic.startswith("/estimates/")
    is_prior = stream.schema.full_name == schemas.GAUSSIAN_ESTIMATE.full_name and not is_stated
    if make is None or is_prior or len(stream) == 0:
        return
    for leaf, message, row in make(stream):
        yield Mirror(
            f"/foxglove{stream.topic}/{leaf}",
            stream.topic,
            message,
            int(stream.log_time_ns[row]),
            int(stream.publish_time_ns[row]),
        )


def left_out(log: Log) -> str:
    """Describe those streams of a log that have no Foxglove mirror; return "" if all have one."""
    shown = {topic.metadata[MIRROR_OF] for topic in log.mirrors.values()}
    topics = [name for name, topic in log.topics.items() if topic.messages and name not in shown]
    return sentence_of(topics) if topics else ""


def sentence_of(topics: Sequence[str]) -> str:
    """Write a sentence which states that these topics have no Foxglove mirror."""
    return f"omitted, because Foxglove has no message for them: {some_of(topics)}"


def _states(stream: Stream) -> Made:
    """Make the poses of truths and estimates, and the ellipses of estimates."""
    field = "mean" if "mean" in stream.columns else "state"
    rows = np.flatnonzero(np.isfinite(stream[field]).all(axis=1))
    known = stream.take(rows)
    trajectory = trajectory_of(known)
    if trajectory is None:
        kinds = known.metadata.get("kinds", "").split(",")
        turned = [columns for kind, columns in manifold_blocks(kinds) if kind == "quaternion"]
        if len(turned) == 1:
            yield from _turns(known, rows, known[field][:, turned[0]])
        return
    quaternions = None
    if trajectory.rotation is not None:
        quaternions = Rotation.from_matrix(trajectory.rotation).as_quat(scalar_first=True)
    yield from _poses(known, rows, trajectory.position_m, quaternions)
    if "covariance" in stream.columns and set(PLANE) <= set(stream.components):
        outlines = _outlines(known)
        for row, number in enumerate(rows.tolist()):
            if np.isfinite(outlines[row]).all():
                scene = SceneUpdate()
                entity = _add_entity(scene, known, row, stream.topic)
                _add_outline(entity, outlines[row], trajectory.position_m[row, 2], _colour(stream))
                yield "ellipse", scene, number


def _fixes(stream: Stream) -> Made:
    """Make poses from positions, oriented along the course if the fixes have one."""
    places, quaternions = _padded(stream["position_m"]), None
    if "course_rad" in stream.columns:
        heading_rad = 0.5 * np.pi - np.nan_to_num(stream["course_rad"])
        quaternions = Rotation.from_euler("z", heading_rad[:, None]).as_quat(scalar_first=True)
    for row, pose in enumerate(_in_frame(stream, places, quaternions)):
        yield "pose", pose, row


def _stated_poses(stream: Stream) -> Made:
    yield from _poses(stream, np.arange(len(stream)), stream["position_m"], stream["quaternion"])


def _orientations(stream: Stream) -> Made:
    yield from _turns(stream, np.arange(len(stream)), stream["quaternion"])


def _turns(stream: Stream, rows: np.ndarray[Any, np.dtype[np.int64]], quaternions: Floats) -> Made:
    """Make poses at the origin from quaternions (n, 4) with w first, omitting invalid ones."""
    known = np.isfinite(quaternions).all(axis=1) & (np.linalg.norm(quaternions, axis=1) > 0.0)
    places = np.zeros((np.count_nonzero(known), 3))
    yield from _poses(stream.take(known), rows[known], places, quaternions[known])


def _sights(stream: Stream) -> Made:
    """Make poses at moving sensors, with the x axis along the line of sight."""
    angles = np.stack([stream["azimuth_rad"], -stream["elevation_rad"]], axis=1)
    known = np.flatnonzero(np.isfinite(angles).all(axis=1))
    seen = stream.take(known)
    turned = Rotation.from_quat(seen["quaternion"], scalar_first=True)
    forward = Rotation.from_euler(
        "y", -0.5 * np.pi
    )  # rotates x to the line of sight if both angles are zero
    lines = (turned * Rotation.from_euler("YX", angles[known]) * forward).as_quat(scalar_first=True)
    for row, pose in enumerate(_in_frame(seen, seen["position_m"], lines)):
        yield "pose", pose, int(known[row])


def _poses(
    stream: Stream, rows: np.ndarray[Any, np.dtype[np.int64]], places: Floats, quaternions: Floats | None
) -> Made:
    """Make poses, and transforms if there is an orientation."""
    for row, pose in enumerate(_in_frame(stream, places, quaternions)):
        yield "pose", pose, int(rows[row])
        if quaternions is not None:
            transforms = FrameTransforms()
            turned = transforms.transforms.add(
                parent_frame_id=pose.frame_id,
                child_frame_id=body_of(stream.topic, stream.metadata),
            )
            turned.timestamp.CopyFrom(pose.timestamp)
            _set_vector(turned.translation, places[row])
            turned.rotation.CopyFrom(pose.pose.orientation)
            yield "transforms", transforms, int(rows[row])


def _in_frame(stream: Stream, places: Floats, quaternions: Floats | None) -> Iterator[PoseInFrame]:
    """Yield a pose for each position (n, 3) and quaternion (n, 4), by default without rotation."""
    for row, place in enumerate(places):
        pose = PoseInFrame(frame_id=world_of(stream.metadata))
        pose.timestamp.FromNanoseconds(int(stream.publish_time_ns[row]))
        _set_pose(pose.pose, place, None if quaternions is None else quaternions[row])
        yield pose


def _location_fixes(stream: Stream) -> Made:
    for row, covariance in enumerate(covariances_of_fixes(stream)):
        fix = LocationFix(
            frame_id=world_of(stream.metadata),
            latitude=stream["latitude_deg"][row],
            longitude=stream["longitude_deg"][row],
            altitude=stream["altitude_m"][row],
        )
        fix.timestamp.FromNanoseconds(int(stream.publish_time_ns[row]))
        is_known = bool(np.isfinite(covariance[:2, :2]).all())
        fix.position_covariance_type = LocationFix.KNOWN if is_known else LocationFix.UNKNOWN
        if is_known:
            fix.position_covariance.extend(np.nan_to_num(covariance).ravel().tolist())
        yield "location", fix, row


def _landmarks(stream: Stream) -> Made:
    """Make spheres that stay visible, labelled with the numbers of the landmarks."""
    scene = SceneUpdate()
    for row, place in enumerate(_padded(stream["position_m"])):
        number = int(stream["landmark_id"][row])
        entity = _add_entity(scene, stream, row, str(number))
        _add_point(entity, place, str(number), TRUTH)
    yield "scene", scene, 0


def _tracks(stream: Stream) -> Made:
    """Make a scene for each stamp, with a numbered sphere and an ellipse for each track."""
    if not set(PLANE) <= set(stream.components):
        return
    outlines = _outlines(stream)
    columns = [stream.components.index(name) for name in PLANE]
    places = _padded(stream["mean"][:, columns])
    for rows in _by_stamp(stream):
        scene = SceneUpdate()
        for row in rows:
            number = int(stream["track_id"][row])
            entity = _add_entity(scene, stream, row, str(number))
            entity.lifetime.FromSeconds(TRACK_S)
            colour = PALETTE[number % len(PALETTE)]
            _add_point(entity, places[row], str(number), colour)
            if np.isfinite(outlines[row]).all():
                _add_outline(entity, outlines[row], 0.0, colour)
        yield "scene", scene, rows[0]


def _particles(stream: Stream) -> Made:
    if set(PLANE) <= set(stream.components):
        columns = [stream.components.index(name) for name in PLANE]
        yield from _scans(stream, _padded(stream["mean"][:, columns]))


def _detections(stream: Stream) -> Made:
    yield from _scans(stream, _padded(stream["position_m"]))


def _scans(stream: Stream, places: Floats) -> Made:
    """Make a message for each stamp, from the positions (n, 3) of all stamps."""
    for rows in _by_stamp(stream):
        poses = PosesInFrame(frame_id=world_of(stream.metadata))
        poses.timestamp.FromNanoseconds(int(stream.publish_time_ns[rows[0]]))
        for row in rows:
            _set_pose(poses.poses.add(), places[row], None)
        yield "poses", poses, rows[0]


def _by_stamp(stream: Stream) -> Iterator[list[int]]:
    """Yield the rows of each stamp, which are consecutive."""
    stamps = stream.publish_time_ns
    for _, rows in groupby(range(len(stream)), lambda row: stamps[row]):
        yield list(rows)


def _outlines(stream: Stream) -> Floats:
    """Compute the 95 % ellipses (n, vertices, 2) in the plane."""
    columns = [stream.components.index(name) for name in PLANE]
    return ellipses(stream["mean"][:, columns], covariances_of(stream, PLANE))


def _add_entity(scene: Any, stream: Stream, row: int, name: str) -> Any:
    entity = scene.entities.add(frame_id=world_of(stream.metadata), id=name)
    entity.timestamp.FromNanoseconds(int(stream.publish_time_ns[row]))
    return entity


def _add_outline(entity: Any, outline: Floats, height_m: float, colour: Sequence[int]) -> None:
    line = entity.lines.add(type=LinePrimitive.LINE_LOOP, thickness=LINE_PX, scale_invariant=True)
    _set_pose(line.pose, np.zeros(3), None)
    _set_colour(line.color, colour)
    for x, y in outline[:-1].tolist():
        line.points.add(x=x, y=y, z=height_m)


def _add_point(entity: Any, place: Floats, label: str, colour: Sequence[int]) -> None:
    sphere = entity.spheres.add()
    _set_pose(sphere.pose, place, None)
    _set_vector(sphere.size, np.full(3, POINT_M))
    _set_colour(sphere.color, colour)
    text = entity.texts.add(text=label, billboard=True, font_size=LABEL_PX, scale_invariant=True)
    _set_pose(text.pose, place + np.array([0.0, 0.0, POINT_M]), None)
    _set_colour(text.color, colour)


def _set_pose(pose: Any, place: Floats, quaternion: Floats | None) -> None:
    """Set the position and orientation of a pose, by a quaternion with w first."""
    _set_vector(pose.position, place)
    w, x, y, z = (1.0, 0.0, 0.0, 0.0) if quaternion is None else quaternion.tolist()
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = x, y, z, w


def _set_vector(vector: Any, values: Floats) -> None:
    vector.x, vector.y, vector.z = values.tolist()


def _set_colour(colour: Any, values: Sequence[int]) -> None:
    colour.r, colour.g, colour.b = (value / 255 for value in values)
    colour.a = 1.0


def _colour(stream: Stream) -> Sequence[int]:
    return PALETTE[crc32(stream.topic.encode()) % len(PALETTE)]


def _padded(places: Floats) -> Floats:
    """Extend positions (n, 1 to 3) to three dimensions with zeros."""
    padded = np.zeros((len(places), 3))
    padded[:, : places.shape[1]] = places[:, :3]
    return padded


_MAKERS: dict[str, Callable[[Stream], Made]] = {
    schemas.TRUTH_STATE.full_name: _states,
    schemas.GAUSSIAN_ESTIMATE.full_name: _states,
    schemas.POSE.full_name: _stated_poses,
    schemas.ORIENTATION.full_name: _orientations,
    schemas.MOVING_LINE_OF_SIGHT.full_name: _sights,
    schemas.POSITION_FIX.full_name: _fixes,
    schemas.COURSE_FIX.full_name: _fixes,
    schemas.GEODETIC_FIX.full_name: _location_fixes,
    schemas.LANDMARK.full_name: _landmarks,
    schemas.TRACK_ESTIMATE.full_name: _tracks,
    schemas.DENSITY_ESTIMATE.full_name: _particles,
    schemas.DETECTION.full_name: _detections,
}
