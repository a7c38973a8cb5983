"""Watches matchers while they are used: labelled probes, planted faults, and Page's test of a change."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from fuselog.replay.engine.arrays import Booleans, Floats

DRIFT_SIGMA = 1.0


class Labelled(NamedTuple):
    """Holds probes of a matcher: its ratio (n,), and whether the other matchers say it is the person."""

    ratio: Floats
    is_genuine: Booleans


def faulty(fault: str, seen: Labelled, steady: Sequence[Floats], rng: np.random.Generator) -> Floats:
    """Draw the ratios of a matcher with a fault.

    Args:
        fault: one of "misses", "accepts" and "drifts"; any other is none.
        seen: n probes without the fault.
        steady: the ratios of impostors and of persons before, each in rising order.
        rng: draws what takes their place.

    Returns:
        (n,), the log-likelihood ratios of the same probes.
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
    """Compute where values lie in a reference, as quantiles of the standard normal distribution.

    Args:
        values: (n,).
        reference: (m,), in rising order; a tie counts as in its middle.

    Returns:
        (n,).
    """
    rank = 0.5 * (
        np.searchsorted(reference, values, "left") + np.searchsorted(reference, values, "right")
    )
    return ndtri((rank + 0.5) / (len(reference) + 1.0))


def watching(seen: Labelled, steady: Sequence[Floats]) -> Floats:
    """Compute log-likelihood ratios of four changes, zero for probes that say nothing of them.

    Args:
        seen: n probes.
        steady: the ratios of impostors and of persons before, each in rising order.

    Returns:
        (4, n): that the person's ratios become those of impostors, or fall by `DRIFT_SIGMA` of their
        normal scores; that those of impostors become the person's, or rise so.
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
