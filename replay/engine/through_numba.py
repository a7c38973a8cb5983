"""Compilation by numba of recursions that create arrays, including all functions that they call.

numba caches compiled functions (`numba.njit(cache=True)`) but checks only the file of the function
itself for changes. The name of a cached kernel therefore contains a digest of everything it depends on:
its code and the code of all functions that it calls, the constants, and the fields of the named tuples
among its arguments.
"""

import dis
import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from types import CellType, CodeType, FunctionType
from typing import cast

import numpy as np

from fuselog.recorders import environment
from fuselog.recorders.compiling.cache import say_once
from fuselog.recorders.compiling.compile import OverRuns
from fuselog.recorders.compiling.identity import OF_PYTHON, identity
from fuselog.recorders.compiling.kernels.program import DoesNotCompile
from fuselog.recorders.compiling.kinds import KernelFunction, RunOnce, Value
from fuselog.recorders.compiling.notices import compiling
from fuselog.recorders.compiling.scratch import Memory

# One instruction of Python's byte code: its name, its argument, its line.
_Step = tuple[str, Value, int | None]
# Compiler options of functions that only kernels call.
_INNER: dict[str, Value] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def numba_over_runs(run_once: RunOnce, title: str = "") -> OverRuns:
    """Make a compiled loop over all runs, on all cores, from a function of one run that creates arrays.

    Arguments and result are the same as for `compile_over_runs`. The loop raises BadInput when it is
    called, if numba is not installed or cannot compile the function.
    """
    title = title or f"{run_once.__module__}.{run_once.__name__}"
    return OverRuns(run_once, lambda: _Loop(cast(FunctionType, run_once), title))


class _Loop:
    """Loop of a function over runs, with one kernel for each combination of argument types."""

    def __init__(self, run_once: FunctionType, title: str) -> None:
        try:
            import numba
        except ImportError as error:
            raise DoesNotCompile(
                f"{run_once.__qualname__} is compiled by numba, which cannot be imported ({error}); "
                "pip install 'fuselog[numba]', or set allocates=False if it creates no arrays"
            ) from error
        bounds = environment.is_on(environment.BOUNDSCHECK)
        # a division by zero gives infinity, which fails the run, instead of an exception
        self._options: dict[str, Value] = {"error_model": "numpy", "nogil": True, "boundscheck": bounds}
        self._njit = numba.njit
        self._function, self._title = run_once, title
        self._kernels: dict[Value, KernelFunction] = {}
        self._known: dict[FunctionType, Value] = {}
        self._called = self._compiled(run_once)

    def of(self, arguments: Sequence[Value], memory: Memory | None = None) -> Callable[[int, int], None]:
        """Make the loop for these arguments."""
        everything = tuple(arguments) if memory is None else (*arguments, memory.value)
        kinds: list[Value] = []
        given: list[Value] = []
        _take_apart(everything, kinds, given)
        key, leaves = tuple(kinds), tuple(given)
        if key not in self._kernels:
            self._kernels[key] = self._kernel(everything, leaves)
        kernel = self._kernels[key]
        return lambda first, end: kernel(first, end, leaves)

    def _kernel(self, everything: tuple[Value, ...], leaves: tuple[Value, ...]) -> KernelFunction:
        """Load or compile the loop with flattened arguments, whose types numba can infer."""
        scope: dict[str, Value] = {"__name__": __name__, "run_once": self._called}
        text = (
            "def kernel(first, end, leaves):\n"
            "    for run in range(first, end):\n"
            f"        run_once(run, *{_put_together(everything, iter(range(len(leaves))), scope)})"
        )
        exec(compile(text, __file__, "exec"), scope)
        kernel = scope.pop("kernel")
        fields = [f"{name} {getattr(value, '_fields', '')}" for name, value in scope.items()]
        made_of = [identity(self._function), text, *fields, str(self._options), np.__version__]
        digest = sha256("\n".join(made_of).encode()).hexdigest()[:24]
        kernel.__qualname__ = f"{self._function.__name__}-{digest}"
        with compiling(self._title):
            return self._first_called(kernel, leaves, is_kept=True)

    def _first_called(self, kernel: FunctionType, leaves: Value, *, is_kept: bool) -> KernelFunction:
        """Compile or load the kernel for the types of these arguments, without processing a run."""
        from numba.core.errors import NumbaError

        try:
            made: KernelFunction = self._njit(kernel, cache=is_kept, **self._options)
            made(0, 0, leaves)
        except NumbaError as error:
            raise self._explained(error) from error
        except Exception as error:  # no folder for the cache, a full disk, a damaged file
            if not is_kept:
                raise
            say_once(
                f"numba's cache cannot be used ({error}): {self._title} is compiled in every process"
            )
            return self._first_called(kernel, leaves, is_kept=False)
        return made

    def _compiled(self, function: FunctionType) -> Value:
        """Compile a function with numba, together with all functions that it calls."""
        if function in self._known:
            return self._known[function]
        code, scope = function.__code__, dict(function.__globals__)
        cells = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
        steps = list(_steps(code))
        named = {name for operation, name, _ in steps if operation == "LOAD_GLOBAL"}
        outside = {name: scope[name] for name in named & scope.keys()}
        outside |= {name: cell.cell_contents for name, cell in cells.items()}
        _refuse_random(function, steps, outside)
        closure = tuple(CellType() for _ in cells)
        own = FunctionType(code, scope, function.__name__, function.__defaults__, closure)
        own.__kwdefaults__, own.__qualname__ = function.__kwdefaults__, function.__qualname__
        self._known[function] = self._njit(own, **_INNER, **self._options)
        called = {name: self._usable(name, value) for name, value in outside.items()}
        scope.update(called)
        for name, cell in zip(cells, closure, strict=True):
            cell.cell_contents = called[name]
        return self._known[function]

    def _usable(self, name: str, value: Value) -> Value:
        """Return the value of a name that a kernel uses, in a form that numba accepts."""
        if isinstance(value, np.ndarray) and value.flags.writeable:
            raise DoesNotCompile(
                f"{self._function.__qualname__} uses the array '{name}', which could change: pass it as "
                "an argument"
            )
        if str(getattr(value, "__module__", "")).partition(".")[0] in OF_PYTHON:
            return value
        function = inspect.unwrap(
            value
        )  # a function that is already compiled is compiled again with the rest
        return self._compiled(function) if isinstance(function, FunctionType) else value

    def _explained(self, error: Exception) -> DoesNotCompile:
        text = re.sub(r"\x1b\[\d*m", "", str(error))  # bold where colorama is installed
        reason = next(line for line in text.splitlines() if not line.startswith("Failed in"))
        found = re.findall(r'File "(.+)", line (\d+)', text)
        places = [(str(Path(file).absolute()), line) for file, line in found]
        place = next((f" ({file}, line {line})" for file, line in places if file != __file__), "")
        return DoesNotCompile(f"kernel '{self._function.__name__}' does not compile: {reason}{place}")


def _take_apart(value: Value, kinds: list[Value], leaves: list[Value]) -> None:
    """Append the arrays and numbers of an argument to `leaves`, and their types to `kinds`."""
    if isinstance(value, tuple):
        kinds.append((type(value), len(value)))
        for each in value:
            _take_apart(each, kinds, leaves)
    else:
        is_array = isinstance(value, np.ndarray)
        kinds.append((value.dtype, value.ndim, value.flags.num) if is_array else type(value))
        leaves.append(value)


def _put_together(value: Value, places: Iterator[int], scope: dict[str, Value]) -> str:
    """Write the expression that rebuilds an argument from `leaves`; put named tuples in `scope`."""
    if not isinstance(value, tuple):
        return f"leaves[{next(places)}]"
    parts = "".join(f"{_put_together(each, places, scope)}, " for each in value)
    if not hasattr(value, "_fields"):
        return f"({parts})"
    name = f"{type(value).__name__}_{len(scope)}"
    scope[name] = type(value)
    return f"{name}({parts})"


def _steps(code: CodeType) -> Iterator[_Step]:
    """Yield the instructions of a function, followed by those of its nested functions."""
    for each in dis.get_instructions(code):
        yield each.opname, each.argval, each.positions.lineno if each.positions else None
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _steps(constant)


def _refuse_random(function: FunctionType, steps: Sequence[_Step], outside: Mapping[str, Value]) -> None:
    """Raise DoesNotCompile if a function draws from NumPy's global generator, which all runs share."""
    for (_, before, _), (_, name, line) in pairwise(steps):
        used = outside.get(name)
        is_module = name == "random" and outside.get(before) is np
        if is_module or used is np.random or getattr(used, "__self__", None) is np.random.mtrand._rand:
            place = f"{function.__code__.co_filename}, line {line}"
            raise DoesNotCompile(
                f"{function.__qualname__} uses np.random ({place}), so its numbers would depend on how "
                "runs are distributed over cores; use the generator that it is given with draws=True"
            )
