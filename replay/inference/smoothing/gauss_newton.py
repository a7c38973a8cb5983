"""Minimisation of the cost of all states of a run by damped Gauss-Newton steps.

The cost is minimised over the states at the time of the prior and at every later stamp:

    1/2 |x_0 (-) m_0|^2_P0 + 1/2 sum |x_k (-) f(x_(k-1))|^2_Q + sum rho(|y (-) h(x_k)|_R)

A pass consists of an affine filter about the latest trajectory
(`fuselog.replay.inference.smoothing.affine`) and the backward pass over it
(`fuselog.replay.inference.smoothing.backward_pass`). If a step would raise the cost, it is repeated with
damping (Levenberg and Marquardt): pseudo-measurements keep every state near its current value, with the
variances of the start divided by the damping.

Bell, SIAM J. Optim. 4(3), 1994; Sarkka and Svensson, ICASSP 2020.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.compiling.kinds import RunOnce
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.kalman.steps import Gaussian, Steps
from fuselog.replay.inference.linear_algebra.manifold import boxplus, by_right_jacobian, is_flat
from fuselog.replay.inference.model.bound_model import BoundModel, title_of
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.settings import ReadSettings, reading_settings
from fuselog.replay.inference.run.recursion import (
    InnovationRows,
    RecursionState,
    RunInputs,
    RunResults,
    recursion,
)
from fuselog.replay.inference.smoothing.affine import Trajectory, affine_steps, damped, reaching
from fuselog.replay.inference.smoothing.backward_pass import (
    BackMemory,
    ForwardMemory,
    Later,
    Piece,
    Smoothed,
    backward_pass,
)

SETTLED = 1e-10  # largest component of the last step, in standard deviations
ROUNDING = 1e-15
COST_ROUNDING = 1e-6  # of 1 or of the cost, if it is larger, because noise may depend on the state
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e12


class Plan(NamedTuple):
    """Inputs of a search: the runs' priors and their stamps, and control before the first message.

    Further inputs are the first damping and the maximum number of passes.
    """

    prior: Gaussian
    start_ns: Integers
    initial: Floats
    damping: float
    passes: int


class SearchState(NamedTuple):
    """State of a search, for all runs.

    Attributes:
        carried, piece, innovations: state and results of the forward pass.
        later, smoothed: state and results of the backward pass.
        kept: (nodes, n) best trajectory.
    """

    carried: RecursionState
    piece: Piece
    innovations: InnovationRows
    later: Later
    smoothed: Smoothed
    kept: Floats


class Ended(NamedTuple):
    """Results of the searches: the number of passes, and whether each search converged (runs,).

    For every pass, the cost, the damping and the largest step in standard deviations (runs, passes, 3).
    """

    passes: Integers
    converged: Integers
    output_streams: Floats


@lru_cache(maxsize=64)
def searching(bound_model: BoundModel) -> tuple[OverRuns, Steps]:
    """Make the search, which is compiled when first called, and the steps, whose memory it uses."""
    steps = affine_steps(bound_model)
    settings_of = reading_settings(number_fields(bound_model.model.parameters))
    title = title_of(bound_model.model, "iterated smoother")
    return compile_over_runs(search(bound_model, steps, settings_of), title=title), steps


def search(bound_model: BoundModel, steps: Steps, settings_of: ReadSettings) -> RunOnce:
    """Make the search for the trajectory of one run, for `compile_over_runs`."""
    kinds, n, t = bound_model.model.kinds, bound_model.model.size, bound_model.model.tangent
    follow, go_back = recursion(bound_model, steps, settings_of), backward_pass(("linear",) * t)
    add, reach, turn = boxplus(kinds), reaching(kinds), by_right_jacobian(kinds)
    flat, hold = is_flat(kinds), damped

    def go_forward(
        run: int, inputs: RunInputs, plan: Plan, state: SearchState, memory: ForwardMemory
    ) -> bool:
        """Filter about the trajectory, sum the cost, and return whether all steps succeeded."""
        carried, (nodes, offsets) = state.carried, state.piece
        trajectory, belief, begin = memory.filter.samples[0], carried.belief, offsets[run]
        mean, covariance = belief.mean[run], belief.covariance[run]
        for row in range(t):
            for column in range(t):
                entry = plan.prior.covariance[run, row, column]
                covariance[row, column] = trajectory.noise[row, column] = entry
        trajectory.cost[0] = trajectory.held[0] = 0.0
        if not reach(trajectory, begin, plan.prior.mean[run]):
            return False
        if not flat:
            turn(trajectory.offset[0], covariance)
            turn(trajectory.offset[0], covariance.T)
        for row in range(t):
            mean[row] = belief.predicted[run, row] = -trajectory.offset[0, row]
        belief.predictions[run] = 0
        hold(mean, covariance, trajectory, begin)
        carried.control[run] = plan.initial
        carried.time_ns[run], carried.failure[run] = plan.start_ns[run], ALL_WELL
        nodes.end[run] = begin
        follow(run, inputs, carried, RunResults(nodes, state.innovations), memory)
        whole = carried.failure[run] == ALL_WELL and nodes.end[run] == offsets[run + 1]
        finite: bool = np.isfinite(trajectory.cost[0] + trajectory.held[0])
        return whole and finite

    def move(
        trajectory: Trajectory, kept: Floats, steps: Floats, begin: int, end: int
    ) -> tuple[float, float, bool]:
        """Set the trajectory to the best trajectory, moved by the latest steps.

        Returns the largest step and the sum of squared steps, both in standard deviations of the start,
        and whether the steps are negligible.
        """
        largest, squares, settled = 0.0, 0.0, True
        for node in range(begin, end):
            size = 0.0
            for row in range(n):
                trajectory.mean[node, row] = kept[node, row]
                size = max(size, abs(kept[node, row]))
            add(trajectory.mean[node], steps[node])
            for row in range(t):
                deviation, step = np.sqrt(trajectory.scale[node, row]), abs(steps[node, row])
                settled = settled and step <= SETTLED * deviation + ROUNDING * size
                if deviation > 0.0:
                    largest = max(largest, step / deviation)
                    squares += (step / deviation) ** 2
        return largest, squares, settled

    def search_run(
        run: int,
        inputs: RunInputs,
        plan: Plan,
        state: SearchState,
        ended: Ended,
        scratch: tuple[ForwardMemory, BackMemory],
    ) -> None:
        """Replace `kept` by the best trajectory of a run, and the covariances accordingly."""
        memory, back = scratch
        offsets, later, kept, smoothed = state.piece.offsets, state.later, state.kept, state.smoothed
        trajectory, begin, end = memory.filter.samples[0], offsets[run], offsets[run + 1]
        ended.passes[run] = ended.converged[run] = 0
        best, damping, again, last = np.inf, plan.damping, False, False
        # the damping of the last step, and the predicted gain, for comparison with the actual gain
        taken, promised = 0.0, 0.0
        while begin < end:
            trajectory.damping[0] = damping
            well = go_forward(run, inputs, plan, state, memory)
            held, passes = trajectory.held[0], ended.passes[run]
            slack, poor = COST_ROUNDING * max(1.0, best), False
            if not again:
                better = well and held <= best + slack
                poor = not better or best - held < 0.25 * promised - slack
                if better:
                    best = trajectory.cost[0]
                    copy_rows(trajectory.mean, kept, begin, end)
                elif passes == 0:  # the start is invalid
                    return
            if poor:
                damping, again = max(10.0 * taken, LEAST_DAMPING), True
                taken, last = damping, damping > MOST_DAMPING
            else:
                later.is_there[run] = False
                go_back(run, state.piece, later, smoothed, back)
                if last:
                    return
                largest, squares, settled = move(trajectory, kept, smoothed.estimates.mean, begin, end)
                output_streams = ended.output_streams[run, passes]
                output_streams[0], output_streams[1], output_streams[2] = best, damping, largest
                ended.passes[run] += 1
                if settled and damping == 0.0:
                    ended.converged[run] = 1
                    copy_rows(trajectory.mean, kept, begin, end)
                    return
                taken, promised = damping, damping * squares
                damping = 0.1 * damping if damping > 0.1 * LEAST_DAMPING else 0.0
                again, last = False, passes + 1 == plan.passes
            if again or last:
                copy_rows(kept, trajectory.mean, begin, end)
            if last:  # compute the covariances without damping
                damping, again = 0.0, True

    return search_run


def copy_rows(these: Floats, there: Floats, begin: int, end: int) -> None:
    """Copy some rows of one array to the same rows of another.

    Args:
        these, there: (n, k) source and destination.
        begin, end: the rows.
    """
    there[begin:end] = these[begin:end]
