"""What other settings, or a log without a fault, would gain: the log-likelihood of replays.

A measurement that the gate keeps out is an outlier: it may be anywhere in the volume that the
innovations span, and is one with the share that they have. Without a gate there are none, and the
log-likelihood is that of the filter. Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, section 5.4; Durbin and Koopman, Time Series Analysis by State Space
Methods, 2nd ed. 2012, chapter 7.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from pipeline.tuning.broad_starts import Starts, begun_at, broad_starts, mean_likelihood, part_count
from recorders.errors import BadInput
from recorders.log import Stream, schemas
from replay.engine.replaying.estimator import Bound, bind
from replay.engine.replaying.replaying import collect, replay
from replay.engine.streams.sources import Ensemble, MemorySource

Floats = NDArray[np.float64]
Gains = Callable[[Sequence[float]], Sequence[float]]  # of the values of one number
DROP_95 = 1.92  # of the log-likelihood, from its greatest to where 95 % of a parameter end
EVALUATIONS = 16  # of a refinement at most
DOUBLINGS = 12  # of the way to an end
LARGEST = 1e12  # a loss, of what cannot be used


class Trial(NamedTuple):
    """A run as it may be, and the estimator's settings as they may be."""

    source: MemorySource
    settings: Mapping[str, Any]


@dataclass
class Likelihood:
    """The log-likelihood of trials that have the measurements of one run.

    Trials of equal settings are replayed together, as the runs of an ensemble.

    Attributes:
        label: the estimator's.
        volumes: by topic, the extents (m,) of the innovations' components, of which outliers may lie
            anywhere.
        count: how many innovations all trials have; another number cannot be compared.
        starts: where all trials begin, where the log does not state it.
    """

    label: str
    volumes: Mapping[str, Floats] = field(default_factory=dict)
    count: int = 0
    starts: Starts = field(default_factory=dict)
    _bound: dict[str, list[Bound]] = field(default_factory=dict)

    def begin(self, trial: Trial) -> dict[str, Stream]:
        """Take a trial for the one that others are compared with; its innovations by topic.

        From the likeliest part of broad starts, where the log does not state one. Raises BadInput where
        the estimator cannot begin.
        """
        self.starts = broad_starts(trial.source, bind(self.label, [trial.source], trial.settings))
        [parts] = self._innovations([trial])
        self.count = max(sum(map(len, part.values())) for part in parts)
        found = max(parts, key=_stated)
        self.volumes = {topic: _extents(stream) for topic, stream in found.items()}
        return found

    def __call__(self, trials: Sequence[Trial]) -> list[float]:
        """The log-likelihoods; minus infinity where the estimator fails or loses measurements."""
        together: dict[str, list[int]] = {}
        for place, trial in enumerate(trials):
            together.setdefault(_key(trial), []).append(place)
        found = [-np.inf] * len(trials)
        for places in together.values():
            outputs = self._innovations([trials[place] for place in places])
            for place, of_run in zip(places, outputs, strict=True):
                found[place] = self._total(of_run)
        return found

    def _innovations(self, trials: Sequence[Trial]) -> list[list[dict[str, Stream]]]:
        """The innovations of trials of equal settings, of each part by topic; none where it fails."""
        key, count = _key(trials[0]), part_count(self.starts)
        sources = [trial.source for trial in trials for _ in range(count)]
        try:
            if key not in self._bound:
                bound = bind(self.label, sources[:1], trials[0].settings)
                self._bound[key] = [begun_at(each, self.starts) for each in bound]
            outputs = collect(replay(Ensemble(sources), self._bound[key], is_part=True))
        except BadInput:  # no run can be followed with these
            return [[{}] * count for _ in trials]
        told = {
            topic: rows
            for topic, rows in outputs.items()
            if rows.stream.schema.full_name == schemas.INNOVATION.full_name
        }
        runs = [{topic: rows.of_run(run) for topic, rows in told.items()} for run in range(len(sources))]
        return [runs[first : first + count] for first in range(0, len(runs), count)]

    def _total(self, parts: Sequence[Mapping[str, Stream]]) -> float:
        found = [self._of_part(part) for part in parts]
        total = sum(mean_likelihood(found).values()) if any(found) else -np.inf
        return total if np.isfinite(total) else -np.inf

    def _of_part(self, innovations: Mapping[str, Stream]) -> dict[str, float]:
        """The log-likelihood of what is seen of each thing, by topic; nothing where messages lack."""
        if sum(map(len, innovations.values())) != self.count:
            return {}
        found = {}
        for topic, stream in innovations.items():
            is_in = stream["accepted"] != 0
            found[topic] = float(np.sum(stream["log_likelihood"][is_in]))
            missing = np.isnan(stream["innovation"][~is_in])
            found[topic] -= float(np.sum(np.where(missing, 0.0, np.log(self.volumes[topic]))))
            share = len(missing) / len(stream) if len(stream) else 0.0
            if 0.0 < share < 1.0:
                found[topic] += len(missing) * np.log(share) + is_in.sum() * np.log(1.0 - share)
        return found


def _stated(innovations: Mapping[str, Stream]) -> float:
    """The log-likelihood of a part, as its innovations state it."""
    return sum(float(np.nansum(stream["log_likelihood"])) for stream in innovations.values())


def _key(trial: Trial) -> str:
    return repr(sorted(trial.settings.items()))


def _extents(stream: Stream) -> Floats:
    """How far the innovations (m,) of each component range; an angle may have any value."""
    kinds = stream.metadata["kinds"].split(",")
    known = np.where(np.isfinite(stream["innovation"]), stream["innovation"], np.nan)
    is_there = np.isfinite(known).any(axis=0)
    extents = np.ones(known.shape[1])
    extents[is_there] = np.nanmax(known[:, is_there], axis=0) - np.nanmin(known[:, is_there], axis=0)
    extents = np.where(np.array(kinds) == "angle", 2.0 * np.pi, extents)
    return np.where(extents > 0.0, extents, 1.0)


class Peak(NamedTuple):
    """The value of one number at which the gain is greatest, and that gain."""

    value: float
    gain: float


def peak(gains: Gains, tried: Sequence[float], limit: float, floor: float) -> Peak:
    """The greatest gain of a number, from the best of those that are tried on.

    Args:
        gains: of several values; zero at zero.
        tried: values beside zero, the first two of them nearest to it, to either side where it has two.
        limit: of its magnitude.
        floor: a gain that is less than this is not worth a search.
    """
    known = {0.0: 0.0}

    def look(values: Sequence[float]) -> None:
        new = [value for value in values if value not in known]
        known.update(zip(new, gains(new), strict=True) if new else ())

    has_sides = tried[0] < 0.0
    look(tried[:2])
    if has_sides and max(known.values()) < 0.5 * floor and _by_parabola(known) < 0.5 * floor:
        return Peak(0.0, 0.0)  # a smooth function that is about greatest here
    look(tried)
    for _ in range(DOUBLINGS):
        best, low, high = _around(known)
        if len(tried) == 1 or best == 0.0 or low != high or abs(best) >= limit:
            break
        look([float(np.clip(2.0 * best, -limit, limit))])
    if len(tried) == 1 or (best == 0.0 and not has_sides):
        return Peak(best, known[best])
    options = {"maxiter": EVALUATIONS, "xatol": 1e-3 * (high - low)}

    def loss(value: float) -> float:
        look([float(value)])
        return -max(known[float(value)], -LARGEST)

    if low < high:
        minimize_scalar(loss, bounds=(low, high), method="bounded", options=options)
    best = max(known, key=lambda value: known[value])
    return Peak(best, known[best])


def _around(known: Mapping[float, float]) -> tuple[float, float, float]:
    """The value of the greatest gain and its neighbours; itself and itself where it is the last one."""
    values = sorted(known)
    place = max(range(len(values)), key=lambda place: known[values[place]])
    if place in (0, len(values) - 1):
        return values[place], values[place], values[place]
    return values[place], values[place - 1], values[place + 1]


def _by_parabola(known: Mapping[float, float]) -> float:
    """The greatest gain of the parabola through three of its values; infinite if it has none."""
    values, gains = np.array(sorted(known.items())).T
    if not gains.any():  # nothing depends on the number
        return 0.0
    if not np.isfinite(gains).all():
        return np.inf
    bend, slope, _ = np.polyfit(values / values[-1], gains, 2)
    return float(-(slope**2) / (4.0 * bend)) if bend < 0.0 else np.inf


def interval(gains: Gains, at: Peak, scale: float) -> tuple[float, float]:
    """The 95 % interval of a number: where the gain is less than its greatest by DROP_95.

    `scale` is a length that is not too long; an end that is not found is infinite.
    """

    def rest(value: float) -> float:
        [gain] = gains([value])
        return max(gain, -LARGEST) - (at.gain - DROP_95)

    def end(sign: float) -> float:
        inner, step = at.value, sign * scale
        for _ in range(DOUBLINGS):
            outer = at.value + step
            if rest(outer) < 0.0:
                return float(brentq(rest, inner, outer, xtol=1e-3 * abs(outer - at.value)))
            inner, step = outer, 2.0 * step
        return sign * np.inf

    return end(-1.0), end(1.0)
