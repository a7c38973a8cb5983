"""Values of a kernel's names while it is lowered: numbers, arrays, tuples, constants.

A value is a `Number`, an `Array`, a tuple of values, a `Record` (a NamedTuple of values), or any Python
object that is already known, such as a number, a string or a function. The leaves of a value are the
parts that exist at run time: numbers, and the address and unknown sizes of an array.
"""

import operator
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import prod

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
    compare,
    constant,
    is_static,
)
from fuselog.recorders.compiling.kinds import AnyArray, Value

Size = int | str  # known size, or the name of an integer at run time
Leaf = tuple[str, str]  # LLVM type and name
POINTER = "ptr"
# LLVM types in which the numbers of an array are stored, and the kinds to which they are converted
STORED = {
    "<f8": ("double", REAL),
    "<i8": ("i64", WHOLE),
    "<u8": ("i64", WORD),
    "<u4": ("i32", WHOLE),
    "<i4": ("i32", WHOLE),
    "|b1": ("i8", TRUTH),
    "|u1": ("i8", WHOLE),
    "|i1": ("i8", WHOLE),
}


@dataclass(frozen=True)
class Array:
    """An array: its element type, its address, its sizes, and its strides in elements.

    `is_local` is True if its memory is released when the function that made it returns, `is_apart` if no
    other argument of the kernel shares its memory.
    """

    dtype: str
    pointer: str
    shape: tuple[Size, ...]
    strides: tuple[Size, ...]
    is_local: bool = False
    is_apart: bool = False

    @property
    def turned(self) -> "Array":
        """Return the transposed array."""
        return Array(self.dtype, self.pointer, self.shape[::-1], self.strides[::-1], self.is_local)


@dataclass(frozen=True)
class Record:
    """A NamedTuple of values."""

    type: type[Value]
    values: tuple[Value, ...]

    def get(self, name: str) -> Value:
        """Return a field."""
        return self.values[self.type._fields.index(name)]


def entries(value: Value) -> tuple[Value, ...] | None:
    """Return the values in a tuple or NamedTuple; None for other values."""
    if isinstance(value, Record):
        return value.values
    return value if isinstance(value, tuple) and not isinstance(value, Number) else None


def leaves(value: Value) -> Iterator[Leaf]:
    """Yield the parts of a value that exist at run time."""
    if isinstance(value, Number):
        yield value.type, value.code
    elif isinstance(value, Array):
        yield f"{POINTER} noalias" if value.is_apart else POINTER, value.pointer
        for size in (*value.shape, *value.strides):
            if isinstance(size, str):
                yield WHOLE, size
    else:
        for entry in entries(value) or ():
            yield from leaves(entry)


def rebuilt(value: Value, names: Iterator[str]) -> Value:
    """Return the same value with other names for its leaves."""
    if isinstance(value, Number):
        return Number(value.kind, next(names), value.natural)
    if isinstance(value, Array):
        pointer, axes = next(names), len(value.shape)
        sizes = [next(names) if isinstance(size, str) else size for size in value.shape + value.strides]
        return Array(value.dtype, pointer, tuple(sizes[:axes]), tuple(sizes[axes:]), value.is_local)
    if isinstance(value, Record):
        return Record(value.type, tuple(rebuilt(entry, names) for entry in value.values))
    if isinstance(value, tuple):
        return tuple(rebuilt(entry, names) for entry in value)
    return value


def signature(value: Value) -> Value:
    """Return the kind of a value, without the names of its leaves; known values are included."""
    if isinstance(value, Number):
        return value.kind
    if isinstance(value, Array):
        sizes = (None if isinstance(size, str) else size for size in (*value.shape, *value.strides))
        return "array", value.dtype, len(value.shape), *sizes
    if isinstance(value, Record):
        return value.type, *map(signature, value.values)
    if isinstance(value, tuple):
        return "tuple", *map(signature, value)
    if is_static(value) or isinstance(value, str | None):
        return type(value), repr(value)
    return "object", id(value)


def at_run_time(value: Value) -> Value:
    """Convert every known number in a value to a number at run time."""
    if is_static(value):
        return constant(value)
    if isinstance(value, Record):
        return Record(value.type, tuple(map(at_run_time, value.values)))
    if isinstance(value, tuple) and not isinstance(value, Number):
        return tuple(map(at_run_time, value))
    return value


# --- arrays -----------------------------------------------------------------------------------------


def whole(size: Size | Scalar) -> Scalar:
    """Convert a size to a number."""
    return Number(WHOLE, size, natural=True) if isinstance(size, str) else size


def _size(number: Scalar) -> Size:
    return number.code if isinstance(number, Number) else int(number)


def combined(emitter: Emitter, operation: Value, left: Size, right: Size) -> Size:
    """Compute the sum, product or difference of two sizes."""
    if isinstance(left, int) and isinstance(right, int):
        return int(operation(left, right))
    if operation is operator.mul and 1 in (left, right):
        return right if left == 1 else left
    if operation is not operator.mul and right == 0:
        return left
    return binary(emitter, operation, whole(left), whole(right)).code


def place_in(emitter: Emitter, index: Scalar, size: Size) -> Size:
    """Find the position of an index, which may count from the end; check it if checks are enabled."""
    place = _counted(emitter, index, size)
    if emitter.fault is not None:
        code, end = (emitter.as_kind(whole(each), WHOLE).code for each in (place, size))
        is_beyond = emitter.number(TRUTH, f"icmp uge i64 {code}, {end}")
        emitter.stop_if(is_beyond, constant(emitter.fault()))
    return place


def _counted(emitter: Emitter, index: Scalar, size: Size) -> Size:
    if not isinstance(index, Number):
        return int(index) if index >= 0 else combined(emitter, operator.add, size, int(index))
    number = emitter.as_kind(index, WHOLE) if index.kind == TRUTH else index
    if number.natural or number.kind == WORD:
        return number.code
    is_below = compare(emitter, operator.lt, number, 0)
    turned = emitter.as_kind(whole(combined(emitter, operator.add, number.code, size)), WHOLE)
    return emitter.select(is_below, turned, number).code


def part_of(emitter: Emitter, array: Array, index: tuple[Value, ...]) -> Array:
    """Select a part of an array by numbers and slices, whose bounds are None at open ends."""
    offset: Size = 0
    shape: list[Size] = []
    strides: list[Size] = []
    for axis, each in enumerate(index):
        size, stride = array.shape[axis], array.strides[axis]
        if isinstance(each, slice):
            start = 0 if each.start is None else _within(emitter, each.start, size)
            stop = size if each.stop is None else _within(emitter, each.stop, size)
            shape.append(combined(emitter, operator.sub, stop, start))
            strides.append(stride)
        else:
            start = place_in(emitter, each, size)
        offset = combined(emitter, operator.add, offset, combined(emitter, operator.mul, start, stride))
    shape += array.shape[len(index) :]
    strides += array.strides[len(index) :]
    return Array(
        array.dtype, _moved(emitter, array, offset), tuple(shape), tuple(strides), array.is_local
    )


def _within(emitter: Emitter, bound: Scalar, size: Size) -> Size:
    """Limit a bound of a slice to the end of the axis."""
    place = _counted(emitter, bound, size)
    if isinstance(place, int) and isinstance(size, int):
        return min(max(place, 0), size)
    both = [emitter.as_kind(whole(each), WHOLE) for each in (place, size)]
    return emitter.select(compare(emitter, operator.lt, *both), *both).code


def _moved(emitter: Emitter, array: Array, offset: Size) -> str:
    if offset == 0:
        return array.pointer
    stored = STORED[array.dtype][0]
    name = emitter.fresh()
    emitter.add(f"{name} = getelementptr inbounds {stored}, ptr {array.pointer}, i64 {offset}")
    return name


def row_kind(value: Value) -> str:
    """Return the kind of an array that is a row of real numbers of known size; "" for other values."""
    is_row = isinstance(value, Array) and value.dtype == "<f8" and value.strides == (1,)
    return f"<{value.shape[0]} x {REAL}>" if is_row and isinstance(value.shape[0], int) else ""


def load(emitter: Emitter, place: Array) -> Number:
    """Load the number in an array without axes, or a row of numbers."""
    kind = row_kind(place)
    if kind:
        return emitter.number(kind, f"load {kind}, ptr {place.pointer}, align 8")
    stored, kind = STORED[place.dtype]
    found = emitter.number(kind, f"load {stored}, ptr {place.pointer}")
    if stored == "i8" and kind == TRUTH:
        return emitter.number(TRUTH, f"icmp ne i8 {found.code}, 0")
    if stored in ("i8", "i32"):
        natural = place.dtype[1] == "u"
        return emitter.number(
            WHOLE, f"{'z' if natural else 's'}ext {stored} {found.code} to i64"
        )._replace(natural=natural)
    return found


def store(emitter: Emitter, place: Array, value: Scalar) -> None:
    """Store a number in an array without axes, or a row of numbers."""
    row = row_kind(place)
    if row:
        code = emitter.as_kind(value, row).code
        emitter.add(f"store {row} {code}, ptr {place.pointer}, align 8")
        return
    stored, kind = STORED[place.dtype]
    number = emitter.as_kind(value, kind)
    if stored == "i8" and kind == TRUTH:
        number = emitter.number(WHOLE, f"zext i1 {number.code} to i8")
    elif stored in ("i8", "i32"):
        number = emitter.number(WHOLE, f"trunc i64 {number.code} to {stored}")
    emitter.add(f"store {stored} {number.code}, ptr {place.pointer}")


# --- constants --------------------------------------------------------------------------------------


def table(name: str, numbers: AnyArray) -> tuple[str, Array]:
    """Define a constant array; return its LLVM IR and the array."""
    dtype = numbers.dtype.str
    stored, kind = STORED[dtype]
    if stored == "i8" and kind == TRUTH:
        numbers = numbers.astype(np.uint8)
    flat = np.ascontiguousarray(numbers).ravel()
    codes = ", ".join(f"{stored} {constant(each).code}" for each in flat)
    text = f"{name} = private unnamed_addr constant [{flat.size} x {stored}] [{codes}]"
    return text, Array(dtype, name, numbers.shape, packed(numbers.shape))


def packed(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Compute the strides of a contiguous array."""
    return tuple(prod(shape[axis + 1 :]) for axis in range(len(shape)))


def made(emitter: Emitter, shape: tuple[int, ...], dtype: str) -> Array:
    """Allocate memory, until the function returns, for an array of known sizes."""
    memory = emitter.memory(STORED[dtype][0], max(1, prod(shape)))
    return Array(dtype, memory, shape, packed(shape), is_local=True)


def is_local(value: Value) -> bool:
    """Test whether a value contains an array whose memory is released when its function returns."""
    if isinstance(value, Array):
        return value.is_local
    return any(map(is_local, entries(value) or ()))


def placed(value: Value, *, is_local: bool) -> Value:
    """Mark the arrays of a value as local to the current function, or as not local.

    The arguments of a function outlive it, and may be part of its result.
    """
    if isinstance(value, Array):
        return replace(value, is_local=is_local)
    if isinstance(value, Record):
        return Record(value.type, tuple(placed(each, is_local=is_local) for each in value.values))
    parts = entries(value)
    return value if parts is None else tuple(placed(each, is_local=is_local) for each in parts)
