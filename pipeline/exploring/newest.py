"""A background worker that does only the newest of the waiting tasks."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

Work = Callable[[Callable[[], bool]], None]


class NewestFirst:
    """A thread that does the newest task and drops older ones that have not begun.

    A task receives a function that tests whether a newer task is waiting, so that it can give up. `ask`
    and `end` must be called from a single thread. At exit, Python waits for the current task, because
    interrupting a thread in NumPy's C++ code aborts the process.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._pool = ThreadPoolExecutor(1, "fuselog explore")
        self._newest = 0
        self._on_error = on_error

    def ask(self, work: Work) -> None:
        """Do this task next instead of the waiting one; do nothing after `end`."""
        self._newest += 1
        with suppress(RuntimeError):  # the worker has ended, or Python is ending
            self._pool.submit(self._do, work, self._newest)

    def end(self) -> None:
        """Stop, and let the current task end early."""
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
