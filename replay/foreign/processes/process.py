"""Start of foreign programs, and the last lines of their standard error."""

import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress

import psutil

from fuselog.recorders.errors import BadInput, printable
from fuselog.recorders.processes import users_environment
from fuselog.replay.foreign.processes.isolation import LOOKS_S, Ended, Limits, Watch, end, how_ended
from fuselog.replay.foreign.processes.orphans import GUARD

TAIL_BYTES = 300  # number of bytes kept of a program's standard error


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
