"""Monte Carlo execution: record an ensemble, replay estimators over it, judge them.

Recording runs on any `concurrent.futures.Executor`; the replay itself uses all cores.
"""

import hashlib
import json
import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from pipeline.starting import Origin, start_from
from recorders.errors import BadInput
from recorders.log import Clock, LogWriter, RunMetadata, schemas
from recorders.recording import record_run
from replay.engine.blocks import Ragged
from replay.engine.estimator import bind
from replay.engine.failures import sentences_of
from replay.engine.replaying import BLOCK_MESSAGES, Report, collect, replay
from replay.engine.sources import Ensemble, MemorySource, Source, memory_source
from replay.judging.evaluation import (
    Errors,
    Innovations,
    errors_of,
    gaussian_estimates,
    innovations_of,
    split_topic,
    unjudged,
)
from replay.judging.metrics import Output, estimated_share
from replay.judging.set_errors import SetErrors, set_errors

# Every run of an ensemble has two files open while it is replayed from logs; systems allow 1024.
RUNS_AT_ONCE = 128
# Less than this share of a span is said; a run's first measurements may well be before the prior.
LEAST_SHARE = 0.995

Settings = Mapping[str, Mapping[str, Any]]
Progress = Callable[[Iterable[Any], str, int | None], Iterable[Any]]


def no_progress(items: Iterable[Any], title: str, total: int | None) -> Iterable[Any]:  # noqa: ARG001
    """The progress bar of programs that show none."""
    return items


@dataclass(frozen=True)
class Replayed:
    """An ensemble with what the estimators made of it, and how that compares with the truth."""

    sources: Sequence[Source]
    outputs: dict[str, Ragged]
    errors: list[Errors]
    innovations: list[Innovations]
    sets: list[SetErrors] = field(default_factory=list)

    @property
    def judged(self) -> list[Errors | Innovations | SetErrors | Output]:
        """All that metrics may judge."""
        outputs = [
            Output(*split_topic(topic), topic.rpartition("/")[2], rows, self.sources)
            for topic, rows in self.outputs.items()
        ]
        return [*self.errors, *self.innovations, *self.sets, *outputs]

    @property
    def unjudged(self) -> list[str]:
        """A sentence for every estimate of which the truth lacks components."""
        sentences = []
        for estimates in gaussian_estimates(self.outputs):
            names = unjudged(estimates, self.sources)
            if names:
                stream = estimates.stream
                what = " ".join(filter(None, split_topic(stream.topic)))
                verb = "is" if len(names) == 1 else "are"
                sentences.append(
                    f"{what}: {', '.join(names)} {verb} not judged: {stream.metadata['truth']} lacks "
                    + ("it" if len(names) == 1 else "them")
                )
        return sentences

    @property
    def failures(self) -> list[str]:
        """A sentence for every run that an estimator could not follow to the end, or not at all."""
        failed: dict[tuple[str, int], str] = {}
        silent: dict[tuple[str, int], str] = {}
        for topic, rows in self.outputs.items():
            what = " ".join(filter(None, split_topic(topic)))
            for run, source in enumerate(self.sources):
                found = rows.of_run(run)
                if rows.stream.schema.full_name == schemas.FAILURE.full_name and len(found):
                    elapsed_s = (int(found.publish_time_ns[0]) - source.epoch_ns) * 1e-9
                    reason = sentences_of(found.take(slice(0, 1)))[0]
                    failed[what, run] = f"{source.name}: {what} failed at {elapsed_s:.3f} s: {reason}"
                elif rows.stream.schema.full_name == schemas.GAUSSIAN_ESTIMATE.full_name and not len(
                    found
                ):
                    silent[what, run] = f"{source.name}: {what} gave no estimates"
        return list({**silent, **failed}.values())

    @property
    def losses(self) -> list[str]:
        """A sentence for every case that was not estimated throughout, and for measurements not used."""
        said = []
        for topic, rows in self.outputs.items():
            what = " ".join(filter(None, split_topic(topic)))
            schema = rows.stream.schema.full_name
            if schema == schemas.COVERAGE.full_name and (share := estimated_share(rows)) is not None:
                if share < LEAST_SHARE:
                    said.append(
                        f"{what}: {100 * share:.1f} % of the span was estimated; its figures are of that"
                    )
            elif schema == schemas.SKIPPED.full_name:
                counts = Counter(sentences_of(rows.stream))
                said += [f"{what}: {count} not used: {reason}" for reason, count in counts.items()]
        return said


def record_ensemble(
    scenario: str,
    parameters: Mapping[str, Any],
    seed: int,
    runs: int,
    progress: Progress = no_progress,
    executor: Executor | None = None,
) -> Ensemble[MemorySource]:
    """Record runs 0 ... runs - 1 of a scenario, each from its own random stream of `seed`.

    Raises BadInput where the first run shows that memory cannot hold them all.
    """
    record = partial(_record, scenario, dict(parameters), seed)
    begin_s = time.perf_counter()
    first = record(0)
    took_s = time.perf_counter() - begin_s
    # replay lays the runs end to end, which holds every column twice; estimates come on top
    require_memory(f"{runs} runs of {scenario}", 2 * runs * _size(first), took_s * runs)
    others = executor.map(record, range(1, runs)) if executor else map(record, range(1, runs))
    return Ensemble(progress(chain([first], others), f"recording {scenario}", runs))


def require_memory(what: str, need_bytes: float, time_s: float | None = None) -> None:
    """Raise BadInput with what something takes, where that is more memory than is free."""
    time_too = "" if time_s is None else f", and about {time_s / 3600:.2g} hours"
    there_bytes = psutil.virtual_memory().available
    if need_bytes > there_bytes:
        need, there = (f"{each / 1e9:.3g} GB" for each in (need_bytes, there_bytes))
        raise BadInput(
            f"{what} take at least {need} of memory, where {there} are free{time_too}; "
            "ask for fewer runs or shorter ones"
        )


def _size(source: MemorySource) -> int:
    """Bytes of all columns of a run."""
    return sum(
        column.nbytes
        for stream in source.streams.values()
        for column in (stream.publish_time_ns, stream.log_time_ns, *stream.columns.values())
    )


def _record(scenario: str, parameters: Mapping[str, Any], seed: int, run: int) -> MemorySource:
    return memory_source(*record_run(scenario, parameters, seed, run))


def replay_ensemble(
    sources: Sequence[Source],
    estimators: Settings,
    *,
    gap_limit_s: float,
    order: Clock = "publish_time",
    progress: Progress = no_progress,
) -> Replayed:
    """Replay estimators (label -> parameters) over an ensemble and judge them against its truth."""
    outputs = replay_in_memory(sources, estimators, order=order, progress=progress)
    return judge(sources, outputs, gap_limit_s)


def replay_in_memory(
    sources: Sequence[Source],
    estimators: Settings,
    *,
    order: Clock = "publish_time",
    progress: Progress = no_progress,
) -> dict[str, Ragged]:
    """Replay estimators (label -> parameters) over an ensemble; whole output streams by topic."""
    outputs: dict[str, Ragged] = {}
    for label in progress(estimators, "replaying", len(estimators)):
        bound = bind(label, sources, estimators[label])
        report = Report()
        outputs |= collect(replay(sources, bound, order=order, report=report))
        outputs |= collect([report.coverage])
    return outputs


def judge(sources: Sequence[Source], outputs: dict[str, Ragged], gap_limit_s: float) -> Replayed:
    """Errors, innovations and set errors of a replay's outputs."""
    found = [errors_of(each, sources, gap_limit_s) for each in gaussian_estimates(outputs)]
    innovations = [
        innovations_of(each)
        for each in outputs.values()
        if each.stream.schema.full_name == schemas.INNOVATION.full_name
    ]
    errors = [each for each in found if each is not None]
    sets = set_errors(outputs, sources, gap_limit_s=gap_limit_s)
    return Replayed(sources, outputs, errors, innovations, sets)


def replay_to_logs(
    sources: Sequence[Source],
    estimators: Settings,
    paths: Sequence[Path],
    *,
    order: Clock = "publish_time",
    origins: Sequence[Origin] = (),
    block_messages: int = BLOCK_MESSAGES,
    progress: Progress = no_progress,
) -> dict[str, float]:
    """Replay and write one estimates log per run, block by block: memory holds the blocks in hand.

    `origins` are what the runs start from where their spans begin after their priors, one per run.
    Returns how many seconds each estimator took, by label. Raises BadInput as `replay` does.
    """
    reports: list[Report] = []
    bound = [each for label in estimators for each in bind(label, sources, estimators[label])]

    def write_some(first: int) -> Iterator[int]:
        now = slice(first, first + RUNS_AT_ONCE)
        begun = [
            start_from(each, sources[now], origins[now], order) if origins else each for each in bound
        ]
        with ExitStack() as stack:
            writers = [
                stack.enter_context(LogWriter(path, estimates_metadata(source, estimators, path)))
                for path, source in zip(paths[now], sources[now], strict=True)
            ]
            reports.append(part := Report())
            blocks = replay(
                sources[now],
                begun,
                order=order,
                block_messages=block_messages,
                report=part,
                is_part=len(sources) > RUNS_AT_ONCE,
            )
            for block in chain(blocks, _coverage_of(part)):
                for run, writer in enumerate(writers):
                    writer.write([ragged.of_run(run) for ragged in block])
                yield first

    parts = map(write_some, range(0, len(sources), RUNS_AT_ONCE))
    for _ in progress(chain.from_iterable(parts), "replaying", None):
        pass
    for name, refusal in reports[0].refused.items():
        if all(name in report.refused for report in reports):
            raise refusal
    seconds: dict[str, float] = defaultdict(float)
    for report in reports:
        for label, time_s in report.seconds.items():
            seconds[label] += time_s
    return dict(seconds)


def _coverage_of(report: Report) -> Iterator[list[Ragged]]:
    """The last block of a replay; it is there only when the others have been taken."""
    yield report.coverage


def estimates_metadata(
    source: Source, estimators: Settings, path: Path, log: Path | None = None
) -> RunMetadata:
    """What the estimates log at `path` says of itself: the run that it is of, the estimators, its log.

    The log's place is stated relative to the estimates', so that both can be moved together.
    """
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    place = os.path.relpath((log or Path(source.name)).resolve(), path.resolve().parent)
    settings = json.dumps({label: dict(values) for label, values in estimators.items()})
    return replace(run, notes={"log": place, "estimators": settings})


def hash_streams(sources: Sequence[MemorySource]) -> str:
    """SHA-256 over every column of every run: equal where the input data are equal."""
    digest = hashlib.sha256()
    for source in sources:
        for stream in source.streams.values():
            for array in (stream.publish_time_ns, stream.log_time_ns, *stream.columns.values()):
                digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
