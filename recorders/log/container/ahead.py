"""A few threads that process items in advance.

Chunks are packed and opened by compiled code, which threads run in parallel, so several cores are used
while the file is read or written.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS = min(4, os.cpu_count() or 1)


def ahead(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Map items in order, processing only a few of them in advance, so that memory stays bounded."""
    rest = iter(items)
    yield from map(work, islice(rest, 1))  # a log of one chunk needs no threads
    with ThreadPoolExecutor(THREADS) as pool:
        running: deque[Future[Result]] = deque()
        for item in rest:
            running.append(pool.submit(work, item))
            if len(running) > THREADS:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
