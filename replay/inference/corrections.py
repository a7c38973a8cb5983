"""How a correction moves a state on its manifold, and what it makes of the covariance.

Forward, an update moves the mean by a step of its tangent space; backward, a smoother finds the step
that leads from one mean to another. Components move by themselves (`generate.retraction`), unless the
model says that they move together (`model.Correction`). Either way the covariance is carried from the
tangent space of the old mean to that of the new one by the derivative of the move.
"""

from functools import lru_cache
from typing import Any

from replay.engine.arrays import Floats, Function
from replay.inference.gaussian import moved_covariance
from replay.inference.generate import (
    Input,
    derivative,
    differencing,
    filling,
    function_of,
    is_flat,
    resetting,
    retraction,
    things,
    tuple_of,
)
from replay.inference.model import Correction, Model

Kinds = tuple[str, ...]


def correcting(model: Model) -> Function:
    """`correct(mean, covariance, work)`: moves the mean by `work.step`, and the covariance with it."""
    return moving(model.kinds, model.correction)


@lru_cache(maxsize=64)
def moving(kinds: Kinds, correction: Correction | None) -> Function:
    """See `correcting`; uses `state`, `transition` and `product` of the workspace."""
    if correction is not None:
        step_to, fill = stepping(kinds, correction), filling(len(kinds))

        def move_together(mean: Floats, covariance: Floats, work: Any) -> None:
            step_to(mean, work.step, work)
            fill(mean, work.state)
            moved_covariance(covariance, work.transition, work.product)

        return move_together
    add, reset = retraction(kinds), resetting(kinds)
    if is_flat(kinds):

        def move(mean: Floats, covariance: Floats, work: Any) -> None:
            add(mean, work.step)

        return move

    def move_and_turn(mean: Floats, covariance: Floats, work: Any) -> None:
        add(mean, work.step)
        reset(work.step, covariance)
        reset(work.step, covariance.T)

    return move_and_turn


@lru_cache(maxsize=64)
def stepping(kinds: Kinds, correction: Correction) -> Function:
    """`step_to(mean, step, work)`: `work.state` gets the moved mean, `transition` its derivative."""
    n, t = len(kinds), _tangent(kinds)
    linearise = derivative(
        _whole(kinds, correction).move,
        [Input("state", kinds), Input("step", ("linear",) * t, "transition")],
        kinds,
        (),
        "state",
    )
    read_state, read_step = tuple_of(n), tuple_of(t)

    def step_to(mean: Floats, step: Floats, work: Any) -> None:
        linearise(read_state(mean), read_step(step), work)

    return step_to


def relinearising(model: Model) -> tuple[Function, Function]:
    """What iterated updates linearise at, and the chain rule back to the mean.

    `step_to(mean, work)` fills `work.state` with the mean moved by `work.step`; `chain(rows, work)` then
    makes of a Jacobian (m, t) at that state one by the step.
    """
    kinds, t = model.kinds, model.tangent
    if model.correction is not None:
        together = stepping(kinds, model.correction)

        def step_together(mean: Floats, work: Any) -> None:
            together(mean, work.step, work)

        def chain_together(rows: Floats, work: Any) -> None:
            for i in range(len(rows)):
                for column in range(t):
                    entry = 0.0
                    for k in range(t):
                        entry += rows[i, k] * work.transition[k, column]
                    work.turned[column] = entry
                for column in range(t):
                    rows[i, column] = work.turned[column]

        return step_together, chain_together
    fill, add, turn, flat = filling(len(kinds)), retraction(kinds), resetting(kinds), is_flat(kinds)

    def step_to(mean: Floats, work: Any) -> None:
        fill(work.state, mean)
        add(work.state, work.step)

    def chain(rows: Floats, work: Any) -> None:
        if not flat:
            for row in range(t):
                work.turned[row] = -work.step[row]
            turn(work.turned, rows.T)

    return step_to, chain


@lru_cache(maxsize=64)
def reaching_back(kinds: Kinds, correction: Correction | None) -> Function:
    """`reach(base, work)`: the step from a mean to that of `work` into its first row of `change`.

    The covariance of `work` becomes one in the tangent space of `base`.
    """
    if correction is not None:
        read, t = tuple_of(len(kinds)), _tangent(kinds)
        linearise = derivative(
            _whole(kinds, correction).between,
            [Input("state", kinds), Input("moved", kinds, "transition")],
            ("linear",) * t,
            (),
            "step",
        )

        def reach_together(base: Floats, work: Any) -> None:
            linearise(read(base), read(work.mean), work)
            for row in range(t):
                work.change[0, row] = work.step[row]
            moved_covariance(work.covariance, work.transition, work.product)

        return reach_together
    subtract, reset_back = differencing(kinds), resetting(kinds, back=True)
    if is_flat(kinds):

        def reach(base: Floats, work: Any) -> None:
            subtract(work.mean, base, work.change, 0)

        return reach

    def reach_and_turn(base: Floats, work: Any) -> None:
        subtract(work.mean, base, work.change, 0)
        reset_back(work.change[0], work.covariance)
        reset_back(work.change[0], work.covariance.T)

    return reach_and_turn


def _tangent(kinds: Kinds) -> int:
    return sum(width for *_, width in things(kinds))


def _whole(kinds: Kinds, correction: Correction) -> Correction:
    """The correction of a state that may have more components, which move by themselves."""
    own, t = correction.components, _tangent(kinds[: correction.components])
    more = range(len(kinds) - own)
    if not more:
        return correction
    first, first_step = tuple_of(own), tuple_of(t)
    moved = [f"state[{own + each}] + step[{t + each}]" for each in more]
    steps = [f"moved[{own + each}] - state[{own + each}]" for each in more]
    move = function_of(
        "def move(state, step):\n"
        f"    return (*inner(first(state), first_step(step)), {', '.join(moved)})\n",
        inner=correction.move,
        first=first,
        first_step=first_step,
    )
    between = function_of(
        "def between(state, moved):\n"
        f"    return (*inner(first(state), first(moved)), {', '.join(steps)})\n",
        inner=correction.between,
        first=first,
    )
    return Correction(move, between, len(kinds))
