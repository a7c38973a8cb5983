"""Association of the detections of an unordered scan with vehicles: the best assignment, or all.

A map assigns each vehicle at most one detection of its own; unassigned detections are false. The weights
of maps assume a detection probability p_D and Poisson clutter of uniform density.
"""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Floats, Integers

MISSED = -1
# Detections outside this gate are not assigned to a vehicle, and less probable maps are dropped.
GATE_PROBABILITY = 1.0 - 1e-12
LEAST_WEIGHT = 1e-9
# Smallest clutter and miss probability, used if a scan is incomplete although it should be complete.
LEAST_CLUTTER_PER_M2 = 1e-12
LEAST_MISSED = 1e-9


class Scanning(NamedTuple):
    """Properties of a sensor of unordered scans."""

    variance_m2: float
    detection_probability: float
    clutter_per_m2: float

    @property
    def is_whole(self) -> bool:
        """Test whether a scan contains each vehicle exactly once and nothing else."""
        return self.detection_probability == 1.0 and self.clutter_per_m2 == 0.0

    @property
    def log_odds_of_detection(self) -> float:
        """Return the log weight of a detection relative to a miss, before the likelihood."""
        missed = max(1.0 - self.detection_probability, LEAST_MISSED)
        clutter = max(self.clutter_per_m2, LEAST_CLUTTER_PER_M2)
        return float(np.log(self.detection_probability / (missed * clutter)))


class Hypotheses(NamedTuple):
    """Maps of all runs, sorted by run: the detection of each vehicle (h, vehicles), or MISSED.

    `log_weight` (h,) is the log weight due to the properties of the scan, without the likelihood of
    positions.
    """

    run: Integers
    detection: Integers
    log_weight: Floats


def log_likelihoods(predicted: Floats, covariance: Floats, detections: Floats) -> Floats:
    """Compute log likelihoods of detections (runs, vehicles, detections); -inf outside the gates.

    Args:
        predicted: (runs, vehicles, axes).
        covariance: (runs, vehicles, axes, axes), covariance of a detection about the prediction of its
            vehicle.
        detections: (runs, detections, axes), padded with NaN.
    """
    axes = predicted.shape[-1]
    difference = detections[:, None] - predicted[:, :, None]
    inverse = np.linalg.inv(covariance)
    squared = np.einsum("rvma,rvab,rvmb->rvm", difference, inverse, difference)
    constant = np.linalg.slogdet(covariance)[1] + axes * np.log(2.0 * np.pi)
    found = -0.5 * (squared + constant[:, :, None])
    return np.where(squared < chi2.isf(1.0 - GATE_PROBABILITY, axes), found, -np.inf)


def best_maps(log_likelihood: Floats, scanning: Scanning) -> Hypotheses:
    """Find the most probable map of every run for independent vehicles (Hungarian method).

    Args:
        log_likelihood: (runs, vehicles, detections), see `log_likelihoods`.
        scanning: properties of the sensor.
    """
    runs, vehicles, detections = log_likelihood.shape
    gain = log_likelihood + scanning.log_odds_of_detection
    chosen = np.full((runs, vehicles), MISSED)
    if detections:
        nearest = gain.argmax(axis=2)
        best = np.take_along_axis(gain, nearest[..., None], 2)[..., 0]
        ordered = np.sort(np.where(best > 0.0, nearest, -1 - np.arange(vehicles)), axis=1)
        unique = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
        chosen[unique] = np.where(best[unique] > 0.0, nearest[unique], MISSED)
        for run in np.flatnonzero(~unique):
            chosen[run] = _assigned(gain[run])
    return Hypotheses(np.arange(runs), chosen, np.zeros(runs))


def _assigned(gain: Floats) -> Integers:
    """Find the map (vehicles,) with the largest total gain (vehicles, detections); a miss has gain 0."""
    from scipy.optimize import linear_sum_assignment  # slow to import

    vehicle, detection = linear_sum_assignment(-np.maximum(gain, 0.0))
    chosen = np.full(len(gain), MISSED)
    chosen[vehicle] = np.where(gain[vehicle, detection] > 0.0, detection, MISSED)
    return chosen


def all_maps(log_likelihood: Floats, scanning: Scanning) -> Hypotheses:
    """List all maps of every run inside the gates, except those with negligible weight.

    If scans are complete and without clutter, a vehicle is missed only if no detection is left for it.

    Args:
        log_likelihood: (runs, vehicles, detections), see `log_likelihoods`.
        scanning: properties of the sensor.
    """
    runs = np.arange(len(log_likelihood))
    gain = log_likelihood + scanning.log_odds_of_detection
    found = _extended(runs, gain, may_miss=not scanning.is_whole)
    lost = np.setdiff1d(runs, found.run)
    if len(lost):
        more = _extended(lost, gain, may_miss=True)
        joined = [np.concatenate(pair) for pair in zip(found, more, strict=True)]
        order = np.argsort(joined[0], kind="stable")
        found = Hypotheses(*(column[order] for column in joined))
    return found._replace(
        log_weight=scanning.log_odds_of_detection * (found.detection != MISSED).sum(axis=1)
    )


def _extended(runs: Integers, gain: Floats, *, may_miss: bool) -> Hypotheses:
    """Build the maps of some runs, one vehicle after another; `log_weight` is the sum of gains."""
    _, vehicles, detections = gain.shape
    run, chosen = runs, np.empty((len(runs), 0), np.int64)
    taken, score = np.zeros((len(runs), detections), bool), np.zeros(len(runs))
    for vehicle in range(vehicles):
        offered = np.where(taken, -np.inf, gain[run, vehicle])
        offered = np.concatenate([offered, np.full((len(run), 1), 0.0 if may_miss else -np.inf)], axis=1)
        row, column = np.nonzero(offered > -np.inf)
        score = score[row] + offered[row, column]
        if vehicle == vehicles - 1:
            best = np.full(len(gain), -np.inf)
            np.maximum.at(best, run[row], score)
            kept = score > best[run[row]] + np.log(LEAST_WEIGHT)
            row, column, score = row[kept], column[kept], score[kept]
        run, taken = run[row], taken[row]
        is_detected = column < detections
        taken[np.flatnonzero(is_detected), column[is_detected]] = True
        column = np.where(is_detected, column, MISSED)
        chosen = np.concatenate([chosen[row], column[:, None]], axis=1)
    return Hypotheses(run, chosen, score)


def log_permanents(logs: Floats) -> Floats:
    """Compute log permanents (...,) of matrices exp(logs) (..., n, n): sums over permutations.

    Dynamic programming over subsets of columns needs n 2^(n-1) products of positive numbers. If a
    permanent underflows, the result is its greatest term.
    """
    n = logs.shape[-1]
    flat = logs.reshape(-1, n, n)
    greatest = flat.max(axis=2, keepdims=True)
    entries = np.moveaxis(np.exp(flat - greatest), 0, -1)
    shared = np.ones((1 << n, len(flat)))  # index: set of columns, one bit each
    for columns in range(1, 1 << n):
        row = columns.bit_count() - 1
        taken = (column for column in range(n) if columns >> column & 1)
        shared[columns] = sum(shared[columns ^ (1 << last)] * entries[row, last] for last in taken)
    with np.errstate(divide="ignore"):
        found: Floats = np.log(shared[-1]) + greatest[..., 0].sum(axis=1)
    from scipy.optimize import linear_sum_assignment  # slow to import

    for index in np.flatnonzero(np.isneginf(found)):
        found[index] = flat[index][linear_sum_assignment(-flat[index])].sum()
    return found.reshape(logs.shape[:-2])
