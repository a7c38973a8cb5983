"""Propagation of a Gaussian through a function by statistical linear regression at weighted samples.

Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014, (19)-(24);
(24) misprints the noise sample as y_{k,i}. On manifolds, samples are the mean plus tangent vectors, and
means are intrinsic: the weighted differences of samples from their mean sum to zero. If an angle is very
uncertain, samples are drawn closer to the mean; see `fuselog.replay.inference.kalman.wide_angles`.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from fuselog.replay.engine.arrays import AnyArgument, Floats, Integers, Numbers, varying
from fuselog.replay.inference.kalman.predict import (
    AddMotionNoise,
    LineariseMotion,
    motion_derivative,
    motion_noise,
    nothing,
)
from fuselog.replay.inference.kalman.steps import Innovate, Interval, Measurement, Predict, Workspace
from fuselog.replay.inference.kalman.update import (
    MeasurementNoise,
    message_layout,
    residual_of,
    sensor_noise,
)
from fuselog.replay.inference.kalman.wide_angles import narrowing, turning, unsuspected_rad, widen
from fuselog.replay.inference.linear_algebra.gaussian import cholesky
from fuselog.replay.inference.linear_algebra.manifold import (
    boxminus,
    boxplus,
    curved_blocks,
    is_flat,
    manifold_blocks,
    recentring,
    tangent_size,
)
from fuselog.replay.inference.linear_algebra.moments import (
    REGISTERS,
    axis_moments_of,
    axis_offset_of,
    lower_of,
    moments_of,
    offset_of,
    weighted_mean_of,
)
from fuselog.replay.inference.linear_algebra.tuples import filling, range_of, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.functions import MotionNoise, OfParameters
from fuselog.replay.inference.model.model import Motion, Sensor
from fuselog.replay.inference.sampling.sets import SampleSets
from fuselog.replay.tracing.functions import TracedFunction
from fuselog.replay.tracing.graph import INPUT

MEANS = 30  # maximum number of iterations of an intrinsic mean


@varying(0, points=1, weights=1)
class SampleMemory(NamedTuple):
    """Samples of N(0, I), and the arrays of a regression at these samples; N = t + noises.

    Attributes:
        points, weights, first, stride: see `fuselog.replay.inference.sampling.sets.SampleSets`.
        axes: (L,) index of the only entry of each point that may differ from zero, as in the unscented
            transform; empty if points have several such entries.
        unsuspected: largest standard deviation up to which angles need no special treatment; see
            `narrowing`.
        factor: (N, N) lower factor of the covariance of state (t) and noise.
        offsets: (L, N) tangent vectors from the mean to the samples.
        still: (n,) the mean plus a zero rotation; this addition normalises the mean.
        point, noise: (n,) one sample, and (noises,) the variances of the noise.
        values: (L, v) values of the function, as tangent vectors from a centre.
        centre, shift: mean of the values, in the space of the values, and weighted mean (v,) of their
            tangent vectors.
        joint: (N, v) covariance of points and values, if points are on axes.
    """

    points: Floats
    weights: Floats
    first: int
    stride: int
    axes: Integers
    unsuspected: float
    factor: Floats
    offsets: Floats
    still: Floats
    point: Floats
    noise: Floats
    values: Floats
    centre: Floats
    shift: Floats
    joint: Floats


def sample_memory(
    sets: SampleSets, kinds: Sequence[str], noises: int, outputs: Sequence[str]
) -> SampleMemory:
    """Allocate memory for the regression of a function of a state and its noise.

    Args:
        sets: samples of N(0, I) in t + noises dimensions.
        kinds: kinds of the state's components.
        noises: number of noise components of the function.
        outputs: kinds of the function's values.
    """
    count_of_sets, count, dimension = sets.points.shape
    values = tangent_size(outputs)
    axes = axes_of(sets.points[0])[: count if count_of_sets == 1 else 0]
    is_on_axes = len(axes) > 0
    return SampleMemory(
        *sets,
        axes=axes,
        unsuspected=unsuspected_rad(sets.points),
        factor=np.zeros((dimension, dimension)),
        offsets=np.empty((count, dimension)),
        still=np.empty(len(kinds)),
        point=np.empty(len(kinds)),
        noise=np.empty(noises),
        values=np.empty((count, values)),
        centre=np.empty(len(outputs)),
        shift=np.empty(values),
        joint=np.empty((dimension if is_on_axes else 0, values)),
    )


def axes_of(points: Floats) -> Integers:
    """Return the index (L,) of each point's only nonzero entry; empty if a point (L, N) has several."""
    is_on_axes = bool(np.all(np.count_nonzero(points, axis=1) <= 1))
    return np.asarray(np.argmax(points != 0.0, axis=1)[: len(points) if is_on_axes else 0])


def has_joint_moments(axes: Integers, states: int, values: int) -> bool:
    """Test whether the covariance of states and values is computed from points on axes.

    Args:
        axes: (L,) indices of the axes, see `axes_of`.
        states: number of tangent components of the state.
        values: number of tangent components of the values.
    """
    return len(axes) > 0 and states * values > REGISTERS


class Sampled(Protocol):
    """Function to sample; it depends on a state (n,), noise (noises,) and other `arguments`."""

    def __call__(
        self, state: Numbers, noise: Numbers, arguments: tuple[AnyArgument, ...], /
    ) -> Numbers: ...


class Sample(Protocol):
    """Function that evaluates another one at samples about a mean (n,) and returns the weights (L,).

    See `sampling`.
    """

    def __call__(
        self,
        mean: Floats | Numbers,
        arguments: tuple[AnyArgument, ...],
        variances: Numbers,
        sample_index: int,
        memory: SampleMemory,
        /,
    ) -> Floats: ...


class Regress(Protocol):
    """Function that propagates a mean (n,) and covariance (t, t) by a function; see `regression`."""

    def __call__(
        self,
        mean: Floats,
        covariance: Floats,
        arguments: tuple[AnyArgument, ...],
        variances: Numbers,
        spread: Floats,
        cross: Floats,
        sample_index: int,
        memory: SampleMemory,
        /,
    ) -> bool: ...


class Settle(Protocol):
    """Function that moves a centre (n,) to the intrinsic mean of values (L, v); see `settling`."""

    def __call__(self, weights: Floats, values: Floats, centre: Floats, shift: Floats, /) -> None: ...


def sampling(
    function: Sampled,
    kinds: tuple[str, ...],
    noises: int,
    outputs: tuple[str, ...],
    *,
    is_motion: bool = False,
) -> Sample:
    """Make the evaluation of `function(state, noise, arguments)` at weighted samples.

    Args:
        function: function to evaluate.
        kinds: kinds of the state's components.
        noises: number of noise components.
        outputs: kinds of the function's values.
        is_motion: whether the function is a motion.

    Returns:
        `sample(mean, arguments, variances, sample_index, memory)`, which uses sample set `sample_index`
        and returns its weights (L,). The leading block of `memory.factor` must be the factor of the
        state. The function fills `memory.offsets`, `memory.centre` (the intrinsic mean of the values)
        and `memory.values`; the tangent vectors from the mean are `memory.values` minus `memory.shift`.
        `variances` is the tuple of the noise variances.
    """
    t, components = tangent_size(kinds), len(kinds)
    size = t + noises
    read_state, read_noise = tuple_of(components), tuple_of(noises, t)
    add_curved, subtract = boxplus(kinds, is_curved=True), boxminus(outputs)
    straight = {c: first for kind, c, first, _ in manifold_blocks(kinds) if kind == "linear"}
    tangents = tuple(straight.get(c, -1) for c in range(components))
    # the factor is a lower triangle, so that points on later axes move only linear numbers
    end = max((first + width for _, _, first, width in curved_blocks(kinds)), default=0)
    fill_point = filling(components)
    fill, fill_offset, fill_noise = filling(len(outputs)), filling(size), filling(noises)
    lower, offset, along = lower_of(size), offset_of(size), axis_offset_of(size)
    settle, flat_states, no_noise = settling(outputs), is_flat(kinds), (0.0,) * noises
    no_step = (0.0,) * t
    turns, narrow = bool(turning(kinds)), narrowing(kinds, size, bounded=is_motion)

    def evaluate(
        mean: Floats | Numbers, points: Floats, arguments: tuple[AnyArgument, ...], memory: SampleMemory
    ) -> None:
        """Fill the offsets of all samples, and the function's values as differences from the centre."""
        triangle, state, offsets = lower(memory.factor), read_state(mean), memory.offsets
        centre = function(state, no_noise, arguments)
        fill(memory.centre, centre)
        if len(memory.axes) and not flat_states:
            fill_point(memory.still, state)
            add_curved(memory.still, no_step)
        for index in range(len(points)):
            if len(memory.axes):
                away = along(memory.factor, memory.axes[index], points[index])
            else:
                away = offset(triangle, points, index)
            fill_offset(offsets[index], away)
            if flat_states:
                point = tuple(state[row] + away[row] for row in range(components))
            else:
                if not len(memory.axes) or memory.axes[index] < end:
                    fill_point(memory.point, state)
                    add_curved(memory.point, away)
                else:
                    memory.point[:] = memory.still
                point = tuple(
                    memory.point[c] if row < 0 else state[c] + away[row]
                    for c, row in enumerate(tangents)
                )
            value = function(point, read_noise(away), arguments)
            subtract(value, centre, memory.values, index)

    def sample(
        mean: Floats | Numbers,
        arguments: tuple[AnyArgument, ...],
        variances: Numbers,
        sample_index: int,
        memory: SampleMemory,
    ) -> Floats:
        chosen = (sample_index - memory.first) * memory.stride
        fill_noise(memory.noise, variances)
        for k in range(noises):
            memory.factor[t + k, t + k] = np.sqrt(memory.noise[k])
        share = narrow(memory.factor, memory.points[chosen], memory.unsuspected) if turns else 1.0
        evaluate(mean, memory.points[chosen], arguments, memory)
        settle(memory.weights[chosen], memory.values, memory.centre, memory.shift)
        if share < 1.0:
            widen(share, memory)
        weights: Floats = memory.weights[chosen]
        return weights

    return sample


def regression(
    function: Sampled,
    kinds: tuple[str, ...],
    noises: int,
    outputs: tuple[str, ...],
    *,
    is_motion: bool = False,
    kept: tuple[int, ...] = (),
) -> Regress:
    """Make the regression of `function(state, noise, arguments)` at weighted samples; see `sampling`.

    Args:
        function: function to evaluate.
        kinds: kinds of the state's components.
        noises: number of noise components.
        outputs: kinds of the function's values.
        is_motion: whether the function is a motion.
        kept: tangent components of the state that the function returns unchanged, at the same indices.

    Returns:
        `regress(mean, covariance, arguments, variances, spread, cross, sample_index, memory)`. It fills
        `spread` (v, v) with the covariance of the values and `cross` (t, v) with their covariance with
        the state, and returns False if the state's covariance is not positive definite. `spread` may be
        the same array as `covariance`.
    """
    t, v = tangent_size(kinds), tangent_size(outputs)
    sample = sampling(function, kinds, noises, outputs, is_motion=is_motion)
    moments = moments_of(t, range_of(v))
    on_axes = axis_moments_of(t, v, kept)

    def regress(
        mean: Floats,
        covariance: Floats,
        arguments: tuple[AnyArgument, ...],
        variances: Numbers,
        spread: Floats,
        cross: Floats,
        sample_index: int,
        memory: SampleMemory,
    ) -> bool:
        if not cholesky(memory.factor, covariance, t):
            return False
        weights = sample(mean, arguments, variances, sample_index, memory)
        if has_joint_moments(memory.axes, t, v):
            chosen = (weights, memory.points[0], memory.axes)
            on_axes(chosen, memory.factor, memory.values, memory.shift, memory.joint, spread, cross)
        else:
            moments(weights, memory.offsets, memory.values, memory.shift, spread, cross)
        return True

    return regress


@lru_cache(maxsize=64)
def settling(kinds: tuple[str, ...]) -> Settle:
    """Make `settle(weights, values, centre, shift)`, which moves a centre to the mean of the values.

    The values (L, v) are tangent vectors from the centre, and the mean is intrinsic. Afterwards, the
    tangent vectors from the mean are `values` minus `shift` (v,).
    """
    places = tuple(t + i for _, _, t, width in curved_blocks(kinds) for i in range(width))
    add, add_curved, recentre = boxplus(kinds), boxplus(kinds, is_curved=True), recentring(kinds)
    mean_of_all, mean_of_curved = (
        weighted_mean_of(range_of(tangent_size(kinds))),
        weighted_mean_of(places),
    )

    def settle(weights: Floats, values: Floats, centre: Floats, shift: Floats) -> None:
        mean_of_all(weights, values, shift)
        add(centre, shift)
        if not places:
            return
        for _ in range(MEANS):
            again = recentre(values, shift)
            for place in places:
                shift[place] = 0.0
            if not again:
                return
            mean_of_curved(weights, values, shift)
            add_curved(centre, shift)

    return settle


def no_variances(*_: object) -> Numbers:
    """Return an empty tuple of variances, for functions without noise."""
    return ()


def sampled_motion(bound_model: BoundModel, number: int) -> Predict:
    """Make the prediction by regression at the samples `work.samples[number]`.

    The noise of the control is propagated by the derivative at the mean, whereas the noise of the motion
    is sampled.

    Args:
        bound_model: the bound model.
        number: index of the samples in `work.samples`.
    """
    model, motion = bound_model.model, bound_model.motion
    entering = motion.noise if motion.noises else None
    moved = moved_with_noise(motion)
    kept = kept_components(motion, model.kinds)
    regress = regression(moved, model.kinds, motion.noises, model.kinds, is_motion=True, kept=kept)
    variances_of: MotionNoise = entering or no_variances
    add_noise: AddMotionNoise = nothing if entering else motion_noise(model, motion)
    linearise: LineariseMotion = nothing
    if motion.control_noise:
        linearise = motion_derivative(model, motion, by_state=False)
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    fill = filling(model.size)

    def predict(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        control, duration_s, parameters, event = interval
        memory, state, driven = work.samples[number], read_state(mean), read_control(control)
        arguments = (driven, duration_s, parameters)
        variances = variances_of(state, duration_s, parameters)
        cross = work.product.T
        if not regress(mean, covariance, arguments, variances, covariance, cross, event, memory):
            return False
        linearise(state, driven, duration_s, parameters, work)
        add_noise(state, covariance, duration_s, parameters, work)
        fill(mean, memory.centre)
        return True

    return predict


def kept_components(motion: Motion, kinds: tuple[str, ...]) -> tuple[int, ...]:
    """Return tangent components of linear components that a motion leaves unchanged, such as biases."""
    assert isinstance(motion.move, TracedFunction)
    returned = motion.move.result.returned
    return tuple(
        tangent
        for kind, component, tangent, _ in manifold_blocks(kinds)
        if kind == "linear"
        and returned[component].operation is INPUT
        and returned[component].value == (0, component)
    )


def moved_with_noise(motion: Motion) -> Sampled:
    """Convert a motion to the form `function(state, noise, arguments)`, for `sampling`."""
    move = motion.move
    if motion.noises:

        def with_noise(state: Numbers, noise: Numbers, arguments: tuple[AnyArgument, ...]) -> Numbers:
            return move(state, arguments[0], noise, arguments[1], arguments[2])

        return with_noise

    def without(state: Numbers, noise: Numbers, arguments: tuple[AnyArgument, ...]) -> Numbers:
        return move(state, arguments[0], arguments[1], arguments[2])

    return without


def sampled_sensor(bound_model: BoundModel, number: int, samples: int) -> Innovate:
    """Make `innovate(...)` of sensor `number` by regression at the samples `work.samples[samples]`.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
        samples: index of the sensor's samples in `work.samples`.
    """
    model, sensor = bound_model.model, bound_model.sensors[number]
    kinds = tuple(sensor.measured.values())
    regress = regression(measured_with_noise(sensor), model.kinds, sensor.noises, kinds)
    read_reference, subtract = message_layout(sensor).reference, residual_of(sensor)
    entering = sensor.noise if sensor.noises else None
    variances_of: OfParameters = entering or no_variances
    add_noise: MeasurementNoise = nothing if sensor.noises else sensor_noise(sensor)

    def innovate(mean: Floats, covariance: Floats, measurement: Measurement, work: Workspace) -> bool:
        data, parameters, _, event = measurement
        memory = work.samples[samples]
        difference, spread, cross = work.innovations[number]
        arguments, variances = (read_reference(data), parameters), variances_of(parameters)
        if not regress(mean, covariance, arguments, variances, spread, cross, event, memory):
            return False
        subtract(data, memory.centre, difference)
        add_noise(spread, data, parameters, work)
        return True

    return innovate


def measured_with_noise(sensor: Sensor) -> Sampled:
    """Convert a sensor's measurement function to the form `function(state, noise, arguments)`."""
    measure = sensor.measure
    if sensor.noises:

        def with_noise(state: Numbers, noise: Numbers, arguments: tuple[AnyArgument, ...]) -> Numbers:
            return measure(state, noise, arguments[0], arguments[1])

        return with_noise

    def without(state: Numbers, noise: Numbers, arguments: tuple[AnyArgument, ...]) -> Numbers:
        return measure(state, arguments[0], arguments[1])

    return without
