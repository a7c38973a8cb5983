"""Tells an error that stays: truth and estimate have other origins, or are of other points of a body.

With errors e_k of positions, covariances P_k and headings h_k, a constant d is sought for which e_k - d
is small, and a lever l for which e_k - R(h_k) l is. What is kept are sums, which merge.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from replay.judging.errors.evaluation import Errors, Floats

SHARE = 0.5  # of the mean squared error, from which on a constant makes the most of it
HALVED = 0.5  # NEES without the constant, as a share of NEES with it
EXPLAINED, TENTH = 5.0, 0.1  # and what it is then: so much of each component, or a tenth
DRIFTS = 0.5  # share of the rest that a line in time takes away: the error grows, and is not constant
AXES = 3


class Constant(NamedTuple):
    """An error that stays.

    Attributes:
        turns: whether it turns with the body: ahead, to the left and up, in place of x, y and z.
        offset_m: (2,) or (3,) what it is.
        share: of the mean squared error that it makes.
        nees, rest: NEES of the positions, with it and without.
    """

    turns: bool
    offset_m: Floats
    share: float
    nees: float
    rest: float


@dataclass
class FrameSums:
    """Sums of errors e (n, 3) with weights W = P^-1 and times t in one frame; unused axes are zero.

    Attributes:
        count: n.
        error, weighted: (3,) of e and W e.
        weight: (3, 3) of W.
        squared, nees: of e' e and e' W e.
        time: of t and t^2.
        timed: (3,) of t e.
    """

    count: int = 0
    error: Floats = field(default_factory=lambda: np.zeros(AXES))
    weighted: Floats = field(default_factory=lambda: np.zeros(AXES))
    weight: Floats = field(default_factory=lambda: np.zeros((AXES, AXES)))
    squared: float = 0.0
    nees: float = 0.0
    time: Floats = field(default_factory=lambda: np.zeros(2))
    timed: Floats = field(default_factory=lambda: np.zeros(AXES))

    def add(self, error: Floats, weight: Floats, time_s: Floats) -> None:
        """Take in errors (n, 3), weights (n, 3, 3) and times (n,)."""
        weighted = np.einsum("nij,nj->ni", weight, error)
        self.count += len(error)
        self.error = self.error + error.sum(axis=0)
        self.weighted = self.weighted + weighted.sum(axis=0)
        self.weight = self.weight + weight.sum(axis=0)
        self.squared += float(np.sum(error**2))
        self.nees += float(np.sum(error * weighted))
        self.time = self.time + np.array([time_s.sum(), np.sum(time_s**2)])
        self.timed = self.timed + time_s @ error

    def merge(self, other: "FrameSums") -> None:
        """Take in the sums of other runs."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def constant(self, size: int, *, turns: bool) -> Constant | None:
        """The mean error, where it makes most of the error, is constant, and NEES tells it."""
        if not self.count or not self.squared:
            return None
        mean = self.error / self.count
        nees = self.nees / self.count
        rest = nees + (mean @ self.weight @ mean - 2.0 * mean @ self.weighted) / self.count
        left = self.squared - self.count * mean @ mean
        spread = self.time[1] - self.time[0] ** 2 / self.count
        slope = self.timed - self.time[0] * mean
        drifts = spread > 0.0 and slope @ slope > DRIFTS * spread * left
        share = self.count * float(mean @ mean) / self.squared
        explains = rest < HALVED * nees and rest < max(EXPLAINED * size, TENTH * nees)
        if share <= SHARE or drifts or not explains:
            return None
        return Constant(turns, mean[:size], share, nees, max(float(rest), 0.0))


@dataclass
class ConstantSums:
    """Sums of one estimate stream's errors of position, as they stand and as seen from the body."""

    size: int = 0
    fixed: FrameSums = field(default_factory=FrameSums)
    turned: FrameSums = field(default_factory=FrameSums)

    def add(self, errors: Errors) -> None:
        """Take in a block; a bound has no errors, and what has no position no origin."""
        self.size = len(errors.position)
        if errors.is_bound or self.size < 2:
            return
        known = np.isfinite(errors.nees) & np.isfinite(errors.covariance).all(axis=(1, 2))
        place = errors.position
        error, weight = np.zeros((known.sum(), AXES)), np.zeros((known.sum(), AXES, AXES))
        error[:, : self.size] = errors.error[known][:, place]
        block = errors.covariance[known][:, place][:, :, place]
        weight[:, : self.size, : self.size] = np.linalg.inv(block)
        time_s = errors.elapsed_s[known]
        self.fixed.add(error, weight, time_s)
        if errors.heading_rad is not None:
            turn = np.zeros_like(weight)
            turn[:, 0, 0] = turn[:, 1, 1] = np.cos(errors.heading_rad[known])
            turn[:, 0, 1] = -np.sin(errors.heading_rad[known])
            turn[:, 1, 0] = -turn[:, 0, 1]
            turn[:, 2, 2] = 1.0
            back = turn.transpose(0, 2, 1)
            self.turned.add(np.einsum("nij,nj->ni", back, error), back @ weight @ turn, time_s)

    def merge(self, other: "ConstantSums") -> None:
        """Take in the sums of other runs."""
        self.size = max(self.size, other.size)
        self.fixed.merge(other.fixed)
        self.turned.merge(other.turned)

    def found(self) -> Constant | None:
        """The error that stays, if there is one; of both frames that in which it makes more of it.

        Of a body that never turns it is not known, and counts as that of another origin.
        """
        fixed = self.fixed.constant(self.size, turns=False)
        turned = self.turned.constant(self.size, turns=True)
        if fixed is None or turned is None:
            return fixed or turned
        return turned if turned.share > fixed.share else fixed
