"""Guard process that ends the programs that we started if we are killed and they do not notice it.

It waits for the end of its standard input, which only we hold open, so that it ends however we end.
Then it kills the processes that were reported to it.
"""

import atexit
import os
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

import psutil

from fuselog.recorders.processes import start_module


def family(process: psutil.Process) -> list[psutil.Process]:
    """Return a process and all processes that it started."""
    try:
        return [process, *process.children(recursive=True)]
    except psutil.Error:
        return [process]


def kill_family(process: psutil.Process) -> None:
    """Kill a process and all processes that it started."""
    for each in family(process):
        with suppress(psutil.Error):
            each.kill()


class _Guard:
    """Process that outlives ours for a moment; each of our processes has one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of: int | None = None  # a forked process does not have its own yet
        self._process: subprocess.Popen[bytes] | None = None

    def tell(self, pid: int) -> None:
        """Register a program to be ended when we end; one that has already ended is ignored."""
        with suppress(psutil.Error):
            line = f"{pid} {psutil.Process(pid).create_time()}\n"
            with self._lock:
                if self._process is None or self._of != os.getpid() or self._process.poll() is not None:
                    alone: dict[str, Any] = {"start_new_session": True}  # so that it does not get Ctrl-C
                    if sys.platform == "win32":
                        alone = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
                    self._process = start_module(__name__, stdout=subprocess.DEVNULL, **alone)
                    self._of = os.getpid()
                assert self._process.stdin is not None
                with suppress(OSError):
                    self._process.stdin.write(line.encode())
                    self._process.stdin.flush()

    def end(self) -> None:
        """End the guard when we end normally; the registered programs have ended."""
        with self._lock:
            if self._process is not None and self._of == os.getpid():
                with suppress(OSError):
                    self._process.communicate()
                self._process = None


GUARD = _Guard()
atexit.register(GUARD.end)


def main() -> None:
    """Read process IDs and creation times, and kill those still running at the end of the input."""
    noted = [line.split() for line in sys.stdin]
    for pid, created in noted:
        with suppress(psutil.Error):
            process = psutil.Process(int(pid))
            if process.create_time() == float(created):
                kill_family(process)


if __name__ == "__main__":
    main()
