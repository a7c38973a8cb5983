"""Averages estimators' diagnostics over the runs, for spans of time.

Such are the probabilities of modes, the effective share of particles, and messages that came late.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.replaying.late import OLDER
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.judging.metrics.measuring import Output
from fuselog.replay.judging.metrics.sums import BinnedSums

if TYPE_CHECKING:
    import pandas as pd

# Spans of time: at most so many, of a millisecond times a power of two.
SPANS = 1024
SPAN_NS = 1_000_000
MODES, SMOOTHED_MODES, EFFECTIVE = "modes", "smoothed_modes", "effective_share"
# What became of messages that came late.
DROPPED, INSERTED, WAITED = "dropped", "inserted", "waited for"
LATE = (DROPPED, INSERTED, WAITED)


class OutputDiagnostics(NamedTuple):
    """Holds what one output tells.

    Attributes:
        what: one of the names above.
        names: of the values.
        values: (n, names), NaN in rows that tell nothing.
    """

    what: str
    names: tuple[str, ...]
    values: Floats


def diagnostics_of(output: Output) -> OutputDiagnostics | None:
    """Read what an output tells that has a mean over time; None where it is of another kind."""
    stream = output.rows.stream
    schema = stream.schema.full_name
    if schema == schemas.MODE_PROBABILITIES.full_name:
        what = SMOOTHED_MODES if output.leaf == SMOOTHED_MODES else MODES
        return OutputDiagnostics(what, tuple(stream.components), stream["probability"])
    if schema == schemas.EFFECTIVE_PARTICLES.full_name:
        return OutputDiagnostics(
            EFFECTIVE, (EFFECTIVE,), (stream["effective"] / stream["particles"])[:, None]
        )
    if schema == schemas.SKIPPED.full_name:
        is_older = np.array([OLDER in reason for reason in sentences_of(stream)], bool)
        late_s = np.where(is_older, _late_s(stream), np.nan)
        return OutputDiagnostics(DROPPED, ("late_s",), late_s[:, None])
    if schema == schemas.REWOUND.full_name:
        values = np.column_stack([_late_s(stream), stream["repeated"]])
        return OutputDiagnostics(INSERTED, ("late_s", "repeated"), values)
    if schema == schemas.WAITED.full_name:
        return OutputDiagnostics(WAITED, ("late_s",), _late_s(stream)[:, None])
    return None


def _late_s(stream: Stream) -> Floats:
    """Compute how long after they were measured messages (n,) were taken."""
    return (stream.log_time_ns - stream.publish_time_ns).astype(np.float64) * 1e-9


@dataclass
class Means:
    """Sums over the runs what one stream tells.

    Attributes:
        estimator, case: whose it is.
        what, names: see `OutputDiagnostics`.
        sums: by time since the epoch, of that time in seconds and of every value.
    """

    estimator: str
    case: str
    what: str
    names: tuple[str, ...]
    sums: BinnedSums = field(repr=False)

    def add(self, output: Output, values: Floats) -> None:
        """Take in a block."""
        rows = output.rows
        epochs_ns = np.array([source.epoch_ns for source in output.sources], np.int64)
        elapsed_ns = rows.stream.publish_time_ns - np.repeat(epochs_ns, np.diff(rows.offsets))
        tells = np.isfinite(values[:, 0])
        columns = np.column_stack([elapsed_ns * 1e-9, values])
        self.sums.add(elapsed_ns[tells], columns[tells])

    @property
    def table(self) -> "pd.DataFrame":
        """Return one row per span of time: its mean time, count of messages, mean of every value."""
        import pandas as pd  # which takes long to import

        _, count, sums = self.sums.filled()
        means = pd.DataFrame(sums / count[:, None], columns=["elapsed_s", *self.names])
        means.insert(0, "estimator", self.estimator)
        means.insert(1, "case", self.case)
        means.insert(3, "messages", count.astype(np.int64))
        return means


class MeansOfAll:
    """Holds the means of all streams of a replay."""

    def __init__(self) -> None:
        self._of: dict[str, Means] = {}

    def add(self, output: Output) -> None:
        """Take in a block of a stream, if it tells anything of the kind."""
        diagnostics = diagnostics_of(output)
        if diagnostics is None or not len(diagnostics.values):
            return
        topic, (what, names, values) = output.rows.stream.topic, diagnostics
        if topic not in self._of:
            sums = BinnedSums(1 + len(names), width=SPAN_NS, limit=SPANS)
            self._of[topic] = Means(output.estimator, output.case, what, names, sums)
        self._of[topic].add(output, values)

    def merge(self, other: "MeansOfAll") -> None:
        """Take in the sums of other runs."""
        for topic, means in other._of.items():
            if topic in self._of:
                self._of[topic].sums.merge(means.sums)
            else:
                self._of[topic] = means

    def _tables(self, *wanted: str) -> "Iterator[tuple[str, pd.DataFrame]]":
        """Yield what is told and its table, of every stream that tells one of what is wanted."""
        for means in self._of.values():
            if means.what in wanted and len(table := means.table):
                yield means.what, table

    def modes(self) -> "Iterator[pd.DataFrame]":
        """Return how probable modes are: a row per span of time and mode."""
        for what, table in self._tables(MODES, SMOOTHED_MODES):
            fixed = ["index", "estimator", "case", "elapsed_s", "estimates"]
            wide = table.rename(columns={"messages": "estimates"}).reset_index()
            long = wide.melt(fixed, var_name="mode", value_name="probability")
            long = long.sort_values("index", kind="stable").drop(columns="index")
            long.insert(2, "smoothed", what == SMOOTHED_MODES)
            yield long

    def effective(self) -> "Iterator[pd.DataFrame]":
        """Return the effective share of the particles: a row per span of time."""
        for _, table in self._tables(EFFECTIVE):
            yield table.rename(columns={"messages": "estimates"})

    def late(self) -> "Iterator[pd.DataFrame]":
        """Yield the messages that came late: a row per span of time and what became of them.

        `late_s` is their mean delay, `repeated` how many others were used again for one on average.
        """
        for what, table in self._tables(*LATE):
            table.insert(2, "became", what)
            yield table
