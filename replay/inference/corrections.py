"""How an update moves a state by a step of its tangent space, and what becomes of the covariance.

Components move by themselves (`generate.retraction`), unless the model says that they move together
(`Model.correct`). Either way the covariance is carried from the tangent space of the old mean to that of
the new one, by the derivative of the moved state by the step.
"""

from typing import Any

from replay.engine.arrays import Floats, Function
from replay.inference.gaussian import moved_covariance
from replay.inference.generate import (
    Input,
    derivative,
    filling,
    function_of,
    is_flat,
    resetting,
    retraction,
    tuple_of,
)
from replay.inference.model import Model


def correcting(model: Model) -> Function:
    """`move(mean, covariance, work)`: moves the state by `work.step`, and the covariance with it.

    Where components move together it uses the workspace's `state`, `transition` and `product`.
    """
    if model.correct is not None:
        step_together, fill = _stepping(model, model.correct), filling(model.size)

        def move_together(mean: Floats, covariance: Floats, work: Any) -> None:
            step_together(mean, work)
            fill(mean, work.state)
            moved_covariance(covariance, work.transition, work.product)

        return move_together
    add = retraction(model.kinds)
    if is_flat(model.kinds):

        def move(mean: Floats, covariance: Floats, work: Any) -> None:
            add(mean, work.step)

        return move
    reset = resetting(model.kinds)

    def move_and_turn(mean: Floats, covariance: Floats, work: Any) -> None:
        add(mean, work.step)
        reset(work.step, covariance)
        reset(work.step, covariance.T)

    return move_and_turn


def relinearising(model: Model) -> tuple[Function, Function]:
    """Where an iterated update linearises, and the chain rule back to the mean.

    `step_to(mean, work)` fills `work.state` with the mean moved by `work.step`; after it
    `chain(rows, work)` makes of a Jacobian (m, t) at that state one by the step.
    """
    t = model.tangent
    if model.correct is not None:

        def chain_together(rows: Floats, work: Any) -> None:
            for i in range(len(rows)):
                for column in range(t):
                    entry = 0.0
                    for k in range(t):
                        entry += rows[i, k] * work.transition[k, column]
                    work.turned[column] = entry
                for column in range(t):
                    rows[i, column] = work.turned[column]

        return _stepping(model, model.correct), chain_together
    fill, add, flat = filling(model.size), retraction(model.kinds), is_flat(model.kinds)
    turn = resetting(model.kinds)

    def step_to(mean: Floats, work: Any) -> None:
        fill(work.state, mean)
        add(work.state, work.step)

    def chain(rows: Floats, work: Any) -> None:
        if not flat:
            for row in range(t):
                work.turned[row] = -work.step[row]
            turn(work.turned, rows.T)

    return step_to, chain


def _stepping(model: Model, correct: Function) -> Function:
    """`step_to(mean, work)`: `work.state` gets the moved mean, `work.transition` its derivative."""
    inputs = [
        Input("state", model.kinds),
        Input("step", ("linear",) * model.tangent, "transition"),
    ]
    linearise = derivative(correct, inputs, model.kinds, (), "state")
    read_state, read_step = tuple_of(model.size), tuple_of(model.tangent)

    def step_to(mean: Floats, work: Any) -> None:
        linearise(read_state(mean), read_step(work.step), work)

    return step_to


def correcting_more(model: Model, more: int) -> Function | None:
    """The `correct` of a model whose state gets so many more components, which move by themselves."""
    if model.correct is None:
        return None
    n, t = model.size, model.tangent
    entries = [f"moved[{each}]" for each in range(n)]
    entries += [f"state[{n + each}] + step[{t + each}]" for each in range(more)]
    return function_of(
        "def correct(state, step):\n"
        "    moved = inner(first(state), first_step(step))\n"
        f"    return ({', '.join(entries)})\n",
        inner=model.correct,
        first=tuple_of(n),
        first_step=tuple_of(t),
    )
