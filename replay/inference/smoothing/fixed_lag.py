"""Smoothing with a fixed lag, with constant work per node for any lag.

The lag is a sliding window of steps. Composition of steps is associative, so a queue of two stacks can
maintain the composition of all its steps with two compositions per node, regardless of the number of
nodes in the lag. On manifolds, steps depend on the means and cannot be composed.
"""

from functools import lru_cache
from typing import NamedTuple

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.compiling.kinds import RunOnce
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.inference.linear_algebra.gaussian import copy_gaussian, propagate_covariance
from fuselog.replay.inference.linear_algebra.manifold import boxminus, boxplus
from fuselog.replay.inference.smoothing.backward_pass import BackMemory, Nodes, Piece, Smoothed, compose


class Window(NamedTuple):
    """Steps within the lag of the first node that is not yet smoothed, as two stacks.

    The row of each node up to `turned` contains the composition of its step and all later steps up to
    `turned`; the steps from `turned` to `through` are composed in this object. The first axis is the
    run; nodes are numbered from the first stored one. A step is (G, b, A): deviations from the filter's
    means are propagated back by d_k = G d_(k+1) + b, covariances by P_k = A + G P_(k+1) G'.
    """

    turned: Integers
    through: Integers
    gain: Floats
    shift: Floats
    rest: Floats


@lru_cache(maxsize=64)
def sliding_over_runs(kinds: tuple[str, ...]) -> OverRuns:
    """Make the loop of `sliding` over all runs, which is compiled when first called."""
    return compile_over_runs(sliding(kinds), title="a smoother with a fixed lag")


def sliding(kinds: tuple[str, ...]) -> RunOnce:
    """Make the loop over the nodes of one run, from first to last, for a fixed lag in a vector space."""
    add, subtract = boxplus(kinds), boxminus(kinds)

    def take_in(
        row: int, is_first: bool, nodes: Nodes, window: Window, run: int, work: BackMemory
    ) -> None:
        """Append a node's step to the window; replace the node's prediction by the step's vector b."""
        shift, change = nodes.predicted[row], work.change[0]
        subtract(nodes.mean[row], shift, work.change, 0)
        for i in range(len(shift)):
            entry = 0.0
            for k in range(len(shift)):
                entry += nodes.gain[row, i, k] * change[k]
            shift[i] = entry
        gain, rest = window.gain[run], window.rest[run]
        if is_first:
            copy_gaussian(shift, nodes.gain[row], window.shift[run], gain)
            copy_gaussian(shift, nodes.rest[row], window.shift[run], rest)
        else:
            extend(gain, window.shift[run], rest, nodes.gain[row], shift, nodes.rest[row], work)

    def go_back(gain: Floats, shift: Floats, rest: Floats, work: BackMemory) -> None:
        """Propagate the deviation and covariance in `work` back by a step."""
        step, deviation = work.step, work.mean
        for row in range(len(step)):
            step[row] = shift[row]
            for k in range(len(step)):
                step[row] += gain[row, k] * deviation[k]
        propagate_covariance(work.covariance, gain, work.product)
        for row in range(len(step)):
            deviation[row] = step[row]
            for column in range(len(step)):
                work.covariance[row, column] += rest[row, column]

    def slide(run: int, piece: Piece, window: Window, smoothed: Smoothed, work: BackMemory) -> None:
        """Smooth the nodes of a piece and move the window."""
        nodes, offsets = piece
        stop, start, lag_ns, estimates = smoothed
        begin, last = offsets[run], offsets[run + 1] - 1
        turned, through = begin + window.turned[run], begin + window.through[run]
        for row in range(begin, stop[run]):
            if through < row:
                turned = through = row
            while through < last and nodes.time_ns[through + 1] - nodes.time_ns[row] <= lag_ns:
                through += 1
                take_in(through, through == turned + 1, nodes, window, run, work)
            if turned <= row:
                for k in range(through - 1, row, -1):
                    gain, shift, rest = nodes.gain[k + 1], nodes.predicted[k + 1], nodes.rest[k + 1]
                    extend(nodes.gain[k], nodes.predicted[k], nodes.rest[k], gain, shift, rest, work)
                turned = through
            work.mean[:] = 0.0
            copy_gaussian(work.mean, nodes.covariance[through], work.mean, work.covariance)
            if through > turned:
                go_back(window.gain[run], window.shift[run], window.rest[run], work)
            if turned > row:
                go_back(nodes.gain[row + 1], nodes.predicted[row + 1], nodes.rest[row + 1], work)
            place = start[run] + row - begin
            estimates.time_ns[place] = nodes.time_ns[row]
            mean = estimates.mean[place]
            copy_gaussian(nodes.mean[row], work.covariance, mean, estimates.covariance[place])
            add(mean, work.mean)
        window.turned[run], window.through[run] = turned - stop[run], through - stop[run]

    return slide


def extend(
    gain: Floats,
    shift: Floats,
    rest: Floats,
    next_gain: Floats,
    next_shift: Floats,
    next_rest: Floats,
    work: BackMemory,
) -> None:
    """Compose a step with the next one; the result replaces the first step.

    Args:
        gain: (t, t) matrix of the first step, changed in place.
        shift: (t,) vector of the first step, changed in place.
        rest: (t, t) matrix of the first step, changed in place.
        next_gain: (t, t) matrix of the next step.
        next_shift: (t,) vector of the next step.
        next_rest: (t, t) matrix of the next step.
        work: working memory.
    """
    for row in range(len(shift)):
        for column in range(len(shift)):
            shift[row] += gain[row, column] * next_shift[column]
            work.rest[row, column] = next_rest[row, column]
    compose(gain, rest, 1, next_gain, work.rest, work.product)
