"""Compiles kernels that make arrays through numba, with all that they call, once per source text.

numba's own disk cache finds module-level functions only, does not notice that a function from another
file has changed, and stops on a damaged file. So the sources of a kernel and of everything it calls
become one module, whose compiled code is kept in the user's cache under the hash of that text: a changed
function is a new file, a known one loads in a fraction of a second.

`kernel_source` gathers sources, `inlining` compiles the inner functions, `kernel_cache` keeps code.
"""

import collections
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from types import ModuleType

import numba
import numpy as np
from numba.core.errors import NumbaError

from fuselog.replay.engine.compiling.inlining import Inlined
from fuselog.replay.engine.compiling.kernel_cache import execute, load
from fuselog.replay.engine.compiling.kernel_source import DoesNotCompile, KernelSource
from fuselog.replay.engine.compiling.kinds import KernelFunction, RunOnce, Value
from fuselog.replay.engine.compiling.scratch import Memory

# Where what kernels are made of is defined, each once; compiled code that was kept looks for it there.
_PARTS = sys.modules.setdefault("kernel_parts", ModuleType("kernel_parts"))
vars(_PARTS).update(collections=collections, numba=numba, numpy=np, Inlined=Inlined)


def function_of(function: KernelFunction) -> KernelFunction:
    """Make a function as numba compiles it."""
    source = KernelSource()
    name = source.add(function.__name__, function)
    names = ", ".join(inspect.signature(function).parameters)
    text = f"def kernel({names}):\n    return {name}({names})"
    return _compile(source, name, text, f"{function.__module__}.{function.__name__}")


class _Loop:
    """Represents a function of one run as a loop over runs."""

    def __init__(self, run_once: RunOnce, title: str = "") -> None:
        source = KernelSource()
        kernel = source.add("run_once", run_once)
        names = ", ".join(list(inspect.signature(run_once).parameters)[1:])
        text = (
            f"def kernel(first, end, {names}):\n"
            "    for run in range(first, end):\n"
            f"        {kernel}(run, {names})"
        )
        self._name, self._places = run_once.__name__, source.places
        title = title or f"{run_once.__module__}.{run_once.__name__}"
        self._loop = _compile(source, kernel, text, title)

    def of(self, arguments: Sequence[Value], memory: Memory | None = None) -> Callable[[int, int], None]:
        """Make the loop for these arguments."""
        everything = arguments if memory is None else (*arguments, memory.value)

        def through(first: int, end: int) -> None:
            try:
                self._loop(first, end, *everything)
            except NumbaError as error:
                raise self._explained(error) from error

        return through

    def _explained(self, error: NumbaError) -> DoesNotCompile:
        text = re.sub(r"\x1b\[\d*m", "", str(error))  # bold where colorama is installed
        reason = next(line for line in text.splitlines() if not line.startswith("Failed in"))
        reason = re.sub(r",? ?(defined )?at \w+_[0-9a-f]{16} \(\d+\)", "", reason)
        line = re.search(r'File "(\w+_[0-9a-f]{16})", line (\d+)', text)
        place = self._places.get((line[1], int(line[2])), "") if line else ""
        return DoesNotCompile(f"kernel '{self._name}' does not compile: {reason}{place}")


loop_of = _Loop


def _compile(source: KernelSource, called: str, definition: str, title: str) -> KernelFunction:
    """Make the function `kernel` that calls one of a source; `title` names it."""
    for name, defined in source.definitions.items():
        if name not in vars(_PARTS):
            execute(defined, name, _PARTS)
    needed = f"import numba\nfrom {_PARTS.__name__} import {called}"
    text = f"{needed}\n@numba.njit(nogil=True, {source.options})\n{definition}\n"
    return load(text, title)
