"""Stress tests of the runs of an experiment, for `fuselog run --stress`."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.output.alarms import Stressing
from fuselog.pipeline.output.claims import Claim, decide
from fuselog.pipeline.output.results import Result
from fuselog.pipeline.runs.ensemble import Progress, no_progress
from fuselog.pipeline.runs.executors import WorkerPool, pool_for
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study, given_files, numbers_of
from fuselog.pipeline.runs.initial_states import order_of
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.stressing.copies import How
from fuselog.pipeline.stressing.stressing import TOGETHER, stress_runs
from fuselog.pipeline.stressing.sums import StressSums
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import build
from fuselog.recorders.registry import load
from fuselog.replay.foreign.naming import allowed
from fuselog.replay.judging.verdicts import Claimed


class _Part(NamedTuple):
    """Runs of an experiment that are stressed together.

    Attributes:
        experiment: the whole experiment.
        data: the folder from which the experiment imports data.
        first, end: the range of runs; `end` is exclusive.
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
    result: Result,
    *,
    workers: int | None = 1,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> list[Stressing]:
    """Stress the estimators of an experiment over all its runs, under the settings of its result.

    Args:
        result: the result of the run.
        workers: processes that share the runs; None means all cores if that saves time.
        scheduler: the address of a Dask scheduler whose workers share the runs.
        progress: function that reports progress.

    Raises BadInput if the experiment has no estimators or no runs of its own.
    """
    beside = ("data", "parameters")
    values = {name: value for name, value in result.settings.items() if name not in beside}
    values["estimators"] = allowed(values.get("estimators") or {})
    experiment = build(Experiment, values, f"experiment {result.experiment}").with_absolute_files()
    if not experiment.estimators:
        raise BadInput(f"--stress: experiment {result.experiment} names no estimators; remove it")
    data = Path(result.settings["data"]).absolute() if result.settings.get("data") else None
    runs = len(experiment.files) or experiment.runs
    parts = [
        _Part(experiment, data, first, min(first + TOGETHER, runs)) for first in range(0, runs, TOGETHER)
    ]
    with pool_for(workers, scheduler, parts[-1].end)() as pool:
        pool.require(given_files(experiment, data))
        return [each.summary for each in _merged(parts, pool, progress).values()]


def claims_under_stress(
    experiment: Experiment, result: Result, stress: Sequence[Stressing]
) -> list[Claim]:
    """Return the claims of a result; a claim is inconclusive if stress may reverse it.

    Claims are decided again. Each metric's interval, or its value if it has no interval, is widened on
    both sides by the largest change under stress. Verdicts on metrics that do not belong to single
    estimators do not change.
    """
    moved = {f"{each.estimator}.{key}": by for each in stress for key, by in each.moved.items()}
    intervals = dict[str, Sequence[float | None]](result.intervals)
    for key in moved.keys() & result.metrics.keys():
        value = result.metrics[key]
        low, high = intervals.get(key, (value, value))
        if isinstance(low, float) and isinstance(high, float):
            intervals[key] = low - moved[key], high + moved[key]
    study: Study = load("studies", experiment.study, Study)
    options = build(study.options, experiment.options, f"options of study {experiment.study}")
    again = decide(experiment.claims, result.metrics, intervals, numbers_of(experiment, options))
    first = len(result.claims) - len(again)  # claims that the study itself decides come first
    claims = list(result.claims)
    for place, found in enumerate(again, first):
        own = claims[place]
        if own.verdict in (Claimed.CONFIRMED, Claimed.REFUTED) and found.verdict != own.verdict:
            why = "; ".join(filter(None, [own.why, "changes that should not matter may reverse it"]))
            claims[place] = replace(own, verdict=Claimed.INCONCLUSIVE, why=why)
    return claims


def _worked_off(parts: Sequence[_Part], pool: WorkerPool) -> Iterator[Mapping[str, StressSums]]:
    """Yield the results of the parts in order, with only a few parts submitted at a time."""
    working = deque[Future[Any]]()
    for part in parts:
        working.append(pool.executor.submit(part.stressed))
        if len(working) > pool.workers:
            yield working.popleft().result()
    while working:
        yield working.popleft().result()


def _merged(parts: Sequence[_Part], pool: WorkerPool, progress: Progress) -> Mapping[str, StressSums]:
    """Merge the results of the parts in their order."""
    whole: dict[str, StressSums] = {}
    try:
        for found in progress(_worked_off(parts, pool), "stressing: parts of the runs", len(parts)):
            for label, sums in found.items():
                whole.setdefault(label, StressSums(label)).merge(sums)
    except pool.lost as error:
        raise BadInput(
            f"--stress: a worker process died while replaying copies ({error}); try fewer workers"
        ) from error
    return whole
