"""Frozen reference: the sampling filter of the batch reactor, specialised by hand; and in C.

As they were before filters were made from models (issue 13), to be timed against and for nothing else.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from tests.bench.reference import c
from tests.bench.reference.gaussian import (
    ALL_WELL,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    Floats,
    Function,
    Innovation,
    SampleMemory,
    SampleSets,
    correct,
    is_finite,
    no_innovation,
    regression,
    sample_memory,
)


class Steps(NamedTuple):
    """A filter's steps before the Kalman update; both tell whether the covariance is positive definite.

    predict(mean, covariance, noise, step, memory) moves mean (n,) and covariance (n, n) in place.
    innovate(mean, covariance, measured, noise, innovation, step, memory) fills the innovation. One of
    them may use the step's samples.
    """

    predict: Function
    innovate: Function


class Carried(NamedTuple):
    """What a filter carries from block to block; first axis = run; see `gaussian.FAILURES`."""

    mean: Floats
    covariance: Floats
    time_ns: NDArray[np.int64]
    failure: NDArray[np.int64]


class Results(NamedTuple):
    """What the kernel fills; first axis = measurement; NaN where a run failed before."""

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats


def copy_gaussian(mean: Floats, covariance: Floats, to_mean: Floats, to_covariance: Floats) -> None:
    """Copy a mean and its covariance."""
    for i in range(len(mean)):
        to_mean[i] = mean[i]
        for j in range(len(mean)):
            to_covariance[i, j] = covariance[i, j]


def stepwise(steps: Steps) -> Function:
    """The loop over the measurements of one run, specialised to a filter; changes `carried` in place."""
    predict, innovate = steps

    def step(
        row: int,
        mean: Floats,
        covariance: Floats,
        measured: Floats,
        noise: Floats,
        gate: Floats,
        results: Results,
        scratch: tuple[Innovation, SampleMemory],
    ) -> int:
        """Take one measurement in; returns what failed, ALL_WELL where nothing did."""
        innovation, memory = scratch
        if not predict(mean, covariance, noise, row, memory):
            return NOT_POSITIVE_DEFINITE
        if not innovate(mean, covariance, measured, noise, innovation, row, memory):
            return NOT_POSITIVE_DEFINITE
        difference, spread = results.innovation[row], results.innovation_covariance[row]
        copy_gaussian(innovation.difference, innovation.covariance, difference, spread)
        squared, _ = correct(mean, covariance, innovation, gate)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        if not is_finite(mean, covariance):
            return NOT_FINITE
        copy_gaussian(mean, covariance, results.mean[row], results.covariance[row])
        results.squared[row] = squared
        return ALL_WELL

    def filter_run(
        run: int,
        offsets: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        measured: Floats,
        noise: Floats,
        gate: Floats,
        carried: Carried,
        results: Results,
        scratch: tuple[Innovation, SampleMemory],
    ) -> None:
        mean, covariance = carried.mean[run], carried.covariance[run]
        for row in range(offsets[run], offsets[run + 1]):
            if carried.failure[run] != ALL_WELL:
                break
            carried.time_ns[run] = time_ns[row]
            carried.failure[run] = step(
                row, mean, covariance, measured[row], noise, gate, results, scratch
            )

    return filter_run


CONSUMED = -0.32
PRODUCED = 0.16


def react(pressures: Floats, duration_s: float) -> tuple[float, float]:
    """The pressures after one time step, without noise."""
    reacted = duration_s * pressures[0] * pressures[0]
    return pressures[0] + CONSUMED * reacted, pressures[1] + PRODUCED * reacted


regress = regression(react, (False, False), states=2)


def predict_sampled(
    mean: Floats, covariance: Floats, noise: Floats, step: int, memory: SampleMemory
) -> bool:
    """Move mean and covariance by statistical linear regression; the noise is additive."""
    if not regress(mean, covariance, (noise[0],), covariance, memory.cross, step, memory):
        return False
    for row in range(2):
        mean[row] = memory.shift[row]
        covariance[row, row] += noise[1]
    return True


def innovate(
    mean: Floats,
    covariance: Floats,
    measured: Floats,
    noise: Floats,
    innovation: Innovation,
    step: int,
    memory: SampleMemory,
) -> bool:
    """The measured total against the predicted one, and the covariances: the Kalman filter's own."""
    cross = innovation.cross_covariance
    innovation.difference[0] = measured[0] - mean[0] - mean[1]
    for row in range(2):
        cross[row, 0] = covariance[row, 0] + covariance[row, 1]
    innovation.covariance[0, 0] = cross[0, 0] + cross[1, 0] + noise[2]
    return True


@cache
def compiled() -> Function:
    """The loop over the runs; it changes `carried`, and fills the results.

    Its arguments are runs, offsets, time_ns, measured, noise, gate, carried, results, and `scratch`.
    """
    return compile_over_runs(stepwise(Steps(predict_sampled, innovate)))


def scratch(sets: SampleSets) -> tuple[Innovation, SampleMemory]:
    """What a core works in."""
    return no_innovation(2, 1), sample_memory(sets, states=2, values=2)


def compiled_c() -> Callable[[Floats, Floats, Floats, NDArray[np.int64]], Floats]:
    """`reactor.c`, compiled: (measured, points, weights, offsets) -> means (n, 2) of all runs."""
    kinds = c.INTEGER, c.INTEGERS, c.FLOATS, c.INTEGER, c.FLOATS, c.FLOATS, c.FLOATS
    function = c.compiled("reactor", "filter_runs", *kinds)

    def run(measured: Floats, points: Floats, weights: Floats, offsets: NDArray[np.int64]) -> Floats:
        means = np.empty((len(measured), 2))
        function(len(offsets) - 1, offsets, measured, len(weights), points, weights, means)
        return means

    return run
