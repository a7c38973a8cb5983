"""Parts of square-root filters (extended or unscented), which store factors of covariances.

Let X be the columns of the state's factor or its weighted samples, Y their images under a function, and
N a factor of the noise. One factorisation then computes a prediction or an update:

    [Y  N]     [L  0]    for a motion, L is the factor of P-, and W = G L with the smoother's gain G;
    [X  0]  =  [W  V]    for a sensor, L is that of S, W = K L with the Kalman gain K, and V that of P+.

Kaminski, Bryson and Schmidt, IEEE TAC 16(6), 1971; Van der Merwe and Wan, ICASSP 2001.
"""

from typing import Protocol

import numpy as np

from fuselog.replay.engine.arrays import AnyArgument, Floats, Numbers, Settings
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.kalman.forms import Parts
from fuselog.replay.inference.kalman.predict import (
    AddMotionNoise,
    motion_derivative,
    motion_noise,
    nothing,
)
from fuselog.replay.inference.kalman.regression import (
    Sample,
    measured_with_noise,
    moved_with_noise,
    no_variances,
    sampling,
)
from fuselog.replay.inference.kalman.steps import (
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    InnovationRecord,
    Interval,
    Measurement,
    Predict,
    Update,
    Workspace,
)
from fuselog.replay.inference.kalman.update import (
    MeasurementNoise,
    is_unmeasured,
    message_layout,
    residual_of,
    sensor_derivative,
    sensor_noise,
    write_numbers,
    writing_innovation,
)
from fuselog.replay.inference.linear_algebra.factors import FACTORS, fill_root, orthogonalise
from fuselog.replay.inference.linear_algebra.gaussian import fill_identity, whiten_by
from fuselog.replay.inference.linear_algebra.inflation import inflation
from fuselog.replay.inference.linear_algebra.linearization import Linearise
from fuselog.replay.inference.linear_algebra.tuples import adding_noise, filling, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.corrections import correcting, sloping
from fuselog.replay.inference.model.functions import MotionNoise, OfParameters

Into = tuple[Floats, Floats]  # rows, and the weights of their columns
Given = tuple[AnyArgument, ...]  # the arguments of a motion or a sensor after the state


class Spread(Protocol):
    """Function that fills Y and X for a factor (t, t) at a state (n,); see the module docstring."""

    def __call__(
        self, state: Numbers, factor: Floats, given: Given, index: int, work: Workspace, into: Into, /
    ) -> None: ...


class VariancesOf(Protocol):
    """Function that returns the variances of the sampled noise at a state (n,)."""

    def __call__(self, state: Numbers, given: Given, /) -> Numbers: ...


def _linear(linearise: Linearise, slopes: str) -> Spread:
    """Make `spread(state, factor, given, index, work, into)`, which fills Y and X for a factor.

    It uses the derivative that `linearise(state, *given, work)` writes to `slopes` in the workspace.
    """

    def spread(
        state: Numbers, factor: Floats, given: Given, index: int, work: Workspace, into: Into
    ) -> None:
        rows, weights = into
        t, m = len(factor), len(rows) - len(factor)
        linearise(state, *given, work)
        for k in range(t):
            weights[k] = 1.0
            rows[m:, k] = factor[:, k]
            for i in range(m):
                for row in range(k, t):
                    rows[i, k] += getattr(work, slopes)[i, row] * factor[row, k]

    return spread


def _sampled(sample: Sample, variances_of: VariancesOf, mean_of: str, size: int, samples: int) -> Spread:
    """Make the function that fills Y and X at samples, and their mean in `mean_of` of the workspace."""
    fill = filling(size)

    def spread(
        state: Numbers, factor: Floats, given: Given, index: int, work: Workspace, into: Into
    ) -> None:
        (rows, weights), memory = into, work.samples[samples]
        t, m = len(factor), len(rows) - len(factor)
        memory.factor[:t, :t] = factor
        drawn = sample(state, given, variances_of(state, given), index, memory)
        fill(getattr(work, mean_of), memory.centre)
        for k in range(len(memory.offsets)):
            weights[k] = drawn[k]
            for i in range(m):
                rows[i, k] = memory.values[k, i] - memory.shift[i]
            rows[m:, k] = memory.offsets[k]

    return spread


def _factorise(rows: Floats, weights: Floats, noise: Floats, found: Floats) -> bool:
    """Fill N from a noise covariance (overwritten), and factorise; return False if this fails."""
    first = len(weights) - len(noise)
    weights[first:] = 1.0
    return fill_root(rows[:, first:], noise) and orthogonalise(rows, weights, found)


def _predicting(
    bound_model: BoundModel, spread: Spread, add_noise: AddMotionNoise, samples: int = -1
) -> Predict:
    """Make the prediction by a `spread`, which uses derivatives or, if given, samples."""
    t, read_control = bound_model.model.tangent, tuple_of(bound_model.model.controls)
    read_state, fill = tuple_of(bound_model.model.size), filling(bound_model.model.size)

    def predict(mean: Floats, factor: Floats, interval: Interval, work: Workspace) -> bool:
        control, duration_s, parameters, event = interval
        count = len(work.samples[samples].offsets) if samples >= 0 else t
        rows, weights = np.zeros((2 * t, count + t)), np.zeros(count + t)
        noise, found = np.zeros((t, t)), np.zeros((2 * t, 2 * t))
        state, given = read_state(mean), (read_control(control), duration_s, parameters)
        spread(state, factor, given, event, work, (rows, weights))
        fill(mean, work.state)
        add_noise(state, noise, duration_s, parameters, work)
        if not _factorise(rows, weights, noise, found):
            return False
        factor[:, :], work.product[:, :] = found[:t, :t], found[t:, :t]
        work.rest[:, :] = found[t:, t:]
        return True

    return predict


def _linear_motion(bound_model: BoundModel) -> Predict:
    linearise = motion_derivative(bound_model.model, bound_model.motion, by_state=True)
    return _predicting(
        bound_model,
        _linear(linearise, "transition"),
        motion_noise(bound_model.model, bound_model.motion),
    )


def _gap_motion(bound_model: BoundModel) -> Predict:
    gap_noise, add = bound_model.motion.gap_noise, adding_noise(bound_model.model.tangent)
    fill = filling(bound_model.model.size)
    assert gap_noise is not None

    def stand(
        state: Numbers, control: Numbers, duration_s: float, parameters: Settings, work: Workspace
    ) -> None:
        fill(work.state, state)
        fill_identity(work.transition)

    def add_noise(
        state: Numbers, noise: Floats, duration_s: float, parameters: Settings, work: Workspace
    ) -> None:
        add(noise, gap_noise(state, duration_s, parameters))

    return _predicting(bound_model, _linear(stand, "transition"), add_noise)


def _sampled_motion(bound_model: BoundModel, samples: int) -> Predict:
    """Make the sampled prediction; control noise is propagated by the derivative at the mean."""
    model, motion = bound_model.model, bound_model.motion
    linearise: Linearise = nothing
    if motion.control_noise:
        linearise = motion_derivative(model, motion, by_state=False)
    variances: MotionNoise = (motion.noise if motion.noises else None) or no_variances

    def variances_of(state: Numbers, given: Given) -> Numbers:
        return variances(state, given[1], given[2])

    moved = moved_with_noise(motion)
    sample = sampling(moved, model.kinds, motion.noises, model.kinds, is_motion=True)
    spread_samples = _sampled(sample, variances_of, "state", model.size, samples)

    def spread(
        state: Numbers, factor: Floats, given: Given, index: int, work: Workspace, into: Into
    ) -> None:
        linearise(state, *given, work)
        spread_samples(state, factor, given, index, work, into)

    add_noise: AddMotionNoise = nothing if motion.noises else motion_noise(model, motion)
    return _predicting(bound_model, spread, add_noise, samples)


def _updating(
    bound_model: BoundModel, number: int, spread: Spread, add_noise: MeasurementNoise, samples: int = -1
) -> Update:
    """Make the update by sensor `number`; see `fuselog.replay.inference.kalman.update.kalman_update`.

    A missing component is replaced by independent noise whose value equals the prediction.
    """
    model, sensor = bound_model.model, bound_model.sensors[number]
    t, m, read_reference = model.tangent, len(sensor.measured), message_layout(sensor).reference
    read_state, to_covariance = tuple_of(model.size), FACTORS.to_covariance
    subtract = residual_of(sensor)
    write_innovation, find_slope = (
        writing_innovation(bound_model, number),
        sloping(model.kinds, model.correct, FACTORS),
    )
    correct = correcting(model.kinds, model.correct, form=FACTORS)

    def update(
        mean: Floats, factor: Floats, measurement: Measurement, work: Workspace, record: InnovationRecord
    ) -> int:
        data, parameters, gate, event = measurement
        count = len(work.samples[samples].offsets) if samples >= 0 else t
        rows, weights = np.zeros((m + t, count + m)), np.zeros(count + m)
        noise, found = np.zeros((m, m)), np.zeros((m + t, m + t))
        innovation, size = work.innovations[number], 0
        difference, own_spread, _ = innovation
        if is_unmeasured(data, m):
            return NOTHING_MEASURED
        state, given = read_state(mean), (read_reference(data), parameters)
        spread(state, factor, given, event, work, (rows, weights))
        add_noise(noise, data, parameters, work)
        subtract(data, work.predicted, difference)
        for i in range(m):
            if np.isnan(difference[i]):
                rows[i, :] = noise[i, :] = noise[:, i] = 0.0
                noise[i, i] = 1.0
            else:
                size += 1
        if not _factorise(rows, weights, noise, found):
            return NOT_POSITIVE_DEFINITE
        own_spread[:, :] = found[:m, :m]
        to_covariance(own_spread)
        write_innovation(innovation, record)
        for i in range(m):
            if not found[i, i] > 0.0:
                return NOT_POSITIVE_DEFINITE
            if np.isnan(difference[i]):
                difference[i] = 0.0
        squared, determinant = whiten_by(found, difference, m)
        accepted, wider = size > 0 and squared <= gate[size], inflation(squared, size, parameters)
        if accepted:
            for row in range(t):
                work.step[row] = 0.0
                for i in range(m):
                    work.step[row] += found[m + row, i] * difference[i] / wider
            for k in range(m + t):
                weights[k] = 1.0 if k >= m else 1.0 - 1.0 / wider
            orthogonalise(found[m:], weights[: m + t], factor)
            find_slope(mean, factor, work.slope)
            correct(mean, factor, work)
        write_numbers(record, squared, determinant, size, accepted, wider)
        return ALL_WELL

    return update


def _linear_update(bound_model: BoundModel, number: int) -> Update:
    sensor = bound_model.sensors[number]
    spread = _linear(sensor_derivative(bound_model.model, sensor), "rows")
    return _updating(bound_model, number, spread, sensor_noise(sensor))


def _sampled_update(bound_model: BoundModel, number: int, samples: int) -> Update:
    sensor = bound_model.sensors[number]
    kinds, noises = tuple(sensor.measured.values()), sensor.noises
    variances: OfParameters = (sensor.noise if noises else None) or no_variances

    def variances_of(state: Numbers, given: Given) -> Numbers:
        return variances(given[1])

    sample = sampling(measured_with_noise(sensor), bound_model.model.kinds, noises, kinds)
    spread = _sampled(sample, variances_of, "predicted", len(kinds), samples)
    add_noise: MeasurementNoise = nothing if noises else sensor_noise(sensor)
    return _updating(bound_model, number, spread, add_noise, samples)


FACTORED = Parts(FACTORS, _linear_motion, _sampled_motion, _linear_update, _sampled_update, _gap_motion)
