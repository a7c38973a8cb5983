"""Reports that a kernel is being compiled, where that takes long."""

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


def seconds_compiling() -> float:
    """How long this thread has compiled until now."""
    return getattr(_spent, "seconds", 0.0)


@contextmanager
def compiling(title: str) -> Iterator[None]:
    """Say what is compiled where that takes longer than a second, and how long it took."""
    patience = Timer(_PATIENCE_S, _say, (f"compiling {title}, once",))
    patience.daemon = True
    begun_s, before_s = time.perf_counter(), seconds_compiling()
    patience.start()
    try:
        yield
    finally:
        patience.cancel()
        took_s = time.perf_counter() - begun_s
        _spent.seconds = before_s + took_s  # of one within another once
    if took_s > _PATIENCE_S:
        _say(f"compiled {title} in {took_s:.1f} s")


def _say(sentence: str) -> None:
    """By the program's logging, as the command line sets it up; else on standard error, each once.

    Not from a worker process, whose parent is what somebody watches.
    """
    if _LOG.hasHandlers():
        _LOG.info(sentence)
    elif parent_process() is None:
        _print_once(sentence)


@cache
def _print_once(sentence: str) -> None:
    print(f"fuselog: {sentence}", file=sys.stderr, flush=True)
