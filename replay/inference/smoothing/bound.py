"""Posterior Cramer-Rao bound from the information of the measurements along the true states.

For each node (a stamp with an estimate), the result is the covariance of an extended Kalman filter that
linearises at the truth, or of its smoother (`bound:smoother`), along this trajectory. No inverse of the
process noise, which may be singular, is needed. The steps are also output;
`fuselog.replay.judging.consistency.bounds` computes the bound over an ensemble from them.

Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5), 1998.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Literal, NamedTuple

import numpy as np
from pydantic import PositiveFloat

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, make_stream, schemas
from fuselog.replay.engine.arrays import Booleans, Floats, Integers, RowSlice
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.results import named
from fuselog.replay.engine.vectors.components import match_components
from fuselog.replay.engine.vectors.tangent import truth_at
from fuselog.replay.inference.kalman.methods import FILTERS, Method, MethodParameters
from fuselog.replay.inference.kalman.steps import CoreMemory, EstimatesToFill, Samples
from fuselog.replay.inference.linear_algebra.gaussian import propagate_covariance, solve_semidefinite
from fuselog.replay.inference.run.filtering import Filter, FilterState
from fuselog.replay.inference.run.recursion import (
    EstimateRows,
    FilterEvents,
    InnovationRows,
    RecursionState,
)
from fuselog.replay.inference.smoothing.bound_steps import Nodes, TrueTrajectory, bound_steps


class BoundParameters(MethodParameters):  # type: ignore[explicit-any]
    """Kind of bound, and interpolation of the truth.

    Attributes:
        of: whether to compute the bound for filters or the bound for smoothers.
        gap_limit_s: longest gap over which truth is interpolated.
    """

    of: Literal["filter", "smoother"] = "filter"
    gap_limit_s: PositiveFloat = 0.2


class BackMemory(NamedTuple):
    """Working memory of the backward pass of one core: four matrices (t, t)."""

    predicted: Floats
    turned: Floats
    factor: Floats
    product: Floats


def back_memory(t: int) -> BackMemory:
    """Allocate memory for the backward pass of states with t components in the tangent space."""
    return BackMemory(*(np.empty((t, t)) for _ in BackMemory._fields))


@lru_cache(maxsize=1)
def smooth_over_runs() -> OverRuns:
    """Make the loop of `smooth` over all runs, which is compiled when first called."""
    return compile_over_runs(smooth, title="the bound of smoothers")


def smooth(
    run: int,
    offsets: Integers,
    transition: Floats,
    noise: Floats,
    covariance: Floats,
    memory: BackMemory,
) -> None:
    """Replace a filter's covariances by its smoother's along one trajectory, in place.

    With the gain G = P F' P-^-1, each covariance becomes P + G (Ps - P-) G', where Ps is the smoothed
    covariance of the next node.

    Args:
        run: index of the run.
        offsets: (runs + 1,) first node of each run.
        transition, noise: F and Q of the step to each node, (nodes, t, t).
        covariance: (nodes, t, t), changed in place; its first entry is set to NaN if P- is not positive
            definite.
        memory: working memory.
    """
    predicted, turned, factor, product = memory
    for node in range(offsets[run + 1] - 2, offsets[run] - 1, -1):
        here, later, step = covariance[node], covariance[node + 1], transition[node + 1]
        predicted[:, :] = here
        propagate_covariance(predicted, step, turned)  # which becomes F P
        for row in range(len(here)):
            for column in range(len(here)):
                predicted[row, column] += noise[node + 1, row, column]
        if not solve_semidefinite(predicted, turned, factor):
            covariance[node, 0, 0] = np.nan
            continue
        for row in range(len(here)):
            for column in range(len(here)):
                factor[row, column] = turned[column, row]
                predicted[row, column] = later[row, column] - predicted[row, column]
        propagate_covariance(predicted, factor, product)
        for row in range(len(here)):
            for column in range(len(here)):
                here[row, column] += predicted[row, column]


class BoundHistory(NamedTuple):
    """Truths of all runs, whether each run has reached a node (runs,), and nodes to be smoothed."""

    truth: Ragged
    has_begun: Booleans
    nodes: tuple[tuple[Nodes, Integers], ...] = ()


class BoundFilter(Filter):
    """Filter that knows the truth, and also outputs every step."""

    is_bound = True

    def static(self, topics: Mapping[str, Topic]) -> tuple[str, ...]:
        """List the topics needed before the start; raise BadInput if the log has no truth."""
        if self.truth not in topics:
            raise BadInput(
                f"estimator {self.name}: a bound needs the true states, but the log has no topic "
                f"{self.truth}; use a log with truth, such as a simulated one"
            )
        return (*super().static(topics), self.truth)

    @property
    def why_in_sequence(self) -> str:
        """See `Filter.why_in_sequence`."""
        return "a bound is only defined for messages in the order of their stamps"

    def start(self, static: Mapping[str, Ragged]) -> FilterState:
        """Make the initial state of every run from its prior; see `Filter.start`."""
        state = super().start(static)
        _, covariance = state.carried.belief
        runs, t, _ = covariance.shape
        kept = BoundHistory(static[self.truth], np.zeros(runs, bool))
        mean = self.truths(kept.truth, state.carried.time_ns, np.arange(runs + 1))
        unit, none = np.tile(np.eye(t), (runs, 1, 1)), np.zeros((2, runs, t, t))
        trajectory = TrueTrajectory(mean, covariance, unit, *none)
        return state._replace(carried=state.carried._replace(belief=trajectory), kept=kept)

    def truths(self, truth: Ragged, time_ns: Integers, offsets: Integers) -> Floats:
        """Return the true states (n, components) at stamps of the runs; NaN if unknown."""
        components = self.bound_model.model.state
        columns = match_components(truth.stream.metadata, components, f"topic {self.truth}")
        found = np.full((len(time_ns), len(components)), np.nan)
        for run in range(truth.runs):
            own, rows = truth.of_run(run), slice(int(offsets[run]), int(offsets[run + 1]))
            if len(own):
                known = replace(own, columns={"state": own["state"][:, columns]})
                kinds, limit_s = list(components.values()), self.parameters.gap_limit_s
                found[rows] = truth_at(known, time_ns[rows], kinds, limit_s)
        return found

    def filtered(
        self, state: FilterState, events: FilterEvents
    ) -> tuple[FilterState, tuple[EstimatesToFill, Integers], list[Ragged]]:
        """Process events with the truth at each event."""
        truths = self.truths(state.kept.truth, events.time_ns, events.offsets)
        after, nodes, made = super().filtered(state._replace(generators=(truths,)), events)
        failures = [each for each in made if each.stream.schema is schemas.FAILURE]
        return after._replace(generators=()), nodes, failures

    def parts(
        self,
        generators: tuple[Samples, ...],
        events: FilterEvents,  # noqa: ARG002
    ) -> Iterator[tuple["RowSlice | None", Callable[[], CoreMemory]]]:
        """Yield all runs, and the function that makes a core's working memory, including the truths."""
        yield None, partial(self.steps.memory, generators)

    def no_results(
        self, due: Integers, recorded: Integers, innovation_size: int
    ) -> tuple[EstimatesToFill, InnovationRows]:
        """Allocate arrays for nodes and innovations."""
        estimates, innovations = super().no_results(due, recorded, innovation_size)
        steps = (np.empty_like(estimates.covariance) for _ in range(3))
        return Nodes(*estimates, *steps), innovations

    def follow(self, state: FilterState, events: FilterEvents) -> tuple[FilterState, list[Ragged]]:
        """Process events; nodes to smooth are stored until the end."""
        before, kept = state.carried, state.kept
        after, (nodes, offsets), made = self.filtered(state, events)
        kept, first = self.begun(before, kept, nodes, offsets)
        made += [first, self.step_stream(nodes, offsets)]
        if self.parameters.of == "smoother":
            kept = kept._replace(nodes=(*kept.nodes, (nodes, offsets)))
        else:
            made.append(self.states(EstimateRows(*nodes[:4]), offsets))
        return after._replace(kept=kept), made

    def finish(self, state: FilterState) -> list[Ragged]:
        """Process the events that still wait, and smooth the nodes if requested."""
        state, made = self.ended(state)
        if self.parameters.of == "smoother" and state.kept.nodes:
            made.append(self.smoothed(state.kept.nodes))
        return made

    def smoothed(self, pieces: Sequence[tuple[Nodes, Integers]]) -> Ragged:
        """Return the smoothed estimates at all nodes, run by run."""
        runs, t = len(pieces[0][1]) - 1, self.bound_model.model.tangent
        parts = [
            [column[rows[run] : rows[run + 1]] for column in nodes[1:6]]
            for run in range(runs)
            for nodes, rows in pieces
        ]
        times, mean, covariance, transition, noise = map(np.concatenate, zip(*parts, strict=True))
        offsets = np.sum([rows for _, rows in pieces], axis=0)
        smooth_over_runs()(runs, offsets, transition, noise, covariance, scratch=partial(back_memory, t))
        return self.states(EstimateRows(offsets[1:], times, mean, covariance), offsets)

    def states(self, estimates: EstimateRows, offsets: Integers) -> Ragged:
        """Make the stream of true states, each with the bound of the covariance."""
        found = super().states(estimates, offsets)
        metadata = {**found.stream.metadata, "bound": self.parameters.of}
        return Ragged(replace(found.stream, metadata=metadata), found.offsets)

    def begun(
        self, before: RecursionState, kept: BoundHistory, nodes: Nodes, offsets: Integers
    ) -> tuple[BoundHistory, Ragged]:
        """Make the steps to the priors, for runs that have now reached their first node.

        The noise of such a step is the prior's covariance. If the first node has the stamp of the prior,
        the step to the prior replaces the step to that node.
        """
        first, is_new = offsets[:-1], ~kept.has_begun & (np.diff(offsets) > 0)
        is_there = is_new.copy()
        is_there[is_new] = nodes.time_ns[first[is_new]] == before.time_ns[is_new]
        nodes.transition[first[is_there]] = 0.0
        nodes.noise[first[is_there]] = before.belief.covariance[is_there]
        output_streams = is_new & ~is_there
        noise, mean = before.belief.covariance[output_streams], before.belief.mean[output_streams]
        none = np.zeros_like(noise)
        rows = np.append(0, np.cumsum(output_streams))
        steps = Nodes(rows[1:], before.time_ns[output_streams], mean, noise, none, noise, none)
        return kept._replace(has_begun=kept.has_begun | is_new), self.step_stream(steps, rows)

    def step_stream(self, nodes: Nodes, offsets: Integers) -> Ragged:
        """Make the stream of the steps to nodes."""
        t = self.bound_model.model.tangent
        stream = make_stream(
            f"/estimates/{self.name}/step",
            schemas.BOUND_STEP,
            nodes.time_ns,
            metadata={**named(self.bound_model.model.state), "bound": self.parameters.of},
            transition=nodes.transition.reshape(-1, t * t),
            noise=nodes.noise.reshape(-1, t * t),
            information=nodes.information.reshape(-1, t * t),
        )
        return Ragged(stream, offsets)


POSTERIOR_BOUND = Method(
    "posterior Cramer-Rao bound; bound applies to filters, bound:smoother to smoothers",
    BoundParameters,
    bound_steps,
    lacks=FILTERS["ekf"].lacks,
    variant="of",
    filtering=BoundFilter,
)
