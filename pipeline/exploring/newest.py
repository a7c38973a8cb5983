"""Works off what is asked for in the background: only the newest of what waits is done."""

from collections.abc import Callable
from threading import Condition, Thread

Work = Callable[[Callable[[], bool]], None]


class NewestFirst:
    """Runs a thread that does the newest work it is given; what was waiting before that is forgotten.

    Work is handed a function that tells whether newer work waits, so that it can give up.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._condition = Condition()
        self._waiting: Work | None = None
        self._is_ended = False
        self._on_error = on_error
        self._thread = Thread(target=self._run, name="fuselog explore", daemon=True)
        self._thread.start()

    def ask(self, work: Work) -> None:
        """Do this next, in place of what waits."""
        with self._condition:
            self._waiting = work
            self._condition.notify()

    def end(self) -> None:
        """Do nothing any more; the work at hand is told that newer work waits."""
        with self._condition:
            self._is_ended = True
            self._waiting = None
            self._condition.notify()

    def _is_newer(self) -> bool:
        with self._condition:
            return self._is_ended or self._waiting is not None

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._is_ended or self._waiting is not None)
                work, self._waiting = self._waiting, None
            if self._is_ended or work is None:
                return
            try:
                work(self._is_newer)
            except Exception as error:
                self._on_error(error)
