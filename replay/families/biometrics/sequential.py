"""Sequential tests of log-likelihood ratios: Wald's test of two hypotheses, Page's test for a change.

Wald, "Sequential Tests of Statistical Hypotheses", Annals of Mathematical Statistics 16(2), 1945; Page,
"Continuous Inspection Schemes", Biometrika 41, 1954. The guarantees of the tests hold if the ratios are
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
    """Error rates of a test: accepting an impostor, and rejecting the genuine person."""

    false_accept: float
    false_reject: float


class Decisions(NamedTuple):
    """Decisions on sequences (n,): whether each was accepted, and after how many probes.

    A sequence without a decision has 0 probes and is not accepted.
    """

    accepted: Booleans
    probes: Integers

    @property
    def rejected(self) -> Booleans:
        """Return which sequences (n,) were rejected."""
        return ~self.accepted & (self.probes > 0)


def thresholds(rates: Rates) -> tuple[float, float]:
    """Compute the sums of log-likelihood ratios at which a test rejects and accepts.

    Raises BadInput if a rate is not above zero, or if their sum is not below one.
    """
    accept, reject = rates
    if not (accept > 0.0 and reject > 0.0 and accept + reject < 1.0):
        raise BadInput(
            f"error rates {accept:g} and {reject:g}: both must be above 0, and their sum below 1"
        )
    return float(np.log(reject / (1.0 - accept))), float(np.log((1.0 - reject) / accept))


def wald_bounds(rates: Rates) -> Rates:
    """Compute the bounds on error rates for these thresholds: Wald's inequalities (3.18), (3.19)."""
    accept, reject = rates
    return Rates(accept / (1.0 - reject), reject / (1.0 - accept))


def wald_probes(rates: Rates, mean_ratio: float, *, genuine: bool) -> float:
    """Compute the mean number of probes by Wald (4.8), assuming that sums end exactly on a threshold.

    `mean_ratio` is the mean log-likelihood ratio of a probe, either of the genuine person (`genuine`) or
    of impostors.
    """
    low, high = thresholds(rates)
    accepted = 1.0 - rates.false_reject if genuine else rates.false_accept
    return (accepted * high + (1.0 - accepted) * low) / mean_ratio


def decide(ratio_of: Callable[[Integers], Floats], count: int, rates: Rates, most: int) -> Decisions:
    """Decide on `count` sequences of at most `most` probes with Wald's test.

    Args:
        ratio_of: function of sequences (k,) that returns the log-likelihood ratio (k,) of the next probe
            of each.
        count: number of sequences.
        rates: the specified error rates.
        most: number of probes after which a sequence ends undecided.

    Returns:
        Which sequences (count,) were accepted, and after how many probes each was decided; 0 for
        undecided sequences.
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
    """Compute Page's cumulative sums (..., n) of ratios (..., n), reset to zero when negative."""
    total = np.cumsum(ratios, axis=-1)
    return total - np.minimum(np.minimum.accumulate(total, axis=-1), 0.0)


def first_alarm(sums: Floats, run_length: float, together: int = 1) -> Integers:
    """Count the probes (...,) until a sum (..., n) exceeds its threshold, or return 0 if no sum does.

    The threshold is log(together * run_length), where `together` is the number of sums to which a probe
    adds. By the martingale of Shiryaev and Roberts, the mean number of probes until a false alarm is at
    least `run_length` (Pollak, Annals of Statistics 13(1), 1985).

    Args:
        sums: (..., n), from `page_sums`.
        run_length: specified mean number of probes until a false alarm.
        together: number of sums to which each probe adds.

    Returns:
        Numbers of probes (...,), counted from 1.
    """
    over = sums >= np.log(together * run_length)
    return np.where(over.any(axis=-1), np.argmax(over, axis=-1) + 1, 0)
