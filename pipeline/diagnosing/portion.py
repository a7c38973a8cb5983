"""The data to diagnose: the first part of a long log, or the estimates that an autopilot recorded."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.altering.sources import alter, split_settings
from fuselog.pipeline.api.replays import Replay, replay
from fuselog.pipeline.comparing.renamed import Renamed
from fuselog.pipeline.diagnosing.advice import number
from fuselog.pipeline.runs.ensemble import Pass, judge_logs
from fuselog.pipeline.tuning.objective import for_likelihood
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Schema, Stream, schemas, topics_of
from fuselog.recorders.log.streams import concatenate
from fuselog.recorders.parameters import merge
from fuselog.replay.engine.replaying.estimator import Bound
from fuselog.replay.engine.streams.blocks import Findings
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.metrics.measuring import find_metrics

MOST_MESSAGES = 40_000  # number of messages from the start of a log in which causes are searched for


class Outputs(Mapping[str, Stream]):
    """A mapping from topics to those outputs of a replay that have a given schema.

    Only the last topic is cached, because the outputs of a long log take much memory.
    """

    def __init__(self, done: Replay, schema: Schema) -> None:
        self._estimates, self._known = done.estimates[0], Findings(most=1)
        topics = self._estimates.topics
        self._topics = [name for name in topics_of(topics, schema) if topics[name].messages]

    def __getitem__(self, topic: str) -> Stream:
        stream: Stream = self._known.once(topic, lambda: self._estimates.read([topic])[topic])
        return stream

    def __iter__(self) -> Iterator[str]:
        return iter(self._topics)

    def __len__(self) -> int:
        return len(self._topics)

    def state(self, column: str) -> bool:
        """Test whether all outputs have a column."""
        firsts = (next(iter(self._estimates.blocks([topic], "publish_time", 1))) for topic in self)
        return all(column in stream.columns for first in firsts for stream in first.values())


def silent(name: str, label: str, bound: Sequence[Bound], settings: Mapping[str, Any]) -> BadInput:
    """Return the error for an estimator that has no innovations on a log of this name."""
    offers = (offer for each in bound for offer in getattr(each, "offers", {}).items())
    topic, setting = next(offers, ("", ""))
    remedy = for_likelihood(settings) or "use a filter of the same model, such as -e ekf"
    if topic:
        remedy = f"it does not use {topic}, unless you give {setting}"
    return BadInput(f"{name}: {label} gives no innovations, which a diagnosis needs; {remedy}")


def recorded(source: LogSource | MemorySource, label: str, gap_limit_s: float) -> Replay:
    """Return an estimator's recorded estimates in the form of a replay's."""
    estimates = Renamed(source, label, label)
    judge = judge_logs([estimates], [source], find_metrics(), gap_limit_s=gap_limit_s)
    return Replay([source], [estimates], {label: {}}, Pass(judge, {label: {}}), gap_limit_s)


class Portion(NamedTuple):
    """The messages of a log that the estimator reads, until `end_ns`; None for the whole log."""

    source: MemorySource
    end_ns: int | None
    note: str


def first_part(
    source: LogSource | MemorySource, bound: Sequence[Bound], streamed: Sequence[str]
) -> Portion:
    """Read the topics that the estimator uses, at most the log's first MOST_MESSAGES messages."""
    whole = dict.fromkeys(topic for each in bound for topic in each.static)
    streams = source.read([topic for topic in whole if topic in source.topics])
    parts: dict[str, list[Stream]] = {topic: [] for topic in streamed}
    stamps_ns = np.empty(0, np.int64)
    for block in source.blocks(streamed, "publish_time", MOST_MESSAGES):
        for topic, stream in block.items():
            parts[topic].append(stream)
        stamps_ns = np.concatenate([stamps_ns, *(stream.publish_time_ns for stream in block.values())])
        if len(stamps_ns) > MOST_MESSAGES:
            break
    for topic, found in parts.items():
        streams[topic] = concatenate(found) if found else source.empty(topic)
    for each in bound:  # a setting may name the truth, whose errors are not needed here
        if each.truth in source.topics:
            streams.setdefault(each.truth, source.empty(each.truth))
    end_ns, note = None, ""
    if len(stamps_ns) > MOST_MESSAGES:
        end_ns = int(np.partition(stamps_ns, MOST_MESSAGES)[MOST_MESSAGES])
        for topic in streamed:
            streams[topic] = streams[topic].take(streams[topic].publish_time_ns < end_ns)
        count = sum(source.topics[topic].messages for topic in streamed)
        note = (
            f"causes were searched in the first {(end_ns - source.epoch_ns) * 1e-9:.4g} s "
            f"({MOST_MESSAGES} of {count} messages) and tested on the rest; use fuselog cut to diagnose "
            "another part"
        )
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    part = MemorySource(streams, run, source.name)
    return Portion(part, end_ns, note)


def on_the_rest(
    source: LogSource | MemorySource,
    label: str,
    settings: Mapping[str, Any],
    advised: Mapping[str, Any],
    end_ns: int,
) -> str:
    """Compute the gain of advice over the rest of the log, and format it as the end of a sentence.

    Args:
        source: the whole log.
        label: the estimator's label.
        settings: the estimator's parameters, with an open gate.
        advised: the advised settings of topics and parameters.
        end_ns: the end of the part in which the cause was found.
    """
    of_topics, own = split_settings(advised)
    before, after = (
        _likelihood(alter(source, altering), label, given, end_ns)
        for altering, given in (({}, settings), (of_topics, merge(settings, own)))
    )
    gain = after - before
    if not np.isfinite(gain):
        return ""
    if gain > 0.0:
        return f", and {number(gain, 4)} over the rest of the log"
    return f"; but over the rest of the log it loses {number(-gain, 4)}: it is not valid there"


def _likelihood(
    source: LogSource | MemorySource, label: str, settings: Mapping[str, Any], end_ns: int
) -> float:
    """Compute the log-likelihood of all innovations from a stamp on."""
    done = replay(source, {label: settings})
    total = 0.0
    for stream in Outputs(done, schemas.INNOVATION).values():
        total += float(np.nansum(stream["log_likelihood"][stream.publish_time_ns >= end_ns]))
    return total
