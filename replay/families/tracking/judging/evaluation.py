"""Evaluation of the tracks of a replay against the targets in its log, block by block.

Instants, pairs and distances are defined in `errors`; experiments with trackers use the same
definitions. A target is present from the first to the last stamp of its truth. The judged span begins
after a burn-in time and ends with the last scan that the tracker processed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.planes import frame_of
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.families.tracking.judging.clear_mot import NONE
from fuselog.replay.families.tracking.judging.errors import (
    BURN_IN_S,
    PERIOD_S,
    SOME_ARE_KNOWN,
    VELOCITY,
    Judged,
    TracksAt,
    figures_of_whole_tracks,
    target_topics,
    track_errors,
    track_figures,
    tracks_at,
    unreferenced_m,
)
from fuselog.replay.judging.errors.evaluation import split_topic
from fuselog.replay.judging.errors.frames import not_comparable, seen_in
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.kinds import JudgedRuns, KindJudge
from fuselog.replay.judging.metrics.measuring import Metric

# Greatest burn-in as a share of the run; in short runs, tracks have less time to begin.
BURN_IN_SHARE = 0.25


class TrackBlock(NamedTuple):
    """A block of a tracker's sets of tracks: their sizes, the tracks, and the targets of each run."""

    estimator: str
    case: str
    sizes: Ragged
    tracks: Ragged
    targets: Sequence[Judged | None]
    first_run: int = 0


def targets_of(source: Source, frame: str) -> Judged | None:
    """Return the targets of a run in a frame at the run's instants, or None if there are no targets.

    Instants are PERIOD_S apart, from the end of the burn-in (BURN_IN_S, or BURN_IN_SHARE of the span if
    this is shorter) to the end of the last truth. Positions are NaN when a target is absent.
    """
    topics = target_topics(source.topics)
    truths = {topic: truth for topic, truth in source.read(topics).items() if len(truth)}
    if not truths:
        return None
    last_ns = max(int(truth.publish_time_ns[-1]) for truth in truths.values())
    span_s = (last_ns - source.epoch_ns) * 1e-9
    burn_in_s = min(BURN_IN_S, BURN_IN_SHARE * span_s)
    first_ns = source.epoch_ns + round(burn_in_s * 1e9)
    at_ns = np.arange(first_ns, last_ns + 1, round(PERIOD_S * 1e9))
    places = [
        seen_in(frame, Truths(source), topic, _places(truth, at_ns), at_ns, span_s)
        for topic, truth in truths.items()
    ]
    return Judged(at_ns, np.stack(places), unreferenced_m(truths.values()))


def unjudged_tracks(tracks: Stream, sources: Sequence[Source]) -> str:
    """Explain why tracks cannot be compared with the targets of a run; return "" if they can."""
    reasons = (
        not_comparable(tracks.metadata, target_topics(source.topics), source.topics)
        for source in sources
    )
    return next(filter(None, reasons), "")


def _places(truth: Stream, at_ns: Integers) -> Floats:
    """Interpolate a target's position (k, 2); NaN before its first stamp and after its last one."""
    place, begin_ns = read_vectors(truth, "state", PLANE), truth.publish_time_ns[0]
    stamps = truth.publish_time_ns - begin_ns
    axes = [np.interp(at_ns - begin_ns, stamps, axis, left=np.nan, right=np.nan) for axis in place.T]
    return np.stack(axes, axis=1)


def track_blocks(
    outputs: Mapping[str, Ragged], targets: Mapping[str, Sequence[Judged | None]], first_run: int
) -> dict[str, TrackBlock]:
    """Collect the sets of tracks in the outputs of a replay, or in a block of them, by topic.

    `targets` has the targets of the runs, by frame; tracks in other frames are left out.
    """
    found = {}
    for topic, tracks in outputs.items():
        sizes = outputs.get(f"{topic.rpartition('/')[0]}/set")
        is_track = tracks.stream.schema.full_name == schemas.TRACK_ESTIMATE.full_name
        if not is_track or sizes is None or not {*PLANE, *VELOCITY} <= {*tracks.stream.components}:
            continue
        if (seen := targets.get(frame_of(tracks.stream.metadata))) is not None:
            found[topic] = TrackBlock(*split_topic(topic), sizes, tracks, seen, first_run)
    return found


class TracksJudge(KindJudge):
    """Judge of sets of tracks, which reads the targets of each run once for each frame."""

    def __init__(self, runs: JudgedRuns) -> None:
        super().__init__(runs)
        self._targets: dict[str, list[Judged | None]] = {}

    def add(self, outputs: Mapping[str, Ragged]) -> list[tuple[str, Any]]:
        """Judge a block; see `KindJudge`."""
        for topic, rows in outputs.items():
            is_track = rows.stream.schema.full_name == schemas.TRACK_ESTIMATE.full_name
            if is_track and topic not in self.unjudged:
                self._find_targets(topic, rows.stream)
        return [*track_blocks(outputs, self._targets, self.runs.first_run).items()]

    def _find_targets(self, topic: str, tracks: Stream) -> None:
        """Find the targets for new tracks, and check that the tracks can be judged."""
        self.unjudged[topic] = unjudged_tracks(tracks, self.runs.sources)
        frame = frame_of(tracks.metadata)
        if self.unjudged[topic] or frame in self._targets:
            return
        self._targets[frame] = [targets_of(source, frame) for source in self.runs.sources]
        if any(targets is not None and targets.is_partial for targets in self._targets[frame]):
            self.notes = [SOME_ARE_KNOWN]


@dataclass
class Followed:
    """The tracks of one run as reported at its instants.

    Attributes:
        targets: the instants, and the positions of the targets.
        sets: the tracks at the instants so far.
        first: number of instants before the first set of tracks; these instants are not judged.
        last: the last set of tracks.
    """

    targets: Judged
    sets: list[TracksAt] = field(default_factory=list)
    first: int | None = None
    last: tuple[Stream, Stream] | None = None

    def add(self, sizes: Stream, tracks: Stream) -> None:
        """Add the next sets of tracks."""
        if not len(sizes):
            return
        at_ns = self.targets.time_ns
        if self.first is None:
            self.first = int(np.searchsorted(at_ns, sizes.publish_time_ns[0]))
        begin = self.first + len(self.sets)
        # instants before the block use the last set before it
        before = int(np.searchsorted(at_ns, sizes.publish_time_ns[0]))
        if self.last is not None:
            self.sets += tracks_at(*self.last, at_ns[begin:before])
        end = int(np.searchsorted(at_ns, sizes.publish_time_ns[-1], side="right"))
        self.sets += tracks_at(sizes, tracks, at_ns[max(begin, before) : end])
        count = int(sizes["elements"][-1])
        self.last = (
            sizes.take(slice(len(sizes) - 1, None)),
            tracks.take(slice(len(tracks) - count, None)),
        )

    @property
    def figures(self) -> dict[str, float]:
        """Compute figures of the tracks at the instants so far, or {} without tracks or targets."""
        begin = self.first or 0
        truths = self.targets.truths[:, begin : begin + len(self.sets)]
        if not self.sets or not np.isfinite(truths).any():
            return {}
        limit_m = self.targets.unreferenced_m
        errors = track_errors(self.sets, truths, unreferenced_m=limit_m)
        found = {
            name: value
            for name, value in track_figures(errors).items()
            if not name.startswith("target")  # only experiments report targets one by one
        }
        followed = errors.track != NONE
        squared = errors.distance[followed] ** 2
        return found | {
            "followed_share": float(followed.sum() / errors.present.sum()),
            "followed_rmse_m": float(np.sqrt(squared.mean())) if len(squared) else np.nan,
            **figures_of_whole_tracks(self.sets, truths, limit_m),
        }


# State of a run: its tracks while more may follow, afterwards only their figures.
State = dict[int, Followed | dict[str, float]]


def _add(state: State, block: TrackBlock) -> State:
    for number, targets in enumerate(block.targets):
        if targets is not None:
            followed = state.setdefault(block.first_run + number, Followed(targets))
            assert isinstance(followed, Followed)
            followed.add(block.sizes.of_run(number), block.tracks.of_run(number))
    return state


def _merge(first: State, second: State) -> State:
    return {**_figures(first), **_figures(second)}


def _figures(state: State) -> dict[int, dict[str, float]]:
    return {run: of.figures if isinstance(of, Followed) else of for run, of in sorted(state.items())}


def _finish(state: State) -> dict[str, float]:
    """Compute the mean of each figure over the runs that have it."""
    runs = [figures for figures in _figures(state).values() if figures]
    found = {}
    for name in dict.fromkeys(name for figures in runs for name in figures):
        known = [figures[name] for figures in runs if np.isfinite(figures.get(name, np.nan))]
        found[name] = float(np.mean(known)) if known else np.nan
    return found


FOLLOWING = Metric(
    "GOSPA of tracks, cutoff 20 m, HOTA and IDF1 against the truths of targets",
    TrackBlock,
    dict,
    _add,
    _merge,
    _finish,
)
