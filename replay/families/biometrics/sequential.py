"""Tests log-likelihood ratios in sequence: Wald's of two hypotheses, Page's of a change.

Wald, "Sequential Tests of Statistical Hypotheses", Annals of Mathematical Statistics 16(2), 1945; Page,
"Continuous Inspection Schemes", Biometrika 41, 1954. What they promise holds for ratios that are
calibrated and independent.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


class Rates(NamedTuple):
    """States a test's rates of error: of accepting an impostor, and of rejecting the person."""

    false_accept: float
    false_reject: float


class Decisions(NamedTuple):
    """Holds what became of sequences (n,): whether they were accepted, and after how many probes.

    Those that came to no decision have 0 probes and are not accepted.
    """

    accepted: Booleans
    probes: Integers

    @property
    def rejected(self) -> Booleans:
        """Return which sequences (n,) were rejected."""
        return ~self.accepted & (self.probes > 0)


def thresholds(rates: Rates) -> tuple[float, float]:
    """Return the sums of log-likelihood ratios below which one rejects, and above which one accepts.

    Raises BadInput where a rate is not above zero, or their sum not below one.
    """
    accept, reject = rates
    if not (accept > 0.0 and reject > 0.0 and accept + reject < 1.0):
        raise BadInput(
            f"rates of error {accept:g} and {reject:g}: both must be above 0, and their sum below 1"
        )
    return float(np.log(reject / (1.0 - accept))), float(np.log((1.0 - reject) / accept))


def wald_bounds(rates: Rates) -> Rates:
    """Compute what error rates cannot exceed by the thresholds: Wald's inequalities (3.18), (3.19)."""
    accept, reject = rates
    return Rates(accept / (1.0 - reject), reject / (1.0 - accept))


def wald_probes(rates: Rates, mean_ratio: float, *, genuine: bool) -> float:
    """Compute the mean number of probes by Wald (4.8), as if the sum ended on a threshold exactly.

    `mean_ratio` is the mean log-likelihood ratio of a probe, of the person (`genuine`) or of impostors.
    """
    low, high = thresholds(rates)
    accepted = 1.0 - rates.false_reject if genuine else rates.false_accept
    return (accepted * high + (1.0 - accepted) * low) / mean_ratio


def decide(ratio_of: Callable[[Integers], Floats], count: int, rates: Rates, most: int) -> Decisions:
    """Test `count` sequences of at most so many probes by Wald's test.

    `ratio_of(sequences)` gives the next probe's log-likelihood ratio of each of these sequences.

    Args:
        ratio_of: sequences (k,) -> the next probe's log-likelihood ratio (k,) of each.
        count: how many sequences there are.
        rates: the stated rates of error.
        most: a sequence ends undecided after so many probes.

    Returns:
        (count,), which were accepted, and after how many probes each was decided; 0 for never.
    """
    low, high = thresholds(rates)
    total, probes = np.zeros(count), np.zeros(count, np.int64)
    going = np.arange(count)
    for probe in range(1, most + 1):
        total[going] += ratio_of(going)
        ends = (total[going] <= low) | (total[going] >= high)
        probes[going[ends]] = probe
        going = going[~ends]
        if not len(going):
            break
    return Decisions((probes > 0) & (total >= high), probes)


def page_sums(ratios: Floats) -> Floats:
    """Compute Page's cumulative sums (..., n) of ratios (..., n) of a change: anew where below zero."""
    total = np.cumsum(ratios, axis=-1)
    return total - np.minimum(np.minimum.accumulate(total, axis=-1), 0.0)


def first_alarm(sums: Floats, run_length: float, together: int = 1) -> Integers:
    """Count probes (...,) until one of the sums (..., n) is over its threshold; 0 for never.

    The threshold is log(together * run_length), where each probe adds to so many sums: by the
    martingale of Shiryaev and Roberts the mean number of probes until a false alarm is then no less than
    `run_length` (Pollak, Annals of Statistics 13(1), 1985).

    Args:
        sums: (..., n), as of `page_sums`.
        run_length: stated mean number of probes until a false alarm.
        together: to how many sums each probe adds.

    Returns:
        (...,), from 1 on.
    """
    over = sums >= np.log(together * run_length)
    return np.where(over.any(axis=-1), np.argmax(over, axis=-1) + 1, 0)
