"""Exact forward differentiation of graphs with respect to chosen inputs.

Griewank and Walther, Evaluating Derivatives, chapter 3. Only derivatives that can differ from zero are
computed, so the sparsity pattern of a Jacobian is also known. If a derivative does not exist or is
infinite at a point, its value is defined as follows:

- `sqrt`, `cbrt`, `hypot`, `arctan2` and `abs` have slope 0 if their arguments are 0: for `abs`, this is
  the mean of the slopes on both sides, and for the length of a zero vector, it avoids NaN;
- the minimum and the maximum of two equal numbers have the slopes of the first;
- step functions (`floor`, `round`, `sign`, `//`) have slope 0 everywhere, and `a % b` has the slopes of
  `a - b floor(a / b)`;
- a branch has the slopes of the selected side.

Other infinite derivatives (`log` at 0, `1 / x`) result in slopes that are infinite or NaN.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fuselog.replay.tracing.graph import CONSTANT, INPUT, POWER, SELECT, Node, needed
from fuselog.replay.tracing.traced import Trace, Traced, where


def _sinc_slope(value: Any, x: Any) -> tuple[Any]:
    u = np.pi * x
    square = u * u  # near 0 the quotient loses digits; the next term of the series is below 1e-18
    series = -np.pi * u / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0 * (1.0 - square / 54.0)))
    return (where(abs(u) < 0.03, series, (np.cos(u) - value) / x),)


def _arctan2_slopes(value: Any, y: Any, x: Any) -> tuple[Any, Any]:
    squared = x * x + y * y
    at_zero = squared == 0.0
    return where(at_zero, 0.0, x / squared), where(at_zero, 0.0, -y / squared)


def _power_slopes(value: Any, base: Any, exponent: Any) -> tuple[Any, Any]:
    by_base = where(exponent == 0.0, 0.0, exponent * base ** (exponent - 1.0))
    return by_base, where(base == 0.0, 0.0, value * np.log(base))


# Derivatives of the value of a function by each argument, from its value and its arguments.
SLOPES: dict[Any, Callable[..., tuple[Any, ...]]] = {
    operator.neg: lambda v, x: (-1.0,),
    operator.add: lambda v, x, y: (1.0, 1.0),
    operator.sub: lambda v, x, y: (1.0, -1.0),
    operator.mul: lambda v, x, y: (y, x),
    operator.truediv: lambda v, x, y: (1.0 / y, -v / y),
    operator.mod: lambda v, x, y: (1.0, -np.floor(x / y)),
    np.power: _power_slopes,
    np.fmod: lambda v, x, y: (1.0, -np.trunc(x / y)),
    np.absolute: lambda v, x: (np.sign(x),),
    np.copysign: lambda v, x, y: (np.copysign(1.0, x) * np.copysign(1.0, y), 0.0),
    np.sqrt: lambda v, x: (where(v == 0.0, 0.0, 0.5 / v),),
    np.cbrt: lambda v, x: (where(v == 0.0, 0.0, 1.0 / (3.0 * v * v)),),
    np.hypot: lambda v, x, y: (where(v == 0.0, 0.0, x / v), where(v == 0.0, 0.0, y / v)),
    np.exp: lambda v, x: (v,),
    np.exp2: lambda v, x: (v * np.log(2.0),),
    np.expm1: lambda v, x: (v + 1.0,),
    np.log: lambda v, x: (1.0 / x,),
    np.log2: lambda v, x: (1.0 / (x * np.log(2.0)),),
    np.log10: lambda v, x: (1.0 / (x * np.log(10.0)),),
    np.log1p: lambda v, x: (1.0 / (1.0 + x),),
    np.sin: lambda v, x: (np.cos(x),),
    np.cos: lambda v, x: (-np.sin(x),),
    np.tan: lambda v, x: (1.0 + v * v,),
    np.arcsin: lambda v, x: (1.0 / np.sqrt(1.0 - x * x),),
    np.arccos: lambda v, x: (-1.0 / np.sqrt(1.0 - x * x),),
    np.arctan: lambda v, x: (1.0 / (1.0 + x * x),),
    np.arctan2: _arctan2_slopes,
    np.sinc: _sinc_slope,
    np.sinh: lambda v, x: (np.cosh(x),),
    np.cosh: lambda v, x: (np.sinh(x),),
    np.tanh: lambda v, x: (1.0 - v * v,),
    np.arcsinh: lambda v, x: (1.0 / np.sqrt(x * x + 1.0),),
    np.arccosh: lambda v, x: (1.0 / np.sqrt(x * x - 1.0),),
    np.arctanh: lambda v, x: (1.0 / (1.0 - x * x),),
}
# Functions that are constant except for steps.
_STEPS = (np.floor, np.ceil, np.trunc, np.rint, np.sign, operator.floordiv)

Slopes = dict[int, Node]


def slopes_of(trace: Trace, outputs: Sequence[Node], seeds: Mapping[Node, Slopes]) -> list[Slopes]:
    """Compute, for each output, its derivatives by variable; derivatives that are missing are zero.

    Args:
        trace: trace whose graph contains the nodes; the derivatives are added to the graph.
        outputs: nodes to differentiate.
        seeds: by input node, its derivatives by variable; variables are numbered.
    """
    found: dict[Node, Slopes] = {}
    for node in needed(outputs):
        found[node] = seeds.get(node, {}) if node.operation is INPUT else _chained(trace, node, found)
    return [found[node] for node in outputs]


def _chained(trace: Trace, node: Node, found: Mapping[Node, Slopes]) -> Slopes:
    """Apply the chain rule to one node."""
    graph, zero = trace.graph, trace.graph.constant(0.0)
    if node.operation is CONSTANT or node.is_truth or node.operation in _STEPS:
        return {}
    of_arguments = [found[each] for each in node.arguments]
    if not any(of_arguments):
        return {}
    if node.operation is SELECT:
        condition, _, _ = node.arguments
        _, of_yes, of_no = of_arguments
        chosen = {
            k: graph.select(condition, of_yes.get(k, zero), of_no.get(k, zero))
            for k in sorted(of_yes | of_no)
        }
        return {k: each for k, each in chosen.items() if not each.is_number(0.0)}
    numbers = [trace.number(each) for each in node.arguments]
    if node.operation is POWER:
        by_arguments: tuple[Any, ...] = (_power_slope(trace.number(node), numbers[0], node.value),)
    else:
        by_arguments = SLOPES[node.operation](trace.number(node), *numbers)
    total: Slopes = {}
    for by, slopes in zip(by_arguments, of_arguments, strict=True):
        for k, slope in slopes.items():
            term = graph.apply(operator.mul, trace.node_of(by), slope)
            total[k] = graph.apply(operator.add, total[k], term) if k in total else term
    return {k: each for k, each in sorted(total.items()) if not each.is_number(0.0)}


def _power_slope(value: Traced, base: Traced, exponent: int) -> Any:
    if exponent < 0:
        return exponent * value / base
    return exponent * base ** (exponent - 1)
