"""Recording, replay and judgement of ensembles that fit into memory."""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

from fuselog.pipeline.runs.ensemble import Progress, Settings, no_progress, replay_blocks
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock
from fuselog.recorders.recording import record_runs
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.late import Late
from fuselog.replay.engine.replaying.replaying import Report, collect
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import MemorySource, Source, memory_source
from fuselog.replay.judging.errors.evaluation import Errors, Innovations, split_topic
from fuselog.replay.judging.judge import TIME_BINS, Judge
from fuselog.replay.judging.metrics.measuring import Output, find_metrics, measure

# Smallest number of bytes that are kept for a judged run, for its sums over time.
KEPT_BYTES = 8 * TIME_BINS
# Number of runs that are simulated together; with more, their arrays do not fit into a core's cache.
TOGETHER = 16


@dataclass(frozen=True)
class Replayed:
    """An ensemble in memory, the outputs of estimators, and their errors.

    `others` contains the outputs that families judge: sets, regions, tracks.
    """

    sources: Sequence[MemorySource]
    outputs: dict[str, Ragged]
    errors: list[Errors]
    innovations: list[Innovations]
    others: list[Any]

    @property
    def judged(self) -> list[Errors | Innovations | Output]:
        """Return all outputs that have metrics: estimates, innovations and messages."""
        outputs = [
            Output(*split_topic(topic), topic.rpartition("/")[2], rows, self.sources)
            for topic, rows in self.outputs.items()
        ]
        return [*self.errors, *self.innovations, *outputs]

    def metrics(self, names: Sequence[str] = ()) -> dict[str, float]:
        """Compute the metrics with these names, or all if no names are given; see `measure`."""
        return measure(self.judged, find_metrics(names))


def record_ensemble(
    scenario: str,
    parameters: Mapping[str, Any],
    seed: int,
    runs: int,
    progress: Progress = no_progress,
    executor: Executor | None = None,
    first_run: int = 0,
    all_runs: int = 0,
) -> Ensemble[MemorySource]:
    """Record `runs` runs of a scenario, each with its own random stream of `seed`.

    Raises BadInput if the size of the first run shows that the runs, or the sums over time needed to
    judge them, do not fit into memory.
    """
    record = partial(_record, scenario, dict(parameters), seed)
    begin_s = time.perf_counter()
    first = record([first_run])
    took_s = time.perf_counter() - begin_s
    # a replay concatenates the runs, which doubles every column; estimates need memory as well
    need_bytes = max(2 * runs * _size(first[0]), all_runs * KEPT_BYTES)
    all_runs = max(runs, all_runs)
    require_memory(f"{all_runs} runs of {scenario}", need_bytes, took_s * all_runs)
    numbers = range(first_run + 1, first_run + runs)
    parts = (numbers[at : at + TOGETHER] for at in range(0, len(numbers), TOGETHER))
    others = chain.from_iterable(executor.map(record, parts) if executor else map(record, parts))
    return Ensemble(progress(chain(first, others), f"recording {scenario}", runs))


def require_memory(what: str, need_bytes: float, time_s: float | None = None) -> None:
    """Raise BadInput with the required memory if it exceeds the free memory."""
    time_too = "" if time_s is None else f", and about {time_s / 3600:.2g} hours"
    import psutil  # slow to import

    there_bytes = psutil.virtual_memory().available
    if need_bytes > there_bytes:
        need, there = (f"{each / 1e9:.3g} GB" for each in (need_bytes, there_bytes))
        raise BadInput(
            f"{what} need at least {need} of memory, but {there} are free{time_too}; "
            "use fewer or shorter runs"
        )


def _size(source: MemorySource) -> int:
    """Count the bytes of all columns of a run."""
    return sum(
        column.nbytes
        for stream in source.streams.values()
        for column in (stream.publish_time_ns, stream.log_time_ns, *stream.columns.values())
    )


def _record(
    scenario: str, parameters: Mapping[str, Any], seed: int, runs: Sequence[int]
) -> list[MemorySource]:
    return [memory_source(*recorded) for recorded in record_runs(scenario, parameters, seed, runs)]


def replay_ensemble(
    sources: Sequence[MemorySource],
    estimators: Settings,
    *,
    gap_limit_s: float,
    progress: Progress = no_progress,
) -> Replayed:
    """Replay estimators (label -> parameters) over an ensemble and judge them against its truth."""
    return judge(sources, replay_in_memory(sources, estimators, progress=progress), gap_limit_s)


def replay_in_memory(
    sources: Sequence[Source],
    estimators: Settings,
    *,
    order: Clock = "publish_time",
    late: Late | None = None,
    progress: Progress = no_progress,
) -> dict[str, Ragged]:
    """Replay estimators (label -> parameters) over an ensemble; return complete streams by topic."""
    outputs: dict[str, Ragged] = {}
    for label in progress(estimators, "replaying", len(estimators)):
        bound = bind(label, sources, estimators[label])
        blocks = replay_blocks(sources, bound, Report(), order=order, late=late)
        outputs |= collect(list(block.values()) for block in blocks)
    return outputs


def judge(sources: Sequence[MemorySource], outputs: dict[str, Ragged], gap_limit_s: float) -> Replayed:
    """Judge a replay's outputs against the truth."""
    judged = Judge(sources, {}, gap_limit_s=gap_limit_s).add(outputs)
    return Replayed(sources, outputs, judged.errors, judged.innovations, judged.others)
