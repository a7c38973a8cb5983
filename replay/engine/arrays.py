"""Type aliases of arrays and functions, and a decorator for NamedTuples of arrays of varying size."""

from collections.abc import Callable
from functools import reduce
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Numbers = tuple[float, ...]
# The numbers that a model's functions read, by name: a NamedTuple type made for each model, see
# `fuselog.replay.inference.model.parameters.settings_type`.
Settings = Any  # type: ignore[explicit-any]
# An argument of a function with any number of arguments: numbers, arrays, or tuples of them.
AnyArgument = Any  # type: ignore[explicit-any]
# Columns of several types, as in a NamedTuple of arrays.
Columns = Any  # type: ignore[explicit-any]
# An array of any type that a column can have.
AnyArray = NDArray[Any]  # type: ignore[explicit-any]
RowSlice: TypeAlias = "slice[int, int, int]"  # of rows; without type parameters they would be Any
Kind = TypeVar("Kind", bound=type)


def over_columns(ufunc: np.ufunc, matrix: AnyArray) -> AnyArray:
    """Reduce each row of a matrix by combining whole columns, 30 times as fast as a loop over rows.

    Args:
        ufunc: the reduction, such as np.logical_and for `all`.
        matrix: (n, m), with few columns and m > 0.
    """
    return reduce(ufunc, matrix.T) if matrix.shape[1] else ufunc.reduce(matrix, axis=1)


def varying(axes: int, **of_fields: int) -> Callable[[Kind], Kind]:
    """Mark a NamedTuple of arrays with the number of leading axes whose sizes vary from log to log.

    The sizes of all other axes are compiled into a kernel that gets the arrays; see
    `fuselog.recorders.compiling.kernels.native`. If a NamedTuple is not marked, only its first axis
    (runs or messages) varies; in the scratch memory of a core, no axis varies.
    """

    def marked(kind: Kind) -> Kind:
        fields = kind._fields  # type: ignore[attr-defined]
        kind.varies = tuple(of_fields.get(name, axes) for name in fields)  # type: ignore[attr-defined]
        return kind

    return marked
