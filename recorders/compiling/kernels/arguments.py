"""Kernel arguments: how they are described in a kernel's key, packed into words, and loaded.

An array is passed as one word: the address of its NumPy structure, which contains the addresses of the
data and of the sizes.
"""

import operator
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from fuselog.recorders.compiling.kernels.numbers import REAL, TRUTH, WHOLE, WORD, Emitter, Number
from fuselog.recorders.compiling.kernels.values import STORED, Array, Record, combined
from fuselog.recorders.compiling.kinds import AnyArray, Value
from fuselog.recorders.errors import BadInput

KNOWN = 64  # sizes up to this are constants of a kernel, and so are those of square matrices


class KnownArray(NamedTuple):
    """The layout of an array: NumPy's type letter, sizes (None if unknown), and contiguity.

    `is_apart` is true if no other array of the kernel shares its memory, as for most working memory.
    """

    letter: str
    shape: tuple[int | None, ...]
    is_packed: bool
    is_apart: bool = False


_LETTERS: dict[str, str] = {np.dtype(stored).char: stored for stored in STORED}
_LETTERS["q"] = _LETTERS["l"] = "<i8"
_LETTERS["Q"] = _LETTERS["L"] = "<u8"
# bits of NumPy's flags: C order, aligned
_PACKED, _ALIGNED = 0x0001, 0x0100
_LAYOUT = _PACKED | _ALIGNED
# offsets in NumPy's structure of an array (PyArrayObject_fields), after the object header
_DATA, _SHAPE, _STRIDES = (object.__basicsize__ + offset for offset in (0, 16, 24))


def describe(values: Iterable[Value], varies: int, kinds: list[Value], numbers: list[Value]) -> None:
    """Append the kinds of arguments, for the kernel's key, and their words, for the call.

    The sizes of the first `varies` axes of arrays are not part of the kinds. If a NamedTuple has an
    attribute `varies`, it states this number for each of the fields.
    """
    for value in values:
        if isinstance(value, np.ndarray):
            shape = value.shape
            kinds.append((value.dtype, len(shape), shape[varies:], value.flags.num & _LAYOUT))
            numbers.append(id(value))
        elif isinstance(value, tuple):
            kinds.append((type(value), len(value)))
            own = getattr(value, "varies", None)
            if own is None:
                describe(value, varies, kinds, numbers)
            else:
                for each, axes in zip(value, own, strict=True):
                    describe((each,), axes, kinds, numbers)
        else:
            kinds.append(type(value))
            numbers.append(value)


def are_apart(value: Value) -> tuple[bool, ...]:
    """Test for each array in an argument whether it shares no memory with the others.

    Two arrays share memory if they are views of one array, or one is a view of the other.
    """
    owners = [id(each if each.base is None else each.base) for each in _arrays_in(value)]
    uses = Counter(owners)
    return tuple(uses[each] == 1 for each in owners)


def _arrays_in(value: Value) -> Iterator[AnyArray]:
    if isinstance(value, np.ndarray):
        yield value
    for each in value if isinstance(value, tuple) else ():
        yield from _arrays_in(each)


def with_types(value: Value, kinds: Iterator[Value], apart: Iterator[bool]) -> Value:
    """Convert an argument's kinds in the key to the description that `value_of` needs.

    `apart` has an entry for every array; see `KnownArray`.
    """
    kind = next(kinds)
    if isinstance(value, tuple):
        return type(value), tuple(with_types(each, kinds, apart) for each in value)
    if isinstance(value, np.ndarray):
        dtype, axes, known, layout = kind
        is_usual = layout & _ALIGNED and dtype.isnative
        if dtype.char not in _LETTERS or not is_usual:
            why = "" if is_usual else ", unaligned or in another machine's order"
            raise BadInput(f"a kernel takes 64-bit numbers, not an array of {value.dtype}{why}")
        is_square = len(known) > 1 and known[-1] == known[-2]
        sizes = (size if size <= KNOWN or is_square else None for size in known)
        shape = (*(None,) * (axes - len(known)), *sizes)
        return KnownArray(dtype.char, shape, bool(layout & _PACKED), next(apart))
    for types, name in _SCALARS:
        if issubclass(kind, types):
            return name
    raise BadInput(f"a kernel takes numbers, arrays and tuples of them, not a {kind.__name__}")


_SCALARS: tuple[tuple[Value, str], ...] = (
    ((bool, np.bool_), TRUTH),
    (np.unsignedinteger, WORD),
    ((int, np.integer), WHOLE),
    ((float, np.floating), REAL),
)


def letters(kind: Value) -> str:
    """Return the format that packs the numbers of an argument into words."""
    if isinstance(kind, KnownArray):
        return "q"
    if isinstance(kind, tuple):
        return "".join(map(letters, kind[1]))
    return {REAL: "d", WORD: "Q", TRUTH: "?7x"}.get(kind, "q")


def value_of(kind: Value, emitter: Emitter, words: Iterator[int]) -> Value:
    """Load the value of a described argument from its words."""
    if isinstance(kind, KnownArray):
        return _array_of(kind, emitter, _word("ptr", emitter, next(words)))
    if isinstance(kind, tuple):
        parts = tuple(value_of(each, emitter, words) for each in kind[1])
        return parts if kind[0] is tuple else Record(kind[0], parts)
    if kind == TRUTH:
        return emitter.number(TRUTH, f"icmp ne i64 {_word('i64', emitter, next(words))}, 0")
    return Number(kind, _word(Number(kind, "").type, emitter, next(words)))


def _word(kind: str, emitter: Emitter, place: int) -> str:
    return _loaded_from(kind, emitter, "%words", 8 * place)


def _loaded_from(kind: str, emitter: Emitter, address: str, offset: int) -> str:
    place, name = emitter.fresh(), emitter.fresh()
    emitter.add(f"{place} = getelementptr inbounds i8, ptr {address}, i64 {offset}")
    emitter.add(f"{name} = load {kind}, ptr {place}")
    return name


def _array_of(kind: KnownArray, emitter: Emitter, structure: str) -> Array:
    """Load a NumPy array: the address of its data, and the sizes that the kernel does not know."""
    dtype = _LETTERS[kind.letter]
    sizes = _loaded_from("ptr", emitter, structure, _SHAPE)
    shape: list[Value] = [
        _loaded_from("i64", emitter, sizes, 8 * axis) if size is None else size
        for axis, size in enumerate(kind.shape)
    ]
    strides: list[Value] = []
    if kind.is_packed:
        stride: Value = 1
        for size in reversed(shape):
            strides.insert(0, stride)
            stride = combined(emitter, operator.mul, size, stride)
    else:
        steps = _loaded_from("ptr", emitter, structure, _STRIDES)
        for axis in range(len(shape)):
            step = _loaded_from("i64", emitter, steps, 8 * axis)
            text = f"sdiv exact i64 {step}, {np.dtype(dtype).itemsize}"
            strides.append(emitter.number(WHOLE, text).code)
    data = _loaded_from("ptr", emitter, structure, _DATA)
    return Array(dtype, data, tuple(shape), tuple(strides), is_apart=kind.is_apart)
