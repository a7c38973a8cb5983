"""The posterior Cramer-Rao bound: what the measurements say of the state along its true course.

At every node, a stamp that has an estimate, stands what the extended Kalman filter would have that
linearises at the truth, of the filter (`bound`) or of the smoother (`bound:smoother`): the covariance
along this one trajectory. It needs no inverse of the process noise, which may be singular. Beside it go
the steps themselves, of which `replay.judging.consistency.bounds` makes the bound over an ensemble.

Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5), 1998.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import PositiveFloat

from recorders.errors import BadInput
from recorders.log import Topic, make_stream, schemas
from replay.engine.arrays import Booleans, Floats, Function, Integers
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.streams.blocks import Ragged
from replay.engine.streams.results import named
from replay.engine.vectors.components import match_components
from replay.engine.vectors.tangent import truth_at
from replay.inference.kalman.methods import FILTERS, Method, MethodParameters
from replay.inference.kalman.predict import motion_derivative, motion_noise
from replay.inference.kalman.steps import (
    NO_TRUTH,
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    Note,
    Steps,
    Workspace,
    workspace,
)
from replay.inference.kalman.update import linear_sensor, sensor_noise
from replay.inference.linear_algebra.gaussian import (
    cholesky,
    kalman_step,
    keep_measured,
    moved_covariance,
    multiply_into,
    reduce_covariance,
    solve_semidefinite,
    whiten,
)
from replay.inference.linear_algebra.tuples import tuple_of
from replay.inference.model.stage import Stage
from replay.inference.run.filtering import Filter, State
from replay.inference.run.recursion import Carried, Estimates, Happenings, Innovations


class BoundParameters(MethodParameters):
    """The bound of filters or of smoothers, and the longest gap over which the truth is interpolated."""

    of: Literal["filter", "smoother"] = "filter"
    gap_limit_s: PositiveFloat = 0.2


class Along(NamedTuple):
    """What is carried along the true trajectories; first axis = run.

    Attributes:
        mean: (runs, n) the true state.
        covariance: (runs, t, t) what a filter that linearises there has.
        transition, noise: (runs, t, t) since the last node.
        information: (runs, t, t) of what was measured since then: the sum of H' R^-1 H.
    """

    mean: Floats
    covariance: Floats
    transition: Floats
    noise: Floats
    information: Floats


class Nodes(NamedTuple):
    """Estimates as the recursion fills them in, with the step to each; see `Along`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    transition: Floats
    noise: Floats
    information: Floats


class BoundMemory(NamedTuple):
    """What one core works in: the true states at all events (events, n), and noise (m, m) by sensor."""

    truth: Floats
    noise: tuple[Floats, ...]
    work: Workspace


def bound_steps(stage: Stage) -> Steps:
    """The steps of an extended Kalman filter that knows where it is."""
    model, motion = stage.model, stage.motion
    n, t = model.size, model.tangent
    read_state, read_control = tuple_of(n), tuple_of(model.controls)
    linearise = motion_derivative(model, motion, by_state=True)
    add_noise = motion_noise(model, motion)

    def predict(
        run: int,
        along: Along,
        control: Floats,
        duration_s: float,
        parameters: Any,
        event: int,
        memory: BoundMemory,
    ) -> bool:
        mean, work = along.mean[run], memory.work
        state = read_state(mean)
        linearise(state, read_control(control), duration_s, parameters, work)
        multiply_into(work.transition, along.transition[run], work.product)
        moved_covariance(along.noise[run], work.transition, work.product)
        add_noise(state, along.noise[run], duration_s, parameters, work)
        moved_covariance(along.covariance[run], work.transition, work.product)
        add_noise(state, along.covariance[run], duration_s, parameters, work)
        for i in range(n):
            mean[i] = memory.truth[event, i]
        return True

    def estimate(run: int, along: Along, nodes: Nodes, row: int, _: Any) -> None:
        for i in range(n):
            nodes.mean[row, i] = along.mean[run, i]
        for i in range(t):
            for j in range(t):
                nodes.covariance[row, i, j] = along.covariance[run, i, j]
                nodes.transition[row, i, j] = along.transition[run, i, j]
                nodes.noise[row, i, j] = along.noise[run, i, j]
                nodes.information[row, i, j] = along.information[run, i, j]
                along.transition[run, i, j] = 1.0 if i == j else 0.0
                along.noise[run, i, j] = along.information[run, i, j] = 0.0

    def memory(sets: tuple[Any, ...]) -> BoundMemory:
        sizes = [len(sensor.measured) for sensor in stage.sensors] or [0]
        return BoundMemory(sets[0], tuple(np.empty((m, m)) for m in sizes), workspace(stage))

    updates = tuple(_update(stage, number) for number in range(len(stage.sensors)))
    return Steps(memory, predict, updates, estimate)


def _update(stage: Stage, number: int) -> Function:
    """The update by sensor `number` as if it had measured what is predicted: nothing moves."""
    innovate, add_noise = linear_sensor(stage, number), sensor_noise(stage.sensors[number])
    m = len(stage.sensors[number].measured)

    def update(
        run: int,
        along: Along,
        data: Floats,
        parameters: Any,
        gate: Floats,
        event: int,
        memory: BoundMemory,
        note: Note,
    ) -> int:
        mean, covariance, work = along.mean[run], along.covariance[run], memory.work
        if np.isnan(mean[0]):
            return NO_TRUTH
        innovate(mean, covariance, data, parameters, event, work)
        innovation, noise = work.innovations[number], memory.noise[number]
        for i in range(m):
            for j in range(m):
                noise[i, j] = 0.0
        add_noise(noise, data, parameters, work)
        size = 0
        for i in range(m):
            if not np.isnan(innovation.difference[i]):
                for k in range(len(covariance)):
                    work.rows[size, k] = work.rows[i, k]
                for j in range(m):
                    noise[size, j] = noise[i, j]
                for j in range(m):
                    noise[j, size] = noise[j, i]
                size += 1
        add_information(along.information[run], work.rows, noise, size)
        keep_measured(innovation)
        for i in range(size):
            innovation.difference[i] = 0.0
        if np.isnan(whiten(innovation, size)[0]):
            return NOT_POSITIVE_DEFINITE
        kalman_step(innovation, size, work.step)
        reduce_covariance(covariance, innovation.cross_covariance, size)
        return NOTHING_MEASURED  # there is no innovation to tell of

    return update


def add_information(information: Floats, rows: Floats, noise: Floats, size: int) -> None:
    """Add H' R^-1 H of the first rows; R becomes its factor. NaN where R is not positive definite."""
    t = len(information)
    if not cholesky(noise, noise, size):
        information[0, 0] = np.nan
    for i in range(size):
        for k in range(t):
            for j in range(i):
                rows[i, k] -= noise[i, j] * rows[j, k]
            rows[i, k] /= noise[i, i]
        for row in range(t):
            for column in range(t):
                information[row, column] += rows[i, row] * rows[i, column]


class BackMemory(NamedTuple):
    """What the way back of one core works in: four matrices (t, t)."""

    predicted: Floats
    turned: Floats
    factor: Floats
    product: Floats


def back_memory(t: int) -> BackMemory:
    """Memory for the way back of states with t components in the tangent space."""
    return BackMemory(*(np.empty((t, t)) for _ in BackMemory._fields))


@lru_cache(maxsize=1)
def _smoothing() -> Function:
    return compile_over_runs(smooth, allocates=False, title="the bound of smoothers")


def smooth(
    run: int,
    offsets: Integers,
    transition: Floats,
    noise: Floats,
    covariance: Floats,
    memory: BackMemory,
) -> None:
    """Make covariances (nodes, t, t) of a filter those of its smoother along one trajectory, in place.

    With the gain G = P F' P-^-1, each is P + G (Ps - P-) G', Ps being that of the node after it.
    """
    predicted, turned, factor, product = memory
    for node in range(offsets[run + 1] - 2, offsets[run] - 1, -1):
        here, later, step = covariance[node], covariance[node + 1], transition[node + 1]
        for row in range(len(here)):
            for column in range(len(here)):
                predicted[row, column] = here[row, column]
        moved_covariance(predicted, step, turned)  # which becomes F P
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
        moved_covariance(predicted, factor, product)
        for row in range(len(here)):
            for column in range(len(here)):
                here[row, column] += predicted[row, column]


class Kept(NamedTuple):
    """What is kept: the truths of all runs, which came to a node (runs,), and nodes to smooth."""

    truth: Ragged
    has_begun: Booleans
    nodes: tuple[tuple[Nodes, Integers], ...] = ()


class BoundFilter(Filter):
    """A filter that knows the truth, and tells of every step of it."""

    def whole(self, topics: Mapping[str, Topic]) -> tuple[str, ...]:
        """The topics of a log that it starts from; raises BadInput where it has no truth."""
        if self.truth not in topics:
            raise BadInput(
                f"estimator {self.name}: a bound needs the true states, and there is no topic "
                f"{self.truth}; give a log with a truth, such as a simulated one"
            )
        return (*super().whole(topics), self.truth)

    @property
    def cannot_rewind(self) -> str:
        """See `Filter.cannot_rewind`."""
        return "a bound is that of all messages in the order of their stamps"

    def start(self, whole: Mapping[str, Ragged]) -> State:
        """The state at every run's prior, see `Filter.start`."""
        state = super().start(whole)
        _, covariance = state.carried.belief
        runs, t, _ = covariance.shape
        kept = Kept(whole[self.truth], np.zeros(runs, bool))
        mean = self.truths(kept.truth, state.carried.time_ns, np.arange(runs + 1))
        unit, none = np.tile(np.eye(t), (runs, 1, 1)), np.zeros((2, runs, t, t))
        along = Along(mean, covariance, unit, *none)
        return state._replace(carried=state.carried._replace(belief=along), kept=kept)

    def truths(self, truth: Ragged, time_ns: Integers, offsets: Integers) -> Floats:
        """The true states (n, components) at stamps of the runs; NaN where there is none."""
        components = self.stage.model.state
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
        self, state: State, happenings: Happenings
    ) -> tuple[State, tuple[Any, Integers], list[Ragged]]:
        """Go through events, with the truths at all of them."""
        truths = self.truths(state.kept.truth, happenings.time_ns, happenings.offsets)
        after, nodes, made = super().filtered(state._replace(generators=(truths,)), happenings)
        failures = [each for each in made if each.stream.schema is schemas.FAILURE]
        return after._replace(generators=()), nodes, failures

    def sets(self, generators: tuple[Any, ...], happenings: Happenings) -> Any:
        """All runs, and the truths."""
        yield slice(0, len(happenings.offsets) - 1), generators

    def no_results(self, due: Integers, noted: Integers, slots: int) -> tuple[Any, Innovations]:
        """Nodes and innovations to be filled in."""
        estimates, innovations = super().no_results(due, noted, slots)
        steps = (np.empty_like(estimates.covariance) for _ in range(3))
        return Nodes(*estimates, *steps), innovations

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Go through events; smoothed covariances have to wait for the end."""
        before, kept = state.carried, state.kept
        after, (nodes, offsets), made = self.filtered(state, happenings)
        kept, first = self.begun(before, kept, nodes, offsets)
        made += [first, self.steps_told(nodes, offsets)]
        if self.parameters.of == "smoother":
            kept = kept._replace(nodes=(*kept.nodes, (nodes, offsets)))
        else:
            made.append(self.states(Estimates(*nodes[:4]), offsets))
        return after._replace(kept=kept), made

    def finish(self, state: State) -> list[Ragged]:
        """What waited for a control that does not come any more, and what is smoothed."""
        state, made = self.ended(state)
        if self.parameters.of == "smoother" and state.kept.nodes:
            made.append(self.smoothed(state.kept.nodes))
        return made

    def smoothed(self, pieces: Sequence[tuple[Nodes, Integers]]) -> Ragged:
        """The estimates at all nodes, run by run."""
        runs, t = len(pieces[0][1]) - 1, self.stage.model.tangent
        parts = [
            [column[rows[run] : rows[run + 1]] for column in nodes[1:6]]
            for run in range(runs)
            for nodes, rows in pieces
        ]
        times, mean, covariance, transition, noise = map(np.concatenate, zip(*parts, strict=True))
        offsets = np.sum([rows for _, rows in pieces], axis=0)
        _smoothing()(runs, offsets, transition, noise, covariance, scratch=partial(back_memory, t))
        return self.states(Estimates(offsets[1:], times, mean, covariance), offsets)

    def states(self, estimates: Estimates, offsets: Integers) -> Ragged:
        """The stream of true states, each with what is known of it there."""
        found = super().states(estimates, offsets)
        metadata = {**found.stream.metadata, "bound": self.parameters.of}
        return Ragged(replace(found.stream, metadata=metadata), found.offsets)

    def begun(self, before: Carried, kept: Kept, nodes: Nodes, offsets: Integers) -> tuple[Kept, Ragged]:
        """The steps to the priors of runs that come to their first node: from nothing.

        The noise of such a step is the prior's covariance. Where the first node has the prior's stamp,
        it is the one that comes from nothing.
        """
        first, is_new = offsets[:-1], ~kept.has_begun & (np.diff(offsets) > 0)
        is_there = is_new.copy()
        is_there[is_new] = nodes.time_ns[first[is_new]] == before.time_ns[is_new]
        nodes.transition[first[is_there]] = 0.0
        nodes.noise[first[is_there]] = before.belief.covariance[is_there]
        told = is_new & ~is_there
        noise, mean = before.belief.covariance[told], before.belief.mean[told]
        none = np.zeros_like(noise)
        rows = np.append(0, np.cumsum(told))
        steps = Nodes(rows[1:], before.time_ns[told], mean, noise, none, noise, none)
        return kept._replace(has_begun=kept.has_begun | is_new), self.steps_told(steps, rows)

    def steps_told(self, nodes: Nodes, offsets: Integers) -> Ragged:
        """The stream of the steps to nodes."""
        t = self.stage.model.tangent
        stream = make_stream(
            f"/estimates/{self.name}/step",
            schemas.BOUND_STEP,
            nodes.time_ns,
            metadata={**named(self.stage.model.state), "bound": self.parameters.of},
            transition=nodes.transition.reshape(-1, t * t),
            noise=nodes.noise.reshape(-1, t * t),
            information=nodes.information.reshape(-1, t * t),
        )
        return Ragged(stream, offsets)


POSTERIOR_BOUND = Method(
    "posterior Cramer-Rao bound, which no filter gets below; that of smoothers is bound:smoother",
    BoundParameters,
    bound_steps,
    lacks=FILTERS["ekf"].lacks,
    variant="of",
    filtering=BoundFilter,
)
