"""Guard process that ends the programs started by this process if this process is killed.

The guard waits for the end of its standard input, which only this process keeps open, so the guard
always notices the end of this process. It then kills the processes that were reported to it.
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
    """Guard process, which runs slightly longer than its parent; each process of fuselog has one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of: int | None = None  # a forked process does not have its own guard yet
        self._process: subprocess.Popen[bytes] | None = None

    def tell(self, pid: int) -> None:
        """Register a program to end with this process; a program that has already ended is ignored."""
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
        """End the guard at a normal exit, when the registered programs have ended."""
        with self._lock:
            if self._process is not None and self._of == os.getpid():
                with suppress(OSError):
                    self._process.communicate()
                self._process = None


GUARD = _Guard()
atexit.register(GUARD.end)


def main() -> None:
    """Read process IDs and creation times; at the end of the input, kill processes still running."""
    noted = [line.split() for line in sys.stdin]
    for pid, created in noted:
        with suppress(psutil.Error):
            process = psutil.Process(int(pid))
            if process.create_time() == float(created):
                kill_family(process)


if __name__ == "__main__":
    main()
