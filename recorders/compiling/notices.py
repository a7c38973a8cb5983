"""Notices about long compilations, and a measurement of the time that threads spend on one-time work."""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from multiprocessing import parent_process
from threading import Timer, local

_LOG = logging.getLogger("fuselog")
_PATIENCE_S = 1.0  # faster compilations are not reported
_spent = local()


def seconds_done_once() -> float:
    """Return how long this thread has spent in `done_once` so far: compiling, loading and importing."""
    return getattr(_spent, "seconds", 0.0)


@contextmanager
def done_once() -> Iterator[None]:
    """Count the time spent in this context as one-time work, not as an estimator's run time."""
    begun_s, before_s = time.perf_counter(), seconds_done_once()
    try:
        yield
    finally:
        _spent.seconds = before_s + time.perf_counter() - begun_s  # nested contexts count once


@contextmanager
def compiling(title: str) -> Iterator[None]:
    """Report a compilation that takes longer than a second, when it begins and when it ends."""
    patience = Timer(_PATIENCE_S, _say, (f"compiling {title}, once",))
    patience.daemon = True
    begun_s = time.perf_counter()
    patience.start()
    try:
        with done_once():
            yield
    finally:
        patience.cancel()
    took_s = time.perf_counter() - begun_s
    if took_s > _PATIENCE_S:
        _say(f"compiled {title} in {took_s:.1f} s")


def _say(sentence: str) -> None:
    """Log a sentence if logging is configured; otherwise print it to standard error once.

    Worker processes print nothing, since users watch only the output of the parent.
    """
    if _LOG.hasHandlers():
        _LOG.info(sentence)
    elif parent_process() is None:
        _print_once(sentence)


@cache
def _print_once(sentence: str) -> None:
    print(f"fuselog: {sentence}", file=sys.stderr, flush=True)
