"""Prediction of a Gaussian with the Jacobian of a model's motion and the noise of the motion."""

from typing import Protocol

from fuselog.replay.engine.arrays import Floats, Numbers, Settings
from fuselog.replay.inference.kalman.steps import CoreMemory, Interval, Predict, Workspace
from fuselog.replay.inference.linear_algebra.gaussian import add_through
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative, known_entries
from fuselog.replay.inference.linear_algebra.sparse import (
    adding_through,
    pattern_of,
    propagating_covariance,
)
from fuselog.replay.inference.linear_algebra.tuples import AddNoise, adding_noise, filling, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.functions import MotionNoise
from fuselog.replay.inference.model.model import Model, Motion


class LineariseMotion(Protocol):
    """Function that fills the moved state (n,) and requested derivatives; see `motion_derivative`."""

    def __call__(
        self,
        state: Numbers,
        control: Numbers,
        duration_s: float,
        parameters: Settings,
        work: CoreMemory,
        /,
    ) -> None: ...


class AddMotionNoise(Protocol):
    """Function that adds the noise of a motion over a duration to a covariance (t, t)."""

    def __call__(
        self,
        state: Numbers,
        covariance: Floats,
        duration_s: float,
        parameters: Settings,
        work: CoreMemory,
        /,
    ) -> None: ...


def linear_motion(bound_model: BoundModel) -> Predict:
    """Make the prediction by the Jacobian at the mean, which is exact if the motion is linear.

    Returns:
        `predict(mean, covariance, interval, work)`, which replaces the mean (n,) by f(x, u) and the
        covariance (t, t) by F P F' + Q, in place.
    """
    model, motion = bound_model.model, bound_model.motion
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
        move_covariance(covariance, work.transition, work.product)
        add_noise(state, covariance, duration_s, parameters, work)
        return True

    return predict


def motion_derivative(model: Model, motion: Motion, *, by_state: bool) -> LineariseMotion:
    """Make the function that moves a state and computes the requested derivatives.

    Args:
        model: the model, for the kinds of state and control.
        motion: motion whose `move` is differentiated.
        by_state: whether F, the derivative with respect to the state, is requested.

    Returns:
        `linearise(state, control, duration_s, parameters, work)`. It fills `work.state` (n,),
        `transition` (t, t) if F is requested, `gain` (t, controls) if the control is noisy, and
        `noise_gain` (t, noises) if the noise is not additive.
    """
    if motion.jacobians is not None:
        move, jacobians, fill = motion.move, motion.jacobians, filling(model.size)

        def by_hand(
            state: Numbers, control: Numbers, duration_s: float, parameters: Settings, work: CoreMemory
        ) -> None:
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


def motion_noise(model: Model, motion: Motion) -> AddMotionNoise:
    """Make the function that adds the noise of a motion, of any kind, to a covariance.

    Args:
        model: the model, for the sizes of tangent space and control.
        motion: the motion.

    Returns:
        `add(state, covariance, duration_s, parameters, work)`, for a covariance (t, t). Noise of the
        control, and noise that is not additive, enters through the derivatives in the workspace.
    """
    pieces: list[AddMotionNoise] = []
    if motion.control_noise is not None:
        pieces.append(_control_noise(model, motion))
    if motion.noise is not None and motion.noises:
        pieces.append(_entering_noise(motion.noise, motion.noises))
    elif motion.noise is not None:
        pieces.append(_additive_noise(motion.noise, adding_noise(model.tangent, motion.noise_block)))
    if not pieces:
        return nothing
    return pieces[0] if len(pieces) == 1 else _both(*pieces)


def nothing(*_: object) -> None:
    """Do nothing; this replaces a function that a model does not need."""
    return


def _both(first: AddMotionNoise, second: AddMotionNoise) -> AddMotionNoise:
    def add(
        state: Numbers, covariance: Floats, duration_s: float, parameters: Settings, work: CoreMemory
    ) -> None:
        first(state, covariance, duration_s, parameters, work)
        second(state, covariance, duration_s, parameters, work)

    return add


def _control_noise(model: Model, motion: Motion) -> AddMotionNoise:
    fill, variances = filling(model.controls), motion.control_noise
    assert variances is not None
    known = known_entries(motion_derivative(model, motion, by_state=False), "gain")
    add_through = adding_through(pattern_of(known, model.tangent))

    def add(
        state: Numbers, covariance: Floats, duration_s: float, parameters: Settings, work: CoreMemory
    ) -> None:
        fill(work.control_variance, variances(duration_s, parameters))
        add_through(covariance, work.gain, work.control_variance)

    return add


def _entering_noise(variances: MotionNoise, noises: int) -> AddMotionNoise:
    fill = filling(noises)

    def add(
        state: Numbers, covariance: Floats, duration_s: float, parameters: Settings, work: CoreMemory
    ) -> None:
        fill(work.noise_variance[:noises], variances(state, duration_s, parameters))
        add_through(covariance, work.noise_gain, work.noise_variance[:noises])

    return add


def _additive_noise(noise: MotionNoise, add_noise: AddNoise) -> AddMotionNoise:
    def add(
        state: Numbers, covariance: Floats, duration_s: float, parameters: Settings, work: CoreMemory
    ) -> None:
        add_noise(covariance, noise(state, duration_s, parameters))

    return add
