"""Transformation of targets' true positions into the estimates' frame, using the frame's true pose."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fuselog.recorders.log import Topic, schemas, topics_of
from fuselog.recorders.log.planes import BODY, FRAME, body_of, frame_in_words, frame_of
from fuselog.recorders.models.planar import into_frame
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.vectors.components import Components, match_components
from fuselog.replay.engine.vectors.tangent import truth_at
from fuselog.replay.judging.errors.truths import Truths

POSE: Components = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}


def pose_topic(topics: Mapping[str, Topic], frame: str, into: str) -> str | None:
    """Find the truth that states the pose of one frame in another frame."""
    for topic in topics_of(topics, schemas.TRUTH_STATE):
        stated = topics[topic].metadata
        is_pose = POSE.keys() <= set(stated.get("components", "").split(","))
        if is_pose and body_of(topic, stated) == frame and frame_of(stated) == into:
            return topic
    return None


def not_comparable(stated: Mapping[str, str], truths: Sequence[str], topics: Mapping[str, Topic]) -> str:
    """Explain why positions cannot be compared with truths in another frame, or return "".

    Args:
        stated: metadata of the estimates' channel.
        truths: the topics of the targets.
        topics: topics of the run.
    """
    frame, is_planar = frame_of(stated), {"x_m", "y_m"} <= set(stated.get("components", "").split(","))
    for topic in truths:
        into = frame_of(topics[topic].metadata)
        if frame != into and not (is_planar and pose_topic(topics, frame, into)):
            own = frame_in_words(frame)
            pose = f"a truth with x_m, y_m and heading_rad, whose channel states {BODY} = {frame}"
            measured = f"the frame of the measurements as {FRAME} on their channels"
            return (
                f"they are in {own}, {topic} is in {frame_in_words(into)}, and no truth states the pose "
                f"of {own} in that frame; record {pose if frame else measured}"
            )
    return ""


def seen_in(
    frame: str, truths: Truths, topic: str, places: Floats, time_ns: Integers, gap_limit_s: float
) -> Floats:
    """Transform the positions of a target into a frame; a pose that is stated only once is constant.

    Args:
        frame: see `frame_of`; `not_comparable` must be empty for it.
        truths: truths of the run.
        topic: the truth of the target.
        places: (n, axes) positions in the frame of this topic, x and y first; heights are not changed.
        time_ns: (n,), the stamps.
        gap_limit_s: longest gap in s over which poses are interpolated.
    """
    topics = truths.source.topics
    into = frame_of(topics[topic].metadata)
    if frame == into:
        return places
    name = pose_topic(topics, frame, into)
    assert name is not None
    if topics[name].messages == 1:
        stream = truths.source.whole().read([name])[name]
        time_ns = np.full_like(time_ns, stream.publish_time_ns.max(initial=0))
    else:
        stream = truths.around(name, time_ns, gap_limit_s, f"{topic} in {frame}")
    columns = match_components(stream.metadata, POSE, f"topic {name}")
    known = replace(stream, columns={"state": stream["state"].reshape(len(stream), -1)[:, columns]})
    pose = truth_at(known, time_ns, list(POSE.values()), gap_limit_s)
    moved = into_frame(tuple(pose.T), tuple(places[:, :2].T))
    return np.column_stack([*moved, places[:, 2:]])
