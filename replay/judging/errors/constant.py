"""Detection of constant errors, due to different origins or body points of truth and estimate.

From position errors e_k, covariances P_k and headings h_k, two constants are estimated: d, which
minimises e_k - d, and a lever arm l, which minimises e_k - R(h_k) l. Only mergeable sums are stored.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import compiled
from fuselog.replay.judging.errors.evaluation import Errors, Floats, errors_at

SHARE = 0.5  # fraction of the mean squared error above which a constant dominates it
HALVED = 0.5  # largest NEES without the constant, as a fraction of the NEES with it
EXPLAINED, TENTH = (
    5.0,
    0.1,
)  # largest remaining NEES: per component, or as a fraction
DRIFTS = 0.5  # fraction of the rest that a linear trend explains; above it, the error grows


class Constant(NamedTuple):
    """Constant error.

    Attributes:
        turns: whether the error rotates with the body: forward, left and up instead of x, y and z.
        offset_m: (2,) or (3,) the error.
        share: fraction of the mean squared error that the constant explains.
        nees, rest: NEES of the positions with and without the constant.
    """

    turns: bool
    offset_m: Floats
    share: float
    nees: float
    rest: float


@dataclass
class FrameSums:
    """Sums of errors e (axes, n) with weights W = P^-1 (axes, axes, n) and times t (n,) in one frame.

    Attributes:
        count: n.
        error, weighted: (axes,) sums of e and W e.
        weight: (axes, axes) sum of W.
        squared, nees: sums of e' e and e' W e.
        time, time_squared: sums of t and t^2.
        timed: (axes,) sum of t e.
    """

    count: int = 0
    error: Any = 0.0
    weighted: Any = 0.0
    weight: Any = 0.0
    squared: float = 0.0
    nees: float = 0.0
    time: float = 0.0
    time_squared: float = 0.0
    timed: Any = 0.0

    def add(self, error: Floats, weight: Floats, time_s: Floats) -> None:
        """Add errors, weights and times."""
        weighted = np.einsum("ijn,jn->in", weight, error)
        self.count += error.shape[1]
        self.error = self.error + error.sum(axis=1)
        self.weighted = self.weighted + weighted.sum(axis=1)
        self.weight = self.weight + weight.sum(axis=2)
        self.squared += float(np.vdot(error, error))
        self.nees += float(np.vdot(error, weighted))
        self.time += float(time_s.sum())
        self.time_squared += float(time_s @ time_s)
        self.timed = self.timed + error @ time_s

    def merge(self, other: "FrameSums") -> None:
        """Add the sums of other runs."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def constant(self, *, turns: bool) -> Constant | None:
        """Return the mean error if it dominates, is constant and explains the NEES; otherwise None."""
        if not self.count or not self.squared:
            return None
        mean = self.error / self.count
        nees = self.nees / self.count
        rest = nees + (mean @ self.weight @ mean - 2.0 * mean @ self.weighted) / self.count
        left = self.squared - self.count * mean @ mean
        spread = self.time_squared - self.time**2 / self.count
        slope = self.timed - self.time * mean
        drifts = spread > 0.0 and slope @ slope > DRIFTS * spread * left
        share = self.count * float(mean @ mean) / self.squared
        explains = rest < HALVED * nees and rest < max(EXPLAINED * len(mean), TENTH * nees)
        if share <= SHARE or drifts or not explains:
            return None
        return Constant(turns, mean, share, nees, max(float(rest), 0.0))


@dataclass
class ConstantSums:
    """Sums of the position errors of a stream of estimates, in the fixed frame and the body's frame."""

    fixed: FrameSums = field(default_factory=FrameSums)
    turned: FrameSums = field(default_factory=FrameSums)

    def add(self, errors: Errors) -> None:
        """Add a block. Bounds have no errors; estimates without a position have no origin."""
        place = errors.position
        if errors.is_bound or len(place) < 2:
            return
        known = np.isfinite(errors.nees)
        if not known.all():
            errors = errors_at(errors, known)
        error = np.array([errors.error[:, axis] for axis in place])
        covariance = np.array([[errors.covariance[:, i, j] for j in place] for i in place])
        weight = _inverse(covariance)
        self.fixed.add(error, weight, errors.elapsed_s)
        if errors.heading_rad is not None:
            weight = weight.swapaxes(0, 1).copy()  # symmetric, except for rounding
            _turn(np.cos(errors.heading_rad), np.sin(errors.heading_rad), error, weight)
            self.turned.add(error, weight, errors.elapsed_s)

    def merge(self, other: "ConstantSums") -> None:
        """Add the sums of other runs."""
        self.fixed.merge(other.fixed)
        self.turned.merge(other.turned)

    def found(self) -> Constant | None:
        """Find a constant error, if any, in the frame in which it explains more of the error.

        If the body never rotates, the frames cannot be distinguished, and the error is treated as a
        different origin.
        """
        fixed, turned = self.fixed.constant(turns=False), self.turned.constant(turns=True)
        if fixed is None or turned is None:
            return fixed or turned
        return turned if turned.share > fixed.share else fixed


def _inverse(covariance: Floats) -> Floats:
    """Invert covariances (axes, axes, n); an infinite variance has weight zero."""
    if len(covariance) > 2:
        finite = np.where(np.isfinite(covariance), covariance, 1e300)
        return np.moveaxis(np.linalg.inv(np.moveaxis(finite, 2, 0)), 0, 2)
    (a, b), (_, c) = covariance
    if not np.isfinite(a + c).all():
        a, c = (np.where(np.isfinite(each), each, 1e150) for each in (a, c))
        b = np.where(np.isfinite(b), b, 0.0)
    weight, determinant = np.empty(covariance.shape), a * c - b * b
    weight[0, 0], weight[1, 1] = c / determinant, a / determinant
    weight[0, 1] = weight[1, 0] = -b / determinant
    return weight


def turn(cosine: Floats, sine: Floats, error: Floats, weight: Floats) -> None:
    """Rotate errors (axes, n) and weights (axes, axes, n) into the frames of bodies, in place.

    Args:
        cosine, sine: (n,) of the headings.
        error: (axes, n).
        weight: (axes, axes, n).
    """
    axes = len(error)
    for row in range(len(cosine)):
        c, s = cosine[row], sine[row]
        x, y = error[0, row], error[1, row]
        error[0, row], error[1, row] = c * x + s * y, c * y - s * x
        for axis in range(axes):
            x, y = weight[axis, 0, row], weight[axis, 1, row]
            weight[axis, 0, row], weight[axis, 1, row] = c * x + s * y, c * y - s * x
        for axis in range(axes):
            x, y = weight[0, axis, row], weight[1, axis, row]
            weight[0, axis, row], weight[1, axis, row] = c * x + s * y, c * y - s * x


_turn = compiled(turn)
