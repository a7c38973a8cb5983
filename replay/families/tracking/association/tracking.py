"""Multi-target tracking scan by scan: prediction, association, update, birth and end of tracks.

The motion of a model predicts every track; with several modes, each track is an IMM. Sensors predict the
measurement of each track (`association.scanning`). An association computes the probability that each
track has each detection (`association`), and unassociated detections may begin tracks. The track
management confirms and ends tracks (`track_management`).
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.replay.engine.arrays import Columns, Floats, Numbers, Settings
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.families.tracking.association.association import ASSOCIATIONS
from fuselog.replay.families.tracking.association.births import beginning, births_of, ending
from fuselog.replay.families.tracking.association.outputs import (
    TrackOutputs,
    blank_outputs,
    writing_pairs,
    writing_tracks,
)
from fuselog.replay.families.tracking.association.scanning import (
    ScanMemory,
    comparing,
    join_near,
    memory_of,
    observing,
    split_by_mode,
    target_of,
    updating,
)
from fuselog.replay.families.tracking.association.scans import BY_SCAN, Scans
from fuselog.replay.families.tracking.association.shared_bias import pool_errors
from fuselog.replay.families.tracking.association.track_management import MANAGEMENTS, Evidence
from fuselog.replay.families.tracking.association.tracker import (
    Newborn,
    Tracker,
    believing,
    choosing,
    moving,
)
from fuselog.replay.families.tracking.association.tracks import NEVER, Tracks
from fuselog.replay.inference.kalman.steps import UNKNOWN, Interval
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.model.settings import ReadSettings, reading_settings
from fuselog.replay.inference.run.loops import Follow, over_events


class ScanInputs(NamedTuple):
    """Inputs of a tracker: scans, parameters (sensors, names), and the state of a new target."""

    events: Scans
    settings: Floats
    newborn: Newborn


def tracking(tracker: Tracker, read: ReadSettings) -> Follow:
    """Make the loop over scans, for `fuselog.recorders.compiling.compile.compile_over_runs`.

    `read(settings, sensor)` makes the parameters of motion, tracker and sensor.
    """
    bound_model, associate = tracker.bound_model, ASSOCIATIONS[tracker.association]
    advance, weigh, process = advancing(tracker), association_weights(tracker), processing(tracker)
    end_tracks, begin_tracks = ending(tracker), beginning(tracker)
    write_pairs, write_tracks = writing_pairs(tracker.sizes[0]), writing_tracks(bound_model)

    def take_scan(
        run: int,
        scan: int,
        inputs: ScanInputs,
        tracks: Tracks,
        outputs: TrackOutputs,
        memory: ScanMemory,
    ) -> int:
        """Process one scan of a run; a scan that is older than the tracks has no effect."""
        scans = inputs.events
        p = read(inputs.settings, scans.sensor[scan])
        if scans.time_ns[scan] < tracks.time_ns[run]:
            return UNKNOWN
        advance(run, scans.time_ns[scan], tracks, p, memory)
        count = join_near(scans.first[scan], scans.end[scan], scans, p.joined_within_m, memory)
        weigh(run, scan, count, scans, tracks, p, memory)
        used = tracks.used[run]
        outputs.approximated[scan] = associate(
            memory.weights, used, count, memory.probability, memory.association
        )
        for detection in range(count):
            memory.left[detection] = 1.0
            for place in range(used):
                memory.left[detection] -= memory.probability[place, 1 + detection]
        write_pairs(run, scan, count, tracks, outputs, memory)
        process(run, scan, count, scans, tracks, p, memory)
        end_tracks(run, tracks, p)
        outputs.turned_away[scan] = begin_tracks(
            run, scan, count, scans, tracks, inputs.newborn, p, memory
        )
        return ALL_WELL

    def record(
        run: int, scan: int, _: ScanInputs, tracks: Tracks, outputs: TrackOutputs, memory: ScanMemory
    ) -> int:
        """Write the tracks after a scan to the outputs."""
        write_tracks(run, scan, tracks, outputs, memory)
        return ALL_WELL

    return over_events(take_scan, record, fails=False)


def advancing(tracker: Tracker) -> Callable[[int, int, Tracks, Settings, ScanMemory], None]:
    """Make `advance(run, time_ns, tracks, p, memory)`, which predicts all tracks."""
    belief_of, predict = believing(tracker.bound_model), moving(tracker.bound_model).predict
    wait, _, _ = MANAGEMENTS[tracker.management]

    def advance(run: int, time_ns: int, tracks: Tracks, p: Settings, memory: ScanMemory) -> None:
        duration_s = (time_ns - tracks.time_ns[run]) * 1e-9
        if tracks.time_ns[run] != NEVER and duration_s > 0.0:
            belief = belief_of(run, tracks)
            interval = Interval(memory.shift, duration_s, p, 0)
            for place in range(tracks.used[run]):
                predict(place, belief, interval, memory.motion)
                wait(run, place, duration_s, tracks, p)
        tracks.time_ns[run] = time_ns

    return advance


# (run, scan, count, scans, tracks, parameters, memory) processes the detections of a scan.
TakeDetections = Callable[[int, int, int, Scans, Tracks, Settings, ScanMemory], None]


def association_weights(tracker: Tracker) -> TakeDetections:
    """Make `weigh(run, scan, count, scans, tracks, p, memory)`, which computes the weights of pairs."""
    model, kinds, modes = tracker.bound_model.model, tracker.kinds, tracker.sizes[0]
    observe = choosing([observing(model, kind, tracker.names) for kind in kinds])
    compare = choosing([comparing(kind) for kind in kinds])
    detection_of = choosing([kind.detection for kind in kinds])
    clutter_of = choosing([kind.clutter for kind in kinds])
    begins, birth_number, birth = births_of(kinds)
    read_pair, read_state, target_in = tuple_of(2), tuple_of(model.size), target_of(model)

    def detectable(
        run: int, place: int, kind: int, origin: Numbers, tracks: Tracks, p: Settings
    ) -> float:
        """Compute the probability that a sensor detects a track's target."""
        total = 0.0
        for mode in range(modes):
            target = target_in(read_state(tracks.mean[run, place, mode]))
            total += tracks.mode[run, place, mode] * detection_of(kind, target, origin, p)
        return total

    def weigh(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Settings, memory: ScanMemory
    ) -> None:
        """Fill the weights of all pairs, and mark the detections that are outside all gates."""
        kind, weights, origin = scans.kind[scan], memory.weights, read_pair(scans.origin[scan])
        for detection in range(count):
            measured = read_pair(memory.place[detection])
            undetected = 0.0
            if begins[kind] and p.undetected_per_m2 > 0.0:
                (at_x, at_y), _, area = birth(birth_number[kind], measured, origin, p)
                detected = detection_of(kind, (at_x, 0.0, at_y, 0.0), origin, p)
                undetected = detected * p.undetected_per_m2 * area
            memory.is_free[detection] = True
            memory.undetected[detection] = undetected
            memory.clutter[detection] = clutter_of(kind, measured, p) + undetected
        for place in range(tracks.used[run]):
            weights.detected[place, :count] = 0.0
            weights.missed[place] = 1.0
            if not (begins[kind] or tracks.is_confirmed[run, place]):
                continue
            memory.detectable[place] = detectable(run, place, kind, origin, tracks, p)
            share = memory.detectable[place] * tracks.existence[run, place]
            weights.missed[place] = 1.0 - share * p.gate_probability
            for mode in range(modes):
                mean, covariance = tracks.mean[run, place, mode], tracks.covariance[run, place, mode]
                factor = observe(kind, place, mode, mean, covariance, scans.origin[scan], p, memory)
                for detection in range(count):
                    squared = compare(kind, place, mode, detection, memory)
                    likelihood = tracks.mode[run, place, mode] * factor * np.exp(-0.5 * squared)
                    memory.likelihood[place, mode, detection] = likelihood
                    if squared <= p.gate:
                        memory.is_free[detection] = False
                        weights.detected[place, detection] = share / memory.clutter[detection]
            for detection in range(count):
                total = 0.0
                for mode in range(modes):
                    total += memory.likelihood[place, mode, detection]
                weights.detected[place, detection] *= total

    return weigh


def processing(tracker: Tracker) -> TakeDetections:
    """Make `process(run, scan, count, scans, tracks, p, memory)`, which updates the tracks."""
    model, kinds, modes = tracker.bound_model.model, tracker.kinds, tracker.sizes[0]
    update = choosing([updating(model, kind) for kind in kinds])
    _, judge, _ = MANAGEMENTS[tracker.management]
    begins, (shared_at, shared) = births_of(kinds).begins, tracker.shared

    def correct(run: int, place: int, count: int, kind: int, tracks: Tracks, memory: ScanMemory) -> None:
        """Update the Gaussians and the mode probabilities of a track by its associations."""
        for mode in range(modes):
            after = split_by_mode(run, place, mode, count, tracks, memory)
            memory.after[mode] = after
            if after > 0.0:
                mean, covariance = tracks.mean[run, place, mode], tracks.covariance[run, place, mode]
                update(kind, place, mode, count, mean, covariance, memory)
        for mode in range(modes):
            after = memory.after[mode]
            tracks.mode[run, place, mode] = after
            tracks.log_mode[run, place, mode] = np.log(after) if after > 0.0 else -np.inf

    def process(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Settings, memory: ScanMemory
    ) -> None:
        """Update the states and the management data of all tracks with their associations."""
        kind, sensor, now_ns = scans.kind[scan], scans.sensor[scan], tracks.time_ns[run]
        for place in range(tracks.used[run]):
            probability = memory.probability[place, : 1 + count]
            memory.pool.is_updated[place] = False
            waited_s = (now_ns - tracks.updated_ns[run, place, sensor]) * 1e-9
            if probability[0] < 1.0 and waited_s >= p.interval_s:
                correct(run, place, count, kind, tracks, memory)
                memory.pool.is_updated[place] = True
                tracks.updated_ns[run, place, sensor] = now_ns
            if begins[kind]:
                if probability[0] < 0.5:
                    tracks.seen_ns[run, place] = now_ns
                inside = memory.detectable[place] * p.gate_probability
                judge(run, place, Evidence(inside, probability, memory.weights), tracks, p)
        if shared > 0:
            pool_errors(run, shared_at, tracks, memory.pool)

    return process


# Number of scans of a run per pass of the loop, which limits the memory for their outputs.
BATCH = 1000


@lru_cache(maxsize=16)
def _compiled(tracker: Tracker) -> OverRuns:
    follow = tracking(tracker, reading_settings(tracker.names))
    return compile_over_runs(follow, title="a tracker")


def track_scans(
    tracker: Tracker, scans: Scans, settings: Floats, newborn: Newborn, before: Tracks
) -> tuple[Tracks, list[tuple[Scans, TrackOutputs]]]:
    """Track targets over scans of all runs in parallel.

    Args:
        tracker: the assembled tracker.
        scans: scans of all runs.
        settings: (sensors, names), the parameters for each sensor.
        newborn: the state of a new target.
        before: the tracks before these scans.

    Returns:
        The tracks after the scans, and the scans and outputs of each batch.
    """
    columns: Columns = before
    tracks = Tracks(*(column.copy() for column in columns))
    runs, places = tracks.number.shape
    begin, end = scans.offsets[:-1], scans.offsets[1:]
    largest = int((scans.end - scans.first).max(initial=0))
    batches = []
    for first in range(0, int((end - begin).max(initial=0)), BATCH):
        bounds = np.minimum(begin + first, end), np.minimum(begin + first + BATCH, end)
        rows = np.concatenate([np.arange(*pair) for pair in zip(*bounds, strict=True)])
        batch = scans._replace(
            offsets=np.concatenate([[0], np.cumsum(bounds[1] - bounds[0])]),
            **{name: getattr(scans, name)[rows] for name in BY_SCAN},
        )
        outputs = blank_outputs(batch, runs, places, tracker.sizes)
        memory = partial(_memory, tracker, places, largest)
        inputs = ScanInputs(batch, settings, newborn)
        _compiled(tracker)(runs, inputs, tracks, outputs, scratch=memory)
        batches.append((batch, outputs))
    return tracks, batches


def _memory(tracker: Tracker, places: int, detections: int) -> ScanMemory:
    motion = moving(tracker.bound_model).memory(())
    return memory_of(tracker.bound_model, motion, tracker.shared[1], places, detections)
