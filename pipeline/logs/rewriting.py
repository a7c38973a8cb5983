"""Functions that rewrite logs block by block, choose topics, report losses and write the new log."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from fuselog.pipeline.output.outputs import CHANGED_BY, CHANGES
from fuselog.recorders.errors import BadInput, UnknownName, choices
from fuselog.recorders.log import Log, LogWriter, RunMetadata, Stream, read_blocks, read_empty
from fuselog.recorders.log.container.sealed import OWN_NAMES
from fuselog.recorders.log.schemas import message_class
from fuselog.recorders.remote.paths import reference_to, referred_to
from fuselog.replay.engine.streams.sources import LogSource

Blocks = Iterator[list[Stream]]


# The scenario of a log that does not name one, and of its estimates logs.
UNKNOWN = "unknown"


class Changed(NamedTuple):
    """The path of the written log, the number of messages of each topic, and sentences on losses."""

    path: Path
    messages: dict[str, int]
    notes: list[str]


def stream_blocks(
    log: Log, topics: Sequence[str], start_ns: int | None = None, end_ns: int | None = None
) -> Blocks:
    """Yield the blocks of a span; messages with equal stamps are in the order of `topics`."""
    for block in read_blocks(log, topics, start_ns=start_ns, end_ns=end_ns) if topics else ():
        yield [block[topic] for topic in topics if topic in block]


def write_changed(
    target: Path,
    run: RunMetadata,
    empty: Sequence[Stream],
    blocks: Iterable[list[Stream]],
    notes: list[str],
) -> Changed:
    """Write the log, including topics without messages."""
    messages = Counter({stream.topic: 0 for stream in empty})
    with LogWriter(target, run) as writer:
        writer.write(empty)
        for block in blocks:
            writer.write(block)
            messages.update({stream.topic: len(stream) for stream in block})
    return Changed(target, dict(messages), notes)


def ranked(log: Log) -> list[str]:
    """Sort topics as the log declares them; messages with equal stamps follow the same order."""
    return sorted(log.topics, key=lambda topic: log.topics[topic].channel_ids)


def matching_topics(log: Log, patterns: Sequence[str]) -> list[str]:
    """Return the topics that match a name or pattern, or all topics if there are no patterns."""
    for pattern in patterns:
        if not any(fnmatchcase(topic, pattern) for topic in log.topics):
            raise UnknownName(f"{log.path}: no topic {pattern}; {choices(pattern, log.topics)}")
    return [
        topic
        for topic in ranked(log)
        if not patterns or any(fnmatchcase(topic, pattern) for pattern in patterns)
    ]


def losses_of(log: Log) -> list[str]:
    """Describe what is missing in a log, and which of its contents are not copied."""
    foreign = [name for name in log.container.metadata if not name.startswith(OWN_NAMES)]
    losses = [log.loss_statement] if log.loss_statement else []
    if log.mirrors:
        losses.append(
            f"{log.path}: the Foxglove mirror is not copied; to make one of the new log: "
            "fuselog export LOG --to foxglove"
        )
    if foreign:
        losses.append(
            f"{log.path}: metadata of other programs is not copied: {', '.join(sorted(foreign))}"
        )
    if attachments := log.container.attachments:
        losses.append(
            f"{log.path}: attachments, which fuselog does not read, are not copied: "
            f"{len(attachments)} ({', '.join(attachments)})"
        )
    return losses


def readable_log(
    log: Log, topics: Sequence[str], notes: list[str], asked: Sequence[str] = ()
) -> list[str]:
    """Return the topics that fuselog can read as columns, and note the omitted messages and fields.

    Raises BadInput if a topic requested by name, or every topic, cannot be read.
    """
    chosen = []
    for topic in topics:
        stated = log.topics[topic]
        try:
            schema = read_empty(log, topic).schema
        except BadInput as error:
            if topic in asked:
                raise
            notes.append(f"{error}; its {stated.messages} messages are not copied")
            continue
        chosen.append(topic)
        described = log.container.schemas[log.container.channels[stated.channel_ids[0]].schema_id]
        fields = message_class(described.data, described.name).DESCRIPTOR.fields
        left_out = {field.name for field in fields} - {field.name for field in schema}
        if left_out:
            notes.append(
                f"{log.path}: topic {topic}: fields that cannot become columns are not copied: "
                f"{', '.join(sorted(left_out))}"
            )
    if not chosen:
        raise BadInput(
            f"{log.path}: has no topic that fuselog can read; import it first, for example a ROS log "
            f"with: fuselog import ros {log.path}"
        )
    return chosen


def run_of(log: Log, target: Path) -> RunMetadata:
    """Return a log's run; for estimates, with the source log's path relative to the target's folder."""
    run = log.run or RunMetadata(UNKNOWN, epoch_ns=LogSource(log).epoch_ns)
    if "log" not in run.notes:
        return run
    place = reference_to(referred_to(run.notes["log"], log.path), target)
    return replace(run, notes={**run.notes, "log": place})


def joined_runs(logs: Sequence[Log], offsets_ns: Sequence[int], target: Path) -> RunMetadata:
    """Return the logs' common run or, if runs or clocks differ, an unknown run with all notes."""
    runs = [run_of(log, target) for log in logs]
    notes: dict[str, str] = {}
    for log, run in zip(logs, runs, strict=True):
        for subject, fact in run.notes.items():
            if subject == CHANGED_BY:
                continue
            is_new = notes.get(subject, fact) == fact
            notes[subject if is_new else f"{subject} ({log.path.name})"] = fact
    first, *others = (replace(run, notes=notes) for run in runs)
    if all(other == first for other in others) and not any(offsets_ns):
        return first
    return RunMetadata(UNKNOWN, epoch_ns=max(0, first.epoch_ns + offsets_ns[0]), notes=notes)


def with_operation(run: RunMetadata, command: str, done: str) -> RunMetadata:
    """Append an operation to the list of changes in the notes of a run."""
    before = [run.notes[CHANGES]] if CHANGES in run.notes else []
    return replace(run, notes={**run.notes, CHANGES: "; ".join([*before, done]), CHANGED_BY: command})
