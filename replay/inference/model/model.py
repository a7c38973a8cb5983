"""Models of a state: its motion, and the sensors that measure it.

A model is written once, as plain component-first functions: their arguments and results are tuples of
components, and a component may be an array. Every method (see `fuselog.replay.inference.kalman.methods`)
can estimate the state of every model that provides what the method needs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

from fuselog.recorders.log import Schema, Stream, schemas
from fuselog.replay.engine.arrays import Floats, Numbers, Settings
from fuselog.replay.engine.renamed import renamed
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.inference.linear_algebra.manifold import tangent_size
from fuselog.replay.inference.model.functions import (
    AlongSlope,
    ControlNoise,
    LogLikelihood,
    Measure,
    MeasurementJacobian,
    MeasurementMoments,
    MotionJacobians,
    MotionMoments,
    MotionNoise,
    Move,
    OfParameters,
    OfState,
)
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start

FIX, POSITION = "fix", ("x_m", "y_m", "z_m")


@dataclass(frozen=True, eq=False)
class Map:
    """Map of fixed points, published on a topic; measurements refer to the points by number.

    Attributes:
        topic: topic of the map.
        schema: schema of its messages.
        number: field with the number of a point.
        point: vector field with the position of a point.
        components: components of the point, by name.
        of: field of the measurement with the number of the point; if the map has no such point, the
            measurement contains no information about the state.
    """

    topic: str
    schema: Schema
    number: str
    point: str
    components: Components
    of: str = "target_id"

    @property
    def size(self) -> int:
        """Number of components of a point."""
        return len(self.components)


@renamed(instead="fallbacks")
@dataclass(frozen=True, eq=False)
class Control:
    """Control of a model: the input that drives its motion.

    Attributes:
        topic: name of the topic of the control, under the prefix of the estimated object.
        schema: schema of its messages.
        components: names of the components of the control, which are fields of the messages unless
            `read` is given.
        read: stream -> (n, components).
        interpolated: whether the control is linear between two messages, so that the motion uses the
            mean of its values at both ends of a step; otherwise, a message applies until the next one.
        initial: value of the control before the first message; zeros by default.
        gap: parameter with the longest time, in s, for which an interpolated control may lack messages.
            In a longer gap the estimate ends, or is unknown until messages resume; see
            `Motion.gap_noise`.
        delay: parameter with the delay, in s, from a measurement to the stamp of its message.
        estimates: whether estimates are also made at the stamps of the control, in addition to those of
            sensors.
        fallbacks: other topics that replace the components of the same names if the log has these
            topics, such as the gyro's turn rate in place of the wheels'.
        noise: for a fallback, the names under which its channel may state the control's noise, by
            parameter; while the fallback is used, these parameters are read only from its channel.
    """

    topic: str
    schema: Schema
    components: tuple[str, ...]
    read: Callable[[Stream], Floats] | None = None
    interpolated: bool = False
    initial: tuple[float, ...] = ()
    gap: str = ""
    delay: str = ""
    estimates: bool = False
    fallbacks: tuple["Control", ...] = ()
    noise: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@renamed(lost="gap_noise")
@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a state.

    Attributes:
        move: (state, control, duration_s, parameters) -> state; with `noises`, (state, control, noise,
            duration_s, parameters) -> state.
        noise: (state, duration_s, parameters) -> variances of the additive noise in the tangent space,
            or the rows of the lower triangle of the covariance of this noise; with `noises`, the
            variances of the noise components.
        noises: number of noise components that `move` receives as arguments; this noise is not added.
        noise_block: number of components in the lower triangle, which is followed by the variances of
            the other components; zero means that the triangle contains all components.
        control_noise: (duration_s, parameters) -> variances of the control's error over the duration;
            the derivative with respect to the control propagates them to the state.
        gap_noise: (state, duration_s, parameters) -> variances in the tangent space that are added after
            the control was missing for longer than its `gap`. The state is not changed, so the variances
            must cover any motion in the meantime; there are no estimates during the gap.
        linear: whether `move` is linear in the state; sampling methods then need no samples.
        jacobians: (state, control, duration_s, parameters, by_state, by_control) fills both Jacobians;
            needed only for handwritten Jacobians, because they are otherwise derived from `move`.
        moments: (mean, covariance, control, duration_s, parameters) moves mean and covariance exactly,
            in place, without the additive noise; for the method `analytic`.
    """

    move: Move
    noise: MotionNoise | None = None
    noises: int = 0
    noise_block: int = 0
    control_noise: ControlNoise | None = None
    gap_noise: MotionNoise | None = None
    linear: bool = False
    jacobians: MotionJacobians | None = None
    moments: MotionMoments | None = None

    def triangle(self, tangent: int) -> int:
        """Return the size of `noise` if it is a triangle; `tangent` is the tangent space's size."""
        block = self.noise_block or tangent
        return block * (block + 1) // 2 + tangent - block


@dataclass(frozen=True, eq=False)
class Switching:
    """Changes between modes, as a Markov chain in continuous time.

    Attributes:
        rates: (parameters) -> rates of change per second: from the first mode to each of the others in
            order, then from the second mode, and so on; M (M - 1) numbers for M modes.
        initial: (parameters) -> probabilities of the modes at the time of the prior; equal by default.
    """

    rates: OfParameters
    initial: OfParameters | None = None


@renamed(about="reference")
@dataclass(frozen=True, eq=False)
class Sensor:
    """Sensor: its measurement as a function of the state.

    Attributes:
        topic: name of its topic, under the prefix of the estimated object; a leading slash makes it a
            full name.
        schema: schema of its messages. A GeodeticFix is accepted as a PositionFix; it is converted using
            the origin of the log's local tangent plane.
        measured: names of the measured components, with their kinds ("linear" or "angle").
        measure: (state, reference, parameters) -> measurement; with `noises`, (state, noise, reference,
            parameters). `reference` is the point of the map, or empty. A component that is undefined at
            this state, or has no derivative, is NaN, as if the message lacked it.
        noise: (parameters) -> variances of the measured components, or the rows of a lower triangle;
            with `noises`, the variances of the noise components. If `covariance` is given, this noise is
            used only for messages without a covariance. A message that has no covariance is skipped and
            counted if this noise is also missing.
        vector: field with the measured components as a vector. The channel's metadata list the names of
            its entries in `components`, in any order; the components of a position need no names. By
            default, every component is a separate field.
        noises: number of noise components that `measure` receives as arguments; this noise is not added.
        covariance: field with the covariance of the vector; with `read`, stream -> (n, m, m), NaN if
            unknown.
        reference: map to whose points the messages refer, or several maps; every message then refers to
            one point of each.
        fields: fields of the schema with values in addition to the measurement, such as the pose of a
            moving sensor, each with its number of components. In `reference`, these values follow the
            points and the control.
        is_numbered: whether `reference` ends with the numbers of the points.
        control: the model's control, if the measurement depends on it; `reference` then contains the
            control at the stamp, after the points. It must be `interpolated`.
        read: stream -> (n, measured), for values that are computed from a message, such as a
            pseudo-measurement; NaN for missing components.
        delay: parameter with the delay, in s, from a measurement to the stamp of its message.
        linear, jacobian, moments: as for `Motion`: jacobian(state, reference, parameters, by_state);
            moments(mean, covariance, reference, parameters, predicted, spread, cross) fills the mean of
            the measurement (m,), its covariance (m, m) including noise, and its covariance with the
            state (t, m).
        log_likelihood: (state, measured, reference, parameters) -> log p(measured | state), for methods
            that can use it.
        stated: parameters that its channel may state in another form: metadata -> number, or NaN if it
            is not stated.
    """

    topic: str
    schema: Schema
    measured: Components
    measure: Measure
    noise: OfParameters | None = None
    noises: int = 0
    vector: str = ""
    covariance: str | Callable[[Stream], Floats] = ""
    reference: Map | tuple[Map, ...] | None = None
    fields: Mapping[str, int] = field(default_factory=dict)
    is_numbered: bool = False
    control: Control | None = None
    read: Callable[[Stream], Floats] | None = None
    delay: str = ""
    linear: bool = False
    jacobian: MeasurementJacobian | None = None
    moments: MeasurementMoments | None = None
    log_likelihood: LogLikelihood | None = None
    stated: Mapping[str, Callable[[Mapping[str, str]], float]] = field(default_factory=dict)

    @property
    def maps(self) -> tuple[Map, ...]:
        """Maps of the points to which a message refers."""
        return (
            self.reference
            if isinstance(self.reference, tuple)
            else (self.reference,)
            if self.reference
            else ()
        )

    @property
    def control_start(self) -> int:
        """Number of entries of `reference` before the control; these are the entries of the points."""
        return sum(each.size for each in self.maps)

    @property
    def reference_size(self) -> int:
        """Number of entries of `reference`: points, control, fields, and numbers of the points."""
        controls = len(self.control.components) if self.control else 0
        numbers = len(self.maps) if self.is_numbered else 0
        return self.control_start + controls + sum(self.fields.values()) + numbers


@lru_cache(maxsize=64)
def fix_sensor(places: tuple[int, ...]) -> Sensor:
    """Make the sensor of position fixes for a state with x, y and perhaps z at these indices."""

    def position(state: Numbers, reference: Numbers, parameters: Settings) -> Numbers:
        return tuple(state[place] for place in places)

    def fix_noise(parameters: Settings) -> Numbers:
        return (parameters.sigma_fix_m**2,) * len(places)

    return Sensor(
        FIX,
        schemas.POSITION_FIX,
        dict.fromkeys(POSITION[: len(places)], "linear"),
        position,
        fix_noise,
        vector="position_m",
        covariance="covariance_m2",
        linear=True,
    )


@dataclass(frozen=True, eq=False)
class Correction:
    """Correction of a state along a curve, such as the circle that a position follows with the heading.

    If the state is very uncertain in one direction of its error, such as the heading, its distribution
    is not an ellipsoid: as a function of the error in this direction, the mean of the other components
    follows a curve. `slope` (t,) is the tangent of the curve, P d / d' P d with the covariance P and the
    direction d. At a step of zero, the derivative of the moved state with respect to the step must be
    the identity matrix, so that small steps move every component separately.

    Attributes:
        along: state -> d (t,).
        move: (state, step, slope) -> state after an update by a step (t,) of the tangent space.
        step: (state, target, slope) -> the step with which `back` moves the state to the target.
        back: (state, step, slope) -> state after a step of a smoother's backward pass.
    """

    along: OfState
    move: AlongSlope
    step: AlongSlope
    back: AlongSlope


@renamed(estimable="augmentable")
@dataclass(frozen=True, eq=False)
class Model:
    """Model of one kind of object; a log may contain several objects, each under its own prefix.

    Attributes:
        summary: description in one line.
        state: names of the components, with their kinds; the four components of a quaternion are
            adjacent.
        parameters: type of its parameters.
        sensors: all sensors that the model can use; a log fits if it has any of them. A model with a
            position (linear `x_m` and `y_m`, perhaps `z_m`) also uses position fixes; see `all_sensors`.
        motion: motion of the state.
        modes: motions by name, including `motion`, for methods with several modes.
        switching: changes of the object between its modes.
        control: input that drives the motion; a log without this topic does not fit.
        prior, truth: topics of the prior and of the true states, under the prefix.
        output: last part of the name of the estimates' topic.
        system: the `system` that a channel's metadata must name, if any.
        needs_sensor: whether a log fits only if it has at least one of the model's sensors.
        start: assumptions for a log without a prior; None if the model does not fit such a log.
        takes_fixes: whether the model can use position fixes.
        correct: correction of the state by an update; None if every component moves separately.
        by_name: whether the model is used only if the user names it, because it also fits logs of other
            models.
        augmentable: parameters that can be added to the state, with their kinds (linear or angle): those
            that motion and sensors read, except noise. See
            `fuselog.replay.inference.model.augmentation`.
        calibration: parameters for the mounting, scale, bias and delay of sensors, each with the largest
            standard deviation of a useful estimate; an estimate with a larger standard deviation is
            reported as undetermined.
        owned: map from the name of each parameter that belongs to a single topic to this topic and the
            name of the general parameter. See `fuselog.replay.inference.model.own_parameters`.

    An object that moves on a line; its distance from the origin is measured:

    >>> import numpy as np
    >>> from fuselog.recorders.log import schemas
    >>> class OnALine(ModelParameters):
    ...     sigma_m: float = 0.1
    >>> def move(state, control, duration_s, parameters):
    ...     return state[0] + duration_s * state[1], state[1]
    >>> def move_noise(state, duration_s, parameters):
    ...     return 0.0, 0.01 * duration_s
    >>> def measure(state, reference, parameters):
    ...     return (np.abs(state[0]),)
    >>> def measure_noise(parameters):
    ...     return (parameters.sigma_m**2,)
    >>> ranges = Sensor("range", schemas.RANGE, {"range_m": "linear"}, measure, measure_noise)
    >>> state = {"x_m": "linear", "vx_mps": "linear"}
    >>> model = Model("on a line", state, OnALine, (ranges,), Motion(move, move_noise, linear=True))
    >>> model.size, model.kinds
    (2, ('linear', 'linear'))

    `fuselog.replay.inference.model.checking.check_model` tests whether the functions match the
    declarations:

    >>> from dataclasses import replace
    >>> from fuselog.replay.inference.model.checking import check_model
    >>> check_model(model)
    on a line: 2 functions at 20 states
    move (...): derivatives by state; angles, jumps and lengths; linear; variances
    measure (...): derivatives by state; angles, jumps and lengths; variances
    >>> check_model(replace(model, sensors=(replace(ranges, linear=True),)))
    Traceback (most recent call last):
    AssertionError: measure (...) is declared linear, but the derivative of range_m by x_m changes ...
    """

    summary: str
    state: Components
    parameters: type[ModelParameters]
    sensors: tuple[Sensor, ...]
    motion: Motion
    modes: Mapping[str, Motion] | None = None
    switching: Switching | None = None
    control: Control | None = None
    prior: str = "prior"
    truth: str = "truth"
    output: str = "state"
    system: str = ""
    needs_sensor: bool = True
    augmentable: Components = field(default_factory=dict)
    calibration: Mapping[str, float] = field(default_factory=dict)
    owned: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    start: Start | None = None
    correct: Correction | None = None
    takes_fixes: bool = True
    by_name: bool = False

    @cached_property
    def all_sensors(self) -> tuple[Sensor, ...]:
        """All sensors, including a sensor of position fixes unless the model defines its own."""
        names = [name for name in POSITION if self.state.get(name) == "linear"]
        has_position = names[:2] == list(POSITION[:2])
        has_own = any(sensor.topic == FIX for sensor in self.sensors)
        if has_own or not (has_position and self.takes_fixes):
            return self.sensors
        components = list(self.state)
        return (*self.sensors, fix_sensor(tuple(map(components.index, names))))

    def key_of(self, name: str) -> str:
        """Return the key that sets a parameter: `/TOPIC.NAME` if it belongs to a topic.

        Args:
            name: name of the parameter.
        """
        return ".".join(self.owned[name]) if name in self.owned else name

    def kind_of(self, name: str) -> str:
        """Return the general parameter that a topic's parameter replaces; other names are unchanged.

        Args:
            name: name of the parameter.
        """
        return self.owned[name][1] if name in self.owned else name

    @property
    def finds_start(self) -> bool:
        """Whether the model finds its initial state from messages; see `Start.find`."""
        return self.start is not None and self.start.find is not None

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the state's components."""
        return tuple(self.state.values())

    @property
    def size(self) -> int:
        """Number of components of the state."""
        return len(self.state)

    @cached_property
    def tangent(self) -> int:
        """Number of tangent components: an orientation has three, although it has four in the state."""
        return tangent_size(self.kinds)

    @property
    def controls(self) -> int:
        """Number of components of the control."""
        return len(self.control.components) if self.control else 0
