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

from pipeline.tuning.objective import innovations_in
from recorders.errors import BadInput
from recorders.log import Stream
from replay.engine.blocks import Ragged
from replay.engine.estimator import Bound, bind
from replay.engine.replaying import collect, replay
from replay.engine.sources import Ensemble, MemorySource

Floats = NDArray[np.float64]
DROP_95 = 1.92  # of the log-likelihood, from its greatest to where 95 % of a parameter end
EVALUATIONS = 16  # of a refinement at most
DOUBLINGS = 12  # of the way to an end


class Trial(NamedTuple):
    """A run as it may be, and the estimator's settings as they may be."""

    source: MemorySource
    settings: Mapping[str, Any]


@dataclass
class Likelihood:
    """The log-likelihood of trials that have the measurements of one run.

    Attributes:
        label: the estimator's.
        volumes: by topic, the extents (m,) of the innovations' components, of which outliers may lie
            anywhere.
        count: how many innovations all trials have; another number cannot be compared.
    """

    label: str
    volumes: Mapping[str, Floats] = field(default_factory=dict)
    count: int = 0
    _bound: dict[str, list[Bound]] = field(default_factory=dict)

    def innovations(self, trial: Trial) -> dict[str, Stream]:
        """The innovations of a trial by topic; none where the estimator fails."""
        key = repr(sorted(trial.settings.items()))
        try:
            if key not in self._bound:
                self._bound[key] = bind(self.label, [trial.source], trial.settings)
            outputs: dict[str, Ragged] = collect(replay(Ensemble([trial.source]), self._bound[key]))
        except BadInput:  # no run can be followed with these
            return {}
        return dict(innovations_in(outputs))

    def begin(self, trial: Trial) -> dict[str, Stream]:
        """Take a trial for the one that others are compared with; its innovations."""
        found = self.innovations(trial)
        self.count = sum(map(len, found.values()))
        self.volumes = {topic: _extents(stream) for topic, stream in found.items()}
        return found

    def __call__(self, trial: Trial) -> float:
        """The log-likelihood; minus infinity where the estimator fails or loses measurements."""
        found = self.innovations(trial)
        if sum(map(len, found.values())) != self.count:
            return -np.inf
        kept_out = 0
        total = 0.0
        for topic, stream in found.items():
            is_in = stream["accepted"] != 0
            total += float(np.sum(stream["log_likelihood"][is_in]))
            missing = np.isnan(stream["innovation"][~is_in])
            total -= float(np.sum(np.where(missing, 0.0, np.log(self.volumes[topic]))))
            kept_out += len(missing)
        share = kept_out / self.count
        if 0.0 < share < 1.0:
            total += kept_out * np.log(share) + (self.count - kept_out) * np.log(1.0 - share)
        return total if np.isfinite(total) else -np.inf


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


def peak(gain: Callable[[float], float], tried: Sequence[float], limit: float, floor: float) -> Peak:
    """The greatest gain of a number, from the best of those that are tried on.

    Args:
        gain: of a value; zero at zero.
        tried: values beside zero, in order.
        limit: of its magnitude.
        floor: a gain that is less than this is not worth a search.
    """
    below, above = [each for each in tried if each < 0.0], [each for each in tried if each > 0.0]
    near = [max(below), min(above)] if below else []
    known = {0.0: 0.0} | {value: gain(value) for value in near}
    if near and _by_parabola(known) < 0.5 * floor and max(known.values()) < 0.5 * floor:
        return Peak(0.0, 0.0)  # a smooth function that is about greatest here
    known |= {value: gain(value) for value in tried if value not in known}
    values = np.array(sorted(known))
    gains = np.array([known[value] for value in values.tolist()])
    best = int(np.argmax(gains))
    if len(tried) == 1 or (gains[best] < floor and not near):
        return Peak(float(values[best]), float(gains[best]))
    for _ in range(DOUBLINGS):
        if best not in (0, len(values) - 1) or abs(values[best]) >= limit:
            break
        further = float(np.clip(2.0 * values[best], -limit, limit))
        place = 0 if best == 0 else len(values)
        values, gains = np.insert(values, place, further), np.insert(gains, place, gain(further))
        best = int(np.argmax(gains))
    low, high = values[max(best - 1, 0)], values[min(best + 1, len(values) - 1)]
    options = {"maxiter": EVALUATIONS, "xatol": 1e-3 * (high - low)}
    found = minimize_scalar(
        lambda value: -max(gain(float(value)), -1e12),
        bounds=(low, high),
        method="bounded",
        options=options,
    )
    if -found.fun > gains[best]:
        return Peak(float(found.x), -float(found.fun))
    return Peak(float(values[best]), float(gains[best]))


def _by_parabola(known: Mapping[float, float]) -> float:
    """The greatest gain of the parabola through three of its values; infinite if it has none."""
    values, gains = np.array(sorted(known.items())).T
    if not np.isfinite(gains).all():
        return np.inf
    bend, slope, _ = np.polyfit(values / values[-1], gains, 2)
    return float(-(slope**2) / (4.0 * bend)) if bend < 0.0 else np.inf


def interval(gain: Callable[[float], float], at: Peak, scale: float) -> tuple[float, float]:
    """The 95 % interval of a number: where the gain is less than its greatest by DROP_95.

    `scale` is a length that is not too long; an end that is not found is infinite.
    """

    def rest(value: float) -> float:
        return max(gain(value), -1e12) - (at.gain - DROP_95)

    def end(sign: float) -> float:
        inner, step = at.value, sign * scale
        for _ in range(DOUBLINGS):
            outer = at.value + step
            if rest(outer) < 0.0:
                return float(brentq(rest, inner, outer, xtol=1e-3 * abs(outer - at.value)))
            inner, step = outer, 2.0 * step
        return sign * np.inf

    return end(-1.0), end(1.0)
