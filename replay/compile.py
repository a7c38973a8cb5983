"""Compiles a kernel together with the model functions it is made of, once per source text.

numba finds a kernel in its disk cache only if it is a module-level function, and does not notice that a
function from another file has changed. So the sources of a kernel and of everything it calls are written
as one module into the user's cache folder, named by their hash: a changed model is a new file, a known
one loads in a fraction of a second. Kernels stay plain Python functions that also run uncompiled.
"""

import ast
import hashlib
import importlib.util
import inspect
import os
import sys
import tempfile
import textwrap
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target

from recorders.errors import BadInput


def cache_folder() -> Path:
    """Where fuselog keeps what it can make again: FUSELOG_CACHE, or the user's cache folder."""
    stated = os.environ.get("FUSELOG_CACHE")
    if stated:
        return Path(stated)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "fuselog"


def compile_over_runs(run_once: Callable[..., None], *, allocates: bool = True) -> Callable[..., None]:
    """Compile a function of one run into a loop over all runs, on all cores.

    Args:
        run_once: `run_once(run, *arguments)` does the work of run number `run` and writes only what
            belongs to that run. It may be a closure over model functions and numbers: that is how it is
            specialised. It may use NumPy and functions that keep to the same.
        allocates: whether it makes arrays. A kernel that does not is compiled without the counting of
            references to arrays, and is several times as fast.

    Returns `loop(runs, *arguments, scratch=None)`; its results do not depend on the number of runs or
    cores. What `scratch()` returns, made anew for every core, is the last argument of `run_once`: arrays
    that one run after another may work in.
    Raises BadInput where a source is not at hand (a function typed at a prompt, say).

    For finding a fault: with FUSELOG_UNCOMPILED=1 the kernels are plain Python, and an index beyond an
    array is an IndexError; with FUSELOG_BOUNDSCHECK=1 it is one in compiled kernels too.
    """
    if os.environ.get("FUSELOG_UNCOMPILED") == "1":
        return uncompiled_over_runs(run_once)
    bounds = ", boundscheck=True" if os.environ.get("FUSELOG_BOUNDSCHECK") == "1" else ""
    # a division by zero gives infinity, which is a failure of its run, and no exception
    inner = "error_model='numpy', forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True"
    bundle = _Bundle(f"@numba.njit({inner}, _nrt={allocates}{bounds})")
    kernel = bundle.add("run_once", run_once)
    names = ", ".join(list(inspect.signature(run_once).parameters)[1:])
    text = "\n".join(
        [
            "from __future__ import annotations",
            "import numba",
            *sorted(bundle.imports),
            *bundle.definitions,
            f"@numba.njit(cache=True, nogil=True, _nrt={allocates}{bounds})",
            f"def loop(first, end, {names}):",
            "    for run in range(first, end):",
            f"        {kernel}(run, {names})",
            "",
        ]
    )
    return partial(_over_runs, name=run_once.__name__, loop=_load(text).loop)


def uncompiled_over_runs(run_once: Callable[..., None]) -> Callable[..., None]:
    """What `compile_over_runs` returns, in plain Python; NaN and infinity raise nothing here either."""

    def loop(runs: int, *arguments: Any, scratch: Callable[[], Any] | None = None) -> None:
        memory = [scratch()] if scratch else []
        with np.errstate(all="ignore"):
            for run in range(runs):
                run_once(run, *arguments, *memory)

    return loop


def _over_runs(
    runs: int,
    *arguments: Any,
    scratch: Callable[[], Any] | None = None,
    name: str,
    loop: Callable[..., None],
) -> None:
    """Share the runs among the cores; in a few pieces per core, since runs differ in length."""

    def work(first: int, end: int) -> None:
        loop(first, end, *arguments, *([scratch()] if scratch else []))

    cores = min(runs, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    try:
        if cores > 1:
            work(0, 0)  # compiles here: a thread would wait for ever for a module that is being imported
            cuts = [runs * piece // (4 * cores) for piece in range(4 * cores + 1)]
            with ThreadPoolExecutor(cores) as pool:
                list(pool.map(work, cuts[:-1], cuts[1:]))
        else:
            work(0, runs)
    except NumbaError as error:
        reason = next(line for line in str(error).splitlines() if not line.startswith("Failed in"))
        raise BadInput(
            f"kernel '{name}' does not compile: {reason} "
            "(a kernel that makes arrays is compiled with allocates=True)"
        ) from error


class _Bundle:
    """Sources in the order they are needed, and the imports above them.

    Everything gets a name of its own: two closures of one function, over different models, are two.
    """

    def __init__(self, decorator: str) -> None:
        self._decorator = decorator
        self.imports: set[str] = set()
        self.definitions: list[str] = []
        self._names: dict[Any, str] = {}

    def add(self, name: str, value: Any) -> str:
        """Define a value, called `name` where it is used, and before it what it needs; its own name."""
        value = getattr(value, "py_func", value)  # what numba has compiled is compiled with the rest
        literal = _literal(value)
        origin = getattr(value, "__qualname__", "<locals>")
        if literal is None and "<locals>" in origin and not isinstance(value, FunctionType | ModuleType):
            raise BadInput(
                f"a kernel uses '{name}', a {type(value).__name__}, which is neither function, number "
                "nor tuple, nor can be imported by name: hand it in as an argument"
            )
        key = value if literal is None else (name, literal)
        if key in self._names:
            return self._names[key]
        own = self._names[key] = f"{name}_{len(self._names)}"
        if isinstance(value, FunctionType) and not _is_known_to_numba(value):
            self.definitions.append(f"{self._decorator}\n{self._source(own, value)}")
        elif isinstance(value, ModuleType):
            self.imports.add(f"import {value.__name__} as {own}{_source_hash(value.__name__)}")
        elif literal is not None:
            self.definitions.append(f"{own} = {literal}")
        elif _is_made_here(value):
            self.imports.add("import collections")
            self.definitions.append(f"{own} = collections.namedtuple({own!r}, {value._fields})")
        else:
            module = value.__module__
            self.imports.add(f"from {module} import {origin} as {own}{_source_hash(module)}")
        return own

    def _source(self, own: str, function: FunctionType) -> str:
        closure = inspect.getclosurevars(function)
        needed = {**closure.globals, **closure.nonlocals}
        names = {name: self.add(name, value) for name, value in needed.items()}
        definition = _definition(function)
        definition.name = own
        for node in ast.walk(definition):
            if isinstance(node, ast.Name):
                node.id = names.get(node.id, node.id)
        return ast.unparse(definition)


def _is_made_here(value: Any) -> bool:
    """Whether it is a NamedTuple that was made at run time, which no import by name finds."""
    made = isinstance(value, type) and issubclass(value, tuple) and hasattr(value, "_fields")
    return made and getattr(sys.modules.get(value.__module__), value.__name__, None) is not value


def _is_known_to_numba(function: FunctionType) -> bool:
    """Whether numba has an implementation of its own for it (`numba.extending.overload`)."""
    context = cpu_target.typing_context
    context.refresh()
    try:
        context.resolve_value_type(function)
    except ValueError:
        return False
    return True


def _source_hash(module: str) -> str:
    """A comment that changes with the source of an imported module, and so makes another kernel."""
    try:
        source = inspect.getsource(sys.modules[module])
    except (OSError, TypeError):  # written in C
        return ""
    return f"  # {hashlib.sha256(source.encode()).hexdigest()}"


def _literal(value: Any) -> str | None:
    """A number, text or tuple of these as source; None for anything else."""
    if isinstance(value, float):
        return f"float('{float(value)!r}')"  # infinity and NaN too
    if isinstance(value, tuple):
        entries = [_literal(entry) for entry in value]
        return None if None in entries else f"({''.join(f'{entry}, ' for entry in entries)})"
    return repr(value) if isinstance(value, bool | int | str) else None


def _definition(function: FunctionType) -> ast.FunctionDef:
    """A function's source without its decorators and docstring."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError) as error:
        raise BadInput(
            f"the source of {function.__qualname__} is not at hand ({error}); "
            "define it as a function in a file"
        ) from error
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise BadInput(f"{function.__qualname__} is no `def` function; kernels are made of these")
    definition.decorator_list = []
    if ast.get_docstring(definition) is not None:
        definition.body = definition.body[1:]
    return definition


@lru_cache(maxsize=64)
def _load(text: str) -> ModuleType:
    stamp = f"{numba.__version__} {version('numpy')}"
    name = f"kernel_{hashlib.sha256((stamp + text).encode()).hexdigest()[:24]}"
    try:
        return _imported(name, text, cache_folder() / "kernels")
    except (OSError, RuntimeError):  # numba raises the latter where it finds no folder to write to
        return _imported(name, text, Path(_own_folder().name))


@lru_cache(maxsize=1)
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    """Where this process compiles, for itself alone, if the cache folder cannot be written."""
    return tempfile.TemporaryDirectory(prefix="fuselog-")


def _imported(name: str, text: str, folder: Path) -> ModuleType:
    path = folder / f"{name}.py"
    if not path.exists() or path.read_text() != text:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as part:
            part.write(text)
        Path(part.name).replace(path)
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # numba's cache looks for it there
    specification.loader.exec_module(module)
    return module
