"""Predicts a Gaussian through a model's motion by its Jacobian, and adds the motion's noise."""

from typing import Any

from fuselog.replay.engine.arrays import Floats, Function
from fuselog.replay.inference.kalman.steps import Interval, Workspace
from fuselog.replay.inference.linear_algebra.gaussian import add_through
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative, known_entries
from fuselog.replay.inference.linear_algebra.sparse import (
    adding_through,
    pattern_of,
    propagating_covariance,
)
from fuselog.replay.inference.linear_algebra.tuples import adding_noise, filling, tuple_of
from fuselog.replay.inference.model.model import Model, Motion
from fuselog.replay.inference.model.stage import Stage


def linear_motion(stage: Stage) -> Function:
    """Make the prediction by the Jacobian at the mean, which is exact where the motion is linear.

    Returns `predict(mean, covariance, interval, work)`: in place, the mean (n,) becomes f(x, u) and the
    covariance (t, t) F P F' + Q.
    """
    model, motion = stage.model, stage.motion
    n, read_control = model.size, tuple_of(model.controls)
    read_state, fill = tuple_of(n), filling(n)
    linearise = motion_derivative(model, motion, by_state=True)
    known = known_entries(linearise, "transition")
    move_covariance = propagating_covariance(pattern_of(known, model.tangent))
    add_noise = motion_noise(model, motion)

    def predict(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        control, duration_s, parameters, _ = interval
        state = read_state(mean)
        linearise(state, read_control(control), duration_s, parameters, work)
        fill(mean, work.state)
        move_covariance(covariance, work.transition, work.product, work.rest)
        add_noise(state, covariance, duration_s, parameters, work)
        return True

    return predict


def motion_derivative(model: Model, motion: Motion, *, by_state: bool) -> Function:
    """Make the function that moves a state and takes the derivatives that are wanted.

    Args:
        model: the model, for the kinds of its state and control.
        motion: the motion whose `move` is differentiated.
        by_state: whether F, the derivative by the state, is wanted.

    Returns `linearise(state, control, duration_s, parameters, work)`. It fills `work.state` (n,),
    `transition` (t, t) where F is wanted, `gain` (t, controls) where the control is noisy, and
    `noise_gain` (t, noises) where noise enters other than by addition.
    """
    if motion.jacobians is not None:
        move, jacobians, fill = motion.move, motion.jacobians, filling(model.size)

        def by_hand(state: Any, control: Any, duration_s: float, parameters: Any, work: Any) -> None:
            jacobians(state, control, duration_s, parameters, work.transition, work.gain)
            fill(work.state, move(state, control, duration_s, parameters))

        return by_hand
    inputs = [
        Input("state", model.kinds, "transition" if by_state else ""),
        Input("control", ("linear",) * model.controls, "gain" if motion.control_noise else ""),
    ]
    if motion.noises:
        inputs.append(Input("noise", ("linear",) * motion.noises, "noise_gain", zero=True))
    return derivative(motion.move, inputs, model.kinds, "state")


def motion_noise(model: Model, motion: Motion) -> Function:
    """Make the function that adds the noise of a motion, whatever its kind, to a covariance.

    Args:
        model: the model, for the sizes of its tangent space and control.
        motion: the motion whose noise it is.

    Returns `add(state, covariance, duration_s, parameters, work)`, for a covariance (t, t). What enters
    by the control, or other than by addition, does so through the workspace's derivatives.
    """
    pieces: list[Function] = []
    if motion.control_noise is not None:
        pieces.append(_control_noise(model, motion))
    if motion.noise is not None and motion.noises:
        pieces.append(_entering_noise(motion.noise, motion.noises))
    elif motion.noise is not None:
        pieces.append(_additive_noise(motion.noise, adding_noise(model.tangent, motion.noise_block)))
    if not pieces:
        return nothing
    return pieces[0] if len(pieces) == 1 else _both(*pieces)


def nothing(*_: Any) -> None:
    """Do nothing, in place of what a model does not need."""
    return


def _both(first: Function, second: Function) -> Function:
    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        first(state, covariance, duration_s, parameters, work)
        second(state, covariance, duration_s, parameters, work)

    return add


def _control_noise(model: Model, motion: Motion) -> Function:
    fill, variances = filling(model.controls), motion.control_noise
    assert variances is not None
    known = known_entries(motion_derivative(model, motion, by_state=False), "gain")
    add_through = adding_through(pattern_of(known, model.tangent))

    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        fill(work.control_variance, variances(duration_s, parameters))
        add_through(covariance, work.gain, work.control_variance)

    return add


def _entering_noise(variances: Function, noises: int) -> Function:
    fill = filling(noises)

    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        fill(work.noise_variance[:noises], variances(state, duration_s, parameters))
        add_through(covariance, work.noise_gain, work.noise_variance[:noises])

    return add


def _additive_noise(noise: Function, add_noise: Function) -> Function:
    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        add_noise(covariance, noise(state, duration_s, parameters))

    return add
