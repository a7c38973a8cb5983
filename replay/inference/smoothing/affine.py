"""Affine filter about a trajectory: the forward pass of a Gauss-Newton iteration.

Motion and sensors are linearised at the latest states x_k of a run. The unknowns are the tangent vectors
d_k from these states, which are in a vector space:

    d_k = E(-r) F d_(k-1) - r + noise of covariance Jr(r) Q Jr(r)',   r = x_k (-) f(x_(k-1))

with the rotation E and the right Jacobian Jr, which are identities except for orientations. No inverse
of Q is needed: if Q is singular, x_k is restricted to states that the noise can reach, and the cost
contains only the directions that have noise. A robust loss is applied by reweighting.

Bell, SIAM J. Optim. 4(3), 1994.
"""

from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.inference.kalman.predict import motion_derivative, motion_noise
from fuselog.replay.inference.kalman.steps import (
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    InnovationRecord,
    Interval,
    Measurement,
    Predict,
    Steps,
    Update,
    Workspace,
    gaussian_filter,
    workspace,
)
from fuselog.replay.inference.kalman.update import message_layout, sensor_derivative, whitening
from fuselog.replay.inference.linear_algebra.gaussian import (
    propagate_covariance,
    scalar_update,
)
from fuselog.replay.inference.linear_algebra.manifold import (
    boxminus,
    boxplus,
    by_right_jacobian,
    is_flat,
)
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.smoothing.backward_pass import (
    Chain,
    ForwardMemory,
    smoothing_steps,
)

LOSSES = ("square", "huber", "cauchy")
NOTHING_LEFT = 1e-12  # fraction of a variance that is zero after conditioning on other components


class Factors(NamedTuple):
    """Covariances of steps, factored by `factor_by_pivots`; the first axis is the step.

    Attributes:
        factor, order, rank: (steps, t, t), (steps, t), (steps,); the rank is -1 if the factor is
        unknown.
    """

    factor: Floats
    order: Integers
    rank: Integers


def no_factors(count: int, t: int) -> Factors:
    """Allocate factors for `count` steps, marked as unknown."""
    return Factors(np.empty((count, t, t)), np.empty((count, t), np.int64), np.full(count, -1))


class Trajectory(NamedTuple):
    """Trajectory at which motion and sensors are linearised, and results of a pass over it.

    Attributes:
        mean: (nodes, n) states.
        noises: noise covariances of the steps to all nodes, from the previous pass. If the costs of the
            two passes are compared, the previous pass was at the states `kept`.
        kept: (nodes, n) states with the smallest cost so far.
        node: (events,) node of each event's stamp.
        scale: (nodes, t) variances of the extended smoother; damping adds pseudo-measurements of the
            current states, with these variances divided by the damping.
        loss: (2,) index in LOSSES, and scale of the loss.
        damping: (1,) damping of this pass.
        cost, held: (1,) costs of the trajectory with its own noise, and with the noise at `kept`.
        noise, found: (t, t) covariance of a step, and its factor.
        offset, column: (1, t), (t,) working memory.
    """

    mean: Floats
    noises: Factors
    kept: Floats
    node: Integers
    scale: Floats
    loss: Floats
    damping: Floats
    cost: Floats
    held: Floats
    noise: Floats
    found: Factors
    offset: Floats
    column: Floats


def affine_steps(bound_model: BoundModel) -> Steps:
    """Make the steps of the affine filter about a `Trajectory`, the only set that `memory` receives."""
    sensors = tuple(affine_sensor(bound_model, number) for number in range(len(bound_model.sensors)))
    steps = gaussian_filter(
        bound_model, affine_motion(bound_model), sensors, partial(workspace, bound_model)
    )
    chained = smoothing_steps(bound_model, steps)
    advance, hold = chained.predict, damped

    def predict(run: int, belief: Chain, interval: Interval, memory: ForwardMemory) -> bool:
        if not advance(run, belief, interval, memory):
            return False
        trajectory = memory.filter.samples[0]
        hold(belief.mean[run], belief.covariance[run], trajectory, trajectory.node[interval.event])
        return True

    return chained._replace(predict=predict)


def damped(mean: Floats, covariance: Floats, trajectory: Trajectory, node: int) -> None:
    """Apply damping in place: add a pseudo-measurement of the current value of each component.

    Args:
        mean, covariance: (t,), (t, t) in the tangent space at the trajectory's state.
        trajectory: trajectory with the damping and the variances of the extended smoother.
        node: index of the state.
    """
    damping, column = trajectory.damping[0], trajectory.column
    if damping == 0.0:
        return
    for component in range(len(mean)):
        column[:] = covariance[:, component]
        variance = column[component] + trajectory.scale[node, component] / damping
        if variance > 0.0:
            scalar_update(mean, covariance, column, variance, -mean[component])


def affine_motion(bound_model: BoundModel) -> Predict:
    """Make the prediction of the tangent vector from one stamp to the next."""
    model, motion = bound_model.model, bound_model.motion
    linearise = motion_derivative(model, motion, by_state=True)
    add_noise, reach = motion_noise(model, motion), reaching(model.kinds)
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    flat, carry = is_flat(model.kinds), carrying(model.kinds)
    turn = by_right_jacobian(model.kinds)

    def predict(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        control, duration_s, parameters, event = interval
        trajectory, step = work.samples[0], work.step
        node, noise, offset = trajectory.node[event], trajectory.noise, trajectory.offset[0]
        state = read_state(trajectory.mean[node - 1])
        linearise(state, read_control(control), duration_s, parameters, work)
        noise[:] = 0.0
        add_noise(state, noise, duration_s, parameters, work)
        if not reach(trajectory, node, work.state):
            return False
        if not flat:
            turn(offset, noise)
            turn(offset, noise.T)
            carry(offset, work.transition, step)
        for row in range(len(step)):
            step[row] = -offset[row]
            for k in range(len(step)):
                step[row] += work.transition[row, k] * mean[k]
        propagate_covariance(covariance, work.transition, work.product)
        for row in range(len(step)):
            mean[row] = step[row]
            for column in range(len(step)):
                covariance[row, column] += noise[row, column]
        return True

    return predict


class Carry(Protocol):
    """Function that multiplies rows (t, m) by E(-offset); `offset` and `step` are (t,)."""

    def __call__(self, offset: Floats, rows: Floats, step: Floats, /) -> None: ...


class Reach(Protocol):
    """Function that computes a node's offset from its origin (n,), and returns whether it is defined."""

    def __call__(self, trajectory: "Trajectory", node: int, origin: Floats, /) -> bool: ...


def carrying(kinds: tuple[str, ...]) -> Carry:
    """Make `carry(offset, rows, step)`, which multiplies rows (t, m) by E(-offset).

    It transforms tangent vectors at one state to tangent vectors at a state that differs by `offset`.
    `step` is working memory.
    """
    turn, turn_back = by_right_jacobian(kinds), by_right_jacobian(kinds, back=True)

    def carry(offset: Floats, rows: Floats, step: Floats) -> None:
        for row in range(len(step)):
            step[row] = -offset[row]
        turn_back(step, rows)
        turn(offset, rows)

    return carry


def reaching(kinds: tuple[str, ...]) -> Reach:
    """Make `reach(trajectory, node, origin)`, which computes a state's offset from its origin.

    It fills `offset`, and adds the square of the offset, in units of the noise, to the costs. In
    directions without noise, the state is changed to one that the noise can reach. It returns False if
    the offset or its cost is undefined.
    """
    add, subtract = boxplus(kinds), boxminus(kinds)

    def reach(trajectory: Trajectory, node: int, origin: Floats) -> bool:
        offset, whitened = trajectory.offset[0], trajectory.column
        noises, (factors, orders, ranks) = trajectory.noises, trajectory.found
        factor, order = factors[0], orders[0]
        rank = ranks[0] = factor_by_pivots(trajectory.noise, factor, order, whitened)
        if rank < 0:
            return False
        subtract(trajectory.mean[node], origin, trajectory.offset, 0)
        squared = held = whitened_square(offset, trajectory.found, 0, whitened)
        if rank < len(offset):
            for k in range(rank, len(offset)):
                offset[order[k]] = 0.0
                for j in range(rank):
                    offset[order[k]] += factor[order[k], j] * whitened[j]
            trajectory.mean[node] = origin
            add(trajectory.mean[node], offset)
        if noises.rank[node] >= 0:
            held = whitened_square(offset, noises, node, whitened)
        noises.order[node] = order
        noises.factor[node, :, :rank] = factor[:, :rank]
        noises.rank[node] = rank
        trajectory.cost[0] += 0.5 * squared
        trajectory.held[0] += 0.5 * held
        return not np.isnan(squared + held)

    return reach


def whitened_square(offset: Floats, factors: Factors, step: int, whitened: Floats) -> float:
    """Compute the square of an offset in units of the noise, in the directions that have noise.

    Args:
        offset: (t,).
        factors: factors of the covariances of all steps.
        step: index of the step.
        whitened: (t,); its first `rank` entries are filled.
    """
    factor, order, squared = factors.factor[step], factors.order[step], 0.0
    for k in range(factors.rank[step]):
        entry = offset[order[k]]
        for j in range(k):
            entry -= factor[order[k], j] * whitened[j]
        whitened[k] = entry / factor[order[k], k]
        squared += whitened[k] ** 2
    return squared


def factor_by_pivots(matrix: Floats, factor: Floats, order: Integers, left: Floats) -> int:
    """Compute the pivoted Cholesky factor of a positive semidefinite matrix.

    The next row is the one with the largest remaining fraction of its diagonal entry; fractions below
    NOTHING_LEFT are rounding errors.

    Args:
        matrix: (t, t).
        factor: (t, t); its first `rank` columns are filled.
        order: (t,), filled: in row order[k] of the factor, the last nonzero entry is in column k.
        left: (t,) working memory.

    Returns:
        The rank, or -1 if the matrix is not positive semidefinite.
    """
    size = len(matrix)
    for row in range(size):
        order[row], left[row] = row, matrix[row, row]
    for rank in range(size):
        best, most = -1, NOTHING_LEFT
        for k in range(rank, size):
            row = order[k]
            share = left[row] / matrix[row, row] if matrix[row, row] > 0.0 else left[row]
            if not share >= -NOTHING_LEFT:
                return -1
            if share > most:
                best, most = k, share
        if best < 0:
            return rank
        order[rank], order[best] = order[best], order[rank]
        chosen = order[rank]
        pivot = factor[chosen, rank] = np.sqrt(left[chosen])
        for k in range(rank + 1, size):
            row = order[k]
            entry = matrix[row, chosen]
            for j in range(rank):
                entry -= factor[row, j] * factor[chosen, j]
            factor[row, rank] = entry / pivot
            left[row] -= factor[row, rank] ** 2
    return size


def affine_sensor(bound_model: BoundModel, number: int) -> Update:
    """Make the update of the tangent vector by sensor `number`, one component after the other."""
    model, sensor = bound_model.model, bound_model.sensors[number]
    read_state, read_reference = tuple_of(model.size), message_layout(sensor).reference
    linearise, whiten_residual = sensor_derivative(model, sensor), whitening(sensor, number)
    noise_enters = sensor.noises > 0

    def update(
        mean: Floats,
        covariance: Floats,
        measurement: Measurement,
        work: Workspace,
        record: InnovationRecord,
    ) -> int:
        data, parameters, _, event = measurement
        trajectory, innovation = work.samples[0], work.innovations[number]
        node, reference, column = trajectory.node[event], read_reference(data), trajectory.column
        if noise_enters:
            linearise(read_state(trajectory.kept[node]), reference, parameters, work)
            _, squared = whiten_residual(data, parameters, work)
            trajectory.held[0] += robust(squared, trajectory.loss)[0]
        linearise(read_state(trajectory.mean[node]), reference, parameters, work)
        size, squared = whiten_residual(data, parameters, work)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        cost, weight = robust(squared, trajectory.loss)
        trajectory.cost[0] += cost
        if not noise_enters:
            trajectory.held[0] += cost
        for i in range(size):
            variance, difference = 1.0 / weight, innovation.difference[i]
            for row in range(len(mean)):
                entry = 0.0
                for k in range(len(mean)):
                    entry += covariance[row, k] * innovation.cross_covariance[k, i]
                column[row] = entry
                variance += innovation.cross_covariance[row, i] * entry
                difference -= innovation.cross_covariance[row, i] * mean[row]
            if not variance > 0.0:
                return NOT_POSITIVE_DEFINITE
            scalar_update(mean, covariance, column, variance, difference)
        return NOTHING_MEASURED  # nothing is recorded in these passes

    return update


def robust(squared: float, loss: Floats) -> tuple[float, float]:
    """Compute the cost of a squared residual, and the weight of its derivative.

    Args:
        squared: square of the whitened residual.
        loss: (2,) type of loss (0 for squares, 1 for Huber, 2 for Cauchy), and the length above which
            residuals are down-weighted.
    """
    bound = loss[1] ** 2
    if loss[0] == 1.0 and squared > bound:
        length = np.sqrt(squared)
        return loss[1] * (length - 0.5 * loss[1]), loss[1] / length
    if loss[0] == 2.0:
        return 0.5 * bound * np.log1p(squared / bound), 1.0 / (1.0 + squared / bound)
    return 0.5 * squared, 1.0
