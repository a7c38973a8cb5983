"""Watches matchers while they are used: labelled probes, planted faults, and Page's test of a change."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from replay.engine.arrays import Booleans, Floats

DRIFT_SIGMA = 1.0


class Labelled(NamedTuple):
    """Holds probes of a matcher: its ratio (n,), and whether the other matchers say it is the person."""

    ratio: Floats
    is_genuine: Booleans


def faulty(fault: str, seen: Labelled, steady: Sequence[Floats], rng: np.random.Generator) -> Floats:
    """Return the ratios (n,) of probes by a matcher with a fault.

    `steady` are the ratios of impostors and of persons before, in rising order.
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
    """Where values (n,) lie in a reference in rising order, as normal numbers; ties in the middle."""
    rank = 0.5 * (
        np.searchsorted(reference, values, "left") + np.searchsorted(reference, values, "right")
    )
    return ndtri((rank + 0.5) / (len(reference) + 1.0))


def watching(seen: Labelled, steady: Sequence[Floats]) -> Floats:
    """Log-likelihood ratios (4, n) of four changes, zero for probes that say nothing of them.

    That the person's ratios become those of impostors, or fall by `DRIFT_SIGMA` of their normal scores;
    that those of impostors become the person's, or rise so.
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
