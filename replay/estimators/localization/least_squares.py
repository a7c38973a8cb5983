"""Iterated least squares over many runs together, and the Cramer-Rao lower bound of the estimates.

For parameters (runs, n), a model returns the residuals of the measurements, the derivatives of the
predictions, and the covariance of the measurements. From these, the module computes the step of the
search, the Fisher information, the Cramer-Rao lower bound (CRLB), the rank and the unobservable
directions. The search uses the Gauss-Newton method (ILS in Bar-Shalom, Li and Kirubarajan, 2001), with
scaled columns and a line search that halves steps; the weights are computed at the latest estimate.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Booleans, Floats, Integers

Rows = NDArray[np.intp]

# Keeps the scaled normal equations (unit diagonal) solvable if a direction is unobservable.
LEAST_DAMPING = 1e-12
# Relative singular values of the scaled information root below this count as zero; if the rank is
# deficient, the smallest is about 1e-16.
RANK_TOLERANCE = 1e-10
# Smaller components of a unit null vector are rounding errors.
PARTICIPATION = 1e-8
TOLERANCE = 1e-6  # of a step, in standard deviations
SMALLEST_STEP = 2.0**-12
# Costs are in squared standard deviations; smaller differences are rounding errors.
COST_ROUNDING = 1e-12
# Number of runs that are processed together, so that their Jacobians stay in the processor's cache.
BLOCK_RUNS = 256


class Linearization(NamedTuple):
    """Result of a model at given parameters.

    residual: (runs, m) measured minus predicted, angles wrapped. jacobian: (runs, m, n) derivative of
    the prediction. covariance: (runs, m) variances of independent errors; or (runs, blocks, k, k) if
    errors are correlated within blocks of k consecutive measurements, m = blocks k. covariance_jacobian:
    derivative of `covariance`, with another axis n; None if it is constant.
    """

    residual: Floats
    jacobian: Floats
    covariance: Floats
    covariance_jacobian: Floats | None = None


Model = Callable[[Floats, Rows], Linearization]


class Status(IntEnum):
    """How the search of one run ended."""

    CONVERGED = 0
    NO_START = 1
    NOT_FINITE = 2
    STALLED = 3
    ITERATION_LIMIT = 4
    UNOBSERVABLE = 5


SENTENCES = {
    Status.CONVERGED: "converged",
    Status.NO_START: "no starting point: the rays to a target do not intersect",
    Status.NOT_FINITE: "the model is not finite at the starting point; is a target on a sensor?",
    Status.STALLED: "no step lowers the cost: the search diverges",
    Status.ITERATION_LIMIT: "the search did not converge within the iteration limit",
    Status.UNOBSERVABLE: "the measurements do not determine all parameters: rank too low",
}


class Bound(NamedTuple):
    """The CRLB of each run: covariance (runs, n, n) and rank (runs,).

    A parameter that is part of an unobservable direction has infinite variance and no covariances.
    """

    covariance: Floats
    rank: Integers


class Solution(NamedTuple):
    """Estimates (runs, n), their CRLB, and how each run ended; `cost` is half of chi-square."""

    parameters: Floats
    covariance: Floats
    rank: Integers
    iterations: Integers
    cost: Floats
    status: Integers

    @property
    def converged(self) -> Booleans:
        """Return whether each run has an estimate (runs,)."""
        return self.status == Status.CONVERGED


class _Whitened(NamedTuple):
    """A linearisation in units of standard deviations, and the whitener that was applied."""

    residual: Floats
    jacobian: Floats
    whitener: Floats

    def take(self, rows: Rows | Booleans) -> "_Whitened":
        return _Whitened(*(column[rows] for column in self))

    @property
    def cost(self) -> Floats:
        return _half_square(self.residual)

    @property
    def usable(self) -> Booleans:
        return np.isfinite(self.cost) & np.asarray(np.isfinite(self.jacobian).all(axis=(1, 2)))


def solve(model: Model, start: Floats, *, max_iterations: int = 50) -> Solution:
    """Compute the weighted least-squares estimate of every run, starting from `start`.

    A run has converged when its next full step is shorter than `TOLERANCE` standard deviations in the
    metric of its own information; that step is still taken.

    Args:
        model: (parameters (k, n), rows (k,)) -> linearisation of these runs; k may be zero.
        start: (runs, n); not finite for a run without a starting point.
        max_iterations: maximum number of steps.

    Raises BadInput if `start` has a wrong shape.
    """
    if start.ndim != 2 or 0 in start.shape:
        raise BadInput(f"least squares: start has shape {start.shape}; expected (runs, parameters)")

    def solve_block(block: Rows) -> Solution:
        return _solve_block(
            lambda parameters, rows: model(parameters, block[rows]), start[block], max_iterations
        )

    count = -(-len(start) // BLOCK_RUNS)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        blocks = [solve_block(block) for block in np.array_split(np.arange(len(start)), count)]
    return Solution(*(np.concatenate(column) for column in zip(*blocks, strict=True)))


def _solve_block(model: Model, start: Floats, max_iterations: int) -> Solution:
    parameters = start.astype(np.float64)
    iterations = np.zeros(len(start), np.int64)
    status = np.where(np.isfinite(start).all(axis=1), Status.NOT_FINITE, Status.NO_START)

    rows = np.flatnonzero(status == Status.NOT_FINITE)
    here = _whiten(model(parameters[rows], rows))
    rows, here = rows[here.usable], here.take(here.usable)
    for iteration in range(1, max_iterations + 1):
        if not rows.size:
            break
        step, length = _gauss_newton(here)
        iterations[rows] = iteration
        done = length < TOLERANCE
        parameters[rows[done]] += step[done]
        status[rows[done]] = Status.CONVERGED
        rows, here, step = rows[~done], here.take(~done), step[~done]
        parameters[rows], here, moved = _line_search(model, parameters[rows], rows, step, here)
        status[rows] = np.where(moved, Status.ITERATION_LIMIT, Status.STALLED)
        rows, here = rows[moved], here.take(moved)
    return _judge(model, parameters, iterations, status)


def _gauss_newton(here: _Whitened) -> tuple[Floats, Floats]:
    """Compute the full step, and its length in standard deviations."""
    scale = _column_scale(here.jacobian)
    scaled = here.jacobian * scale[:, None, :]
    transposed = np.swapaxes(scaled, 1, 2)
    gradient = transposed @ here.residual[:, :, None]
    normal = transposed @ scaled + LEAST_DAMPING * np.eye(scale.shape[1])
    step = np.linalg.solve(normal, gradient)
    length = np.sqrt(np.maximum(np.swapaxes(step, 1, 2) @ gradient, 0.0))
    return scale * step[:, :, 0], length[:, 0, 0]


def _line_search(
    model: Model, parameters: Floats, rows: Rows, step: Floats, here: _Whitened
) -> tuple[Floats, _Whitened, Booleans]:
    """Halve the steps of runs whose cost would rise if the weights stayed constant."""
    limit = here.cost + COST_ROUNDING * (1.0 + here.cost)

    def attempt(some: Rows, factor: float) -> tuple[Floats, _Whitened, Booleans]:
        trial = parameters[some] + factor * step[some]
        seen = model(trial, rows[some])
        found = _whiten(seen)
        cost = _half_square(_apply(here.whitener[some], seen.residual[:, :, None])[:, :, 0])
        return trial, found, ~((cost <= limit[some]) & found.usable)

    factor = 1.0
    reached, there, rising = attempt(np.arange(len(rows)), factor)
    while rising.any() and factor > SMALLEST_STEP:
        factor /= 2.0
        some = np.flatnonzero(rising)
        reached[some], found, rising[some] = attempt(some, factor)
        for column, new in zip(there, found, strict=True):
            column[some] = new
    reached[rising] = parameters[rising]
    return reached, there, ~rising


def _judge(model: Model, parameters: Floats, iterations: Integers, status: Integers) -> Solution:
    """Compute bound, rank and cost at the final parameters of each run."""
    runs, n = parameters.shape
    covariance, cost = np.full((runs, n, n), np.nan), np.full(runs, np.nan)
    rank = np.zeros(runs, np.int64)
    rows = np.flatnonzero((status != Status.NO_START) & (status != Status.NOT_FINITE))
    at = model(parameters[rows], rows)
    covariance[rows], rank[rows] = cramer_rao_bound(at)
    cost[rows] = _whiten(at).cost
    status[(status == Status.CONVERGED) & (rank < n)] = Status.UNOBSERVABLE
    return Solution(parameters, covariance, rank, iterations, cost, status)


def information_root(at: Linearization) -> Floats:
    """Compute rows (runs, k, n) whose outer products sum to the Fisher information.

    The first rows are the whitened Jacobian. If the covariance depends on the parameters, one row
    follows for each of its entries, because the trace term is half the scalar product of the
    covariance's whitened derivatives (Osborne et al. 2014, eq. (48)).
    """
    whitener = _whitener(at.covariance)
    root = _apply(whitener, at.jacobian)
    if at.covariance_jacobian is None:
        return root
    if whitener.ndim == 2:
        entries = whitener[:, :, None] ** 2 * at.covariance_jacobian
    else:
        left = np.einsum("rbik,rbkln->rbiln", whitener, at.covariance_jacobian)
        blocks = np.einsum("rbjl,rbiln->rbijn", whitener, left)
        entries = blocks.reshape(len(root), whitener[:1].size, root.shape[2])
    return np.concatenate([root, np.sqrt(0.5) * entries], axis=1)


def cramer_rao_bound(at: Linearization) -> Bound:
    """Compute the inverse Fisher information from its root, because squaring the root would lose digits.

    If the triangular factor proves full rank, it is inverted, which is fast; otherwise singular values
    determine the rank. A run whose model is not finite has rank 0.
    """
    root, scale = _scaled_root(at)
    inverse, safe = _inverse_factor(root)
    unsafe = np.flatnonzero(~safe)
    values, right = _singular_values(root[unsafe])
    seen = values > RANK_TOLERANCE * values[:, :1]
    lost = np.asarray(((np.abs(right) > PARTICIPATION) & ~seen[:, None, :]).any(axis=2))
    weights = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
    inverse[unsafe] = np.where(lost[:, :, None], 0.0, right * weights[:, None, :])

    spread = scale[:, :, None] * inverse
    covariance = spread @ np.swapaxes(spread, 1, 2)
    rank = np.full(len(root), root.shape[2])
    rank[unsafe] = seen.sum(axis=1)
    run, parameter = np.nonzero(lost)
    covariance[unsafe[run], parameter, parameter] = np.inf
    return Bound(covariance, rank)


def unobservable_directions(at: Linearization) -> list[Floats]:
    """Find each run's unobservable directions, as unit columns (n, n - rank) in parameter units."""
    root, scale = _scaled_root(at)
    values, right = _singular_values(root)
    directions = scale[:, :, None] * right
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    unseen = values <= RANK_TOLERANCE * values[:, :1]
    return [columns[:, gap] for columns, gap in zip(directions, unseen, strict=True)]


def _scaled_root(at: Linearization) -> tuple[Floats, Floats]:
    """Compute the information root with columns of unit length, and the scale that was applied."""
    root = information_root(at)
    root = np.where(np.isfinite(root).all(axis=(1, 2), keepdims=True), root, 0.0)
    scale = _column_scale(root)
    return root * scale[:, None, :], scale


def _inverse_factor(root: Floats) -> tuple[Floats, Booleans]:
    """Compute roots of the inverse information, and test whether the roots prove that the rank is full.

    With F the inverse of the triangular factor, no singular value is below 1 / |F| or above sqrt(n).
    """
    runs, rows, n = root.shape
    if rows < n:
        return np.zeros((runs, n, n)), np.zeros(runs, np.bool_)
    factor = np.linalg.qr(root, mode="r")
    diagonal = np.abs(np.diagonal(factor, axis1=1, axis2=2))
    singular = np.min(diagonal, axis=1) <= RANK_TOLERANCE
    inverse = np.linalg.inv(np.where(singular[:, None, None], np.eye(n), factor))
    norm = np.linalg.norm(inverse, axis=(1, 2))
    return inverse, ~singular & (norm * np.sqrt(n) < 1.0 / RANK_TOLERANCE)


def _singular_values(root: Floats) -> tuple[Floats, Floats]:
    """Compute all n singular values, largest first, and their right vectors as columns."""
    runs, rows, n = root.shape
    _, singular, right = np.linalg.svd(root, full_matrices=rows < n)
    values = np.zeros((runs, n))
    values[:, : singular.shape[1]] = singular
    return values, np.swapaxes(right, 1, 2)


def describe_direction(names: Sequence[str], direction: Floats) -> str:
    """Describe a direction by the share of each parameter relative to the largest share.

    Args:
        names: names of the n parameters.
        direction: (n,); shares up to `PARTICIPATION` are left out.
    """
    share = direction / direction[np.argmax(np.abs(direction))]
    parts = [(name, part) for name, part in zip(names, share, strict=True) if abs(part) > PARTICIPATION]
    return ", ".join(f"{name} {part:+.3g}" for name, part in parts)


def mask_missing(at: Linearization, present: Booleans) -> Linearization:
    """Remove the information of measurements that are not `present`.

    Args:
        at: linearisation of the runs.
        present: (runs, m) whether each measurement is present.
    """
    if present.all():
        return at
    kept, slope = present, at.covariance_jacobian
    unit: Floats = np.ones(present.shape[1])
    if at.covariance.ndim == 4:
        block = present.reshape(at.covariance.shape[:3])
        kept, unit = block[..., :, None] & block[..., None, :], np.eye(at.covariance.shape[2])
    return Linearization(
        np.where(present, at.residual, 0.0),
        np.where(present[:, :, None], at.jacobian, 0.0),
        np.where(kept, at.covariance, unit),
        None if slope is None else np.where(kept[..., None], slope, 0.0),
    )


def _whiten(at: Linearization) -> _Whitened:
    whitener = _whitener(at.covariance)
    residual = _apply(whitener, at.residual[:, :, None])[:, :, 0]
    return _Whitened(residual, _apply(whitener, at.jacobian), whitener)


def _whitener(covariance: Floats) -> Floats:
    """Compute an inverse square root of the covariance (same shape), or NaN if it is not positive."""
    if covariance.ndim == 2:
        positive = covariance > 0.0
        return np.where(positive, 1.0 / np.sqrt(np.where(positive, covariance, 1.0)), np.nan)
    try:
        return np.linalg.inv(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        if len(covariance) == 1:
            return np.full_like(covariance, np.nan)
        return np.concatenate([_whitener(one[None]) for one in covariance])


def _apply(whitener: Floats, columns: Floats) -> Floats:
    """Multiply columns (runs, m, any) by the whitener."""
    if whitener.ndim == 2:
        return whitener[:, :, None] * columns
    blocks = columns.reshape(*whitener.shape[:3], columns.shape[2])
    return (whitener @ blocks).reshape(columns.shape)


def _half_square(residual: Floats) -> Floats:
    return 0.5 * (residual[:, None, :] @ residual[:, :, None])[:, 0, 0]


def _column_scale(matrix: Floats) -> Floats:
    """Compute factors (runs, n) that scale columns (runs, m, n) to unit length; 1 for zero columns."""
    norm = np.sqrt((matrix * matrix).sum(axis=1))
    return 1.0 / np.where(norm > 0.0, norm, 1.0)
