"""Functions without arrays of their own, compiled for Python; and what families' kernels are made of."""

import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fuselog.recorders.compiling.compile import compile_over_runs, compiled
from fuselog.recorders.errors import BadInput
from fuselog.replay.families.tracking.association.association import marginals


def total(values: np.ndarray, factor: float) -> float:
    """A number."""
    found = 0.0
    for value in range(len(values)):
        found += factor * values[value]
    return found


def count(values: np.ndarray) -> int:
    """Another kind of number."""
    return len(values) + 2**60


def is_rising(values: np.ndarray) -> bool:
    """And another one."""
    return values[0] < values[1]


def double(values: np.ndarray) -> None:
    """None."""
    for each in range(len(values)):
        values[each] *= 2.0


def test_a_call_returns_the_number_that_the_annotation_says():
    values = np.array([1.0, 2.0, 4.0])
    assert repr(compiled(total)(values, 0.5)) == "3.5"
    assert repr(compiled(count)(values)) == str(3 + 2**60)
    assert compiled(is_rising)(values) is True
    assert compiled(double)(values) is None
    assert_array_equal(values, [2.0, 4.0, 8.0])


def add_columns(matrix: np.ndarray, sums: np.ndarray) -> None:
    """Sum each column."""
    for row in range(len(matrix)):
        for column in range(matrix.shape[1]):
            sums[column] += matrix[row, column]


def test_code_for_sizes_is_compiled_for_the_sizes_of_every_call():
    add, whole = compiled(add_columns, for_sizes=True), np.arange(24.0).reshape(6, 4)
    for matrix in (whole, whole[:2], whole[:, :3].copy(), whole[:, ::2]):
        sums = np.zeros(matrix.shape[1])
        add(matrix, sums)
        assert_array_equal(sums, matrix.sum(axis=0))


def without_its_kind(values: np.ndarray):
    return values[0]


def test_a_call_that_does_not_say_what_it_returns_is_told_so():
    with pytest.raises(BadInput, match=r"without_its_kind .* '-> float'"):
        compiled(without_its_kind)(np.ones(3))


def part_of(matrix: np.ndarray) -> np.ndarray:
    return matrix[1]


def language(run: int, values: np.ndarray, out: np.ndarray) -> None:
    """Copies, `in`, Python's own functions, and a part of an array that this function has made."""
    before = values[run].copy()
    for k in range(3):
        values[run, k] = before[2 - k]
    for k in range(3):
        out[run, k] = 1.0 if k in (run, 2) else 0.0
        out[run, 3 + k] = math.atan2(math.expm1(before[k]), math.hypot(before[k], 1.0))
        out[run, 6 + k] = -1.0 if before[k] not in (values[run, 0], 1.0) else 0.0
    matrix = np.zeros((2, 3))
    part = part_of(matrix)
    part[2] = before[1]
    out[run, 9] = matrix[1, 2]


def escaping(run: int, out: np.ndarray) -> None:
    out[run] = made(run)[0]


def made(first: int) -> np.ndarray:
    matrix = np.zeros((2, 2))
    matrix[1, 0] = first
    return part_of(matrix)


def test_the_language_of_kernels_is_pythons():
    values = np.array([[0.5, 1.0, 2.0], [3.0, 4.0, 3.0]])
    both, found, expected = (values.copy(), values.copy()), np.empty((2, 10)), np.empty((2, 10))
    compile_over_runs(language)(2, both[0], found)
    for run in range(2):
        language(run, both[1], expected)
    assert_array_equal(found, expected)
    assert_array_equal(*both)


def test_no_array_that_a_function_made_leaves_it_through_another():
    with pytest.raises(BadInput, match="it returns an array that it created"):
        compile_over_runs(escaping)(1, np.empty(1))


def test_arrays_without_numbers_are_as_others():
    """NumPy gives them strides of 0."""
    assert_array_equal(marginals(np.empty((2, 0)), np.ones(2)), [[1.0], [1.0]])
