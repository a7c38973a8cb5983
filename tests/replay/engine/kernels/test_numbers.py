"""Arithmetic and functions in kernels are NumPy's, with NaN, infinity and the signs of zeros."""

import math
import struct
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.compiling.kernels.functions import FUNCTIONS
from fuselog.recorders.compiling.kernels.words import high_word

# Exactly rounded, or made of nothing else: the same in every bit.
EXACT = [
    *(np.add, np.subtract, np.multiply, np.true_divide, np.remainder, np.floor_divide, np.fmod),
    *(np.copysign, np.greater, np.less_equal, np.equal, np.not_equal),
]
OF_ONE = [
    *(np.sqrt, np.floor, np.ceil, np.trunc, np.rint, np.absolute, np.fabs, np.sign, np.negative),
    *(np.isnan, np.isfinite, np.isinf, np.signbit, np.square, np.reciprocal, np.positive),
]
# By another library: the last digits may differ.
ROUNDED = [
    *(np.exp, np.exp2, np.expm1, np.log, np.log2, np.log10, np.log1p, np.sin, np.cos, np.tan),
    *(np.arcsin, np.arccos, np.arctan, np.sinh, np.cosh, np.tanh, np.arcsinh, np.arccosh, np.arctanh),
    *(np.cbrt, np.deg2rad, np.rad2deg, np.sinc),
]
# NumPy leaves open which of two zeros is the lesser.
ROUNDED_OF_TWO = [np.hypot, np.arctan2, np.power, np.minimum, np.maximum]


def kernel_of(functions: tuple[Any, ...], of_one: bool) -> Callable[..., None]:
    def one(run: int, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
        for k, function in enumerate(functions):
            out[run, k] = function(x[run]) if of_one else function(x[run], y[run])

    return one


@cache
def loop_of(functions: tuple[Any, ...], of_one: bool) -> Callable[..., None]:
    return compile_over_runs(kernel_of(functions, of_one))


def compiled(functions: list[Any], *arguments: float) -> np.ndarray:
    out = np.empty((1, len(functions)))
    x, y = np.array([arguments[0]]), np.array([arguments[-1]])
    loop_of(tuple(functions), len(arguments) == 1)(1, x, y, out)
    return out[0]


def by_numpy(functions: list[Any], *arguments: float) -> np.ndarray:
    with np.errstate(all="ignore"):
        return np.array([float(each(*map(np.float64, arguments))) for each in functions])


def bits(numbers: np.ndarray) -> list[bytes]:
    """The numbers bit by bit; one NaN is as good as another."""
    return [b"nan" if math.isnan(each) else struct.pack("<d", each) for each in numbers]


ANY = st.floats() | st.sampled_from([0.0, -0.0, math.inf, -math.inf, math.nan, 1.0, -1.0, 2.0])


@given(ANY, ANY)
@example(0.0, -0.0)
@example(-0.0, 3.0)
@example(5.0, 0.0)
@example(-1.0, math.inf)
def test_arithmetic_is_the_same_in_every_bit(x: float, y: float):
    assert bits(compiled(EXACT, x, y)) == bits(by_numpy(EXACT, x, y)), (x, y)
    assert bits(compiled(OF_ONE, x)) == bits(by_numpy(OF_ONE, x)), x


@given(st.floats(-1e3, 1e3) | st.sampled_from([0.0, -0.0, 1.0, -1.0, math.inf, -math.inf, math.nan]))
def test_functions_are_numpys(x: float):
    assert_allclose(compiled(ROUNDED, x), by_numpy(ROUNDED, x), rtol=1e-13, atol=1e-300)


@given(st.floats(-1e3, 1e3) | ANY, st.floats(-50.0, 50.0) | ANY)
def test_functions_of_two_are_numpys(x: float, y: float):
    found, expected = compiled(ROUNDED_OF_TWO, x, y), by_numpy(ROUNDED_OF_TWO, x, y)
    assert_allclose(found, expected, rtol=1e-13, atol=1e-300)


@pytest.mark.parametrize("signed", [True, False])
@given(st.data())
def test_integers_divide_and_are_compared_as_pythons(signed: bool, data: st.DataObject):
    numbers = st.integers(-(2**31), 2**31) if signed else st.integers(0, 2**64 - 1)
    x, y = data.draw(numbers), data.draw(numbers.filter(bool))
    kind = np.int64 if signed else np.uint64
    out = np.zeros((1, 6), kind)
    loop_of_integers()(1, np.array([x], kind), np.array([y], kind), out)
    expected = [x // y, x % y, x < y, x >= y, x & y, x ^ y]
    assert out[0].tolist() == expected


@cache
def loop_of_integers() -> Callable[..., None]:
    return compile_over_runs(divided)


def divided(run: int, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    a, b = x[run], y[run]
    out[run, 0], out[run, 1] = a // b, a % b
    out[run, 2], out[run, 3] = a < b, a >= b
    out[run, 4], out[run, 5] = a & b, a ^ b


@given(*(st.integers(0, 2**64 - 1) | st.just(2**64 - 1),) * 2)
def test_high_words_are_those_of_integers(x: int, y: int):
    out = np.zeros(1, np.uint64)
    loop_of_words()(1, np.array([x], np.uint64), np.array([y], np.uint64), out)
    with np.errstate(over="ignore"):
        assert int(out[0]) == int(high_word(np.uint64(x), np.uint64(y))) == (x * y) >> 64


@cache
def loop_of_words() -> Callable[..., None]:
    def once(run: int, x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
        out[run] = high_word(x[run], y[run])

    return compile_over_runs(once)


def test_every_function_of_numbers_is_compared_somewhere():
    """Those that are left are operators under other names, conversions, choices and `frexp`.

    What `math` has of them is the same functions.
    """
    compared = {*EXACT, *OF_ONE, *ROUNDED, *ROUNDED_OF_TWO, high_word}
    same = {
        each for name, each in vars(math).items() if name[0] != "_" and name not in ("frexp", "sqrt")
    }
    names = {getattr(each, "__name__", "") for each in FUNCTIONS if each not in compared | same}
    assert names == {
        *("less", "greater_equal", "sqrt"),
        *("logical_and", "logical_or", "logical_not", "where", "round", "around", "abs", "min", "max"),
        *("radians", "degrees", "float", "float64", "int", "int64", "uint64", "bool", "frexp"),
    }
