"""Types of a model's functions, with their arguments and results.

Arguments and results are tuples of numbers: states (n,), the control, and the point to which a message
refers. Parameters are a NamedTuple of numbers. All arguments are positional.
"""

from collections.abc import Callable
from typing import Any, Protocol

from fuselog.replay.engine.arrays import Floats, Numbers, Settings

# Any function of a model, for code that wraps or traces functions with any arguments.
ModelFunction = Callable[..., Any]  # type: ignore[explicit-any]

# (state, control, duration_s, parameters) -> state. Noise that is not additive is an argument after the
# control, so there are four or five arguments.
Move = Callable[..., Numbers]  # type: ignore[explicit-any]

# (state, reference, parameters) -> the measured quantities (m,). Noise that is not additive is an
# argument after the state, so there are three or four arguments.
Measure = Callable[..., Numbers]  # type: ignore[explicit-any]


class MotionNoise(Protocol):
    """Function that returns the variances that a motion adds over a duration, or a lower triangle."""

    def __call__(self, state: Numbers, duration_s: float, parameters: Settings, /) -> Numbers: ...


class ControlNoise(Protocol):
    """Function that returns the variances of the control's error over a duration (controls,)."""

    def __call__(self, duration_s: float, parameters: Settings, /) -> Numbers: ...


class MotionJacobians(Protocol):
    """Function that fills the derivatives of the moved state with respect to state and control."""

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
    """Function that moves a mean (n,) and covariance (t, t) in place, exactly, without added noise."""

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
    """Function of the parameters only, such as noise of a sensor or rates between modes."""

    def __call__(self, parameters: Settings, /) -> Numbers: ...


class MeasurementJacobian(Protocol):
    """Function that fills the derivative (m, t) of a measurement with respect to the state."""

    def __call__(
        self, state: Numbers, reference: Numbers, parameters: Settings, by_state: Floats, /
    ) -> object: ...


class MeasurementMoments(Protocol):
    """Function that fills a measurement's mean (m,), covariance (m, m) and covariance with the state.

    This covariance with the state is (t, m); the state has the given mean (n,) and covariance (t, t).
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
    """Function that returns log p(measured | state)."""

    def __call__(
        self, state: Numbers, measured: Numbers, reference: Numbers, parameters: Settings, /
    ) -> float: ...


class OfState(Protocol):
    """Function that returns a direction d (t,) of the tangent space at a state (n,)."""

    def __call__(self, state: Numbers, /) -> Numbers: ...


class AlongSlope(Protocol):
    """Function that moves a state (n,) by a step (t,) along a slope (t,), or finds such a step."""

    def __call__(self, state: Numbers, step_or_target: Numbers, slope: Numbers, /) -> Numbers: ...
