"""Defines a hypothesis: one thing that may be wrong, and how it is undone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.diagnosing.advice import Advice, number
from fuselog.pipeline.diagnosing.likelihood import Likelihood, Trial
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters, field_of
from fuselog.replay.engine import chi2

Number = Any  # a float; of a fault of several numbers a tuple of floats
NOISES = ("measurement noise", "process noise")
COMPONENTS = 3  # of a measurement, hardly more
SPIKE = 10.0  # of log-likelihood that it falls within a standard error: 20 times what it may
SCALES = (-0.7, 0.7, -2.0, 2.0)  # logarithms
PARTS = 20  # of a log, whose slopes are compared
FALL = 2.0  # of log-likelihood, about, from its greatest to where its slope is taken
BY_CHANCE = float(chi2.isf(0.001, PARTS - 1)) / (PARTS - 1)  # an inflation in 1 of 1,000 logs


@dataclass(frozen=True)
class Hypothesis:
    """Describes one way in which a log or its settings may be wrong.

    Attributes:
        kind: what those that cannot be told apart have in common.
        topic: the topic that it is of, or the parameter.
        part: the component of the topic, if it is of one.
        tried: numbers to begin the search with, the first two of them nearest to zero; none where it is
            so, or is not. Of a fault of several numbers the step of each.
        limit: of the number's magnitude.
        without: the trial without the fault of this number.
        words: what is wrong, from the number and the ends of its 95 % interval.
        mend: what to try against this number; None where it is done already.
        specials: numbers that are tried as they are, such as the factor of a unit.
        size: of how many numbers it is.
        floor: of the magnitude: what is less is no fault.
        reported: the number as tables have it: a factor, where it is searched by its logarithm.
        already: how much of it a parameter undoes already, which the number adds to.
    """

    kind: Kind
    topic: str
    part: str
    tried: tuple[Any, ...]
    limit: float
    without: Callable[[Trial, Any], Trial]
    words: Callable[[Any, Any, Any], str]
    mend: Callable[[Any], Advice | None]
    specials: Sequence[float] = ()
    size: int = 1
    floor: float = 0.0
    reported: Callable[[float], float] = float
    already: float = 0.0

    @property
    def has_end(self) -> bool:
        """Tell whether what lies beyond the limit is not searched; an angle is, where it comes round."""
        return bool(self.tried) and self.size == 1 and self.limit not in (np.pi, np.inf)

    @property
    def name(self) -> str:
        """Return what it is of, in a few words."""
        return " ".join(filter(None, (self.kind, self.topic, self.part)))


GainsOf = Callable[[Sequence[tuple[Hypothesis, Number]]], Sequence[float]]


def supposed(
    kind: Kind,
    topic: str,
    part: str,
    without: Callable[[Trial, Any], Trial],
    words: str,
    advice: Advice | None,
    reported: Callable[[float], float] = float,
) -> Hypothesis:
    """Return the hypothesis of what is so or is not, and has no number: see `Hypothesis`."""
    return Hypothesis(
        kind,
        topic,
        part,
        (),
        1.0,
        without,
        lambda *_: words,
        lambda _: advice,
        (1.0,),
        reported=reported,
    )


def in_topic(
    topic: str, alteration: alter.Alteration, stretched: float = 0.0
) -> Callable[[Trial, Any], Trial]:
    """Return the trial with the opposite of an alteration of a topic.

    `stretched` is by how much the number stretches what is measured, see `Trial`.
    """

    def without(trial: Trial, value: Any) -> Trial:
        source = alter.altered(trial.source, topic, alteration, -value)
        if not stretched:
            return trial._replace(source=source)
        before = trial.stretched.get(topic, 0.0)
        return trial._replace(
            source=source, stretched={**trial.stretched, topic: before - stretched * value}
        )

    return without


def has(parameters: Parameters | None, name: str) -> bool:
    """Tell whether there is a parameter of this name."""
    return parameters is not None and name in type(parameters).model_fields


def value_of(parameters: Parameters | None, name: str, stream: Stream) -> float:
    """Return a parameter that a topic is read with: as given, or stated by the channel, or zero."""
    if not has(parameters, field_of(name)):
        return 0.0
    value = getattr(parameters, field_of(name))
    stated = stream.metadata.get(name.rpartition(".")[2], 0.0)
    return float(stated if value is None else value)


def times(at: float, low: float, high: float) -> str:
    """Say by what factor a standard deviation is wrong, from logarithms."""
    least, most = (
        "1" if at * end <= 0 else number(np.exp(abs(end))) for end in sorted((low, high), key=abs)
    )
    factor = number(np.exp(abs(at)))
    return f"{factor} times ({least} to {most}) too {size_of(at)}"


def size_of(at: float) -> str:
    """Say whether it is too small or too large by so much."""
    return "small" if at > 0.0 else "large"


def in_sense(
    at: float, low: float, high: float, words: tuple[str, str] = ("too large", "too small")
) -> tuple[str, float, float, float]:
    """Return the word for a number's sign, the number's size, and its interval in that sense.

    >>> in_sense(-0.3, -0.4, -0.2)
    ('too small', 0.3, 0.2, 0.4)
    """
    if at < 0.0:
        return words[1], -at, min(-low, -high), max(-low, -high)
    return words[0], at, low, high


def gains_over(likelihood: Likelihood, now: Trial) -> GainsOf:
    """Return what undoing faults of these numbers, each by itself, gains over a trial."""
    known: list[float] = []  # the trial's own log-likelihood

    def gains(asked: Sequence[tuple[Hypothesis, Number]]) -> list[float]:
        found = likelihood([*[now][len(known) :], *(each.without(now, at) for each, at in asked)])
        known.extend(found[: 1 - len(known)])
        return [each - known[0] for each in found[len(found) - len(asked) :]]

    return gains


def is_spike(likelihood: Likelihood, now: Trial, of: Hypothesis, value: float, gain: float) -> bool:
    """Tell whether the gain of a noise falls faster beside its peak than so many measurements allow.

    Each of n measurements of m components tells at most 2 m of the information on the logarithm of a
    standard deviation (Fisher's, of a Gaussian), so that the gain falls by about 1/2 within
    (2 m n)^-1/2. A faster fall is that of a filter that diverges for most values: the likelihood is
    jagged there, and its peak is none.
    """
    if of.kind not in NOISES:
        return False
    apart = (2.0 * COMPONENTS * sum(likelihood.count.values())) ** -0.5
    return min(gains_over(likelihood, now)([(of, value - apart), (of, value + apart)])) < gain - SPIKE


def noise_gain_over(
    likelihood: Likelihood, now: Trial
) -> Callable[[Hypothesis, Number], tuple[float, float]]:
    """Return a function that says what undoing a fault gains by the noise of the controls alone.

    The mean and the standard deviation over logs, see `fuselog.pipeline.tuning.control_noise`. Of noises
    and
    outliers it is zero: their likelihood is meant to have that noise.
    """
    most = 0.5 * COMPONENTS * sum(likelihood.count.values())  # half of NIS, all of it this noise

    @cache
    def disturbed() -> tuple[list[Trial], NDArray[np.float64]]:
        trials = [now, *(now._replace(source=each) for each in likelihood.disturbed(now))]
        return trials, _lost(likelihood, trials)

    def gain(of: Hypothesis, value: Number) -> tuple[float, float]:
        if of.kind in NOISES or of.kind == "outliers":
            return 0.0, 0.0
        trials, before = disturbed()
        if len(trials) < 2:
            return 0.0, 0.0
        gained = before - _lost(likelihood, [of.without(each, value) for each in trials])
        gained = gained[np.isfinite(gained)]  # a filter may fail with more noise
        if len(gained) < 2:
            return 0.0, 0.0
        mean = float(np.clip(np.mean(gained), -most, most))  # more where a filter diverges
        variance = min(float(np.var(gained, ddof=1)) * (1.0 + 1.0 / len(gained)), most)
        # and together with the noise of the measurements: a likelihood ratio varies by twice its mean
        return mean, (variance + 2.0 * max(mean, 0.0)) ** 0.5

    return gain


def _lost(likelihood: Likelihood, trials: Sequence[Trial]) -> NDArray[np.float64]:
    """Compute what each pair of opposite noises costs the first trial in log-likelihood (pairs,)."""
    without, *having = likelihood(trials)
    with np.errstate(invalid="ignore"):
        return without - np.mean(np.reshape(having, (-1, 2)), axis=1)


def inflation_over(likelihood: Likelihood, now: Trial) -> Callable[[Hypothesis, Number, float], float]:
    """Return a function that says how many times smaller than it looks a fault's gain is.

    Where the log's parts disagree about the number more than their likelihoods say, a gain is so many
    times smaller than it looks: the variance of the slopes of PARTS of the log, at the greatest gain, is
    compared with the curvature of all, which is the same where the model is right. Kent, Robust
    properties of likelihood ratio tests, Biometrika 69, 1982, pages 19 to 27. It is 1 where chance may
    explain it, and of what is so or is not, where no number is known.
    """

    def inflation(of: Hypothesis, value: Number, gain: float) -> float:
        if not of.tried:
            return 1.0
        step = min(1.0, (FALL / gain) ** 0.5)  # the gain is about a parabola from zero
        below, at, above = likelihood.over_parts(
            [of.without(now, _times(value, each)) for each in (1.0 - step, 1.0, 1.0 + step)], PARTS
        )
        bend = float(np.sum(2.0 * at - below - above)) / step**2
        if not np.isfinite(bend) or bend <= 0.0:
            return 1.0
        variance = PARTS * float(np.var((above - below) / (2.0 * step), ddof=1))
        found = variance / bend
        return found if found > BY_CHANCE else 1.0

    return inflation


def _times(value: Number, factor: float) -> Number:
    return tuple(factor * each for each in value) if isinstance(value, tuple) else factor * value
