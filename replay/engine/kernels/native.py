"""Kernels as machine code: made by LLVM, kept on disk, loaded, and called with arrays as they are.

A kernel is compiled for the kinds and sizes of its arguments: of arrays that a core works in all sizes
are known, of all others those behind the first axis, up to 64 (see `_described`). Its key is all that it
is made of (`identity`), this room itself, LLVM, and the processor.
"""

import ctypes
import gc
import operator
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from itertools import count
from pathlib import Path
from struct import Struct
from threading import Lock
from types import FunctionType
from typing import Any, NamedTuple, cast

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from recorders.errors import BadInput
from replay.engine.cache import cache_folder, in_turn, is_private, read_checked, say_once, write_checked
from replay.engine.kernels.identity import digest_of, identity
from replay.engine.kernels.lowering import lower
from replay.engine.kernels.numbers import REAL, TRUTH, WHOLE, WORD, Emitter, Number
from replay.engine.kernels.program import Program
from replay.engine.kernels.telling import compiling
from replay.engine.kernels.values import STORED, Array, Record, combined

KNOWN = 64  # sizes up to this are part of a kernel
_ALL = 64  # axes that an array may have
_MADE_BY = "a kernel that fuselog compiled"


class Kernel:
    """A function of one run as a loop over runs: `kernel.of(arguments)(first, end)`.

    `title` says what it is, to who waits for it.
    """

    def __init__(self, run_once: FunctionType, title: str) -> None:
        self._function = run_once
        self._title = title
        self._entries: dict[Any, tuple[Struct, Callable[..., Any]]] = {}
        self._loaded: dict[Any, Callable[..., Any]] = {}
        self._lock = Lock()

    def of(
        self, arguments: Sequence[Any], scratch: Sequence[Any] = (), varies: int = 1
    ) -> Callable[[int, int], None]:
        """The loop over the runs from `first` up to `end` for these arguments, which it holds.

        So many first axes of arrays vary, none of those in `scratch`; see `_describe`.
        """
        kinds: list[Any] = [os.environ.get("FUSELOG_BOUNDSCHECK") == "1"]
        numbers: list[Any] = []
        for each in arguments:
            _describe(each, varies, kinds, numbers)
        for each in scratch:
            _describe(each, 0, kinds, numbers)
        key = tuple(kinds)
        known = self._entries.get(key)
        if known is None:
            with self._lock:
                known = self._entries.get(key) or self._entries.setdefault(
                    key, self._entry((*arguments, *scratch), iter(key))
                )
        layout, entry = known
        given = layout.pack(*numbers)

        def loop(first: int, end: int, kept: Any = (arguments, scratch)) -> None:  # noqa: ARG001
            entry(first, end, given)

        return loop

    def _entry(
        self, arguments: Sequence[Any], kinds: Iterator[Any]
    ) -> tuple[Struct, Callable[..., Any]]:
        is_checked = next(kinds)
        described = tuple(_with_types(each, kinds) for each in arguments)
        key = is_checked, described
        if key not in self._loaded:
            make = _checked_entry if is_checked else _entry
            self._loaded[key] = make(self._function, described, self._title)
        return Struct(f"={''.join(map(_letters, described))}"), self._loaded[key]


def function_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that makes no arrays, for Python; no size of the arrays that it is given is known.

    It returns nothing, or a number of the kind that its annotation says.
    """
    said = function.__annotations__.get("return", "")
    returned = said if isinstance(said, str) else getattr(said, "__name__", str(said))
    if returned not in ("float", "int", "bool", "None"):
        raise BadInput(
            f"{function.__qualname__} does not say what it returns; annotate it with '-> float', "
            "'-> int', '-> bool' or '-> None'"
        )

    def call(run: int, arguments: tuple[Any, ...]) -> None:  # noqa: ARG001
        function(*arguments)

    def evaluate(run: int, arguments: tuple[Any, ...], found: np.ndarray) -> None:
        found[run] = function(*arguments)

    once = call if returned == "None" else evaluate
    once.__module__, once.__name__ = function.__module__, function.__name__
    kernel = Kernel(cast(FunctionType, once), f"{function.__module__}.{function.__name__}")

    def called(*arguments: Any) -> Any:
        if returned == "None":
            return kernel.of((arguments,), varies=_ALL)(0, 1)
        found = np.empty(1, returned)
        kernel.of((arguments, found), varies=_ALL)(0, 1)
        return found[0].item()

    return called


# --- arguments --------------------------------------------------------------------------------------


class Kept(NamedTuple):
    """How an array lies in memory: NumPy's letter of its numbers, its sizes (None where they vary)."""

    letter: str
    shape: tuple[int | None, ...]
    is_packed: bool


_LETTERS: dict[str, str] = {np.dtype(stored).char: stored for stored in STORED}
_LETTERS["q"] = _LETTERS["l"] = "<i8"
_LETTERS["Q"] = _LETTERS["L"] = "<u8"
# where NumPy's own structure of an array has what (PyArrayObject_fields), behind the head of an object
_DATA, _SHAPE, _STRIDES = (object.__basicsize__ + offset for offset in (0, 16, 24))


def _describe(value: Any, varies: int, kinds: list[Any], numbers: list[Any]) -> None:
    """Add what an argument is, for the kernel's key, and what it is at run time.

    So many first axes of an array vary, unless its NamedTuple says otherwise (`varying`).
    """
    if isinstance(value, np.ndarray):
        flags, dtype = value.flags, value.dtype
        is_usual = flags.aligned and dtype.isnative
        kinds.append((dtype.char, value.ndim, value.shape[varies:], flags.c_contiguous, is_usual))
        numbers.append(id(value))
    elif isinstance(value, tuple):
        kinds.append((type(value), len(value)))
        own = getattr(value, "varies", None)
        if own is None:
            for each in value:
                _describe(each, varies, kinds, numbers)
        else:
            for each, axes in zip(value, own, strict=True):
                _describe(each, axes, kinds, numbers)
    else:
        kinds.append(type(value))
        numbers.append(value)


def _with_types(value: Any, kinds: Iterator[Any]) -> Any:
    """An argument in full, as `_value_of` takes it: from what it is and its part of the key."""
    kind = next(kinds)
    if isinstance(value, tuple):
        return type(value), tuple(_with_types(each, kinds) for each in value)
    if isinstance(value, np.ndarray):
        letter, axes, known, is_packed, is_usual = kind
        if letter not in _LETTERS or not is_usual:
            why = "" if is_usual else ", unaligned or in another machine's order"
            raise BadInput(f"a kernel takes numbers of 64 bits, not an array of {value.dtype}{why}")
        shape = (*(None,) * (axes - len(known)), *(n if n <= KNOWN else None for n in known))
        return Kept(letter, shape, is_packed)
    for types, name in _SCALARS:
        if issubclass(kind, types):
            return name
    raise BadInput(f"a kernel takes numbers, arrays and tuples of them, not a {kind.__name__}")


_SCALARS: tuple[tuple[Any, str], ...] = (
    ((bool, np.bool_), TRUTH),
    (np.unsignedinteger, WORD),
    ((int, np.integer), WHOLE),
    ((float, np.floating), REAL),
)


def _letters(kind: Any) -> str:
    """How the numbers of an argument are packed into words."""
    if isinstance(kind, Kept):
        return "q"
    if isinstance(kind, tuple):
        return "".join(map(_letters, kind[1]))
    return {REAL: "d", WORD: "Q", TRUTH: "?7x"}.get(kind, "q")


def _value_of(kind: Any, emitter: Emitter, words: Iterator[int]) -> Any:
    """The value that a described argument is in the kernel: loaded from its words."""
    if isinstance(kind, Kept):
        return _array_of(kind, emitter, _word("ptr", emitter, next(words)))
    if isinstance(kind, tuple):
        parts = tuple(_value_of(each, emitter, words) for each in kind[1])
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


def _array_of(kind: Kept, emitter: Emitter, structure: str) -> Array:
    """An array of NumPy's: where its numbers are, and the sizes that are not known."""
    dtype = _LETTERS[kind.letter]
    sizes = _loaded_from("ptr", emitter, structure, _SHAPE)
    shape: list[Any] = [
        _loaded_from("i64", emitter, sizes, 8 * axis) if size is None else size
        for axis, size in enumerate(kind.shape)
    ]
    strides: list[Any] = []
    if kind.is_packed:
        stride: Any = 1
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
    return Array(dtype, data, tuple(shape), tuple(strides))


# --- making -----------------------------------------------------------------------------------------


def program_of(function: FunctionType, kinds: Sequence[Any], *, is_checked: bool = False) -> Program:
    """The kernel in LLVM's text: `kernel(first, end, words)` calls the function for every run.

    It returns 0, or where indices are checked the number of the first fault.
    """
    program, emitter, words = Program(lower, is_checked=is_checked), Emitter(), count()
    arguments = [_value_of(kind, emitter, words) for kind in kinds]
    body = Emitter()
    body.fresh = emitter.fresh  # type: ignore[method-assign]
    program.call(body, function, [Number(WHOLE, "%run"), *arguments])
    stop = ["stop:", "  %why = load i64, ptr %fault", "  ret i64 %why"] if body.can_fail else []
    lines = [
        "define i64 @kernel(i64 %first, i64 %end, ptr %words) {",
        "entry:",
        *body.allocated,
        *emitter.lines,
        "  br label %loop",
        "loop:",
        "  %run = phi i64 [ %first, %entry ], [ %next, %following ]",
        "  %more = icmp slt i64 %run, %end",
        "  br i1 %more, label %body, label %done",
        "body:",
        *body.lines,
        "  br label %following",
        "following:",
        "  %next = add nsw i64 %run, 1",
        "  br label %loop",
        "done:",
        "  ret i64 0",
        *stop,
        "}",
    ]
    program.functions.append("\n".join(lines))
    return program


def _checked_entry(function: FunctionType, kinds: tuple[Any, ...], title: str) -> Callable[..., None]:
    """The kernel's entry, which raises IndexError where an index is beyond its array; it is not kept."""
    with compiling(title):
        program = program_of(function, kinds, is_checked=True)
        kernel = _loaded(object_code(program.text()))

    def checked(*arguments: Any) -> None:
        fault = kernel(*arguments)
        if fault:
            raise IndexError(f"an index is beyond its array in {program.faults[fault - 1]}")

    return checked


def _entry(function: FunctionType, kinds: tuple[Any, ...], title: str) -> Callable[..., int]:
    """The kernel's entry: kept, or made."""
    known = "\n".join([_surroundings(), repr(_named(kinds)), identity(function)])
    key = sha256(known.encode()).hexdigest()[:32]
    path = None
    with suppress(RuntimeError):  # a user without a home
        path = cache_folder() / "kernels" / f"{function.__name__}-{key}.bin"
    if path is not None and not is_private(path.parent):
        path = None
    code = None if path is None else _kept(path, key)
    if code is None:
        if path is None:
            with compiling(title):
                code = _made(function, kinds)
        else:
            with compiling(title), in_turn(path) as waited:
                code = (_kept(path, key) if waited else None) or _made(function, kinds)
                _keep(path, key.encode() + code)
    return _loaded(code)


def _kept(path: Path, key: str) -> bytes | None:
    """The object code that a file holds; None where it is damaged, or another kernel's."""
    found = read_checked(path)
    own = key.encode()
    return found.removeprefix(own) if found is not None and found.startswith(own) else None


def _keep(path: Path, code: bytes) -> None:
    try:
        write_checked(path, code, _MADE_BY)
    except BadInput as error:
        why = str(error).removeprefix(f"{path}: ")
        say_once(f"the cache {path.parent} {why}: what is compiled now is not kept")


def _named(kinds: Any) -> Any:
    """Kinds of arguments in words that are the same in every process."""
    if isinstance(kinds, type):
        return f"{kinds.__module__}.{kinds.__qualname__}", getattr(kinds, "_fields", ())
    return tuple(map(_named, kinds)) if isinstance(kinds, tuple) else kinds


@cache
def _surroundings() -> str:
    """What beside a kernel's own sources its code depends on."""
    machine = _machine()
    return "\n".join(
        [
            digest_of("replay.engine.kernels"),
            platform.python_version(),
            f"llvmlite {llvmlite.__version__}",
            str(llvm.get_process_triple()),
            *machine,
        ]
    )


def _machine() -> tuple[str, str]:
    """The processor and its features: this one's, or those that are asked for as numba's are."""
    name = os.environ.get("NUMBA_CPU_NAME")
    features = os.environ.get("NUMBA_CPU_FEATURES")
    if features is None:
        features = "" if name else llvm.get_host_cpu_features().flatten()
    return name or llvm.get_host_cpu_name(), features


def _new_target() -> Any:
    """LLVM's description of the machine."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = _machine()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=name, features=features, opt=3, reloc="pic", codemodel="jitdefault"
    )


def _made(function: FunctionType, kinds: Sequence[Any]) -> bytes:
    """The kernel's object code."""
    with _without_garbage():
        return object_code(program_of(function, kinds).text())


def object_code(text: str) -> bytes:
    """Machine code of LLVM's text.

    Without the SLP vectoriser, which costs as much as all else and gains these kernels nothing.
    """
    target = _new_target()
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(target.target_data)
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization, options.loop_vectorization = False, True
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(target.emit_object(module))


_ENGINES: list[Any] = []  # what is loaded stays


def _loaded(code: bytes) -> Callable[..., int]:
    """The entry of a kernel's object code; the engine owns its target."""
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _new_target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    entry = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_char_p)
    return entry(engine.get_function_address("kernel"))


@contextmanager
def _without_garbage() -> Iterator[None]:
    """A compiler makes very many objects and little garbage: nobody looks for it meanwhile."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
