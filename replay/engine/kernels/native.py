"""Kernels as machine code: made by LLVM, kept on disk, loaded, and called with arrays as they are.

A kernel is compiled for the kinds and sizes of its arguments: of arrays that a core works in all sizes
are known, of all others those behind the first axis, up to 64 (see `_described`). Its key is all that it
is made of (`identity`), this room itself, LLVM, and the processor.
"""

import ctypes
import gc
import os
import platform
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from importlib.resources import files
from threading import Lock
from types import FunctionType
from typing import Any, cast

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from recorders.errors import BadInput
from replay.engine.cache import cache_folder, in_turn, is_private, read_checked, say_once, write_checked
from replay.engine.kernels.identity import identity
from replay.engine.kernels.lowering import lower
from replay.engine.kernels.numbers import REAL, TRUTH, WHOLE, WORD, Emitter, Number
from replay.engine.kernels.program import Program
from replay.engine.kernels.telling import compiling
from replay.engine.kernels.values import STORED, Array, Record, leaves, rebuilt

KNOWN = 64  # sizes up to this are part of a kernel
_ALL = 64  # axes that an array may have
_MADE_BY = "a kernel that fuselog compiled"


class Kernel:
    """A function of one run as a loop over runs: `kernel.of(arguments)(first, end)`."""

    def __init__(self, run_once: FunctionType) -> None:
        self._function = run_once
        self._entries: dict[Any, Callable[..., None]] = {}
        self._lock = Lock()

    def of(
        self, arguments: Sequence[Any], scratch: Sequence[Any] = (), varies: int = 1
    ) -> Callable[[int, int], None]:
        """The loop over the runs from `first` up to `end` for these arguments, which it holds.

        So many first axes of arrays vary, none of those in `scratch`; see `_described`.
        """
        words: list[int] = []
        kinds = (
            *(_described(each, words, varies) for each in arguments),
            *(_described(each, words, 0) for each in scratch),
        )
        entry = self._entries.get(kinds)
        if entry is None:
            with self._lock:
                entry = self._entries.get(kinds) or self._entries.setdefault(
                    kinds, _entry(self._function, kinds)
                )
        found, given = entry, (ctypes.c_int64 * len(words))(*words)

        def loop(first: int, end: int, kept: Any = (arguments, scratch)) -> None:  # noqa: ARG001
            found(first, end, given)

        return loop


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
    kernel = Kernel(cast(FunctionType, once))

    def called(*arguments: Any) -> Any:
        if returned == "None":
            return kernel.of((arguments,), varies=_ALL)(0, 1)
        found = np.empty(1, returned)
        kernel.of((arguments, found), varies=_ALL)(0, 1)
        return found[0].item()

    return called


# --- arguments --------------------------------------------------------------------------------------


def _described(value: Any, words: list[int], varies: int) -> Any:
    """What an argument is, for the kernel's key; what of it is known at run time only goes to `words`.

    So many first axes of an array vary, unless its NamedTuple says otherwise (`varying`).
    """
    if isinstance(value, np.ndarray):
        size, item = value.itemsize, value.dtype.str
        if item not in STORED:
            raise BadInput(f"a kernel takes numbers of 64 bits, not an array of {value.dtype}")
        shape = tuple(n if axis >= varies and n <= KNOWN else None for axis, n in enumerate(value.shape))
        strides: list[int | None] = []
        usual: int | None = 1
        for n, known, step in zip(value.shape[::-1], shape[::-1], value.strides[::-1], strict=True):
            if step % size:
                raise BadInput("a kernel takes arrays whose numbers lie in whole steps")
            # NumPy's strides of an array without numbers are 0: it is taken for a packed one
            strides.append(usual if step // size == usual or not value.size else None)
            usual = None if usual is None or known is None else usual * n
        strides.reverse()
        words.append(value.__array_interface__["data"][0])
        for known, numbers in (
            (shape, value.shape),
            (strides, [each // size for each in value.strides]),
        ):
            words += [n for n, each in zip(numbers, known, strict=True) if each is None]
        return item, shape, tuple(strides)
    if isinstance(value, tuple):
        own = getattr(type(value), "varies", (varies,) * len(value))
        return type(value), tuple(
            _described(*each) for each in zip(value, [words] * len(value), own, strict=True)
        )
    if isinstance(value, bool | np.bool_):
        words.append(int(value))
        return TRUTH
    if isinstance(value, int | np.integer):
        words.append(int(value))
        return WORD if isinstance(value, np.unsignedinteger) else WHOLE
    if isinstance(value, float | np.floating):
        words.append(struct.unpack("<q", struct.pack("<d", value))[0])
        return REAL
    raise BadInput(f"a kernel takes numbers, arrays and tuples of them, not a {type(value).__name__}")


def _value_of(kind: Any, emitter: Emitter) -> Any:
    """The value that a described argument is in the kernel, its leaves without names."""
    if isinstance(kind, str):
        return Number(kind, "")
    if isinstance(kind[0], str):
        item, shape, strides = kind
        unknown = [tuple("" if each is None else each for each in part) for part in (shape, strides)]
        return Array(item, "", unknown[0], unknown[1])
    parts = tuple(_value_of(each, emitter) for each in kind[1])
    return parts if kind[0] is tuple else Record(kind[0], parts)


# --- making -----------------------------------------------------------------------------------------


def text_of(function: FunctionType, kinds: Sequence[Any]) -> str:
    """The kernel in LLVM's text: `kernel(first, end, words)` calls the function for every run."""
    program, emitter = Program(lower), Emitter()
    place = 0
    arguments = []
    for kind in kinds:
        value, names = _value_of(kind, emitter), []
        for leaf, _ in leaves(value):
            address = emitter.fresh()
            emitter.add(f"{address} = getelementptr inbounds i64, ptr %words, i64 {place}")
            stored = "i64" if leaf == "i1" else leaf
            name = emitter.fresh()
            emitter.add(f"{name} = load {stored}, ptr {address}")
            names.append(name if leaf != "i1" else emitter.number(TRUTH, f"icmp ne i64 {name}, 0").code)
            place += 1
        arguments.append(rebuilt(value, iter(names)))
    body = Emitter()
    body.fresh = emitter.fresh  # type: ignore[method-assign]
    program.call(body, function, [Number(WHOLE, "%run"), *arguments])
    lines = [
        "define void @kernel(i64 %first, i64 %end, ptr %words) {",
        "entry:",
        *emitter.lines,
        "  br label %loop",
        "loop:",
        "  %run = phi i64 [ %first, %entry ], [ %next, %body ]",
        "  %more = icmp slt i64 %run, %end",
        "  br i1 %more, label %body, label %done",
        "body:",
        *body.lines,
        "  %next = add nsw i64 %run, 1",
        "  br label %loop",
        "done:",
        "  ret void",
        "}",
    ]
    program.functions.append("\n".join(lines))
    return program.text()


def _entry(function: FunctionType, kinds: tuple[Any, ...]) -> Callable[..., None]:
    """The kernel's entry: kept, or made."""
    known = "\n".join([_surroundings(), repr(_named(kinds)), identity(function)])
    key = sha256(known.encode()).hexdigest()[:32]
    path = None
    with suppress(RuntimeError):  # a user without a home
        path = cache_folder() / "kernels" / f"{function.__name__}-{key}.bin"
    if path is not None and not is_private(path.parent):
        path = None
    code = None if path is None else read_checked(path)
    if code is None:
        title = f"{function.__module__}.{function.__name__}"
        if path is None:
            with compiling(title):
                code = _made(function, kinds)
        else:
            with compiling(title), in_turn(path) as waited:
                code = (read_checked(path) if waited else None) or _made(function, kinds)
                _keep(path, code)
    return _loaded(code)


def _keep(path: Any, code: bytes) -> None:
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
    room = files("replay.engine.kernels")
    sources = sorted(each.name for each in room.iterdir() if each.name.endswith(".py"))
    digest = sha256(b"".join(room.joinpath(name).read_bytes() for name in sources)).hexdigest()
    machine = _machine()
    return "\n".join(
        [
            digest,
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


@cache
def _target() -> Any:
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
        return object_code(text_of(function, kinds))


def object_code(text: str) -> bytes:
    """Machine code of LLVM's text.

    Without the SLP vectoriser, which costs as much as all else and gains these kernels nothing.
    """
    target = _target()
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(target.target_data)
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization, options.loop_vectorization = False, True
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(target.emit_object(module))


_ENGINES: list[Any] = []  # what is loaded stays


def _loaded(code: bytes) -> Callable[..., None]:
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _fresh_target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    entry = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
    return entry(engine.get_function_address("kernel"))


def _fresh_target() -> Any:
    """An engine owns its target."""
    _target()
    name, features = _machine()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=name, features=features, opt=3, reloc="pic", codemodel="jitdefault"
    )


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
