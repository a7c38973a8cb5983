"""How probable the modes of a model are, as means over the runs for spans of time."""

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import pandas as pd

from replay.judging.metrics import Output
from replay.judging.sums import BinnedSums

# Spans of time: at most so many, of a millisecond times a power of two.
SPANS = 1024
SPAN_NS = 1_000_000


@dataclass
class Modes:
    """Sums over the runs of one stream of mode probabilities.

    Attributes:
        estimator, case: whose they are.
        is_smoothed: whether they are given all data of a run.
        modes: their names.
        sums: by time since the epoch, of that time in seconds and of every probability.
    """

    estimator: str
    case: str
    is_smoothed: bool
    modes: tuple[str, ...]
    sums: BinnedSums = field(repr=False)

    @classmethod
    def of(cls, output: Output) -> Self:
        """No sums yet, for the stream of an output."""
        modes = tuple(output.rows.stream.components)
        sums = BinnedSums(1 + len(modes), width=SPAN_NS, limit=SPANS)
        return cls(output.estimator, output.case, output.leaf == "smoothed_modes", modes, sums)

    def add(self, output: Output) -> None:
        """Take in a block."""
        rows = output.rows
        epochs_ns = np.array([source.epoch_ns for source in output.sources], np.int64)
        elapsed_ns = rows.stream.publish_time_ns - np.repeat(epochs_ns, np.diff(rows.offsets))
        self.sums.add(elapsed_ns, np.column_stack([elapsed_ns * 1e-9, rows["probability"]]))

    def merge(self, other: "Modes") -> None:
        """Take in the sums of other runs."""
        self.sums.merge(other.sums)

    @property
    def table(self) -> pd.DataFrame:
        """One row per span of time and mode: the mean probability, of so many estimates."""
        _, count, sums = self.sums.filled()
        means = sums / count[:, None]
        return pd.DataFrame(
            {
                "estimator": self.estimator,
                "case": self.case,
                "smoothed": self.is_smoothed,
                "elapsed_s": np.repeat(means[:, 0], len(self.modes)),
                "estimates": np.repeat(count.astype(np.int64), len(self.modes)),
                "mode": self.modes * len(count),
                "probability": means[:, 1:].ravel(),
            }
        )
