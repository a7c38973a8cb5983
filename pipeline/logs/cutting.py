"""Decimation of streams, and choice of the topics that a cut log keeps completely."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fuselog.pipeline.logs.rewriting import stream_blocks
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Log, Stream, schemas
from fuselog.replay.engine.streams.sources import LogSource


def static_topics(log: Log, topics: Sequence[str]) -> list[str]:
    """List maps, priors, and topics whose messages all have the first stamp of the log."""
    first_ns, _ = LogSource(log).extent("publish_time")
    early: Counter[str] = Counter()
    for block in stream_blocks(log, topics, None, first_ns + 1):
        early.update({stream.topic: len(stream) for stream in block})
    return [
        topic
        for topic in topics
        if (stated := log.topics[topic]).messages
        and (
            stated.schema_name == schemas.LANDMARK.full_name
            or is_prior(log, topic)
            or stated.messages == early[topic]
        )
    ]


def is_prior(log: Log, topic: str) -> bool:
    """Test whether a topic is a prior: a Gaussian estimate that was not written by a replay."""
    schema = log.topics[topic].schema_name
    return schema == schemas.GAUSSIAN_ESTIMATE.full_name and not topic.startswith("/estimates/")


@dataclass
class Thinner:
    """A filter that keeps the first stamp of each interval, which is a number of stamps or a duration.

    `stamps` is the number of stamps in earlier blocks, and `last` is the index of the last stamp's
    interval.
    """

    every: int = 0
    rate_hz: float = 0.0
    zero_ns: int = 0
    stamps: int = 0
    last: int | None = None

    def thin(self, stream: Stream) -> Stream:
        """Decimate the next block of the topic, which must not be empty."""
        times_ns, row = np.unique(stream.publish_time_ns, return_inverse=True)
        if self.every:
            interval = (self.stamps + np.arange(len(times_ns))) // self.every
        else:  # adds 1 ns, because stamps are rounded
            interval = np.floor((times_ns - self.zero_ns + 1) * (self.rate_hz * 1e-9)).astype(np.int64)
        is_first = np.append(self.last is None or interval[0] != self.last, np.diff(interval) != 0)
        self.stamps += len(times_ns)
        self.last = int(interval[-1])
        return stream.take(is_first[row])


def thinner(topic: str, rate: int | str, zero_ns: int) -> Thinner:
    """Make a topic's thinner: a `rate` of 10 keeps every tenth stamp; "5Hz" keeps five per second."""
    text = str(rate)
    try:
        if text.lower().endswith("hz"):
            rate_hz = float(text[:-2])
            if 0 < rate_hz < math.inf:
                return Thinner(rate_hz=rate_hz, zero_ns=zero_ns)
        elif int(text) > 0:
            return Thinner(every=int(text))
    except ValueError:
        pass
    raise BadInput(
        f"decimate {topic}={text}: expected a whole number, such as 10 for every tenth stamp, or a "
        "rate, such as 5Hz"
    )
