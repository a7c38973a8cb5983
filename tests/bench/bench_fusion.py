"""Covariance intersection against the usual way: SciPy's bounded search over the weight, pair by pair.

Four states, the weight of the least trace. Both reach the same traces, or this stops.
"""

from statistics import median
from time import perf_counter

import numpy as np
from scipy.optimize import minimize_scalar

from fuselog.replay.families.networks.covariance_intersection import fuse

PAIRS, THEIRS, REPEATS = 10_000, 300, 5
TOLERANCE = 1e-6

Row = tuple[str, float, float, float]


def main() -> list[Row]:
    """Rows of (what, our time in us, SciPy's, how many times faster)."""
    rng = np.random.default_rng(1)
    factors = rng.normal(size=(PAIRS, 2, 4, 4))
    covariances = factors @ factors.swapaxes(-1, -2) + 0.05 * np.eye(4)
    means = np.zeros((PAIRS, 2, 4))
    fused = fuse("ci-trace", means, covariances, tolerance=TOLERANCE)  # compiles
    traces, theirs_us = searched(covariances[:THEIRS])
    ours = np.trace(fused.covariance[:THEIRS], axis1=1, axis2=2)
    np.testing.assert_allclose(ours, traces, rtol=10 * TOLERANCE)
    times = []
    for count in (PAIRS, 1):
        repeats = []
        for _ in range(REPEATS):
            begin = perf_counter()
            fuse("ci-trace", means[:count], covariances[:count], tolerance=TOLERANCE)
            repeats.append(1e6 * (perf_counter() - begin) / count)
        times.append(median(repeats))
    names = (f"CI of two, batch of {PAIRS}, us; SciPy", "CI of two, single, us; SciPy")
    return [(name, us, theirs_us, theirs_us / us) for name, us in zip(names, times, strict=True)]


def searched(covariances: np.ndarray) -> tuple[np.ndarray, float]:
    """The least traces by SciPy, and its time per pair in us."""
    begin = perf_counter()
    traces = []
    for pair in covariances:
        first, second = np.linalg.inv(pair)

        def trace(weight: float, first: np.ndarray = first, second: np.ndarray = second) -> float:
            return float(np.trace(np.linalg.inv(weight * first + (1 - weight) * second)))

        found = minimize_scalar(trace, bounds=(0, 1), method="bounded", options={"xatol": 1e-6})
        traces.append(found.fun)
    return np.array(traces), 1e6 * (perf_counter() - begin) / len(covariances)
