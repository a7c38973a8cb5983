"""Arithmetic and comparisons of numbers in LLVM IR.

Operations are not contracted or reassociated, so that results do not depend on the optimisation.
Divisions by zero give infinity or NaN.
"""

import operator
import struct
from collections.abc import Callable
from itertools import count
from typing import NamedTuple, TypeGuard

import numpy as np

from fuselog.recorders.compiling.kinds import Value

REAL, WHOLE, WORD, TRUTH = "double", "i64", "u64", "i1"  # kinds; WORD is an unsigned integer
_WIDTH = {TRUTH: 0, WHOLE: 1, WORD: 2, REAL: 3}


class Number(NamedTuple):
    """A number while a kernel is lowered: its kind, and its name or constant in LLVM IR.

    `natural` numbers are known to be non-negative.
    """

    kind: str
    code: str
    natural: bool = False

    @property
    def type(self) -> str:
        """Return LLVM's name of the type."""
        return WHOLE if self.kind == WORD else self.kind


Static = bool | int | float  # known while lowering
Scalar = Number | Static


def constant(value: Value) -> Number:
    """Convert a known number to LLVM IR; real numbers are written as their exact bits."""
    if isinstance(value, bool | np.bool_):
        return Number(TRUTH, "true" if value else "false")
    if isinstance(value, np.unsignedinteger):
        return Number(WORD, str(int(value)))
    if isinstance(value, int | np.integer):
        return Number(WHOLE, str(int(value)), natural=int(value) >= 0)
    return Number(REAL, f"0x{struct.pack('>d', float(value)).hex().upper()}")


def is_static(value: Value) -> TypeGuard[Static]:
    """Test whether a value is a number that is known while lowering."""
    return isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating)


class Emitter:
    """A writer of the instructions of one function.

    If indices are checked, `fault` returns the number (1, ...) of the current line.
    """

    def __init__(self, fault: Callable[[], int] | None = None) -> None:
        self.lines: list[str] = []
        self.allocated: list[str] = []  # memory of the function, allocated once
        self.declared: set[str] = set()
        self.fault = fault
        self.can_fail = False
        self._names = count()

    def fresh(self) -> str:
        """Return an unused name."""
        return f"%v{next(self._names)}"

    def add(self, line: str) -> None:
        """Write an instruction."""
        self.lines.append(f"  {line}")

    def memory(self, kind: str, size: int = 1) -> str:
        """Allocate memory for `size` numbers; return its address."""
        name = self.fresh()
        self.allocated.append(f"  {name} = alloca {kind}, i64 {size}")
        return name

    def number(self, kind: str, text: str) -> Number:
        """Write an instruction; return its result."""
        name = self.fresh()
        self.add(f"{name} = {text}")
        return Number(kind, name)

    def call(self, name: str, *arguments: Number) -> Number:
        """Call a function of real numbers, such as `llvm.sqrt.f64` or `atan2`."""
        parameters = ", ".join([REAL] * len(arguments))
        self.declared.add(f"declare double @{name}({parameters}) #0")
        given = ", ".join(f"double {each.code}" for each in arguments)
        return self.number(REAL, f"call double @{name}({given})")

    def stop_if(self, condition: Number, fault: Number) -> None:
        """If a condition is true, leave the function and all of its callers with a fault.

        See `Program.define`.
        """
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
        """Convert a number to another kind, as Python and NumPy do."""
        if not isinstance(value, Number):
            if kind == REAL:
                return constant(float(value))
            if is_row(kind):
                return self.as_kind(constant(float(value)), kind)
            return constant(
                np.uint64(value) if kind == WORD else int(value) if kind != TRUTH else bool(value)
            )
        if value.kind == kind:
            return value
        if is_row(value.kind):
            raise TypeError("a number is needed, not a row of an array")
        if is_row(kind):
            first = self.number(
                kind, f"insertelement {kind} poison, double {self.as_kind(value, REAL).code}, i64 0"
            )
            places = f"<{kind[1:].partition(' ')[0]} x i32> zeroinitializer"
            return self.number(kind, f"shufflevector {kind} {first.code}, {kind} poison, {places}")
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
        """Lower the test whether a number is not zero."""
        if not isinstance(value, Number):
            return constant(bool(value))
        if value.kind == TRUTH:
            return value
        if is_row(value.kind):
            raise TypeError("an array is neither true nor false")
        if value.kind == REAL:
            return self.number(TRUTH, f"fcmp une double {value.code}, 0x0000000000000000")
        return self.number(TRUTH, f"icmp ne i64 {value.code}, 0")

    def select(self, condition: Number, yes: Number, no: Number) -> Number:
        """Select one of two numbers of the same kind."""
        if yes.code == no.code:
            return yes
        text = f"select i1 {condition.code}, {yes.type} {yes.code}, {no.type} {no.code}"
        return self.number(yes.kind, text)


def is_row(kind: str) -> bool:
    """Test whether a kind is that of a row of real numbers, with arithmetic element by element."""
    return kind.startswith("<")


def kind_of(value: Scalar) -> str:
    """Return the kind of a number."""
    return value.kind if isinstance(value, Number) else constant(value).kind


def common_kind(*values: Scalar) -> str:
    """Find the kind of the result of an operation on these numbers.

    Signed and unsigned integers have no common kind.
    """
    kinds = {kind_of(each) for each in values}
    rows = [each for each in kinds if is_row(each)]
    if len(rows) > 1:
        raise TypeError("rows of different sizes")
    if rows:
        return rows[0]
    if {WORD, WHOLE} <= kinds:
        raise TypeError("signed and unsigned integers are mixed; convert one of them")
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


def binary(emitter: Emitter, operation: Value, left: Scalar, right: Scalar) -> Number:
    """Lower one of Python's binary operators."""
    if operation is operator.pow:
        return power(emitter, left, right)
    kind = common_kind(left, right)
    if operation is operator.truediv and not is_row(kind):
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
    if kind == REAL or is_row(kind):
        return emitter.number(kind, f"{_REAL[operation]} {kind} {x.code}, {y.code}")
    name = _WHOLE[operation] if kind == WHOLE else _WHOLE[operation].partition(" ")[0]
    natural = x.natural and y.natural and operation is not operator.sub
    return emitter.number(kind, f"{name} i64 {x.code}, {y.code}")._replace(natural=natural)


def _divided(emitter: Emitter, operation: Value, x: Number, y: Number) -> Number:
    """Lower `x % y` or `x // y`; the remainder has the sign of y."""
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
    # the quotient is an integer except for round-off; snap it to the nearest one
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
    """Lower a power; known integer exponents become multiplications."""
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


def compare(emitter: Emitter, operation: Value, left: Scalar, right: Scalar) -> Number:
    """Lower a comparison; comparisons with NaN are false, except for `!=`."""
    kind = common_kind(left, right)
    kind = WHOLE if kind == TRUTH else REAL if is_row(kind) else kind
    x, y = (emitter.as_kind(each, kind) for each in (left, right))
    name = _ORDERED[operation]
    if kind == REAL:
        how = "une" if name == "ne" else f"o{name}"
        return emitter.number(TRUTH, f"fcmp {how} double {x.code}, {y.code}")
    how = name if name in ("eq", "ne") else f"{'u' if kind == WORD else 's'}{name}"
    return emitter.number(TRUTH, f"icmp {how} i64 {x.code}, {y.code}")


def negative(emitter: Emitter, x: Scalar) -> Number:
    """Lower `-x`."""
    kind = kind_of(x)
    if kind == REAL or is_row(kind):
        return emitter.number(kind, f"fneg {kind} {emitter.as_kind(x, kind).code}")
    return emitter.number(WHOLE, f"sub nsw i64 0, {emitter.as_kind(x, WHOLE).code}")


def inverse(emitter: Emitter, x: Scalar) -> Number:
    """Lower `not x`."""
    return emitter.number(TRUTH, f"xor i1 {emitter.truth(x).code}, true")
