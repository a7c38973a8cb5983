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

from fuselog.pipeline.runs.campaigns import cells_of, judge_all
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.executors import PoolFactory, processes
from fuselog.pipeline.runs.experiment import Experiment, Setting, load_experiment, run_experiment
from tests.bench.parts import LOOPS, time_parts
from tests.bench.timing import cpu_seconds, seconds

RUNS, LONG = 2000, 10_000
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """Runs per second, and what the campaign adds to a cell's work."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "compiled")
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        _campaign(folder, processes(2), 256)()  # modules and kernels are compiled, figures were drawn
        rates = {
            runs: [runs / seconds(_campaign(folder, processes(count), runs)) for count in (1, 2)]
            for runs in (RUNS, LONG)
        }
        experiment = load_experiment("landmarks", {}, {"runs": 128})[1]
        ways = {"campaign": partial(_one_cell, experiment, folder), "alone": _cell(experiment, folder)}
        taken = cpu_seconds(ways, repeats=9)
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


def _campaign(folder: Path, open_pool: PoolFactory, runs: int) -> Callable[[], object]:
    name, experiment = load_experiment("landmarks", {}, {"runs": runs})
    return partial(run_experiment, name, experiment, folder / "result", logs=0, open_pool=open_pool)


def _one_cell(experiment: Experiment, folder: Path) -> None:
    """A campaign of one cell: it is worked off, kept, read again and merged."""
    with checkpoints_of(folder / "one") as checkpoints:
        setting = Setting(folder, folder / "one", logs=0, draws=False, checkpoints=checkpoints)
        list(judge_all([experiment], setting))


def _cell(experiment: Experiment, folder: Path) -> Callable[[], object]:
    setting = Setting(folder, folder / "one", logs=0, draws=False)
    return partial(cells_of(experiment, setting)[0].work_off, folder)
