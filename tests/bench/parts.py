"""CPU time of a campaign's cell on one core, and of its parts, by timers around functions."""

import os
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pkgutil import resolve_name
from time import process_time, thread_time
from typing import Any, NamedTuple
from unittest.mock import patch

from fuselog.recorders.compiling.compile import OverRuns, core_count, use_cores

LOOPS = "loops of the filters"
# The functions that do the parts; none is called in another.
FUNCTIONS = {
    "judging": "fuselog.pipeline.runs.ensemble._judge_and_draw",
    "simulation of the runs": "fuselog.pipeline.runs.runner.record_ensemble",
    "events of the filters": "fuselog.replay.inference.run.filtering.events_of",
    "hash of the data": "fuselog.pipeline.runs.runner.hash_streams",
}


class Taken(NamedTuple):
    """CPU time of a cell in s, and of its parts by name."""

    whole_s: float
    parts_s: Mapping[str, float]

    @property
    def of_loops(self) -> float:
        """How many times the loops of its filters the cell takes."""
        return self.whole_s / self.parts_s[LOOPS]


def time_parts(work: Callable[[], object], repeats: int = 9) -> Taken:
    """Measure a cell `repeats` times; the median by `of_loops`."""
    before = core_count()
    with patch.dict(os.environ):
        use_cores(1)
        taken = [_timed(work) for _ in range(repeats)]
        use_cores(before)
    return sorted(taken, key=lambda each: each.of_loops)[repeats // 2]


def _timed(work: Callable[[], object]) -> Taken:
    parts_s: Counter[str] = Counter()

    def timed(part: str, function: Callable[..., object], *arguments: Any, **named: Any) -> object:
        begin_s = thread_time()
        done = function(*arguments, **named)
        parts_s[part] += thread_time() - begin_s
        return done

    def called(loop: OverRuns, *arguments: Any, **named: Any) -> None:
        if loop.run_once.__name__ == "follow":
            timed(LOOPS, call, loop, *arguments, **named)
        else:
            call(loop, *arguments, **named)

    call = OverRuns.__call__
    with ExitStack() as stack:
        for part, name in FUNCTIONS.items():
            stack.enter_context(patch(name, partial(timed, part, resolve_name(name))))
        stack.enter_context(patch.object(OverRuns, "__call__", called))
        begin_s = process_time()
        work()
        return Taken(process_time() - begin_s, parts_s)
