"""Frozen reference: the Bingham filters of axes and orientations, one loop over all runs.

As they were before filters were made from models (issue 13), to be timed against and for nothing else.
What a Bingham distribution is turned, predicted and updated by is not the filter's but its own, and is
taken from `fuselog.replay.families.directional.distributions`.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.through_numba import numba_over_runs
from fuselog.replay.families.directional.distributions.bingham import Bingham
from fuselog.replay.families.directional.distributions.bingham_kernels import (
    predict,
    turn_columns,
    update,
)


class Steps(NamedTuple):
    """The steps of many runs end to end: run r owns the rows offsets[r]:offsets[r + 1].

    A row is a prediction with a known increment u, then an update with a measurement z; a row of NaN
    in either leaves that half of the step out.

    Attributes:
        offsets: (runs + 1,).
        increment: unit vectors u (rows, d), the identity (1, 0, ...) where there is no control input.
        measurement: unit vectors z (rows, d).
    """

    offsets: NDArray[np.int64]
    increment: NDArray[np.float64]
    measurement: NDArray[np.float64]


def filter_runs(
    steps: Steps, system: NDArray, inverse_noise: NDArray, state: Bingham, estimates: Bingham
) -> None:
    """Fill the estimates of all rows, and leave the state after the last in `state`.

    `system` is the system noise's second moment, `inverse_noise` the parameter matrix of the measurement
    noise's likelihood.
    """
    compiled()(len(steps.offsets) - 1, steps, system, inverse_noise, state, estimates)


@cache
def compiled() -> Callable[..., None]:
    """The loop over the runs."""
    return numba_over_runs(filter_run)


def filter_run(
    run: int, steps: Steps, system: NDArray, inverse_noise: NDArray, state: Bingham, estimates: Bingham
) -> None:
    """The steps of one run."""
    axes, z = state.axes[run], state.concentrations[run]
    for row in range(steps.offsets[run], steps.offsets[run + 1]):
        if not math.isnan(steps.increment[row, 0]):
            turn_columns(axes, steps.increment[row])
            if not predict(axes, z, system):
                z[:] = np.nan
        if not math.isnan(steps.measurement[row, 0]):
            update(axes, z, inverse_noise, steps.measurement[row])
        if math.isnan(z[0]):
            # NaN stays: all later rows of the run are NaN as well
            axes[:] = np.nan
        estimates.axes[row] = axes
        estimates.concentrations[row] = z
