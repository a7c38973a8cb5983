"""Evaluation, as in Python, of values that are known while a kernel is lowered."""

import ast
import operator

import numpy as np

from fuselog.recorders.compiling.kernels.numbers import Number
from fuselog.recorders.compiling.kernels.values import Array, Record, entries
from fuselog.recorders.compiling.kinds import Value


def is_in(x: Value, many: Value) -> bool:
    """Evaluate `x in many`."""
    return x in many


def is_not_in(x: Value, many: Value) -> bool:
    """Evaluate `x not in many`."""
    return x not in many


# Python's operators by their nodes in a syntax tree.
OPERATORS: dict[type[ast.AST], Value] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: is_in,
    ast.NotIn: is_not_in,
}


def is_known(value: Value) -> bool:
    """Test whether all parts of a value are known before run time."""
    if isinstance(value, Number | Array):
        return False
    parts = entries(value)
    return parts is None or all(map(is_known, parts))


def as_python(value: Value) -> Value:
    """Convert a known value to Python's types."""
    if isinstance(value, Record):
        return value.type(*map(as_python, value.values))
    return tuple(map(as_python, value)) if isinstance(value, tuple) else value


def from_python(value: Value) -> Value:
    """Convert a Python value to the form that it has during lowering."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return Record(type(value), tuple(map(from_python, value)))
    if isinstance(value, tuple | list):
        return tuple(map(from_python, value))
    if isinstance(value, np.generic):
        return value if isinstance(value, np.unsignedinteger) else value.item()
    return value
