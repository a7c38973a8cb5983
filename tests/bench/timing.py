"""How long a call takes."""

from collections.abc import Callable, Mapping
from statistics import median
from time import perf_counter, process_time


def median_seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """The median wall time of a call, after one to warm up."""
    work()
    return median(seconds(work) for _ in range(repeats))


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    begin = perf_counter()
    work()
    return perf_counter() - begin


def cpu_seconds(
    ways: Mapping[str, Callable[[], object]], repeats: int = 3, turn_s: float = 0.5
) -> dict[str, float]:
    """The median CPU time of each way, of all cores together; a busy machine stretches it little.

    The ways take turns of `turn_s` and more, so that a busy spell meets all of them.
    """
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            calls, begin = 0, process_time()
            while process_time() < begin + turn_s:
                way()
                calls += 1
            taken[name].append((process_time() - begin) / calls)
    return {name: median(each) for name, each in taken.items()}


def least_seconds(
    ways: Mapping[str, Callable[[], float]], repeats: int = 5, turn_s: float = 0.3
) -> dict[str, float]:
    """The least of what the ways say that they took, in turns; see `cpu_seconds`."""
    taken = dict.fromkeys(ways, float("inf"))
    for _ in range(repeats):
        for name, way in ways.items():
            begin = process_time()
            while process_time() < begin + turn_s:
                taken[name] = min(taken[name], way())
    return taken
