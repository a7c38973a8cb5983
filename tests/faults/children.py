"""Runs jobs in forked children, two at once, with limits of memory and of time."""

import os
import resource  # noqa: TID251
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

LIMIT_S, LIMIT_CPU_S, LIMIT_BYTES = 120, 60, 2 << 30
AT_ONCE = min(2, os.cpu_count() or 1)
FELL = 70  # the exit code of a child that ended with a traceback

Key = TypeVar("Key")


def in_children(jobs: Iterable[tuple[Key, Callable[[], object]]]) -> Iterator[tuple[Key, int]]:
    """Run each job in a child of its own; yield its key and wait status as it ends."""
    waiting = iter(jobs)
    working: dict[int, tuple[Key, float]] = {}
    while True:
        while len(working) < AT_ONCE:
            following = next(waiting, None)
            if following is None:
                break
            key, job = following
            working[_begin(job)] = key, time.monotonic()
        if not working:
            return
        pid, status = _next_end(working)
        yield working.pop(pid)[0], status


def in_child(job: Callable[[], object]) -> int:
    """Run one job in a child, which may take what memory it likes; return its wait status."""
    return _next_end({_begin(job, is_limited=False): ("", time.monotonic())})[1]


def how(status: int) -> str:
    """Say in words how a child ended; empty if it ended well."""
    if os.WIFSIGNALED(status):
        return f"ended by {signal.Signals(os.WTERMSIG(status)).name}"
    return "ended with a traceback" if status else ""


def _begin(job: Callable[[], object], *, is_limited: bool = True) -> int:
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()  # noqa: TID251
    if pid:
        return pid
    code = FELL
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        memory = pages * resource.getpagesize() + LIMIT_BYTES
        if is_limited:
            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_CPU_S, LIMIT_CPU_S + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        job()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _next_end(working: dict[int, tuple[Key, float]]) -> tuple[int, int]:
    """Wait until one of the children ends, or end one that takes too long."""
    while True:
        for pid, (_, since_s) in working.items():
            ended, status = os.waitpid(pid, os.WNOHANG)
            if not ended and time.monotonic() - since_s > LIMIT_S:
                os.kill(pid, signal.SIGKILL)  # noqa: TID251
                ended, status = os.waitpid(pid, 0)
            if ended:
                return pid, status
        time.sleep(0.002)
