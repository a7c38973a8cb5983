"""Reports that a kernel is being compiled, where that takes long; counts what a process does once."""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from multiprocessing import parent_process
from threading import Timer, local

_LOG = logging.getLogger("fuselog")
_PATIENCE_S = 1.0  # what compiles in less time is not told of
_spent = local()


def seconds_done_once() -> float:
    """Tell how long this thread has compiled, loaded kernels and imported until now, where told."""
    return getattr(_spent, "seconds", 0.0)


@contextmanager
def done_once() -> Iterator[None]:
    """Tell that what is done here belongs to a first use, and to no estimator's time."""
    begun_s, before_s = time.perf_counter(), seconds_done_once()
    try:
        yield
    finally:
        _spent.seconds = before_s + time.perf_counter() - begun_s  # of one within another once


@contextmanager
def compiling(title: str) -> Iterator[None]:
    """Say what is compiled where that takes longer than a second, and how long it took."""
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
    """Say it by the program's logging, as the command line sets it up; else on standard error, once.

    Not from a worker process, whose parent is what somebody watches.
    """
    if _LOG.hasHandlers():
        _LOG.info(sentence)
    elif parent_process() is None:
        _print_once(sentence)


@cache
def _print_once(sentence: str) -> None:
    print(f"fuselog: {sentence}", file=sys.stderr, flush=True)
