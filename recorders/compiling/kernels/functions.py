"""`FUNCTIONS`: how kernels lower `high_word` and the numeric functions of NumPy, Python and libm."""

import math
import operator
from collections.abc import Callable
from functools import partial

import numpy as np

from fuselog.recorders.compiling.kernels.numbers import (
    REAL,
    TRUTH,
    WHOLE,
    WORD,
    Emitter,
    Number,
    Scalar,
    binary,
    common_kind,
    compare,
    constant,
    inverse,
    kind_of,
    negative,
)
from fuselog.recorders.compiling.kernels.words import emit_high_word, high_word
from fuselog.recorders.compiling.kinds import KernelFunction, Value


def absolute(emitter: Emitter, x: Scalar) -> Number:
    """Lower `abs(x)`."""
    if kind_of(x) == REAL:
        return emitter.call("llvm.fabs.f64", emitter.as_kind(x, REAL))
    whole = emitter.as_kind(x, WHOLE)
    below = compare(emitter, operator.lt, whole, 0)
    return emitter.select(below, negative(emitter, whole), whole)._replace(natural=True)


def _least(operation: Value, emitter: Emitter, *values: Scalar) -> Number:
    """Lower Python's `min` and `max`, which return the first of equal arguments."""
    kind = common_kind(*values)
    found, *others = (emitter.as_kind(each, kind) for each in values)
    for each in others:
        found = emitter.select(compare(emitter, operation, each, found), each, found)
    return found


def _bounded(operation: Value, emitter: Emitter, x: Scalar, y: Scalar) -> Number:
    """Lower `np.minimum` and `np.maximum`, which return NaN if an argument is NaN."""
    kind = common_kind(x, y)
    x, y = emitter.as_kind(x, kind), emitter.as_kind(y, kind)
    first = compare(emitter, operation, x, y)
    if kind == REAL:
        first = emitter.number(TRUTH, f"or i1 {first.code}, {is_nan(emitter, x).code}")
    return emitter.select(first, x, y)


def is_nan(emitter: Emitter, x: Scalar) -> Number:
    """Lower `np.isnan(x)`."""
    code = emitter.as_kind(x, REAL).code
    return emitter.number(TRUTH, f"fcmp uno double {code}, {code}")


def _is_finite(emitter: Emitter, x: Scalar) -> Number:
    size = emitter.call("llvm.fabs.f64", emitter.as_kind(x, REAL))
    return compare(emitter, operator.lt, size, math.inf)


def _is_infinite(emitter: Emitter, x: Scalar) -> Number:
    size = emitter.call("llvm.fabs.f64", emitter.as_kind(x, REAL))
    return compare(emitter, operator.eq, size, math.inf)


def _sign(emitter: Emitter, x: Scalar) -> Number:
    real, zero = emitter.as_kind(x, REAL), constant(0.0)
    above, below = (compare(emitter, each, real, zero) for each in (operator.gt, operator.lt))
    no_sign = emitter.select(is_nan(emitter, real), real, zero)
    return emitter.select(above, constant(1.0), emitter.select(below, constant(-1.0), no_sign))


def _sinc(emitter: Emitter, x: Scalar) -> Number:
    angle = binary(emitter, operator.mul, emitter.as_kind(x, REAL), math.pi)
    quotient = binary(emitter, operator.truediv, emitter.call("llvm.sin.f64", angle), angle)
    return emitter.select(compare(emitter, operator.eq, x, 0.0), constant(1.0), quotient)


def _hypot(emitter: Emitter, x: Scalar, y: Scalar) -> Number:
    return emitter.call("hypot", emitter.as_kind(x, REAL), emitter.as_kind(y, REAL))


def _where(emitter: Emitter, condition: Scalar, yes: Scalar, no: Scalar) -> Number:
    kind = common_kind(yes, no)
    return emitter.select(
        emitter.truth(condition), emitter.as_kind(yes, kind), emitter.as_kind(no, kind)
    )


def _of_reals(name: str, emitter: Emitter, *arguments: Scalar) -> Number:
    return emitter.call(name, *(emitter.as_kind(each, REAL) for each in arguments))


def _scaled(factor: float, emitter: Emitter, x: Scalar) -> Number:
    return binary(emitter, operator.mul, emitter.as_kind(x, REAL), factor)


EmitOfTwo = Callable[[Emitter, Scalar, Scalar], Number]


def _operator(operation: Value) -> EmitOfTwo:
    return lambda emitter, x, y: binary(emitter, operation, x, y)


def _comparison(operation: Value) -> EmitOfTwo:
    return lambda emitter, x, y: compare(emitter, operation, x, y)


def _round(emitter: Emitter, x: Scalar) -> Number:
    return emitter.call("llvm.rint.f64", emitter.as_kind(x, REAL))


def _frexp(emitter: Emitter, x: Scalar) -> tuple[Number, Number]:
    """Lower `math.frexp(x)`."""
    emitter.declared.add("declare { double, i32 } @llvm.frexp.f64.i32(double)")
    both = emitter.fresh()
    emitter.add(
        f"{both} = call {{ double, i32 }} @llvm.frexp.f64.i32(double {emitter.as_kind(x, REAL).code})"
    )
    share = emitter.number(REAL, f"extractvalue {{ double, i32 }} {both}, 0")
    exponent = emitter.number(WHOLE, f"extractvalue {{ double, i32 }} {both}, 1")
    return share, emitter.number(WHOLE, f"sext i32 {exponent.code} to i64")


_INTRINSICS = (
    "sqrt",
    "floor",
    "ceil",
    "trunc",
    "rint",
    "exp",
    "exp2",
    "sin",
    "cos",
    "log",
    "log2",
    "log10",
)
_LIBM = ("tan", "sinh", "cosh", "tanh", "expm1", "log1p", "cbrt")
_LIBM_RENAMED = {
    np.arcsin: "asin",
    np.arccos: "acos",
    np.arctan: "atan",
    np.arctan2: "atan2",
    np.arcsinh: "asinh",
    np.arccosh: "acosh",
    np.arctanh: "atanh",
    np.copysign: "llvm.copysign.f64",
    np.fabs: "llvm.fabs.f64",
}
# Lowerings of NumPy's and Python's functions of numbers, as functions (emitter, *arguments) -> number.
FUNCTIONS: dict[Value, KernelFunction] = {
    **{getattr(np, name): partial(_of_reals, f"llvm.{name}.f64") for name in _INTRINSICS},
    **{getattr(np, name): partial(_of_reals, name) for name in _LIBM},
    **{function: partial(_of_reals, name) for function, name in _LIBM_RENAMED.items()},
    math.frexp: _frexp,
    np.add: _operator(operator.add),
    np.subtract: _operator(operator.sub),
    np.multiply: _operator(operator.mul),
    np.true_divide: _operator(operator.truediv),
    np.floor_divide: _operator(operator.floordiv),
    np.remainder: _operator(operator.mod),
    np.power: lambda emitter, x, y: emitter.call(
        "llvm.pow.f64", emitter.as_kind(x, REAL), emitter.as_kind(y, REAL)
    ),
    np.fmod: lambda emitter, x, y: emitter.number(
        REAL, f"frem double {emitter.as_kind(x, REAL).code}, {emitter.as_kind(y, REAL).code}"
    ),
    np.negative: negative,
    np.positive: lambda emitter, x: emitter.as_kind(x, kind_of(x)),
    np.square: lambda emitter, x: binary(emitter, operator.mul, x, x),
    np.reciprocal: lambda emitter, x: binary(emitter, operator.truediv, 1.0, x),
    np.absolute: absolute,
    abs: absolute,
    min: partial(_least, operator.lt),
    max: partial(_least, operator.gt),
    np.minimum: partial(_bounded, operator.le),
    np.maximum: partial(_bounded, operator.ge),
    np.sign: _sign,
    np.sinc: _sinc,
    np.hypot: _hypot,
    np.where: _where,
    np.round: _round,
    np.around: _round,
    round: _round,
    np.deg2rad: partial(_scaled, math.pi / 180.0),
    np.radians: partial(_scaled, math.pi / 180.0),
    np.rad2deg: partial(_scaled, 180.0 / math.pi),
    np.degrees: partial(_scaled, 180.0 / math.pi),
    np.isnan: is_nan,
    np.isfinite: _is_finite,
    np.isinf: _is_infinite,
    np.signbit: lambda emitter, x: compare(
        emitter,
        operator.lt,
        emitter.call("llvm.copysign.f64", constant(1.0), emitter.as_kind(x, REAL)),
        0.0,
    ),
    np.logical_not: inverse,
    np.logical_and: lambda emitter, x, y: binary(
        emitter, operator.and_, emitter.truth(x), emitter.truth(y)
    ),
    np.logical_or: lambda emitter, x, y: binary(
        emitter, operator.or_, emitter.truth(x), emitter.truth(y)
    ),
    **{
        getattr(np, name): _comparison(operation)
        for name, operation in (
            ("less", operator.lt),
            ("less_equal", operator.le),
            ("greater", operator.gt),
            ("greater_equal", operator.ge),
            ("equal", operator.eq),
            ("not_equal", operator.ne),
        )
    },
    float: lambda emitter, x: emitter.as_kind(x, REAL),
    np.float64: lambda emitter, x: emitter.as_kind(x, REAL),
    int: lambda emitter, x: emitter.as_kind(x, WHOLE),
    np.int64: lambda emitter, x: emitter.as_kind(x, WHOLE),
    np.uint64: lambda emitter, x: emitter.as_kind(x, WORD),
    bool: lambda emitter, x: emitter.truth(x),
    high_word: emit_high_word,
}
# Python's functions with the same names.
FUNCTIONS |= {
    getattr(math, name): FUNCTIONS[getattr(np, name)]
    for name in (
        *("sqrt", "exp", "exp2", "sin", "cos", "log", "log2", "log10", *_LIBM),
        *("asin", "acos", "atan", "atan2", "asinh", "acosh", "atanh", "hypot", "copysign", "fabs"),
        *("isnan", "isfinite", "isinf"),
    )
}
