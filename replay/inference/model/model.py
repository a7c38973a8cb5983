"""What a model is: how a state moves and what sensors say of it, nothing of how it is estimated.

A model is written once, as plain component-first functions: they take tuples of components and return
tuples, and run on arrays as well. Every method (see `replay.inference.kalman.methods`) estimates the
state of every model that gives what the method needs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat

from recorders.errors import BadInput
from recorders.log import Schema, Stream, schemas
from recorders.parameters import Parameters
from replay.engine.arrays import Floats, Function
from replay.engine.vectors.components import Components
from replay.engine.vectors.tangent import are_kinds
from replay.inference.linear_algebra.manifold import tangent_size
from replay.tracing.functions import place_of

FIX, POSITION = "fix", ("x_m", "y_m", "z_m")


class ModelParameters(Parameters):
    """Options of every model.

    A parameter that is none is what the channels of the log state: the sensor's own first, then those
    of control, prior and the other sensors.

    Attributes:
        gate_probability: a measurement whose NIS is beyond this quantile of chi-square is not used; 1
            uses all.
        gate_reopens_s: the gate is open for a sensor whose last accepted measurement is older, so that a
            filter that has drifted, as in an outage, accepts what brings it back.
        inflate_nis: an innovation with a greater NIS counts with a larger covariance, which gives it
            this NIS.
        student_freedom: innovations count as if they had Student's distribution with so many degrees of
            freedom.
        switch_nis: above this NIS a measurement counts less and less, as in dynamic covariance scaling.
        sigma_fix_m: standard deviation of each component of a fix that does not state its covariance.
    """

    gate_probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    gate_reopens_s: PositiveFloat | None = None
    inflate_nis: PositiveFloat | None = None
    student_freedom: PositiveFloat | None = None
    switch_nis: PositiveFloat | None = None
    sigma_fix_m: PositiveFloat | None = None


@dataclass(frozen=True, eq=False)
class Map:
    """What measurements are about, by number: the fixed points of a topic of the log.

    Attributes:
        topic: the map's.
        schema: of its messages.
        number: the field that numbers them.
        point: the vector field of the point.
        components: of the point, by name.
        of: the measurement's field that says which point; where it names none, the measurement says
            nothing of the state.
    """

    topic: str
    schema: Schema
    number: str
    point: str
    components: Components
    of: str = "target_id"

    @property
    def size(self) -> int:
        """How many components a point has."""
        return len(self.components)


@dataclass(frozen=True, eq=False)
class Control:
    """What drives the motion.

    Attributes:
        topic: its name, under the prefix of what is estimated.
        schema: of its messages.
        components: their names, which are the messages' fields unless `read` is given.
        read: stream -> (n, components).
        interpolated: the control is linear between two messages, and the motion over a step gets the
            mean of its two ends; else a message holds until the next one.
        initial: what holds before the first message; zeros unless given.
        gap: the parameter that says how long, in s, an interpolated control may be silent: what is
            estimated ends there, or is unknown until it speaks again, see `Motion.lost`.
        delay: the parameter that says how long before its stamp, in s, a message was measured.
        estimates: whether there are estimates at its stamps too, not at those of sensors alone.
        instead: other topics that the components of these names are taken from where the log has them,
            such as a gyro's turn rate in place of the wheels'.
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
    instead: tuple["Control", ...] = ()


@dataclass(frozen=True, eq=False)
class Motion:
    """How the state moves.

    Attributes:
        move: (state, control, duration_s, parameters) -> state. Where `noises` says how many numbers of
            noise enter other than by addition, (state, control, noise, duration_s, parameters).
        noise: (state, duration_s, parameters) -> the variances of the additive noise in the tangent
            space, or the rows of its covariance's lower triangle; with `noises`, the variances of these.
        noise_block: how many components the triangle is of, where variances of the others follow it; of
            all of them for zero.
        control_noise: (duration_s, parameters) -> the variances of the control's error over the
            duration; it enters the state through the derivative by the control.
        lost: (state, duration_s, parameters) -> the variances in the tangent space that are added where
            the control was silent for longer than its `gap`. The state stays, so that they cover what it
            may have moved meanwhile; there are no estimates between.
        linear: whether `move` is linear in the state: sampling methods then need no samples.
        jacobians: (state, control, duration_s, parameters, by_state, by_control) fills both; only where
            they are written by hand, the graph of `move` gives them else.
        moments: (mean, covariance, control, duration_s, parameters) moves both in place, exactly and
            without the additive noise; for the method `analytic`.
    """

    move: Function
    noise: Function | None = None
    noises: int = 0
    noise_block: int = 0
    control_noise: Function | None = None
    lost: Function | None = None
    linear: bool = False
    jacobians: Function | None = None
    moments: Function | None = None

    def triangle(self, tangent: int) -> int:
        """How many numbers `noise` returns where it is no variances alone."""
        block = self.noise_block or tangent
        return block * (block + 1) // 2 + tangent - block


@dataclass(frozen=True, eq=False)
class Switching:
    """How a thing changes from mode to mode: a Markov chain in continuous time.

    Attributes:
        rates: (parameters) -> how often per second it changes from the first mode to each of the others,
            in their order, then from the second one, and so on: M (M - 1) numbers of M modes.
        initial: (parameters) -> the modes' probabilities at the prior's time; equal ones unless given.
    """

    rates: Function
    initial: Function | None = None


@dataclass(frozen=True, eq=False)
class Sensor:
    """What a sensor measures of the state.

    Attributes:
        topic: its name, under the prefix of what is estimated; a slash in front makes it everybody's.
        schema: of its messages. A GeodeticFix serves for a PositionFix, through the log's origin.
        measured: the components by name, with their kinds ("linear" or "angle").
        measure: (state, about, parameters) -> what it measures; `about` is the point of the map, or
            empty. With `noises`, (state, noise, about, parameters). A component that says nothing of
            this state, or has no derivative there, is NaN: as if the message lacked it.
        noise: (parameters) -> variances of the measured components, or the rows of a lower triangle;
            with `noises`, the variances of these. With `covariance`, for messages that lack theirs: what
            has neither is passed over, and counted.
        vector: the field that holds what is measured as a vector, by the names of its components; else
            every component is a field of its own.
        covariance: the field that holds the vector's covariance; with `read`, stream -> (n, m, m), NaN
            where it is unknown.
        about: what the message is about: a point of a map, or one of each of several maps.
        fields: numbers that a message states beside what it measures, such as the pose of a sensor that
            moves: fields of the schema, and how many components each has. `about` has them behind the
            points and the control.
        is_numbered: whether `about` ends with the numbers of these points.
        control: the model's, which has to be interpolated, where what is measured depends on it:
            `about` then ends with its numbers at the stamp.
        read: stream -> (n, measured), NaN where a component is missing, for what is computed of a
            message: a pseudo-measurement.
        delay: the parameter that says how long before its stamp, in s, a message was measured.
        linear, jacobian, moments: as for `Motion`: jacobian(state, about, parameters, by_state);
            moments(mean, covariance, about, parameters, predicted, spread, cross) fills the mean of the
            measurement (m,), its covariance (m, m), noise included, and that with the state (t, m).
        log_likelihood: (state, measured, about, parameters) -> log p(measured | state), for methods that
            can use it.
    """

    topic: str
    schema: Schema
    measured: Components
    measure: Function
    noise: Function | None = None
    noises: int = 0
    vector: str = ""
    covariance: str | Callable[[Stream], Floats] = ""
    about: Map | tuple[Map, ...] | None = None
    fields: Mapping[str, int] = field(default_factory=dict)
    is_numbered: bool = False
    control: Control | None = None
    read: Callable[[Stream], Floats] | None = None
    delay: str = ""
    linear: bool = False
    jacobian: Function | None = None
    moments: Function | None = None
    log_likelihood: Function | None = None

    @property
    def maps(self) -> tuple[Map, ...]:
        """The maps of the points that a message is about."""
        return self.about if isinstance(self.about, tuple) else (self.about,) if self.about else ()

    @property
    def control_start(self) -> int:
        """How many numbers of `about` come before those of the control: the points' components."""
        return sum(each.size for each in self.maps)

    @property
    def about_size(self) -> int:
        """How many numbers `measure` gets as `about`: points, control, fields, the points' numbers."""
        controls = len(self.control.components) if self.control else 0
        numbers = len(self.maps) if self.is_numbered else 0
        return self.control_start + controls + sum(self.fields.values()) + numbers


@lru_cache(maxsize=64)
def fix_sensor(places: tuple[int, ...]) -> Sensor:
    """The sensor of position fixes, of a state that has x, y and perhaps z in these places."""

    def position(state: Any, about: Any, parameters: Any) -> Any:
        return tuple(state[place] for place in places)

    def fix_noise(parameters: Any) -> Any:
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
class Start:
    """What is assumed of a log that has no prior: it was not made for the model.

    It begins at the first message that measures components of the state by their names, a fix or a pose
    with its covariance. What that does not measure is zero, and as uncertain as is said here. With no
    sensor at all the thing begins at zero, which is where its frame is. Sensors that do not measure the
    state itself need a prior.

    Attributes:
        sigmas: standard deviations of the state's components, linear ones and angles.
        parameters: numbers that no channel of such a log states.
        align: (path, places, covariances, span_s, parameters) -> mean and covariance of the state, or
            None where these do not tell it yet. The path (k, n) is where the control alone leads from
            zero, at the first k fixes (k, 2) with their covariances (k, 2, 2), which span so much time.
            The state is that at the last of them, and begins just after it: they are used up. For a
            state of which a position tells too little.
        find: (streams, parameters) -> `Started`, in place of all that, of the first messages of a run by
            the model's names for their topics, and the maps; for a state that is found from several
            messages together. Raises BadInput where they do not tell it. Such a model needs a sensor.
        suspect: (streams, parameters) -> sentences: what looks wrong in these messages where the log has
            a prior. It is only said.
    """

    sigmas: Mapping[str, float]
    parameters: Mapping[str, float] = field(default_factory=dict)
    align: Callable[..., tuple[Floats, Floats] | None] | None = None
    find: "Callable[[Mapping[str, Stream], Any], Started] | None" = None
    suspect: Callable[[Mapping[str, Stream], Any], list[str]] | None = None


class Started(NamedTuple):
    """The start of a run: its stamp, mean (n,), covariance (t, t), and how it was found, in words."""

    time_ns: int
    mean: Floats
    covariance: Floats
    how: str


@dataclass(frozen=True, eq=False)
class Correction:
    """How a state is corrected where one direction of its error, such as a heading, bends all others.

    A belief that is wide in that direction is no ellipsoid: given how far the state is off along it, the
    mean of the rest moves on a curve. `slope` (t,) is the tangent there, P d / d' P d with the
    covariance P and the direction d. Small steps move every component by itself: the derivative of the
    moved state at zero is the unit matrix.

    Attributes:
        along: state -> d (t,).
        move: (state, step, slope) -> the state after an update's step (t,) of its tangent space.
        step: (state, target, slope) -> the step that `back` takes from the state to the target.
        back: (state, step, slope) -> the state after a step of a smoother's way back.
    """

    along: Function
    move: Function
    step: Function
    back: Function


@dataclass(frozen=True, eq=False)
class Model:
    """A model of one kind of thing; a log may hold several of them, each under its own prefix.

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
        estimable: the parameters that may become part of the state, linear or angles, see
            `replay.inference.model.augmentation`: those that motion and sensors read, and no noise.

    A thing on a line, whose range from the origin is measured:

    >>> from recorders.log import schemas
    >>> class OnALine(ModelParameters):
    ...     sigma_m: float = 0.1
    >>> def move(state, control, duration_s, parameters):
    ...     return state[0] + duration_s * state[1], state[1]
    >>> def move_noise(state, duration_s, parameters):
    ...     return 0.0, 0.01 * duration_s
    >>> def measure(state, about, parameters):
    ...     return (np.abs(state[0]),)
    >>> def measure_noise(parameters):
    ...     return (parameters.sigma_m**2,)
    >>> ranges = Sensor("range", schemas.RANGE, {"range_m": "linear"}, measure, measure_noise)
    >>> state = {"x_m": "linear", "vx_mps": "linear"}
    >>> model = Model("on a line", state, OnALine, (ranges,), Motion(move, move_noise, linear=True))
    >>> model.size, model.kinds
    (2, ('linear', 'linear'))

    `replay.inference.model.checking.check_model` says whether the functions keep to what is declared:

    >>> from dataclasses import replace
    >>> from replay.inference.model.checking import check_model
    >>> check_model(model)
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
    estimable: Components = field(default_factory=dict)
    start: Start | None = None
    correct: Correction | None = None
    takes_fixes: bool = True
    by_name: bool = False

    @property
    def all_sensors(self) -> tuple[Sensor, ...]:
        """The sensors, and that of position fixes unless the model has one of its own."""
        names = [name for name in POSITION if self.state.get(name) == "linear"]
        has_position = names[:2] == list(POSITION[:2])
        has_own = any(sensor.topic == FIX for sensor in self.sensors)
        if has_own or not (has_position and self.takes_fixes):
            return self.sensors
        components = list(self.state)
        return (*self.sensors, fix_sensor(tuple(map(components.index, names))))

    @property
    def finds_start(self) -> bool:
        """Whether the model finds where to start itself, see `Start.find`."""
        return self.start is not None and self.start.find is not None

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the state's components."""
        return tuple(self.state.values())

    @property
    def size(self) -> int:
        """How many components the state has."""
        return len(self.state)

    @property
    def tangent(self) -> int:
        """How many its tangent space has: an orientation has four components and three."""
        return tangent_size(self.kinds)

    @property
    def controls(self) -> int:
        """How many components the control has."""
        return len(self.control.components) if self.control else 0


def check_state(where: str, model: Model) -> None:
    """Raise BadInput where a state's kinds are none."""
    if not are_kinds(model.kinds):
        raise BadInput(
            f"{where}: a state of kinds {', '.join(model.kinds)}; give linear, angle, axis (two "
            "side by side) or quaternion (four side by side)"
        )


def check_motion(where: str, model: Model, motion: Motion, parameters: Any) -> None:
    """Call a motion's functions once, uncompiled.

    `parameters` has a number for every parameter. Raises BadInput where a function fails, or
    returns what the model denies.
    """
    state, control = trial_state(model.kinds), (0.0,) * model.controls
    sizes = (model.tangent, motion.triangle(model.tangent))
    entering = ((0.0,) * motion.noises,) if motion.noises else ()
    _check(where, motion.move, (state, control, *entering, 1.0, parameters), (model.size,))
    if motion.noises and (motion.noise is None or motion.control_noise is not None):
        raise BadInput(
            f"{where}: noise that is not additive needs its variances, `noise`, and takes that of the "
            "control with it; leave out `control_noise`"
        )
    if motion.noise is not None:
        wanted = (motion.noises,) if motion.noises else sizes
        _check(where, motion.noise, (state, 1.0, parameters), wanted)
    if motion.lost is not None:
        _check(where, motion.lost, (state, 1.0, parameters), (model.tangent,))
    if motion.control_noise is not None:
        _check(where, motion.control_noise, (1.0, parameters), (model.controls,))


def check_correction(where: str, model: Model) -> None:
    """Call the functions of how a model is corrected once, uncompiled; see `check_motion`."""
    if model.correct is not None:
        state, error = trial_state(model.kinds), (0.0,) * model.tangent
        _check(where, model.correct.along, (state,), (model.tangent,))
        for moved in (model.correct.move, model.correct.back):
            _check(where, moved, (state, error, error), (model.size,))
        _check(where, model.correct.step, (state, state, error), (model.tangent,))


def check_switching(where: str, model: Model, parameters: Any) -> None:
    """Call the functions of a model's switching once, uncompiled; see `check_motion`."""
    assert model.modes
    assert model.switching
    modes, switching = len(model.modes), model.switching
    _check(where, switching.rates, (parameters,), (modes * (modes - 1),))
    if switching.initial is not None:
        _check(where, switching.initial, (parameters,), (modes,))


def switching_of(where: str, model: Model, parameters: Any) -> tuple[Floats, Floats]:
    """The rates (M (M - 1),) between a model's modes and their initial probabilities (M,).

    Raises BadInput where a rate is negative, or the probabilities are none.
    """
    assert model.modes
    assert model.switching
    names, switching = list(model.modes), model.switching
    rates = np.array(switching.rates(parameters), float)
    changes = [(begin, end) for begin in names for end in names if begin != end]
    for (begin, end), rate in zip(changes, rates.tolist(), strict=True):
        if not 0.0 <= rate < np.inf:
            raise BadInput(
                f"{where}: the rate from mode {begin} to {end} is {rate:g} per second; give zero or more"
            )
    initial = np.full(len(names), 1.0 / len(names))
    if switching.initial is not None:
        initial = np.array(switching.initial(parameters), float)
    if not (np.all(initial >= 0.0) and abs(initial.sum() - 1.0) < 1e-9):
        told = ", ".join(f"{name} {each:g}" for name, each in zip(names, initial, strict=True))
        raise BadInput(
            f"{where}: the initial probabilities of the modes are {told}; give numbers of zero or more "
            "whose sum is one"
        )
    return rates, initial


def check_sensor(where: str, model: Model, sensor: Sensor, parameters: Any) -> None:
    """Call a sensor's functions once, uncompiled; see `check_motion`."""
    where, size = f"{where}, sensor {sensor.topic}", len(sensor.measured)
    unknown = sorted(set(sensor.measured.values()) - {"linear", "angle"})
    if unknown:
        raise BadInput(f"{where}: measures a component of kind {unknown[0]}; give linear or angle")
    state, about = trial_state(model.kinds), (1.0,) * sensor.about_size
    entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
    _check(where, sensor.measure, (state, *entering, about, parameters), (size,))
    if sensor.noise is None and (sensor.noises or not sensor.covariance):
        raise BadInput(f"{where}: states no noise; give `noise`, or `covariance`, the field that has it")
    if isinstance(sensor.covariance, str) and sensor.covariance and not sensor.vector:
        raise BadInput(
            f"{where}: the covariance {sensor.covariance} needs the field that it is of; give `vector`"
        )
    if callable(sensor.covariance) and sensor.read is None:
        raise BadInput(
            f"{where}: reads covariances of fields that it does not read; give `read` as well"
        )
    if sensor.noise is not None and not sensor.covariance:
        wanted = (sensor.noises,) if sensor.noises else (size, size * (size + 1) // 2)
        _check(where, sensor.noise, (parameters,), wanted)


def trial_state(kinds: tuple[str, ...]) -> tuple[float, ...]:
    """A state at which to try functions: numbers that differ, unit vectors."""
    found: list[float] = []
    while len(found) < len(kinds):
        kind = kinds[len(found)]
        number = 0.1 * (1 + len(found))
        found += {"axis": [0.6, 0.8], "quaternion": [0.1, 0.5, -0.5, 0.7]}.get(kind, [number])
    return tuple(found)


def _check(where: str, function: Function, arguments: tuple[Any, ...], sizes: tuple[int, ...]) -> None:
    what = f"{where}: {place_of(function)}"
    with np.errstate(all="ignore"):
        try:
            found = function(*arguments)
        except Exception as error:
            raise BadInput(f"{what} raised {type(error).__name__}: {error}") from error
    wanted = " or ".join(str(size) for size in dict.fromkeys(sizes))
    if not isinstance(found, tuple):
        raise BadInput(f"{what} returns a {type(found).__name__}; return a tuple of {wanted} components")
    if len(found) not in sizes:
        raise BadInput(f"{what} returns {len(found)} components; {wanted} are needed")
