"""Comparison of tracks with trajectories of targets at instants that do not depend on sensors.

At every instant, the tracks are predicted to this instant and paired with the targets that are present
(GOSPA with alpha 2). The pairs determine the distance of a track from its target, and the share of time
in which a target is followed. Switches to another track and breaks are counted with the pairs of CLEAR
MOT: a pair is kept while it is within the cutoff.

By default, every track counts. If the metadata of a truth states that truths cover only some of the
targets (`COVERS`), a track of another target is not a false track: tracks that are farther than a
limit from all targets with a truth are counted separately as unreferenced, and metrics that exclude
them have separate names.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, Topic, schemas, topics_of
from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.families.sets.judging.distances import gospa, gospa_pairs
from fuselog.replay.families.tracking.judging.clear_mot import NONE, clear_mot, switches_and_breaks
from fuselog.replay.judging.errors.truths import COVERS, SOME_TARGETS

CUTOFF_M = 20.0
UNREFERENCED_M = 50.0
# Time of the first instant, before which tracks can begin, and the period of the instants.
BURN_IN_S = 10.0
PERIOD_S = 0.5
SOME_ARE_KNOWN = (
    "the truths cover only some of the targets: a track more than "
    f"{UNREFERENCED_M:g} m from all truths counts as unreferenced, not as false, and referenced_hota "
    f"and referenced_idf1 exclude tracks that never come within {CUTOFF_M:g} m of a truth"
)
VELOCITY = ("vx_mps", "vy_mps")


class TracksAt(NamedTuple):
    """Tracks at one instant: their numbers (n,) and positions (n, 2)."""

    number: Integers
    place: Floats


class TrackErrors(NamedTuple):
    """Errors of the tracks of one run at k instants; distances are in m, the parts of GOSPA in m^2.

    Attributes:
        gospa_all: (k,), GOSPA of all tracks.
        gospa, localisation, missed, false: (k,), GOSPA and its parts without unreferenced tracks.
        unreferenced: (k,), number of unreferenced tracks; None if the truths cover all targets.
        track: (targets, k), the track with which GOSPA pairs each target, or NONE.
        distance: (targets, k), distance of each target from its track; NaN if the target has no track.
        present: (targets, k), whether the target is present.
        kept: (targets, k), the track with which CLEAR MOT pairs each target, or NONE.
    """

    gospa_all: Floats
    gospa: Floats
    localisation: Floats
    missed: Floats
    false: Floats
    unreferenced: Integers | None
    track: Integers
    distance: Floats
    present: Booleans
    kept: Integers


class Judged(NamedTuple):
    """Instants (k,) at which the tracks of a run are judged, and truths (targets, k, 2).

    `unreferenced_m` is the distance from all truths beyond which a track belongs to a target without a
    truth; infinite if the truths cover all targets.
    """

    time_ns: Integers
    truths: Floats
    unreferenced_m: float = np.inf

    @property
    def is_partial(self) -> bool:
        """Test whether there may be targets without a truth."""
        return bool(np.isfinite(self.unreferenced_m))


def target_topics(topics: Mapping[str, Topic]) -> list[str]:
    """List the truths that are positions of targets, not poses of scanning sensors."""
    return [
        topic
        for topic in topics_of(topics, schemas.TRUTH_STATE)
        if {*PLANE} <= {*topics[topic].metadata.get("components", "").split(",")}
        and f"{topic.rpartition('/')[0]}/scan" not in topics
    ]


def instants_of(source: Source, burn_in_s: float = BURN_IN_S, period_s: float = PERIOD_S) -> Judged:
    """Choose instants from the end of the burn-in until scans or a truth end, whichever is first.

    Truths are interpolated linearly. Raises BadInput if there are no scans or no truths of positions, or
    if any of them end before the first instant.
    """
    scans = source.read(topics_of(source.topics, schemas.SCAN))
    truths = source.read(target_topics(source.topics))
    if not scans or not truths:
        raise BadInput(
            f"{source.name}: tracks are judged with scans and truths, and one of them is missing; use a "
            "log with both"
        )
    last_ns = [int(stream.publish_time_ns.max(initial=0)) for stream in truths.values()]
    last_ns.append(max(int(stream.publish_time_ns.max(initial=0)) for stream in scans.values()))
    first_ns = source.epoch_ns + round(burn_in_s * 1e9)
    at_ns = np.arange(first_ns, min(last_ns) + 1, round(period_s * 1e9))
    if not len(at_ns):
        raise BadInput(
            f"{source.name}: the log ends within the first {burn_in_s:g} s, which are not judged; use a "
            "longer log"
        )
    places = [
        [np.interp(at_ns - first_ns, truth.publish_time_ns - first_ns, axis) for axis in place.T]
        for truth in truths.values()
        for place in [read_vectors(truth, "state", PLANE)]
    ]
    return Judged(at_ns, np.array(places).transpose(0, 2, 1), unreferenced_m(truths.values()))


def unreferenced_m(truths: Iterable[Stream]) -> float:
    """Return the distance beyond which a track is unreferenced, from the metadata of all truths."""
    covered = {truth.metadata.get(COVERS, "") for truth in truths}
    return UNREFERENCED_M if SOME_TARGETS in covered else np.inf


def tracks_at(sizes: Stream, tracks: Stream, at_ns: Integers, delay_ns: int = 0) -> list[TracksAt]:
    """Return the tracks of a run at instants: the last estimates, predicted by their velocities.

    `sizes` has the number of messages in `tracks` for each scan. A tracker that waits for late scans
    reports each scan `delay_ns` after its stamp. Tracks without velocities are not predicted.

    Args:
        sizes: sizes of the sets of tracks, one message per scan.
        tracks: all tracks after each scan.
        at_ns: (k,), the instants.
        delay_ns: time from a scan's stamp to its report.
    """
    names = tracks.components
    moving = VELOCITY if {*VELOCITY} <= {*names} else ()
    place, velocity = ([names.index(each) for each in of] for of in (PLANE, moving))
    ends = np.append(0, np.cumsum(sizes["elements"].astype(np.int64)))
    found = []
    for time_ns, last in zip(
        at_ns, np.searchsorted(sizes.publish_time_ns, at_ns - delay_ns, side="right"), strict=True
    ):
        rows = slice(ends[last - 1], ends[last]) if last else slice(0, 0)
        later_s = (time_ns - sizes.publish_time_ns[last - 1]) * 1e-9 if last else 0.0
        mean = tracks["mean"][rows]
        moved = mean[:, place] + (later_s * mean[:, velocity] if velocity else 0.0)
        found.append(TracksAt(tracks["track_id"][rows].astype(np.int64), moved))
    return found


def track_errors(
    tracks: Sequence[TracksAt],
    truths: Floats,
    cutoff_m: float = CUTOFF_M,
    unreferenced_m: float = np.inf,
) -> TrackErrors:
    """Compare the tracks at k instants with the truths (targets, k, 2).

    Args:
        tracks: the tracks at each of the k instants.
        truths: (targets, k, 2), in m, NaN when a target is absent.
        cutoff_m: cutoff of GOSPA.
        unreferenced_m: distance from all targets beyond which a track is unreferenced.
    """
    targets_in_all, instants, _ = truths.shape
    present = np.asarray(np.isfinite(truths).all(axis=2))
    found = TrackErrors(
        gospa_all=np.zeros(instants),
        gospa=np.zeros(instants),
        localisation=np.zeros(instants),
        missed=np.zeros(instants),
        false=np.zeros(instants),
        unreferenced=np.zeros(instants, np.int64) if np.isfinite(unreferenced_m) else None,
        track=np.full((targets_in_all, instants), NONE),
        distance=np.full((targets_in_all, instants), np.nan),
        present=present,
        kept=clear_mot([(at.number, at.place) for at in tracks], truths, cutoff_m),
    )
    for instant, at in enumerate(tracks):
        targets = np.flatnonzero(present[:, instant])
        true = truths[targets, instant]
        away = np.linalg.norm(at.place[:, None] - true[None], axis=2)
        known = (away <= unreferenced_m).any(axis=1) | np.isinf(unreferenced_m)
        place = at.place[known]
        found.gospa_all[instant] = gospa(at.place, true, cutoff_m).total
        parts = gospa(place, true, cutoff_m)
        found.gospa[instant], found.localisation[instant] = parts.total, parts.localisation
        found.missed[instant], found.false[instant] = parts.missed, parts.false
        if found.unreferenced is not None:
            found.unreferenced[instant] = np.count_nonzero(~known)
        estimate, paired = gospa_pairs(place, true, cutoff_m)
        found.track[targets[paired], instant] = at.number[known][estimate]
        found.distance[targets[paired], instant] = away[known][estimate, paired]
    return found


def track_figures(errors: TrackErrors, cutoff_m: float = CUTOFF_M) -> dict[str, float]:
    """Compute means over the instants, and RMSE and coverage per target; targets are numbered from 1.

    `missed_targets` and `false_targets` are mean numbers of targets. The RMSE of a target that is never
    followed is NaN. If the truths cover only some targets, the GOSPA of all tracks and the number of
    unreferenced tracks are included.
    """
    alone = cutoff_m**2 / 2.0
    figures = {"gospa_m": float(errors.gospa.mean())}
    if errors.unreferenced is not None:
        figures["gospa_all_m"] = float(errors.gospa_all.mean())
    figures |= {
        "localisation_m2": float(errors.localisation.mean()),
        "missed_targets": float(errors.missed.mean()) / alone,
        "false_targets": float(errors.false.mean()) / alone,
    }
    if errors.unreferenced is not None:
        figures["unreferenced_targets"] = float(errors.unreferenced.mean())
    for target, (track, distance, present) in enumerate(
        zip(errors.track, errors.distance, errors.present, strict=True), start=1
    ):
        followed = np.flatnonzero(track != NONE)
        figures[f"target{target}_rmse_m"] = (
            float(np.sqrt(np.mean(distance[followed] ** 2))) if len(followed) else float("nan")
        )
        figures[f"target{target}_coverage"] = len(followed) / max(int(present.sum()), 1)
    switches, breaks = switches_and_breaks(errors.kept, errors.present)
    return figures | {"switches": float(switches), "breaks": float(breaks)}


def figures_of_whole_tracks(
    tracks: Sequence[TracksAt], truths: Floats, unreferenced_m: float = np.inf
) -> dict[str, float]:
    """Compute HOTA and IDF1 with a cutoff of 20 m.

    By default, all tracks count. If truths cover only some targets, tracks are used only if they come
    within the cutoff of a target at some instant, and the metrics have other names.

    Args:
        tracks: the tracks at each of k instants.
        truths: (targets, k, 2), in m, NaN when a target is absent.
        unreferenced_m: see `Judged`.
    """
    from fuselog.replay.families.tracking.judging.distances import (  # slow: it imports SciPy
        hota,
        idf1,
    )

    near, others = near_tracks(tracks, truths)
    is_partial = bool(np.isfinite(unreferenced_m))
    name, more = ("referenced_", 0) if is_partial else ("", others)
    return {
        f"{name}hota": float(hota(near, truths, CUTOFF_M, others=more).hota.mean()),
        f"{name}idf1": idf1(near, truths, CUTOFF_M, others=more),
    }


def near_tracks(tracks: Sequence[TracksAt], truths: Floats) -> tuple[Floats, int]:
    """Find the tracks that come within the cutoff of a target.

    Args:
        tracks: the tracks at each of k instants.
        truths: (targets, k, 2), in m, NaN when a target is absent.

    Returns: The near tracks (tracks, k, 2), NaN when a track is absent, and the number of points of all
    other tracks.
    """
    near: set[int] = set()
    for at, true in zip(tracks, truths.transpose(1, 0, 2), strict=True):
        away = np.linalg.norm(at.place[:, None] - true[None], axis=2)
        near.update(at.number[(away < CUTOFF_M).any(axis=1)].tolist())
    kept, others = [], 0
    for at in tracks:
        is_near = np.isin(at.number, list(near))
        kept.append(TracksAt(at.number[is_near], at.place[is_near]))
        others += int(np.count_nonzero(~is_near))
    return as_trajectories(kept), others


def as_trajectories(tracks: Sequence[TracksAt]) -> Floats:
    """Arrange the tracks at k instants as (tracks, k, 2), NaN when absent; see `judging.distances`."""
    numbers = np.unique(np.concatenate([at.number for at in tracks] or [np.empty(0, np.int64)]))
    found = np.full((len(numbers), len(tracks), 2), np.nan)
    for instant, at in enumerate(tracks):
        found[np.searchsorted(numbers, at.number), instant] = at.place
    return found
