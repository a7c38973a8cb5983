"""Workers for the cells of an experiment: this process, local processes, or a Dask cluster."""

import ctypes
import hashlib
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import cache, partial
from importlib import import_module, resources
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

from fuselog.recorders.compiling.compile import core_count, use_cores
from fuselog.recorders.errors import BadInput, ignore_warnings_of_numbers
from fuselog.recorders.processes import (
    collect_garbage_seldom,
    keep_off_settings_here,
    limit_libraries,
    safe_spawning,
)
from fuselog.recorders.registry import registered
from fuselog.recorders.remote.paths import RemotePath, state_of

# Smallest number of runs for which starting processes saves time.
PAYING_RUNS = 1000
# Parameters of glibc's mallopt.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
PACKAGES = ("fuselog.recorders", "fuselog.replay", "fuselog.pipeline")


class WorkerPool(NamedTuple):
    """An executor and the properties of its workers.

    Attributes:
        executor: the executor that distributes the work.
        workers: number of tasks that run concurrently.
        require: function that raises BadInput unless all workers see the same files at given absolute
            paths as this process does.
        lost: exceptions of a future whose worker has died.
        queued: number of further tasks that are submitted, so that no worker waits for this process.
    """

    executor: Executor
    workers: int
    require: Callable[[Sequence[Path]], None] = lambda _: None  # always true on this machine
    lost: tuple[type[BaseException], ...] = (BrokenExecutor,)
    queued: int = 0


# Opens a pool of workers, and closes it.
PoolFactory = Callable[[], AbstractContextManager[WorkerPool]]


def pool_for(
    workers: int | None, scheduler: str | None, runs: int, executor: Executor | None = None
) -> PoolFactory:
    """Choose the workers for a number of runs: from the options, or all cores if that saves time.

    If an executor is given, it does all the work. Raises BadInput if both `workers` and `scheduler` are
    given without an executor.
    """
    if executor is not None:
        return pool_of(executor)
    if scheduler is not None and workers is not None:
        raise BadInput(
            f"--workers {workers} --scheduler {scheduler}: a scheduler has its own workers; give one "
            "of the two options"
        )
    if scheduler is not None:
        return dask(scheduler)
    if workers is None:
        workers = os.cpu_count() or 1 if runs >= PAYING_RUNS else 1
    return inline_pool if workers == 1 else processes(workers)


def pool_of(executor: Executor) -> PoolFactory:
    """Wrap an existing executor as a pool with one concurrent task per core."""

    @contextmanager
    def begin() -> Iterator[WorkerPool]:
        yield WorkerPool(executor, os.cpu_count() or 1)

    return begin


class InlineExecutor(Executor):
    """An executor that does the work immediately in the calling thread."""

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do the work immediately; the future gets its result or exception. Interrupts are raised."""
        future: Future[Any] = Future()
        try:
            future.set_result(work(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@cache
def keep_freed_memory() -> None:
    """Keep freed memory for new arrays, because the system clears every page before handing it out.

    Only glibc has such settings; arrays above 32 MB, the largest limit that it accepts, are not
    affected.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, 32 << 20)
        mallopt(_TRIM_THRESHOLD, 1 << 30)


@contextmanager
def inline_pool() -> Iterator[WorkerPool]:
    """Open a pool that consists of the calling process, in which a replay uses all cores."""
    yield WorkerPool(InlineExecutor(), 1)


@contextmanager
def threads() -> Iterator[WorkerPool]:
    """Open a pool with a thread for each core that kernels may use, for work with parallel kernels."""
    count = core_count()
    with InlineExecutor() if count == 1 else ThreadPoolExecutor(count) as pool:
        yield WorkerPool(pool, count)


class _Processes(ProcessPoolExecutor):
    """Local processes, which never get interrupts, even while they start and import."""

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit work to a process, and start one if none is idle."""
        with _interrupts_kept_off():
            return super().submit(work, *args, **kwargs)


@contextmanager
def _interrupts_kept_off() -> Iterator[None]:
    """Delay interrupts; a process that is started meanwhile never gets them, even while it imports."""
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def processes(count: int) -> PoolFactory:
    """Make a pool of `count` processes with one core each, which end with this process."""

    @contextmanager
    def begin() -> Iterator[WorkerPool]:
        others = set(active_children())
        with safe_spawning():
            pool = _Processes(count, get_context("spawn"), _begin_worker)
            try:
                yield WorkerPool(pool, count, queued=1)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for worker in set(active_children()) - others:
                    worker.terminate()
                raise
            pool.shutdown(wait=False)  # the processes end while this one goes on

    return begin


@contextmanager
def started(open_pool: PoolFactory) -> Iterator[PoolFactory]:
    """Start workers while this process prepares their work.

    Yields a factory that first gives the pool whose workers were started, and then opens others.
    """
    with ExitStack() as stack:
        pools = [stack.enter_context(open_pool())]
        # if a worker cannot start, the first cell fails with the same error
        with suppress(BrokenExecutor):
            for _ in range(pools[0].workers):
                pools[0].executor.submit(_import_cells)

        @contextmanager
        def begin() -> Iterator[WorkerPool]:
            with stack.pop_all() as now:
                yield pools.pop() if pools else now.enter_context(open_pool())

        yield begin


def _import_cells() -> None:
    """Import what a worker needs to compute a cell."""
    import_module("fuselog.pipeline.runs.campaigns")


def _begin_worker() -> None:
    """Limit a worker to one core, ignore interrupts, and end it when the parent ends."""
    collect_garbage_seldom()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _use_one_core()
    keep_off_settings_here()
    parent = parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    Thread(target=follow, daemon=True).start()


@cache
def _use_one_core() -> None:
    """Limit the kernels and linear algebra of this process to one core, and ignore numeric warnings."""
    use_cores(1)
    limit_libraries()
    ignore_warnings_of_numbers()


class DaskExecutor(Executor):
    """An executor that submits work to a Dask client, whose worker threads use one core each.

    The limit of one core is applied with each task, so it also applies to workers that start later or
    restart.
    """

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(pure=False)

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit work to a worker."""
        future: Future[Any] = self._executor.submit(_on_one_core, work, *args, **kwargs)
        return future


def _on_one_core(work: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Limit this process to one core from now on, and do the work."""
    _use_one_core()
    return work(*args, **kwargs)


def dask(scheduler: str) -> PoolFactory:
    """Make a pool of the workers of a Dask scheduler at an address such as tcp://127.0.0.1:8786.

    `local:N` starts N workers on this machine, which other machines cannot reach. Raises BadInput when
    the pool is opened if no scheduler answers, if its workers have other code, or if Dask is missing.
    """

    @contextmanager
    def begin() -> Iterator[WorkerPool]:
        try:
            from dask import config
            from distributed import Client, KilledWorker
        except ImportError:
            remedy = "pip install 'fuselog[dask]'"
            raise BadInput(f"--scheduler {scheduler}: Dask is not installed; {remedy}") from None
        for name in [each for each in logging.root.manager.loggerDict if each.startswith("distributed")]:
            logging.getLogger(name).setLevel(logging.CRITICAL)  # errors are raised as well
        with ExitStack() as stack:
            address = scheduler
            if scheduler.startswith("local:"):
                stack.enter_context(safe_spawning())
                address = stack.enter_context(_local_cluster(scheduler))
            try:
                client = stack.enter_context(Client(address, timeout=10))
            except (OSError, ValueError) as error:
                raise BadInput(
                    f"--scheduler {scheduler}: no scheduler answers at this address ({error}); start "
                    "one, or give another address"
                ) from None
            _check_code(scheduler, client)
            if scheduler.startswith("local:"):
                client.run(keep_off_settings_here)
            workers = sum(client.nthreads().values())
            stack.enter_context(config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}))
            require = partial(_require_paths, scheduler, client)
            yield WorkerPool(DaskExecutor(client), workers, require, (KilledWorker,), queued=1)

    return begin


def _local_cluster(scheduler: str) -> Any:
    """Start local workers with one thread each."""
    from distributed import LocalCluster

    count = scheduler.removeprefix("local:")
    if not count.isdecimal() or int(count) < 1:
        raise BadInput(f"--scheduler {scheduler}: expected local:N with at least one worker")
    return LocalCluster(
        n_workers=int(count),
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )


def _check_code(scheduler: str, client: Any) -> None:
    """Raise BadInput unless there are workers, all with the same code as this process."""
    try:
        there = client.run(version_of_code)
    except ImportError as error:
        raise BadInput(
            f"--scheduler {scheduler}: fuselog is not installed on its workers ({error}); install it "
            f"there"
        ) from error
    if not there:
        raise BadInput(f"--scheduler {scheduler}: the scheduler has no workers; start some")
    for worker, found in there.items():
        if found != version_of_code():
            raise BadInput(
                f"--scheduler {scheduler}: worker {worker} has another version of the code; install "
                "the same version there"
            )


def _require_paths(scheduler: str, client: Any, paths: Sequence[Path]) -> None:
    """Raise BadInput unless all workers see files and folders as this process does."""
    for worker, found in client.run(states_of, paths).items():
        for path, own, there in zip(paths, states_of(paths), found, strict=True):
            if there != own:
                how = "cannot read" if there is None else "has another"
                raise BadInput(
                    f"--scheduler {scheduler}: worker {worker} {how} {path}; put logs and --out on a "
                    "disk that all workers share, under the same paths, or leave out --scheduler"
                )


def states_of(paths: Sequence[Path]) -> list[tuple[int, int, str] | None]:
    """Return the states of files, zeros for folders, and None for unreadable paths; see `state_of`."""
    found: list[tuple[int, int, str] | None] = []
    for path in paths:
        try:
            state = (0, 0, "") if path.is_dir() else state_of(path)
        except (BadInput, OSError):
            found.append(None)
            continue
        is_readable = isinstance(path, RemotePath) or os.access(path, os.R_OK)
        found.append(state if is_readable else None)
    return found


@cache
def version_of_code() -> str:
    """Hash everything that determines the results of cells: our code, plug-ins, library versions."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        with resources.as_file(resources.files(package)) as folder:
            _add_sources(digest, folder)
    modules = {entry.module.partition(".")[0] for entry in registered()} - {"fuselog"}
    for spec in filter(None, map(find_spec, sorted(modules))):
        for place in spec.submodule_search_locations or ():
            _add_sources(digest, Path(place))
        if spec.origin and not spec.submodule_search_locations:
            digest.update(Path(spec.origin).read_bytes())
    libraries = filter(find_spec, ("numpy", "scipy", "llvmlite", "numba"))
    digest.update(" ".join(map(version, libraries)).encode())
    return digest.hexdigest()


def _add_sources(digest: "hashlib._Hash", folder: Path) -> None:
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
