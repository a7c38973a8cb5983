"""Operation counts of the steps of a filter in C, from their graphs and their loops."""

import operator
from collections.abc import Collection, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.deploying.c_source.names import CFilter
from fuselog.pipeline.deploying.c_source.statements import retriangulates
from fuselog.replay.inference.kalman.iterated_update import ITERATIONS
from fuselog.replay.inference.kalman.regression import MEANS
from fuselog.replay.inference.linear_algebra.covariances import COVARIANCES
from fuselog.replay.inference.linear_algebra.factors import FACTORS
from fuselog.replay.inference.linear_algebra.gaussian import (
    Innovation,
    add_through,
    downdate,
    kalman_step,
    whiten,
)
from fuselog.replay.inference.linear_algebra.inflation import inflate
from fuselog.replay.inference.linear_algebra.manifold import by_right_jacobian
from fuselog.replay.inference.linear_algebra.sparse import (
    measuring_covariance,
    pattern_of,
    propagating_covariance,
)
from fuselog.replay.inference.model.corrections import sloping
from fuselog.replay.inference.sampled_steps import SETTLING, SampledFunction
from fuselog.replay.inference.step_graphs import Step
from fuselog.replay.tracing.functions import Argument, Shape, trace
from fuselog.replay.tracing.graph import (
    CONSTANT,
    INPUT,
    POWER,
    SELECT,
    Graph,
    Level,
    Node,
    choices,
    needed,
    steady,
)

_FLOPS = (operator.add, operator.sub, operator.mul, operator.truediv)
_FREE = (
    *(CONSTANT, INPUT, SELECT),
    *(operator.neg, operator.not_, operator.and_, operator.or_, operator.xor),
    *(operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne),
    *(np.absolute, np.isnan, np.isfinite, np.isinf, np.signbit, np.sign, np.fmin, np.fmax),
)


class Cost(NamedTuple):
    """An upper bound of a step's cost: the costlier alternative of every branch, and most iterations.

    Attributes:
        flops: additions, subtractions, multiplications and divisions.
        roots: square roots.
        calls: calls of other functions of libm, such as sin and fmod.
    """

    flops: int
    roots: int = 0
    calls: int = 0


NOTHING = Cost(0)
Products = tuple[Cost, Cost]


def added(*costs: Cost) -> Cost:
    """Add costs."""
    return Cost(*(sum(each) for each in zip(*costs, strict=True))) if costs else NOTHING


def costs_of(made: CFilter) -> tuple[dict[str, Cost], list[Products]]:
    """Count the cost of a filter's functions, by name.

    The function also returns, for the motion and every sensor, the cost of products with a Jacobian,
    once with all its entries, and once without those that are known to be zero or one.
    """
    t, steps = made.tangent, made.steps
    products = [_products(steps.predict, "F", t, t, is_root=made.is_root)]
    costs = {"predict": added(_cost_of_step(steps.predict), products[0][1], _loops(made, 0, t))}
    for row, ((name, sensor), step) in enumerate(zip(made.sensors, steps.innovate, strict=True)):
        m, robust = len(sensor.measured), {**made.robustness(row + 1), "reopens_s": np.nan}
        products.append(_products(step, "H", m, t, is_root=made.is_root))
        own = added(_cost_of_step(step), products[-1][1], _loops(made, row + 1, m))
        is_robust = any(value == value for value in robust.values())
        algebra = _factored_algebra(m, t) if made.is_root else _algebra(m, t, is_robust)
        times = ITERATIONS if steps.is_iterated else 1
        costs[f"update_{name}"] = added(*[own, algebra] * times, _correction(made))
    return costs, products


def _cost_of_step(step: Step) -> Cost:
    return cost_of(list(step.outputs.values()))


def cost_of(outputs: Sequence[Node], known: Collection[Node] = ()) -> Cost:
    """Count the operations of a graph; for a branch, count those of the more expensive alternative."""
    choice_of, levels = choices(outputs, known)
    on_level: dict[Level, list[Node]] = {}
    for node in needed(outputs, known):
        if node not in known:
            on_level.setdefault(levels.get(node), []).append(node)

    def cost(level: Level) -> Cost:
        own = on_level.get(level, [])
        branches = {id(choice_of[node]): choice_of[node] for node in own if node in choice_of}
        sides = [[cost((each, index)) for index in (0, 1)] for each in branches.values()]
        return added(*map(_operation, own), *(Cost(*map(max, *both)) for both in sides))

    return cost(None)


def _operation(node: Node) -> Cost:
    if node.operation in _FLOPS:
        return Cost(1)
    if node.operation is POWER:
        return Cost(abs(node.value).bit_length() + abs(node.value).bit_count() - 2 + (node.value < 0))
    if node.operation is np.sqrt:
        return Cost(0, roots=1)
    if node.operation is np.sinc:  # sin(pi x) / (pi x)
        return Cost(2, calls=1)
    return NOTHING if node.operation in _FREE else Cost(0, calls=1)


def _traced(function: Any, *arguments: Argument) -> Cost:
    result = trace(Graph(), function, arguments)
    return cost_of([*result.returned, *(node for _, _, node in result.written)])


def _loops(made: CFilter, part: int, size: int) -> Cost:
    """Count the cost of the motion's (0) or a sensor's loops: those for samples, noise and factors."""
    step = made.steps.predict if part == 0 else made.steps.innovate[part - 1]
    sampled, t = made.steps.sampled[part], made.tangent
    costs = [_entering(step, size)]
    if sampled is not None:
        costs.append(_sampling(sampled))
        costs.append(_spread(sampled, t, part, is_root=made.is_root))
    columns = t if sampled is None else len(sampled.points)
    if made.is_root:
        rows = t if part == 0 else size + t
        costs += [_filling_root(size), _orthogonalising(rows, columns + size)]
    return added(*costs)


def _entering(step: Step, size: int) -> Cost:
    """Count the cost of adding noise that is multiplied by gains."""
    gains = sum(name == "u" for name, _ in step.outputs)
    if not gains:
        return NOTHING
    return _traced(add_through, Shape((size, size)), Shape((size, gains)), Shape((gains,)))


def _sampling(sampled: SampledFunction) -> Cost:
    """Count the cost of evaluating a function at samples and averaging, with the most iterations."""
    count, size = sampled.points.shape
    once = added(
        _cost_of_step(sampled.variances), _cost_of_step(sampled.centre), Cost(0, sampled.noises)
    )
    values = _in_loop(sampled.value, sampled.varying, count)
    own = added(once, values, Cost(size * size * count), _narrowing(sampled))
    mean = Cost(2 * count * sampled.size)
    if sampled.recentre is None:
        return added(own, mean, Cost(sampled.size))
    curved = cost_of([sampled.move.outputs["centre", (i,)] for i in sampled.curved])
    again = added(mean, curved, _in_loop(sampled.recentre, SETTLING, count))
    return added(own, mean, _cost_of_step(sampled.move), *[again] * MEANS)


def _narrowing(sampled: SampledFunction) -> Cost:
    """Count the operations that keep sampled angles within half a turn if an angle is very uncertain."""
    if not sampled.turns:
        return NOTHING
    count, size = sampled.points.shape
    rows = [row for first, width, _ in sampled.turns for row in range(first, first + width)]
    entries, turns = sum(row + 1 for row in rows), len(sampled.turns)
    looked = Cost(2 * entries + 3 * turns)
    bounded = Cost(4 * entries + len(rows), len(rows))
    reach = Cost(count * (2 * entries + 2 * len(rows)) + turns, turns)
    factors = size * (size + 1)  # narrowed, and widened again
    back = Cost(1 + factors + count * size + sampled.size * (count + 1))
    return added(looked, bounded, reach, back)


def _in_loop(step: Step, varying: Collection[int], count: int) -> Cost:
    """Count the cost of a step at every sample; operations that all samples share are counted once."""
    outputs = list(step.outputs.values())
    same = steady(outputs, lambda at: at[0] in varying)
    return added(cost_of(same), *[cost_of(outputs, same)] * count)


def _spread(sampled: SampledFunction, t: int, part: int, *, is_root: bool) -> Cost:
    """Count the operations that form covariances, or rows to factorise, from values at samples."""
    count, v = len(sampled.points), sampled.size
    if is_root:
        return Cost(count * v)
    cross = 4 * t * v * count if part else 0
    if len(sampled.axes):
        cross = count * (1 + 3 * v) + t * (t + 1) * v
    return added(Cost(5 * count * v * (v + 1) // 2 + cross), _cholesky(t))


def _cholesky(size: int) -> Cost:
    below = size * (size - 1) // 2
    return Cost(sum(2 * column * (size - column) for column in range(size)) + below, size)


def _orthogonalising(rows: int, columns: int) -> Cost:
    own = sum(3 * columns + 2 * i + 2 for i in range(rows))
    return Cost(own + rows * (rows - 1) // 2 * (6 * columns + 1), rows)


def _filling_root(size: int) -> Cost:
    """Count the cost of factorising a noise covariance; the search for a pivot also divides."""
    return Cost(size * (1 + 4 * size + size + 2 * size * size), size)


@cache
def _algebra(m: int, t: int, is_robust: bool) -> Cost:
    """Count the cost of an update with an innovation of m components, for a tangent space of size t."""

    def update(v: Any, spread: Any, cross: Any, covariance: Any, factor: Any) -> Any:
        innovation, step = Innovation(v, spread, cross), np.empty(t, object)
        squared, _ = whiten(innovation, m)
        if is_robust:
            inflate(innovation, m, factor)
        kalman_step(innovation, m, step)
        downdate(covariance, cross, m)
        return squared, *step

    return _traced(update, Shape((m,)), Shape((m, m)), Shape((t, m)), Shape((t, t)), None)


def _factored_algebra(m: int, t: int) -> Cost:
    """Count the cost of updating a factored covariance: S, whitening, the step, and the new factor."""
    square = sum(2 * (column + 1) for row in range(m) for column in range(row + 1))
    return added(Cost(square + m * m + 2 * m + 3 * t * m + 2 * m), _orthogonalising(t, m + t))


def _products(step: Step, jacobian: str, rows: int, t: int, *, is_root: bool) -> Products:
    """Count the cost of products with a Jacobian, with all its entries and without the known entries."""
    if not step.has(jacobian):
        return NOTHING, NOTHING
    known = {
        (place[0], place[1]): node.value if node.is_constant else None
        for (name, place), node in step.outputs.items()
        if name == jacobian
    }
    # J L with a lower factor L: an entry in column k is multiplied by k + 1 entries of the factor
    if is_root:
        return Cost(rows * t * (t + 1)), Cost(sum(2 * (column + 1) for _, column in known))
    patterns = None, pattern_of(known, rows)
    square = Shape((t, t))
    if jacobian == "F":
        first, last = (_traced(propagating_covariance(each), *(square,) * 3) for each in patterns)
    else:
        sizes = square, Shape((rows, t)), Shape((t, rows)), Shape((rows, rows))
        first, last = (_traced(measuring_covariance(each), *sizes) for each in patterns)
    return first, last


def _correction(made: CFilter) -> Cost:
    model, step, t = made.filtering.bound_model.model, made.steps.correct, made.tangent
    kinds, square = model.kinds, Shape((t, t))
    mean, vector = Shape((model.size,)), Shape((t,))
    own = added(_cost_of_step(step), _products(step, "F", t, t, is_root=made.is_root)[1])
    form = FACTORS if made.is_root else COVARIANCES
    if model.correct is not None:
        own = added(own, _traced(sloping(kinds, model.correct, form), mean, square, vector))
        return added(own, _orthogonalising(t, t)) if made.is_root else own
    turning = by_right_jacobian(kinds)
    if not made.is_root:
        return added(own, _traced(partial(COVARIANCES.turn, turning), vector, square))
    turned = added(own, _traced(turning, vector, square))
    return added(turned, _orthogonalising(t, t)) if retriangulates(made) else turned
