"""The iterated smoother: the states of a whole run that are most probable, given all measurements.

It minimises, over the state at the prior's time and at every stamp after it,

    1/2 |x_0 (-) m_0|^2_P0 + 1/2 sum |x_k (-) f(x_(k-1))|^2_Q + sum rho(|y (-) h(x_k)|_R)

by Gauss-Newton. A step is an affine filter and the way back over it, with motion and sensors linearised
at the latest trajectory; the unknowns are the tangent vectors d_k from there, which lie in flat space:

    d_k = E(-r) F d_(k-1) - r + noise of covariance Jr(r) Q Jr(r)',   r = x_k (-) f(x_(k-1))

with the rotation E and the right Jacobian Jr, units but for orientations. No inverse of Q is needed:
where it is singular, x_k keeps to what noise can reach, and the cost is that of the noise. Where a step
would raise the cost it is taken again, damped (Levenberg and Marquardt): every state is measured as it
stands, with the start's variances over the damping. A robust rho takes part by reweighting.

Bell, SIAM J. Optim. 4(3), 1994; Sarkka and Svensson, ICASSP 2020.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial, reduce
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from recorders.errors import BadInput
from recorders.log import make_stream, schemas
from replay.engine.arrays import Booleans, Floats, Function, Integers
from replay.engine.blocks import Ragged, copied, ragged_rows
from replay.engine.compile import compile_over_runs
from replay.engine.components import Components
from replay.engine.results import ALL_WELL
from replay.inference import smoothers
from replay.inference.binding import number_fields, reading_settings
from replay.inference.estimators import State
from replay.inference.gaussian import keep_measured, moved_covariance, whiten, wrap
from replay.inference.generate import differencing, is_flat, resetting, retraction, tuple_of
from replay.inference.happenings import data_columns, joined, last_of_stamps, of_rows, times_alone
from replay.inference.methods import FILTERS, Method
from replay.inference.recursion import (
    NOTHING,
    Carried,
    Estimates,
    Happenings,
    Innovations,
    no_results,
    recursion,
)
from replay.inference.smoothers import (
    FOREVER_NS,
    Chain,
    ForwardMemory,
    Later,
    Nodes,
    Piece,
    Smoother,
    SmootherParameters,
    back_memory,
    no_later,
    smoothing_steps,
    way_back,
)
from replay.inference.steps import (
    Gaussian,
    Stage,
    Steps,
    Workspace,
    gaussian_filter,
    kalman_update,
    linear_innovation,
    motion_derivative,
    motion_noise,
    reading,
    sensor_derivative,
    sensor_noise,
    slots_of,
    workspace,
)

LOSSES = ("square", "huber", "cauchy")
SETTLED = 1e-10  # the largest last step, in standard deviations; and what of a state is round-off
ROUNDING = 1e-15
COST_ROUNDING = 1e-6  # of one, or of the cost itself where larger: noise may depend on the state
NOTHING_LEFT = 1e-12  # of a variance, beside what other components say of it
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e12


class IteratedParameters(SmootherParameters):
    """Of `smoother:iterated`: where the search starts, how it is damped, what outliers cost.

    `start` is the extended filter smoothed once, the prior's mean moved along, or that mean everywhere.
    `damping` is that of the first step: the information that holds a state where it is, in units of what
    the start has of it; without any, Gauss-Newton is damped only where its cost would rise. With `huber`
    and `cauchy` a measurement whose whitened residual is longer than `loss_scale` counts less.
    """

    start: Literal["smoother", "motion", "prior"] = "smoother"
    damping: NonNegativeFloat = 0.0
    loss: Literal["square", "huber", "cauchy"] = "square"
    loss_scale: PositiveFloat = 1.345
    iterations: Annotated[PositiveInt, Field(le=1000)] = 50


# One pass: the affine filter about a trajectory


class Trajectory(NamedTuple):
    """Where everything is linearised, and what a pass over it finds.

    Attributes:
        mean: (nodes, n) the states.
        kept: (nodes, n) the best ones so far, whose noise says whether these are better.
        node: (events,) of every event the node of its stamp.
        scale: (nodes, t) variances of the start; over the damping those of the states as they stand.
        loss: (2,) an index of LOSSES, and its scale.
        damping: (1,) of this pass.
        cost, held: (1,) of the trajectory, with the noise as it is there and as it is at `kept`.
        noise, factor: (t, t) the covariance of a step, and its factor, see `factor_by_pivots`.
        order, rank: (t,), (1,) of the factor.
        offset, column: (1, t), (t,).
    """

    mean: Floats
    kept: Floats
    node: Integers
    scale: Floats
    loss: Floats
    damping: Floats
    cost: Floats
    held: Floats
    noise: Floats
    factor: Floats
    order: Integers
    rank: Integers
    offset: Floats
    column: Floats


def iterated_steps(stage: Stage) -> Steps:
    """The steps of the affine filter about a `Trajectory`, the only one of `memory`'s sets."""
    model = stage.model
    flat: Components = {f"d{number}": "linear" for number in range(model.tangent)}
    steps = gaussian_filter(
        stage,
        affine_motion(stage),
        tuple(
            kalman_update(stage._replace(model=replace(model, state=flat)), number, innovate)
            for number, innovate in enumerate(
                map(partial(affine_sensor, stage), range(len(stage.sensors)))
            )
        ),
        partial(workspace, stage),
    )
    chained = smoothing_steps(stage, steps)
    advance, hold = chained.predict, damped

    def predict(
        run: int,
        belief: Chain,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        memory: ForwardMemory,
    ) -> bool:
        if not advance(run, belief, control, duration_s, parameters, use, memory):
            return False
        trajectory = memory.filter.samples[0]
        hold(belief.mean[run], belief.covariance[run], trajectory, trajectory.node[use])
        return True

    return chained._replace(predict=predict)


def damped(mean: Floats, covariance: Floats, trajectory: Trajectory, node: int) -> None:
    """Measure every component of the state as it stands, one after the other."""
    damping, column = trajectory.damping[0], trajectory.column
    if damping == 0.0:
        return
    for component in range(len(mean)):
        spread = covariance[component, component] + trajectory.scale[node, component] / damping
        if not spread > 0.0:
            continue
        for row in range(len(mean)):
            column[row] = covariance[row, component]
        share = mean[component] / spread
        for row in range(len(mean)):
            mean[row] -= column[row] * share
            for k in range(row + 1):
                covariance[row, k] -= column[row] * column[k] / spread
                covariance[k, row] = covariance[row, k]


def affine_motion(stage: Stage) -> Function:
    """Prediction of the tangent vector at one stamp to that at the next."""
    model, motion = stage.model, stage.motion
    linearise = motion_derivative(model, motion, by_state=True)
    add_noise, reach = motion_noise(model, motion), reaching(model.kinds)
    noise_enters = bool(motion.noises) or motion.control_noise is not None
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    flat, carry = is_flat(model.kinds), carrying(model.kinds)
    turn = resetting(model.kinds)

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        work: Workspace,
    ) -> bool:
        trajectory, step = work.samples[0], work.step
        node, noise, offset = trajectory.node[use], trajectory.noise, trajectory.offset[0]
        state = read_state(trajectory.mean[node - 1])
        linearise(state, read_control(control), duration_s, parameters, work)
        noise[:] = 0.0
        add_noise(state, noise, duration_s, parameters, work)
        squared = reach(trajectory, node, work.state)
        trajectory.cost[0] += 0.5 * squared
        if not flat:
            turn(offset, noise)
            turn(offset, noise.T)
            carry(offset, work.transition, step)
        for row in range(len(step)):
            step[row] = -offset[row]
            for k in range(len(step)):
                step[row] += work.transition[row, k] * mean[k]
        moved_covariance(covariance, work.transition, work.product)
        for row in range(len(step)):
            mean[row] = step[row]
            for column in range(len(step)):
                covariance[row, column] += noise[row, column]
        state = read_state(trajectory.kept[node - 1])
        if noise_enters:
            linearise(state, read_control(control), duration_s, parameters, work)
        noise[:] = 0.0
        add_noise(state, noise, duration_s, parameters, work)
        held = whitened_square(trajectory)
        trajectory.held[0] += 0.5 * held
        return not np.isnan(squared + held)

    return predict


def carrying(kinds: tuple[str, ...]) -> Function:
    """`carry(offset, rows, step)`: E(-offset) times rows (t, m), by way of `step`.

    Takes tangent vectors at one state to those at the state that lies `offset` from it.
    """
    turn, turn_back = resetting(kinds), resetting(kinds, back=True)

    def carry(offset: Floats, rows: Floats, step: Floats) -> None:
        for row in range(len(step)):
            step[row] = -offset[row]
        turn_back(step, rows)
        turn(offset, rows)

    return carry


def reaching(kinds: tuple[str, ...]) -> Function:
    """`reach(trajectory, node, origin)`: how far a state is from where it comes from.

    Fills `offset` and returns its square in units of `noise`, see `whitened_square`. Where noise has no
    part the state is moved to what it can reach.
    """
    add, subtract = retraction(kinds), differencing(kinds)

    def reach(trajectory: Trajectory, node: int, origin: Floats) -> float:
        offset, factor, order = trajectory.offset[0], trajectory.factor, trajectory.order
        subtract(trajectory.mean[node], origin, trajectory.offset, 0)
        squared = whitened_square(trajectory)
        rank = trajectory.rank[0]
        if 0 <= rank < len(offset):
            for k in range(rank, len(offset)):
                offset[order[k]] = 0.0
                for j in range(rank):
                    offset[order[k]] += factor[order[k], j] * trajectory.column[j]
            for row in range(len(origin)):
                trajectory.mean[node, row] = origin[row]
            add(trajectory.mean[node], offset)
        return squared

    return reach


def whitened_square(trajectory: Trajectory) -> float:
    """The square of `offset` in units of `noise`, NaN where that is no covariance.

    What noise has no part in does not count. Fills `factor`, `order`, `rank`, and the whitened offset
    into `column`.
    """
    factor, order, whitened = trajectory.factor, trajectory.order, trajectory.column
    rank = factor_by_pivots(trajectory.noise, factor, order, whitened)
    trajectory.rank[0] = rank
    squared = 0.0 if rank >= 0 else np.nan
    for k in range(rank):
        entry = trajectory.offset[0, order[k]]
        for j in range(k):
            entry -= factor[order[k], j] * whitened[j]
        whitened[k] = entry / factor[order[k], k]
        squared += whitened[k] ** 2
    return squared


def factor_by_pivots(matrix: Floats, factor: Floats, order: Integers, left: Floats) -> int:
    """Cholesky's factor of a positive semidefinite matrix: its rank, or -1 where it is none.

    The row with the largest share of its diagonal entry left comes next; shares below NOTHING_LEFT are
    round-off. Fills `order`, and `factor` (t, rank), whose row order[k] ends in column k.
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


def affine_sensor(stage: Stage, number: int) -> Function:
    """`innovate` of sensor `number` about the trajectory, see `steps.kalman_update`."""
    model, sensor = stage.model, stage.sensors[number]
    m, angular = len(sensor.measured), tuple(kind == "angle" for kind in sensor.measured.values())
    read_state, read_about = tuple_of(model.size), reading(sensor).about
    linearise, compare = sensor_derivative(model, sensor), linear_innovation(sensor, number)
    add_noise, noise_enters = sensor_noise(sensor), sensor.noises > 0

    def fill_noise(data: Floats, parameters: Any, work: Workspace) -> None:
        innovation = work.innovations[number]
        innovation.covariance[:] = 0.0
        add_noise(innovation.covariance, data, parameters, work)

    def square(data: Floats, work: Workspace) -> float:
        """The squared residual in units of the noise that was filled in; uses both up."""
        innovation = work.innovations[number]
        for i in range(m):
            innovation.difference[i] = wrap(data[i] - work.predicted[i], angular[i])
        squared, _ = whiten(innovation, keep_measured(innovation))
        return squared

    def innovate(
        mean: Floats, covariance: Floats, data: Floats, parameters: Any, use: int, work: Workspace
    ) -> bool:
        trajectory, node, about = work.samples[0], work.samples[0].node[use], read_about(data)
        if noise_enters:
            linearise(read_state(trajectory.kept[node]), about, parameters, work)
            fill_noise(data, parameters, work)
        linearise(read_state(trajectory.mean[node]), about, parameters, work)
        held = square(data, work) if noise_enters else 0.0
        fill_noise(data, parameters, work)
        squared = square(data, work)
        cost, weight = robust(squared, trajectory.loss)
        trajectory.cost[0] += cost
        trajectory.held[0] += robust(held, trajectory.loss)[0] if noise_enters else cost
        innovation, root = work.innovations[number], np.sqrt(weight)
        for i in range(m):
            for k in range(len(mean)):
                work.rows[i, k] *= root
        compare(covariance, data, parameters, work)
        for i in range(m):
            innovation.difference[i] *= root
            for k in range(len(mean)):
                innovation.difference[i] -= work.rows[i, k] * mean[k]
        return not np.isnan(squared + held)

    return innovate


def robust(squared: float, loss: Floats) -> tuple[float, float]:
    """The cost of a residual whose square is given, and the weight that has its derivative."""
    bound = loss[1] ** 2
    if loss[0] == 1.0 and squared > bound:
        length = np.sqrt(squared)
        return loss[1] * (length - 0.5 * loss[1]), loss[1] / length
    if loss[0] == 2.0:
        return 0.5 * bound * np.log1p(squared / bound), 1.0 / (1.0 + squared / bound)
    return 0.5 * squared, 1.0


# The search


class Plan(NamedTuple):
    """What a search is given: the prior (first axis = run), what drives before the first control.

    And the rows of innovations from which each run may write, the first damping, the most passes.
    """

    prior: Gaussian
    start_ns: Integers
    initial: Floats
    first: Integers
    damping: float
    passes: int


class Ended(NamedTuple):
    """How the searches ended: passes, and whether converged (runs,).

    Of every pass the cost, the damping and the largest step in standard deviations (runs, passes, 3).
    """

    passes: Integers
    converged: Integers
    told: Floats


@lru_cache(maxsize=64)
def _search(stage: Stage) -> tuple[Function, Steps]:
    steps = iterated_steps(stage)
    settings_of = reading_settings(number_fields(stage.model.parameters))
    return compile_over_runs(search(stage, steps, settings_of), allocates=False), steps


def search(stage: Stage, steps: Steps, settings_of: Function) -> Function:
    """The search of one run's trajectory, for `replay.engine.compile.compile_over_runs`."""
    kinds, n, t = stage.model.kinds, stage.model.size, stage.model.tangent
    follow, go_back = recursion(stage, steps, settings_of), way_back(("linear",) * t)
    add, reach, turn = retraction(kinds), reaching(kinds), resetting(kinds)
    flat, hold = is_flat(kinds), damped

    def go_forward(
        run: int,
        happenings: Happenings,
        settings: Floats,
        gates: Floats,
        plan: Plan,
        carried: Carried,
        nodes: Nodes,
        offsets: Integers,
        innovations: Innovations,
        memory: ForwardMemory,
    ) -> bool:
        """Filter about the trajectory, and sum its cost; whether all went well."""
        trajectory, belief, begin = memory.filter.samples[0], carried.belief, offsets[run]
        mean, covariance = belief.mean[run], belief.covariance[run]
        for row in range(t):
            for column in range(t):
                entry = plan.prior.covariance[run, row, column]
                covariance[row, column] = trajectory.noise[row, column] = entry
        squared = reach(trajectory, begin, plan.prior.mean[run])
        trajectory.cost[0] = trajectory.held[0] = 0.5 * squared
        if not flat:
            turn(trajectory.offset[0], covariance)
            turn(trajectory.offset[0], covariance.T)
        for row in range(t):
            mean[row] = belief.predicted[run, row] = -trajectory.offset[0, row]
        belief.predictions[run] = 0
        hold(mean, covariance, trajectory, begin)
        for row in range(len(plan.initial)):
            carried.control[run, row] = plan.initial[row]
        carried.time_ns[run], carried.failure[run] = plan.start_ns[run], ALL_WELL
        nodes.end[run], innovations.end[run] = begin, plan.first[run]
        follow(run, happenings, settings, gates, carried, nodes, innovations, memory)
        whole = carried.failure[run] == ALL_WELL and nodes.end[run] == offsets[run + 1]
        return whole and np.isfinite(trajectory.cost[0] + trajectory.held[0])

    def move(
        trajectory: Trajectory, kept: Floats, steps: Floats, begin: int, end: int
    ) -> tuple[float, float, bool]:
        """Move the trajectory from what is kept.

        Returns the largest step, the sum of their squares, both in standard deviations of the start, and
        whether these are nothing any more.
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
        happenings: Happenings,
        settings: Floats,
        gates: Floats,
        plan: Plan,
        carried: Carried,
        nodes: Nodes,
        offsets: Integers,
        innovations: Innovations,
        later: Later,
        kept: Floats,
        smoothed: Estimates,
        ended: Ended,
        scratch: Any,
    ) -> None:
        """Move `kept` (nodes, n) to the best trajectory of run `run`; the covariances go with it."""
        memory, back = scratch
        trajectory, begin, end = memory.filter.samples[0], offsets[run], offsets[run + 1]
        ended.passes[run] = ended.converged[run] = 0
        best, damping, again, last = np.inf, plan.damping, False, False
        taken, promised = (
            0.0,
            0.0,
        )  # the damping of the last step, and a gain that it must not miss by far
        while begin < end:
            trajectory.damping[0] = damping
            well = go_forward(
                run, happenings, settings, gates, plan, carried, nodes, offsets, innovations, memory
            )
            held, passes = trajectory.held[0], ended.passes[run]
            slack, poor = COST_ROUNDING * max(1.0, best), False
            if not again:
                better = well and held <= best + slack
                poor = not better or best - held < 0.25 * promised - slack
                if better:
                    best = trajectory.cost[0]
                    copy_rows(trajectory.mean, kept, begin, end)
                elif passes == 0:  # no start
                    return
            if poor:
                damping, again = max(10.0 * taken, LEAST_DAMPING), True
                taken, last = damping, damping > MOST_DAMPING
            else:
                later.is_there[run] = False
                go_back(run, nodes, offsets, offsets[1:], FOREVER_NS, later, offsets, smoothed, back)
                if last:
                    return
                largest, squares, settled = move(trajectory, kept, smoothed.mean, begin, end)
                told = ended.told[run, passes]
                told[0], told[1], told[2] = best, damping, largest
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
            if last:  # the covariances, which damping has no part in
                damping, again = 0.0, True

    return search_run


def copy_rows(these: Floats, there: Floats, begin: int, end: int) -> None:
    """Copy some rows of one array to the same of another."""
    for row in range(begin, end):
        for column in range(these.shape[1]):
            there[row, column] = these[row, column]


# As an estimator


class Way(NamedTuple):
    """Runs from their priors to their ends, as the extended smoother has them.

    Attributes:
        happenings: the events up to the last node, without those that a gate kept out.
        node: (events,) of every event the node of its stamp.
        nodes, offsets: the stamps, as the filter went through them; run r owns those from offsets[r] on.
        states: the smoothed states there.
        wanted: (nodes,) at which of them estimates are wanted.
        made: the other outputs of the filter.
    """

    happenings: Happenings
    node: Integers
    nodes: Nodes
    offsets: Integers
    states: Estimates
    wanted: Booleans
    made: list[Ragged]


class IteratedSmoother(Smoother):
    """A smoother that keeps the events of the whole run, and at the end searches their trajectory."""

    @cached_property
    def lag_ns(self) -> int:
        """The whole run."""
        return FOREVER_NS

    def follow(self, state: State, happenings: Happenings) -> tuple[State, list[Ragged]]:
        """Keep the events."""
        return state._replace(kept=(*state.kept, happenings)), []

    def finish(self, state: State) -> list[Ragged]:
        """The best trajectory, and how the search for it ended."""
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
        found = Estimates(kept.end, kept.time_ns[rows], kept.mean[rows], kept.covariance[rows])
        states = self.states(found, ragged_rows(rows, offsets))
        return [states, *way.made, *self._told(ended, way)]

    def smoothed_once(self, state: State) -> "Way":
        """The extended smoother's states at all stamps, from the prior's on."""
        happenings = reduce(joined, (*self._first(state), *state.kept))
        run = np.repeat(np.arange(len(state.tick)), np.diff(happenings.offsets))
        asked, start_ns = happenings.is_due, state.carried.time_ns
        happenings = happenings._replace(
            is_due=last_of_stamps(happenings) & (happenings.time_ns >= start_ns[run])
        )
        _, (nodes, offsets), made = self.filtered(state, happenings)
        stamp = np.cumsum(happenings.is_due) - happenings.is_due
        stamp -= np.append(stamp, 0)[happenings.offsets[run]]  # counted in each run
        known = stamp < np.diff(offsets)[run]  # a run that failed has no more
        node = offsets[run] + stamp
        wanted = np.zeros(offsets[-1], bool)
        wanted[node[asked & known]] = True
        states, _ = self.gone_back([Piece(nodes, offsets)])
        used = of_rows(self._accepted(happenings, start_ns, made), known)
        return Way(used, node[known], nodes, offsets, states, wanted, made)

    def _moved(self, state: State, way: "Way") -> Floats:
        """The prior's means, moved along all of every run as if nothing was measured."""
        unseen = np.where(way.happenings.source >= 0, NOTHING, way.happenings.source)
        _, (moved, reached), _ = self.filtered(state, way.happenings._replace(source=unseen))
        if not np.array_equal(reached, way.offsets):
            raise BadInput(
                f"estimator {self.name}: start = motion: the prior cannot be moved along all of a run; "
                "choose another start"
            )
        return moved.mean

    def _first(self, state: State) -> list[Happenings]:
        """The prior's time as an event; an interpolated control has made one already."""
        control = self.stage.model.control
        if control is not None and control.interpolated:
            return []
        runs, (width, _) = np.arange(len(state.tick) + 1), data_columns(self.stage)
        return [times_alone(runs, state.carried.time_ns.copy(), width, is_due=False)]

    def _accepted(
        self, happenings: Happenings, start_ns: Integers, made: Sequence[Ragged]
    ) -> Happenings:
        """Events without the measurements that the gate kept out on the way forward."""
        if self.parameters.gate_probability == 1.0:
            return happenings
        source = happenings.source.copy()
        told = np.zeros(len(source), bool)
        for number, sensor in enumerate(self.stage.sensors):
            measured = happenings.data[:, : len(sensor.measured)]
            told |= (source == number) & np.isfinite(measured).any(axis=1)
        [innovations] = [each for each in made if each.stream.topic.endswith("/innovation")]
        for run, (begin, end) in enumerate(pairwise(happenings.offsets)):
            accepted = innovations.of_run(run)["accepted"]
            told[begin:end] &= happenings.time_ns[begin:end] >= start_ns[run]
            events = begin + np.flatnonzero(told[begin:end])[: len(accepted)]
            source[events[accepted == 0]] = NOTHING
        return happenings._replace(source=source)

    def _search(self, state: State, way: Way, scale: Floats) -> Ended:
        """Search the trajectories of all runs from the way's states, which they replace."""
        stage, asked = self.stage, self.parameters
        happenings, nodes, offsets, kept = way.happenings, way.nodes, way.offsets, way.states
        loop, steps = _search(stage)
        t, runs, count = stage.model.tangent, len(offsets) - 1, len(kept.mean)
        noted = ragged_rows(happenings.source >= 0, happenings.offsets)
        _, innovations = no_results(offsets, noted, stage.model, len(slots_of(stage.sensors)))
        belief = state.carried.belief
        prior = Gaussian(belief.mean, belief.covariance)
        plan = Plan(
            prior,
            state.carried.time_ns,
            np.array(self.initial),
            innovations.end.copy(),
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
        trajectory = kept.mean.copy()

        def scratch() -> Any:
            own = Trajectory(
                trajectory,
                kept.mean,
                way.node,
                scale,
                loss,
                np.zeros(1),
                np.zeros(1),
                np.zeros(1),
                np.empty((t, t)),
                np.empty((t, t)),
                np.empty(t, np.int64),
                np.empty(1, np.int64),
                np.empty((1, t)),
                np.empty(t),
            )
            return steps.memory((own,)), back_memory(t, t)

        settings = np.repeat(self.settings[None], runs, axis=0)
        gates = np.full_like(self.gates, np.inf)
        loop(
            runs, happenings, settings, gates, plan, carried, vectors, offsets, innovations, later,
            kept.mean, smoothed, ended, scratch=scratch,
        )  # fmt: skip
        return ended

    def _told(self, ended: Ended, way: Way) -> list[Ragged]:
        """How the searches ended, and every pass of each, at the last node of its run."""
        asked, some = self.parameters, np.diff(way.offsets) > 0
        last_ns = np.append(way.nodes.time_ns, 0)[way.offsets[1:] - 1]
        passes, one = ended.passes, np.arange(len(some))
        cost = ended.told[one, np.maximum(passes - 1, 0), 0]
        t = self.stage.model.tangent
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
            **dict(zip(("cost", "damping", "largest_step"), ended.told[made].T, strict=True)),
        )
        return [
            Ragged(solution, np.append(0, np.cumsum(some))),
            Ragged(iterations, np.append(0, np.cumsum(passes))),
        ]


# As a method


def _solved_at_the_end(stage: Stage) -> Steps:
    """The way to the start: the extended filter's."""
    return smoothing_steps(stage, FILTERS["ekf"].steps(stage))


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
