"""Defines a model: how a state moves, and what sensors measure of it.

A model is written once, as plain component-first functions: they take tuples of components and return
tuples, and run on arrays as well. Every method (see `fuselog.replay.inference.kalman.methods`) estimates
the state of every model that gives what the method needs.
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
    """Describes a map: fixed points of a topic, to which measurements refer by number.

    Attributes:
        topic: the map's.
        schema: of its messages.
        number: the field that numbers them.
        point: the vector field of the point.
        components: of the point, by name.
        of: the measurement's field that says which point; where it names none, the measurement has
            no information on the state.
    """

    topic: str
    schema: Schema
    number: str
    point: str
    components: Components
    of: str = "target_id"

    @property
    def size(self) -> int:
        """Count the components of a point."""
        return len(self.components)


@renamed(instead="fallbacks")
@dataclass(frozen=True, eq=False)
class Control:
    """Describes what drives the motion.

    Attributes:
        topic: its name, under the prefix of what is estimated.
        schema: of its messages.
        components: their names, which are the messages' fields unless `read` is given.
        read: stream -> (n, components).
        interpolated: the control is linear between two messages, and the motion over a step gets the
            mean of its two ends; else a message holds until the next one.
        initial: what holds before the first message; zeros unless given.
        gap: the parameter that says how long, in s, an interpolated control may be missing: what is
            estimated ends there, or is unknown until it speaks again, see `Motion.gap_noise`.
        delay: the parameter that says how long before its stamp, in s, a message was measured.
        estimates: whether there are estimates at its stamps too, not at those of sensors alone.
        fallbacks: other topics that the components of these names are taken from where the log has them,
            such as a gyro's turn rate in place of the wheels'.
        noise: of one of these, the parameters that are its noise, by the names under which its channel
            may state them; no other channel is asked for them where it drives.
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
    """Describes how the state moves.

    Attributes:
        move: (state, control, duration_s, parameters) -> state; with `noises`, (state, control, noise,
            duration_s, parameters) -> state.
        noise: (state, duration_s, parameters) -> the variances of the additive noise in the tangent
            space, or the rows of its covariance's lower triangle; with `noises`, the variances of these.
        noises: how many numbers of noise enter `move` other than by addition.
        noise_block: how many components the triangle is of, where variances of the others follow it; of
            all of them for zero.
        control_noise: (duration_s, parameters) -> the variances of the control's error over the
            duration; it enters the state through the derivative by the control.
        gap_noise: (state, duration_s, parameters) -> the variances in the tangent space that are added
            where the control was silent for longer than its `gap`. The state stays, so that they cover
            what it may have moved meanwhile; there are no estimates between.
        linear: whether `move` is linear in the state: sampling methods then need no samples.
        jacobians: (state, control, duration_s, parameters, by_state, by_control) fills both; only where
            they are written by hand, the graph of `move` gives them else.
        moments: (mean, covariance, control, duration_s, parameters) moves both in place, exactly and
            without the additive noise; for the method `analytic`.
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
        """Count the numbers of `noise` where they are a triangle, for a state of size `tangent`."""
        block = self.noise_block or tangent
        return block * (block + 1) // 2 + tangent - block


@dataclass(frozen=True, eq=False)
class Switching:
    """Describes how a target changes from mode to mode: a Markov chain in continuous time.

    Attributes:
        rates: (parameters) -> how often per second it changes from the first mode to each of the others,
            in their order, then from the second one, and so on: M (M - 1) numbers of M modes.
        initial: (parameters) -> the modes' probabilities at the prior's time; equal ones unless given.
    """

    rates: OfParameters
    initial: OfParameters | None = None


@renamed(about="reference")
@dataclass(frozen=True, eq=False)
class Sensor:
    """Describes what a sensor measures of the state.

    Attributes:
        topic: its name, under the prefix of what is estimated; a slash in front makes it everybody's.
        schema: of its messages. A GeodeticFix serves for a PositionFix, through the log's origin.
        measured: the components by name, with their kinds ("linear" or "angle").
        measure: (state, reference, parameters) -> what it measures; `reference` is the point of the map,
            or empty. With `noises`, (state, noise, reference, parameters). A component without
            information of this state, or has no derivative there, is NaN: as if the message lacked it.
        noise: (parameters) -> variances of the measured components, or the rows of a lower triangle;
            with `noises`, the variances of these. With `covariance`, for messages that lack theirs: what
            has neither is passed over, and counted.
        vector: the field that holds what is measured as a vector. The channel's metadata say in
            `components` how its entries are called, in any order; those of a position need no names.
            Unless this is given, every component is a field of its own.
        noises: how many numbers of noise enter `measure` other than by addition.
        covariance: the field that holds the vector's covariance; with `read`, stream -> (n, m, m), NaN
            where it is unknown.
        reference: what the message is about: a point of a map, or one of each of several maps.
        fields: numbers that a message states beside what it measures, such as the pose of a sensor that
            moves: fields of the schema, and how many components each has. `reference` has them behind
            the points and the control.
        is_numbered: whether `reference` ends with the numbers of these points.
        control: the model's, where what is measured depends on it: `reference` then has its numbers at
            the stamp, behind the points. It has to be `interpolated`: one that is held is refused.
        read: stream -> (n, measured), NaN where a component is missing, for what is computed of a
            message: a pseudo-measurement.
        delay: the parameter that says how long before its stamp, in s, a message was measured.
        linear, jacobian, moments: as for `Motion`: jacobian(state, reference, parameters, by_state);
            moments(mean, covariance, reference, parameters, predicted, spread, cross) fills the mean of
            the measurement (m,), its covariance (m, m), noise included, and that with the state (t, m).
        log_likelihood: (state, measured, reference, parameters) -> log p(measured | state), for methods
            that can use it.
        stated: parameters that its channel may state in another form: metadata -> number, NaN where it
            does not.
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
        """List the maps of the points that a message refers to."""
        return (
            self.reference
            if isinstance(self.reference, tuple)
            else (self.reference,)
            if self.reference
            else ()
        )

    @property
    def control_start(self) -> int:
        """Count the numbers of `reference` before those of the control: the points' components."""
        return sum(each.size for each in self.maps)

    @property
    def reference_size(self) -> int:
        """Count the numbers of `reference`: points, control, fields, the points' numbers."""
        controls = len(self.control.components) if self.control else 0
        numbers = len(self.maps) if self.is_numbered else 0
        return self.control_start + controls + sum(self.fields.values()) + numbers


@lru_cache(maxsize=64)
def fix_sensor(places: tuple[int, ...]) -> Sensor:
    """Make the sensor of position fixes, of a state that has x, y and perhaps z in these places."""

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
    """Describes how a state is corrected where one direction of its error, a heading's, bends others.

    A belief that is wide in that direction is no ellipsoid: given how far the state is off along it, the
    mean of the rest moves on a curve. `slope` (t,) is the tangent there, P d / d' P d with the
    covariance P and the direction d. Small steps move every component by itself: the derivative of the
    moved state at zero is the unit matrix.

    Attributes:
        along: state -> d (t,).
        move: (state, step, slope) -> the state after an update's step (t,) of its tangent space.
        step: (state, target, slope) -> the step that `back` takes from the state to the target.
        back: (state, step, slope) -> the state after a step of a smoother's backward pass.
    """

    along: OfState
    move: AlongSlope
    step: AlongSlope
    back: AlongSlope


@renamed(estimable="augmentable")
@dataclass(frozen=True, eq=False)
class Model:
    """Describes a model of one kind of target; a log may hold several, each under its own prefix.

    Attributes:
        summary: what it is, in one line.
        state: the components by name, with their kinds; the four of a quaternion side by side.
        parameters: their type.
        sensors: all it can use; any of them makes a log fit. A model with a position, linear `x_m` and
            `y_m` or these and `z_m`, takes fixes as well, see `all_sensors`.
        motion: how the state moves.
        modes: other motions by name, for methods of several; `motion` is then one of them.
        switching: how the thing changes between its modes.
        control: what drives it; a log without this topic does not fit.
        prior, truth: topics with the first Gaussian and the reference, under the prefix.
        output: the last part of the estimates' topic.
        system: what a channel's metadata has to name as its `system`, if anything.
        needs_sensor: whether a log without any of its sensors does not fit.
        start: what is assumed of a log without the prior; None where that does not fit.
        takes_fixes: whether position fixes are sensors of it.
        correct: how an update moves the state where not every component moves by itself.
        by_name: whether it is only taken where it is named, since it fits the logs of other models too.
        augmentable: the parameters that may become part of the state, linear or angles, see
            `fuselog.replay.inference.model.augmentation`: those that motion and sensors read, and no
            noise.
        calibration: the parameters that say how sensors are mounted, scaled, biased and delayed, each
            with a useful standard deviation: what is known no better counts as not determined.
        owned: by their names the parameters that single topics have, each with the topic and what it is
            called there; see `fuselog.replay.inference.model.own_parameters`.

    A thing on a line, whose range from the origin is measured:

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

    `fuselog.replay.inference.model.checking.check_model` says whether the functions keep to what is
    declared:

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
        """List the sensors, with that of position fixes unless the model has one of its own."""
        names = [name for name in POSITION if self.state.get(name) == "linear"]
        has_position = names[:2] == list(POSITION[:2])
        has_own = any(sensor.topic == FIX for sensor in self.sensors)
        if has_own or not (has_position and self.takes_fixes):
            return self.sensors
        components = list(self.state)
        return (*self.sensors, fix_sensor(tuple(map(components.index, names))))

    def key_of(self, name: str) -> str:
        """Return the key by which a parameter is set: `/TOPIC.NAME` of one that a topic has.

        Args:
            name: the parameter's.
        """
        return ".".join(self.owned[name]) if name in self.owned else name

    def kind_of(self, name: str) -> str:
        """Return the parameter that one of a topic stands for; any other is its own.

        Args:
            name: the parameter's.
        """
        return self.owned[name][1] if name in self.owned else name

    @property
    def finds_start(self) -> bool:
        """Tell whether the model finds its own start, see `Start.find`."""
        return self.start is not None and self.start.find is not None

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """List the kinds of the state's components."""
        return tuple(self.state.values())

    @property
    def size(self) -> int:
        """Count the components of the state."""
        return len(self.state)

    @cached_property
    def tangent(self) -> int:
        """Count those of its tangent space: an orientation has four components and three."""
        return tangent_size(self.kinds)

    @property
    def controls(self) -> int:
        """Count the components of the control."""
        return len(self.control.components) if self.control else 0
