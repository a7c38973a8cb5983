"""A filter's whole steps as graphs: its prediction, each sensor's innovation, and the correction.

The steps that kernels are compiled from are called with traced numbers, covariances and all. So a graph
has their operations in their order, and no product with what is known to be zero.
"""

import operator
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from replay.engine.arrays import Function
from replay.inference.kalman.predict import linear_motion
from replay.inference.kalman.regression import sampled_motion, sampled_sensor
from replay.inference.kalman.steps import Interval, Measurement
from replay.inference.kalman.update import linear_sensor, reading
from replay.inference.model.corrections import correcting, sloping
from replay.inference.model.parameters import number_fields
from replay.inference.model.stage import Stage
from replay.inference.run.filtering import Filter
from replay.inference.run.samples import sample_sets
from replay.tracing.functions import Argument, Result, Shape, trace
from replay.tracing.graph import SELECT, Graph, Node


class Step(NamedTuple):
    """Holds one step as a graph.

    Attributes:
        graph: the graph.
        outputs: what it gives, by argument and place where it writes, or by its number.
        conditions: truths that have to hold; it gives nothing where one does not.
    """

    graph: Graph
    outputs: Mapping[Any, Node]
    conditions: tuple[Node, ...]


class WholeSteps(NamedTuple):
    """Holds the steps of a filter with n components of the state, t of its tangent space.

    Attributes:
        predict: of (mean, covariance, control, duration_s, parameters), it writes the first two.
        innovate: of (mean, covariance, data, parameters), for every sensor of m components: it gives v
            (m), the lower triangle of S, and C (t, m), row by row.
        correct: of (mean, covariance, step), it writes the first two.
    """

    predict: Step
    innovate: tuple[Step, ...]
    correct: Step


EXTENDED, SAMPLED = "extended", "sampled"


def whole_steps(filtering: Filter, kind: str) -> WholeSteps:
    """Trace the steps of a filter.

    Args:
        filtering: the filter, bound to a log.
        kind: EXTENDED for derivatives, SAMPLED for regression at samples.

    Raises BadInput where a step is no graph, as that of sampled angles.
    """
    stage = filtering.stage
    model, motion = stage.model, stage.motion
    n, t, names = model.size, model.tangent, number_fields(model.parameters)
    is_sampled = kind == SAMPLED
    if is_sampled and not motion.linear:
        _check_straight("the prediction", model.kinds)
    move = sampled_motion(stage, 0) if is_sampled and not motion.linear else linear_motion(stage)
    [(_, sets)] = sample_sets(filtering.samplers, (), np.zeros(1, np.int64))

    def memory() -> Any:
        return _of_objects(filtering.steps.memory(sets))

    def predict(mean: Any, covariance: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
        return (move(mean, covariance, Interval(control, duration_s, parameters, 0), memory()),)

    gaussian: tuple[Argument, ...] = (Shape((n,)), Shape((t, t)))
    innovations = []
    samples = int(is_sampled and not motion.linear)
    for number, sensor in enumerate(stage.sensors):
        if is_sampled and not sensor.linear:
            _check_straight(f"sensor {sensor.topic}", sensor.measured.values())
            innovate = sampled_sensor(stage, number, samples)
            samples += 1
        else:
            innovate = linear_sensor(stage, number)
        step = _innovating(innovate, number, memory)
        width = Shape((reading(sensor).width,))
        innovations.append(_traced(f"sensor {sensor.topic}", step, (*gaussian, width, names)))
    return WholeSteps(
        _traced("the prediction", predict, (*gaussian, Shape((model.controls,)), None, names)),
        tuple(innovations),
        _traced("the correction", _correcting(stage, memory), (*gaussian, Shape((t,)))),
    )


def _check_straight(what: str, kinds: Collection[str]) -> None:
    """Raise BadInput where the mean of samples is found step by step, which is no graph."""
    bent = [kind for kind in kinds if kind != "linear"]
    if bent:
        averaged = "an orientation" if bent[0] == "quaternion" else f"an {bent[0]}"
        raise BadInput(
            f"{what} cannot be written as C: samples of {averaged} are averaged in a loop; give -e ekf"
        )


def _innovating(innovate: Function, number: int, memory: Callable[[], Any]) -> Function:
    def step(mean: Any, covariance: Any, data: Any, parameters: Any) -> Any:
        work = memory()
        well = innovate(mean, covariance, Measurement(data, parameters, None, 0), work)  # type: ignore[arg-type]
        difference, spread, cross = work.innovations[number]
        if not well:
            return (False, *(0.0 for _ in range(_entries(spread, cross))))
        lower = (spread[row, column] for row in range(len(spread)) for column in range(row + 1))
        return (True, *difference, *lower, *cross.ravel())

    return step


def _entries(spread: Any, cross: Any) -> int:
    m = len(spread)
    return m + m * (m + 1) // 2 + cross.size


def _correcting(stage: Stage, memory: Callable[[], Any]) -> Function:
    kinds, correct = stage.model.kinds, stage.model.correct
    find_slope, move = sloping(kinds, correct), correcting(kinds, correct)

    def step(mean: Any, covariance: Any, along: Any) -> Any:
        work = memory()._replace(step=along)
        find_slope(mean, covariance, work.slope)
        move(mean, covariance, work)
        return (True,)

    return step


def _of_objects(value: Any) -> Any:
    """A workspace that takes traced numbers."""
    if isinstance(value, np.ndarray):
        return value.astype(object) if value.dtype == float else value
    if isinstance(value, tuple):
        parts = [_of_objects(each) for each in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _traced(what: str, function: Function, arguments: tuple[Argument, ...]) -> Step:
    graph = Graph()
    try:
        result = trace(graph, function, arguments)
    except BadInput as error:
        raise BadInput(f"{what} cannot be written as C: {error}") from error
    return _split(graph, result)


def _split(graph: Graph, result: Result) -> Step:
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

    outputs: dict[Any, Node] = {index: where_they_hold(node) for index, node in enumerate(returned)}
    outputs |= {(argument, place): where_they_hold(node) for argument, place, node in result.written}
    return Step(
        graph,
        outputs,
        tuple(
            condition if holds else graph.apply(operator.not_, condition)
            for condition, holds in conditions.items()
        ),
    )
