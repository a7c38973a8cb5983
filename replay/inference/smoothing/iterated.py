"""Iterated smoother: the most probable states of a whole run, given all measurements.

It stores the events of a run, smooths them once with the extended smoother, and then searches for the
trajectory with the smallest cost; see `fuselog.replay.inference.smoothing.gauss_newton`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, reduce
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged, copied, ragged_rows, run_of_rows
from fuselog.replay.inference.kalman.methods import FILTERS, Method
from fuselog.replay.inference.kalman.steps import CoreMemory, Gaussian, Steps
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.run.events import data_columns
from fuselog.replay.inference.run.filtering import FilterState
from fuselog.replay.inference.run.recursion import (
    NOTHING,
    EstimateRows,
    FilterEvents,
    RunInputs,
    no_results,
)
from fuselog.replay.inference.run.timing import join_events, last_of_stamps, output_times, select_events
from fuselog.replay.inference.smoothing import smoothers
from fuselog.replay.inference.smoothing.affine import LOSSES, Trajectory, no_factors
from fuselog.replay.inference.smoothing.backward_pass import (
    FOREVER_NS,
    BackMemory,
    Nodes,
    Piece,
    Smoothed,
    back_memory,
    no_later,
    smoothing_steps,
)
from fuselog.replay.inference.smoothing.gauss_newton import Ended, Plan, SearchState, searching
from fuselog.replay.inference.smoothing.smoothers import Smoother, SmootherParameters


class IteratedParameters(SmootherParameters):  # type: ignore[explicit-any]
    """Options of smoother:iterated: initial trajectory, damping, and loss function for outliers.

    Attributes:
        start: initial trajectory: smoother (result of the extended smoother), motion (the prior's mean,
            propagated by the motion) or prior (the prior's mean at all stamps).
        damping: damping of the first step, in units of the information at the start; with 0, damping
            begins only when a step would raise the cost.
        loss: loss function of residuals; huber and cauchy down-weight large residuals.
        loss_scale: length of a whitened residual above which huber and cauchy down-weight it.
        iterations: maximum number of iterations.
    """

    start: Literal["smoother", "motion", "prior"] = "smoother"
    damping: NonNegativeFloat = 0.0
    loss: Literal["square", "huber", "cauchy"] = "square"
    loss_scale: PositiveFloat = 1.345
    iterations: Annotated[PositiveInt, Field(le=1000)] = 50


# Estimator


class Way(NamedTuple):
    """Complete runs, from the prior to the last node, as processed by the extended smoother.

    Attributes:
        events: events up to the last node, without measurements that a gate rejected.
        node: (events,) node of each event's stamp.
        nodes, offsets: nodes of the filter; the nodes of run r begin at offsets[r].
        states: smoothed states at the nodes.
        wanted: (nodes,) whether an estimate is requested at each node.
        made: other outputs of the filter.
    """

    events: FilterEvents
    node: Integers
    nodes: Nodes
    offsets: Integers
    states: EstimateRows
    wanted: Booleans
    made: list[Ragged]


class IteratedSmoother(Smoother):
    """Smoother that stores the events of a run and searches for its trajectory at the end."""

    @cached_property
    def lag_ns(self) -> int:
        """Infinite lag: the whole run."""
        return FOREVER_NS

    def follow(self, state: FilterState, events: FilterEvents) -> tuple[FilterState, list[Ragged]]:
        """Store the events."""
        return state._replace(kept=(*state.kept, events)), []

    def finish(self, state: FilterState) -> list[Ragged]:
        """Find the best trajectory, and report the outcome of the search."""
        state, _ = self.ended(state)
        if not state.kept:
            return []
        way = self.smoothed_once(state)
        kept, offsets = way.states, way.offsets
        scale = np.diagonal(kept.covariance, axis1=1, axis2=2).copy()
        if self.parameters.start == "motion":
            kept.mean[:] = self._moved(state, way)
        elif self.parameters.start == "prior":
            kept.mean[:] = np.repeat(state.carried.belief.mean, np.diff(offsets), axis=0)
        ended = self._search(state, way, scale)
        rows = way.wanted
        found = EstimateRows(kept.end, kept.time_ns[rows], kept.mean[rows], kept.covariance[rows])
        states = self.states(found, ragged_rows(rows, offsets))
        return [states, *way.made, *self._solution_streams(ended, way)]

    def smoothed_once(self, state: FilterState) -> "Way":
        """Compute the extended smoother's states at all stamps, starting with the prior's stamp."""
        events = reduce(join_events, (*self._first(state), *state.kept))
        run = run_of_rows(events.offsets)
        asked, start_ns = events.wants_estimate, state.carried.time_ns
        events = events._replace(
            wants_estimate=last_of_stamps(events) & (events.time_ns >= start_ns[run])
        )
        _, (nodes, offsets), made = self.filtered(state, events)
        stamp = np.cumsum(events.wants_estimate) - events.wants_estimate
        stamp -= np.append(stamp, 0)[events.offsets[run]]  # counted within each run
        known = stamp < np.diff(offsets)[run]  # nodes after a failure do not exist
        node = offsets[run] + stamp
        wanted = np.zeros(offsets[-1], bool)
        wanted[node[asked & known]] = True
        states, _ = self.gone_back([Piece(nodes, offsets)])
        used = select_events(self._accepted(events, start_ns, made), known)
        return Way(used, node[known], nodes, offsets, states, wanted, made)

    def _moved(self, state: FilterState, way: "Way") -> Floats:
        """Propagate the mean of the prior through each whole run, ignoring all measurements."""
        unseen = np.where(way.events.source >= 0, NOTHING, way.events.source)
        _, (moved, reached), _ = self.filtered(state, way.events._replace(source=unseen))
        if not np.array_equal(reached, way.offsets):
            raise BadInput(
                f"estimator {self.name}: start = motion: the prior cannot be propagated through a whole "
                "run; choose another start"
            )
        mean: Floats = moved.mean
        return mean

    def _first(self, state: FilterState) -> list[FilterEvents]:
        """Return an event at the time of the prior, unless an interpolated control already has one."""
        control = self.bound_model.model.control
        if control is not None and control.interpolated:
            return []
        runs, (width, _) = np.arange(len(state.next_output) + 1), data_columns(self.bound_model)
        return [output_times(runs, state.carried.time_ns.copy(), width, wants_estimate=False)]

    def _accepted(
        self, events: FilterEvents, start_ns: Integers, made: Sequence[Ragged]
    ) -> FilterEvents:
        """Remove the measurements that the gate rejected in the forward pass."""
        if self.parameters.gate_probability == 1.0:
            return events
        source = events.source.copy()
        output_streams = np.zeros(len(source), bool)
        for number, sensor in enumerate(self.bound_model.sensors):
            measured = events.data[:, : len(sensor.measured)]
            output_streams |= (source == number) & np.isfinite(measured).any(axis=1)
        [innovations] = [each for each in made if each.stream.topic.endswith("/innovation")]
        for run, (begin, end) in enumerate(pairwise(events.offsets)):
            accepted = innovations.of_run(run)["accepted"]
            output_streams[begin:end] &= events.time_ns[begin:end] >= start_ns[run]
            rows = begin + np.flatnonzero(output_streams[begin:end])[: len(accepted)]
            source[rows[accepted == 0]] = NOTHING
        return events._replace(source=source)

    def _search(self, state: FilterState, way: Way, scale: Floats) -> Ended:
        """Search for the trajectories of all runs from the states of `way`; the results replace them."""
        bound_model, asked = self.bound_model, self.parameters
        events, nodes, offsets, kept = way.events, way.nodes, way.offsets, way.states
        loop, steps = searching(bound_model)
        t, runs, count = bound_model.model.tangent, len(offsets) - 1, len(kept.mean)
        _, innovations = no_results(np.zeros(1, int), np.arange(runs + 1), bound_model.model, 0)
        belief = state.carried.belief
        prior = Gaussian(belief.mean, belief.covariance)
        plan = Plan(
            prior,
            state.carried.time_ns,
            np.array(self.initial),
            asked.damping,
            asked.iterations,
        )
        chain = belief._replace(mean=np.empty((runs, t)), predicted=np.empty((runs, t)))
        carried = copied(state.carried._replace(belief=chain))
        vectors = nodes._replace(mean=np.empty((count, t)), predicted=np.empty((count, t)))
        smoothed = kept._replace(mean=np.empty((count, t)))
        later = no_later(runs, t, t)
        ended = Ended(
            np.zeros(runs, np.int64), np.zeros(runs, np.int64), np.zeros((runs, asked.iterations, 3))
        )
        loss = np.array([LOSSES.index(asked.loss), asked.loss_scale])
        trajectory, noises = kept.mean.copy(), no_factors(count, t)

        def scratch() -> tuple[CoreMemory, BackMemory]:
            own = Trajectory(
                trajectory,
                noises,
                kept.mean,
                way.node,
                scale,
                loss,
                np.zeros(1),
                np.zeros(1),
                np.zeros(1),
                np.empty((t, t)),
                no_factors(1, t),
                np.empty((1, t)),
                np.empty(t),
            )
            return steps.memory((own,)), back_memory(t, t)

        settings = self.settings_of_runs(state.context, runs)
        gates = np.full_like(self.gates, np.inf)
        back = Smoothed(offsets[1:], offsets, FOREVER_NS, smoothed)
        found = SearchState(carried, Piece(vectors, offsets), innovations, later, back, kept.mean)
        loop(runs, RunInputs(events, settings, gates), plan, found, ended, scratch=scratch)
        return ended

    def _solution_streams(self, ended: Ended, way: Way) -> list[Ragged]:
        """Make the streams that report each search and its passes, at the last node of the run."""
        asked, some = self.parameters, np.diff(way.offsets) > 0
        last_ns = np.append(way.nodes.time_ns, 0)[way.offsets[1:] - 1]
        passes, one = ended.passes, np.arange(len(some))
        cost = ended.output_streams[one, np.maximum(passes - 1, 0), 0]
        t = self.bound_model.model.tangent
        stated = {"start": asked.start, "damping": f"{asked.damping:g}", "loss": asked.loss}
        stated |= {} if asked.loss == "square" else {"loss_scale": f"{asked.loss_scale:g}"}
        solution = make_stream(
            f"/estimates/{self.name}/solution",
            schemas.SOLUTION,
            last_ns[some],
            metadata={"parameters": str(t), **stated},
            iterations=passes[some],
            converged=ended.converged[some],
            rank=np.full(some.sum(), t),
            cost=cost[some],
        )
        made = np.arange(asked.iterations) < passes[:, None]
        run, number = np.nonzero(made)
        iterations = make_stream(
            f"/estimates/{self.name}/iteration",
            schemas.ITERATION,
            last_ns[run],
            metadata=stated,
            iteration=number,
            **dict(zip(("cost", "damping", "largest_step"), ended.output_streams[made].T, strict=True)),
        )
        return [
            Ragged(solution, np.append(0, np.cumsum(some))),
            Ragged(iterations, np.append(0, np.cumsum(passes))),
        ]


# Method


def _solved_at_the_end(bound_model: BoundModel) -> Steps:
    """Make the steps of the extended smoother, which runs once before the search."""
    return smoothing_steps(bound_model, FILTERS["ekf"].steps(bound_model))


ITERATED = Method(
    "iterated smoother: Gauss-Newton on all states of a run",
    IteratedParameters,
    _solved_at_the_end,
    lacks=FILTERS["ekf"].lacks,
    filtering=IteratedSmoother,
)


def _made_for(parameters: IteratedParameters) -> Method:
    name, _, rest = parameters.forward.partition(":")
    if name != "iterated":
        assert smoothers.SMOOTHING.made_for is not None
        own = sorted(set(IteratedParameters.model_fields) - set(SmootherParameters.model_fields))
        for field in own:
            if getattr(parameters, field) != IteratedParameters.model_fields[field].default:
                raise BadInput(f"{field} is a setting of smoother:iterated, not of smoother:{name}")
        return smoothers.SMOOTHING.made_for(parameters)
    if rest:
        raise BadInput(f"smoother:iterated uses the whole run and has no variants; leave out ':{rest}'")
    return ITERATED


SMOOTHING = replace(
    smoothers.SMOOTHING,
    summary=f"{smoothers.SMOOTHING.summary}; smoother:iterated is Gauss-Newton on the whole run",
    parameters=IteratedParameters,
    made_for=_made_for,
)
