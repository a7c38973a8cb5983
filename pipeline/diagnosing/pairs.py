"""Two gross faults at once: with one undone the other is still so large that a noise explains more."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.diagnosing.hypotheses.hypothesis import Hypothesis, Number, gains_over
from pipeline.diagnosing.likelihood import Likelihood, Trial
from pipeline.diagnosing.search import Peak

NOISES = ("measurement noise", "process noise")
GROSS = float(np.log(20.0))  # a noise stated so many times too small is a sign of something else
LEADING = 10  # of the likeliest faults: each is tried beside all others


class Supposed(NamedTuple):
    """A fault with a number."""

    of: Hypothesis
    value: Number

    def without(self, trial: Trial) -> Trial:
        """The trial without it."""
        return self.of.without(trial, self.value)


def is_gross(at: Peak, of: Hypothesis) -> bool:
    """Whether it is a noise that is stated far too small."""
    return of.kind in NOISES and at.value > GROSS


def companion(
    likelihood: Likelihood, now: Trial, peaks: Sequence[Peak], candidates: Sequence[Hypothesis]
) -> Supposed | None:
    """One of two faults that gain more together than any noise does; None where no two do.

    Beside the numbers that gain most by themselves, all special ones are tried: of two gross faults
    none may gain by itself what it is worth.
    """
    supposed, most = list[Supposed](), 0.0
    for at, of in zip(peaks, candidates, strict=True):
        if of.kind in NOISES:
            most = max(most, at.gain)
        elif of.kind != "outliers":
            values = dict.fromkeys([at.value, *of.specials] if at.gain > 0.0 else of.specials)
            supposed += [Supposed(of, value) for value in values]
    alone = np.array(gains_over(likelihood, now)(supposed))
    best, found = most, None
    for place in np.argsort(-alone, kind="stable")[:LEADING]:
        leading = supposed[place]
        others = [each for each in supposed if each.of is not leading.of]
        gains = gains_over(likelihood, leading.without(now))(others)
        together = alone[place] + max(gains, default=-np.inf)
        if together > best:
            best, found = float(together), leading
    return found
