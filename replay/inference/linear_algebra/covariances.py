"""Representations in which a filter can store covariances, and the operations on them.

A belief is a mean (n,) and a matrix (t, t) that represents its covariance P: P itself (`COVARIANCES`),
or its lower Cholesky factor (`fuselog.replay.inference.linear_algebra.factors.FACTORS`). The steps of a
filter predict and update this matrix; other code, such as an IMM or a smoother, only uses its `Form`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.gaussian import propagate_covariance, solve_semidefinite
from fuselog.replay.inference.linear_algebra.manifold import Turning


class Propagate(Protocol):
    """Function that replaces the matrix P (t, t) by F P F'; `product` is working memory."""

    def __call__(self, matrix: Floats, transition: Floats, product: Floats, /) -> None: ...


class Times(Protocol):
    """Function that fills a product (t,) with P v."""

    def __call__(self, matrix: Floats, vector: Sequence[float] | Floats, product: Floats, /) -> None: ...


class Turn(Protocol):
    """Function that applies `turning`, from `manifold.by_right_jacobian`, to the matrix of P (t, t)."""

    def __call__(self, turning: Turning, vector: Floats, matrix: Floats, /) -> None: ...


class Mix(Protocol):
    """Function that fills the matrix of a mixture's covariance; see `Form`."""

    def __call__(
        self, weights: Floats, away: Floats, shift: Floats, carried: Floats, matrix: Floats, /
    ) -> None: ...


class Predicted(Protocol):
    """Arrays that a prediction fills in the workspace; see `kalman.steps.Workspace`."""

    @property
    def product(self) -> Floats: ...
    @property
    def rest(self) -> Floats: ...


class Retrace(Protocol):
    """Function that reverses a prediction; see `Form`.

    It returns whether P- is positive semidefinite.
    """

    def __call__(
        self, before: Floats, after: Floats, work: Predicted, turned: Floats, factor: Floats, /
    ) -> bool: ...


class Form(NamedTuple):
    """Operations on a matrix (t, t) that represents a covariance P; all work in place.

    Attributes:
        start: (covariances (..., t, t)) -> matrices that represent them.
        to_covariance: (matrix) replaces the matrix by P.
        times: (matrix, vector, product) fills the product (t,) with P v.
        propagate: (matrix, transition, product) replaces P by F P F'; product (t, t) is working memory.
        turn: (turning, vector, matrix) transforms P by `turning`, from `manifold.by_right_jacobian`,
            along a vector.
        mix: (weights, away, shift, carried, matrix) fills the matrix of a mixture of M Gaussians, from
            their weights, their means `away` (M, t), their matrices `carried` (M, t, t) and the mean
            `shift` (t,) of the mixture.
        retrace: (before, after, work, turned, factor) -> whether P- is positive semidefinite. From the
            matrices before and after a prediction and its values in the workspace, it fills `turned`
            with G', and `before` with P - G D'; see `fuselog.replay.inference.smoothing.backward_pass`.
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
