"""The definition of a hypothesis, which is a possible fault with its correction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.diagnosing.advice import Advice, number
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters, field_of
from fuselog.replay.engine import chi2

Number = Any  # a float, or a tuple of floats for a fault with several values
NOISES = ("measurement noise", "process noise")
COMPONENTS = 3  # largest number of components of a measurement; more are rare
# a peak is a spike if the log-likelihood drops by more than this within a standard error: 20 times
# the expected drop
SPIKE = 10.0
SCALES = (-0.7, 0.7, -2.0, 2.0)  # logarithms
PARTS = 20  # number of parts of a log whose slopes are compared
FALL = 2.0  # approximate drop in log-likelihood from the maximum to where the slope is computed
# an inflation that only 1 of 1,000 logs exceed by chance
BY_CHANCE = float(chi2.isf(0.001, PARTS - 1)) / (PARTS - 1)


@dataclass(frozen=True)
class Hypothesis:
    """One way in which a log or its settings may be wrong.

    Attributes:
        kind: the common name of faults that cannot be distinguished.
        topic: the topic, or the parameter, that is wrong.
        part: the component of the topic, if only one component is wrong.
        tried: values at which the search begins, the first two nearest to zero; empty for a fault
            without a value. For a fault with several values, this is one tuple that contains the step of
            each value.
        limit: the largest magnitude of the value.
        without: function that returns the trial without a fault of this value.
        words: function that describes the fault, from the value and the ends of its 95 % interval.
        remedy: function that returns advice for this value, or None if the advice is already followed.
        specials: values that are tried exactly, such as the factor of a unit.
        size: number of values of the fault.
        floor: the magnitude below which the value is no fault.
        reported: function that converts the value for tables, for example from a logarithm to a factor.
        already: the value that a parameter already corrects, to which the found value is added.
    """

    kind: Kind
    topic: str
    part: str
    tried: tuple[Any, ...]
    limit: float
    without: Callable[[Trial, Any], Trial]
    words: Callable[[Any, Any, Any], str]
    remedy: Callable[[Any], Advice | None]
    specials: Sequence[float] = ()
    size: int = 1
    floor: float = 0.0
    reported: Callable[[float], float] = float
    already: float = 0.0

    @property
    def has_end(self) -> bool:
        """Test whether the search ends at the limit; it does not for an angle, which wraps."""
        return bool(self.tried) and self.size == 1 and self.limit not in (np.pi, np.inf)

    @property
    def name(self) -> str:
        """Return a short name of the fault."""
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
    """Make a hypothesis without a value; see `Hypothesis`."""
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
    """Make a function that applies the opposite of an alteration to a topic of a trial.

    `stretched` is the factor by which the value stretches measurements; see `Trial`.
    """
    return lambda trial, value: trial.altered(topic, alteration, -value, -stretched * value)


def has(parameters: Parameters | None, name: str) -> bool:
    """Test whether the parameters contain this name."""
    return parameters is not None and name in type(parameters).model_fields


def value_of(parameters: Parameters | None, name: str, stream: Stream) -> float:
    """Return a parameter of a topic: the set value, otherwise the channel's value, otherwise zero."""
    if not has(parameters, field_of(name)):
        return 0.0
    value = getattr(parameters, field_of(name))
    stated = stream.metadata.get(name.rpartition(".")[2], 0.0)
    return float(stated if value is None else value)


def times(at: float, low: float, high: float) -> str:
    """Describe the factor by which a standard deviation is wrong; the arguments are logarithms."""
    least, most = (
        "1" if at * end <= 0 else number(np.exp(abs(end))) for end in sorted((low, high), key=abs)
    )
    factor = number(np.exp(abs(at)))
    return f"{factor} times ({least} to {most}) too {size_of(at)}"


def size_of(at: float) -> str:
    """Return "small" or "large" for a standard deviation that is wrong by this logarithm."""
    return "small" if at > 0.0 else "large"


def in_sense(
    at: float, low: float, high: float, words: tuple[str, str] = ("too large", "too small")
) -> tuple[str, float, float, float]:
    """Describe a value as a direction, such as "too small", with its size and the interval of the size.

    >>> in_sense(-0.3, -0.4, -0.2)
    ('too small', 0.3, 0.2, 0.4)
    """
    if at < 0.0:
        return words[1], -at, min(-low, -high), max(-low, -high)
    return words[0], at, low, high


def gains_over(likelihood: Likelihood, now: Trial) -> GainsOf:
    """Make a function that computes the gains of correcting single faults in a trial."""
    known: list[float] = []  # the trial's own log-likelihood

    def gains(asked: Sequence[tuple[Hypothesis, Number]]) -> list[float]:
        found = likelihood([*[now][len(known) :], *(each.without(now, at) for each, at in asked)])
        known.extend(found[: 1 - len(known)])
        return [each - known[0] for each in found[len(found) - len(asked) :]]

    return gains


def is_spike(likelihood: Likelihood, now: Trial, of: Hypothesis, value: float, gain: float) -> bool:
    """Test whether the gain of a noise falls faster next to its peak than measurements can explain.

    Each of n measurements with m components has at most 2 m of the (Fisher) information on the logarithm
    of a standard deviation, so the gain falls by about 1/2 within (2 m n)^-1/2. If the gain falls
    faster, the filter diverges for most values, the likelihood is jagged, and the peak has no meaning.
    """
    if of.kind not in NOISES:
        return False
    apart = (2.0 * COMPONENTS * sum(likelihood.count.values())) ** -0.5
    return min(gains_over(likelihood, now)([(of, value - apart), (of, value + apart)])) < gain - SPIKE


def noise_gain_over(
    likelihood: Likelihood, now: Trial
) -> Callable[[Hypothesis, Number], tuple[float, float]]:
    """Make a function that computes the gain of a fault's correction under control noise.

    The function returns the mean and the standard deviation of the gain over logs; see
    `fuselog.pipeline.tuning.control_noise`. For noises and outliers, both the mean and the standard
    deviation are zero, because their likelihood is meant to contain control noise.
    """
    # half of the NIS, if all of it were caused by this noise
    most = 0.5 * COMPONENTS * sum(likelihood.count.values())

    @cache
    def disturbed() -> tuple[list[Trial], NDArray[np.float64]]:
        trials = [now, *likelihood.disturbed(now)]
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
        mean = float(np.clip(np.mean(gained), -most, most))  # it would be larger if a filter diverged
        variance = min(float(np.var(gained, ddof=1)) * (1.0 + 1.0 / len(gained)), most)
        # with measurement noise, the variance of a likelihood ratio is twice its mean
        return mean, (variance + 2.0 * max(mean, 0.0)) ** 0.5

    return gain


def _lost(likelihood: Likelihood, trials: Sequence[Trial]) -> NDArray[np.float64]:
    """Compute the mean loss of log-likelihood (pairs,) by opposite noises; the first trial has none."""
    without, *having = likelihood(trials)
    with np.errstate(invalid="ignore"):
        return without - np.mean(np.reshape(having, (-1, 2)), axis=1)


def inflation_over(likelihood: Likelihood, now: Trial) -> Callable[[Hypothesis, Number, float], float]:
    """Make a function that computes the inflation of a fault's gain.

    The gain is inflated if parts of the log disagree about the value more than their likelihoods imply.
    The log is divided into PARTS parts. The inflation is PARTS times the variance of the slopes of the
    parts' log-likelihoods at the maximum, divided by the curvature of the whole log-likelihood; for a
    correct model, this ratio is about 1. Kent, Robust properties of likelihood ratio tests, Biometrika
    69, 1982, pages 19 to 27. The inflation is set to 1 for faults without a value, and if chance can
    explain the inflation.
    """

    def inflation(of: Hypothesis, value: Number, gain: float) -> float:
        if not of.tried:
            return 1.0
        step = min(1.0, (FALL / gain) ** 0.5)  # seen from zero, the gain is approximately a parabola
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
