"""A background worker that does only the newest of the waiting requests."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

Work = Callable[[Callable[[], bool]], None]


class NewestFirst:
    """A thread that does the newest work; older waiting work is dropped.

    Work receives a function that tells whether newer work waits, so that it can give up. One thread
    calls `ask` and `end`. At exit, Python waits for the current work, because a thread that is
    interrupted in NumPy's C++ aborts the process.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._pool = ThreadPoolExecutor(1, "fuselog explore")
        self._newest = 0
        self._on_error = on_error

    def ask(self, work: Work) -> None:
        """Do this work next, in place of waiting work; nothing after the end."""
        self._newest += 1
        with suppress(RuntimeError):  # it has ended, or Python ends
            self._pool.submit(self._do, work, self._newest)

    def end(self) -> None:
        """Stop, and let the current work end early."""
        self._newest += 1
        self._pool.shutdown(wait=False)

    def _do(self, work: Work, number: int) -> None:
        def is_newer() -> bool:
            return self._newest > number

        if not is_newer():
            try:
                work(is_newer)
            except Exception as error:
                self._on_error(error)
