"""Translation of a graph to instructions of a kernel, or to Python."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from fuselog.recorders.compiling.kernels.functions import FUNCTIONS
from fuselog.recorders.compiling.kernels.numbers import (
    REAL,
    Emitter,
    Number,
    binary,
    compare,
    constant,
    inverse,
    negative,
    power,
)
from fuselog.replay.tracing.graph import CONSTANT, INPUT, POWER, SELECT, Node, needed

_BINARY = (operator.add, operator.sub, operator.mul, operator.truediv, operator.mod, operator.floordiv)
_COMPARISONS = (operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne)
_LOGICAL = (operator.and_, operator.or_, operator.xor)


def emit(
    emitter: Emitter, outputs: Sequence[Node], inputs: dict[Any, Number], known: dict[Node, Number]
) -> list[Number]:
    """Write the instructions of a graph.

    Args:
        emitter: destination of the instructions.
        outputs: nodes to compute.
        inputs: values of the graph's inputs in the kernel, by position.
        known: values of nodes that are computed elsewhere.
    """
    found = dict(known)
    for node in needed(outputs, known):
        if node in known:
            continue
        given = [found[each] for each in node.arguments]
        operation = node.operation
        if operation is INPUT:
            found[node] = inputs[node.value]
        elif operation is CONSTANT:
            found[node] = constant(node.value)
        elif operation is SELECT:
            found[node] = FUNCTIONS[np.where](emitter, *given)
        elif operation is POWER:
            found[node] = power(emitter, given[0], node.value)
        elif operation is operator.neg:
            found[node] = negative(emitter, emitter.as_kind(given[0], REAL))
        elif operation is operator.not_:
            found[node] = inverse(emitter, given[0])
        elif operation in _LOGICAL:
            found[node] = binary(emitter, operation, *given)
        elif operation in _BINARY:
            found[node] = binary(emitter, operation, *(emitter.as_kind(each, REAL) for each in given))
        elif operation in _COMPARISONS:
            found[node] = compare(emitter, operation, *given)
        else:
            found[node] = FUNCTIONS[operation](emitter, *given)
    return [emitter.as_kind(found[each], REAL) for each in outputs]


_SIGNS = {
    operator.add: "+",
    operator.sub: "-",
    operator.mul: "*",
    operator.truediv: "/",
    operator.mod: "%",
    operator.floordiv: "//",
    operator.lt: "<",
    operator.le: "<=",
    operator.gt: ">",
    operator.ge: ">=",
    operator.eq: "==",
    operator.ne: "!=",
    operator.and_: "&",
    operator.or_: "|",
    operator.xor: "^",
}


def python_of(outputs: Sequence[Node], inputs: dict[Any, str]) -> list[str]:
    """Return Python lines that compute the outputs of a graph and return them as a list."""
    lines: list[str] = []
    names: dict[Node, str] = {}
    for node in needed(outputs):
        if node.operation is INPUT:
            names[node] = inputs[node.value]
        elif node.operation is CONSTANT:
            names[node] = (
                f"float({repr(node.value)!r})" if isinstance(node.value, float) else repr(node.value)
            )
        else:
            names[node] = f"v{len(lines)}"
            lines.append(f"{names[node]} = {expression(node, [names[each] for each in node.arguments])}")
    return [*lines, f"return [{', '.join(names[each] for each in outputs)}]"]


def expression(node: Node, given: Sequence[str]) -> str:
    """Write a node as an expression of its arguments."""
    operation = node.operation
    if operation is SELECT:
        return f"{given[1]} if {given[0]} else {given[2]}"
    if operation is POWER:
        return f"{given[0]} ** {node.value}"
    if operation is operator.neg:
        return f"-{given[0]}"
    if operation is operator.not_:
        return f"not {given[0]}"
    if operation in _SIGNS:
        return f"{given[0]} {_SIGNS[operation]} {given[1]}"
    return f"np.{operation.__name__}({', '.join(given)})"
