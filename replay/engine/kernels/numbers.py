"""Numbers in LLVM's text: constants, arithmetic, comparisons, and the functions of NumPy and libm.

Nothing is contracted or reassociated, so that a result does not depend on how code was optimised.
Divisions by zero give infinity or NaN.
"""

import math
import operator
import struct
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any, NamedTuple, TypeGuard

import numpy as np

REAL, WHOLE, WORD, TRUTH = "double", "i64", "u64", "i1"  # kinds; a word is an unsigned integer
_WIDTH = {TRUTH: 0, WHOLE: 1, WORD: 2, REAL: 3}


class Number(NamedTuple):
    """A number while a kernel is lowered: its kind, and the name or constant that LLVM knows it by.

    `natural` numbers are known not to be negative.
    """

    kind: str
    code: str
    natural: bool = False

    @property
    def type(self) -> str:
        """LLVM's type."""
        return WHOLE if self.kind == WORD else self.kind


Static = bool | int | float  # what is known while lowering
Scalar = Number | Static


def constant(value: Any) -> Number:
    """A number that is known, as LLVM writes it; real ones bit by bit."""
    if isinstance(value, bool | np.bool_):
        return Number(TRUTH, "true" if value else "false")
    if isinstance(value, np.unsignedinteger):
        return Number(WORD, str(int(value)))
    if isinstance(value, int | np.integer):
        return Number(WHOLE, str(int(value)), natural=int(value) >= 0)
    return Number(REAL, f"0x{struct.pack('>d', float(value)).hex().upper()}")


def is_static(value: Any) -> TypeGuard[Static]:
    """Whether it is a number that is known while lowering."""
    return isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating)


class Emitter:
    """Writes the instructions of one function.

    `fault`, where indices are checked, gives the number (1, ...) that stands for the line at work.
    """

    def __init__(self, fault: Callable[[], int] | None = None) -> None:
        self.lines: list[str] = []
        self.allocated: list[str] = []  # memory of the function, which is taken once
        self.declared: set[str] = set()
        self.fault = fault
        self.can_fail = False
        self._names = count()

    def fresh(self) -> str:
        """A name that is not taken."""
        return f"%v{next(self._names)}"

    def add(self, line: str) -> None:
        """Write an instruction."""
        self.lines.append(f"  {line}")

    def memory(self, kind: str, size: int = 1) -> str:
        """The address of memory for some numbers."""
        name = self.fresh()
        self.allocated.append(f"  {name} = alloca {kind}, i64 {size}")
        return name

    def number(self, kind: str, text: str) -> Number:
        """The result of an instruction."""
        name = self.fresh()
        self.add(f"{name} = {text}")
        return Number(kind, name)

    def call(self, name: str, *arguments: Number) -> Number:
        """What a function of real numbers returns, such as `llvm.sqrt.f64` or `atan2`."""
        parameters = ", ".join([REAL] * len(arguments))
        self.declared.add(f"declare double @{name}({parameters}) #0")
        given = ", ".join(f"double {each.code}" for each in arguments)
        return self.number(REAL, f"call double @{name}({given})")

    def stop_if(self, condition: Number, fault: Number) -> None:
        """Leave the function, and all that called it, with a fault; see `Program.define`."""
        if not self.can_fail:
            self.can_fail = True
            self.allocated += ["  %fault = alloca i64", "  store i64 0, ptr %fault"]
        failed, on = self.fresh()[1:], self.fresh()[1:]
        self.add(f"br i1 {condition.code}, label %{failed}, label %{on}")
        self.lines.append(f"{failed}:")
        self.add(f"store i64 {fault.code}, ptr %fault")
        self.add("br label %stop")
        self.lines.append(f"{on}:")

    # --- conversions ---

    def as_kind(self, value: Scalar, kind: str) -> Number:
        """A number as one of another kind, as Python and NumPy convert it."""
        if not isinstance(value, Number):
            if kind == REAL:
                return constant(float(value))
            return constant(
                np.uint64(value) if kind == WORD else int(value) if kind != TRUTH else bool(value)
            )
        if value.kind == kind:
            return value
        if kind == TRUTH:
            return self.truth(value)
        if value.kind == REAL:
            return self.number(kind, f"fpto{'u' if kind == WORD else 's'}i double {value.code} to i64")
        if kind == REAL:
            signed = "s" if value.kind == WHOLE else "u"
            return self.number(REAL, f"{signed}itofp {value.type} {value.code} to double")
        if value.kind == TRUTH:
            return self.number(kind, f"zext i1 {value.code} to i64")._replace(natural=kind == WHOLE)
        return Number(kind, value.code)

    def truth(self, value: Scalar) -> Number:
        """Whether a number is other than zero."""
        if not isinstance(value, Number):
            return constant(bool(value))
        if value.kind == TRUTH:
            return value
        if value.kind == REAL:
            return self.number(TRUTH, f"fcmp une double {value.code}, 0x0000000000000000")
        return self.number(TRUTH, f"icmp ne i64 {value.code}, 0")

    def select(self, condition: Number, yes: Number, no: Number) -> Number:
        """One of two numbers of one kind."""
        if yes.code == no.code:
            return yes
        text = f"select i1 {condition.code}, {yes.type} {yes.code}, {no.type} {no.code}"
        return self.number(yes.kind, text)


def kind_of(value: Scalar) -> str:
    """The kind of a number."""
    return value.kind if isinstance(value, Number) else constant(value).kind


def common_kind(*values: Scalar) -> str:
    """The kind of a result of these numbers; a signed and an unsigned integer together make none."""
    kinds = {kind_of(each) for each in values}
    if {WORD, WHOLE} <= kinds:
        raise TypeError("signed and unsigned integers together; convert one of them")
    return max(kinds, key=_WIDTH.__getitem__)


# --- arithmetic -------------------------------------------------------------------------------------

_REAL = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_WHOLE = {operator.add: "add nsw", operator.sub: "sub nsw", operator.mul: "mul nsw"}
_BITS = {operator.and_: "and", operator.or_: "or", operator.xor: "xor"}
_SHIFTS = {operator.lshift: "shl", operator.rshift: "lshr"}
_ORDERED = {
    operator.lt: "lt",
    operator.le: "le",
    operator.gt: "gt",
    operator.ge: "ge",
    operator.eq: "eq",
    operator.ne: "ne",
}


def binary(emitter: Emitter, operation: Any, left: Scalar, right: Scalar) -> Number:
    """The result of an operator of Python's."""
    if operation is operator.pow:
        return power(emitter, left, right)
    kind = common_kind(left, right)
    if operation is operator.truediv:
        kind = REAL
    elif operation in _BITS:
        both = [emitter.as_kind(each, kind) for each in (left, right)]
        return emitter.number(kind, f"{_BITS[operation]} {both[0].type} {both[0].code}, {both[1].code}")
    elif kind == TRUTH:
        kind = WHOLE
    x, y = (emitter.as_kind(each, kind) for each in (left, right))
    if operation in (operator.mod, operator.floordiv):
        return _divided(emitter, operation, x, y)
    if operation in _SHIFTS:
        shift = "ashr" if kind == WHOLE and operation is operator.rshift else _SHIFTS[operation]
        return emitter.number(kind, f"{shift} i64 {x.code}, {y.code}")
    if kind == REAL:
        return emitter.number(kind, f"{_REAL[operation]} double {x.code}, {y.code}")
    name = _WHOLE[operation] if kind == WHOLE else _WHOLE[operation].partition(" ")[0]
    natural = x.natural and y.natural and operation is not operator.sub
    return emitter.number(kind, f"{name} i64 {x.code}, {y.code}")._replace(natural=natural)


def _divided(emitter: Emitter, operation: Any, x: Number, y: Number) -> Number:
    """`x % y` or `x // y`, whose remainder has the sign of y."""
    if x.kind == WORD:
        name = "urem" if operation is operator.mod else "udiv"
        return emitter.number(WORD, f"{name} i64 {x.code}, {y.code}")
    if x.kind == WHOLE:
        rest = emitter.number(WHOLE, f"srem i64 {x.code}, {y.code}")
        signs = emitter.number(WHOLE, f"xor i64 {rest.code}, {y.code}")
        apart = emitter.number(TRUTH, f"icmp slt i64 {signs.code}, 0")
        is_off = emitter.number(TRUTH, f"icmp ne i64 {rest.code}, 0")
        both = emitter.number(TRUTH, f"and i1 {apart.code}, {is_off.code}")
        if operation is operator.mod:
            moved = emitter.number(WHOLE, f"add nsw i64 {rest.code}, {y.code}")
            return emitter.select(both, moved, rest)
        quotient = emitter.number(WHOLE, f"sdiv i64 {x.code}, {y.code}")
        less = emitter.number(WHOLE, f"sub nsw i64 {quotient.code}, 1")
        return emitter.select(both, less, quotient)
    zero = constant(0.0)
    rest = emitter.number(REAL, f"frem double {x.code}, {y.code}")
    divisor_below, rest_below = (compare(emitter, operator.lt, each, zero) for each in (y, rest))
    apart = emitter.number(TRUTH, f"xor i1 {divisor_below.code}, {rest_below.code}")
    is_off = emitter.number(TRUTH, f"fcmp une double {rest.code}, {zero.code}")
    moved = emitter.number(REAL, f"fadd double {rest.code}, {y.code}")
    nothing = emitter.select(divisor_below, constant(-0.0), zero)
    if operation is operator.mod:
        return emitter.select(is_off, emitter.select(apart, moved, rest), nothing)
    # the quotient of what is a multiple but for round-off, snapped to the nearest integer
    whole = emitter.number(REAL, f"fsub double {x.code}, {rest.code}")
    quotient = emitter.number(REAL, f"fdiv double {whole.code}, {y.code}")
    less = emitter.number(REAL, f"fsub double {quotient.code}, {constant(1.0).code}")
    both = emitter.number(TRUTH, f"and i1 {apart.code}, {is_off.code}")
    quotient = emitter.select(both, less, quotient)
    floor = emitter.call("llvm.floor.f64", quotient)
    over = emitter.number(REAL, f"fsub double {quotient.code}, {floor.code}")
    up = emitter.number(REAL, f"fadd double {floor.code}, {constant(1.0).code}")
    snapped = emitter.select(compare(emitter, operator.gt, over, constant(0.5)), up, floor)
    exact = emitter.number(REAL, f"fdiv double {x.code}, {y.code}")
    signed_zero = emitter.call("llvm.copysign.f64", zero, exact)
    found = emitter.select(compare(emitter, operator.eq, quotient, zero), signed_zero, snapped)
    return emitter.select(compare(emitter, operator.eq, y, zero), exact, found)


def power(emitter: Emitter, base: Scalar, exponent: Scalar) -> Number:
    """A power; of an integer that is known by multiplication."""
    if isinstance(exponent, int):
        kind = REAL if exponent < 0 or kind_of(base) == REAL else WHOLE
        square, rest = emitter.as_kind(base, kind), abs(int(exponent))
        found: Number | None = None
        while rest:
            if rest & 1:
                found = square if found is None else binary(emitter, operator.mul, found, square)
            rest >>= 1
            if rest:
                square = binary(emitter, operator.mul, square, square)
        found = emitter.as_kind(1, kind) if found is None else found
        return binary(emitter, operator.truediv, 1.0, found) if exponent < 0 else found
    return emitter.call("llvm.pow.f64", emitter.as_kind(base, REAL), emitter.as_kind(exponent, REAL))


def compare(emitter: Emitter, operation: Any, left: Scalar, right: Scalar) -> Number:
    """The result of a comparison; false with NaN, but for `!=`."""
    kind = common_kind(left, right)
    kind = WHOLE if kind == TRUTH else kind
    x, y = (emitter.as_kind(each, kind) for each in (left, right))
    name = _ORDERED[operation]
    if kind == REAL:
        how = "une" if name == "ne" else f"o{name}"
        return emitter.number(TRUTH, f"fcmp {how} double {x.code}, {y.code}")
    how = name if name in ("eq", "ne") else f"{'u' if kind == WORD else 's'}{name}"
    return emitter.number(TRUTH, f"icmp {how} i64 {x.code}, {y.code}")


def negative(emitter: Emitter, x: Scalar) -> Number:
    """`-x`."""
    if kind_of(x) == REAL:
        return emitter.number(REAL, f"fneg double {emitter.as_kind(x, REAL).code}")
    return emitter.number(WHOLE, f"sub nsw i64 0, {emitter.as_kind(x, WHOLE).code}")


def inverse(emitter: Emitter, x: Scalar) -> Number:
    """`not x`."""
    return emitter.number(TRUTH, f"xor i1 {emitter.truth(x).code}, true")


# --- functions --------------------------------------------------------------------------------------


def absolute(emitter: Emitter, x: Scalar) -> Number:
    """`abs(x)`."""
    if kind_of(x) == REAL:
        return emitter.call("llvm.fabs.f64", emitter.as_kind(x, REAL))
    whole = emitter.as_kind(x, WHOLE)
    below = compare(emitter, operator.lt, whole, 0)
    return emitter.select(below, negative(emitter, whole), whole)._replace(natural=True)


def _least(operation: Any, emitter: Emitter, *values: Scalar) -> Number:
    """Python's `min` and `max`: the first of equal ones."""
    kind = common_kind(*values)
    found, *others = (emitter.as_kind(each, kind) for each in values)
    for each in others:
        found = emitter.select(compare(emitter, operation, each, found), each, found)
    return found


def _bounded(operation: Any, emitter: Emitter, x: Scalar, y: Scalar) -> Number:
    """`np.minimum` and `np.maximum`, which are NaN where an argument is."""
    kind = common_kind(x, y)
    x, y = emitter.as_kind(x, kind), emitter.as_kind(y, kind)
    first = compare(emitter, operation, x, y)
    if kind == REAL:
        first = emitter.number(TRUTH, f"or i1 {first.code}, {is_nan(emitter, x).code}")
    return emitter.select(first, x, y)


def is_nan(emitter: Emitter, x: Scalar) -> Number:
    """`np.isnan(x)`."""
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


def _operator(operation: Any) -> Callable[..., Number]:
    return lambda emitter, x, y: binary(emitter, operation, x, y)


def _comparison(operation: Any) -> Callable[..., Number]:
    return lambda emitter, x, y: compare(emitter, operation, x, y)


def _round(emitter: Emitter, x: Scalar) -> Number:
    return emitter.call("llvm.rint.f64", emitter.as_kind(x, REAL))


def _frexp(emitter: Emitter, x: Scalar) -> tuple[Number, Number]:
    """`math.frexp(x)`."""
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
# What NumPy's and Python's functions are of numbers: (emitter, *arguments) -> number.
FUNCTIONS: dict[Any, Callable[..., Any]] = {
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
}
# Python's own functions of the same names.
FUNCTIONS |= {
    getattr(math, name): FUNCTIONS[getattr(np, name)]
    for name in (
        *("sqrt", "exp", "exp2", "sin", "cos", "log", "log2", "log10", *_LIBM),
        *("asin", "acos", "atan", "atan2", "asinh", "acosh", "atanh", "hypot", "copysign", "fabs"),
        *("isnan", "isfinite", "isinf"),
    )
}
