"""Keeps numba's kernels on disk: each is loaded, or compiled once by one process.

The key of a kernel is its source text, the versions of Python, numba and NumPy, the types of its
arguments and the processor, and how numba is used, the text of `inlining` and `through_numba`. Our own
compiler's kernels are kept by `kernels.native`.
"""

import __future__

import gc
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, lru_cache, partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numba
from numba.core import errors, types
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.serialize import dumps

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.compiling.cache import (
    cache_folder,
    in_turn,
    is_private,
    read_checked,
    say_once,
    write_checked,
)
from fuselog.replay.engine.compiling.kinds import KernelFunction, OfNumba
from fuselog.replay.engine.compiling.notices import compiling, done_once

# In place of the colours in which numba sets its error messages.
_COLOURLESS = SimpleNamespace(
    **dict.fromkeys(("code", "errmsg", "filename", "highlight", "indicate", "reset"), str)
)


@lru_cache(maxsize=64)
def load(text: str, title: str) -> KernelFunction:
    """Make the function `kernel` of a module with this text; `title` is what to call it to a user.

    Args:
        text: the source, in which `kernel` stands.
        title: see above.
    """
    name = f"kernel_{sha256((_versions() + text).encode()).hexdigest()[:24]}"
    module = ModuleType(name)
    sys.modules[name] = module  # compiled code that was kept looks for it there
    execute(text, name, module)
    if not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        module.kernel._cache = code = _CompiledCode(name, title)
        module.kernel.compile = partial(code.compile, module.kernel.compile)
    kernel: KernelFunction = module.kernel
    return kernel


@cache
def _versions() -> str:
    """Name what a kernel is made with: Python, NumPy, numba, and how numba is used."""
    files = [Path(__file__).with_name(name) for name in ("inlining.py", "through_numba.py")]
    how = sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]
    return f"{sys.implementation.cache_tag} numba {numba.__version__} {how} numpy {version('numpy')}"


def execute(source: str, name: str, module: ModuleType) -> None:
    """Define what a source defines in a module; `name` is its file in tracebacks.

    Args:
        source: Python's text.
        name: see above.
        module: in which it is defined.
    """
    exec(compile(source, name, "exec", __future__.annotations.compiler_flag), vars(module))


class _CompiledCode:
    """Keeps the compiled code of one kernel, in the place of numba's own cache.

    A file is checked before it is executed. Nothing about the disk stops the work: what cannot be loaded
    is compiled anew and replaced.
    """

    cache_path = None

    def __init__(self, name: str, title: str) -> None:
        self._name = name
        self._title = title
        # what holds while it is compiled
        self._meanwhile = ExitStack()

    def compile(self, by_numba: Callable[[OfNumba], OfNumba], signature: OfNumba) -> OfNumba:
        """Load or compile the kernel for these types of arguments; numba asks the methods below."""
        with done_once(), global_compiler_lock, self._meanwhile:
            return by_numba(signature)

    def load_overload(self, signature: OfNumba, target: OfNumba) -> CompileResult | None:
        """Return the code, or None: it is compiled then, which is said where it takes long.

        Of several processes that want it one compiles, and the others load what that one has kept.
        """
        target.refresh()  # numba's own cache says: "to ensure it is initialized"
        path = self._path(signature, target)
        if path is None or not is_private(path.parent):
            self._meanwhile.enter_context(_compiling(self._title))
            return None
        found = _loaded(path, target)
        if found is None:
            self._meanwhile.enter_context(_compiling(self._title))
            if self._meanwhile.enter_context(in_turn(path)):
                found = _loaded(path, target)
        return found

    def save_overload(self, signature: OfNumba, result: OfNumba) -> None:
        """Keep the code."""
        path = self._path(signature, result.target_context)
        # an address in the code is worth nothing in another process
        if path is None or result.library.has_dynamic_globals or not is_private(path.parent):
            return
        try:
            write_checked(path, dumps((path.name, result._reduce())), "a kernel that fuselog compiled")
        except BadInput as error:
            why = str(error).removeprefix(f"{path}: ")
            say_once(f"the cache {path.parent} {why}: what is compiled now is not kept")

    def _path(self, signature: OfNumba, target: OfNumba) -> Path | None:
        """Return the file for one processor and these types of arguments."""
        key = "\n".join([*map(str, target.codegen().magic_tuple()), *map(_described, signature)])
        try:
            folder = cache_folder()
        except RuntimeError:  # a user without a home
            return None
        return folder / "kernels" / f"{self._name}-{sha256(key.encode()).hexdigest()[:24]}.bin"


def _loaded(path: Path, target: OfNumba) -> CompileResult | None:
    content = read_checked(path)
    if content is None:
        return None
    try:
        name, parts = pickle.loads(content)
        return CompileResult._rebuild(target, *parts) if name == path.name else None
    except Exception:  # whatever a file of other versions, or of a class that has moved, leads to
        return None


@contextmanager
def _compiling(title: str) -> Iterator[None]:
    """Say that a kernel is compiled, where that takes long, and do meanwhile what makes that shorter.

    A compiler makes very many objects and little garbage; looking for that takes a seventh of its time.
    numba makes an error of every type that does not fit and tries the next; colours of these, which are
    there where colorama is installed, take a thirtieth.
    """
    collecting = gc.isenabled()
    colours = errors._termcolor_inst  # type: ignore[attr-defined]
    gc.disable()
    errors._termcolor_inst = _COLOURLESS  # type: ignore[attr-defined]
    try:
        with compiling(title):
            yield
    finally:
        errors._termcolor_inst = colours  # type: ignore[attr-defined]
        if collecting:
            gc.enable()


def _described(kind: OfNumba) -> str:
    """Describe a type by its name, and the fields of a named tuple, which numba knows by its class."""
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    entries = ", ".join(map(_described, kind.types))  # type: ignore[attr-defined]
    return f"{getattr(kind, 'instance_class', tuple)} {getattr(kind, 'fields', '')} ({entries})"
