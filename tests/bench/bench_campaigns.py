"""Runs per second of a campaign: two workers beside one, and a cell beside its work alone.

Wall time, so that it needs a machine with two cores and nothing else to do. Run it with `make bench`, or
`python -m tests.bench campaigns`. Workers begin as those of an installed package do, whose modules are
compiled.
"""

import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time, thread_time
from typing import Any
from unittest.mock import patch

from fuselog.pipeline.runs.campaigns import cells_of, judge_all
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.executors import PoolFactory, processes
from fuselog.pipeline.runs.experiment import Experiment, Setting, load_experiment, run_experiment
from fuselog.recorders.compiling.compile import OverRuns, core_count
from fuselog.recorders.environment import CORES
from tests.bench.timing import cpu_seconds, seconds

RUNS = 2000
called = OverRuns.__call__
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """Runs per second, and what the campaign adds to a cell's work."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "compiled")
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        _campaign(folder, processes(2), 256)()  # modules and kernels are compiled, figures were drawn
        campaigns = {count: seconds(_campaign(folder, processes(count))) for count in (1, 2)}
        experiment = load_experiment("landmarks", {}, {"runs": 128})[1]
        ways = {"campaign": partial(_one_cell, experiment, folder), "alone": _cell(experiment, folder)}
        taken = cpu_seconds(ways, repeats=9)
        cell_s, loops_s = _of_filters(ways["alone"])
    rates = {count: RUNS / taken_s for count, taken_s in campaigns.items()}
    return [
        (
            f"landmarks, {RUNS} runs: two workers; one, at least 1.7 times",
            f"{rates[2]:.0f} runs/s",
            f"{rates[1]:.0f} runs/s",
            f"{rates[2] / rates[1]:.2f} times",
        ),
        (
            "one cell of 128 runs that is kept, CPU; its work alone, at most 1.05 times",
            f"{taken['campaign']:.2f} s",
            f"{taken['alone']:.2f} s",
            f"{taken['campaign'] / taken['alone']:.2f} times",
        ),
        (
            "one cell of 128 runs, CPU of one core; the loops of its three filters, at most 2.5 times",
            f"{cell_s:.2f} s",
            f"{loops_s:.2f} s",
            f"{cell_s / loops_s:.2f} times",
        ),
    ]


def _campaign(folder: Path, open_pool: PoolFactory, runs: int = RUNS) -> Callable[[], object]:
    name, experiment = load_experiment("landmarks", {}, {"runs": runs})
    return partial(run_experiment, name, experiment, folder / "result", logs=0, open_pool=open_pool)


def _of_filters(work: Callable[[], object], repeats: int = 9) -> tuple[float, float]:
    """The CPU time of a cell on one core, and of the loops of filters in it: medians of their pairs."""
    taken, loops_s = [], [0.0]

    def timed(loop: OverRuns, *arguments: Any, **named: Any) -> None:
        begin = thread_time()
        called(loop, *arguments, **named)
        loops_s[-1] += (thread_time() - begin) * (loop.run_once.__name__ == "follow")

    with patch.object(OverRuns, "__call__", timed), patch.dict(os.environ, {CORES: "1"}):
        core_count.cache_clear()
        for _ in range(repeats):
            loops_s[-1], begin = 0.0, process_time()
            work()
            taken.append((process_time() - begin, loops_s[-1]))
    core_count.cache_clear()
    return sorted(taken, key=lambda each: each[0] / each[1])[repeats // 2]


def _one_cell(experiment: Experiment, folder: Path) -> None:
    """A campaign of one cell: it is worked off, kept, read again and merged."""
    with checkpoints_of(folder / "one") as checkpoints:
        setting = Setting(folder, folder / "one", logs=0, draws=False, checkpoints=checkpoints)
        list(judge_all([experiment], setting))


def _cell(experiment: Experiment, folder: Path) -> Callable[[], object]:
    setting = Setting(folder, folder / "one", logs=0, draws=False)
    return partial(cells_of(experiment, setting)[0].work_off, folder)
