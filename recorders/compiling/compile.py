"""Compilation of functions that process one run into loops over all runs, shared among the cores.

A kernel is a plain Python function of numbers and arrays, together with all functions that it calls. It
creates no arrays. `fuselog.recorders.compiling.kernels` translates it to LLVM IR in milliseconds. With
FUSELOG_UNCOMPILED=1, kernels run as plain Python: a debugger can step through them, and their results
are the reference for compiled code.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial, wraps
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
    """A compiled loop over runs."""

    def of(
        self, arguments: Sequence[KernelArgument], memory: Memory | None = None
    ) -> Callable[[int, int], None]:
        """Return a function that processes the runs from a first one up to an end.

        If `memory` is given, it is passed as the last argument of the compiled function.
        """
        ...


def compiled(
    function: Callable[Parameters, Result], *, for_sizes: bool = False
) -> Callable[Parameters, Result]:
    """Compile a function of arrays and numbers, with all functions that it calls, at its first call.

    Use this for a function that Python calls directly. If a kernel calls the function, it is compiled
    together with that kernel.

    Arguments are positional; the function returns nothing, or one number of the annotated kind. A call
    raises BadInput if the source of a function is not available.

    Args:
        function: plain Python function of arrays and numbers.
        for_sizes: whether the code is specialised for the sizes of all axes but the first; loops over
            small matrices are then faster, but other sizes are compiled separately. The number of rows
            of data therefore has to be the size of a first axis.

    Returns:
        The compiled function.
    """

    @cache
    def kernel() -> Callable[Parameters, Result]:
        from fuselog.recorders.compiling.kernels.native import function_of

        return function_of(function, for_sizes=for_sizes)

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        if is_uncompiled():
            with np.errstate(all="ignore"):
                return function(*arguments, **named)
        return kernel()(*arguments, **named)

    return call


def compile_over_runs(run_once: RunOnce, *, title: str = "") -> "OverRuns":
    """Compile a function that processes one run into a loop over all runs, on all cores.

    Args:
        run_once: function `run_once(run, *arguments)` that processes run number `run` and writes only to
            the elements of that run. If it is a closure over model functions and numbers, the compiled
            code is specialised for them. It may use NumPy and call functions with the same restrictions;
            it must not create arrays.
        title: name in notices during compilation, such as "ekf of robot".

    Returns `loop(runs, *arguments, scratch=None, per_run=None)`, whose results do not depend on the
    number of runs or cores. With `scratch`, the last argument of `run_once` is working memory for
    successive runs, which `scratch()` makes once per core (see `Scratch`). With `per_run`, it is
    `per_run[run]`, such as the run's random generator; runs are skipped if this is None. Raises
    BadInput if the source of a function is not available, as for a function typed at a prompt.

    For debugging: with FUSELOG_UNCOMPILED=1, kernels are plain Python, where an index out of bounds
    raises IndexError; with FUSELOG_BOUNDSCHECK=1, compiled kernels raise it too.
    """
    title = title or f"{run_once.__module__}.{run_once.__name__}"

    def loop() -> Loop:
        from fuselog.recorders.compiling.kernels.native import Kernel

        return Kernel(cast(FunctionType, run_once), title)

    return OverRuns(run_once, loop)


@dataclass(frozen=True)
class OverRuns:
    """A loop over all runs, see `compile_over_runs`.

    Attributes:
        run_once: function that processes one run.
        make_loop: function that makes the compiled loop; None if the loop is always plain Python.
    """

    run_once: RunOnce
    make_loop: Callable[[], Loop] | None = None

    @cached_property
    def compiled_loop(self) -> Loop:
        """The compiled loop, made at first use, which may import modules."""
        assert self.make_loop is not None
        with done_once():
            return self.make_loop()

    def __call__(
        self,
        runs: int,
        *arguments: KernelArgument,
        scratch: Callable[[], KernelArgument] | None = None,
        per_run: Sequence[KernelArgument] | None = None,
    ) -> None:
        """Process all runs; NaN and infinity cause no warnings or errors, even in plain Python."""
        if self.make_loop is not None and not is_uncompiled():
            _share(self.compiled_loop, runs, *arguments, scratch=scratch, per_run=per_run)
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
    lent: list[Memory] = []
    cores = min(runs, core_count())
    if cores <= 1:
        _prepared(loop, arguments, scratch, per_run, lent)(0, runs)
    else:
        _on_cores(cores, runs, partial(_prepared, loop, arguments, scratch, per_run, lent))
    if isinstance(scratch, Scratch):
        scratch.take_back(lent)


def _prepared(
    loop: Loop,
    arguments: Sequence[KernelArgument],
    scratch: Callable[[], KernelArgument] | None,
    per_run: Sequence[KernelArgument] | None,
    lent: list[Memory],
) -> Callable[[int, int], None]:
    """Return a function that processes runs on one core; its working memory is added to `lent`."""
    if per_run is not None:
        return _one_by_one(loop, arguments, per_run)
    if scratch is None:
        return loop.of(arguments)
    memory = scratch.lend() if isinstance(scratch, Scratch) else Memory(scratch())
    lent.append(memory)
    return loop.of(arguments, memory)


def _one_by_one(
    loop: Loop, arguments: Sequence[KernelArgument], per_run: Sequence[KernelArgument]
) -> Callable[[int, int], None]:
    """Return a function that processes runs, in which the last argument has a separate value per run."""
    by_run = {run: loop.of((*arguments, each)) for run, each in enumerate(per_run) if each is not None}

    def through(first: int, end: int) -> None:
        for run in range(first, end):
            if run in by_run:
                by_run[run](run, run + 1)

    return through


def _on_cores(cores: int, runs: int, prepared: Callable[[], Callable[[int, int], None]]) -> None:
    """Process runs on several cores, in a few pieces per core, since runs take different times."""

    def work(through: Callable[[int, int], None] | None) -> None:
        through = through or prepared()
        for first, end in waiting:
            through(first, end)

    first = prepared()
    cuts = [runs * piece // (4 * cores) for piece in range(4 * cores + 1)]
    waiting = iter(list(pairwise(cuts)))  # all threads take their next piece from here
    first(0, 0)  # compile in this thread: others would deadlock on a module that is being imported
    helpers = [_helpers(os.getpid()).submit(work, None) for _ in range(cores - 1)]
    try:
        work(first)
    finally:  # no thread may still be running when this function returns
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()


def use_cores(count: int) -> None:
    """Set the number of cores that kernels of this process use."""
    os.environ[environment.CORES] = str(count)
    core_count.cache_clear()
    _helpers.cache_clear()


@cache
def core_count() -> int:
    """Return the number of cores for kernels: NUMBA_NUM_THREADS, or the number available."""
    asked = environment.core_count()
    if asked is not None:
        return asked
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@lru_cache(maxsize=1)
def _helpers(process: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """Make the additional worker threads; a forked process gets its own."""
    return ThreadPoolExecutor(max(1, core_count() - 1))


def is_uncompiled() -> bool:
    """Test whether kernels are currently plain Python."""
    return environment.is_on(environment.UNCOMPILED)
