"""Means of estimator diagnostics over runs and time spans.

The diagnostics are probabilities of modes, the effective share of particles, and out-of-sequence
messages.
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

# Largest number of time spans, and their shortest length in ns; lengths are doubled as needed.
SPANS = 1024
SPAN_NS = 1_000_000
MODES, SMOOTHED_MODES, EFFECTIVE = "modes", "smoothed_modes", "effective_share"
# Treatment of out-of-sequence messages.
DROPPED, INSERTED, WAITED = "dropped", "inserted", "waited for"
LATE = (DROPPED, INSERTED, WAITED)


class OutputDiagnostics(NamedTuple):
    """Diagnostics in one output.

    Attributes:
        what: kind of diagnostics: MODES, SMOOTHED_MODES, EFFECTIVE, or one of LATE.
        names: names of the values.
        values: (n, names), NaN in rows without a value.
    """

    what: str
    names: tuple[str, ...]
    values: Floats


def diagnostics_of(output: Output) -> OutputDiagnostics | None:
    """Extract those diagnostics of an output that can be averaged over time; None if there are none."""
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
    """Compute the delay (n,) in s from the measurement of messages to their processing."""
    return (stream.log_time_ns - stream.publish_time_ns).astype(np.float64) * 1e-9


@dataclass
class Means:
    """Sums over the runs of the diagnostics in one stream.

    Attributes:
        estimator, case: the estimator and the estimated object.
        what, names: see `OutputDiagnostics`.
        sums: sums of the time since the epoch (s) and of every value, in bins of this time.
    """

    estimator: str
    case: str
    what: str
    names: tuple[str, ...]
    sums: BinnedSums = field(repr=False)

    def add(self, output: Output, values: Floats) -> None:
        """Add a block."""
        rows = output.rows
        epochs_ns = np.array([source.epoch_ns for source in output.sources], np.int64)
        elapsed_ns = rows.stream.publish_time_ns - np.repeat(epochs_ns, np.diff(rows.offsets))
        tells = np.isfinite(values[:, 0])
        columns = np.column_stack([elapsed_ns * 1e-9, values])
        self.sums.add(elapsed_ns[tells], columns[tells])

    @property
    def table(self) -> "pd.DataFrame":
        """Return a table with one row per time span: mean time, number of messages, mean values."""
        import pandas as pd  # slow to import

        _, count, sums = self.sums.filled()
        means = pd.DataFrame(sums / count[:, None], columns=["elapsed_s", *self.names])
        means.insert(0, "estimator", self.estimator)
        means.insert(1, "case", self.case)
        means.insert(3, "messages", count.astype(np.int64))
        return means


class MeansOfAll:
    """Means of the diagnostics in all streams of a replay."""

    def __init__(self) -> None:
        self._of: dict[str, Means] = {}

    def add(self, output: Output) -> None:
        """Add a block of a stream, if it has diagnostics."""
        diagnostics = diagnostics_of(output)
        if diagnostics is None or not len(diagnostics.values):
            return
        topic, (what, names, values) = output.rows.stream.topic, diagnostics
        if topic not in self._of:
            sums = BinnedSums(1 + len(names), width=SPAN_NS, limit=SPANS)
            self._of[topic] = Means(output.estimator, output.case, what, names, sums)
        self._of[topic].add(output, values)

    def merge(self, other: "MeansOfAll") -> None:
        """Add the sums of other runs."""
        for topic, means in other._of.items():
            if topic in self._of:
                self._of[topic].sums.merge(means.sums)
            else:
                self._of[topic] = means

    def _tables(self, *wanted: str) -> "Iterator[tuple[str, pd.DataFrame]]":
        """Yield the kind of diagnostics and the table of every stream with one of the wanted kinds."""
        for means in self._of.values():
            if means.what in wanted and len(table := means.table):
                yield means.what, table

    def modes(self) -> "Iterator[pd.DataFrame]":
        """Yield tables of mode probabilities: a row per time span and mode."""
        for what, table in self._tables(MODES, SMOOTHED_MODES):
            fixed = ["index", "estimator", "case", "elapsed_s", "estimates"]
            wide = table.rename(columns={"messages": "estimates"}).reset_index()
            long = wide.melt(fixed, var_name="mode", value_name="probability")
            long = long.sort_values("index", kind="stable").drop(columns="index")
            long.insert(2, "smoothed", what == SMOOTHED_MODES)
            yield long

    def effective(self) -> "Iterator[pd.DataFrame]":
        """Yield tables of the effective share of particles: a row per time span."""
        for _, table in self._tables(EFFECTIVE):
            yield table.rename(columns={"messages": "estimates"})

    def late(self) -> "Iterator[pd.DataFrame]":
        """Yield tables of out-of-sequence messages: a row per time span and treatment.

        `late_s` is the mean delay, `repeated` the mean number of other messages that were reprocessed.
        """
        for what, table in self._tables(*LATE):
            table.insert(2, "became", what)
            yield table
