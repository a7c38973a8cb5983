"""Runs per second of a campaign: two workers beside one, and a cell beside its work alone.

Two processes that compute only cells show what the machine can give: two cores may share their memory,
or be two threads of one. Wall time, so that it needs a machine with two cores and nothing else to do.
Run it with `make bench`, or `python -m tests.bench campaigns`. Workers begin as those of an installed
package do, whose modules are compiled.
"""

import os
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import process_time

from fuselog.pipeline.runs.campaigns import Cell, cells_of, judge_all
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.ensemble import RUNS_AT_ONCE
from fuselog.pipeline.runs.executors import processes, started
from fuselog.pipeline.runs.experiment import Experiment, Setting, load_experiment, run_experiment
from tests.bench.parts import LOOPS, time_parts
from tests.bench.timing import least_seconds, seconds

RUNS, LONG = 2000, 10_000
CELLS = 4  # of each process, where there is nothing else
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """Runs per second, and what the campaign adds to a cell's work."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "compiled")
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        _campaign(folder, 2, 256)  # modules and kernels are compiled, figures were drawn
        rates = {
            runs: [runs / seconds(partial(_campaign, folder, count, runs)) for count in (1, 2)]
            for runs in (RUNS, LONG)
        }
        one_s, two_s = _cells_alone(folder)
        experiment = load_experiment("landmarks", {}, {"runs": 128})[1]
        ways = {"campaign": partial(_one_cell, experiment, folder), "alone": _cell(experiment, folder)}
        taken = least_seconds({name: partial(_cpu_s, way) for name, way in ways.items()}, repeats=9)
        parts = time_parts(ways["alone"])
    return [
        *(
            (
                f"landmarks, {runs} runs: two workers; one, at least 1.9 times",
                f"{two:.0f} runs/s",
                f"{one:.0f} runs/s",
                f"{two / one:.2f} times",
            )
            for runs, (one, two) in rates.items()
        ),
        (
            "cells alone, without a driver: two processes; one, what the machine gives",
            f"{2 * CELLS * RUNS_AT_ONCE / two_s:.0f} runs/s",
            f"{2 * CELLS * RUNS_AT_ONCE / one_s:.0f} runs/s",
            f"{one_s / two_s:.2f} times",
        ),
        (
            "one cell of 128 runs that is kept, CPU; its work alone, at most 1.05 times",
            f"{taken['campaign']:.2f} s",
            f"{taken['alone']:.2f} s",
            f"{taken['campaign'] / taken['alone']:.2f} times",
        ),
        (
            "one cell of 128 runs, CPU of one core; the loops of its three filters, at most 2.5 times",
            f"{parts.whole_s:.2f} s",
            f"{parts.parts_s[LOOPS]:.2f} s",
            f"{parts.of_loops:.2f} times",
        ),
    ]


def _campaign(folder: Path, workers: int, runs: int) -> None:
    name, experiment = load_experiment("landmarks", {}, {"runs": runs})
    with started(processes(workers)) as open_pool:
        run_experiment(name, experiment, folder / "result", logs=0, open_pool=open_pool)


def _cells_alone(folder: Path, pairs: int = 3) -> tuple[float, float]:
    """Wall time of the same cells in one process and, in halves, in two; all have begun before."""
    _, experiment = load_experiment("landmarks", {}, {"runs": CELLS * RUNS_AT_ONCE})
    cells = cells_of(experiment, Setting(folder, folder, logs=0, draws=False))
    with processes(1)() as first, processes(1)() as second:

        def work(*shares: Sequence[Cell]) -> None:
            pools = (first, second)
            halves = [
                pool.executor.submit(_work_off, share, folder)
                for pool, share in zip(pools, shares, strict=False)
            ]
            for half in halves:
                half.result()

        work(cells[:1], cells[:1])
        taken = [
            (seconds(partial(work, [*cells, *cells])), seconds(partial(work, cells, cells)))
            for _ in range(pairs)
        ]
    return sorted(taken, key=lambda pair: pair[0] / pair[1])[pairs // 2]


def _work_off(cells: Sequence[Cell], folder: Path) -> None:
    for cell in cells:
        cell.work_off(folder)


def _one_cell(experiment: Experiment, folder: Path) -> None:
    """A campaign of one cell: it is worked off, kept, read again and merged."""
    with checkpoints_of(folder / "one") as checkpoints:
        setting = Setting(folder, folder / "one", logs=0, draws=False, checkpoints=checkpoints)
        list(judge_all([experiment], setting))


def _cell(experiment: Experiment, folder: Path) -> Callable[[], object]:
    setting = Setting(folder, folder / "one", logs=0, draws=False)
    return partial(cells_of(experiment, setting)[0].work_off, folder)


def _cpu_s(work: Callable[[], object]) -> float:
    begin_s = process_time()
    work()
    return process_time() - begin_s
