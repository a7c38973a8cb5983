"""Recording, replay and judgement of ensembles, in one streamed pass or in memory.

Runs are recorded on any `concurrent.futures.Executor`; the replay itself uses all cores.
"""

import json
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fuselog.pipeline.altering.sources import note_of
from fuselog.pipeline.output.coverage import added, replayed_note, rows_of, untaken
from fuselog.pipeline.runs.initial_states import Origin, start_from
from fuselog.pipeline.runs.settings import meanings_of
from fuselog.recorders.compiling.compile import core_count
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, LogWriter, Mirrors, RunMetadata
from fuselog.recorders.log.impossible import Rejections
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.remote.paths import reference_to
from fuselog.replay.engine.replaying.estimator import Bound, bind
from fuselog.replay.engine.replaying.late import Late
from fuselog.replay.engine.replaying.replaying import BLOCK_MESSAGES, Report, collect, replay
from fuselog.replay.engine.replaying.usage import Row, Usage
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.ensembles import ensemble_of
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.errors.evaluation import Errors, errors_at
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import Metric, find_metrics, plus

if TYPE_CHECKING:
    from fuselog.replay.timeline.show import Drawing

# Every run that is replayed from logs has up to three open files; systems allow 1024.
RUNS_AT_ONCE = 128

Item = TypeVar("Item")
Settings = Mapping[str, Mapping[str, Any]]
# A function of items, a title (converted to text for each item), and their number; yields the items.
Progress = Callable[[Iterable[Any], object, int | None], Iterable[Any]]


def no_progress(items: Iterable[Any], title: object, total: int | None) -> Iterable[Any]:  # noqa: ARG001
    """Return the items unchanged, for programs that show no progress."""
    return items


@dataclass(frozen=True)
class RunGroup:
    """Some runs of an ensemble, which are replayed together.

    Attributes:
        sources: the runs.
        first_run: the number of the first run.
        estimates: paths of estimates and source log, for the first runs.
        origins: initial states, one per run, for runs whose spans begin after their priors; may be
            empty.
        is_all: whether these are all runs of the ensemble.
    """

    sources: Sequence[Source]
    first_run: int = 0
    is_all: bool = True
    estimates: Sequence[tuple[Path, Path]] = ()
    origins: Sequence[Origin] = ()


def parts_of(runs: int) -> Iterator[slice]:
    """Yield slices of runs that are replayed together. The slices depend only on the number of runs."""
    for first in range(0, runs, RUNS_AT_ONCE):
        yield slice(first, min(first + RUNS_AT_ONCE, runs))


def cut_in_parts(
    sources: Sequence[Source],
    estimates: Sequence[tuple[Path, Path]],
    origins: Sequence[Origin] = (),
) -> Iterator[RunGroup]:
    """Yield groups of existing runs; `estimates` and `origins` contain the entries of all runs."""
    for now in parts_of(len(sources)):
        yield RunGroup(
            sources[now], now.start, now.stop - now.start == len(sources), estimates[now], origins[now]
        )


@dataclass
class Pass:
    """The result of a streamed pass over runs.

    Attributes:
        judge: judge of all runs.
        parameters: parameters of every estimator by label, including defaults.
        stated: parameters in the first log's channels; see `stated_of`.
        usages: how many measurements each bound estimator used.
        untaken: topics that estimators do not use.
        left_out: counts of messages with impossible values.
        seconds: the run time of each estimator in s, by label.
        refused: the reasons why estimators cannot replay any run, by label.
        input_sha256: a hash of the input data, if requested.
        meanings: meanings of the parameters in a few words, by label and name.
    """

    judge: Judge
    parameters: dict[str, dict[str, Any]]
    seconds: dict[str, float] = field(default_factory=dict)
    refused: dict[str, BadInput] = field(default_factory=dict)
    input_sha256: str = ""
    stated: dict[str, dict[str, str]] = field(default_factory=dict)
    usages: dict[str, Usage] = field(default_factory=dict)
    untaken: list[Row] = field(default_factory=list)
    left_out: Rejections = field(default_factory=Rejections)
    meanings: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def coverage(self) -> list[Row]:
        """Return counts of used and unused messages for every topic."""
        return rows_of(self.usages, self.untaken, self.judge.doubts, self.left_out)

    @property
    def timings(self) -> dict[str, dict[str, float]]:
        """Return the run time of each estimator in seconds, and its number of messages."""
        messages: Counter[str] = Counter()
        for name, usage in self.usages.items():
            messages[name.partition("/")[0]] += usage.given.total()
        return {
            label: {"seconds": seconds, "messages": messages[label]}
            for label, seconds in self.seconds.items()
        }

    def merge(self, other: "Pass") -> None:
        """Add the result of a pass over later runs to this one."""
        self.judge.merge(other.judge)
        self.seconds = plus(self.seconds, other.seconds)
        for name, usage in other.usages.items():
            self.usages.setdefault(name, Usage(name)).merge(usage)
        self.untaken = added(self.untaken, other.untaken)
        self.left_out = self.left_out.plus([other.left_out])
        self.refused = {name: why for name, why in self.refused.items() if name in other.refused}

    def check(self) -> "Pass":
        """Return the pass itself; raise BadInput if an estimator could not replay any run."""
        for refusal in self.refused.values():
            raise refusal
        return self


def replay_parts(
    parts: Iterable[RunGroup],
    estimators: Settings,
    *,
    gap_limit_s: float,
    metrics: Sequence[str] = (),
    order: Clock = "publish_time",
    late: Late | None = None,
    save: Path | None = None,
    connect: str | None = None,
    on_errors: Callable[[Errors], None] | None = None,
    block_messages: int = BLOCK_MESSAGES,
    mirrors: Mirrors | None = None,
    progress: Progress = no_progress,
) -> Pass:
    """Replay an ensemble in parts, and send blocks to estimates logs, judge and timeline.

    Memory contains only the current blocks, and those runs of the part that were in memory before.

    Args:
        parts: the runs.
        estimators: parameters by label.
        gap_limit_s: the longest gap over which the truth is interpolated.
        metrics: names of the metrics to compute; all if empty.
        order: the clock that orders messages.
        late: how out-of-sequence messages are handled if messages are in order of log time.
        save: the file for the first run's timeline.
        connect: the viewer to which the timeline is streamed; see `Drawing`.
        on_errors: function that is called with the errors of every block.
        block_messages: approximate number of a run's messages that are in memory at a time.
        mirrors: function that makes the Foxglove mirror, which is written next to the estimates.
        progress: function that reports progress after every block.

    `Pass.check` reports estimators that cannot replay any run.
    """
    found, whole = find_metrics(metrics), None
    with _told(progress, "replaying") as tell:
        for part in parts:
            report = Report()
            bound = bind_from(part.sources, estimators, part.origins, order)
            judge = Judge(
                part.sources,
                found,
                gap_limit_s=gap_limit_s,
                first_run=part.first_run,
                on_errors=on_errors,
            )
            with ExitStack() as stack:
                writers = [
                    stack.enter_context(
                        LogWriter(
                            path,
                            estimates_metadata(source, estimators, path, log, order),
                            mirrors=mirrors,
                        )
                    )
                    for (path, log), source in zip(part.estimates, part.sources, strict=False)
                ]
                drawing = None
                if part.first_run == 0 and (save or connect):
                    from fuselog.replay.timeline.show import Drawing  # slow to import

                    asked = json.dumps([str(part.sources[0].start_ns), estimators], default=str)
                    first = Drawing(part.sources[0].whole(), identity=asked, save=save, connect=connect)
                    drawing = stack.enter_context(first)
                blocks = replay_blocks(
                    part.sources,
                    bound,
                    report,
                    order=order,
                    late=late,
                    block_messages=block_messages,
                    is_part=not part.is_all,
                )
                judging = partial(_judge_and_draw, judge, drawing)
                hand_over = stack.enter_context(in_background(judging))
                for block in blocks:
                    hand_over(block)
                    for run, writer in enumerate(writers):
                        writer.write([ragged.of_run(run) for ragged in block.values()])
                    tell()
            judge.close()
            done = Pass(judge, parameters_of(bound), dict(report.seconds), report.refused)
            done.stated = stated_of(bound, part.sources[0])
            done.meanings = meanings_of(bound)
            done.usages = report.usages
            done.untaken = untaken(part.sources, estimators, bound, order)
            done.left_out = Rejections().plus(source.rejections for source in part.sources)
            if whole is None:
                whole = done
            else:
                whole.merge(done)
    assert whole is not None
    return whole


def _judge_and_draw(judge: Judge, drawing: "Drawing | None", block: Mapping[str, Ragged]) -> None:
    judged = judge.add(block)
    if drawing is not None:
        drawing.add(*of_run(block, judged.errors, 0))


@contextmanager
def _told(progress: Progress, title: str) -> Iterator[Callable[[], object]]:
    """Return a function that reports progress when it is called at every step of a loop."""
    steps = iter(progress(repeat(None), title, None))
    next(steps)
    try:
        yield partial(next, steps)
    finally:
        if isinstance(steps, Generator):
            steps.close()


@contextmanager
def in_background(work: Callable[[Item], None]) -> Iterator[Callable[[Item], None]]:
    """Process items in order in a background thread; yields a function that submits an item.

    An exception in the thread is raised when the next item is submitted, or at the end. If this process
    has only one core, there is no thread, and items are processed immediately.
    """
    if core_count() == 1:
        yield work
        return
    with ThreadPoolExecutor(1) as pool:
        working: list[Future[None]] = []

        def hand_over(item: Item) -> None:
            while working:
                working.pop().result()
            working.append(pool.submit(work, item))

        yield hand_over
        for last in working:
            last.result()


def bind_from(
    sources: Sequence[Source], estimators: Settings, origins: Sequence[Origin], order: Clock
) -> list[Bound]:
    """Bind estimators to runs, with the initial states of the runs if there are origins."""
    bound = [each for label in estimators for each in bind(label, sources, estimators[label])]
    return [start_from(each, sources, origins, order) for each in bound] if origins else bound


def parameters_of(bound: Sequence[Bound]) -> dict[str, dict[str, Any]]:
    """Return the parameters of estimators by label as JSON values, without values that are None.

    Parameters of single topics are in one table per topic.
    """
    return {
        each.name.partition("/")[0]: _as_set(each.parameters)
        for each in bound
        if each.parameters is not None
    }


def _as_set(parameters: Parameters) -> dict[str, Any]:
    values = parameters.model_dump(mode="json", exclude_none=True)
    owned: Mapping[str, tuple[str, str]] = getattr(type(parameters), "OWNED", {})
    if owned:
        values.pop("of_topics", None)
    for own, (topic, name) in owned.items():
        if own in values:
            values.setdefault(topic, {})[name] = values.pop(own)
    return values


def stated_of(bound: Sequence[Bound], source: Source) -> dict[str, dict[str, str]]:
    """Return by label the unset parameters that a log's channels contain, as "VALUE (TOPIC)".

    If several topics contain the same value, the first is named.
    """
    found: dict[str, dict[str, dict[str, str]]] = {}
    for each in bound:
        own = found.setdefault(each.name.partition("/")[0], {})
        values = each.parameters.model_dump() if each.parameters is not None else {}
        for topic in (*each.streams, *each.static):
            metadata = source.topics[topic].metadata if topic in source.topics else {}
            for name in (name for name, value in values.items() if value is None and name in metadata):
                own.setdefault(name, {}).setdefault(metadata[name], topic)
    return {
        label: {
            name: ", ".join(f"{value} ({topic})" for value, topic in stating.items())
            for name, stating in own.items()
        }
        for label, own in found.items()
    }


def replay_blocks(
    sources: Sequence[Source],
    bound: Sequence[Bound],
    report: Report,
    *,
    order: Clock = "publish_time",
    late: Late | None = None,
    block_messages: int = BLOCK_MESSAGES,
    is_part: bool = False,
) -> Iterator[dict[str, Ragged]]:
    """Iterate over a replay's outputs by topic, block by block; the last block contains the coverage."""
    blocks = replay(
        sources,
        bound,
        order=order,
        late=late,
        block_messages=block_messages,
        report=report,
        is_part=is_part,
    )
    return map(by_topic, chain(blocks, (report.coverage,)))


def by_topic(block: list[Ragged]) -> dict[str, Ragged]:
    """Join the streams of one block by topic."""
    return collect([block])


def of_run(
    block: Mapping[str, Ragged], errors: Sequence[Errors], run: int
) -> tuple[dict[str, Any], list[Errors]]:
    """Select the streams and the errors of one run for a timeline."""
    streams = {topic: rows.of_run(run) for topic, rows in block.items()}
    return streams, [errors_at(each, each.run == run) for each in errors]


def judge_logs(
    estimates: Sequence[Source],
    sources: Sequence[Source],
    metrics: Mapping[str, Metric[Any, Any]],
    *,
    gap_limit_s: float,
    drawing: "Drawing | None" = None,
    on_errors: Callable[[Errors], None] | None = None,
) -> Judge:
    """Judge the estimates in logs, block by block.

    Args:
        estimates: the estimates of every run.
        sources: the runs, with their truths.
        metrics: the metrics to compute.
        gap_limit_s: the longest gap over which the truth is interpolated.
        drawing: timeline that receives the data of the first run.
        on_errors: function that is called with the errors of every block.

    Raises BadInput if the estimates in a log differ in kind from those in the first log.
    """
    held = [[each for each in source.topics if each.startswith("/estimates/")] for source in estimates]
    for source, topics in zip(estimates, held, strict=True):
        if topics != held[0]:
            raise BadInput(
                f"{source.name}: has other estimates than {estimates[0].name}; judge it separately"
            )
    whole: Judge | None = None
    for now in parts_of(len(sources)):
        judge = Judge(
            sources[now], metrics, gap_limit_s=gap_limit_s, first_run=now.start, on_errors=on_errors
        )
        runs = ensemble_of(estimates[now])
        for block in runs.blocks(held[0], "publish_time", BLOCK_MESSAGES) if held else ():
            judged = judge.add(block)
            if drawing is not None and now.start == 0:
                drawing.add(*of_run(block, judged.errors, 0))
        if whole is None:
            whole = judge
        else:
            whole.merge(judge)
    assert whole is not None
    return whole


def estimates_metadata(
    source: Source, estimators: Settings, path: Path, log: Path, order: Clock = "publish_time"
) -> RunMetadata:
    """Describe the estimates log at `path`: its run, estimators, changes, span, clock and source log.

    The path of the source log is relative to the estimates log, so that both can be moved together.
    """
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    place = reference_to(log, path)
    settings = json.dumps({label: dict(values) for label, values in estimators.items()}, default=str)
    notes = {"log": place, "estimators": settings, **note_of(source), **replayed_note(source, order)}
    return replace(run, notes=notes)
