"""Export of tracks and truths in the format of the MOT Challenge, which TrackEval reads.

There is a frame every half second from the run's epoch on; the first frame has number 1. Tracks are
predicted to the frames, and truths are interpolated. A target has no extent: its box begins at its
position, in metres, and has zero width and height. In TrackEval, choose the similarity that uses the
Euclidean distance of points, not the overlap of boxes.

    frame,id,x,y,0,0,1,-1,-1,-1      a track
    frame,id,x,y,0,0,1,1,1           a truth; the last three mean counted, class 1, fully visible

Dendorfer et al., "MOTChallenge: a benchmark for single-camera multiple target tracking", IJCV 129, 2021.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fuselog.recorders.errors import BadInput, UnknownName, choices
from fuselog.recorders.log import Log, Stream, Topic, schemas
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.families.tracking.judging.errors import PERIOD_S, tracks_at

TRUTHS = "gt"
PERIOD_NS = round(PERIOD_S * 1e9)


def mot_files(log: Log, topics: Sequence[str]) -> dict[str, tuple[list[str], list[str]]]:
    """Return the topics and lines of each file, by file name: a file per tracker, and one of truths.

    `topics` contains the wanted topics, or is empty for all. Raises BadInput if a requested topic does
    not exist or has neither tracks nor truths in the plane, or if the log has no topic with tracks or
    truths.
    """
    unknown = [topic for topic in topics if topic not in log.topics]
    if unknown:
        raise UnknownName(f"{log.path}: no topic {unknown[0]}; {choices(unknown[0], log.topics)}")
    fitting = [topic for topic, stated in log.topics.items() if _is_point(stated)]
    wanted = list(dict.fromkeys(topics)) or fitting
    for topic in wanted:
        if topic not in fitting:
            raise BadInput(
                f"{log.path}: topic {topic} has neither tracks nor a truth in the plane; export it "
                "as csv"
            )
    if not wanted:
        raise BadInput(
            f"{log.path}: has neither tracks nor truths in the plane to export as mot; export it as csv"
        )
    source = LogSource(log)
    truths = [topic for topic in wanted if _is_truth(log.topics[topic])]
    files = {}
    for topic in wanted:
        if topic not in truths:
            sizes = f"{topic.rpartition('/')[0]}/set"
            if sizes not in log.topics:
                raise BadInput(
                    f"{log.path}: topic {topic} lacks the topic {sizes} with its number of tracks over "
                    "time; export it as csv"
                )
            streams = source.read([sizes, topic])
            lines = list(_track_lines(streams[sizes], streams[topic], source.epoch_ns))
            files[topic.split("/")[-2]] = [topic], lines
    if truths:
        files[TRUTHS] = truths, list(_truth_lines(source.read(truths), source.epoch_ns))
    return files


def _is_truth(topic: Topic) -> bool:
    return topic.schema_name == schemas.TRUTH_STATE.full_name


def _is_point(topic: Topic) -> bool:
    is_track = topic.schema_name == schemas.TRACK_ESTIMATE.full_name
    return (is_track or _is_truth(topic)) and set(PLANE) <= set(topic.metadata["components"].split(","))


def _frames(epoch_ns: int, last_ns: int) -> Integers:
    """Return the stamps of all frames up to the last stamp."""
    return np.arange(epoch_ns, last_ns + 1, PERIOD_NS)


def _track_lines(sizes: Stream, tracks: Stream, epoch_ns: int) -> Iterator[str]:
    frames = _frames(epoch_ns, int(sizes.publish_time_ns.max(initial=0)))
    for number, at_frame in enumerate(tracks_at(sizes, tracks, frames), start=1):
        for track, place in zip(at_frame.number, at_frame.place, strict=True):
            yield f"{number},{track},{_box(place)},1,-1,-1,-1"


def _truth_lines(truths: Mapping[str, Stream], epoch_ns: int) -> Iterator[str]:
    last_ns = max(int(stream.publish_time_ns.max(initial=0)) for stream in truths.values())
    frames = _frames(epoch_ns, last_ns)
    for target, stream in enumerate(truths.values(), start=1):
        time_ns, places = stream.publish_time_ns - epoch_ns, read_vectors(stream, "state", PLANE)
        known = np.flatnonzero(np.isfinite(places).all(axis=1))
        if not len(known):
            continue
        since_ns = frames - epoch_ns
        axes = [np.interp(since_ns, time_ns[known], axis[known], np.nan, np.nan) for axis in places.T]
        for number, place in enumerate(np.stack(axes, axis=1), start=1):
            if np.isfinite(place).all():
                yield f"{number},{target},{_box(place)},1,1,1"


def _box(place: Floats) -> str:
    x, y = place.tolist()
    return f"{x!r},{y!r},0,0"
