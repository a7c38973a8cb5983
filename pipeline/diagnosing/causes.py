"""The likeliest causes of an inconsistent filter: the hypotheses that gain most, one after the other."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from os import cpu_count
from typing import NamedTuple

import numpy as np

from pipeline.diagnosing.hypotheses import Hypothesis
from pipeline.diagnosing.likelihood import DROP_95, Gains, Likelihood, Peak, Trial, interval, peak
from pipeline.diagnosing.numbers import number
from replay.distributions import chi2

FALSE_ALARMS = 0.01  # of logs without a fault, where something is found all the same
RIVAL = 3.0  # less gained than by the likeliest: odds of 20 to 1, not enough to leave it out


class Cause(NamedTuple):
    """A hypothesis with the number that gains most.

    Attributes:
        hypothesis: what may be wrong.
        value: by how much.
        ends: of the 95 % interval of that.
        gain: in log-likelihood, after all causes before it.
        is_rival: whether it is instead of the cause before it, and explains nearly as much.
    """

    hypothesis: Hypothesis
    value: float
    ends: tuple[float, float]
    gain: float
    is_rival: bool = False

    @property
    def words(self) -> str:
        """What is wrong, by how much, and what that is known by."""
        said = self.hypothesis.words(self.value, *self.ends)
        known = f"without this the log-likelihood gains {number(self.gain, 4)}"
        return f"{'Or instead, nearly as likely: ' if self.is_rival else ''}{said}; {known}"


def least_gain(count: int) -> float:
    """What the best of so many hypotheses gains by chance in FALSE_ALARMS of all logs.

    Twice the gain is chi-square of one degree of freedom (Wilks), shared among them (Bonferroni).
    """
    return float(chi2.isf(FALSE_ALARMS / max(count, 1), 1)) / 2.0


def find_causes(
    likelihood: Likelihood, base: Trial, tried: Sequence[Hypothesis], most: int
) -> list[Cause]:
    """At most so many causes, the likeliest first: each gains most after all before it are undone."""
    least, found = least_gain(len(tried)), list[Cause]()
    candidates, now = list(tried), base
    while candidates and len(found) < most:
        gains_of = _gains(likelihood, now, candidates)
        with ThreadPoolExecutor(cpu_count()) as threads:
            peaks = list(threads.map(partial(_peak, gains_of, least), candidates))
        ranked = sorted(
            (
                (at, each)
                for at, each in zip(peaks, candidates, strict=True)
                if at.gain > least and not _is_at_end(gains_of(each), at, each)
            ),
            key=lambda pair: -pair[0].gain,
        )
        if not ranked:
            break
        (best, first), *others = ranked
        found.append(_cause(gains_of(first), best, first))
        found += [
            _cause(gains_of(each), at, each)._replace(is_rival=True)
            for at, each in others
            if at.gain > best.gain - RIVAL
        ]
        now = first.without(now, best.value)
        candidates = [each for at, each in others if at.gain <= best.gain - RIVAL]
    return found[:most]


def _gains(
    likelihood: Likelihood, now: Trial, candidates: Sequence[Hypothesis]
) -> Callable[[Hypothesis], Gains]:
    """For a hypothesis the gains of its number over a trial; the first of all are replayed at once."""
    asked = [(each, value) for each in candidates for value in each.tried[:2]]
    before, *after = likelihood([now, *(each.without(now, value) for each, value in asked)])
    known = {
        (id(each), value): found - before for (each, value), found in zip(asked, after, strict=True)
    }

    def of(each: Hypothesis) -> Gains:
        def gains(values: Sequence[float]) -> list[float]:
            if all((id(each), value) in known for value in values):
                return [known[id(each), value] for value in values]
            return [
                found - before for found in likelihood([each.without(now, value) for value in values])
            ]

        return gains

    return of


def _peak(gains_of: Callable[[Hypothesis], Gains], least: float, tried: Hypothesis) -> Peak:
    return peak(gains_of(tried), tried.tried, tried.limit, least)


def _is_at_end(gains: Gains, at: Peak, of: Hypothesis) -> bool:
    """Whether the number may as well be the last that is searched: its 95 % go on beyond."""
    if not of.has_end:
        return False
    [last] = gains([float(np.copysign(of.limit, at.value))])
    return last > at.gain - DROP_95


def _cause(gains: Gains, at: Peak, of: Hypothesis) -> Cause:
    if len(of.tried) == 1:  # it is, or is not
        return Cause(of, at.value, (at.value, at.value), at.gain)
    # the gain falls by DROP_95 at about sqrt(DROP_95 / gain) of the way to zero
    scale = abs(at.value) * min(1.0, (2.0 / at.gain) ** 0.5)
    return Cause(of, at.value, interval(gains, at, scale), at.gain)
