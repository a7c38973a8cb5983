"""Mergeable sums of the errors of estimates by step and time, and of innovations by run."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled
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
    columns = np.empty((len(errors.nees), 6 + len(errors.components)))
    position, rotation, main = (
        np.array(each, np.int64) for each in (errors.position, errors.rotation, errors.main.columns)
    )
    squared = errors.elapsed_s, errors.squared, errors.covariance, errors.nees
    _fill_columns(*squared, position, rotation, main, columns)
    return columns


def fill_columns(
    elapsed_s: Floats,
    squared: Floats,
    covariance: Floats,
    nees: Floats,
    position: Integers,
    rotation: Integers,
    main: Integers,
    columns: Floats,
) -> None:
    """Fill the rows (n, 6 + d) to sum; see `Quantities`.

    Args:
        elapsed_s: (n,) elapsed time.
        squared: (n, d) squared errors.
        covariance: (n, d, d).
        nees: (n,).
        position, rotation, main: components of the position, the rotation and the main quantity.
        columns: (n, 6 + d), filled.
    """
    size = squared.shape[1]
    for row in range(len(nees)):
        columns[row, 0], columns[row, 5 + size] = elapsed_s[row], nees[row]
        for column in range(1, 3):
            columns[row, column] = 0.0
        for place in range(len(position)):
            columns[row, 1] += squared[row, position[place]]
        for place in range(len(rotation)):
            columns[row, 2] += squared[row, rotation[place]]
        for column in range(size):
            columns[row, 3 + column] = squared[row, column]
        trace, of_square = 0.0, 0.0
        for column in range(len(main)):
            trace += covariance[row, main[column], main[column]]
            for other in range(len(main)):
                entry = covariance[row, main[other], main[column]]
                of_square += entry * entry
        columns[row, 3 + size], columns[row, 4 + size] = trace, of_square


def fill_innovations(
    accepted: NDArray[np.bool_], degrees: Integers, squared: Floats, stated: Floats, columns: Floats
) -> None:
    """Fill the rows to sum for innovations; see `OfRuns`.

    Args:
        accepted, degrees, squared: (n,), as in `Innovations`.
        stated: (n,), log-likelihoods; NaN if they are not stated.
        columns: (n, 5), filled.
    """
    for row in range(len(columns)):
        is_accepted = accepted[row]
        columns[row, 0], columns[row, 1] = float(is_accepted), float(degrees[row])
        columns[row, 2] = float(degrees[row]) if is_accepted else 0.0
        columns[row, 3] = squared[row]
        columns[row, 4] = stated[row] if is_accepted else 0.0


_fill_columns, _fill_innovations = compiled(fill_columns), compiled(fill_innovations)


class OfRuns(NamedTuple):
    """Statistics of innovations, for each run (runs,) or for all runs.

    Attributes:
        messages, accepted: number of innovations, and number of those that a gate accepted.
        degrees, accepted_degrees: numbers of measured components of these innovations.
        squared: the sum of NIS.
        log_likelihood: sum over accepted innovations; NaN unless it is stated for all of them.
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
        columns = np.empty((len(accepted), len(OfRuns._fields) - 1))
        stated = np.full(len(columns), np.nan) if stated is None else stated
        _fill_innovations(accepted, innovations.degrees, innovations.squared, stated, columns)
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
