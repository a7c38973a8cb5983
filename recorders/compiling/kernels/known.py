"""Evaluates what is known while a kernel is lowered, as Python would."""

import ast
import operator

import numpy as np

from fuselog.recorders.compiling.kernels.numbers import Number
from fuselog.recorders.compiling.kernels.values import Array, Record, entries
from fuselog.recorders.compiling.kinds import Value


def is_in(x: Value, many: Value) -> bool:
    """Tell what `x in many` is."""
    return x in many


def is_not_in(x: Value, many: Value) -> bool:
    """Tell what `x not in many` is."""
    return x not in many


# Python's operators by their names in a source.
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
    """Tell whether nothing of a value exists at run time only."""
    if isinstance(value, Number | Array):
        return False
    parts = entries(value)
    return parts is None or all(map(is_known, parts))


def as_python(value: Value) -> Value:
    """Return what is known, as Python has it."""
    if isinstance(value, Record):
        return value.type(*map(as_python, value.values))
    return tuple(map(as_python, value)) if isinstance(value, tuple) else value


def from_python(value: Value) -> Value:
    """Return what Python has, as it is known while lowering."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return Record(type(value), tuple(map(from_python, value)))
    if isinstance(value, tuple | list):
        return tuple(map(from_python, value))
    if isinstance(value, np.generic):
        return value if isinstance(value, np.unsignedinteger) else value.item()
    return value
