"""Tracing of the complete steps of a filter: prediction, innovation of each sensor, correction.

The functions from which kernels are compiled are called with traced numbers; see `step_graphs`. Products
of covariances and Jacobians are not traced: loops compute them from the outputs of the graphs. The same
applies to samples; see `sampled_steps`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.replay.inference.kalman.predict import motion_derivative
from fuselog.replay.inference.kalman.regression import (
    kept_components,
    measured_with_noise,
    moved_with_noise,
    no_variances,
)
from fuselog.replay.inference.kalman.update import message_layout, residual_of, sensor_derivative
from fuselog.replay.inference.linear_algebra.manifold import boxplus
from fuselog.replay.inference.linear_algebra.tuples import adding_noise, tuple_of
from fuselog.replay.inference.model.corrections import relinearising, stepping
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.run.filtering import Filter
from fuselog.replay.inference.run.samples import sample_sets
from fuselog.replay.inference.sampled_steps import Sampled, SampledFunction, sampled_function
from fuselog.replay.inference.step_graphs import Step, StepFunction, TracedValue, traced_step, zeros
from fuselog.replay.tracing.functions import Argument, Shape, traced


class WholeSteps(NamedTuple):
    """Steps of a filter whose state has n components and a tangent space of t components.

    The arguments of all steps are (mean, covariance, ...). The covariance added by a step is G diag(u)
    G' + N: a gain G with the variances u of its columns, and N, (t, t) or (m, m).

    Attributes:
        predict: has the arguments (..., control, duration_s, parameters) and returns G, u, N, the mean
            and F (t, t); only the first three if the motion is sampled.
        innovate: one step for each sensor of m components, with the arguments (..., data, parameters),
            which returns v (m), G, u, N and H (m, t). If the sensor is sampled, the arguments are (...,
            data, parameters, centre), and H is not returned. If updates are iterated, the arguments are
            (..., data, parameters, step, slope), and the innovation about the mean is linearised at the
            mean moved by the step.
        direction: returns `a` (t), the direction of a correction along a curve; None if components are
            corrected separately.
        correct: has the arguments (..., step, slope) and returns the mean, and F if the correction also
            transforms the covariance by F.
        gap: has the arguments of `predict` and returns N, the noise added over a gap of the control;
            None if the estimate ends at a gap.
        sampled: the sampled function for the motion and for every sensor; None for a motion or sensor
            that is linearised.
        is_iterated: whether updates are iterated.
    """

    predict: Step
    innovate: tuple[Step, ...]
    direction: Step | None
    correct: Step
    gap: Step | None
    sampled: tuple[SampledFunction | None, ...]
    is_iterated: bool

    @property
    def all(self) -> list[Step]:
        """All graphs."""
        found = [self.predict, *self.innovate, self.direction, self.correct, self.gap]
        found += [step for each in self.sampled if each is not None for step in each.steps]
        return [each for each in found if each is not None]

    def of(self, part: int) -> list[Step]:
        """List the graphs of the motion (0) or of a sensor (1 or more)."""
        found = [self.predict, self.gap] if part == 0 else [self.innovate[part - 1]]
        sampled = self.sampled[part]
        found += [] if sampled is None else sampled.steps
        return [each for each in found if each is not None]


EXTENDED, ITERATED, SAMPLED = "extended", "iterated", "sampled"


def whole_steps(filtering: Filter, kind: str) -> WholeSteps:
    """Trace the steps of a filter.

    Args:
        filtering: the filter, bound to a log.
        kind: EXTENDED to use derivatives, ITERATED to linearise again at every iteration of an update,
            SAMPLED to use regression at samples.

    Raises BadInput if a step cannot be traced.
    """
    bound_model = filtering.bound_model
    model, motion, names = (
        bound_model.model,
        bound_model.motion,
        number_fields(bound_model.model.parameters),
    )
    gaussian: tuple[Argument, ...] = (Shape((model.size,)), Shape((model.tangent, model.tangent)))
    [(_, sets)] = sample_sets(filtering.samplers, (), np.zeros(1, np.int64))
    drawn = iter(sets)

    def memory() -> TracedValue:
        return _of_objects(filtering.steps.memory(sets))

    given = (*gaussian, Shape((model.controls,)), None, names)
    sampled: list[SampledFunction | None] = [None]
    if kind == SAMPLED and not motion.linear:
        sampled = [sampled_function(_of_motion(model, motion), next(drawn), given)]
    moved = _motion(model, motion, memory, is_sampled=sampled[0] is not None)
    predict = traced_step("the prediction", moved, given)
    gap = None
    if motion.gap_noise is not None:
        gap = traced_step("the prediction in a gap", _gap_noise(model, motion), given)
    innovations, step = [], Shape((model.tangent,))
    for sensor in bound_model.sensors:
        what = f"sensor {sensor.topic}"
        given = *gaussian, Shape((message_layout(sensor).width,)), names
        if kind == SAMPLED and not sensor.linear:
            sampled.append(sampled_function(_of_sensor(model, sensor), next(drawn), given))
            innovate = _sampled_sensor(sensor)
            given += (Shape((len(sensor.measured),)),)
        else:
            sampled.append(None)
            innovate = _linear_sensor(model, sensor, memory, is_iterated=kind == ITERATED)
            given += (step, step) if kind == ITERATED else ()
        innovations.append(traced_step(what, innovate, given))
    correct = traced_step("the correction", _correcting(model, memory), (*gaussian, step, step))
    direction = None
    if model.correct is not None:
        along, read_state = traced(model.correct.along, model.size), tuple_of(model.size)
        direction = traced_step(
            "the correction", lambda mean, _: {"a": np.array(along(read_state(mean)))}, gaussian
        )
    is_iterated = kind == ITERATED
    return WholeSteps(predict, tuple(innovations), direction, correct, gap, tuple(sampled), is_iterated)


# --- traced functions that return arrays by name ----------------------------------------------------


def _motion(
    model: Model, motion: Motion, memory: Callable[[], TracedValue], *, is_sampled: bool
) -> StepFunction:
    """Make the step with the derivatives of the motion, or only its noise if the motion is sampled."""
    linearise = motion_derivative(model, motion, by_state=not is_sampled)
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    t, add = model.tangent, adding_noise(model.tangent, motion.noise_block)

    def predict(
        mean: TracedValue,
        _: TracedValue,
        control: TracedValue,
        duration_s: TracedValue,
        parameters: TracedValue,
    ) -> TracedValue:
        work, state, noise = memory(), read_state(mean), zeros(t, t)
        gains, variances = [zeros(t, 0)], list[TracedValue]()
        if is_sampled and motion.noises:
            return {"G": gains[0], "u": variances, "N": noise}
        if motion.control_noise is not None or not is_sampled:
            linearise(state, read_control(control), duration_s, parameters, work)
        if motion.control_noise is not None:
            gains.append(work.gain)
            variances += motion.control_noise(duration_s, parameters)
        if motion.noise is not None:
            found = motion.noise(state, duration_s, parameters)
            if motion.noises:
                gains.append(work.noise_gain[:t, : motion.noises])
                variances += found
            else:
                add(noise, found)
        moved = {} if is_sampled else {"mean": work.state, "F": work.transition}
        return {**moved, "G": np.hstack(gains), "u": variances, "N": noise}

    return predict


def _gap_noise(model: Model, motion: Motion) -> StepFunction:
    noise_of, read_state, t = motion.gap_noise, tuple_of(model.size), model.tangent
    assert noise_of is not None
    add = adding_noise(t)

    def widen(
        mean: TracedValue,
        _: TracedValue,
        __: TracedValue,
        duration_s: TracedValue,
        parameters: TracedValue,
    ) -> TracedValue:
        noise = zeros(t, t)
        add(noise, noise_of(read_state(mean), duration_s, parameters))
        return {"N": noise}

    return widen


def _of_motion(model: Model, motion: Motion) -> Sampled:
    read_control = tuple_of(model.controls)
    variances = (motion.noise if motion.noises else None) or no_variances
    return Sampled(
        "the prediction",
        moved_with_noise(motion),
        lambda state, given: variances(state, given[1], given[2]),
        lambda given: (read_control(given[0]), given[1], given[2]),
        model.kinds,
        model.kinds,
        kept_components(motion, model.kinds),
    )


def _of_sensor(model: Model, sensor: Sensor) -> Sampled:
    layout = message_layout(sensor)
    variances = (sensor.noise if sensor.noises else None) or no_variances
    return Sampled(
        f"sensor {sensor.topic}",
        measured_with_noise(sensor),
        lambda _, given: variances(given[1]),
        lambda given: (layout.reference(given[0]), given[1]),
        model.kinds,
        tuple(sensor.measured.values()),
    )


def _linear_sensor(
    model: Model, sensor: Sensor, memory: Callable[[], TracedValue], *, is_iterated: bool
) -> StepFunction:
    linearise, layout = sensor_derivative(model, sensor), message_layout(sensor)
    m, read_state, add = len(sensor.measured), tuple_of(model.size), adding_noise(len(sensor.measured))
    subtract, (step_to, chain) = residual_of(sensor), relinearising(model)

    def innovate(
        mean: TracedValue,
        _: TracedValue,
        data: TracedValue,
        parameters: TracedValue,
        *moved: TracedValue,
    ) -> TracedValue:
        work, noise, state = memory(), zeros(m, m), mean
        rows = work.rows[:m]
        if is_iterated:
            work = work._replace(step=moved[0], slope=moved[1])
            step_to(mean, work)
            state = work.state
        linearise(read_state(state), layout.reference(data), parameters, work)
        if is_iterated:
            chain(rows, work)
        gain, variances = zeros(m, 0), list[TracedValue]()
        if sensor.covariance:
            add(noise, layout.noise(data))
        elif sensor.noise is not None and sensor.noises:
            gain, variances = work.noise_gain[:m, : sensor.noises], [*sensor.noise(parameters)]
        elif sensor.noise is not None:
            add(noise, sensor.noise(parameters))
        difference = zeros(m)
        subtract(data, work.predicted, difference)
        for i in range(m if is_iterated else 0):
            for k in range(model.tangent):
                difference[i] += rows[i, k] * work.step[k]
        return {"v": difference, "H": rows, "G": gain, "u": variances, "N": noise}

    return innovate


def _sampled_sensor(sensor: Sensor) -> StepFunction:
    layout, m = message_layout(sensor), len(sensor.measured)
    subtract, add = residual_of(sensor), adding_noise(m)

    def innovate(
        _: TracedValue, __: TracedValue, data: TracedValue, parameters: TracedValue, centre: TracedValue
    ) -> TracedValue:
        difference, noise = zeros(m), zeros(m, m)
        subtract(data, centre, difference)
        if sensor.covariance and not sensor.noises:
            add(noise, layout.noise(data))
        elif sensor.noise is not None and not sensor.noises:
            add(noise, sensor.noise(parameters))
        return {"v": difference, "N": noise}

    return innovate


def _correcting(model: Model, memory: Callable[[], TracedValue]) -> StepFunction:
    if model.correct is not None:
        step_to = stepping(model.kinds, model.correct.move)

        def step_together(
            mean: TracedValue, _: TracedValue, step: TracedValue, slope: TracedValue
        ) -> TracedValue:
            work = memory()._replace(step=step, slope=slope)
            step_to(mean, work)
            return {"mean": work.state, "F": work.transition}

        return step_together
    add = boxplus(model.kinds)

    def step_each(mean: TracedValue, _: TracedValue, step: TracedValue, __: TracedValue) -> TracedValue:
        add(mean, step)
        return {"mean": mean}

    return step_each


def _of_objects(value: TracedValue) -> TracedValue:
    """Make a copy of a workspace whose arrays can store traced numbers."""
    if isinstance(value, np.ndarray):
        return value.astype(object) if value.dtype == float else value
    if isinstance(value, tuple):
        parts = [_of_objects(each) for each in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value
