"""Smoothing of mode probabilities, given all data of a run.

Kim, Journal of Econometrics 60, 1994.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.compiling.kinds import RunOnce
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.inference.modes.mixing import transition_matrix


class SmoothingMemory(NamedTuple):
    """Working memory of one core: Pi (M, M), and ratios of smoothed to predicted probabilities (M,)."""

    transition: Floats
    ratio: Floats


def smoothing_memory(modes: int) -> SmoothingMemory:
    """Allocate memory for smoothing the probabilities of `modes` modes."""
    return SmoothingMemory(np.empty((modes, modes)), np.empty(modes))


@lru_cache(maxsize=16)
def smoothing_over_runs(modes: int) -> OverRuns:
    """Make the loop of `smoothing` over all runs, which is compiled when first called."""
    return compile_over_runs(smoothing(modes), title="the smoother of modes")


def smoothing(modes: int) -> RunOnce:
    """Make `smooth(run, ...)`, which conditions the probabilities (n, M) on all data of a run.

    mu_i(k|T) = mu_i(k) sum_j Pi_ij mu_j(k+1|T) / c_j(k+1), with c = Pi' mu(k).
    """
    fill_transition = transition_matrix(modes)

    def smooth(
        run: int,
        offsets: Integers,
        time_ns: Integers,
        rates: Floats,
        probability: Floats,
        memory: SmoothingMemory,
    ) -> None:
        transition, ratio = memory
        for row in range(offsets[run + 1] - 2, offsets[run] - 1, -1):
            fill_transition(rates, (time_ns[row + 1] - time_ns[row]) * 1e-9, transition)
            for end in range(modes):
                predicted = 0.0
                for begin in range(modes):
                    predicted += probability[row, begin] * transition[begin, end]
                ratio[end] = probability[row + 1, end] / predicted if predicted > 0.0 else 0.0
            for begin in range(modes):
                factor = 0.0
                for end in range(modes):
                    factor += transition[begin, end] * ratio[end]
                probability[row, begin] *= factor

    return smooth
