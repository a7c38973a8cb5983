"""Runs per second of a campaign: two workers beside one, and a cell beside its work alone.

Wall time, so that it needs a machine with two cores and nothing else to do. Run it with `make bench`, or
`python -m tests.bench campaigns`.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from pipeline.campaigns import cells_of
from pipeline.executors import Crew, processes
from pipeline.experiment import Setting, load_experiment, run_experiment
from tests.bench.timing import median_seconds, seconds

RUNS = 2000
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """Runs per second, and what the campaign adds to a cell's work."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        campaigns = {count: seconds(_campaign(folder, processes(count))) for count in (1, 2)}
        rates = {count: RUNS / taken for count, taken in campaigns.items()}
        whole = median_seconds(_campaign(folder, None, 128), 3)
        alone = median_seconds(_cell(folder / "cell"), 3)
    return [
        (
            f"landmarks, {RUNS} runs: two workers; one, at least 1.7 times",
            f"{rates[2]:.0f} runs/s",
            f"{rates[1]:.0f} runs/s",
            f"{rates[2] / rates[1]:.2f} times",
        ),
        (
            "one cell of 128 runs with its result folder; its work alone",
            f"{whole:.2f} s",
            f"{alone:.2f} s",
            f"{whole / alone:.2f} times",
        ),
    ]


def _campaign(folder: Path, crew: Crew | None, runs: int = RUNS) -> Callable[[], object]:
    name, experiment = load_experiment("landmarks", {}, {"runs": runs})
    return partial(run_experiment, name, experiment, folder / "result", logs=0, crew=crew)


def _cell(folder: Path) -> Callable[[], object]:
    _, experiment = load_experiment("landmarks", {}, {"runs": 128})
    folder.mkdir()
    return partial(cells_of(experiment, Setting(folder, folder, logs=0))[0].work_off, folder)
