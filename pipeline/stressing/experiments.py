"""Stresses the runs of an experiment that was run: `fuselog run --stress`."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.altering.sources import alter
from pipeline.output.alarms import Stressing
from pipeline.output.results import Result
from pipeline.runs.ensemble import Progress, no_progress
from pipeline.runs.executors import WorkerPool, pool_for
from pipeline.runs.experiment import Experiment, Setting
from pipeline.runs.initial_states import order_of
from pipeline.runs.runner import Runner
from pipeline.stressing.stressing import TOGETHER, How, stress_runs
from pipeline.stressing.sums import StressSums
from recorders.errors import BadInput
from recorders.parameters import build
from replay.foreign.naming import allowed


class _Part(NamedTuple):
    """Runs of an experiment that are stressed together.

    Attributes:
        experiment: all of it.
        data: what it imports.
        first, end: the runs.
    """

    experiment: Experiment
    data: Path | None
    first: int
    end: int

    def stressed(self) -> Mapping[str, StressSums]:
        """Obtain the runs again, and stress the estimators."""
        experiment = self.experiment
        runner = Runner(experiment, Setting(Path(), Path(), data=self.data, logs=0, draws=False))
        runs = runner.obtain(first_run=self.first, runs=self.end - self.first)
        order, late = order_of(arrival_order=bool(experiment.arrival_order), late=experiment.late)
        how = How(0, experiment.gap_limit_s, order, late)
        sources = [alter(source, experiment.alterations or {}) for source in runs]
        sums = {label: StressSums(label) for label in experiment.estimators}
        for each in stress_runs(sources, experiment.estimators, how):
            sums[each.estimator].add(each)
        return sums


def stress_result(
    result: Result, *, workers: int | None = 1, progress: Progress = no_progress
) -> list[Stressing]:
    """Stress the estimators of an experiment over all of its runs, as it was run in this process.

    Args:
        result: what the run left.
        workers: processes that share the runs; None stands for all cores where that pays.
        progress: is told how it goes.

    Raises BadInput where the experiment has no estimators or no runs of its own.
    """
    beside = ("data", "parameters")
    values = {name: value for name, value in result.settings.items() if name not in beside}
    values["estimators"] = allowed(values.get("estimators") or {})
    experiment = build(Experiment, values, f"experiment {result.experiment}")
    if not experiment.estimators:
        raise BadInput(f"--stress: experiment {result.experiment} names no estimators; leave it out")
    data = result.settings.get("data")
    runs = len(experiment.files) or experiment.runs
    parts = [
        _Part(experiment, Path(data) if data else None, first, min(first + TOGETHER, runs))
        for first in range(0, runs, TOGETHER)
    ]
    return [each.told for each in _merged(parts, workers, progress).values()]


def _worked_off(parts: Sequence[_Part], pool: WorkerPool) -> Iterator[Mapping[str, StressSums]]:
    """What each part leaves, in their order; a few are handed out at a time."""
    working = deque[Future[Any]]()
    for part in parts:
        working.append(pool.executor.submit(part.stressed))
        if len(working) > pool.workers:
            yield working.popleft().result()
    while working:
        yield working.popleft().result()


def _merged(parts: Sequence[_Part], workers: int | None, progress: Progress) -> Mapping[str, StressSums]:
    """What stress did, part by part, in their order."""
    whole: dict[str, StressSums] = {}
    with pool_for(workers, None, parts[-1].end)() as pool:
        try:
            told = progress(_worked_off(parts, pool), "stressing: parts of the runs", len(parts))
            for found in told:
                for label, sums in found.items():
                    whole.setdefault(label, StressSums(label)).merge(sums)
        except BrokenExecutor as error:
            raise BadInput(
                f"--stress: a process that replayed copies died ({error}); try fewer workers"
            ) from error
    return whole
