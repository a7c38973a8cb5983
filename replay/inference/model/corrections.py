"""Corrections of a state and its covariance by a step of the tangent space, in updates and smoothers.

Each component is corrected separately (`manifold.boxplus`), unless a model defines a correction along a
curve (`model.Correction`). In both cases, the covariance is transformed between the tangent spaces of
the old and the new mean: to the new mean by the derivative of the moved state with respect to the step,
and back by the derivative of the step with respect to the moved state.
"""

from typing import Protocol

from fuselog.replay.engine.arrays import Floats, Numbers
from fuselog.replay.inference.linear_algebra.covariances import COVARIANCES, Form
from fuselog.replay.inference.linear_algebra.gaussian import propagate_covariance
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative
from fuselog.replay.inference.linear_algebra.manifold import (
    boxminus,
    boxplus,
    by_right_jacobian,
    is_flat,
    tangent_size,
)
from fuselog.replay.inference.linear_algebra.tuples import filling, tuple_of
from fuselog.replay.inference.model.functions import AlongSlope
from fuselog.replay.inference.model.model import Correction, Model
from fuselog.replay.tracing.functions import traced

Kinds = tuple[str, ...]


class CorrectionWork(Protocol):
    """Working arrays of a correction; see `kalman.steps.Workspace`."""

    @property
    def state(self) -> Floats: ...
    @property
    def step(self) -> Floats: ...
    @property
    def slope(self) -> Floats: ...
    @property
    def transition(self) -> Floats: ...
    @property
    def product(self) -> Floats: ...


class ComparisonWork(CorrectionWork, Protocol):
    """Working arrays of a comparison, with `change` (..., t), whose first row is set to the step."""

    @property
    def change(self) -> Floats: ...


class RelinearisingWork(CorrectionWork, Protocol):
    """Working arrays of a relinearisation, with `turned` (t,)."""

    @property
    def turned(self) -> Floats: ...


class FillSlope(Protocol):
    """Function that fills the slope (t,) at a mean (n,) and a covariance (t, t); see `Correction`."""

    def __call__(self, mean: Floats, covariance: Floats, slope: Floats, /) -> None: ...


class Correct(Protocol):
    """Function that moves a mean (n,) and its covariance (t, t) in place by the workspace's `step`."""

    def __call__(self, mean: Floats, covariance: Floats, work: CorrectionWork, /) -> None: ...


class Compare(Protocol):
    """Function that fills `work.change[0]` with the step from an origin (n,) to a mean (n,).

    See `comparing`.
    """

    def __call__(
        self, origin: Floats, mean: Floats, covariance: Floats, work: ComparisonWork, /
    ) -> None: ...


class StepTo(Protocol):
    """Function that fills `work.state` with the mean (n,) moved by `work.step`."""

    def __call__(self, mean: Floats, work: CorrectionWork, /) -> None: ...


class Chain(Protocol):
    """Function that converts a Jacobian at the moved state, (m, t), to the Jacobian for the step."""

    def __call__(self, rows: Floats, work: RelinearisingWork, /) -> None: ...


def sloping(kinds: Kinds, correct: Correction | None, form: Form = COVARIANCES) -> FillSlope:
    """Make `fill(mean, covariance, slope)`, which computes the slope (t,) of `model.Correction`.

    If the model has no correction, the slope is not changed.

    Args:
        kinds: kinds of the state's components.
        correct: the correction of the model, if it has one.
        form: the form in which the filter stores covariances.
    """
    if correct is None:

        def leave(mean: Floats, covariance: Floats, slope: Floats) -> None:
            pass

        return leave
    along = traced(correct.along, len(kinds))
    read_state, t, times = tuple_of(len(kinds)), tangent_size(kinds), form.times

    def fill(mean: Floats, covariance: Floats, slope: Floats) -> None:
        direction, variance = along(read_state(mean)), 0.0
        times(covariance, direction, slope)
        for row in range(t):
            variance += direction[row] * slope[row]
        for row in range(t):
            slope[row] = slope[row] / variance if variance > 0.0 else 0.0

    return fill


def correcting(
    kinds: Kinds, correct: Correction | None, *, back: bool = False, form: Form = COVARIANCES
) -> Correct:
    """Make `move(mean, covariance, work)`, which moves a state and its covariance by `work.step`.

    If the model has a correction, components move along the curve with the tangent `work.slope`, and
    `work.state`, `work.transition` and `work.product` are overwritten. With `back`, the step is part of
    a smoother's backward pass.
    """
    if correct is not None:
        step_together = stepping(kinds, correct.back if back else correct.move)
        fill, propagate = filling(len(kinds)), form.propagate

        def move_together(mean: Floats, covariance: Floats, work: CorrectionWork) -> None:
            step_together(mean, work)
            fill(mean, work.state)
            propagate(covariance, work.transition, work.product)

        return move_together
    add, reset, turn = boxplus(kinds), by_right_jacobian(kinds), form.turn
    if is_flat(kinds):

        def move(mean: Floats, covariance: Floats, work: CorrectionWork) -> None:
            add(mean, work.step)

        return move

    def move_and_turn(mean: Floats, covariance: Floats, work: CorrectionWork) -> None:
        add(mean, work.step)
        turn(reset, work.step, covariance)

    return move_and_turn


def comparing(kinds: Kinds, correct: Correction | None) -> Compare:
    """Make `compare(origin, mean, covariance, work)`, which finds the step between two states.

    It is the inverse of `correcting`: it fills `work.change[0]` with the step from the origin (n,) to
    the mean, and transforms the covariance from the mean's tangent space to the origin's.

    Args:
        kinds: kinds of the state's components.
        correct: the correction of the model, if it has one.
    """
    if correct is not None:
        t, read_state = tangent_size(kinds), tuple_of(len(kinds))
        read_slope = tuple_of(t)
        inputs = [
            Input("origin", kinds),
            Input("target", kinds, "transition"),
            Input("slope", ("linear",) * t),
        ]
        linearise = derivative(
            traced(correct.step, len(kinds), len(kinds), t), inputs, ("linear",) * t, "step"
        )

        def compare_together(
            origin: Floats, mean: Floats, covariance: Floats, work: ComparisonWork
        ) -> None:
            linearise(read_state(origin), read_state(mean), read_slope(work.slope), work)
            work.change[0] = work.step
            propagate_covariance(covariance, work.transition, work.product)

        return compare_together
    subtract, reset_back = boxminus(kinds), by_right_jacobian(kinds, back=True)
    if is_flat(kinds):

        def compare(origin: Floats, mean: Floats, covariance: Floats, work: ComparisonWork) -> None:
            subtract(mean, origin, work.change, 0)

        return compare

    def compare_and_turn(origin: Floats, mean: Floats, covariance: Floats, work: ComparisonWork) -> None:
        subtract(mean, origin, work.change, 0)
        reset_back(work.change[0], covariance)
        reset_back(work.change[0], covariance.T)

    return compare_and_turn


def relinearising(model: Model) -> tuple[StepTo, Chain]:
    """Make the functions for the linearisation point and the chain rule of an iterated update.

    `step_to(mean, work)` fills `work.state` with the mean moved by `work.step`. After that, `chain(rows,
    work)` converts a Jacobian (m, t) at that state to the Jacobian with respect to the step.
    """
    t = model.tangent
    if model.correct is not None:

        def chain_together(rows: Floats, work: RelinearisingWork) -> None:
            for i in range(len(rows)):
                for column in range(t):
                    entry = 0.0
                    for k in range(t):
                        entry += rows[i, k] * work.transition[k, column]
                    work.turned[column] = entry
                rows[i] = work.turned

        return stepping(model.kinds, model.correct.move), chain_together
    fill, add, flat = filling(model.size), boxplus(model.kinds), is_flat(model.kinds)
    turn = by_right_jacobian(model.kinds)

    def step_to(mean: Floats, work: CorrectionWork) -> None:
        fill(work.state, mean)
        add(work.state, work.step)

    def chain(rows: Floats, work: RelinearisingWork) -> None:
        if not flat:
            for row in range(t):
                work.turned[row] = -work.step[row]
            turn(work.turned, rows.T)

    return step_to, chain


def stepping(kinds: Kinds, move: AlongSlope) -> StepTo:
    """Make `step_to(mean, work)`, which fills `work.state` and its derivative `work.transition`.

    The mean is moved by `work.step` along the curve with the tangent `work.slope`.
    """
    straight = ("linear",) * tangent_size(kinds)
    inputs = [Input("state", kinds), Input("step", straight, "transition"), Input("slope", straight)]
    arguments = (len(each.kinds) for each in inputs)
    linearise = derivative(traced(move, *arguments), inputs, kinds, "state")
    read_state, read_step = tuple_of(len(kinds)), tuple_of(len(straight))

    def step_to(mean: Floats, work: CorrectionWork) -> None:
        linearise(read_state(mean), read_step(work.step), read_step(work.slope), work)

    return step_to


def correcting_more(model: Model, more: int) -> Correction | None:
    """Extend the correction of a model to further components of the state, which move separately."""
    if model.correct is None:
        return None
    n, t, correct = model.size, model.tangent, model.correct

    def longer(move: AlongSlope) -> AlongSlope:
        def move_all(state: Numbers, step: Numbers, slope: Numbers) -> Numbers:
            moved = move(state[:n], step[:t], slope[:t])
            return (*moved, *(state[n + each] + step[t + each] for each in range(more)))

        return move_all

    along_own, step_own = correct.along, correct.step

    def along(state: Numbers) -> Numbers:
        return (*along_own(state[:n]), *(0.0,) * more)

    def step_to(state: Numbers, target: Numbers, slope: Numbers) -> Numbers:
        step = step_own(state[:n], target[:n], slope[:t])
        return (*step, *(target[n + each] - state[n + each] for each in range(more)))

    return Correction(along, longer(correct.move), step_to, longer(correct.back))
