"""Correction of a filter's estimates by later measurements: the Rauch-Tung-Striebel backward pass.

In the forward pass, the filter stores a node at every stamp with an estimate: its Gaussian, and the
relation to the previous node. The backward pass starts at the last node. For a step from k to k + 1 with
the prediction (m-, P-) and D, the covariance between the states before and after the step,

    G = D P-^-1,  ms_k = m_k (+) G (ms_(k+1) (-) m-),  Ps_k = (P_k - G D') + G Ps_(k+1) G'

where D is computed from the derivative for extended filters, and from the samples for all other filters.
Several predictions between two nodes form one step: their matrices G are multiplied. For states that are
not vectors, `fuselog.replay.inference.model.corrections` defines (+), (-) and the tangent spaces of the
covariances.

Rauch, Tung and Striebel, AIAA Journal 3(8), 1965; Sarkka, IEEE TAC 53(3), 2008.
"""

from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.inference.kalman.steps import (
    CoreMemory,
    InnovationRecord,
    Interval,
    Measurement,
    Samples,
    Steps,
    UpdateRun,
)
from fuselog.replay.inference.linear_algebra.gaussian import (
    copy_gaussian,
    fill_identity,
    multiply,
    propagate_covariance,
)
from fuselog.replay.inference.linear_algebra.manifold import tangent_size
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.corrections import Kinds, comparing, correcting, sloping
from fuselog.replay.inference.model.model import Correction
from fuselog.replay.inference.run.recursion import EstimateRows

FOREVER_NS = np.iinfo(np.int64).max


# Forward pass


class Chain(NamedTuple):
    """Belief of the states, and their relation to the last node; the first axis is the run.

    Attributes:
        mean, covariance: mean and covariance of the filter, (runs, n) and (runs, t, t).
        predicted, slope: (runs, n) last prediction before its correction, and (runs, t) its slope; see
        `fuselog.replay.inference.model.model.Correction`.
        gain, rest: (runs, t, t) G and P - G D' of the predictions since the last node.
        predictions: (runs,) number of these predictions.
    """

    mean: Floats
    covariance: Floats
    predicted: Floats
    slope: Floats
    gain: Floats
    rest: Floats
    predictions: Integers


class Nodes(NamedTuple):
    """Estimates that the filter fills, and the relation of each to the previous one; see `Chain`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    predicted: Floats
    slope: Floats
    gain: Floats
    rest: Floats


class Piece(NamedTuple):
    """Nodes of all runs; nodes offsets[r]:offsets[r + 1] belong to run r."""

    nodes: Nodes
    offsets: Integers


class ForwardMemory(NamedTuple):
    """Working memory of the steps of one core: the filter's memory, and four matrices (t, t)."""

    filter: CoreMemory
    rest: Floats
    turned: Floats
    factor: Floats
    product: Floats


def smoothing_steps(bound_model: BoundModel, steps: Steps) -> Steps:
    """Make the steps of a filter that stores nodes; its `predict` must fill `Workspace.product`.

    Args:
        bound_model: the bound model.
        steps: steps of the forward filter.
    """
    model, t, predict_filter = bound_model.model, bound_model.model.tangent, steps.predict
    retrace, to_covariance = steps.form.retrace, steps.form.to_covariance
    find_slope = sloping(model.kinds, model.correct, steps.form)

    def predict(run: int, belief: Chain, interval: Interval, memory: ForwardMemory) -> bool:
        rest, turned, product = memory.rest, memory.turned, memory.product
        mean, covariance = belief.mean[run], belief.covariance[run]
        rest[:, :] = covariance
        if not predict_filter(run, belief, interval, memory.filter):
            return False
        if not retrace(rest, covariance, memory.filter, turned, memory.factor):
            return False
        compose(belief.gain[run], belief.rest[run], belief.predictions[run], turned.T, rest, product)
        belief.predictions[run] += 1
        find_slope(mean, covariance, belief.slope[run])
        belief.predicted[run] = mean
        return True

    def estimate(run: int, belief: Chain, nodes: Nodes, row: int, memory: ForwardMemory) -> None:
        mean, covariance = belief.mean[run], belief.covariance[run]
        copy_gaussian(mean, covariance, nodes.mean[row], nodes.covariance[row])
        to_covariance(nodes.covariance[row])
        nodes.predicted[row], nodes.slope[row] = belief.predicted[run], belief.slope[run]
        if belief.predictions[run] == 0:
            fill_identity(nodes.gain[row])
            nodes.rest[row] = 0.0
        else:
            nodes.gain[row], nodes.rest[row] = belief.gain[run], belief.rest[run]
        belief.predicted[run], belief.predictions[run] = mean, 0

    def memory(sets: tuple[Samples, ...]) -> ForwardMemory:
        return ForwardMemory(steps.memory(sets), *(np.empty((t, t)) for _ in range(4)))

    updates = tuple(_with_memory(update) for update in steps.updates)
    return steps._replace(memory=memory, predict=predict, updates=updates, estimate=estimate)


def _with_memory(update: UpdateRun) -> UpdateRun:
    def update_filter(
        run: int,
        belief: Chain,
        measurement: Measurement,
        memory: ForwardMemory,
        record: InnovationRecord,
    ) -> int:
        return update(run, belief, measurement, memory.filter, record)

    return update_filter


def compose(
    gain: Floats, rest: Floats, predictions: int, next_gain: Floats, next_rest: Floats, product: Floats
) -> None:
    """Compose the steps so far with the next step: G G1, and A + G A1 G'.

    Args:
        gain: G (t, t) of the steps so far, changed in place.
        rest: A (t, t) of the steps so far, changed in place.
        predictions: number of steps so far; if it is zero, the next step is copied.
        next_gain: G1 (t, t).
        next_rest: A1 (t, t), overwritten.
        product: (t, t) working memory.
    """
    t = len(gain)
    if predictions == 0:
        gain[:, :] = next_gain
        rest[:, :] = next_rest
        return
    propagate_covariance(next_rest, gain, product)
    multiply(gain, next_gain, product)
    for row in range(t):
        for column in range(t):
            rest[row, column] += next_rest[row, column]
            gain[row, column] = product[row, column]


# The backward pass


class Later(NamedTuple):
    """The node after a piece: whether each run has one, and the smoothed nodes, one row per run."""

    is_there: Integers
    nodes: Nodes


class Smoothed(NamedTuple):
    """Results of smoothing: the nodes of run r before stop[r] are written from row start[r] on.

    The smoothing of each estimate begins at the last node within the lag.
    """

    stop: Integers
    start: Integers
    lag_ns: int
    estimates: EstimateRows


class BackMemory(NamedTuple):
    """Working memory of one core for the backward pass: a Gaussian, its gain, and vectors of a step."""

    mean: Floats
    covariance: Floats
    product: Floats
    rest: Floats
    change: Floats
    state: Floats
    transition: Floats
    step: Floats
    slope: Floats


@lru_cache(maxsize=64)
def backward_pass_over_runs(kinds: Kinds, correct: Correction | None = None) -> OverRuns:
    """Make the loop of `backward_pass` over all runs, which is compiled when first called."""
    return compile_over_runs(backward_pass(kinds, correct), title="the backward pass of a smoother")


class GoBack(Protocol):
    """Function that smooths the nodes of a run in a piece, and sets `later` to the first of them."""

    def __call__(
        self, run: int, piece: Piece, later: Later, smoothed: Smoothed, work: BackMemory, /
    ) -> None: ...


def backward_pass(kinds: Kinds, correct: Correction | None = None) -> GoBack:
    """Make the loop over the nodes of one run, from its last to its first.

    Args:
        kinds: kinds of the state's components.
        correct: the correction of the model, if it has one.
    """
    move, compare = correcting(kinds, correct, back=True), comparing(kinds, correct)
    find_slope, t = sloping(kinds, correct), tangent_size(kinds)

    def go_back(mean: Floats, covariance: Floats, nodes: Nodes, node: int, work: BackMemory) -> None:
        """Move the Gaussian of `work` back to the previous node, given the filtered Gaussian there."""
        gain, rest, step, change = nodes.gain[node], nodes.rest[node], work.step, work.change[0]
        work.slope[:] = nodes.slope[node]
        compare(nodes.predicted[node], work.mean, work.covariance, work)
        for row in range(t):
            entry = 0.0
            for k in range(t):
                entry += gain[row, k] * change[k]
            step[row] = entry
        propagate_covariance(work.covariance, gain, work.product)
        for row in range(t):
            for column in range(t):
                work.covariance[row, column] += rest[row, column]
        find_slope(mean, covariance, work.slope)
        work.mean[:] = mean
        move(work.mean, work.covariance, work)

    def smooth(run: int, piece: Piece, later: Later, smoothed: Smoothed, work: BackMemory) -> None:
        nodes, offsets = piece
        stop, start, lag_ns, estimates = smoothed
        begin, through, reached = offsets[run], offsets[run + 1] - 1, -1
        at = through
        for row in range(stop[run] - 1, begin - 1, -1):
            while nodes.time_ns[through] - nodes.time_ns[row] > lag_ns:
                through -= 1
            if through != reached:
                at = reached = through
                copy_gaussian(nodes.mean[at], nodes.covariance[at], work.mean, work.covariance)
                if later.is_there[run]:
                    behind = later.nodes
                    copy_gaussian(behind.mean[run], behind.covariance[run], work.mean, work.covariance)
                    go_back(nodes.mean[at], nodes.covariance[at], behind, run, work)
            while at > row:
                go_back(nodes.mean[at - 1], nodes.covariance[at - 1], nodes, at, work)
                at -= 1
            place = start[run] + row - begin
            estimates.time_ns[place] = nodes.time_ns[row]
            copy_gaussian(work.mean, work.covariance, estimates.mean[place], estimates.covariance[place])
        if stop[run] > begin:
            later.is_there[run] = True
            first = later.nodes
            copy_gaussian(work.mean, work.covariance, first.mean[run], first.covariance[run])
            copy_gaussian(
                nodes.predicted[begin], nodes.gain[begin], first.predicted[run], first.gain[run]
            )
            copy_gaussian(nodes.slope[begin], nodes.rest[begin], first.slope[run], first.rest[run])

    return smooth


def no_later(runs: int, n: int, t: int) -> Later:
    """Allocate a `Later` without nodes, for runs of states with n components.

    See `Later`.
    """
    wide = (np.empty((runs, *shape)) for shape in ((n,), (t, t), (n,), (t,), (t, t), (t, t)))
    return Later(np.zeros(runs, bool), Nodes(np.arange(runs), np.empty(runs, np.int64), *wide))


def back_memory(n: int, t: int) -> BackMemory:
    """Allocate memory for the backward pass of states with n components, t in the tangent space."""
    shapes = (n,), (t, t), (t, t), (t, t), (1, t), (n,), (t, t), (t,), (t,)
    return BackMemory(*(np.empty(shape) for shape in shapes))
