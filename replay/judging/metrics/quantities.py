"""Mergeable sums of the errors of estimates by step and time, and of innovations by run."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from fuselog.replay.judging.errors.constant import ConstantSums
from fuselog.replay.judging.errors.evaluation import Errors, Floats, Innovations
from fuselog.replay.judging.metrics.sums import BinnedSums, Integers


@dataclass
class Quantities:
    """Sums of one stream of estimates, from which tables and figures are made.

    The columns of both sums are the elapsed time, the squared error of the position, of the rotation and
    of each component, the trace of the main quantity's covariance and of its square, and the NEES.
    `constant` has the sums by which a constant error is detected.
    """

    errors: Errors  # the last block, for its names and kinds
    by_step: BinnedSums
    by_time: BinnedSums
    constant: ConstantSums = field(default_factory=ConstantSums)

    def merge(self, other: "Quantities") -> None:
        """Add the sums of other runs."""
        self.by_step.merge(other.by_step)
        self.by_time.merge(other.by_time)
        self.constant.merge(other.constant)


def columns_of(errors: Errors) -> Floats:
    """Compute the rows (n, 6 + d) to sum; see `Quantities`."""
    squared = errors.squared
    main = errors.main.columns
    covariance = errors.covariance[:, main][:, :, main]
    return np.column_stack(
        [
            errors.elapsed_s,
            squared[:, errors.position].sum(axis=1),
            squared[:, errors.rotation].sum(axis=1),
            squared,
            np.trace(covariance, axis1=1, axis2=2),
            np.sum(covariance**2, axis=(1, 2)),
            errors.nees,
        ]
    )


class OfRuns(NamedTuple):
    """Statistics of innovations, for each run (runs,) or for all runs.

    Attributes:
        messages, accepted: number of innovations, and number of those that a gate accepted.
        degrees, accepted_degrees: numbers of measured components of these innovations.
        squared: the sum of NIS.
        log_likelihood: sum over accepted innovations; NaN if it is not stated for all of them.
    """

    messages: Any
    accepted: Any
    degrees: Any
    accepted_degrees: Any
    squared: Any
    log_likelihood: Any


class InnovationSums:
    """Sums of one stream of innovations by run, starting with a first run."""

    def __init__(self, first_run: int) -> None:
        self.first_run = first_run
        self._sums = BinnedSums(len(OfRuns._fields) - 1, first=first_run)

    def add(self, innovations: Innovations) -> None:
        """Add a block."""
        stated, accepted = innovations.log_likelihood, innovations.accepted
        accepted_likelihood = np.where(accepted, np.nan if stated is None else stated, 0.0)
        degrees = innovations.degrees
        columns = np.column_stack(
            [accepted, degrees, degrees * accepted, innovations.squared, accepted_likelihood]
        ).astype(float)
        self._sums.add(np.zeros(len(columns), np.int64), columns, innovations.run)

    def merge(self, other: "InnovationSums") -> None:
        """Add the sums of other runs."""
        self._sums.merge(other._sums)

    def by_run(self) -> tuple[Integers, OfRuns]:
        """Return the runs (runs,) that have innovations, and their sums."""
        cells, count, sums = self._sums.filled()
        return cells[:, 0], OfRuns(count, *sums.T)

    @property
    def total(self) -> OfRuns:
        """Return the sums over all runs."""
        of_all = [float(column.sum()) for column in self.by_run()[1]]
        return OfRuns(*(round(each) for each in of_all[:4]), *of_all[4:])
