"""Keeps the sums of an estimate stream's errors by step and by time, which merge."""

from dataclasses import dataclass, field

import numpy as np

from replay.judging.errors.constant import ConstantSums
from replay.judging.errors.evaluation import Errors, Floats
from replay.judging.metrics.sums import BinnedSums


@dataclass
class Quantities:
    """Sums of one estimate stream: what tables and figures are made of.

    The columns of both sums are elapsed time, squared error of the position, of the rotation and of
    each component, trace of the main quantity's covariance and of its square, and NEES. `constant` tells
    an error that stays.
    """

    errors: Errors  # the last block: for names and kinds
    by_step: BinnedSums
    by_time: BinnedSums
    constant: ConstantSums = field(default_factory=ConstantSums)

    def merge(self, other: "Quantities") -> None:
        """Take in the sums of other runs."""
        self.by_step.merge(other.by_step)
        self.by_time.merge(other.by_time)
        self.constant.merge(other.constant)


def columns_of(errors: Errors) -> Floats:
    """Rows (n, 6 + d) of what is summed; see `Quantities`."""
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
