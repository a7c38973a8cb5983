"""A filter's whole steps as graphs: its prediction, each sensor's innovation, and the correction.

The functions that kernels are compiled from are called with traced numbers. So a graph has their
operations in their order, and what is known to be zero stands in none of them. Products of covariances
with Jacobians are left to loops, which go over the entries that the graphs give.
"""

import operator
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from replay.engine.arrays import Function
from replay.inference.kalman.predict import motion_derivative
from replay.inference.kalman.regression import sampled_motion, sampled_sensor
from replay.inference.kalman.steps import Interval, Measurement
from replay.inference.kalman.update import reading, sensor_derivative
from replay.inference.linear_algebra.gaussian import wrap
from replay.inference.linear_algebra.manifold import boxplus
from replay.inference.linear_algebra.tuples import adding_noise, tuple_of
from replay.inference.model.corrections import relinearising, stepping
from replay.inference.model.model import Model, Motion, Sensor
from replay.inference.model.parameters import number_fields
from replay.inference.model.stage import Stage
from replay.inference.run.filtering import Filter
from replay.inference.run.samples import sample_sets
from replay.tracing.functions import Argument, Result, Shape, trace, traced
from replay.tracing.graph import SELECT, Graph, Node


class Step(NamedTuple):
    """Holds one step as a graph.

    Attributes:
        graph: the graph.
        outputs: what it gives, by the array's name and place; of F, H, G and N without what is zero.
        conditions: truths that have to hold; it gives nothing where one does not.
    """

    graph: Graph
    outputs: Mapping[tuple[str, tuple[int, ...]], Node]
    conditions: tuple[Node, ...] = ()

    def has(self, name: str) -> bool:
        """Tell whether it gives an array of this name."""
        return any(each == name for each, _ in self.outputs)

    def columns(self, name: str, rows: int) -> list[list[int]]:
        """List the columns of a matrix that are not known to be zero, row by row."""
        places = sorted(place for each, place in self.outputs if each == name)
        return [[place[1] for place in places if place[0] == row] for row in range(rows)]


class WholeSteps(NamedTuple):
    """Holds the steps of a filter with n components of the state, t of its tangent space.

    All are of (mean, covariance, ...). Those of derivatives give what is entered by loops: the Jacobian
    F (t, t) or H (m, t), a gain G of noise with the variances u of its columns, and what is added to the
    product, N (t, t) or (m, m). Those of samples give the covariances themselves.

    Attributes:
        predict: of (..., control, duration_s, parameters), it gives mean and F, G, u, N, or mean and P.
        innovate: of (..., data, parameters), for every sensor of m components: v (m) and H, G, u, N, or
            v, S (m, m) and C (t, m), of S the lower triangle. Where updates are iterated it is of (...,
            data, parameters, step, slope): at the mean moved by a step, as an innovation about the mean.
        direction: of the state: `a` (t), along which the correction bends; None where it does not.
        correct: of (..., step, slope), it gives the mean, and F where covariances go with it by that.
        is_iterated: whether updates are.
        gap: in a gap of the control it gives N, added to the covariance; None where it ends there.
    """

    predict: Step
    innovate: tuple[Step, ...]
    direction: Step | None
    correct: Step
    is_iterated: bool = False
    gap: Step | None = None


EXTENDED, ITERATED, SAMPLED = "extended", "iterated", "sampled"
_SPARSE = ("F", "H", "G", "N")


def whole_steps(filtering: Filter, kind: str) -> WholeSteps:
    """Trace the steps of a filter.

    Args:
        filtering: the filter, bound to a log.
        kind: EXTENDED for derivatives, ITERATED where updates take them again at every iterate, SAMPLED
            for regression at samples.

    Raises BadInput where a step is no graph, as that of sampled angles.
    """
    stage = filtering.stage
    model, motion, names = stage.model, stage.motion, number_fields(stage.model.parameters)
    gaussian: tuple[Argument, ...] = (Shape((model.size,)), Shape((model.tangent, model.tangent)))
    [(_, sets)] = sample_sets(filtering.samplers, (), np.zeros(1, np.int64))
    is_sampled, samples = kind == SAMPLED, 0

    def memory() -> Any:
        return _of_objects(filtering.steps.memory(sets))

    move = _linear_motion(model, motion, memory)
    if is_sampled and not motion.linear:
        _check_straight("the prediction", model.kinds)
        move, samples = _sampled_motion(stage, memory), 1
    given = (*gaussian, Shape((model.controls,)), None, names)
    predict = _traced("the prediction", move, given)
    innovations, step = [], Shape((model.tangent,))
    for number, sensor in enumerate(stage.sensors):
        if is_sampled and not sensor.linear:
            _check_straight(f"sensor {sensor.topic}", sensor.measured.values())
            innovate = _sampled_sensor(stage, number, samples, memory)
            samples += 1
        else:
            innovate = _linear_sensor(model, sensor, memory, is_iterated=kind == ITERATED)
        given = (*gaussian, Shape((reading(sensor).width,)), names)
        given += (step, step) if kind == ITERATED else ()
        innovations.append(_traced(f"sensor {sensor.topic}", innovate, given))
    correct = _traced("the correction", _correcting(model, memory), (*gaussian, step, step))
    direction = None
    if model.correct is not None:
        along, read_state = traced(model.correct.along, model.size), tuple_of(model.size)
        direction = _traced(
            "the correction", lambda mean, _: (True, {"a": np.array(along(read_state(mean)))}), gaussian
        )
    gap = None
    if motion.gap_noise is not None:
        given = (*gaussian, Shape((model.controls,)), None, names)
        gap = _traced("the prediction in a gap", _gap_noise(model, motion), given)
    return WholeSteps(predict, tuple(innovations), direction, correct, kind == ITERATED, gap)


# --- what is traced: functions that return whether all is well, and arrays by name ------------------


def _linear_motion(model: Model, motion: Motion, memory: Callable[[], Any]) -> Function:
    linearise = motion_derivative(model, motion, by_state=True)
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    t, add = model.tangent, adding_noise(model.tangent, motion.noise_block)

    def predict(mean: Any, _: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
        work, state, noise = memory(), read_state(mean), _zeros(t, t)
        linearise(state, read_control(control), duration_s, parameters, work)
        gains, variances = [_zeros(t, 0)], []
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
        found = {"mean": work.state, "F": work.transition, "G": np.hstack(gains), "u": variances}
        return True, {**found, "N": noise}

    return predict


def _gap_noise(model: Model, motion: Motion) -> Function:
    noise_of, read_state, t = motion.gap_noise, tuple_of(model.size), model.tangent
    assert noise_of is not None
    add = adding_noise(t)

    def widen(mean: Any, _: Any, __: Any, duration_s: Any, parameters: Any) -> Any:
        noise = _zeros(t, t)
        add(noise, noise_of(read_state(mean), duration_s, parameters))
        return True, {"N": noise}

    return widen


def _sampled_motion(stage: Stage, memory: Callable[[], Any]) -> Function:
    move = sampled_motion(stage, 0)

    def predict(mean: Any, covariance: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
        well = move(mean, covariance, Interval(control, duration_s, parameters, 0), memory())
        return well, {"mean": mean, "P": covariance}

    return predict


def _linear_sensor(
    model: Model, sensor: Sensor, memory: Callable[[], Any], *, is_iterated: bool
) -> Function:
    linearise, read = sensor_derivative(model, sensor), reading(sensor)
    m, read_state, add = len(sensor.measured), tuple_of(model.size), adding_noise(len(sensor.measured))
    angular = [kind == "angle" for kind in sensor.measured.values()]
    step_to, chain = relinearising(model)

    def innovate(mean: Any, _: Any, data: Any, parameters: Any, *moved: Any) -> Any:
        work, noise, state = memory(), _zeros(m, m), mean
        rows = work.rows[:m]
        if is_iterated:
            work = work._replace(step=moved[0], slope=moved[1])
            step_to(mean, work)
            state = work.state
        linearise(read_state(state), read.reference(data), parameters, work)
        if is_iterated:
            chain(rows, work)
        gain, variances = _zeros(m, 0), []
        if sensor.covariance:
            add(noise, read.noise(data))
        elif sensor.noise is not None and sensor.noises:
            gain, variances = work.noise_gain[:m, : sensor.noises], sensor.noise(parameters)
        elif sensor.noise is not None:
            add(noise, sensor.noise(parameters))
        difference = [wrap(data[i] - work.predicted[i], angular[i]) for i in range(m)]
        for i in range(m if is_iterated else 0):
            for k in range(model.tangent):
                difference[i] += rows[i, k] * work.step[k]
        return True, {"v": difference, "H": rows, "G": gain, "u": variances, "N": noise}

    return innovate


def _sampled_sensor(stage: Stage, number: int, samples: int, memory: Callable[[], Any]) -> Function:
    innovate = sampled_sensor(stage, number, samples)

    def step(mean: Any, covariance: Any, data: Any, parameters: Any) -> Any:
        work = memory()
        well = innovate(mean, covariance, Measurement(data, parameters, None, 0), work)  # type: ignore[arg-type]
        difference, spread, cross = work.innovations[number]
        if not well:
            difference, spread, cross = (_zeros(*each.shape) for each in (difference, spread, cross))
        return well, {"v": difference, "S": spread, "C": cross}

    return step


def _correcting(model: Model, memory: Callable[[], Any]) -> Function:
    if model.correct is not None:
        step_to = stepping(model.kinds, model.correct.move)

        def step_together(mean: Any, _: Any, step: Any, slope: Any) -> Any:
            work = memory()._replace(step=step, slope=slope)
            step_to(mean, work)
            return True, {"mean": work.state, "F": work.transition}

        return step_together
    add = boxplus(model.kinds)

    def step_each(mean: Any, _: Any, step: Any, __: Any) -> Any:
        add(mean, step)
        return True, {"mean": mean}

    return step_each


def _zeros(*sizes: int) -> Any:
    return np.zeros(sizes).astype(object)


def _check_straight(what: str, kinds: Collection[str]) -> None:
    """Raise BadInput where the mean of samples is found step by step, which is no graph."""
    bent = [kind for kind in kinds if kind != "linear"]
    if bent:
        averaged = "an orientation" if bent[0] == "quaternion" else f"an {bent[0]}"
        raise BadInput(
            f"{what} cannot be written as C: samples of {averaged} are averaged in a loop; give -e ekf"
        )


def _of_objects(value: Any) -> Any:
    """A workspace that takes traced numbers."""
    if isinstance(value, np.ndarray):
        return value.astype(object) if value.dtype == float else value
    if isinstance(value, tuple):
        parts = [_of_objects(each) for each in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _traced(what: str, function: Function, arguments: tuple[Argument, ...]) -> Step:
    graph, places = Graph(), list[tuple[str, tuple[int, ...]]]()

    def flat(*given: Any) -> Any:
        well, arrays = function(*given)
        arrays = {name: np.array(array, object) for name, array in arrays.items()}
        places[:] = [
            (name, place) for name, array in arrays.items() for place in np.ndindex(array.shape)
        ]
        return well, *(each for array in arrays.values() for each in array.ravel())

    try:
        result = trace(graph, flat, arguments)
    except BadInput as error:
        raise BadInput(f"{what} cannot be written as C: {error}") from error
    return _split(graph, result, places)


def _split(graph: Graph, result: Result, places: Collection[tuple[str, tuple[int, ...]]]) -> Step:
    """Take apart the conditions and what is given where they hold."""
    (well, *returned), conditions = result.returned, dict[Node, bool]()
    while well.operation is SELECT:
        condition, yes, no = well.arguments
        holds = no.is_constant and not no.value
        conditions[condition] = holds
        well = yes if holds else no

    def where_they_hold(node: Node) -> Node:
        if node.operation is not SELECT:
            return node
        condition, yes, no = node.arguments
        if condition in conditions:
            return where_they_hold(yes if conditions[condition] else no)
        return graph.select(condition, where_they_hold(yes), where_they_hold(no))

    found = {place: where_they_hold(node) for place, node in zip(places, returned, strict=True)}
    return Step(
        graph,
        {
            (name, place): node
            for (name, place), node in found.items()
            if name not in _SPARSE or not node.is_number(0.0)
        },
        tuple(
            condition if holds else graph.apply(operator.not_, condition)
            for condition, holds in conditions.items()
        ),
    )
