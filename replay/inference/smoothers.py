"""Smoothers: what a filter estimates, corrected by all that was measured later.

A filter goes forward. At every stamp that has an estimate, a node, it leaves its Gaussian and what ties
it to the node before; from the last node the way leads back. For a step from k to k + 1 with the
prediction (m-, P-) and D, the covariance of the state before with the state after it,

    G = D P-^-1,  ms_k = m_k (+) G (ms_(k+1) (-) m-),  Ps_k = (P_k - G D') + G Ps_(k+1) G'

with the derivative's D for extended filters and that of the samples for the others. Several predictions
between two nodes are one such step: their G multiply. On a manifold covariances are carried from the
tangent space of one mean to that of another by the right Jacobian.

A fixed lag is a window of such steps that slides: as they compose, whatever brackets are put, a queue
made of two stacks has the composition of all its steps at hand, at two compositions a node however many
nodes the lag has. Where the means of a manifold have a part in the steps they do not compose, and each
estimate comes back over the whole lag.

Rauch, Tung and Striebel, AIAA Journal 3(8), 1965; Sarkka, IEEE TAC 53(3), 2008.
"""

import re
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from replay.engine.arrays import Floats, Function, Integers
from replay.engine.blocks import Ragged, copied
from replay.engine.compile import compile_over_runs
from replay.inference.estimators import Filter, State
from replay.inference.gaussian import copy_gaussian, moved_covariance, semidefinite_cholesky
from replay.inference.generate import differencing, is_flat, resetting, retraction
from replay.inference.methods import (
    FILTERS,
    Method,
    RegressionParameters,
    UnscentedParameters,
    check_filter,
    filter_with,
)
from replay.inference.model import Model
from replay.inference.recursion import Estimates, Happenings, Innovations
from replay.inference.steps import Note, Stage, Steps

UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
IN_MEMORY_BYTES = 10**9  # of the nodes of whole runs; what is more goes to a temporary file
FOREVER_NS = np.iinfo(np.int64).max


class SmootherParameters(UnscentedParameters, RegressionParameters):
    """The filter that goes forward, and after `lag=` how far the way back reaches: `ekf:lag=500ms`.

    Without a lag every estimate uses the whole run; with one, the messages up to so much later.
    """

    forward: str = "ekf"


class Forward(NamedTuple):
    """A filter's name, its variant, and the lag, FOREVER_NS for the whole run."""

    name: str
    variant: str
    lag_ns: int


def parse_forward(text: str) -> Forward:
    """What `SmootherParameters.forward` says; raises BadInput where it says nothing."""
    before, has_lag, lag = text.rpartition("lag=") if "lag=" in text else (text, "", "")
    name, _, variant = before.removesuffix(":").partition(":")
    check_filter(name, variant, "smoother", "that a smoother goes back over")
    if not has_lag:
        return Forward(name, variant, FOREVER_NS)
    found = re.fullmatch(rf"(\d+)({'|'.join(UNITS_NS)})", lag)
    if found is None or int(found[1]) == 0:
        raise BadInput(
            f"lag={lag} is no lag; give a whole number above zero and its unit, one of "
            f"{', '.join(UNITS_NS)}, as in smoother:ekf:lag=500ms"
        )
    return Forward(name, variant, int(found[1]) * UNITS_NS[found[2]])


# The way forward


class Chain(NamedTuple):
    """What is believed of the states, and of how they came from the last node; first axis = run.

    Attributes:
        mean, covariance: the filter's, (runs, n) and (runs, t, t).
        predicted: (runs, n) the last prediction, before it was corrected.
        gain, rest: (runs, t, t) G and P - G D' of the predictions since the last node.
        predictions: (runs,) how many these are.
    """

    mean: Floats
    covariance: Floats
    predicted: Floats
    gain: Floats
    rest: Floats
    predictions: Integers


class Nodes(NamedTuple):
    """Estimates as the filter fills them in, and how each came from the one before; see `Chain`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    predicted: Floats
    gain: Floats
    rest: Floats


class ForwardMemory(NamedTuple):
    """What the steps of one core work in: the filter's own memory, and four matrices (t, t)."""

    filter: Any
    rest: Floats
    turned: Floats
    factor: Floats
    product: Floats


def smoothing_steps(stage: Stage, steps: Steps) -> Steps:
    """The steps of a filter that leaves nodes; its `predict` fills `Workspace.product`."""
    t = stage.model.tangent
    predict_filter = steps.predict

    def predict(
        run: int,
        belief: Chain,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        memory: ForwardMemory,
    ) -> bool:
        rest, turned, product = memory.rest, memory.turned, memory.product
        mean, covariance = belief.mean[run], belief.covariance[run]
        for row in range(t):
            for column in range(t):
                rest[row, column] = covariance[row, column]
        if not predict_filter(run, belief, control, duration_s, parameters, use, memory.filter):
            return False
        cross = memory.filter.product
        for row in range(t):
            for column in range(t):
                turned[row, column] = cross[row, column]
        if not solve_semidefinite(covariance, turned, memory.factor):
            return False
        for row in range(t):
            for column in range(row + 1):
                entry = rest[row, column]
                for k in range(t):
                    entry -= turned[k, row] * cross[k, column]
                rest[row, column] = rest[column, row] = entry
        lengthen(belief.gain[run], belief.rest[run], belief.predictions[run], rest, turned, product)
        belief.predictions[run] += 1
        for row in range(len(mean)):
            belief.predicted[run, row] = mean[row]
        return True

    def estimate(run: int, belief: Chain, nodes: Nodes, row: int, memory: ForwardMemory) -> None:
        mean, covariance = belief.mean[run], belief.covariance[run]
        copy_gaussian(mean, covariance, nodes.mean[row], nodes.covariance[row])
        still = belief.predictions[run] == 0
        for i in range(len(mean)):
            nodes.predicted[row, i] = belief.predicted[run, i]
            belief.predicted[run, i] = mean[i]
        for i in range(t):
            for j in range(t):
                unit = 1.0 if i == j else 0.0
                nodes.gain[row, i, j] = unit if still else belief.gain[run, i, j]
                nodes.rest[row, i, j] = 0.0 if still else belief.rest[run, i, j]
        belief.predictions[run] = 0

    def memory(sets: tuple[Any, ...]) -> ForwardMemory:
        return ForwardMemory(steps.memory(sets), *(np.empty((t, t)) for _ in range(4)))

    updates = tuple(_with_memory(update) for update in steps.updates)
    return Steps(memory, predict, updates, estimate, steps.sampled)


def _with_memory(update: Function) -> Function:
    def update_filter(
        run: int,
        belief: Chain,
        data: Floats,
        parameters: Any,
        gate: Floats,
        use: int,
        memory: ForwardMemory,
        note: Note,
    ) -> int:
        return update(run, belief, data, parameters, gate, use, memory.filter, note)

    return update_filter


def lengthen(
    gain: Floats, rest: Floats, predictions: int, next_rest: Floats, next_turned: Floats, product: Floats
) -> None:
    """Make one step of the steps so far and the next, whose gain is given turned: G G1, A + G A1 G'."""
    t = len(gain)
    if predictions == 0:
        for row in range(t):
            for column in range(t):
                gain[row, column] = next_turned[column, row]
                rest[row, column] = next_rest[row, column]
        return
    moved_covariance(next_rest, gain, product)
    for row in range(t):
        for column in range(t):
            rest[row, column] += next_rest[row, column]
            entry = 0.0
            for k in range(t):
                entry += gain[row, k] * next_turned[column, k]
            product[row, column] = entry
    for row in range(t):
        for column in range(t):
            gain[row, column] = product[row, column]


def solve_semidefinite(matrix: Floats, right: Floats, factor: Floats) -> bool:
    """Make X of B in place, A X = B, by Cholesky's factor of A, which goes into `factor`.

    A pivot of zero, but for round-off, is what A knows exactly: its row of X is zero, a solution where B
    is in the range of A. False where A is not positive semidefinite.
    """
    size, columns = len(matrix), right.shape[1]
    if not semidefinite_cholesky(factor, matrix, size):
        return False
    for row in range(size):
        scale = 1.0 / factor[row, row] if factor[row, row] > 0.0 else 0.0
        for k in range(row):
            for column in range(columns):
                right[row, column] -= factor[row, k] * right[k, column]
        for column in range(columns):
            right[row, column] *= scale
    for row in range(size - 1, -1, -1):
        scale = 1.0 / factor[row, row] if factor[row, row] > 0.0 else 0.0
        for k in range(row + 1, size):
            for column in range(columns):
                right[row, column] -= factor[k, row] * right[k, column]
        for column in range(columns):
            right[row, column] *= scale
    return True


# The way back


class Later(NamedTuple):
    """The first node of the piece behind this one, smoothed, and how it came from the last node here.

    First axis = run; `is_there` says in which runs there is one.
    """

    is_there: Integers
    mean: Floats
    covariance: Floats
    predicted: Floats
    gain: Floats
    rest: Floats


class BackMemory(NamedTuple):
    """What the way back of one core works in: a Gaussian, what carries it, and a step's matrices."""

    mean: Floats
    covariance: Floats
    product: Floats
    change: Floats
    step: Floats
    rest: Floats
    turned: Floats


@lru_cache(maxsize=64)
def _way_back(kinds: tuple[str, ...]) -> Function:
    return compile_over_runs(way_back(kinds), allocates=False)


def way_back(kinds: tuple[str, ...]) -> Function:
    """The loop over the nodes of one run, from its last to its first."""
    add, subtract, flat = retraction(kinds), differencing(kinds), is_flat(kinds)
    reset, reset_back = resetting(kinds), resetting(kinds, back=True)

    def go_back(mean: Floats, predicted: Floats, gain: Floats, rest: Floats, work: BackMemory) -> None:
        """Move the Gaussian of `work` to the node before, whose filtered mean is `mean`."""
        change, step, covariance = work.change[0], work.step, work.covariance
        subtract(work.mean, predicted, work.change, 0)
        for row in range(len(step)):
            entry = 0.0
            for k in range(len(step)):
                entry += gain[row, k] * change[k]
            step[row] = entry
        if not flat:
            reset_back(change, covariance)
            reset_back(change, covariance.T)
        moved_covariance(covariance, gain, work.product)
        for row in range(len(step)):
            for column in range(len(step)):
                covariance[row, column] += rest[row, column]
        for row in range(len(mean)):
            work.mean[row] = mean[row]
        add(work.mean, step)
        if not flat:
            reset(step, covariance)
            reset(step, covariance.T)

    def smooth(
        run: int,
        nodes: Nodes,
        offsets: Integers,
        stop: Integers,
        lag_ns: int,
        later: Later,
        start: Integers,
        smoothed: Estimates,
        work: BackMemory,
    ) -> None:
        """Smooth the nodes of a piece that lie before row stop[run], into the rows from start[run] on.

        Each comes back from the last node within the lag; `later` then holds the first of them.
        """
        begin, through, reached = offsets[run], offsets[run + 1] - 1, -1
        at = through
        for row in range(stop[run] - 1, begin - 1, -1):
            while nodes.time_ns[through] - nodes.time_ns[row] > lag_ns:
                through -= 1
            if through != reached:
                at = reached = through
                copy_gaussian(nodes.mean[at], nodes.covariance[at], work.mean, work.covariance)
                if later.is_there[run]:
                    copy_gaussian(later.mean[run], later.covariance[run], work.mean, work.covariance)
                    go_back(nodes.mean[at], later.predicted[run], later.gain[run], later.rest[run], work)
            while at > row:
                go_back(nodes.mean[at - 1], nodes.predicted[at], nodes.gain[at], nodes.rest[at], work)
                at -= 1
            place = start[run] + row - begin
            smoothed.time_ns[place] = nodes.time_ns[row]
            copy_gaussian(work.mean, work.covariance, smoothed.mean[place], smoothed.covariance[place])
        if stop[run] > begin:
            later.is_there[run] = True
            copy_gaussian(work.mean, work.covariance, later.mean[run], later.covariance[run])
            predicted, gain, rest = nodes.predicted[begin], nodes.gain[begin], nodes.rest[begin]
            copy_gaussian(predicted, gain, later.predicted[run], later.gain[run])
            copy_gaussian(predicted, rest, later.predicted[run], later.rest[run])

    return smooth


# A lag behind


class Window(NamedTuple):
    """The steps within the lag of the first node that is not smoothed yet, as two stacks.

    Of the steps to the nodes up to `turned`, each node's row holds the composition of its own and all
    behind it, up to there; those from there up to `through` are composed here. First axis = run; nodes
    count from the first that is kept. A step is (G, b, A): deviations from the filter's means go back by
    d_k = G d_(k+1) + b, covariances by P_k = A + G P_(k+1) G'.
    """

    turned: Integers
    through: Integers
    gain: Floats
    shift: Floats
    rest: Floats


@lru_cache(maxsize=64)
def _sliding(kinds: tuple[str, ...]) -> Function:
    return compile_over_runs(sliding(kinds), allocates=False)


def sliding(kinds: tuple[str, ...]) -> Function:
    """The loop over the nodes of one run in flat space, from its first to its last, a lag behind."""
    add, subtract = retraction(kinds), differencing(kinds)

    def take_in(
        row: int, is_first: bool, nodes: Nodes, window: Window, run: int, work: BackMemory
    ) -> None:
        """The step to a node behind those of the window: its row gets b in place of the prediction."""
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
        """Take deviation and covariance of `work` by a step."""
        step, deviation = work.step, work.mean
        for row in range(len(step)):
            step[row] = shift[row]
            for k in range(len(step)):
                step[row] += gain[row, k] * deviation[k]
        moved_covariance(work.covariance, gain, work.product)
        for row in range(len(step)):
            deviation[row] = step[row]
            for column in range(len(step)):
                work.covariance[row, column] += rest[row, column]

    def slide(
        run: int,
        nodes: Nodes,
        offsets: Integers,
        stop: Integers,
        lag_ns: int,
        window: Window,
        start: Integers,
        smoothed: Estimates,
        work: BackMemory,
    ) -> None:
        """Smooth the nodes before row stop[run] into the rows from start[run] on."""
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
            smoothed.time_ns[place] = nodes.time_ns[row]
            mean = smoothed.mean[place]
            copy_gaussian(nodes.mean[row], work.covariance, mean, smoothed.covariance[place])
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
    """Make one step of a step and the next, in place of the first."""
    for row in range(len(shift)):
        for column in range(len(shift)):
            shift[row] += gain[row, column] * next_shift[column]
            work.turned[column, row] = next_gain[row, column]
            work.rest[row, column] = next_rest[row, column]
    lengthen(gain, rest, 1, work.rest, work.turned, work.product)


# As an estimator


class Piece(NamedTuple):
    """Nodes of all runs: run r owns offsets[r]:offsets[r + 1]."""

    nodes: Nodes
    offsets: Integers


class Stored:
    """A piece on disk, in a temporary file that is gone when nobody refers to it any more."""

    def __init__(self, piece: Piece) -> None:
        self.offsets = piece.offsets
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 lives as long as the piece
        weakref.finalize(self, self._file.close)
        for column in piece.nodes:
            np.save(self._file, column)

    def read(self) -> Piece:
        """The piece, in memory."""
        self._file.seek(0)
        return Piece(Nodes(*(np.load(self._file) for _ in Nodes._fields)), self.offsets)


def stored(pieces: Sequence[Piece | Stored], new: Piece) -> Piece | Stored:
    """A piece, on disk where it is too much beside those in memory."""
    in_memory = [new, *(piece for piece in pieces if isinstance(piece, Piece))]
    size = sum(column.nbytes for piece in in_memory for column in piece.nodes)
    return new if size <= IN_MEMORY_BYTES else Stored(new)


class Waiting(NamedTuple):
    """The nodes within the lag, and the steps between them."""

    piece: Piece
    window: Window


class Smoother(Filter):
    """A filter that keeps its nodes, and at the end, or a lag behind, goes back over them."""

    @cached_property
    def lag_ns(self) -> int:
        """How much later a message may be that an estimate uses."""
        return parse_forward(self.parameters.forward).lag_ns

    @property
    def cannot_rewind(self) -> str:
        """A smoother has its estimates from what came later in any case."""
        return "a smoother uses later messages in any case; replay it in the order of the stamps"

    def start(self, whole: Mapping[str, Ragged]) -> State:
        """The state at every run's prior, see `Filter.start`."""
        state = super().start(whole)
        mean, covariance = state.carried.belief
        gain, rest = (np.empty_like(covariance) for _ in range(2))
        chain = Chain(mean, covariance, mean.copy(), gain, rest, np.zeros(len(mean), np.int64))
        return state._replace(carried=state.carried._replace(belief=chain), kept=())

    def no_results(self, due: Integers, noted: Integers, slots: int) -> tuple[Any, Innovations]:
        """Nodes and innovations to be filled in."""
        estimates, innovations = super().no_results(due, noted, slots)
        end, times, mean, covariance = estimates
        gain, rest = (np.empty_like(covariance) for _ in range(2))
        return Nodes(end, times, mean, covariance, np.empty_like(mean), gain, rest), innovations

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Filter events, and smooth what the lag lets go."""
        after, (nodes, offsets), made = self.filtered(state, happenings)
        new = Piece(nodes, offsets)
        if self.lag_ns == FOREVER_NS:  # nothing yet
            nothing = self.states(*self.gone_back([new], offsets[:-1]))
            return after._replace(kept=(*state.kept, stored(state.kept, new))), [nothing, *made]
        piece, window = new, self._no_window(len(offsets) - 1)
        if state.kept:
            piece, window = _joined([state.kept.piece, new]), copied(state.kept.window)
        begin, end = piece.offsets[:-1], piece.offsets[1:]
        run = np.repeat(np.arange(len(begin)), end - begin)
        newest_ns = np.append(piece.nodes.time_ns, 0)[end - 1]
        is_ready = newest_ns[run] - piece.nodes.time_ns > self.lag_ns
        stop = begin + np.bincount(run, is_ready, len(begin)).astype(np.int64)
        smoothed = self.states(*self.lagging(piece, window, stop))
        return after._replace(kept=Waiting(_rows_from(piece, stop), window)), [smoothed, *made]

    def finish(self, state: State) -> list[Ragged]:
        """What waited for later messages, and what those say of all before them."""
        state, made = self.ended(state)
        if self.lag_ns == FOREVER_NS:
            return [*made, self.states(*self.gone_back(state.kept))]
        if not state.kept:
            return made
        piece, window = copied(state.kept)
        return [*made, self.states(*self.lagging(piece, window, piece.offsets[1:]))]

    def lagging(self, piece: Piece, window: Window, stop: Integers) -> tuple[Estimates, Integers]:
        """The estimates before row stop[run]; run r owns offsets[r]:offsets[r + 1].

        Changes the nodes, and the window, which then begins at row stop[run].
        """
        model = self.stage.model
        if not is_flat(model.kinds):
            return self.gone_back([piece], stop)
        offsets = np.append(0, np.cumsum(stop - piece.offsets[:-1]))
        smoothed = _no_estimates(offsets, model.size, model.tangent)
        memory = partial(back_memory, model.size, model.tangent)
        arguments = (piece.nodes, piece.offsets, stop, self.lag_ns, window, offsets, smoothed)
        _sliding(model.kinds)(len(stop), *arguments, scratch=memory)
        return smoothed, offsets

    def _no_window(self, runs: int) -> Window:
        t = self.stage.model.tangent
        gain, rest = (np.empty((runs, t, t)) for _ in range(2))
        turned, through = (np.zeros(runs, np.int64) for _ in range(2))
        return Window(turned, through, gain, np.empty((runs, t)), rest)

    def gone_back(
        self, pieces: Sequence[Piece | Stored], stop: Integers | None = None
    ) -> tuple[Estimates, Integers]:
        """The estimates at the nodes of all pieces, or of one those before row stop[run].

        Run r owns offsets[r]:offsets[r + 1].
        """
        model, runs = self.stage.model, len(pieces[0].offsets) - 1 if pieces else 0
        counts = [(piece.offsets[1:] if stop is None else stop) - piece.offsets[:-1] for piece in pieces]
        offsets = np.append(0, np.cumsum(sum(counts, np.zeros(runs, np.int64))))
        n, t = model.size, model.tangent
        smoothed = _no_estimates(offsets, n, t)
        later = no_later(runs, n, t)
        start = offsets[1:].copy()
        for kept, of_piece in zip(reversed(pieces), reversed(counts), strict=True):
            piece = kept.read() if isinstance(kept, Stored) else kept
            start -= of_piece
            end = piece.offsets[:-1] + of_piece
            memory = partial(back_memory, n, t)
            arguments = (piece.nodes, piece.offsets, end, self.lag_ns, later, start, smoothed)
            _way_back(model.kinds)(runs, *arguments, scratch=memory)
        return smoothed, offsets


def _no_estimates(offsets: Integers, n: int, t: int) -> Estimates:
    count = offsets[-1]
    times, means = np.empty(count, np.int64), np.empty((count, n))
    return Estimates(offsets[:-1], times, means, np.empty((count, t, t)))


def no_later(runs: int, n: int, t: int) -> Later:
    """Where nothing lies behind a piece, for so many runs of states with n components; see `Later`."""
    wide = (np.empty((runs, *shape)) for shape in ((n,), (t, t), (n,), (t, t), (t, t)))
    return Later(np.zeros(runs, bool), *wide)


def back_memory(n: int, t: int) -> BackMemory:
    """Memory for the way back of states with n components, and t in the tangent space."""
    shapes = ((n,), (t, t), (t, t), (1, t), (t,), (t, t), (t, t))
    return BackMemory(*(np.empty(shape) for shape in shapes))


def _joined(pieces: Sequence[Piece]) -> Piece:
    """Pieces as one, each run's nodes together."""
    if len(pieces) == 1:
        return pieces[0]
    runs = np.arange(len(pieces[0].offsets) - 1)
    run = np.concatenate([np.repeat(runs, np.diff(piece.offsets)) for piece in pieces])
    order = np.argsort(run, kind="stable")
    columns: Any = zip(*(piece.nodes[1:] for piece in pieces), strict=True)
    offsets = sum((piece.offsets for piece in pieces), np.zeros(1, np.int64))
    return Piece(Nodes(offsets[1:], *(np.concatenate(parts)[order] for parts in columns)), offsets)


def _rows_from(piece: Piece, begin: Integers) -> Piece:
    """The nodes of every run from row begin[run] on."""
    counts = piece.offsets[1:] - begin
    rows = np.arange(piece.offsets[-1]) >= np.repeat(begin, np.diff(piece.offsets))
    columns: Any = (column[rows] for column in piece.nodes[1:])
    offsets = np.append(0, np.cumsum(counts))
    return Piece(Nodes(offsets[1:], *columns), offsets)


# As a method


@lru_cache(maxsize=64)
def _smoother_of(name: str, variant: str) -> Method:
    """The method that smooths what a filter estimates."""
    inner = filter_with(name, variant)

    def steps(stage: Stage) -> Steps:
        return smoothing_steps(stage, inner.steps(stage))

    def lacks(model: Model) -> str:
        motions = (model.modes or {"": model.motion}).values()
        if name == "analytic" and not all(motion.linear for motion in motions):
            return "exact moments of its motion with the state before it"
        return inner.lacks(model)

    return replace(SMOOTHING, steps=steps, sampling=inner.sampling, lacks=lacks, made_for=None)


def _made_for(parameters: SmootherParameters) -> Method:
    forward = parse_forward(parameters.forward)
    return _smoother_of(forward.name, forward.variant)


def _no_steps(stage: Stage) -> Steps:
    raise AssertionError("a smoother has the steps of the filter that its parameters name")


SMOOTHING = Method(
    "Rauch-Tung-Striebel smoother; the filter follows the name, as in smoother:ukf, and after it, if "
    "wanted, a lag, as in smoother:ekf:lag=500ms",
    SmootherParameters,
    _no_steps,
    lacks=FILTERS["ekf"].lacks,
    variant="forward",
    made_for=_made_for,
    filtering=Smoother,
)
