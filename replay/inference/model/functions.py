"""Names the functions that a model is made of, by what they take and return.

They take and return tuples of numbers: states (n,), the control, the point that a message refers to. The
parameters are a NamedTuple of numbers. All arguments are given by position.
"""

from collections.abc import Callable
from typing import Any, Protocol

from fuselog.replay.engine.arrays import Floats, Numbers, Settings

# Any function of a model, for what wraps or traces all of them alike: what they take differs.
ModelFunction = Callable[..., Any]  # type: ignore[explicit-any]

# (state, control, duration_s, parameters) -> state. Where noise enters other than by addition it stands
# behind the control, so that there are four or five arguments.
Move = Callable[..., Numbers]  # type: ignore[explicit-any]

# (state, reference, parameters) -> what a sensor measures (m,). Noise that is not additive stands behind
# the state, so that there are three or four arguments.
Measure = Callable[..., Numbers]  # type: ignore[explicit-any]


class MotionNoise(Protocol):
    """Gives variances of what a motion adds over a duration, or the rows of a lower triangle."""

    def __call__(self, state: Numbers, duration_s: float, parameters: Settings, /) -> Numbers: ...


class ControlNoise(Protocol):
    """Gives the variances of the control's error over a duration (controls,)."""

    def __call__(self, duration_s: float, parameters: Settings, /) -> Numbers: ...


class MotionJacobians(Protocol):
    """Fills the derivatives of the moved state by the state (t, t) and by the control (t, controls)."""

    def __call__(
        self,
        state: Numbers,
        control: Numbers,
        duration_s: float,
        parameters: Settings,
        by_state: Floats,
        by_control: Floats,
        /,
    ) -> object: ...


class MotionMoments(Protocol):
    """Moves a mean (n,) and a covariance (t, t) in place, exactly and without the additive noise."""

    def __call__(
        self,
        mean: Floats,
        covariance: Floats,
        control: Numbers,
        duration_s: float,
        parameters: Settings,
        /,
    ) -> object: ...


class OfParameters(Protocol):
    """Gives numbers that depend on the parameters only: noise of a sensor, rates between modes."""

    def __call__(self, parameters: Settings, /) -> Numbers: ...


class MeasurementJacobian(Protocol):
    """Fills the derivative of what a sensor measures by the state, (m, t)."""

    def __call__(
        self, state: Numbers, reference: Numbers, parameters: Settings, by_state: Floats, /
    ) -> object: ...


class MeasurementMoments(Protocol):
    """Fills the mean of a measurement (m,), its covariance (m, m) and that with the state (t, m).

    Of a mean (n,) and covariance (t, t) of the state.
    """

    def __call__(
        self,
        mean: Floats,
        covariance: Floats,
        reference: Numbers,
        parameters: Settings,
        predicted: Floats,
        spread: Floats,
        cross: Floats,
        /,
    ) -> object: ...


class LogLikelihood(Protocol):
    """Gives log p(measured | state)."""

    def __call__(
        self, state: Numbers, measured: Numbers, reference: Numbers, parameters: Settings, /
    ) -> float: ...


class OfState(Protocol):
    """Gives a direction d (t,) of the tangent space at a state (n,)."""

    def __call__(self, state: Numbers, /) -> Numbers: ...


class AlongSlope(Protocol):
    """Moves a state (n,) by a step (t,) along a slope (t,); or finds the step to a target (n,)."""

    def __call__(self, state: Numbers, step_or_target: Numbers, slope: Numbers, /) -> Numbers: ...
