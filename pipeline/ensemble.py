"""Monte Carlo execution: record an ensemble, replay estimators over it, judge them.

Recording runs on any `concurrent.futures.Executor`; the replay itself uses all cores.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recorders.errors import BadInput
from recorders.log import LogWriter, RunMetadata, Stream, schemas
from recorders.log.reader import Order
from recorders.recording import record_run
from replay.blocks import Ragged
from replay.engine import BLOCK_MESSAGES, bind, collect, replay
from replay.evaluation import (
    Errors,
    Innovations,
    errors_of,
    gaussian_estimates,
    innovations_of,
)
from replay.sources import MemorySource, Source, memory_source

Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]


def no_progress(items: Iterable[Any], title: str, total: int) -> Iterable[Any]:  # noqa: ARG001
    """The progress bar of programs that show none."""
    return items


@dataclass(frozen=True)
class Replayed:
    """An ensemble with what the estimators made of it."""

    sources: Sequence[Source]
    outputs: dict[str, Ragged]
    errors: list[Errors]
    innovations: list[Innovations]


def record_ensemble(
    scenario: str,
    parameters: Mapping[str, Any],
    seed: int,
    runs: int,
    progress: Progress = no_progress,
    executor: Executor | None = None,
) -> list[MemorySource]:
    """Record runs 0 ... runs - 1 of a scenario, each from its own random stream of `seed`."""
    if runs < 1:
        raise BadInput(f"--runs {runs}: at least one run is needed")
    record = partial(_record, scenario, dict(parameters), seed)
    recorded = executor.map(record, range(runs)) if executor else map(record, range(runs))
    return list(progress(recorded, f"recording {scenario}", runs))


def _record(scenario: str, parameters: Mapping[str, Any], seed: int, run: int) -> MemorySource:
    return memory_source(*record_run(scenario, parameters, seed, run))


def replay_ensemble(
    sources: Sequence[Source],
    estimators: Mapping[str, Mapping[str, Any]],
    *,
    gap_limit_s: float,
    order: Order = "publish_time",
    progress: Progress = no_progress,
) -> Replayed:
    """Replay estimators (label -> parameters) over an ensemble and judge them against its truth."""
    outputs = replay_in_memory(sources, estimators, order=order, progress=progress)
    return judge(sources, outputs, gap_limit_s)


def replay_in_memory(
    sources: Sequence[Source],
    estimators: Mapping[str, Mapping[str, Any]],
    *,
    order: Order = "publish_time",
    progress: Progress = no_progress,
) -> dict[str, Ragged]:
    """Replay estimators (label -> parameters) over an ensemble; whole output streams by topic."""
    outputs: dict[str, Ragged] = {}
    for label in progress(estimators, "replaying", len(estimators)):
        bound = bind(label, sources, estimators[label])
        outputs |= collect(replay(sources, bound, order=order))
    return outputs


def judge(sources: Sequence[Source], outputs: dict[str, Ragged], gap_limit_s: float) -> Replayed:
    """Errors and innovations of a replay's outputs."""
    found = [errors_of(each, sources, gap_limit_s) for each in gaussian_estimates(outputs)]
    innovations = [
        innovations_of(each)
        for each in outputs.values()
        if each.stream.schema.full_name == schemas.INNOVATION.full_name
    ]
    return Replayed(sources, outputs, [each for each in found if each is not None], innovations)


def estimates_metadata(
    source: Source, estimators: Mapping[str, Mapping[str, Any]], log: str = ""
) -> RunMetadata:
    """What an estimates log says of itself: the run it is of, the estimators, and where its log is."""
    run = source.run or RunMetadata("unknown")
    parameters = {"estimators": {label: dict(values) for label, values in estimators.items()}}
    return RunMetadata(
        run.scenario, parameters, run.seed, run.run, run.epoch_ns, {"log": log} if log else {}
    )


def replay_to_logs(
    sources: Sequence[Source],
    estimators: Mapping[str, Mapping[str, Any]],
    paths: Sequence[Path],
    *,
    order: Order = "publish_time",
    block_messages: int = BLOCK_MESSAGES,
    progress: Progress = no_progress,
) -> None:
    """Replay and write one estimates log per run, block by block: memory holds the blocks in hand."""
    bound = [each for label in estimators for each in bind(label, sources, estimators[label])]
    with ExitStack() as stack:
        writers = [
            stack.enter_context(LogWriter(path, _metadata_beside(source, estimators, path)))
            for path, source in zip(paths, sources, strict=True)
        ]
        blocks = replay(sources, bound, order=order, block_messages=block_messages)
        for block in progress(blocks, "replaying", 0):
            for run, writer in enumerate(writers):
                writer.write([ragged.of_run(run) for ragged in block])


def _metadata_beside(
    source: Source, estimators: Mapping[str, Mapping[str, Any]], path: Path
) -> RunMetadata:
    """The log is named relative to its estimates, so that both can be moved together."""
    log = os.path.relpath(Path(source.name).resolve(), path.resolve().parent)
    return estimates_metadata(source, estimators, log)


def hash_streams(sources: Sequence[MemorySource]) -> str:
    """SHA-256 over every column of every run: equal where the input data are equal."""
    digest = hashlib.sha256()
    for source in sources:
        for array in _arrays(source.streams):
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _arrays(streams: Mapping[str, Stream]) -> Iterator[np.ndarray]:
    for stream in streams.values():
        yield from (stream.publish_time_ns, stream.log_time_ns, *stream.columns.values())
