"""Names the types of arrays and functions, and marks NamedTuples of arrays whose sizes vary."""

from collections.abc import Callable
from functools import reduce
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Numbers = tuple[float, ...]
# The numbers that a model's functions read, by name: a NamedTuple that is made for each model, see
# `fuselog.replay.inference.model.parameters.settings_type`.
Settings = Any  # type: ignore[explicit-any]
# An argument of a function whose number of arguments is not known here: numbers, arrays, tuples of them.
AnyArgument = Any  # type: ignore[explicit-any]
# Columns of several types, which a NamedTuple of arrays is made of.
Columns = Any  # type: ignore[explicit-any]
# An array of whatever kind a column is.
AnyArray = NDArray[Any]  # type: ignore[explicit-any]
RowSlice: TypeAlias = "slice[int, int, int]"  # of rows; unless told, its parameters are Any
Kind = TypeVar("Kind", bound=type)


def over_columns(ufunc: np.ufunc, matrix: AnyArray) -> AnyArray:
    """Reduce each row of a matrix (n, m), m > 0: column by column, 30 times as fast as by its last axis.

    Args:
        ufunc: such as np.logical_and, for `all`.
        matrix: (n, m), of few columns.
    """
    return reduce(ufunc, matrix.T) if matrix.shape[1] else ufunc.reduce(matrix, axis=1)


def varying(axes: int, **of_fields: int) -> Callable[[Kind], Kind]:
    """Mark a NamedTuple of arrays by how many of their first axes vary from log to log.

    The sizes of all other axes are part of a kernel that gets them; see
    `fuselog.recorders.compiling.kernels.native`. Of what is not marked these are the first axis, the
    runs or messages, and none of a core's scratch.
    """

    def marked(kind: Kind) -> Kind:
        fields = kind._fields  # type: ignore[attr-defined]
        kind.varies = tuple(of_fields.get(name, axes) for name in fields)  # type: ignore[attr-defined]
        return kind

    return marked
