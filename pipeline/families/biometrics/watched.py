"""Monitoring of matchers in use, with labelled probes, simulated faults and Page's test."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from fuselog.replay.engine.arrays import Booleans, Floats

DRIFT_SIGMA = 1.0


class Labelled(NamedTuple):
    """Probes of a matcher: its ratios (n,), and whether the other matchers label them as genuine."""

    ratio: Floats
    is_genuine: Booleans


def faulty(fault: str, seen: Labelled, steady: Sequence[Floats], rng: np.random.Generator) -> Floats:
    """Simulate the ratios of a matcher with a fault.

    Args:
        fault: "misses", "accepts" or "drifts"; any other name means no fault.
        seen: n probes without the fault.
        steady: ratios of impostors and of genuine probes without a fault, each in ascending order.
        rng: random number generator that draws replacements.

    Returns:
        The log-likelihood ratios of the same probes, (n,).
    """
    others, own = steady
    match fault:
        case "misses":
            return np.where(seen.is_genuine, rng.choice(others, len(seen.ratio)), seen.ratio)
        case "accepts":
            return np.where(seen.is_genuine, seen.ratio, rng.choice(own, len(seen.ratio)))
        case "drifts":
            fallen = ndtr(normal_scores(seen.ratio, own) - DRIFT_SIGMA) * len(own)
            return np.where(seen.is_genuine, own[fallen.astype(int)], seen.ratio)
    return seen.ratio


def normal_scores(values: Floats, reference: Floats) -> Floats:
    """Convert values to standard normal scores through their ranks in a reference sample.

    Args:
        values: (n,).
        reference: (m,), in ascending order; ties count as half.

    Returns:
        The normal scores (n,).
    """
    rank = 0.5 * (
        np.searchsorted(reference, values, "left") + np.searchsorted(reference, values, "right")
    )
    return ndtri((rank + 0.5) / (len(reference) + 1.0))


def watching(seen: Labelled, steady: Sequence[Floats]) -> Floats:
    """Compute log-likelihood ratios of four changes, zero for probes without information on a change.

    Args:
        seen: n probes.
        steady: ratios of impostors and of genuine probes without a fault, each in ascending order.

    Returns:
        Ratios (4, n), one row per change: genuine probes score like impostors; genuine normal scores
        fall by `DRIFT_SIGMA`; impostors score like genuine probes; impostors' normal scores rise by
        `DRIFT_SIGMA`.
    """
    others, own = (
        DRIFT_SIGMA * sign * normal_scores(seen.ratio, reference) - 0.5 * DRIFT_SIGMA**2
        for sign, reference in zip((1.0, -1.0), steady, strict=True)
    )
    is_genuine = seen.is_genuine
    return np.stack(
        [
            np.where(is_genuine, -seen.ratio, 0.0),
            np.where(is_genuine, own, 0.0),
            np.where(is_genuine, 0.0, seen.ratio),
            np.where(is_genuine, 0.0, others),
        ]
    )
