"""Processing of scans by a tracker, in order or with reprocessing, and smoothing at the end."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from fuselog.replay.engine.api.inputs import Given
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Block, Ragged, gather, join, of_runs
from fuselog.replay.families.tracking.association.outputs import TrackOutputs, of_last
from fuselog.replay.families.tracking.association.scans import Scans, in_time, take_scans
from fuselog.replay.families.tracking.association.tracker import Tracker
from fuselog.replay.families.tracking.association.tracking import track_scans
from fuselog.replay.families.tracking.association.tracks import Tracks, no_tracks
from fuselog.replay.families.tracking.scan_sensors import KINDS
from fuselog.replay.families.tracking.scans import Fixes, SensorTopics, latest_fixes, scans_of
from fuselog.replay.families.tracking.targets import Targets
from fuselog.replay.families.tracking.track_outputs import track_outputs
from fuselog.replay.families.tracking.track_smoother import smoothed


class TrackerSetup(NamedTuple):
    """A tracker bound to a log.

    Attributes:
        name: name of the estimator.
        found: sensors of the log.
        tracker: the assembled tracker.
        settings: (sensors, names), the parameters for each sensor.
        targets: model of the targets, and the state of a new target.
        most_tracks: greatest number of tracks at a time.
        smoothed: whether tracks are smoothed at the end.
    """

    name: str
    found: SensorTopics
    tracker: Tracker
    settings: Floats
    targets: Targets
    most_tracks: int
    smoothed: bool

    def no_tracks(self, runs: int) -> Tracks:
        """Return empty tracks for a number of runs."""
        first, count = self.tracker.shared
        shared = self.targets.newborn.covariance[first : first + count, first : first + count]
        return no_tracks(runs, self.most_tracks, self.tracker.sizes, len(self.found.scans), shared)

    def track(self, tracks: Tracks, scans: Scans) -> tuple[Tracks, list[tuple[Scans, TrackOutputs]]]:
        """Return the tracks after some scans, and the outputs of these scans."""
        return track_scans(self.tracker, scans, self.settings, self.targets.newborn, tracks)

    def outputs(self, scans: Scans, tracked: TrackOutputs, *, repeated: int = 0) -> list[Ragged]:
        """Make the output streams of some scans; see `track_outputs`."""
        return track_outputs(
            self.name, self.found, self.tracker.bound_model, scans, tracked, repeated=repeated
        )


class OutOfSequenceState(NamedTuple):
    """State of one run with out-of-sequence scans.

    Attributes:
        base: the tracks after the settled scans, that is, those before which no late scan can arrive any
            more.
        pending: the scans after the settled ones, in time order.
        head: the tracks after all scans.
    """

    base: Tracks
    pending: Scans
    head: Tracks


class TrackerState(NamedTuple):
    """Last sensor positions and tracks, carried from block to block.

    Attributes:
        fixes: the last sensor positions, by topic and run.
        tracks: the tracks of all runs after all scans so far; if scans may be out of sequence, the
            initial tracks.
        late: state of each run with out-of-sequence scans.
        outputs: with smoothing, the outputs to write at the end, by block.
    """

    fixes: Fixes
    tracks: Tracks
    late: tuple[OutOfSequenceState, ...] = ()
    outputs: tuple[list[Ragged], ...] = ()


def start(given: Given[Any]) -> tuple[TrackerSetup, TrackerState]:
    """Return the setup, and a state without tracks."""
    setup, runs = given.setup, given.runs
    unknown: list[Any] = [None] * runs
    fixes: Fixes = {topic: unknown for topic in setup.found.origins if topic}
    return setup, TrackerState(fixes, setup.no_tracks(runs))


def advance(setup: TrackerSetup, state: TrackerState, block: Block) -> tuple[TrackerState, list[Ragged]]:
    """Track targets over a block; see `fuselog.replay.engine.api.functions.recursive`."""
    scans, fixes = _scans(state, block, setup)
    tracks, batches = setup.track(state.tracks, scans)
    outputs = _joined([setup.outputs(batch, tracked) for batch, tracked in batches])
    after = state._replace(fixes=fixes, tracks=tracks)
    if setup.smoothed:
        return after._replace(outputs=(*state.outputs, outputs)), []
    return after, outputs


def finish(setup: TrackerSetup, state: TrackerState) -> list[Ragged]:
    """Return the outputs that were kept until the end, with smoothed tracks."""
    outputs = _joined([each for each in state.outputs if each])
    return [
        smoothed(each, setup.targets) if each.stream.topic.endswith("/track") else each
        for each in outputs
    ]


def _joined(outputs: Sequence[Sequence[Ragged]]) -> list[Ragged]:
    """Join the streams of each topic from successive parts."""
    return [join(parts) for parts in zip(*outputs, strict=True)]


def _scans(state: TrackerState, block: Block, setup: TrackerSetup) -> tuple[Scans, Fixes]:
    """Return a block's scans, and the last sensor positions after it."""
    scans = scans_of(block, setup.found, KINDS, state.fixes)
    fixes = state.fixes.items()
    return scans, {topic: latest_fixes(block.streams[topic], known) for topic, known in fixes}


def advance_out_of_sequence(
    setup: TrackerSetup, state: TrackerState, block: Block, *, back_ns: int
) -> tuple[TrackerState, list[Ragged]]:
    """Process scans in order of arrival, with reprocessing if a scan is late by at most `back_ns`.

    A late scan is inserted at its stamp, and the scans after it are processed again. Earlier outputs are
    not changed; the corrected tracks are output again at the latest stamp.
    """
    scans, fixes = _scans(state, block, setup)
    after, outputs = [], []
    for number, late in enumerate(state.late or _before_all(state.tracks, scans)):
        batches = list[list[Ragged]]()
        for rows in _stretches(late, scans, *scans.offsets[number : number + 2]):
            late, tracked = _take(late, take_scans(scans, rows), setup, back_ns)
            batches += tracked
        after.append(late)
        outputs.append(_joined(batches))
    filled = next((each for each in outputs if each), [])
    empty = [Ragged(each.stream.take(slice(0, 0)), np.zeros(2, np.int64)) for each in filled]
    by_topic = zip(*(each or empty for each in outputs), strict=True)
    said = [gather([each.stream for each in parts]) for parts in by_topic]
    return state._replace(fixes=fixes, late=tuple(after)), said


def _before_all(tracks: Tracks, scans: Scans) -> Iterator[OutOfSequenceState]:
    """Yield the state of every run before its first scan."""
    none = take_scans(scans, np.empty(0, np.int64))
    for run in range(len(tracks.used)):
        own = of_runs(tracks, slice(run, run + 1))
        yield OutOfSequenceState(own, none, own)


def _stretches(before: OutOfSequenceState, scans: Scans, first: int, end: int) -> Iterator[Integers]:
    """Yield rows of scans to process together: scans in time order, or a single late scan."""
    known = np.append(before.pending.time_ns[-1:], scans.time_ns[first:end])
    newest_ns = np.maximum.accumulate(known)[len(known) - (end - first) :]
    late = scans.time_ns[first:end] < newest_ns
    cuts = np.flatnonzero(late | np.append(False, late[:-1]))
    return (first + rows for rows in np.split(np.arange(end - first), cuts) if len(rows))


def _take(
    out_of_sequence: OutOfSequenceState, arrived: Scans, setup: TrackerSetup, back_ns: int
) -> tuple[OutOfSequenceState, list[list[Ragged]]]:
    """Process ordered scans of one run, or one late scan; also return the outputs."""
    base, pending, head = out_of_sequence
    repeated = int(np.count_nonzero(pending.time_ns > arrived.time_ns[0]))
    pending = in_time(pending, arrived)
    if repeated:
        head, batches = setup.track(base, pending)
        outputs = [setup.outputs(*of_last(*batches[-1]), repeated=repeated)]
    else:
        head, batches = setup.track(head, arrived)
        outputs = [setup.outputs(batch, tracked) for batch, tracked in batches]
    rows = np.arange(len(pending.time_ns))
    settled = pending.time_ns < pending.time_ns[-1] - back_ns
    if settled.any():
        base, _ = setup.track(base, take_scans(pending, rows[settled]))
        pending = take_scans(pending, rows[~settled])
    return OutOfSequenceState(base, pending, head), outputs
