"""Runs filters in processes of their own: a crash, a loop or a leak ends one run, with its reason."""

import atexit
import json
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import psutil

from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.compiling.compile import core_count
from fuselog.recorders.errors import BadInput
from fuselog.recorders.processes import start_module
from fuselog.replay.engine.streams.blocks import copied
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.foreign.description import Description, ForeignParameters
from fuselog.replay.foreign.native.following import Followed, followed, offsets_of, reason_of_code
from fuselog.replay.foreign.native.library import Library
from fuselog.replay.foreign.processes.orphans import GUARD, family, kill_family
from fuselog.replay.foreign.processes.tasks import LOADING, RunGiven, follow_given, mapped, sizes_of
from fuselog.replay.foreign.processes.worker import IDLE
from fuselog.replay.foreign.results import begun, results

Given = TypeVar("Given")
Found = TypeVar("Found")
LOOKS_S = 0.02  # how often a process is looked at
STARTS_S = 60.0  # how long one may take to begin: it imports and compiles


class Ended(Exception):
    """Says why a process ended, or was ended, before it was done."""


class Limits(NamedTuple):
    """Holds how long one message may take, and how much memory a process."""

    time_s: float
    memory_mb: float

    @classmethod
    def of(cls, parameters: ForeignParameters) -> "Limits":
        """Return those of an estimator."""
        return cls(parameters.time_limit_s, parameters.memory_limit_mb)


class Watch:
    """Watches a process at work: whether it goes on, and what memory it takes."""

    def __init__(self, process: psutil.Process, limits: Limits) -> None:
        self._process, self._limits = process, limits
        self._seen: object = None
        self._since = time.monotonic()

    def look(self, progress: object, allowed_s: float | None = None) -> None:
        """Look at it; raises Ended where it is beyond a limit. `progress` differs where it went on."""
        now, limit_s = time.monotonic(), allowed_s or self._limits.time_s
        if progress != self._seen:
            self._seen, self._since = progress, now
        if now - self._since > limit_s:
            raise Ended(f"took longer than {limit_s:g} s (time_limit_s)")
        taken = sum(_memory(each) for each in family(self._process))
        if taken > self._limits.memory_mb * 1e6:
            raise Ended(f"took more than {self._limits.memory_mb:g} MB of memory (memory_limit_mb)")


def _memory(process: psutil.Process) -> int:
    try:
        return int(process.memory_info().rss)
    except psutil.Error:
        return 0


def end(process: "subprocess.Popen[bytes]") -> None:
    """End a process and all that it started."""
    if process.poll() is None:  # else its number may be another's
        with suppress(psutil.Error):
            kill_family(psutil.Process(process.pid))
        process.wait()

    def close() -> None:
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None:
                with suppress(OSError):
                    stream.close()

    # what it started before it ended by itself may hold its output open, which nobody waits for
    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    closing.join(LOOKS_S)


def how_ended(code: int) -> str:
    """Say how a process ended."""
    if code < 0:
        with suppress(ValueError):
            return f"crashed ({signal.Signals(-code).name})"
    return f"crashed (0x{code & 0xFFFFFFFF:08X})" if code > 0xFFFF else f"ended with exit code {code}"


class Worker:
    """Represents a process that takes runs through filters of libraries, one after another."""

    def __init__(self) -> None:
        self._process = start_module("fuselog.replay.foreign.processes.worker", stdout=subprocess.PIPE)
        GUARD.tell(self._process.pid)
        self.is_over = False
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with suppress(OSError, ValueError):
            for line in self._process.stdout:
                self._answers.put(line)
        self._answers.put(b"")

    def end(self) -> None:
        """End the process, whatever it does."""
        self.is_over = True
        end(self._process)

    @property
    def is_alive(self) -> bool:
        """Tell whether it waits for work."""
        return self._process.poll() is None

    @property
    def code(self) -> int | None:
        """Return its exit code; None while there is none."""
        return self._process.returncode

    def ask(self, task: dict[str, Any], limits: Limits, progress: Callable[[], int] = lambda: 0) -> Any:
        """Have a task done; raises Ended where the process does not do it, BadInput what it raises."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(task).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise Ended(how_ended(self._process.wait())) from None
        watch = Watch(psutil.Process(self._process.pid), limits)
        while True:
            try:
                answer = self._answers.get(timeout=LOOKS_S)
            except queue.Empty:
                now = progress()
                watch.look(now, STARTS_S if now == LOADING else None)
                continue
            if not answer:
                raise Ended(how_ended(self._process.wait()))
            reply = json.loads(answer)
            if "refused" in reply:
                raise BadInput(reply["refused"])
            return reply


def state_of(library: str) -> list[int]:
    """Return when a library was last changed, and its size: a process that has an older one ends."""
    try:
        state = Path(library).stat()
    except OSError:
        return [0, 0]
    return [state.st_mtime_ns, state.st_size]


class Ran(NamedTuple):
    """Holds what one run's filter said, and why the run failed, if it did."""

    followed: Followed
    failure: Failure | None


def follow_apart(
    worker: Worker, library: str, given: RunGiven, description: Description, limits: Limits
) -> Ran | None:
    """Take one run through its filter in a process; what it says before it crashes counts.

    None where the process had ended before, for want of work.
    """
    due, recorded = offsets_of(description, given.events)
    with scratch_folder("fuselog-filter") as folder:
        given.save(folder / "given.npz")
        made = begun(mapped(folder, due, recorded, description), due, recorded)
        made.progress[0] = LOADING
        task = {
            "library": library,
            "state": state_of(library),
            "folder": str(folder),
        }
        failure = None
        try:
            failed = worker.ask(task, limits, lambda: int(made.progress[0]))["failure"]
            if failed is not None:
                failure = Failure(failed[1], reason_of_code(failed[0], description))
        except Ended as ended:
            worker.end()
            if worker.code == IDLE and int(made.progress[0]) == LOADING:
                return None
            failure = failure_at(int(made.progress[0]), given, description, str(ended))
        return Ran(copied(followed(made, due, recorded)), failure)


def follow_here(library: Library, given: RunGiven, description: Description) -> Ran:
    """Take one run through its filter in this process."""
    due, recorded = offsets_of(description, given.events)
    made = begun(results(due, recorded, sizes_of(description)), due, recorded)
    failed = follow_given(library, given, description, made)
    failure = failed and Failure(failed[1], reason_of_code(failed[0], description))
    return Ran(followed(made, due, recorded), failure)


def failure_at(event: int, given: RunGiven, description: Description, why: str) -> Failure:
    """Return a failure at a message, which is named."""
    events = given.events
    if not 0 <= event < len(events.time_ns):
        first_ns = int(events.time_ns[0]) if len(events.time_ns) else 0
        return Failure(first_ns, f"the filter {why} before its first message")
    number = int(events.source[event])
    of = f" ({description.topics[number].topic})" if number >= 0 else ", a prediction"
    return Failure(int(events.time_ns[event]), f"the filter {why} at message {event + 1}{of}")


class Workers:
    """Represents the processes that work on some runs; those that survive are kept for the next.

    A process that is given nothing for a while ends by itself, see `worker`.
    """

    def __init__(self) -> None:
        self._working: set[Worker] = set()
        self._is_over = False

    @contextmanager
    def one(self) -> Iterator[Worker]:
        """Take a process out for a run."""
        if self._is_over:
            raise Ended("was stopped")
        worker = _kept_or_new()
        self._working.add(worker)
        try:
            yield worker
        finally:
            self._working.discard(worker)
            if not worker.is_over:
                _KEPT.put(worker)

    def end(self) -> None:
        """End those that still work; there are no more."""
        self._is_over = True
        for worker in list(self._working):
            worker.end()


_KEPT: queue.SimpleQueue[Worker] = queue.SimpleQueue()


def _kept_or_new() -> Worker:
    """Return a process that waits for work."""
    with suppress(queue.Empty):
        while True:
            worker = _KEPT.get_nowait()
            if worker.is_alive:
                return worker
            worker.end()
    return Worker()


@atexit.register
def _end_kept() -> None:
    with suppress(queue.Empty):
        while True:
            _KEPT.get_nowait().end()


def follow_runs_apart(
    library: str, runs: Sequence[RunGiven | None], description: Description, limits: Limits
) -> list[Ran | None]:
    """Take runs through filters in processes, as many at once as there are cores; None stays None."""
    count = max(1, min(core_count(), sum(each is not None for each in runs)))
    workers = Workers()

    def one(given: RunGiven | None) -> Ran | None:
        if given is None:
            return None
        while True:
            with workers.one() as worker:
                ran = follow_apart(worker, library, given, description, limits)
            if ran is not None:
                return ran

    return in_threads(one, runs, count, workers.end)


def in_threads(
    work: Callable[[Given], Found], items: Sequence[Given], count: int, stop: Callable[[], None]
) -> list[Found]:
    """Do work on all items, some at once; `stop` ends what they wait for, in the end or when stopped."""
    with ThreadPoolExecutor(count) as threads:
        try:
            return [each.result() for each in [threads.submit(work, item) for item in items]]
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            stop()


def describe_apart(library: str) -> str:
    """Ask a library for its description, in a process."""
    while True:
        worker = _kept_or_new()
        try:
            found = worker.ask(
                {"library": library, "state": state_of(library)}, Limits(STARTS_S, 2000.0)
            )["description"]
            _KEPT.put(worker)
            return str(found)
        except Ended as ended:
            worker.end()
            if worker.code != IDLE:
                raise BadInput(f"{library}: {ended} while it was asked what it is; mend it") from None
        except BaseException:
            worker.end()
            raise
