"""Claims: statements of papers with our verdicts, and how numbers stand in their sentences."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Verdict = Literal["confirmed", "refuted", "not reproducible"]


@dataclass(frozen=True)
class Claim:
    """A statement of a paper: what it prints, what we measured, our verdict and its reason."""

    claim: str
    paper: str
    ours: str
    verdict: Verdict
    why: str = ""


def judged(claim: str, paper: str, ours: str, holds: bool | np.bool_, why: str = "") -> Claim:
    """A claim that a measured condition confirms or refutes.

    >>> judged("the filter is consistent", "NEES 3", "NEES 3.1", holds=True).verdict
    'confirmed'
    """
    return Claim(claim, paper, ours, "confirmed" if holds else "refuted", why)


def decided(claim: Claim) -> Claim:
    """The claim; nothing is confirmed or refuted where a number of ours is missing: runs failed."""
    if not re.search(r"\bnan\b", claim.ours):
        return claim
    why = "; ".join(filter(None, [claim.why, "estimates are missing"]))
    return replace(claim, verdict="not reproducible", why=why)


def listed(values: ArrayLike, digits: int = 2, between: str = " ") -> str:
    """Numbers for a sentence."""
    return between.join(f"{value:.{digits}f}" for value in np.ravel(values))


def named(values: Mapping[str, float], *names: str) -> str:
    """Some names with their numbers, for a sentence."""
    return ", ".join(f"{name} {values[name]:.3g}" for name in names)
