"""Derivatives of a model's functions between the tangent spaces of their arguments and results.

A function is traced (`fuselog.replay.tracing`), and a kernel writes the exact derivatives of its graph
to the arrays of its workspace.
"""

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from fuselog.replay.engine.arrays import AnyArgument
from fuselog.replay.engine.vectors.tangent import WIDTHS
from fuselog.replay.inference.linear_algebra.manifold import manifold_blocks, tangent_size
from fuselog.replay.inference.linear_algebra.tuples import range_of
from fuselog.replay.tracing.functions import Derivative, TracedFunction
from fuselog.replay.tracing.graph import Node
from fuselog.replay.tracing.traced import Trace

# Hamilton product of the units: e_i e_j = sign * e_k; row k lists (i, j, sign).
_PRODUCT = (
    ((0, 0, 1), (1, 1, -1), (2, 2, -1), (3, 3, -1)),
    ((0, 1, 1), (1, 0, 1), (2, 3, 1), (3, 2, -1)),
    ((0, 2, 1), (1, 3, -1), (2, 0, 1), (3, 1, 1)),
    ((0, 3, 1), (1, 2, 1), (2, 1, -1), (3, 0, 1)),
)


# Inputs, other arguments and workspace; their number depends on the linearised function.
Linearise = Callable[..., None]  # type: ignore[explicit-any]
Place = tuple[str, int, int]  # an array of the workspace, row and column


class Input(NamedTuple):
    """Input for which derivatives are computed: its name, its kinds, and where its Jacobian is stored.

    `into` is the name of an array in the workspace; it is empty if the derivative is not requested. An
    argument with `zero` is not passed, because it is noise with mean zero.
    """

    name: str
    kinds: tuple[str, ...]
    into: str = ""
    zero: bool = False


def derivative(
    function: object, inputs: Sequence[Input], outputs: Sequence[str], values: str = ""
) -> Linearise:
    """Make a function that computes values and exact Jacobians of a component-first function.

    Args:
        function: function of the inputs, which are tuples, and of other arguments; it returns a tuple
            and is traced.
        inputs: its first arguments.
        outputs: kinds of its results.
        values: array of the workspace for the values (n,), if requested.

    Returns:
        `linearise(inputs..., others..., work)`, without inputs that are zero. It fills the values and
        the requested Jacobians (t of the outputs, t of the input), in the tangent spaces.
    """
    assert isinstance(function, TracedFunction)
    wanted = [(index, each) for index, each in enumerate(inputs) if each.into]
    sizes = [tangent_size(each.kinds) for _, each in wanted]
    firsts = [sum(sizes[:place]) for place in range(len(wanted))]
    columns = [
        (each.into, column)
        for (_, each), size in zip(wanted, sizes, strict=True)
        for column in range(size)
    ]

    def seeds(trace: Trace) -> dict[Node, dict[int, Node]]:
        found: dict[Node, dict[int, Node]] = {}
        for (index, each), first in zip(wanted, firsts, strict=True):
            found |= _seeded(trace, index, each.kinds, first)
        return found

    def combine(
        trace: Trace, returned: Sequence[Node], slopes: Sequence[Mapping[int, Node]]
    ) -> dict[Place, Node]:
        return {
            (columns[variable][0], row, columns[variable][1]): node
            for variable in range(len(columns))
            for row, node in _in_tangent_space(trace, outputs, returned, slopes, variable)
        }

    linearised = Derivative(function, seeds, combine)
    zeros = tuple((index, (0.0,) * len(each.kinds)) for index, each in enumerate(inputs) if each.zero)
    count, rows = len(outputs), tangent_size(outputs)
    written = tuple((len(outputs) + index, *place) for index, place in enumerate(linearised.places))
    known = set(linearised.places)
    empty = tuple(
        (into, row, column)
        for into, column in columns
        for row in range(rows)
        if (into, row, column) not in known
    )

    def linearise(*given: AnyArgument) -> None:
        work, arguments = given[-1], given[:-1]
        for place, zero in zeros:
            arguments = (*arguments[:place], zero, *arguments[place:])
        found = linearised(*arguments)
        if values:
            for index in range_of(count):
                getattr(work, values)[index] = found[index]
        for into, row, column in empty:
            getattr(work, into)[row, column] = 0.0
        for index, into, row, column in written:
            getattr(work, into)[row, column] = found[index]

    linearise.__dict__["known"] = {
        place: node.value if node.is_constant else None for place, node in linearised.entries.items()
    }
    return linearise


def known_entries(linearise: Linearise, into: str) -> dict[tuple[int, int], float | None] | None:
    """Return the entries of a Jacobian that may be nonzero, by index: the value if constant, else None.

    The result is None if the entries are unknown, as for a Jacobian that is written by hand.
    """
    known = linearise.__dict__.get("known")
    if known is None:
        return None
    return {(row, column): value for (name, row, column), value in known.items() if name == into}


def _seeded(
    trace: Trace, argument: int, kinds: Sequence[str], first: int
) -> dict[Node, dict[int, Node]]:
    """Return the derivatives of the components of an argument with respect to its tangent space."""
    graph = trace.graph
    x = [graph.input((argument, index)) for index in range(len(kinds))]
    one, found = graph.constant(1.0), {}
    for kind, c, t, _ in manifold_blocks(kinds):
        at = first + t
        if kind in ("linear", "angle"):
            found[x[c]] = {at: one}
        elif kind == "axis":
            found[x[c]] = {at: graph.apply(operator.neg, x[c + 1])}
            found[x[c + 1]] = {at: x[c]}
        else:  # d(q exp(d/2))/dd at 0 is q times half a unit
            for row in range(4):
                found[x[c + row]] = {
                    at + j - 1: graph.apply(operator.mul, graph.constant(0.5 * sign), x[c + i])
                    for i, j, sign in _PRODUCT[row]
                    if j > 0
                }
    return found


def _in_tangent_space(
    trace: Trace,
    kinds: Sequence[str],
    returned: Sequence[Node],
    slopes: Sequence[Mapping[int, Node]],
    variable: int,
) -> Iterator[tuple[int, Node]]:
    """Yield, by row, the derivatives of a function's results by one variable in the tangent space."""
    zero = trace.graph.constant(0.0)
    y = [trace.number(node) for node in returned]
    for kind, c, t, _ in manifold_blocks(kinds):
        by = [slopes[c + index].get(variable, zero) for index in range(WIDTHS[kind])]
        d = [trace.number(node) for node in by]
        if kind in ("linear", "angle"):
            yield t, by[0]
        elif kind == "axis":
            yield t, trace.node_of(y[c] * d[1] - y[c + 1] * d[0])
        else:
            for row in (1, 2, 3):
                total: AnyArgument = 0.0
                for i, j, sign in _PRODUCT[row]:
                    term = y[c + i] * d[j]
                    total = total + term if (sign > 0) == (i == 0) else total - term
                yield t + row - 1, trace.node_of(2.0 * total)
