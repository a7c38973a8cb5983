"""Start of tracks at unassociated detections, and end of tracks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats, Numbers, Settings
from fuselog.replay.families.tracking.association.scanning import (
    ScanMemory,
    correlating,
)
from fuselog.replay.families.tracking.association.scans import Born, Scans, ScanSensor
from fuselog.replay.families.tracking.association.track_management import MANAGEMENTS
from fuselog.replay.families.tracking.association.tracker import (
    Newborn,
    Tracker,
    choosing,
    corner_of,
    place_of,
)
from fuselog.replay.families.tracking.association.tracks import NEVER, Tracks, are_near, drop, expected
from fuselog.replay.inference.kalman.predict import nothing
from fuselog.replay.inference.kalman.steps import Workspace
from fuselog.replay.inference.linear_algebra.gaussian import copy_gaussian
from fuselog.replay.inference.linear_algebra.tuples import tuple_of


class Births(NamedTuple):
    """Functions that begin tracks at detections, by kind of sensor.

    Attributes:
        begins: whether detections of a kind begin tracks.
        number: the index in `birth` of each kind that begins tracks.
        birth: (number, detection, origin, parameters) -> see `ScanSensor.birth`.
    """

    begins: tuple[bool, ...]
    number: tuple[int, ...]
    birth: Callable[[int, Numbers, Numbers, Settings], Born]


def births_of(kinds: Sequence[ScanSensor]) -> Births:
    """Collect the births of the given kinds of sensors."""
    begins = tuple(kind.birth is not None for kind in kinds)
    births = [kind.birth for kind in kinds if kind.birth is not None]
    number = tuple(sum(begins[:k]) for k in range(len(kinds)))
    return Births(begins, number, choosing(births))


def ending(tracker: Tracker) -> Callable[[int, Tracks, Settings], None]:
    """Make `end_tracks(run, tracks, p)`, which removes tracks that have ended."""
    names = list(tracker.bound_model.model.state)
    x, y = place_of(tracker.bound_model.model)
    has_velocity = "vx_mps" in names and "vy_mps" in names
    velocity = (names.index("vx_mps"), names.index("vy_mps")) if has_velocity else (x, y)
    _, _, is_over = MANAGEMENTS[tracker.management]

    def is_another(run: int, place: int, tracks: Tracks, p: Settings) -> bool:
        """Test whether an older confirmed track has about the same position and velocity."""
        for other in range(place if tracks.is_confirmed[run, place] else 0):
            if (
                tracks.is_confirmed[run, other]
                and are_near(run, place, other, (x, y), p.same_within_m, tracks)
                and (
                    not has_velocity or are_near(run, place, other, velocity, p.same_within_mps, tracks)
                )
            ):
                return True
        return False

    def end_tracks(run: int, tracks: Tracks, p: Settings) -> None:
        """Remove the tracks that have ended, and duplicate tracks of a target."""
        place = 0
        while place < tracks.used[run]:
            if is_over(run, place, tracks, p) or is_another(run, place, tracks, p):
                drop(run, place, tracks)
            else:
                place += 1

    return end_tracks


# (run, scan, count, scans, tracks, newborn, parameters, memory) -> number of tracks for which there is
# no room.
BeginTracks = Callable[[int, int, int, Scans, Tracks, Newborn, Settings, ScanMemory], int]


def beginning(tracker: Tracker) -> BeginTracks:
    """Make `begin_tracks(run, scan, count, scans, tracks, newborn, p, memory)`, which begins tracks."""
    model, kinds, modes = tracker.bound_model.model, tracker.kinds, tracker.sizes[0]
    (x, y), corner, (shared_at, shared) = place_of(model), corner_of(model), tracker.shared
    begins, birth_number, birth = births_of(kinds)
    correlate: Callable[[int, Floats, Floats, Floats, Settings, Workspace], None] = nothing
    read_pair = tuple_of(2)
    if shared_at < model.size:
        correlations = [
            correlating(model, kind, corner, tracker.names) for kind in kinds if kind.birth is not None
        ]
        correlate = choosing(correlations)

    def is_taken(run: int, at_x: float, at_y: float, tracks: Tracks, p: Settings) -> bool:
        """Test whether a confirmed track is so near to a position that no track may begin there."""
        for place in range(tracks.used[run]):
            apart = np.hypot(
                at_x - expected(run, place, x, tracks), at_y - expected(run, place, y, tracks)
            )
            if tracks.is_confirmed[run, place] and apart < p.birth_distance_m:
                return True
        return False

    def first_existence(
        run: int,
        detection: int,
        at_x: float,
        at_y: float,
        tracks: Tracks,
        p: Settings,
        memory: ScanMemory,
    ) -> float:
        """Compute the probability that a detection belongs to a new target; 0 if no track may begin."""
        if p.undetected_per_m2 > 0.0:
            share = memory.undetected[detection] / memory.clutter[detection]
            existence = memory.left[detection] * share
            return existence if existence >= p.ending_existence else 0.0
        is_another = not memory.is_free[detection] or is_taken(run, at_x, at_y, tracks, p)
        return 0.0 if is_another else p.birth_existence

    def begin_tracks(
        run: int,
        scan: int,
        count: int,
        scans: Scans,
        tracks: Tracks,
        newborn: Newborn,
        p: Settings,
        memory: ScanMemory,
    ) -> int:
        """Begin tracks at unassociated detections; return the number of tracks that did not fit."""
        kind, turned_away = scans.kind[scan], 0
        for detection in range(count if begins[kind] else 0):
            measured, origin = read_pair(memory.place[detection]), read_pair(scans.origin[scan])
            (at_x, at_y), triangle, _ = birth(birth_number[kind], measured, origin, p)
            existence = first_existence(run, detection, at_x, at_y, tracks, p, memory)
            if existence == 0.0:
                continue
            place = tracks.used[run]
            if place == tracks.number.shape[1]:
                turned_away += 1
                continue
            tracks.used[run] += 1
            tracks.met[run] += 1
            tracks.number[run, place] = tracks.met[run]
            for mode in range(modes):
                mean, covariance = tracks.mean[run, place, mode], tracks.covariance[run, place, mode]
                copy_gaussian(newborn.mean, newborn.covariance, mean, covariance)
                mean[x], mean[y] = at_x, at_y
                covariance[corner[0], corner[0]], covariance[corner[1], corner[1]] = (
                    triangle[0],
                    triangle[2],
                )
                covariance[corner[0], corner[1]] = covariance[corner[1], corner[0]] = triangle[1]
                for i in range(shared):
                    mean[shared_at + i] = tracks.shared_mean[run, i]
                    for j in range(shared):
                        known = tracks.shared_covariance[run, i, j]
                        covariance[shared_at + i, shared_at + j] = known
                number = birth_number[kind]
                correlate(number, mean, covariance, scans.origin[scan], p, memory.step)
                probability = newborn.mode[mode]
                tracks.mode[run, place, mode] = probability
                tracks.log_mode[run, place, mode] = np.log(probability) if probability > 0.0 else -np.inf
            tracks.existence[run, place] = existence
            tracks.is_confirmed[run, place] = existence >= p.confirming_existence
            tracks.hits[run, place] = tracks.chances[run, place] = 1
            tracks.score[run, place] = tracks.best_score[run, place] = 0.0
            tracks.seen_ns[run, place] = tracks.time_ns[run]
            tracks.updated_ns[run, place] = NEVER
        return turned_away

    return begin_tracks
