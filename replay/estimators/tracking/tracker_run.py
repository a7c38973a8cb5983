"""Runs a tracker over its scans, in order or going back for scans that come late."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from replay.engine.arrays import Floats, Integers
from replay.engine.streams.blocks import Block, Ragged, gather, join
from replay.estimators.tracking.scan_sensors import KINDS
from replay.estimators.tracking.scans import Fixes, SensorTopics, latest_fixes, scans_of
from replay.estimators.tracking.track_outputs import track_outputs
from replay.inference.association.outputs import TrackOutputs, of_last
from replay.inference.association.scans import Scans, in_time, take_scans
from replay.inference.association.tracker import Newborn, Tracker
from replay.inference.association.tracking import track_scans
from replay.inference.association.tracks import Tracks, no_tracks


class TrackerSetup(NamedTuple):
    """Holds a tracker as bound to a log: its name, the sensors, their settings, room for tracks."""

    name: str
    found: SensorTopics
    tracker: Tracker
    settings: Floats
    newborn: Newborn
    most_tracks: int

    def no_tracks(self, runs: int) -> Tracks:
        """Return the tracks of runs in which nothing was met yet."""
        first, count = self.tracker.shared
        shared = self.newborn.covariance[first : first + count, first : first + count]
        return no_tracks(runs, self.most_tracks, self.tracker.sizes, len(self.found.scans), shared)

    def track(self, tracks: Tracks, scans: Scans) -> tuple[Tracks, list[tuple[Scans, TrackOutputs]]]:
        """Return the tracks after some scans, and what is said of them."""
        return track_scans(self.tracker, scans, self.settings, self.newborn, tracks)

    def outputs(self, scans: Scans, tracked: TrackOutputs, *, repeated: int = 0) -> list[Ragged]:
        """Return the streams of what is said of these scans; see `track_outputs`."""
        return track_outputs(
            self.name, self.found, self.tracker.stage, scans, tracked, repeated=repeated
        )


class TrackerState(NamedTuple):
    """Carries the last own positions and the tracks from block to block.

    Attributes:
        fixes: by topic and run.
        tracks: of all runs; where scans may come late those of one run each, see `OutOfSequenceState`.
    """

    fixes: Fixes
    tracks: Any


def start(_: Mapping[str, Ragged]) -> None:
    """Start with nothing: before the first scan not even the number of runs is known."""


def run(
    state: TrackerState | None, block: Block, *, setup: TrackerSetup
) -> tuple[TrackerState, list[Ragged]]:
    """Track a block; see `replay.engine.replaying.estimator.Recursive`."""
    before = state or _begin(block, setup, setup.no_tracks(_runs(block)))
    scans, fixes = _scans(before, block, setup)
    after, batches = setup.track(before.tracks, scans)
    outputs = [setup.outputs(batch, tracked) for batch, tracked in batches]
    return TrackerState(fixes, after), [join(parts) for parts in zip(*outputs, strict=True)]


def _runs(block: Block) -> int:
    return next(iter(block.streams.values())).runs


def _begin(block: Block, setup: TrackerSetup, tracks: Any) -> TrackerState:
    unknown: list[Any] = [None] * _runs(block)
    return TrackerState({topic: unknown for topic in setup.found.origins if topic}, tracks)


def _scans(state: TrackerState, block: Block, setup: TrackerSetup) -> tuple[Scans, Fixes]:
    """Return a block's scans, and the last own positions after it."""
    scans = scans_of(block, setup.found, KINDS, state.fixes)
    fixes = state.fixes.items()
    return scans, {topic: latest_fixes(block.streams[topic], known) for topic, known in fixes}


class OutOfSequenceState(NamedTuple):
    """Holds one run whose scans may come late.

    Attributes:
        base: the tracks after all scans that no late one can precede any more.
        pending: the scans after those, in time order.
        head: the tracks after all scans.
    """

    base: Tracks
    pending: Scans
    head: Tracks


def run_out_of_sequence(
    state: TrackerState | None, block: Block, *, setup: TrackerSetup, back_ns: int
) -> tuple[TrackerState, list[Ragged]]:
    """Track a block in the order of arrival, and go back for scans that are late by up to `back_ns`.

    A late scan is put in its place and those after it are used again; what was said stays, and is said
    again at the latest stamp.
    """
    nothing = setup.no_tracks(1)
    scans, fixes = _scans(state or _begin(block, setup, None), block, setup)
    none = take_scans(scans, np.empty(0, np.int64))
    runs = [OutOfSequenceState(nothing, none, nothing)] * _runs(block) if state is None else state.tracks
    after, outputs = [], []
    for number, before in enumerate(runs):
        out_of_sequence, batches = before, list[list[Ragged]]()
        for rows in _stretches(before, scans, *scans.offsets[number : number + 2]):
            out_of_sequence, tracked = _take(out_of_sequence, take_scans(scans, rows), setup, back_ns)
            batches += tracked
        after.append(out_of_sequence)
        outputs.append([join(parts) for parts in zip(*batches, strict=True)])
    filled = next((each for each in outputs if each), [])
    empty = [Ragged(each.stream.take(slice(0, 0)), np.zeros(2, np.int64)) for each in filled]
    by_topic = zip(*(each or empty for each in outputs), strict=True)
    return TrackerState(fixes, after), [gather([each.stream for each in parts]) for parts in by_topic]


def _stretches(before: OutOfSequenceState, scans: Scans, first: int, end: int) -> Iterator[Integers]:
    """Yield rows of a run's scans that can be used together: those that go on in time, and late ones."""
    known = np.append(before.pending.time_ns[-1:], scans.time_ns[first:end])
    newest_ns = np.maximum.accumulate(known)[len(known) - (end - first) :]
    late = scans.time_ns[first:end] < newest_ns
    cuts = np.flatnonzero(late | np.append(False, late[:-1]))
    return (first + rows for rows in np.split(np.arange(end - first), cuts) if len(rows))


def _take(
    out_of_sequence: OutOfSequenceState, arrived: Scans, setup: TrackerSetup, back_ns: int
) -> tuple[OutOfSequenceState, list[list[Ragged]]]:
    """Take one run through scans that go on in time, or one that is late; also what is said then."""
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
