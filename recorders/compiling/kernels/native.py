"""Machine code of kernels: made by LLVM, cached, loaded, and called with NumPy arrays.

A kernel is compiled for the kinds and sizes of its arguments. The sizes of working memory are constants,
and so are the sizes of other arrays after the first axis, up to `arguments.KNOWN`. The key of cached
code covers all functions in it (`identity`), this package, LLVM and the processor.
"""

import ctypes
import gc
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from itertools import count, repeat
from pathlib import Path
from struct import Struct
from threading import Lock
from types import FunctionType
from typing import cast

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from fuselog.recorders import environment
from fuselog.recorders.compiling.cache import (
    cache_folder,
    in_turn,
    is_private,
    read_checked,
    say_once,
    write_checked,
)
from fuselog.recorders.compiling.identity import digest_of, identity
from fuselog.recorders.compiling.kernels.arguments import (
    are_apart,
    describe,
    letters,
    value_of,
    with_types,
)
from fuselog.recorders.compiling.kernels.lowering import lower
from fuselog.recorders.compiling.kernels.numbers import WHOLE, Emitter, Number
from fuselog.recorders.compiling.kernels.program import Program
from fuselog.recorders.compiling.kinds import AnyArray, Entry, KernelFunction, RunOnce, Value
from fuselog.recorders.compiling.notices import compiling, done_once
from fuselog.recorders.compiling.scratch import Memory
from fuselog.recorders.errors import BadInput

_ALL = 64  # largest number of axes of an array
_MADE_BY = "a kernel that fuselog compiled"


class _Layout:
    """The kinds of a core's working memory; equal kinds share one object, which makes lookup fast.

    `apart` states for each array whether it is known to share no memory with other arrays.
    """

    def __init__(self, kinds: tuple[Value, ...], apart: tuple[bool, ...]) -> None:
        self.kinds, self.apart = kinds, apart


_layout_of = cache(_Layout)


def _described(memory: Memory) -> tuple[_Layout, list[Value]]:
    """Describe working memory: its kinds, with all sizes known, and the words to pass."""
    kinds: list[Value] = []
    words: list[Value] = []
    describe((memory.value,), 0, kinds, words)
    apart = are_apart(memory.value)
    return _layout_of(tuple(kinds), apart if memory.is_kept else (False,) * len(apart)), words


class Kernel:
    """A compiled loop over runs, called as `kernel.of(arguments)(first, end)`.

    `title` is its name in notices.
    """

    def __init__(self, run_once: FunctionType, title: str = "") -> None:
        self._function = run_once
        self._title = title or f"{run_once.__module__}.{run_once.__name__}"
        self._entries: dict[Value, tuple[Struct, KernelFunction]] = {}
        self._loaded: dict[Value, KernelFunction] = {}
        self._lock = Lock()

    def of(
        self, arguments: Sequence[Value], memory: Memory | None = None, varies: int = 1
    ) -> Callable[[int, int], None]:
        """Return a function that processes the runs from `first` up to `end` with these arguments.

        The function keeps the arguments alive. The kernel does not rely on the sizes of the first
        `varies` axes of arrays, except in the working memory; see `describe`.
        """
        kinds: list[Value] = [environment.is_on(environment.BOUNDSCHECK)]
        numbers: list[Value] = []
        describe(arguments, varies, kinds, numbers)
        layout_of_memory = None
        if memory is not None:
            memory.described = memory.described or _described(memory)
            layout_of_memory, words = memory.described
            numbers += words
        key = layout_of_memory, *kinds
        known = self._entries.get(key)
        if known is None:
            with self._lock:
                known = self._entries.get(key) or self._entries.setdefault(
                    key, self._layout_and_entry(arguments, iter(kinds), memory)
                )
        layout, entry = known
        given = layout.pack(*numbers)

        def loop(first: int, end: int, kept: Value = (arguments, memory)) -> None:  # noqa: ARG001
            entry(first, end, given)

        return loop

    def _layout_and_entry(
        self, arguments: Sequence[Value], kinds: Iterator[Value], memory: Memory | None
    ) -> tuple[Struct, KernelFunction]:
        """Make the structure that packs arguments of these kinds, and the entry that takes them."""
        is_checked = next(kinds)
        described = tuple(with_types(each, kinds, repeat(False)) for each in arguments)
        if memory is not None:
            layout, _ = memory.described
            apart = are_apart((*arguments, memory.value))
            assert not memory.is_kept or apart[len(apart) - len(layout.apart) :] == layout.apart, (
                f"{self._title}: an argument is also in the memory that is kept for later calls"
            )
            described += (with_types(memory.value, iter(layout.kinds), iter(layout.apart)),)
        key = is_checked, described
        if key not in self._loaded:
            make = _checked_entry if is_checked else _kept_entry
            with done_once():
                self._loaded[key] = make(self._function, described, self._title)
        return Struct(f"={''.join(map(letters, described))}"), self._loaded[key]


def function_of(function: KernelFunction, *, for_sizes: bool = False) -> KernelFunction:
    """Compile a function for calls from Python; see `compiled`.

    The function creates no arrays, and returns nothing or a number of the annotated kind. Unless
    `for_sizes` is true, its code makes no assumptions about the sizes of its arrays.
    """
    varies = 1 if for_sizes else _ALL
    stated = function.__annotations__.get("return", "")
    returned = stated if isinstance(stated, str) else getattr(stated, "__name__", str(stated))
    if returned not in ("float", "int", "bool", "None"):
        raise BadInput(
            f"{function.__qualname__} does not state the type of its result; annotate it by '-> float', "
            "'-> int', '-> bool' or '-> None'"
        )

    def call(run: int, arguments: tuple[Value, ...]) -> None:  # noqa: ARG001
        function(*arguments)

    def evaluate(run: int, arguments: tuple[Value, ...], found: AnyArray) -> None:
        found[run] = function(*arguments)

    once = call if returned == "None" else evaluate
    once.__module__, once.__name__ = function.__module__, function.__name__
    kernel = Kernel(cast(FunctionType, once))

    def called(*arguments: Value) -> Value:
        if returned == "None":
            return kernel.of((arguments,), varies=varies)(0, 1)
        found = np.empty(1, returned)
        kernel.of((arguments, found), varies=varies)(0, 1)
        return found[0].item()

    return called


# --- making -----------------------------------------------------------------------------------------


def program_of(function: FunctionType, kinds: Sequence[Value], *, is_checked: bool = False) -> Program:
    """Write the kernel in LLVM IR: `kernel(first, end, words)` calls the function for every run.

    The kernel returns 0, or the number of the first fault if indices are checked.
    """
    program, emitter, words = Program(lower, is_checked=is_checked), Emitter(), count()
    arguments = [value_of(kind, emitter, words) for kind in kinds]
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


def _checked_entry(function: FunctionType, kinds: tuple[Value, ...], title: str) -> RunOnce:
    """Make an entry that raises IndexError for an index out of bounds; its code is not cached."""
    with compiling(title):
        program = program_of(function, kinds, is_checked=True)
        kernel = _loaded(object_code(program.text()))

    def checked(*arguments: Value) -> None:
        fault = kernel(*arguments)
        if fault:
            raise IndexError(f"an array index is out of range in {program.faults[fault - 1]}")

    return checked


def _kept_entry(function: FunctionType, kinds: tuple[Value, ...], title: str) -> Entry:
    """Load the kernel's entry from the cache; if it is missing, make it and add it to the cache."""
    known = "\n".join([_surroundings(), repr(_named(kinds)), identity(function)])
    key = sha256(known.encode()).hexdigest()[:32]
    path = None
    with suppress(RuntimeError):  # the user has no home folder
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
    """Read the object code in a file; return None if it is damaged or belongs to another kernel."""
    found = read_checked(path)
    own = key.encode()
    return found.removeprefix(own) if found is not None and found.startswith(own) else None


def _keep(path: Path, code: bytes) -> None:
    """Write object code to a file; warn once if this is impossible."""
    try:
        write_checked(path, code, _MADE_BY)
    except BadInput as error:
        why = str(error).removeprefix(f"{path}: ")
        say_once(f"the cache {path.parent} {why}: newly compiled code is not stored")


def _named(kinds: Value) -> Value:
    """Describe kinds of arguments by values that are the same in every process."""
    if isinstance(kinds, type):
        return f"{kinds.__module__}.{kinds.__qualname__}", getattr(kinds, "_fields", ())
    return tuple(map(_named, kinds)) if isinstance(kinds, tuple) else kinds


@cache
def _surroundings() -> str:
    """Describe the versions, sources and processor on which the code of every kernel depends."""
    machine = _machine()
    return "\n".join(
        [
            digest_of("fuselog.recorders.compiling.kernels"),
            platform.python_version(),
            f"llvmlite {llvmlite.__version__}",
            str(llvm.get_process_triple()),
            *machine,
        ]
    )


def _machine() -> tuple[str, str]:
    """Return the processor and its features: this machine's, or those requested by numba's variables."""
    name = os.environ.get("NUMBA_CPU_NAME")
    features = os.environ.get("NUMBA_CPU_FEATURES")
    if features is None:
        features = "" if name else llvm.get_host_cpu_features().flatten()
    return name or llvm.get_host_cpu_name(), features


def _new_target() -> Value:
    """Make LLVM's description of the processor to compile for."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = _machine()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=name, features=features, opt=3, reloc="pic", codemodel="jitdefault"
    )


def _made(function: FunctionType, kinds: Sequence[Value]) -> bytes:
    """Make the kernel's object code."""
    with _without_garbage():
        return object_code(program_of(function, kinds).text())


def object_code(text: str) -> bytes:
    """Compile LLVM IR to machine code.

    The SLP vectoriser is off, since it takes as long as all other passes and does not speed up these
    kernels.
    """
    target = _new_target()
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(target.target_data)
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization, options.loop_vectorization = False, True
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(target.emit_object(module))


_ENGINES: list[Value] = []  # loaded code is never released


def _loaded(code: bytes) -> Entry:
    """Load a kernel's object code; return its entry. The engine owns its target."""
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _new_target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    entry = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_char_p)
    return entry(engine.get_function_address("kernel"))


@contextmanager
def _without_garbage() -> Iterator[None]:
    """Pause garbage collection, since a compiler makes very many objects, but little garbage."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
