"""Conversion of a run with positions in several local tangent planes to a single plane."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from fuselog.pipeline.altering.changes import Change
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, Topic, schemas
from fuselog.recorders.log.planes import LATITUDE, Origin, frame_of, is_planar, stated_in
from fuselog.replay.engine.streams.planes import into_plane_of


def in_one_plane(
    name: str, topics: Mapping[str, Topic], changes: Mapping[str, Change]
) -> dict[str, Change]:
    """Extend the changes of topics so that all positions are in one local tangent plane.

    This is the plane of the truth, in which errors are computed. Without truth, it is the plane of the
    first topic.

    Args:
        name: the run's name.
        topics: the topics that are stored in the run.
        changes: other alterations, by topic, which are applied first.

    Raises BadInput if planes differ and a topic with positions does not state its local tangent plane.
    """
    stating = {
        topic: changes[topic].stated(topics[changes[topic].stored]) if topic in changes else own
        for topic, own in topics.items()
    }
    stated = {topic: stated_in(topic, own.metadata) for topic, own in stating.items()}
    origins = {topic: origin for topic, origin in stated.items() if origin is not None}
    if len(set(origins.values())) < 2:
        return dict(changes)
    truths = [each for each in origins if stating[each].schema_name == schemas.TRUTH_STATE.full_name]
    into = origins[[*truths, *origins][0]]
    for topic, own in stating.items():
        silent = LATITUDE not in own.metadata and not frame_of(own.metadata)
        if silent and is_planar(own.schema_name, own.metadata):
            first, other = (
                next(each for each, origin in origins.items() if (origin == into) is wanted)
                for wanted in (True, False)
            )
            raise BadInput(
                f"{name}: {topic} does not state the origin of its tangent plane, and {first} states "
                f"{into}, {other} {origins[other]}; set it, such as --set {topic}.plane="
                f"{into.latitude_deg:.9g},{into.longitude_deg:.9g},{into.altitude_m:.9g}"
            )
    made = dict(changes)
    for topic, origin in origins.items():
        if origin != into:
            before = changes.get(topic) or Change(topic, topic)
            made[topic] = replace(
                before,
                columns=(*before.columns, partial(_moved, origin, into)),
                metadata={**before.metadata, **into.metadata},
            )
    return made


def _moved(origin: Origin, into: Origin, stream: Stream) -> Stream:
    own = replace(stream, metadata={**stream.metadata, **origin.metadata})
    return into_plane_of(own, into)
