"""Treatment of very uncertain angles in sampling, which keeps samples within half a turn.

An angle with standard deviation s has samples at a + r s. Samples beyond half a turn wrap around, and
their difference from the mean is no longer r s: for s = 3 rad, the three-dimensional unscented set with
r = 3^1/2 gives 5.196 - 2 pi = -1.09 rad, and a prediction without any measurement would reduce 3 rad to
0.63 rad. Two rules prevent this:

- **A smaller spread.** A function f is regressed at the samples m + c (x - m) of N(m, c^2 P), with the
  largest c <= 1 that keeps all angles within a quarter of a turn, which leaves room for changes by f.
  With y = f(m + c (x - m)) - f(m) the regression (Steinbring and Hanebeck 2014, (19)-(24)) gives

      E[(x - m) y'] / c = P A',     E[(y - E y)(y - E y)'] / c^2 = A P A' + V / c^2,

  where A is the slope of f within the quarter turn, and V the covariance of the residuals of the linear
  fit. Therefore the differences of the values are divided by c. For an affine f this is exact for every
  c: a prediction that only adds to an angle keeps its variance. The effect of nonlinearity is
  overestimated, never underestimated. This is the scaled unscented transformation (Julier, "The scaled
  unscented transformation", ACC 2002) with a scale that the angles determine. Only the mean differs: it
  is the mean of the narrowed samples, which is bounded on a circle, unlike the second-order term of the
  scaled transformation.

- **No wider than uniform.** A completely unknown angle has the standard deviation pi / 3^1/2 = 1.81 rad
  (Mardia and Jupp, Directional Statistics, 2000, section 3.5); no distribution of an angle should be
  wider. A motion limits wider angles, and each axis of a rotation, to this value by scaling the rows of
  the covariance's factor.

A Gaussian is a poor description of an angle beyond 1 rad: at 1 rad, 0.2 % of its probability is beyond
half a turn; at 1.81 rad, 8 % is, and its mean is meaningless. Samples are bit-identical to the ordinary
ones while every angle's standard deviation is at most 1 rad and no sample is beyond half a turn.
"""

from functools import lru_cache
from typing import Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.manifold import manifold_blocks

WIDE_RAD = 1.0  # largest standard deviation at which samples within half a turn are not changed
UNIFORM_RAD = np.pi / np.sqrt(3.0)
QUARTER_RAD = 0.5 * np.pi


def turning(kinds: tuple[str, ...]) -> tuple[tuple[int, int, float], ...]:
    """List the angles, axes and rotations of a state: first tangent component, size, multiplicity.

    An axis is the same after half a turn, so its multiplicity is 2.
    """
    return tuple(
        (tangent, width, 2.0 if kind == "axis" else 1.0)
        for kind, _, tangent, width in manifold_blocks(kinds)
        if kind != "linear"
    )


def unsuspected_rad(points: Floats) -> float:
    """Return the standard deviation up to which angles at points (..., L, N) need no narrowing."""
    radius = np.sqrt(np.max(np.sum(points**2, axis=-1), initial=1.0))
    return float(min(WIDE_RAD, np.pi / radius))


class Narrow(Protocol):
    """Function that scales a factor (N, N) of the samples' covariance and returns the scale c.

    `points` (L, N) are the samples of N(0, I); for the last argument, see `SampleMemory.unsuspected`.
    """

    def __call__(self, factor: Floats, points: Floats, unsuspected: float, /) -> float: ...


class Regressed(Protocol):
    """Samples and their images; see `regression.SampleMemory`."""

    @property
    def factor(self) -> Floats: ...
    @property
    def offsets(self) -> Floats: ...
    @property
    def values(self) -> Floats: ...
    @property
    def shift(self) -> Floats: ...


@lru_cache(maxsize=64)
def narrowing(kinds: tuple[str, ...], size: int, *, bounded: bool) -> Narrow:
    """Make `narrow(factor, points, unsuspected)`, which returns c and scales the factor (N, N) by c.

    See the module docstring. With `bounded`, the standard deviation of each angle is first limited to a
    uniform angle's.

    Args:
        kinds: kinds of the state's components.
        size: size N of the factor.
        bounded: whether the standard deviation of angles is limited to that of a uniform angle, as for
            motions.
    """
    turns = turning(kinds)

    def squared_length(factor: Floats, first: int, width: int) -> float:
        """Sum the variances of `width` tangent components."""
        squared = 0.0
        for row in range(first, first + width):
            for k in range(row + 1):
                squared += factor[row, k] * factor[row, k]
        return squared

    def bound(factor: Floats, row: int, times: float) -> float:
        """Limit the standard deviation of one component, and return it."""
        wide: float = times * np.sqrt(squared_length(factor, row, 1))
        if bounded and wide > UNIFORM_RAD:
            for k in range(row + 1):
                factor[row, k] *= UNIFORM_RAD / wide
            wide = UNIFORM_RAD
        return wide

    def reach_of(factor: Floats, points: Floats, first: int, width: int) -> float:
        """Return the largest distance of a sample from the mean in some components."""
        most = 0.0
        for index in range(len(points)):
            squared = 0.0
            for row in range(first, first + width):
                away = 0.0
                for k in range(row + 1):
                    away += factor[row, k] * points[index, k]
                squared += away * away
            most = max(most, squared)
        reach: float = np.sqrt(most)
        return reach

    def narrow(factor: Floats, points: Floats, unsuspected: float) -> float:
        suspected = False
        for first, width, times in turns:
            if times * times * squared_length(factor, first, width) > unsuspected * unsuspected:
                suspected = True
        if not suspected:
            return 1.0
        widest, reach = 0.0, 0.0
        for first, width, times in turns:
            for row in range(first, first + width):
                widest = max(widest, bound(factor, row, times))
            reach = max(reach, times * reach_of(factor, points, first, width))
        if reach <= QUARTER_RAD or (widest <= WIDE_RAD and reach <= np.pi):
            return 1.0
        share = QUARTER_RAD / reach
        for row in range(size):
            for k in range(row + 1):
                factor[row, k] *= share
        return share

    return narrow


def widen(share: float, memory: Regressed) -> None:
    """Divide the factor, the offsets and the values of narrowed samples by c."""
    for row in range(len(memory.factor)):
        for k in range(row + 1):
            memory.factor[row, k] /= share
    for index in range(len(memory.offsets)):
        for row in range(memory.offsets.shape[1]):
            memory.offsets[index, row] /= share
        for i in range(len(memory.shift)):
            memory.values[index, i] /= share
    for i in range(len(memory.shift)):
        memory.shift[i] /= share
