"""Ends the programs that we started where we are killed, and they do not look whether we live.

A process of ours waits for the end of its standard input, which only we hold: that end comes however we
end. Then it kills what it was told of.
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
    """Return a process and all that it started."""
    try:
        return [process, *process.children(recursive=True)]
    except psutil.Error:
        return [process]


def kill_family(process: psutil.Process) -> None:
    """Kill a process and all that it started."""
    for each in family(process):
        with suppress(psutil.Error):
            each.kill()


class _Guard:
    """Represents the process that outlives us for a moment; one for each of our processes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of: int | None = None  # a fork has none of its own yet
        self._process: subprocess.Popen[bytes] | None = None

    def tell(self, pid: int) -> None:
        """Have a program ended when we are; one that has ended by itself is none's concern."""
        with suppress(psutil.Error):
            line = f"{pid} {psutil.Process(pid).create_time()}\n"
            with self._lock:
                if self._process is None or self._of != os.getpid() or self._process.poll() is not None:
                    alone: dict[str, Any] = {"start_new_session": True}  # Ctrl-C is not for it
                    if sys.platform == "win32":
                        alone = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
                    self._process = start_module(__name__, stdout=subprocess.DEVNULL, **alone)
                    self._of = os.getpid()
                assert self._process.stdin is not None
                with suppress(OSError):
                    self._process.stdin.write(line.encode())
                    self._process.stdin.flush()

    def end(self) -> None:
        """End the guard where we end as usual: what it was told of has ended."""
        with self._lock:
            if self._process is not None and self._of == os.getpid():
                with suppress(OSError):
                    self._process.communicate()
                self._process = None


GUARD = _Guard()
atexit.register(GUARD.end)


def main() -> None:
    """Note processes, by number and time of creation; at the end of input kill those that still run."""
    noted = [line.split() for line in sys.stdin]
    for pid, created in noted:
        with suppress(psutil.Error):
            process = psutil.Process(int(pid))
            if process.create_time() == float(created):
                kill_family(process)


if __name__ == "__main__":
    main()
