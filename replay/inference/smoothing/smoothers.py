"""Smoothers: filters that store their nodes and smooth them at the end or with a lag.

The stored steps and the backward pass are in `fuselog.replay.inference.smoothing.backward_pass`; the
sliding window of a fixed lag is in `fuselog.replay.inference.smoothing.fixed_lag`. On manifolds, steps
depend on the means, so each estimate with a fixed lag needs a backward pass over the whole lag.
"""

import re
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Columns, Integers
from fuselog.replay.engine.streams.blocks import Ragged, by_runs, copied, run_of_rows
from fuselog.replay.inference.kalman.methods import (
    FILTERS,
    Method,
    RegressionParameters,
    UnscentedParameters,
    filter_with,
    named_filter,
    no_steps,
)
from fuselog.replay.inference.kalman.steps import Steps
from fuselog.replay.inference.linear_algebra.manifold import is_flat
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.run.filtering import Filter, FilterState
from fuselog.replay.inference.run.recursion import EstimateRows, FilterEvents, InnovationRows
from fuselog.replay.inference.smoothing.backward_pass import (
    FOREVER_NS,
    Chain,
    Nodes,
    Piece,
    Smoothed,
    back_memory,
    backward_pass_over_runs,
    no_later,
    smoothing_steps,
)
from fuselog.replay.inference.smoothing.fixed_lag import Window, sliding_over_runs

UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
IN_MEMORY_BYTES = 10**9  # limit of nodes in memory; more are stored in temporary files


class SmootherParameters(UnscentedParameters, RegressionParameters):  # type: ignore[explicit-any]
    """Forward filter, and lag of the estimates.

    Attributes:
        forward: the filter (ekf, iekf, ukf, lrkf, analytic or sqrt), optionally with a lag, as in
            `ekf:lag=500ms`; or iterated. With a lag, an estimate uses messages up to this time after its
            stamp; without a lag, it uses the whole run.
    """

    forward: str = "ekf"


class Forward(NamedTuple):
    """Name and variant of a filter, and the lag, which is FOREVER_NS for the whole run."""

    name: str
    variant: str
    lag_ns: int


def parse_forward(text: str) -> Forward:
    """Parse `SmootherParameters.forward`; raise BadInput if it is invalid."""
    before, has_lag, lag = text.rpartition("lag=") if "lag=" in text else (text, "", "")
    rest_on = before.removesuffix(":")
    name, variant = named_filter(rest_on, "smoother", "that a smoother can use")
    if not has_lag:
        return Forward(name, variant, FOREVER_NS)
    found = re.fullmatch(rf"(\d+)({'|'.join(UNITS_NS)})", lag)
    if found is None or int(found[1]) == 0:
        raise BadInput(
            f"lag={lag} is not a valid lag; give a positive whole number and its unit, one of "
            f"{', '.join(UNITS_NS)}, as in smoother:ekf:lag=500ms"
        )
    return Forward(name, variant, int(found[1]) * UNITS_NS[found[2]])


# Estimator


class Stored:
    """Piece in a temporary file, which is deleted when the object is no longer referenced."""

    def __init__(self, piece: Piece) -> None:
        self.offsets = piece.offsets
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 lives as long as the piece
        weakref.finalize(self, self._file.close)
        for column in piece.nodes:
            np.save(self._file, column)

    def read(self) -> Piece:
        """Read the piece into memory."""
        self._file.seek(0)
        return Piece(Nodes(*(np.load(self._file) for _ in Nodes._fields)), self.offsets)


def stored(pieces: Sequence[Piece | Stored], new: Piece) -> Piece | Stored:
    """Return a piece, stored on disk if the pieces in memory would become too large."""
    in_memory = [new, *(piece for piece in pieces if isinstance(piece, Piece))]
    size = sum(column.nbytes for piece in in_memory for column in piece.nodes)
    return new if size <= IN_MEMORY_BYTES else Stored(new)


class Waiting(NamedTuple):
    """Nodes within the lag, and the steps between them."""

    piece: Piece
    window: Window


class Smoother(Filter):
    """Filter that stores its nodes, and smooths them at the end or with a lag."""

    @cached_property
    def lag_ns(self) -> int:
        """Time after an estimate's stamp up to which messages are used for it."""
        return parse_forward(self.parameters.forward).lag_ns

    @property
    def why_in_sequence(self) -> str:
        """Reason why a smoother cannot reprocess messages: its estimates use later messages anyway."""
        return "a smoother uses later messages anyway; replay it in the order of the stamps"

    def start(self, static: Mapping[str, Ragged]) -> FilterState:
        """Make the initial state of every run from its prior; see `Filter.start`."""
        state = super().start(static)
        mean, covariance = state.carried.belief
        gain, rest = (np.empty_like(covariance) for _ in range(2))
        slope, none = np.zeros(covariance.shape[:2]), np.zeros(len(mean), np.int64)
        chain = Chain(mean, covariance, mean.copy(), slope, gain, rest, none)
        return state._replace(carried=state.carried._replace(belief=chain), kept=())

    def no_results(
        self, due: Integers, recorded: Integers, innovation_size: int
    ) -> tuple[Nodes, InnovationRows]:
        """Allocate arrays for nodes and innovations."""
        estimates, innovations = super().no_results(due, recorded, innovation_size)
        end, times, mean, covariance = estimates
        predicted, slope = np.empty_like(mean), np.empty(covariance.shape[:2])
        gain, rest = (np.empty_like(covariance) for _ in range(2))
        return Nodes(end, times, mean, covariance, predicted, slope, gain, rest), innovations

    def follow(self, state: FilterState, events: FilterEvents) -> tuple[FilterState, list[Ragged]]:
        """Filter events, and smooth the nodes that are older than the lag."""
        after, (nodes, offsets), made = self.filtered(state, events)
        new = Piece(nodes, offsets)
        if self.lag_ns == FOREVER_NS:  # nothing is smoothed yet
            nothing = self.states(*self.gone_back([new], offsets[:-1]))
            return after._replace(kept=(*state.kept, stored(state.kept, new))), [nothing, *made]
        piece, window = new, self._no_window(len(offsets) - 1)
        if state.kept:
            piece, window = _joined([state.kept.piece, new]), copied(state.kept.window)
        begin, end = piece.offsets[:-1], piece.offsets[1:]
        run = run_of_rows(piece.offsets)
        newest_ns = np.append(piece.nodes.time_ns, 0)[end - 1]
        is_ready = newest_ns[run] - piece.nodes.time_ns > self.lag_ns
        stop = begin + np.bincount(run, is_ready, len(begin)).astype(np.int64)
        smoothed = self.states(*self.lagging(piece, window, stop))
        return after._replace(kept=Waiting(_rows_from(piece, stop), window)), [smoothed, *made]

    def finish(self, state: FilterState) -> list[Ragged]:
        """Filter the events that still wait, and smooth all remaining nodes."""
        state, made = self.ended(state)
        if self.lag_ns == FOREVER_NS:
            return [*made, self.states(*self.gone_back(state.kept))]
        if not state.kept:
            return made
        piece, window = copied(state.kept)
        return [*made, self.states(*self.lagging(piece, window, piece.offsets[1:]))]

    def lagging(self, piece: Piece, window: Window, stop: Integers) -> tuple[EstimateRows, Integers]:
        """Smooth the nodes before row stop[run] with the lag.

        The nodes and the window are changed; the window then begins at row stop[run]. The results of run
        r have the rows offsets[r]:offsets[r + 1].
        """
        model = self.bound_model.model
        if not is_flat(model.kinds):
            return self.gone_back([piece], stop)
        offsets = np.append(0, np.cumsum(stop - piece.offsets[:-1]))
        smoothed = _no_estimates(offsets, model.size, model.tangent)
        memory = partial(back_memory, model.size, model.tangent)
        filled = Smoothed(stop, offsets, self.lag_ns, smoothed)
        sliding_over_runs(model.kinds)(len(stop), piece, window, filled, scratch=memory)
        return smoothed, offsets

    def _no_window(self, runs: int) -> Window:
        t = self.bound_model.model.tangent
        gain, rest = (np.empty((runs, t, t)) for _ in range(2))
        turned, through = (np.zeros(runs, np.int64) for _ in range(2))
        return Window(turned, through, gain, np.empty((runs, t)), rest)

    def gone_back(
        self, pieces: Sequence[Piece | Stored], stop: Integers | None = None
    ) -> tuple[EstimateRows, Integers]:
        """Smooth the nodes of all pieces, or the nodes of one piece before row stop[run].

        The results of run r have the rows offsets[r]:offsets[r + 1].
        """
        model, runs = self.bound_model.model, len(pieces[0].offsets) - 1 if pieces else 0
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
            filled = Smoothed(end, start, self.lag_ns, smoothed)
            go_back = backward_pass_over_runs(model.kinds, model.correct)
            go_back(runs, piece, later, filled, scratch=memory)
        return smoothed, offsets


def _no_estimates(offsets: Integers, n: int, t: int) -> EstimateRows:
    count = offsets[-1]
    times, means = np.empty(count, np.int64), np.empty((count, n))
    return EstimateRows(offsets[:-1], times, means, np.empty((count, t, t)))


def _joined(pieces: Sequence[Piece]) -> Piece:
    """Concatenate pieces, run by run."""
    if len(pieces) == 1:
        return pieces[0]
    order, offsets = by_runs([piece.offsets for piece in pieces])
    columns: Columns = zip(*(piece.nodes[1:] for piece in pieces), strict=True)
    return Piece(Nodes(offsets[1:], *(np.concatenate(parts)[order] for parts in columns)), offsets)


def _rows_from(piece: Piece, begin: Integers) -> Piece:
    """Return the nodes of every run, starting at row begin[run]."""
    counts = piece.offsets[1:] - begin
    rows = np.arange(piece.offsets[-1]) >= np.repeat(begin, np.diff(piece.offsets))
    columns: Columns = (column[rows] for column in piece.nodes[1:])
    offsets = np.append(0, np.cumsum(counts))
    return Piece(Nodes(offsets[1:], *columns), offsets)


# Method


@lru_cache(maxsize=64)
def _smoother_of(name: str, variant: str) -> Method:
    """Make the method that smooths the estimates of a filter."""
    inner = filter_with(name, variant)

    def steps(bound_model: BoundModel) -> Steps:
        return smoothing_steps(bound_model, inner.steps(bound_model))

    def lacks(model: Model) -> str:
        motions = (model.modes or {"": model.motion}).values()
        if name == "analytic" and not all(motion.linear for motion in motions):
            return "exact moments of its motion together with the state before it"
        return inner.lacks(model)

    return replace(SMOOTHING, steps=steps, sampling=inner.sampling, lacks=lacks, made_for=None)


def _made_for(parameters: SmootherParameters) -> Method:
    forward = parse_forward(parameters.forward)
    return _smoother_of(forward.name, forward.variant)


SMOOTHING = Method(
    "Rauch-Tung-Striebel smoother; the filter follows the name, as in smoother:ukf, and "
    "optionally a lag, as in smoother:ekf:lag=500ms",
    SmootherParameters,
    no_steps,
    lacks=FILTERS["ekf"].lacks,
    variant="forward",
    made_for=_made_for,
    filtering=Smoother,
)
