"""Does in the background what is asked for: only the newest of what waits."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

Work = Callable[[Callable[[], bool]], None]


class NewestFirst:
    """Does the newest work it is given in a thread; what was waiting before that is forgotten.

    Work is handed a function that tells whether newer work waits, so that it can give up. One thread
    calls `ask` and `end`. At its end, Python waits for the work at hand, because a thread that is
    broken off in NumPy's C++ aborts the process.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._pool = ThreadPoolExecutor(1, "fuselog explore")
        self._newest = 0
        self._on_error = on_error

    def ask(self, work: Work) -> None:
        """Do this next, in place of what waits; nothing after the end."""
        self._newest += 1
        with suppress(RuntimeError):  # it has ended, or Python ends
            self._pool.submit(self._do, work, self._newest)

    def end(self) -> None:
        """Do nothing any more; the work at hand is told that newer work waits."""
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
