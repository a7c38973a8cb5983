"""Tracing of the parts of a filter's steps: graphs are made from functions that return arrays by name.

The functions are called with traced numbers; a graph contains the same operations in the same order,
without terms that are known to be zero.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.tracing.functions import Argument, trace
from fuselog.replay.tracing.graph import Graph, Node

# An array or a tuple of traced numbers, or a traced number.
TracedValue = Any  # type: ignore[explicit-any]
# Function that returns traced values, often by name; its arguments depend on the step.
StepFunction = Callable[..., TracedValue]  # type: ignore[explicit-any]

_SPARSE = ("F", "H", "G", "N")


class Step(NamedTuple):
    """Step of a filter, or part of a step, as a graph.

    Attributes:
        graph: the graph.
        outputs: its output nodes, by name of array and index; zero entries of F, H, G and N are left
            out.
    """

    graph: Graph
    outputs: Mapping[tuple[str, tuple[int, ...]], Node]

    def has(self, name: str) -> bool:
        """Test whether the step returns an array of this name."""
        return any(each == name for each, _ in self.outputs)

    def columns(self, name: str, rows: int) -> list[list[int]]:
        """List, for each row of a matrix, the columns whose entries are not known to be zero."""
        places = sorted(place for each, place in self.outputs if each == name)
        return [[place[1] for place in places if place[0] == row] for row in range(rows)]


def traced_step(what: str, function: StepFunction, arguments: tuple[Argument, ...]) -> Step:
    """Trace a function that returns arrays by name.

    Args:
        what: name of the step, for errors.
        function: the function.
        arguments: its arguments, as for `fuselog.replay.tracing.functions.trace`.

    Raises BadInput if the function cannot be traced.
    """
    graph, places = Graph(), list[tuple[str, tuple[int, ...]]]()

    def flat(*given: TracedValue) -> TracedValue:
        arrays = {name: np.array(array, object) for name, array in function(*given).items()}
        places[:] = [
            (name, place) for name, array in arrays.items() for place in np.ndindex(array.shape)
        ]
        return tuple(each for array in arrays.values() for each in array.ravel())

    try:
        result = trace(graph, flat, arguments)
    except BadInput as error:
        raise BadInput(f"{what} cannot be written as C: {error}") from error
    outputs = {
        (name, place): node
        for (name, place), node in zip(places, result.returned, strict=True)
        if name not in _SPARSE or not node.is_number(0.0)
    }
    return Step(graph, outputs)


def zeros(*sizes: int) -> TracedValue:
    """Make an array of zeros that can store traced numbers."""
    return np.zeros(sizes).astype(object)
