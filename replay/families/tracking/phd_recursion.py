"""Recursion of the Gaussian mixture PHD filter: predict, update, merge, prune and extract."""

from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.families.vehicles.models import noise_moments
from fuselog.replay.engine.arrays import Booleans, Floats, Integers, varying
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.kalman.steps import NOT_POSITIVE_DEFINITE, UNKNOWN
from fuselog.replay.inference.linear_algebra.gaussian import (
    Innovation,
    cholesky,
    copy_gaussian,
    downdate,
    kalman_step,
    predict_constant_velocity,
    whiten,
)

STATES = 4
PLACE = (0, 2)  # x and y; each is followed by its velocity


# A component with more than this weight counts as a target.
EXTRACTED = 0.5


class PhdSettings(NamedTuple):
    """Parameters as the kernel reads them; the gate is in squared sigmas."""

    variance_m2: float
    detection_probability: float
    clutter_per_m2: float
    survival_probability: float
    births_per_m2: float
    birth_sigma_mps: float
    acceleration_sigma_mps2: float
    prune_weight: float
    merge_squared: float
    gate: float


@varying(2)
class Mixture(NamedTuple):
    """Mixtures of all runs, with the axes run and component; the first `used` components are occupied.

    used, time_ns, failure: (runs,); time is negative before the first scan. weight, mean, covariance:
    (runs, most), (runs, most, 4), (runs, most, 4, 4).
    """

    used: Integers
    time_ns: Integers
    failure: Integers
    weight: Floats
    mean: Floats
    covariance: Floats


class Scans(NamedTuple):
    """Scans of all runs in time order; scan s has the detections first[s]:end[s] of `place` (n, 2)."""

    offsets: Integers
    time_ns: Integers
    first: Integers
    end: Integers
    place: Floats


class PhdInputs(NamedTuple):
    """Inputs of the recursion."""

    events: Scans
    settings: PhdSettings


class Sets(NamedTuple):
    """Output after every scan: the expected number of targets, and the elements of the set.

    The elements of scan s begin at `room[s]`; `elements[s]` of them are filled.
    """

    is_reported: Booleans
    expected: Floats
    elements: Integers
    room: Integers
    weight: Floats
    mean: Floats
    covariance: Floats


@varying(1, step=0, shift=0)
class PhdMemory(NamedTuple):
    """Scratch memory of one core.

    Attributes:
        weight, mean, covariance: the components after a scan, before reduction.
        factor, is_merged, heaviest, step, shift: memory for merging them.
        innovation: innovation of a detection for a component.
        seen_factor, seen_gain, seen_covariance: quantities for the update of each component: the factor
            L of the innovation covariance S (2, 2), W = C L^-T (4, 2), and the updated covariance.
    """

    weight: Floats
    mean: Floats
    covariance: Floats
    factor: Floats
    is_merged: Booleans
    heaviest: Integers
    step: Floats
    shift: Floats
    innovation: Innovation
    seen_factor: Floats
    seen_gain: Floats
    seen_covariance: Floats


def put(weight: float, mean: Floats, covariance: Floats, mixture: Any, row: int) -> None:
    """Write a component to a row of a mixture or of the memory.

    Args:
        weight, mean, covariance: the component, with mean (4,) and covariance (4, 4).
        mixture: a mixture of one run, or the memory.
        row: index of the row.
    """
    mixture.weight[row] = weight
    copy_gaussian(mean, covariance, mixture.mean[row], mixture.covariance[row])


def prepare(mean: Floats, covariance: Floats, variance: float, work: PhdMemory, parent: int) -> bool:
    """Compute the common part of all updates of a component; return False if S is singular.

    Args:
        mean, covariance: (4,), (4, 4), of the component.
        variance: variance of a detection, per axis, in m^2.
        work: memory to fill.
        parent: index of the component.
    """
    factor, gain = work.seen_factor[parent], work.seen_gain[parent]
    for i in range(2):
        for j in range(2):
            factor[i, j] = covariance[PLACE[i], PLACE[j]]
        factor[i, i] += variance
        work.innovation.difference[i] = 0.0
        gain[:, i] = covariance[:, PLACE[i]]
    innovation = Innovation(work.innovation.difference, factor, gain)
    if np.isnan(whiten(innovation, 2)[0]):
        return False
    kalman_step(innovation, 2, work.step)
    after = work.seen_covariance[parent]
    copy_gaussian(mean, covariance, work.step, after)
    downdate(after, gain, 2)
    return True


def add_detected(
    run: int,
    parents: int,
    place: Floats,
    mixture: Mixture,
    settings: PhdSettings,
    work: PhdMemory,
    end: int,
) -> int:
    """Append components in the gate, updated with one detection, and a birth; return the new number.

    Args:
        run: index of the run.
        parents: number of components before the scan.
        place: position of the detection, (2,), in m.
        mixture: the predicted mixture, with weights that do not yet include survival.
        settings: settings of the filter.
        work: memory that `prepare` filled for each component; components are appended to it.
        end: number of components in the memory.
    """
    first = end
    total = settings.clutter_per_m2
    for parent in range(parents):
        mean, factor, gain = mixture.mean[run, parent], work.seen_factor[parent], work.seen_gain[parent]
        one = (place[0] - mean[PLACE[0]]) / factor[0, 0]
        other = (place[1] - mean[PLACE[1]] - factor[1, 0] * one) / factor[1, 1]
        squared = one * one + other * other
        if squared > settings.gate:
            continue
        density = np.exp(-0.5 * squared) / (2.0 * np.pi * factor[0, 0] * factor[1, 1])
        weight = mixture.weight[run, parent] * density
        weight *= settings.detection_probability * settings.survival_probability
        total += weight
        put(weight, mean, work.seen_covariance[parent], work, end)
        for row in range(STATES):
            work.mean[end, row] += gain[row, 0] * one + gain[row, 1] * other
        end += 1
    born = settings.detection_probability * settings.births_per_m2
    if born > 0.0:
        total += born
        work.weight[end] = born
        work.mean[end], work.covariance[end] = 0.0, 0.0
        for axis in range(2):
            at = PLACE[axis]
            work.mean[end, at] = place[axis]
            work.covariance[end, at, at] = settings.variance_m2
            work.covariance[end, at + 1, at + 1] = settings.birth_sigma_mps**2
        end += 1
    for component in range(first, end):
        work.weight[component] /= total
    return end


def update(
    run: int, scan: int, scans: Scans, mixture: Mixture, settings: PhdSettings, work: PhdMemory
) -> int:
    """Fill `work` with the pruned components after a scan; return their number, or -1 on failure."""
    parents = mixture.used[run]
    missed = settings.survival_probability * (1.0 - settings.detection_probability)
    for parent in range(parents):
        mean, covariance = mixture.mean[run, parent], mixture.covariance[run, parent]
        if not prepare(mean, covariance, settings.variance_m2, work, parent):
            return -1
        put(mixture.weight[run, parent] * missed, mean, covariance, work, parent)
    end = parents
    for detection in range(scans.first[scan], scans.end[scan]):
        end = add_detected(run, parents, scans.place[detection], mixture, settings, work, end)
    kept = 0
    for component in range(end):
        if work.weight[component] > settings.prune_weight:
            put(work.weight[component], work.mean[component], work.covariance[component], work, kept)
            kept += 1
    return kept


def squared_distance(work: PhdMemory, member: int, other: int) -> float:
    """Compute the squared Mahalanobis distance of two means, with the covariance of `member`."""
    squared = 0.0
    for row in range(STATES):
        value = work.mean[member, row] - work.mean[other, row]
        for column in range(row):
            value -= work.factor[member, row, column] * work.step[column]
        work.step[row] = value / work.factor[member, row, row]
        squared += work.step[row] ** 2
    return squared


def merge(count: int, settings: PhdSettings, work: PhdMemory) -> int:
    """Merge components around the heaviest remaining one, repeatedly; return the number of groups.

    Each merged component replaces the heaviest of its group; `heaviest` lists the indices of these
    components. Returns -1 if a covariance is not positive definite.
    """
    for component in range(count):
        work.is_merged[component] = False
        if not cholesky(work.factor[component], work.covariance[component], STATES):
            return -1
    groups = 0
    while True:
        seed = -1
        for component in range(count):
            if not work.is_merged[component] and (
                seed < 0 or work.weight[component] > work.weight[seed]
            ):
                seed = component
        if seed < 0:
            return groups
        merge_group(seed, count, settings, work)
        work.heaviest[groups] = seed
        groups += 1


def merge_group(seed: int, count: int, settings: PhdSettings, work: PhdMemory) -> None:
    """Replace a component by the Gaussian with the moments of all components close to it.

    Moments are computed about the mean of the seed, which does not change until all members are found.
    """
    work.is_merged[seed] = True
    total = work.weight[seed]
    shift, second = work.shift, work.factor[seed]
    for row in range(STATES):
        shift[row] = 0.0
        for column in range(STATES):
            second[row, column] = total * work.covariance[seed, row, column]
    for member in range(count):
        if work.is_merged[member]:
            continue
        if squared_distance(work, member, seed) > settings.merge_squared:
            continue
        work.is_merged[member] = True
        weight = work.weight[member]
        total += weight
        for row in range(STATES):
            difference = work.mean[member, row] - work.mean[seed, row]
            shift[row] += weight * difference
            for column in range(STATES):
                other = work.mean[member, column] - work.mean[seed, column]
                second[row, column] += weight * (
                    work.covariance[member, row, column] + difference * other
                )
    work.weight[seed] = total
    for row in range(STATES):
        work.mean[seed, row] += shift[row] / total
        for column in range(STATES):
            moved = shift[row] / total * shift[column] / total
            work.covariance[seed, row, column] = second[row, column] / total - moved


def keep(run: int, groups: int, mixture: Mixture, work: PhdMemory) -> None:
    """Keep the heaviest of the merged components, in order of their weights."""
    kept = min(groups, mixture.weight.shape[1])
    for place in range(kept):
        best = place
        for other in range(place + 1, groups):
            if work.weight[work.heaviest[other]] > work.weight[work.heaviest[best]]:
                best = other
        component = work.heaviest[best]
        work.heaviest[best] = work.heaviest[place]
        work.heaviest[place] = component
        mixture.weight[run, place] = work.weight[component]
        mean, covariance = mixture.mean[run, place], mixture.covariance[run, place]
        copy_gaussian(work.mean[component], work.covariance[component], mean, covariance)
    mixture.used[run] = kept


def process(
    run: int, scan: int, inputs: PhdInputs, mixture: Mixture, sets: Sets, work: PhdMemory
) -> int:
    """Process one scan of a run; a scan that is older than the mixture has no effect."""
    scans, settings = inputs
    if mixture.time_ns[run] >= 0:
        duration_s = (scans.time_ns[scan] - mixture.time_ns[run]) * 1e-9
        if duration_s < 0.0:
            return UNKNOWN
        noise = noise_moments(settings.acceleration_sigma_mps2, duration_s)
        for component in range(mixture.used[run]):
            mean, covariance = mixture.mean[run, component], mixture.covariance[run, component]
            predict_constant_velocity(mean, covariance, duration_s, (2, 1), noise)
    mixture.time_ns[run] = scans.time_ns[scan]
    count = update(run, scan, scans, mixture, settings, work)
    groups = merge(count, settings, work) if count >= 0 else -1
    if groups < 0:
        return NOT_POSITIVE_DEFINITE
    keep(run, groups, mixture, work)
    return ALL_WELL


def extract(
    run: int, scan: int, inputs: PhdInputs, mixture: Mixture, sets: Sets, work: PhdMemory
) -> int:
    """Fill the set of a scan; the number of targets at a component is its rounded weight."""
    row = sets.room[scan]
    for component in range(mixture.used[run]):
        weight = mixture.weight[run, component]
        sets.expected[scan] += weight
        if weight <= EXTRACTED:
            continue
        for _ in range(max(1, int(np.floor(weight + 0.5)))):
            if row == sets.room[scan + 1]:
                break
            mean, covariance = mixture.mean[run, component], mixture.covariance[run, component]
            put(weight, mean, covariance, sets, row)
            row += 1
    sets.elements[scan] = row - sets.room[scan]
    sets.is_reported[scan] = True
    return ALL_WELL
