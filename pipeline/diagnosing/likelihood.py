"""The log-likelihood of replays, from which the gains of corrected settings and logs are computed.

A trial is a log with an estimator's settings, in which faults may be corrected. All trials have the same
measurements, and their estimators start by the same rule. In some trials, the filter cannot score some
measurements, for example a fix that a delay moves beyond the odometry's span. These measurements are
scored by a broad model, in which successive messages differ by the amount that is usual for their topic.

A measurement that the gate rejects is scored as an outlier. Outliers are uniform in the volume that the
innovations span, and have the observed share of outliers as their probability. Without a gate there are
no outliers, and the log-likelihood is that of the filter. Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, 2001, section 5.4; Durbin and Koopman, Time Series Analysis
by State Space Methods, 2nd ed. 2012, chapter 7.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.runs.trials import Trial, alike, in_memory_together, together
from fuselog.pipeline.tuning.broad_starts import (
    Starts,
    begun_at,
    begun_broadly,
    broad_starts,
    mean_likelihood,
    part_count,
)
from fuselog.pipeline.tuning.control_noise import disturbed
from fuselog.pipeline.tuning.objective import is_innovation
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.replay.engine.replaying.estimator import Bound, Reading, Recursive
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.ensembles import Ensemble, ensemble_of
from fuselog.replay.engine.streams.sources import MemorySource

Floats = NDArray[np.float64]
Found = TypeVar("Found")
EVER_NS = 2**62
ROOM_NS = 86_400 * 10**9  # room for earlier stamps
LEAST_SCORED = 0.5  # share of the measurements; a trial that scores fewer cannot be compared


class Scored(NamedTuple):
    """The part of a trial that a filter can score.

    Attributes:
        source: its messages.
        begin_ns: the stamp at which the filter begins if there is no prior.
        left: log-likelihood of all other messages under the broad model, by estimate.
        beyond: number of messages that the broad model scores, by estimate.
        stretch: correction for units that differ from the log's, by estimate.
    """

    source: MemorySource
    begin_ns: int
    left: Mapping[str, float]
    beyond: Mapping[str, int]
    stretch: Mapping[str, float]


class _Known:
    """A cache of results on streams that several trials share."""

    def __init__(self) -> None:
        self._found: dict[Hashable, tuple[object, object]] = {}

    def once(self, streams: Sequence[Stream], key: Hashable, find: Callable[[], Found]) -> Found:
        """Return the result of `find` for these stream objects, cached under a key."""
        entry = (*map(id, streams), key)
        if entry not in self._found:
            self._found[entry] = find(), streams  # the streams stay alive, so their ids stay valid
        return cast(Found, self._found[entry][0])


@dataclass
class Likelihood:
    """The log-likelihood of trials that have the measurements of one run.

    Trials whose estimators differ only in numbers are replayed together, like the runs of an ensemble.

    Attributes:
        volumes: by topic, the ranges (m,) of the innovations' components, in which outliers are uniform.
        count: by estimate, the number of innovations and of messages that the broad model scores.
        starts: the initial states that all trials share, if the log contains none.
        readings: by estimate, functions that read the measured numbers, if known.
        broad: by topic, the mean log-likelihood of a message under the broad model.
        later_ns: shift of all stamps, so that no alteration moves them to before 1970.
    """

    volumes: Mapping[str, Floats] = field(default_factory=dict)
    count: Mapping[str, int] = field(default_factory=dict)
    starts: Starts = field(default_factory=dict)
    readings: Mapping[str, Reading] = field(default_factory=dict)
    broad: Mapping[str, float] = field(default_factory=dict)
    later_ns: int = 0
    _bound: dict[Hashable, list[Bound]] = field(default_factory=dict)
    # by the metadata of channels, runs to which estimators are bound; messages do not matter for that
    _runs: dict[Hashable, Ensemble[MemorySource]] = field(default_factory=dict)

    def begin(self, trial: Trial) -> dict[str, Stream]:
        """Set the trial with which other trials are compared, and return its innovations by topic.

        If the log has no initial state, the innovations from the most likely broad start are returned.
        Raises BadInput if the estimator cannot begin.
        """
        bound = self._bound_to(trial)
        self.later_ns = max(0, ROOM_NS - trial.source.extent("publish_time")[0])
        later = {topic: _later(each, self.later_ns) for topic, each in trial.source.streams.items()}
        self.starts = broad_starts(replace(trial.source, streams=later), bound)
        self.readings = {
            each.name: each.reading()
            for each in bound
            if isinstance(each, Recursive) and each.reading is not None
        }
        self.broad = {
            topic: _broad(reading.numbers(trial.source.streams[topic]), kinds)
            for reading in self.readings.values()
            for topic, kinds in reading.kinds.items()
            if topic not in reading.controls and len(trial.source.streams[topic])
        }
        scored = self._scored(trial, bound, _Known())
        [parts] = self._innovations([bound], [scored])
        found = max(parts, key=_stated)
        for name, reading in self.readings.items():
            if _topic(name) in found:
                self.broad |= _foreseen(self.broad, reading, found[_topic(name)])
        self.count = {
            name: max(len(part.get(_topic(name), ())) for part in parts) + scored.beyond.get(name, 0)
            for name in dict.fromkeys([*(each.name for each in bound), *map(_name, found)])
        }
        self.volumes = {topic: _extents(stream) for topic, stream in found.items()}
        return found

    def __call__(self, trials: Sequence[Trial]) -> list[float]:
        """Compute the log-likelihoods; minus infinity if a replay fails or loses measurements."""
        return [float(each) for [each] in self.over_parts(trials, 1)]

    def over_parts(self, trials: Sequence[Trial], count: int) -> Floats:
        """Compute log-likelihoods (trials, count) of equal shares of the measurements, in order.

        The log-likelihoods are minus infinity if the estimator fails or loses measurements.
        """
        groups: dict[Hashable, list[int]] = {}
        bound: dict[int, list[Bound]] = {}
        for place, trial in enumerate(trials):
            stated, key = _stated_by(trial), _key(trial)
            with suppress(BadInput):  # no run fits these settings
                bound[place] = self._bound_to(trial, (key, stated))
                groups.setdefault((alike(bound[place]) or key, stated), []).append(place)
        found = np.full((len(trials), count), -np.inf)
        for group in groups.values():
            repeated = [trials[group[0]].source] * part_count(self.starts)
            for places in in_memory_together(group, repeated):
                known = _Known()
                scored = [self._scored(trials[place], bound[place], known) for place in places]
                outputs = self._innovations([bound[place] for place in places], scored)
                for place, part, of_run in zip(places, scored, outputs, strict=True):
                    found[place] = self._totals(part, of_run, count)
        return found

    def disturbed(self, trial: Trial) -> list[Trial]:
        """Make copies of a trial with noise added to the controls of its log."""
        copies = disturbed(trial.source, self._bound_to(trial))
        return [replace(trial, runs=[each]) for each in copies]

    def _bound_to(self, trial: Trial, key: tuple[str, Hashable] | None = None) -> list[Bound]:
        key = key or (_key(trial), _stated_by(trial))
        if key not in self._bound:
            _, stated = key
            runs = self._runs.setdefault(stated, ensemble_of(trial.runs))
            self._bound[key] = replace(trial, runs=runs).bind()
        return self._bound[key]

    def _scored(self, trial: Trial, bound: Sequence[Bound], known: "_Known") -> Scored:
        """Select the messages that are scored: within the span of the controls, and after the prior.

        `known` caches results on streams that several trials share.
        """
        given, streams = trial.source.streams, dict(trial.source.streams)
        left, count, stretch = dict[str, float](), dict[str, int](), dict[str, float]()
        begins = [np.iinfo(np.int64).max]
        for each in bound:
            reading = self.readings.get(each.name)
            if reading is None:
                continue
            drives = [given[topic] for topic in (*reading.controls, *each.priors) if topic in given]
            span_ns = known.once(drives, each.name, partial(_span, reading.controls, each, given))
            for topic in each.streams:
                stream = given[topic]
                if topic not in reading.controls and len(stream):
                    streams[topic] = known.once([stream], span_ns, partial(_within, stream, span_ns))
                    lost = len(stream) - len(streams[topic])
                    left[each.name] = left.get(each.name, 0.0) + lost * self.broad[topic]
                    count[each.name] = count.get(each.name, 0) + lost
                    added = trial.stretched.get(topic, 0.0) * len(streams[topic])
                    stretch[each.name] = stretch.get(each.name, 0.0) + added
                begins += streams[topic].publish_time_ns[:1].tolist()
        later = {
            topic: known.once([stream], self.later_ns, partial(_later, stream, self.later_ns))
            for topic, stream in streams.items()
        }
        # raw messages: otherwise, a trial would gain if its alteration makes values impossible
        source = replace(trial.source, streams=later, is_raw=True)
        return Scored(source, min(begins) + self.later_ns, left, count, stretch)

    def _innovations(
        self, bounds: Sequence[Sequence[Bound]], scored: Sequence[Scored]
    ) -> list[list[dict[str, Stream]]]:
        """Replay trials of similar estimators; return innovations by part and topic, {} if they fail."""
        count = part_count(self.starts)
        bound = [together(each, count) for each in zip(*bounds, strict=True)]
        sources = [each.source for each in scored for _ in range(count)]
        begins_ns = [each.begin_ns for each in scored]
        try:
            begun = [begun_broadly(begun_at(each, self.starts), begins_ns, count) for each in bound]
            outputs = collect(replay(Ensemble(sources), begun, is_part=True))
        except BadInput:  # no run fits these settings
            outputs = {}
        if not outputs and any(each is not bounds[0] for each in bounds):
            alone = zip(bounds, scored, strict=True)
            return [parts for each, own in alone for parts in self._innovations([each], [own])]
        innovations = {topic: rows for topic, rows in outputs.items() if is_innovation(rows)}
        runs = [
            {topic: rows.of_run(run) for topic, rows in innovations.items()}
            for run in range(len(sources))
        ]
        return [runs[first : first + count] for first in range(0, len(runs), count)]

    def _totals(self, scored: Scored, parts: Sequence[Mapping[str, Stream]], count: int) -> Floats:
        """Compute log-likelihoods of equal shares of the measurements, each given the earlier shares."""
        until = []
        for share in np.arange(1, count + 1) / count:
            found = [self._of_start(scored, part, share) for part in parts]
            total = sum(mean_likelihood(found).values()) if any(found) else -np.inf
            until.append(total if np.isfinite(total) else -np.inf)
        if not np.isfinite(until).all():
            return np.full(count, -np.inf)
        return np.subtract(until, [0.0, *until[:-1]])

    def _of_start(
        self, scored: Scored, innovations: Mapping[str, Stream], share: float
    ) -> dict[str, float]:
        """Compute the first share's log-likelihood by estimate; {} if too few innovations are scored."""
        found = {}
        for name, all_ in self.count.items():
            topic = _topic(name)
            stream = innovations.get(topic)
            if stream is None:
                if all_:
                    return {}
                continue
            lacking = all_ - scored.beyond.get(name, 0) - len(stream)
            if len(stream) < LEAST_SCORED * all_ or (lacking and name not in self.readings):
                return {}
            if share < 1.0:
                stream = stream.take(first_of_each(stream, share))
            is_in, logs = stream["accepted"] != 0, stream["log_likelihood"]
            total = float((logs if is_in.all() else logs[is_in]).sum())
            if not is_in.all():
                missing = np.isnan(stream["innovation"][~is_in])
                total -= float(np.sum(np.where(missing, 0.0, np.log(self.volumes[topic]))))
                rejected = len(missing) / len(stream)
                if rejected < 1.0:
                    total += len(missing) * np.log(rejected) + is_in.sum() * np.log(1.0 - rejected)
            if name in self.readings:
                own = [self.broad[each] for each in self.readings[name].kinds if each in self.broad]
                more = lacking * float(np.mean(own)) if lacking else 0.0
                more += scored.left.get(name, 0.0) + scored.stretch.get(name, 0.0)
                total += share * more
            found[name] = total
        return found


def _topic(name: str) -> str:
    return f"/estimates/{name}/innovation"


def _name(topic: str) -> str:
    """Return the name of the estimate to which innovations belong; a program may have several."""
    return topic.removeprefix("/estimates/").removesuffix("/innovation")


def _span(controls: Sequence[str], bound: Bound, streams: Mapping[str, Stream]) -> tuple[int, int, int]:
    """Find the span in which a filter can score measurements, and the time step of its controls.

    Measurements at most one step before the span are scored at its start, and measurements at most two
    steps after the span are scored as well. Thus messages that a small delay moves across an end of the
    span stay comparable.
    """
    begin_ns, end_ns, longest_ns = -EVER_NS, EVER_NS, 0
    for topic in controls:
        stamps_ns = streams[topic].publish_time_ns
        if len(stamps_ns):
            step_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0
            begin_ns = max(begin_ns, int(stamps_ns.min()))
            end_ns = min(end_ns, int(stamps_ns.max()))
            longest_ns = max(longest_ns, step_ns)
    for topic in bound.priors:
        if topic in streams and len(streams[topic]):
            begin_ns = int(streams[topic].publish_time_ns[0])
    return begin_ns, end_ns, longest_ns


def _broad(numbers: Floats, kinds: Sequence[str]) -> float:
    """Compute the mean log-likelihood of messages (n, m) under a random walk with their mean steps."""
    steps = np.diff(numbers, axis=0)
    is_angle = np.array(kinds) == "angle"
    steps[:, is_angle] = np.remainder(steps[:, is_angle] + np.pi, 2.0 * np.pi) - np.pi
    known = np.isfinite(steps)
    squares = np.where(known, steps, 0.0) ** 2
    squares = squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    there = squares > 0.0
    return float(-0.5 * np.sum(np.log(2.0 * np.pi * squares[there]) + 1.0))


def _foreseen(broad: Mapping[str, float], reading: Reading, innovations: Stream) -> dict[str, float]:
    """Limit the broad likelihood of topics that a filter predicts better than its variances suggest.

    For a stationary body, the broad model is more precise than a conservative filter. Without the limit,
    a delay would gain by moving messages out of the scored span.
    """
    found = {}
    is_known = np.isfinite(innovations["innovation"])
    for topic, names in reading.measured.items():
        own = np.isin(innovations.components, names)
        rows = (is_known & own).any(axis=1) & ~(is_known & ~own).any(axis=1)
        squares = innovations["normalised_innovation_squared"][rows].sum()
        if topic in broad and rows.any() and squares < is_known[rows].sum():
            found[topic] = min(broad[topic], float(innovations["log_likelihood"][rows].mean()))
    return found


def first_of_each(innovations: Stream, share: float) -> NDArray[np.bool_]:
    """Test which innovations are in the first share of their sensor's innovations.

    If the share were taken of the innovations of all sensors together, a delay that changes their order
    would change the selection.
    """
    known = np.isfinite(innovations["innovation"])
    sensor = known @ 2.0 ** np.arange(known.shape[1])
    is_first = np.zeros(len(innovations), bool)
    for each in np.unique(sensor):
        rows = np.flatnonzero(sensor == each)
        is_first[rows[: round(share * len(rows))]] = True
    return is_first


def _within(stream: Stream, span_ns: tuple[int, int, int]) -> Stream:
    """Return the messages that can be scored in a span (see `_span`); move earlier ones to its start."""
    (begin_ns, end_ns, step_ns), stamps_ns = span_ns, stream.publish_time_ns
    is_in = (stamps_ns >= begin_ns - step_ns) & (stamps_ns <= end_ns + 2 * step_ns)
    if is_in.all() and stamps_ns.min() >= begin_ns:
        return stream
    inside = stream.take(is_in)
    return replace(inside, publish_time_ns=np.maximum(inside.publish_time_ns, begin_ns))


def _later(stream: Stream, by_ns: int) -> Stream:
    return replace(stream, publish_time_ns=stream.publish_time_ns + by_ns) if by_ns else stream


def _stated(innovations: Mapping[str, Stream]) -> float:
    """Sum the log-likelihoods that the innovations of a part contain."""
    return sum(float(np.nansum(stream["log_likelihood"])) for stream in innovations.values())


def _stated_by(trial: Trial) -> Hashable:
    """Return the metadata of channels, which must be equal for trials that are replayed together."""
    return tuple((topic, *stream.metadata.items()) for topic, stream in trial.source.streams.items())


def _key(trial: Trial) -> str:
    return repr(sorted(trial.settings.items()))


def _extents(stream: Stream) -> Floats:
    """Compute the ranges (m,) of innovations by component; the range of an angle is a full turn."""
    kinds = stream.metadata["kinds"].split(",")
    known = np.where(np.isfinite(stream["innovation"]), stream["innovation"], np.nan)
    highest = np.fmax.reduce(known, axis=0, initial=-np.inf)  # result for a component without values
    extents = highest - np.fmin.reduce(known, axis=0, initial=np.inf)
    extents = np.where(np.array(kinds) == "angle", 2.0 * np.pi, extents)
    return np.where(extents > 0.0, extents, 1.0)
