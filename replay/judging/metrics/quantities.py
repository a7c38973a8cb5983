"""Mergeable sums of the errors of estimates by step and time, and of innovations by run."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled
from fuselog.replay.judging.errors.constant import ConstantSums
from fuselog.replay.judging.errors.evaluation import Errors, Floats, Innovations
from fuselog.replay.judging.metrics.sums import BinnedSums, Bins, Integers, bin_of


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

    def add(self, errors: Errors) -> None:
        """Add a block."""
        self.constant.add(errors)
        if not len(errors.nees):
            return
        time_ns = np.rint(errors.elapsed_s * 1e9).astype(np.int64)
        rows = errors.elapsed_s, errors.squared, errors.covariance, errors.nees
        position, rotation, main = (
            np.array(each, np.int64) for each in (errors.position, errors.rotation, errors.main.columns)
        )
        with (
            self.by_step.filling(errors.step) as steps,
            self.by_time.filling(time_ns, errors.run) as times,
        ):
            _add_errors(*rows, position, rotation, main, steps, times)

    def merge(self, other: "Quantities") -> None:
        """Add the sums of other runs."""
        self.by_step.merge(other.by_step)
        self.by_time.merge(other.by_time)
        self.constant.merge(other.constant)


def add_errors(
    elapsed_s: Floats,
    squared: Floats,
    covariance: Floats,
    nees: Floats,
    position: Integers,
    rotation: Integers,
    main: Integers,
    steps: Bins,
    times: Bins,
) -> None:
    """Sum the numbers of estimates by step and by time; see `Quantities`.

    Args:
        elapsed_s: (n,) elapsed time.
        squared: (n, d) squared errors.
        covariance: (n, d, d).
        nees: (n,).
        position, rotation, main: components of the position, the rotation and the main quantity.
        steps, times: the bins, of 6 + d columns.
    """
    size = squared.shape[1]
    for row in range(len(nees)):
        of_position, of_rotation, trace, of_square = 0.0, 0.0, 0.0, 0.0
        for place in range(len(position)):
            of_position += squared[row, position[place]]
        for place in range(len(rotation)):
            of_rotation += squared[row, rotation[place]]
        for column in range(len(main)):
            trace += covariance[row, main[column], main[column]]
            for other in range(len(main)):
                entry = covariance[row, main[other], main[column]]
                of_square += entry * entry
        for bins in (steps, times):
            sums = bin_of(bins, row)
            sums[0] += 1.0
            sums[1] += elapsed_s[row]
            sums[2] += of_position
            sums[3] += of_rotation
            for column in range(size):
                sums[4 + column] += squared[row, column]
            sums[4 + size] += trace
            sums[5 + size] += of_square
            sums[6 + size] += nees[row]


def add_innovations(
    accepted: NDArray[np.bool_], degrees: Integers, squared: Floats, stated: Floats, runs: Bins
) -> None:
    """Sum the numbers of innovations by run; see `OfRuns`.

    Args:
        accepted, degrees, squared: (n,), as in `Innovations`.
        stated: (n,), log-likelihoods; NaN if they are not stated.
        runs: the bins, of 5 columns.
    """
    for row in range(len(accepted)):
        own, is_accepted = bin_of(runs, row), accepted[row]
        own[0] += 1.0
        own[1] += float(is_accepted)
        own[2] += float(degrees[row])
        own[3] += float(degrees[row]) if is_accepted else 0.0
        own[4] += squared[row]
        own[5] += stated[row] if is_accepted else 0.0


_add_errors = compiled(add_errors, for_sizes=True)
_add_innovations = compiled(add_innovations, for_sizes=True)


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
        count = len(accepted)
        if not count:
            return
        stated = np.full(count, np.nan) if stated is None else stated
        with self._sums.filling(np.zeros(count, np.int64), innovations.run) as runs:
            _add_innovations(accepted, innovations.degrees, innovations.squared, stated, runs)

    def merge(self, other: "InnovationSums") -> None:
        """Add the sums of other runs."""
        self._sums.merge(other._sums)

    def by_run(self) -> tuple[Integers, OfRuns]:
        """Return the runs (runs,) that have innovations, and their sums."""
        runs, count, sums = self._sums.by_group()
        return runs, OfRuns(count, *sums.T)

    @property
    def total(self) -> OfRuns:
        """Return the sums over all runs."""
        of_all = [float(column.sum()) for column in self.by_run()[1]]
        return OfRuns(*(round(each) for each in of_all[:4]), *of_all[4:])
