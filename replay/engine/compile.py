"""Compiles a kernel together with the model functions it is made of, once per source text.

numba's own disk cache finds module-level functions only, does not notice that a function from another
file has changed, and stops on a damaged file. So the sources of a kernel and of everything it calls
become one module, whose compiled code is kept in the user's cache under the hash of that text: a changed
model is a new file, a known one loads in a fraction of a second. Kernels stay plain Python functions,
which also run uncompiled.

`bundling` gathers sources, `inlining` compiles the inner functions, `keeping` keeps compiled code. numba
takes long to import: only what compiles or loads a kernel does.
"""

import collections
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, lru_cache, partial, wraps
from itertools import pairwise
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

import numpy as np

from replay.engine.bundling import Bundle, DoesNotCompile

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function of arrays and numbers, with all that it calls, when it is first called.

    For what Python calls as it stands; inside another kernel it is compiled with the rest. Its arguments
    are given by position. Raises BadInput, when called, where a source is not at hand.
    """

    @cache
    def kernel() -> Callable[Parameters, Result]:
        if _is_uncompiled():
            return np.errstate(all="ignore")(function)
        bundle = Bundle()
        name = bundle.add(function.__name__, function)
        names = ", ".join(inspect.signature(function).parameters)
        text = f"def kernel({names}):\n    return {name}({names})"
        return _compile(bundle, name, text, function)

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        return kernel()(*arguments, **named)

    return call


def compile_over_runs(run_once: Callable[..., None], *, allocates: bool = True) -> Callable[..., None]:
    """Compile a function of one run into a loop over all runs, on all cores.

    Args:
        run_once: `run_once(run, *arguments)` does the work of run number `run` and writes only what
            belongs to that run. It may be a closure over model functions and numbers: that is how it is
            specialised. It may use NumPy and functions that keep to the same.
        allocates: whether it makes arrays. A kernel that does not is compiled without the counting of
            references to arrays, and is several times as fast.

    Returns `loop(runs, *arguments, scratch=None, own=None)`; its results do not depend on the number of
    runs or cores. What `scratch()` returns, made anew for every core, is the last argument of
    `run_once`: arrays that one run after another may work in. Or that is `own[run]`, such as the run's
    generator of random numbers; a run whose own is None is left out.
    Raises BadInput where a source is not at hand (a function typed at a prompt, say).

    For finding a fault: with FUSELOG_UNCOMPILED=1 the kernels are plain Python, and an index beyond an
    array is an IndexError; with FUSELOG_BOUNDSCHECK=1 it is one in compiled kernels too.
    """
    if _is_uncompiled():
        return uncompiled_over_runs(run_once)
    bundle = Bundle(allocates)
    kernel = bundle.add("run_once", run_once)
    names = ", ".join(list(inspect.signature(run_once).parameters)[1:])
    loop = _compile(
        bundle,
        kernel,
        f"def kernel(first, end, {names}):\n"
        "    for run in range(first, end):\n"
        f"        {kernel}(run, {names})",
        run_once,
    )
    hint = "" if allocates else " (a kernel that makes arrays is compiled with allocates=True)"
    return partial(_over_runs, name=run_once.__name__, loop=loop, places=bundle.places, hint=hint)


def uncompiled_over_runs(run_once: Callable[..., None]) -> Callable[..., None]:
    """What `compile_over_runs` returns, in plain Python; NaN and infinity raise nothing here either."""

    def loop(
        runs: int,
        *arguments: Any,
        scratch: Callable[[], Any] | None = None,
        own: Sequence[Any] | None = None,
    ) -> None:
        memory = [scratch()] if scratch else []
        with np.errstate(all="ignore"):
            for run in range(runs):
                if own is None:
                    run_once(run, *arguments, *memory)
                elif own[run] is not None:
                    run_once(run, *arguments, own[run])

    return loop


def _over_runs(
    runs: int,
    *arguments: Any,
    scratch: Callable[[], Any] | None = None,
    own: Sequence[Any] | None = None,
    name: str,
    loop: Callable[..., None],
    places: Mapping[tuple[str, int], str],
    hint: str,
) -> None:
    """Share the runs among the cores; in a few pieces per core, since runs differ in length."""
    import numba

    def work(pieces: Iterable[tuple[int, int]]) -> None:
        memory = [scratch()] if scratch else []
        for first, end in pieces:
            if own is None:
                loop(first, end, *arguments, *memory)
                continue
            for run in range(first, end):
                if own[run] is not None:
                    loop(run, run + 1, *arguments, own[run])

    cores = min(runs, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    try:
        if cores <= 1:
            work([(0, runs)])
            return
        # compiles here: a thread would wait for ever for a module that is being imported
        last = [scratch()] if scratch else [each for each in own or () if each is not None][:1]
        if own is None or last:
            loop(0, 0, *arguments, *last)
        cuts = [runs * piece // (4 * cores) for piece in range(4 * cores + 1)]
        waiting = iter(list(pairwise(cuts)))  # all threads take their next piece from here
        helpers = [_helpers(os.getpid()).submit(work, waiting) for _ in range(cores - 1)]
        try:
            work(waiting)
        finally:  # none works on when this returns
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
        for helper in begun:
            helper.result()
    except numba.core.errors.NumbaError as error:
        said = re.sub(r"\x1b\[\d*m", "", str(error))  # bold where colorama is installed
        reason = next(line for line in said.splitlines() if not line.startswith("Failed in"))
        reason = re.sub(r",? ?(defined )?at \w+_[0-9a-f]{16} \(\d+\)", "", reason)
        line = re.search(r'File "(\w+_[0-9a-f]{16})", line (\d+)', said)
        place = places.get((line[1], int(line[2])), "") if line else ""
        raise DoesNotCompile(f"kernel '{name}' does not compile: {reason}{place}{hint}") from error


@lru_cache(maxsize=1)
def _helpers(process: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """The threads beside the calling one; a forked process has none of its parent's."""
    import numba

    return ThreadPoolExecutor(max(1, numba.config.NUMBA_NUM_THREADS - 1))  # type: ignore[attr-defined]


def _is_uncompiled() -> bool:
    return os.environ.get("FUSELOG_UNCOMPILED") == "1"


def _compile(
    bundle: Bundle, called: str, definition: str, function: Callable[..., Any]
) -> Callable[..., Any]:
    """The function `kernel` that calls one that a bundle holds, which is made of `function`."""
    from replay.engine.keeping import execute, load

    parts = _parts()
    for own, source in bundle.definitions.items():
        if own not in vars(parts):
            execute(source, own, parts)
    needed = f"import numba\nfrom {parts.__name__} import {called}"
    text = f"{needed}\n@numba.njit(nogil=True, {bundle.options})\n{definition}\n"
    return load(text, f"{function.__module__}.{function.__name__}")


@cache
def _parts() -> ModuleType:
    """Where what kernels are made of is defined, each once; compiled code that was kept looks there."""
    import numba

    from replay.engine.inlining import Inlined

    parts = sys.modules.setdefault("kernel_parts", ModuleType("kernel_parts"))
    vars(parts).update(collections=collections, numba=numba, numpy=np, Inlined=Inlined)
    return parts
