"""Compiles functions of one run into loops over all runs, which the cores share.

A kernel is a plain Python function over numbers and arrays, with all that it calls, that makes no
arrays; `fuselog.recorders.compiling.kernels` writes it in LLVM's text, in milliseconds. With
FUSELOG_UNCOMPILED=1 all are plain Python, which a debugger can follow: that is the reference.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, lru_cache, wraps
from itertools import pairwise
from types import FunctionType
from typing import ParamSpec, Protocol, TypeVar, cast

import numpy as np

from fuselog.recorders import environment
from fuselog.recorders.compiling.kinds import KernelArgument, RunOnce
from fuselog.recorders.compiling.notices import done_once
from fuselog.recorders.compiling.scratch import Memory, Scratch

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class Loop(Protocol):
    """Represents a compiled loop over runs."""

    def of(
        self, arguments: Sequence[KernelArgument], memory: Memory | None = None
    ) -> Callable[[int, int], None]:
        """Return what goes through the runs from a first one up to an end, with these arguments.

        Their last is the memory, where there is one.
        """
        ...


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function of arrays and numbers, with all that it calls, when it is first called.

    For what Python calls as it stands; inside another kernel it is compiled with the rest. Its arguments
    are given by position; it returns nothing, or one number of the kind that its annotation says.
    Raises BadInput, when called, where a source is not at hand.

    Args:
        function: plain Python over arrays and numbers.

    Returns:
        The function that does the same compiled.
    """

    @cache
    def kernel() -> Callable[Parameters, Result]:
        from fuselog.recorders.compiling.kernels.native import function_of

        return function_of(function)

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        if is_uncompiled():
            with np.errstate(all="ignore"):
                return function(*arguments, **named)
        return kernel()(*arguments, **named)

    return call


def compile_over_runs(run_once: RunOnce, *, title: str = "") -> "OverRuns":
    """Compile a function of one run into a loop over all runs, on all cores.

    Args:
        run_once: `run_once(run, *arguments)` does the work of run number `run` and writes only what
            belongs to that run. It may be a closure over model functions and numbers: that is how it is
            specialised. It may use NumPy and functions that keep to the same, and makes no arrays.
        title: what it is to who waits until it is compiled, such as "ekf of robot".

    Returns `loop(runs, *arguments, scratch=None, per_run=None)`; its results do not depend on the number
    of runs or cores. What `scratch()` returns, made for every core (see `Scratch`), is the last argument
    of `run_once`: arrays that one run after another may work in. Or that is `per_run[run]`, such as the
    run's generator of random numbers; a run for which that is None is left out.
    Raises BadInput where a source is not at hand (a function typed at a prompt, say).

    For finding a fault: with FUSELOG_UNCOMPILED=1 the kernels are plain Python, and an index beyond an
    array is an IndexError; with FUSELOG_BOUNDSCHECK=1 it is one in compiled kernels too.
    """
    title = title or f"{run_once.__module__}.{run_once.__name__}"

    @cache
    def loop() -> Loop:
        from fuselog.recorders.compiling.kernels.native import Kernel

        return Kernel(cast(FunctionType, run_once), title)

    return OverRuns(run_once, loop)


@dataclass(frozen=True)
class OverRuns:
    """Goes through all runs, see `compile_over_runs`.

    Attributes:
        run_once: the work of one run.
        compiled_loop: makes the compiled loop; None for one that is always plain Python.
    """

    run_once: RunOnce
    compiled_loop: Callable[[], Loop] | None = None

    def __call__(
        self,
        runs: int,
        *arguments: KernelArgument,
        scratch: Callable[[], KernelArgument] | None = None,
        per_run: Sequence[KernelArgument] | None = None,
    ) -> None:
        """Go through the runs; in plain Python, too, NaN and infinity raise nothing."""
        if self.compiled_loop is not None and not is_uncompiled():
            with done_once():
                loop = self.compiled_loop()  # imports what it needs
            _share(loop, runs, *arguments, scratch=scratch, per_run=per_run)
            return
        memory = [scratch()] if scratch else []
        with np.errstate(all="ignore"):
            for run in range(runs):
                if per_run is None:
                    self.run_once(run, *arguments, *memory)
                elif per_run[run] is not None:
                    self.run_once(run, *arguments, per_run[run])


def _share(
    loop: Loop,
    runs: int,
    *arguments: KernelArgument,
    scratch: Callable[[], KernelArgument] | None = None,
    per_run: Sequence[KernelArgument] | None = None,
) -> None:
    """Share the runs among the cores."""
    cores, lent = min(runs, core_count()), list[Memory]()

    def prepared() -> Callable[[int, int], None]:
        if per_run is not None:
            return _one_by_one(loop, arguments, per_run)
        if scratch is None:
            return loop.of(arguments)
        lent.append(scratch.lend() if isinstance(scratch, Scratch) else Memory(scratch()))
        return loop.of(arguments, lent[-1])

    if cores <= 1:
        prepared()(0, runs)
    else:
        _on_cores(cores, runs, prepared)
    if isinstance(scratch, Scratch):
        scratch.take_back(lent)


def _one_by_one(
    loop: Loop, arguments: Sequence[KernelArgument], per_run: Sequence[KernelArgument]
) -> Callable[[int, int], None]:
    """Return what goes through the runs with a last argument for each."""
    by_run = {run: loop.of((*arguments, each)) for run, each in enumerate(per_run) if each is not None}

    def through(first: int, end: int) -> None:
        for run in range(first, end):
            if run in by_run:
                by_run[run](run, run + 1)

    return through


def _on_cores(cores: int, runs: int, prepared: Callable[[], Callable[[int, int], None]]) -> None:
    """Go through runs on several cores; in a few pieces per core, since runs differ in length."""

    def work(through: Callable[[int, int], None] | None) -> None:
        through = through or prepared()
        for first, end in waiting:
            through(first, end)

    first = prepared()
    cuts = [runs * piece // (4 * cores) for piece in range(4 * cores + 1)]
    waiting = iter(list(pairwise(cuts)))  # all threads take their next piece from here
    first(0, 0)  # compiles here: a thread would wait for ever for a module that is being imported
    helpers = [_helpers(os.getpid()).submit(work, None) for _ in range(cores - 1)]
    try:
        work(first)
    finally:  # none works on when this returns
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()


def use_cores(count: int) -> None:
    """Have kernels of this process use so many cores."""
    os.environ[environment.CORES] = str(count)
    core_count.cache_clear()
    _helpers.cache_clear()


@cache
def core_count() -> int:
    """Count how many cores kernels use: NUMBA_NUM_THREADS, else those that this process may use."""
    asked = environment.core_count()
    if asked is not None:
        return asked
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@lru_cache(maxsize=1)
def _helpers(process: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """Return the threads beside the calling one; a forked process has none of its parent's."""
    return ThreadPoolExecutor(max(1, core_count() - 1))


def is_uncompiled() -> bool:
    """Tell whether kernels are plain Python now."""
    return environment.is_on(environment.UNCOMPILED)
