"""Output streams of a tracker: tracks after every scan, associations, innovations, skipped data."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.planes import in_frame
from fuselog.replay.engine.arrays import Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.engine.streams.results import InnovationColumns, innovation_stream, named
from fuselog.replay.families.tracking.association.outputs import TrackOutputs
from fuselog.replay.families.tracking.association.scans import Scans
from fuselog.replay.families.tracking.association.tracks import NEVER
from fuselog.replay.families.tracking.scan_sensors import KINDS
from fuselog.replay.families.tracking.scans import SensorTopics
from fuselog.replay.inference.model.bound_model import BoundModel

UNUSED = (
    "there is no room for more tracks; use a larger --set most_tracks=...",
    "the scan is out of sequence, after a scan with a later stamp; use --late rewind:SECONDS",
)


def track_outputs(
    name: str,
    found: SensorTopics,
    bound_model: BoundModel,
    scans: Scans,
    tracked: TrackOutputs,
    *,
    repeated: int = 0,
) -> list[Ragged]:
    """Make the output streams of the tracker `name` for these scans.

    `repeated` is the number of scans that were processed again after an out-of-sequence scan; if it is
    not zero, `scans` contains only the last of these scans.
    """
    topic = f"/estimates/{name}"
    return [
        *_of_tracks(topic, found, bound_model, scans, tracked),
        _associations(topic, found, scans, tracked),
        *_of_scans(topic, scans, tracked, repeated),
        *_modes(topic, bound_model, scans, tracked),
        *_innovations(topic, found, scans, tracked),
    ]


def _filled(column: NDArray, ends: Integers) -> NDArray:
    """Concatenate the filled rows of each run in a column (runs, rows, ...)."""
    return np.concatenate([of_run[:end] for of_run, end in zip(column, ends, strict=True)])


def _bounds(ends: Integers) -> Integers:
    """Compute offsets (runs + 1,) from the number of rows of each run."""
    return np.concatenate([[0], np.cumsum(ends)])


def _track_stamps(scans: Scans, tracked: TrackOutputs) -> Integers:
    """Return a stamp for each track after each scan."""
    used = tracked.confirmed != NEVER
    return np.repeat(scans.time_ns[used], tracked.confirmed[used])


def _of_tracks(
    topic: str, found: SensorTopics, bound_model: BoundModel, scans: Scans, tracked: TrackOutputs
) -> Iterator[Ragged]:
    """Yield streams of the number of tracks, the tracks and their existence after every scan."""
    metadata = {**named(bound_model.model.state), **in_frame(found.frames[0])}
    ends = tracked.end[:, 0]
    used = np.flatnonzero(tracked.confirmed != NEVER)
    size = make_stream(
        f"{topic}/set",
        schemas.ESTIMATE_SIZE,
        scans.time_ns[used],
        metadata=metadata,
        elements=tracked.confirmed[used],
    )
    yield Ragged(size, np.searchsorted(used, scans.offsets))
    stamps_ns, covariance = _track_stamps(scans, tracked), _filled(tracked.covariance, ends)
    track = make_stream(
        f"{topic}/track",
        schemas.TRACK_ESTIMATE,
        stamps_ns,
        metadata=metadata,
        track_id=_filled(tracked.number, ends),
        mean=_filled(tracked.mean, ends),
        covariance=covariance.reshape(len(covariance), bound_model.model.tangent**2),
    )
    yield Ragged(track, _bounds(ends))
    existence = _filled(tracked.existence, ends)
    stream = make_stream(f"{topic}/existence", schemas.EXISTENCE, stamps_ns, existence=existence)
    yield Ragged(stream, _bounds(ends))


def _modes(topic: str, bound_model: BoundModel, scans: Scans, tracked: TrackOutputs) -> Iterator[Ragged]:
    """Yield a stream of the mode probabilities of each track, if there are several modes."""
    if not bound_model.modes:
        return
    ends = tracked.end[:, 0]
    stream = make_stream(
        f"{topic}/modes",
        schemas.MODE_PROBABILITIES,
        _track_stamps(scans, tracked),
        metadata=named(dict.fromkeys(bound_model.model.modes or (), "linear")),
        probability=_filled(tracked.probability, ends),
    )
    yield Ragged(stream, _bounds(ends))


def _associations(topic: str, found: SensorTopics, scans: Scans, tracked: TrackOutputs) -> Ragged:
    """Make the stream of detections associated with tracks, with their probabilities."""
    ends = tracked.end[:, 1]
    track, scan, detection = _filled(tracked.pair, ends).T
    stream = make_stream(
        f"{topic}/association",
        schemas.ASSOCIATION,
        scans.time_ns[scan],
        metadata={"sensors": ",".join(found.sensors)},
        track_id=track,
        sensor_id=scans.sensor[scan],
        scan_id=scans.number[scan],
        detection=detection,
        probability=_filled(tracked.associated, ends),
    )
    return Ragged(stream, _bounds(ends))


def _of_scans(topic: str, scans: Scans, tracked: TrackOutputs, repeated: int) -> Iterator[Ragged]:
    """Yield streams of approximated clusters, unused scans and detections, and reprocessed scans."""
    approximated = np.flatnonzero(tracked.approximated)
    tracks = tracked.approximated[approximated]
    stream = make_stream(
        f"{topic}/approximation", schemas.APPROXIMATION, scans.time_ns[approximated], tracks=tracks
    )
    yield Ragged(stream, np.searchsorted(approximated, scans.offsets))
    late = tracked.confirmed == NEVER
    unused = np.repeat(np.arange(len(late)), tracked.turned_away + late)
    reasons = np.where(late[unused], 1, 0)
    stream = reason_stream(f"{topic}/unused", schemas.SKIPPED, scans.time_ns[unused], reasons, UNUSED)
    yield Ragged(stream, np.searchsorted(unused, scans.offsets))
    count = min(repeated, 1)
    stream = make_stream(
        f"{topic}/rewound", schemas.REWOUND, scans.time_ns[:count], repeated=[repeated] * count
    )
    yield Ragged(stream, np.minimum(scans.offsets, repeated))


def _innovations(
    topic: str, found: SensorTopics, scans: Scans, tracked: TrackOutputs
) -> Iterator[Ragged]:
    """Yield, by sensor, the innovations of each confirmed track with its most likely detection."""
    ends = tracked.end[:, 1]
    pair, probability = _filled(tracked.pair, ends), _filled(tracked.associated, ends)
    white, factor = _filled(tracked.white, ends), _filled(tracked.factor, ends)
    order = np.lexsort((-probability, pair[:, 0], pair[:, 1]))
    track, scan = pair[order, 0], pair[order, 1]
    is_first = np.append(True, (np.diff(scan) != 0) | (np.diff(track) != 0))[: len(order)]
    likeliest = np.sort(order[is_first])
    for sensor, (kind, scan_topic) in enumerate(zip(found.kinds, found.scans, strict=True)):
        rows = likeliest[scans.sensor[pair[likeliest, 1]] == sensor]
        measured = KINDS[kind].measured
        size = len(measured)
        root, whitened = np.tril(factor[rows, :size, :size]), white[rows, :size]
        columns = InnovationColumns(
            scans.time_ns[pair[rows, 1]],
            pair[rows, 0],
            np.ones(len(rows), np.int64),
            np.einsum("nij,nj->ni", root, whitened),
            root @ root.transpose(0, 2, 1),
            (whitened**2).sum(axis=1),
        )
        own = f"{topic}{scan_topic.removesuffix('/scan')}/innovation"
        stream = innovation_stream(own, measured, "", columns)
        yield Ragged(stream, np.searchsorted(rows, _bounds(ends)))
