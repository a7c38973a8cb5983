"""How the tests of tracing call a function: with its derivatives, compiled and in plain Python."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.tracing.functions import Derivative, TracedFunction
from fuselog.replay.tracing.graph import Node
from fuselog.replay.tracing.traced import Trace


def linearised(function: Callable[[Any], Any], variables: int) -> Derivative:
    """A function of a tuple of numbers that returns a tuple, with all derivatives, by (row, column)."""

    def seeds(trace: Trace) -> dict[Node, dict[int, Node]]:
        one = trace.graph.constant(1.0)
        return {trace.graph.input((0, k)): {k: one} for k in range(variables)}

    def combine(
        _: Trace, returned: Sequence[Node], slopes: Sequence[Mapping[int, Node]]
    ) -> dict[Any, Node]:
        return {(row, k): node for row, each in enumerate(slopes) for k, node in each.items()}

    return Derivative(TracedFunction(function, (variables,)), seeds, combine)


def over_points(functions: tuple[Callable[..., Any], ...], variables: int) -> Callable[..., None]:
    """A kernel of functions that return tuples: fills out (points, functions, numbers)."""

    def one(run: int, given: Floats, out: Floats) -> None:
        x = tuple(given[run, k] for k in range(variables))
        for row, function in enumerate(functions):
            for place, number in enumerate(function(x)):
                out[run, row, place] = number

    return one


def by_compiler(functions: Sequence[Derivative], points: Floats) -> list[Floats]:
    """Of every function the values and derivatives (points, rows, 1 + variables)."""
    points = np.array(points, dtype=float)
    kernel = over_points(tuple(functions), points.shape[1])
    out = np.full((len(points), len(functions), max(len(each.outputs) for each in functions)), np.nan)
    compile_over_runs(kernel)(len(points), points, out)
    return [_dense(each, out[:, k], points.shape[1]) for k, each in enumerate(functions)]


def by_python(functions: Sequence[Derivative], points: Floats) -> list[Floats]:
    """The same as plain Python has it."""
    with np.errstate(all="ignore"):
        found = [[each(tuple(x)) for x in np.array(points, dtype=float)] for each in functions]
    return [
        _dense(each, np.array(rows, dtype=float), np.shape(points)[1])
        for each, rows in zip(functions, found, strict=True)
    ]


def _dense(function: Derivative, numbers: Floats, variables: int) -> Floats:
    rows = len(function.function.result.returned)
    out = np.zeros((len(numbers), rows, 1 + variables))
    out[:, :, 0] = numbers[:, :rows]
    for place, (row, k) in enumerate(function.places):
        out[:, row, 1 + k] = numbers[:, rows + place]
    return out
