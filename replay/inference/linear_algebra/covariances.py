"""Says what a filter can carry for a covariance: the contract of beliefs between methods.

A belief is a mean (n,) and a matrix (t, t) that stands for its covariance P: P itself (`COVARIANCES`),
or its lower Cholesky factor (`fuselog.replay.inference.linear_algebra.factors.FACTORS`). A filter's own
steps predict and update it; all others, such as an IMM or a smoother, know no more of it than its
`Form`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.gaussian import propagate_covariance, solve_semidefinite
from fuselog.replay.inference.linear_algebra.manifold import Turning


class Propagate(Protocol):
    """Makes of P (t, t) what stands for F P F'; the product (t, t) is to work in."""

    def __call__(self, matrix: Floats, transition: Floats, product: Floats, /) -> None: ...


class Times(Protocol):
    """Fills a product (t,) with P v."""

    def __call__(self, matrix: Floats, vector: Sequence[float] | Floats, product: Floats, /) -> None: ...


class Turn(Protocol):
    """Turns a matrix (t, t) by `manifold.by_right_jacobian`, which is `turning`, along a vector (t,)."""

    def __call__(self, turning: Turning, vector: Floats, matrix: Floats, /) -> None: ...


class Mix(Protocol):
    """Fills what stands for a mixture's covariance, see `Form`."""

    def __call__(
        self, weights: Floats, away: Floats, shift: Floats, carried: Floats, matrix: Floats, /
    ) -> None: ...


class Predicted(Protocol):
    """Holds what a prediction left in the workspace, see `kalman.steps.Workspace`."""

    @property
    def product(self) -> Floats: ...
    @property
    def rest(self) -> Floats: ...


class Retrace(Protocol):
    """Goes back over a prediction, see `Form`; returns whether P- is positive semidefinite."""

    def __call__(
        self, before: Floats, after: Floats, work: Predicted, turned: Floats, factor: Floats, /
    ) -> bool: ...


class Form(NamedTuple):
    """Holds what can be done with a matrix (t, t) that stands for a covariance P; all in place.

    Attributes:
        start: (covariances (..., t, t)) -> the matrices that stand for them.
        to_covariance: (matrix) makes P of it.
        times: (matrix, vector, product) fills the product (t,) with P v.
        propagate: (matrix, transition, product): P becomes F P F'; the product (t, t) is to work in.
        turn: (turning, vector, matrix): the same by `manifold.by_right_jacobian`, which is `turning`.
        mix: (weights, away, shift, carried, matrix) fills it with the mixture's of matrices (M, t, t)
            whose means are `away` (M, t), and the mixture's `shift` (t,).
        retrace: (before, after, work, turned, factor) -> whether P- is positive semidefinite. Of the
            matrices before and after a prediction, and what it left in the workspace, it fills `turned`
            with G', and `before` with P - G D', see `fuselog.replay.inference.smoothing.backward_pass`.
    """

    start: Callable[[Floats], Floats]
    to_covariance: Callable[[Floats], object]
    times: Times
    propagate: Propagate
    turn: Turn
    mix: Mix
    retrace: Retrace


def _as_it_is(matrix: Floats) -> Floats:
    return matrix


def _times(covariance: Floats, vector: Sequence[float] | Floats, product: Floats) -> None:
    for row in range(len(covariance)):
        product[row] = 0.0
        for column in range(len(covariance)):
            product[row] += covariance[row, column] * vector[column]


def _turn(turning: Turning, vector: Floats, covariance: Floats) -> None:
    turning(vector, covariance)
    turning(vector, covariance.T)


def _mix(weights: Floats, away: Floats, shift: Floats, carried: Floats, covariance: Floats) -> None:
    for row in range(len(covariance)):
        for column in range(row + 1):
            entry = 0.0
            for mode in range(len(weights)):
                spread = (away[mode, row] - shift[row]) * (away[mode, column] - shift[column])
                entry += weights[mode] * (carried[mode, row, column] + spread)
            covariance[row, column] = covariance[column, row] = entry


def _retrace(before: Floats, after: Floats, work: Predicted, turned: Floats, factor: Floats) -> bool:
    cross, t = work.product, len(before)
    turned[:, :] = cross
    if not solve_semidefinite(after, turned, factor):
        return False
    for row in range(t):
        for column in range(row + 1):
            entry = before[row, column]
            for k in range(t):
                entry -= turned[k, row] * cross[k, column]
            before[row, column] = before[column, row] = entry
    return True


COVARIANCES = Form(_as_it_is, _as_it_is, _times, propagate_covariance, _turn, _mix, _retrace)
