"""Detection of constant errors that arise if truth and estimate have different origins or body points.

From position errors e_k, covariances P_k and headings h_k, two constants are estimated: d, which
minimises the residuals e_k - d, and a lever arm l, which minimises the residuals e_k - R(h_k) l. Only
mergeable sums are stored.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
class ConstantSums:
    """Sums of the position errors e of a stream of estimates, with weights W = P^-1 and times t.

    Attributes:
        axes: number of position components; for positions in the plane, errors and weights in z are
            zero.
        count: number of errors.
        numbers: (4,) sums of e' e, e' W e, t and t^2.
        frames: (2, 15) sums in the fixed frame and in the body's: e, W e and t e, and xx, xy, xz, yy, yz
            and zz of W.
    """

    axes: int = 0
    count: int = 0
    numbers: Floats = field(default_factory=lambda: np.zeros(4))
    frames: Floats = field(default_factory=lambda: np.zeros((2, 15)))

    def add(self, errors: Errors) -> None:
        """Add a block. Bounds and estimates without a position are skipped."""
        place = errors.position
        if errors.is_bound or len(place) < 2:
            return
        known = np.isfinite(errors.nees)
        if not known.all():
            errors = errors_at(errors, known)
        self.axes, self.count = len(place), self.count + len(errors.nees)
        heading_rad = errors.heading_rad
        if heading_rad is None:
            heading_rad = np.zeros(len(errors.nees))
        turn = np.cos(heading_rad), np.sin(heading_rad)
        of_rows = errors.error, errors.covariance, *turn, errors.elapsed_s
        _add_sums(*of_rows, np.array(place), self.numbers, self.frames)

    def merge(self, other: "ConstantSums") -> None:
        """Add the sums of other runs."""
        self.axes = self.axes or other.axes
        self.count += other.count
        self.numbers += other.numbers
        self.frames += other.frames

    def found(self) -> Constant | None:
        """Find a constant error, if any, in the frame in which it explains more of the error.

        If the body never rotates, the frames cannot be distinguished, and the error is attributed to
        different origins.
        """
        fixed, turned = self._constant(turns=False), self._constant(turns=True)
        if fixed is None or turned is None:
            return fixed or turned
        return turned if turned.share > fixed.share else fixed

    def _constant(self, *, turns: bool) -> Constant | None:
        """Return the mean error if it dominates, is constant and explains the NEES; otherwise None."""
        count, (squared, nees, time, time_squared) = self.count, self.numbers.tolist()
        error, weighted, timed, *_ = self.frames[int(turns)].reshape(5, 3)
        weight = self.frames[int(turns), 9:][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        if not count or not squared:
            return None
        mean, nees = error / count, nees / count
        rest = nees + (mean @ weight @ mean - 2.0 * mean @ weighted) / count
        left = squared - count * mean @ mean
        spread = time_squared - time**2 / count
        slope = timed - time * mean
        drifts = spread > 0.0 and slope @ slope > DRIFTS * spread * left
        share = count * float(mean @ mean) / squared
        explains = rest < HALVED * nees and rest < max(EXPLAINED * self.axes, TENTH * nees)
        if share <= SHARE or drifts or not explains:
            return None
        return Constant(turns, mean[: self.axes], share, nees, max(float(rest), 0.0))


def add_sums(
    errors: Floats,
    covariances: Floats,
    cosine: Floats,
    sine: Floats,
    time_s: Floats,
    place: NDArray[np.int64],
    numbers: Floats,
    frames: Floats,
) -> None:
    """Add position errors to the sums in both frames; an infinite variance has weight zero.

    Args:
        errors, covariances: (n, d) and (n, d, d).
        cosine, sine: (n,) of the headings.
        time_s: (n,).
        place: (axes,), components of the position.
        numbers, frames: the sums, see `ConstantSums`.
    """
    i, j, k = place[0], place[1], place[len(place) - 1]
    for row in range(len(errors)):
        x, y, z = errors[row, i], errors[row, j], 0.0
        a, b, c = covariances[row, i, i], covariances[row, i, j], covariances[row, j, j]
        p, q, zz = 0.0, 0.0, 0.0
        if len(place) > 2:
            z, p, q = errors[row, k], covariances[row, i, k], covariances[row, j, k]
            zz = 1.0 / covariances[row, k, k]
        if np.isinf(a) or np.isinf(c):
            b, p, q = 0.0, 0.0 if np.isinf(a) else p, 0.0 if np.isinf(c) else q
            a, c = min(a, 1e150), min(c, 1e150)
        if zz == 0.0:
            p, q = 0.0, 0.0
        a, b, c = a - p * p * zz, b - p * q * zz, c - q * q * zz
        determinant = a * c - b * b
        xx, xy, yy = c / determinant, -b / determinant, a / determinant
        xz, yz = -(xx * p + xy * q) * zz, -(xy * p + yy * q) * zz
        zz -= (xz * p + yz * q) * zz
        time = time_s[row]
        numbers[0] += x * x + y * y + z * z
        numbers[1] += add_error(frames[0], time, x, y, z, xx, xy, xz, yy, yz, zz)
        numbers[2] += time
        numbers[3] += time * time
        c, s = cosine[row], sine[row]
        x, y, xz, yz = c * x + s * y, c * y - s * x, c * xz + s * yz, c * yz - s * xz
        both, apart = 2.0 * c * s * xy, c * s * (yy - xx) + (c * c - s * s) * xy
        xx, yy = c * c * xx + both + s * s * yy, s * s * xx - both + c * c * yy
        add_error(frames[1], time, x, y, z, xx, apart, xz, yy, yz, zz)


def add_error(
    sums: Floats,
    time_s: float,
    x: float,
    y: float,
    z: float,
    xx: float,
    xy: float,
    xz: float,
    yy: float,
    yz: float,
    zz: float,
) -> float:
    """Add an error e and its weight W to the sums in one frame, and return e' W e.

    Args:
        sums: (15,), see `ConstantSums`.
        time_s: the time.
        x, y, z: e.
        xx, xy, xz, yy, yz, zz: W.
    """
    u, v, w = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    sums[0] += x
    sums[1] += y
    sums[2] += z
    sums[3] += u
    sums[4] += v
    sums[5] += w
    sums[6] += time_s * x
    sums[7] += time_s * y
    sums[8] += time_s * z
    sums[9] += xx
    sums[10] += xy
    sums[11] += xz
    sums[12] += yy
    sums[13] += yz
    sums[14] += zz
    return x * u + y * v + z * w


_add_sums = compiled(add_sums, for_sizes=True)
