"""Isolation of filters in processes: a crash, an endless loop or a memory leak ends only one run."""

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
from fuselog.recorders.errors import BadInput, printable
from fuselog.recorders.processes import start_module, users_environment
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
LOOKS_S = 0.02  # interval at which a process is checked
STARTS_S = 60.0  # time for a process to start, since it imports and compiles

TAIL_BYTES = 300  # number of bytes kept of a program's standard error


class Ended(Exception):
    """Reason why a process ended, or was ended, before it had finished its task."""


class Limits(NamedTuple):
    """Limits for the time per message and for the memory of a process."""

    time_s: float
    memory_mb: float

    @classmethod
    def of(cls, parameters: ForeignParameters) -> "Limits":
        """Return the limits in the parameters of an estimator."""
        return cls(parameters.time_limit_s, parameters.memory_limit_mb)


class Watch:
    """Monitor of the progress and the memory of a working process."""

    def __init__(self, process: psutil.Process, limits: Limits) -> None:
        self._process, self._limits = process, limits
        self._seen: object = None
        self._since = time.monotonic()

    def look(self, progress: object, allowed_s: float | None = None) -> None:
        """Raise Ended if the process exceeds a limit; time runs from the last change of `progress`."""
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
    """End a process and all processes that it started."""
    if process.poll() is None:  # otherwise its ID may belong to another process
        with suppress(psutil.Error):
            kill_family(psutil.Process(process.pid))
        process.wait()

    def close() -> None:
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None:
                with suppress(OSError):
                    stream.close()

    # a process that it started may keep its output open; do not wait for this
    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    closing.join(LOOKS_S)


def how_ended(code: int) -> str:
    """Describe the end of a process by its exit code."""
    if code < 0:
        with suppress(ValueError):
            return f"crashed ({signal.Signals(-code).name})"
    return f"crashed (0x{code & 0xFFFFFFFF:08X})" if code > 0xFFFF else f"ended with exit code {code}"


class Worker:
    """Worker process for filters of libraries, which handles one run after another."""

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
        """End the process, even if it is working."""
        self.is_over = True
        end(self._process)

    @property
    def is_alive(self) -> bool:
        """Test whether the process is running."""
        return self._process.poll() is None

    @property
    def code(self) -> int | None:
        """Return the exit code; None while the process runs."""
        return self._process.returncode

    def ask(self, task: dict[str, Any], limits: Limits, progress: Callable[[], int] = lambda: 0) -> Any:
        """Run a task; raise Ended if the process ends first, and BadInput if it rejects the task."""
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


def state_of(file: str) -> tuple[int, int]:
    """Return the modification time and size of a file, such as a library, to detect a new version."""
    try:
        state = Path(file).stat()
    except (OSError, ValueError):
        return 0, 0
    return state.st_mtime_ns, state.st_size


class Ran(NamedTuple):
    """Results of the filter of one run, and the reason if the run failed."""

    followed: Followed
    failure: Failure | None


def follow_apart(
    worker: Worker, library: str, given: RunGiven, description: Description, limits: Limits
) -> Ran | None:
    """Process one run with its filter in another process; results before a crash are kept.

    Return None if the process had already ended because it was idle.
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
    """Process one run with its filter in this process."""
    due, recorded = offsets_of(description, given.events)
    made = begun(results(due, recorded, sizes_of(description)), due, recorded)
    failed = follow_given(library, given, description, made)
    failure = failed and Failure(failed[1], reason_of_code(failed[0], description))
    return Ran(followed(made, due, recorded), failure)


def failure_at(event: int, given: RunGiven, description: Description, why: str) -> Failure:
    """Make the failure of a run at a message; the reason of the failure names the message."""
    events = given.events
    if not 0 <= event < len(events.time_ns):
        first_ns = int(events.time_ns[0]) if len(events.time_ns) else 0
        return Failure(first_ns, f"the filter {why} before its first message")
    number = int(events.source[event])
    of = f" ({description.topics[number].topic})" if number >= 0 else ", a prediction"
    return Failure(int(events.time_ns[event]), f"the filter {why} at message {event + 1}{of}")


class Workers:
    """Processes that work on a set of runs; surviving processes are reused later.

    A process ends by itself if it has no work for some time, see `worker`.
    """

    def __init__(self) -> None:
        self._working: set[Worker] = set()
        self._is_over = False

    @contextmanager
    def one(self) -> Iterator[Worker]:
        """Provide a process for a run."""
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
        """End the processes that are still working, and provide no new ones."""
        self._is_over = True
        for worker in list(self._working):
            worker.end()


_KEPT: queue.SimpleQueue[Worker] = queue.SimpleQueue()


def _kept_or_new() -> Worker:
    """Return an idle process, or start a new one."""
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
    """Process runs with filters in parallel, one process per core; the result is None without input."""
    workers = Workers()

    def one(given: RunGiven | None) -> Ran | None:
        if given is None:
            return None
        while True:
            with workers.one() as worker:
                ran = follow_apart(worker, library, given, description, limits)
            if ran is not None:
                return ran

    return in_threads(one, runs, [workers])


def in_threads(
    work: Callable[[Given], Found],
    items: Sequence[Given],
    started: "Sequence[Workers | Program]",
) -> list[Found]:
    """Process all items in threads; at the end, also end the processes in `started`."""
    with ThreadPoolExecutor(max(1, min(core_count(), len(items)))) as threads:
        try:
            return [each.result() for each in [threads.submit(work, item) for item in items]]
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            for each in started:
                each.end()


def describe_apart(library: str) -> str:
    """Ask a library for its description in a separate process."""
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
                raise BadInput(
                    f"{library}: {ended} while it was asked for its description; correct the library"
                ) from None
        except BaseException:
            worker.end()
            raise


class Program:
    """Started program with its standard streams."""

    def __init__(self, words: Sequence[str]) -> None:
        """Start a program; raise BadInput if it cannot be started."""
        try:
            self.process = subprocess.Popen(
                words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=users_environment(),
            )
        except OSError as error:
            raise BadInput(
                f"exec:{words[0]}: cannot be started ({error.strerror}); give a program that exists"
            ) from None
        GUARD.tell(self.process.pid)
        self.tail = b""
        self._reader = threading.Thread(target=self._keep_tail, daemon=True)
        self._reader.start()

    def _keep_tail(self) -> None:
        assert self.process.stderr is not None
        with suppress(OSError, ValueError):
            while piece := self.process.stderr.read1(4096):  # type: ignore[attr-defined]
                self.tail = (self.tail + piece)[-TAIL_BYTES:]

    def how_ended(self) -> str:
        """Describe the end of the program, with the last line of its standard error."""
        code = self.process.wait()
        self._reader.join(1.0)
        lines = self.tail.decode(errors="replace").strip().splitlines()
        return how_ended(code) + (f": {printable(lines[-1])}" if lines and code else "")

    def end(self) -> None:
        """End the program and all processes that it started."""
        end(self.process)

    def wait(self, limits: Limits) -> None:
        """Wait for the end of the program and discard its output; raise Ended if it fails."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        threading.Thread(target=self._drop, daemon=True).start()
        watch = Watch(psutil.Process(self.process.pid), limits)
        while True:
            try:
                code = self.process.wait(LOOKS_S)
                break
            except subprocess.TimeoutExpired:
                try:
                    watch.look(0)
                except Ended as ended:
                    self.end()
                    raise Ended(f"the program {ended}") from None
        if code:
            raise Ended(f"the program {self.how_ended()}")

    def _drop(self) -> None:
        assert self.process.stdout is not None
        with suppress(OSError, ValueError):
            while self.process.stdout.read1(65536):  # type: ignore[attr-defined]
                pass
