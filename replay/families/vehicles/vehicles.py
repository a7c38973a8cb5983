"""Joint Gaussian filter of several vehicles, for all runs of an ensemble in parallel.

Sources: Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on
the symmetric measurement equation filter", 2016; Bar-Shalom, Li, "Multitarget-Multisensor Tracking",
1995, 6.2 (moment matching over associations). The state is (x, vx, y, vy) of every vehicle, followed by
the infrastructure sensor's pose (x, y, heading) if it is estimated.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.families.vehicles.models import noise_moments, turn
from fuselog.recorders.models.planar import into_frame
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.vehicles.association import Hypotheses

STATES = 4  # components of a vehicle's state
POSE = 3  # components of the sensor's pose
# Chi-square gate with one degree of freedom; a less probable topology is not of vehicles only.
TOPOLOGY_GATE = float(chi2.isf(1e-6, 1))


class Joint(NamedTuple):
    """Gaussians of the joint states: means (runs, n), covariances (runs, n, n)."""

    mean: Floats
    covariance: Floats

    def of(self, rows: Integers) -> "Joint":
        """Return the joint states of some runs."""
        return Joint(self.mean[rows], self.covariance[rows])


class Motion(NamedTuple):
    """Motion of the vehicles: turn rates (vehicles,), and standard deviations of the acceleration."""

    turn_rate_radps: Floats
    acceleration_sigma_mps2: Floats

    @property
    def vehicles(self) -> int:
        """Return the number of vehicles."""
        return len(self.turn_rate_radps)


def positions(motion: Motion, mean: Floats) -> Floats:
    """Return the positions (runs, vehicles, 2) of the vehicles.

    Args:
        motion: motion of the vehicles, from which their number is known.
        mean: means of the joint states, (runs, n).
    """
    count = motion.vehicles
    return mean[:, : STATES * count].reshape(-1, count, STATES)[..., 0::2]


def position_rows(vehicles: int, states: int, axes: tuple[int, ...] = (0, 1)) -> Floats:
    """Make the matrix (axes * vehicles, states) that selects some axes of all positions from a state."""
    rows = np.zeros((vehicles, len(axes), states))
    for place, axis in enumerate(axes):
        rows[np.arange(vehicles), place, STATES * np.arange(vehicles) + 2 * axis] = 1.0
    return rows.reshape(-1, states)


def predict(motion: Motion, joint: Joint, duration_s: float) -> Joint:
    """Predict the joint state over `duration_s`, with coordinated turns and white accelerations."""
    transition, noise = _moved(
        tuple(motion.turn_rate_radps.tolist()),
        tuple(motion.acceleration_sigma_mps2.tolist()),
        joint.mean.shape[1],
        duration_s,
    )
    half = joint.covariance @ transition.T
    return Joint(joint.mean @ transition.T, half.swapaxes(1, 2) @ transition.T + noise)


@lru_cache(maxsize=64)
def _moved(
    turn_rate_radps: tuple[float, ...],
    acceleration_sigma_mps2: tuple[float, ...],
    states: int,
    duration_s: float,
) -> tuple[Floats, Floats]:
    """Compute the transition matrix and the noise (states, states) of all vehicles over `duration_s`."""
    transition, noise = np.eye(states), np.zeros((states, states))
    for vehicle, (rate, sigma) in enumerate(zip(turn_rate_radps, acceleration_sigma_mps2, strict=True)):
        own = slice(STATES * vehicle, STATES * (vehicle + 1))
        transition[own, own] = np.stack(turn(np.eye(STATES), rate, duration_s))
        first, cross, second = noise_moments(sigma, duration_s)
        noise[own, own] = np.kron(np.eye(2), [[first, cross], [cross, second]])
    return transition, noise


class Gain(NamedTuple):
    """Effect of a linear measurement on a covariance; S is the innovation covariance.

    `inverse` (runs, m, m) is S^-1, `log_determinant` (runs,) is the log determinant of S, `gain` (runs,
    n, m) is the Kalman gain, and `covariance` is the covariance after the update.
    """

    inverse: Floats
    log_determinant: Floats
    gain: Floats
    covariance: Floats


def gain_of(covariance: Floats, rows: Floats, noise: Floats) -> Gain:
    """Compute the Kalman gain and the updated covariance.

    Args:
        covariance: (runs, n, n).
        rows: (m, n), or (runs, m, n).
        noise: (runs, m, m).
    """
    cross = covariance @ rows.swapaxes(-1, -2)
    innovation = rows @ cross + noise
    inverse: Floats = np.asarray(np.linalg.inv(innovation), np.float64)
    gain = cross @ inverse
    after = covariance - gain @ cross.swapaxes(1, 2)
    log_determinant = np.asarray(np.linalg.slogdet(innovation)[1], np.float64)
    return Gain(inverse, log_determinant, gain, 0.5 * (after + after.swapaxes(1, 2)))


def update(joint: Joint, rows: Floats, innovation: Floats, noise: Floats) -> Joint:
    """Apply the Kalman update; components with a NaN innovation are not measured.

    Args:
        joint: the Gaussians of all runs.
        rows: (m, n), or (runs, m, n).
        innovation: (runs, m), NaN if not measured.
        noise: (runs, m, m).
    """
    missing = np.isnan(innovation)
    if missing.any():
        there = ~missing
        rows = np.where(there[..., None], rows, 0.0)
        unit = np.eye(innovation.shape[1])
        noise = np.where(there[:, :, None] & there[:, None, :], noise, unit)
        innovation = np.where(there, innovation, 0.0)
    found = gain_of(joint.covariance, rows, noise)
    return Joint(joint.mean + (found.gain @ innovation[..., None])[..., 0], found.covariance)


class Weighed(NamedTuple):
    """Hypotheses with scores (log weight plus log likelihood) and innovations (zero if missed).

    `group` (h,) is the row of the gains for each hypothesis: hypotheses of a run share a row if they
    miss the same vehicles. `group_run` is the run of each row.
    """

    score: Floats
    innovations: Floats
    group: Integers
    group_run: Integers
    gains: Gain


def weigh(
    joint: Joint, rows: Floats, innovations: Floats, noise: Floats, hypotheses: Hypotheses
) -> Weighed:
    """Compute the likelihood of every hypothesis, jointly for all vehicles.

    Args:
        joint: joint states before the measurement.
        rows: (m, n), matrix that selects the measured components of all vehicles from the state.
        innovations: innovations of every hypothesis, (h, m), NaN for a vehicle that was not detected.
        noise: the variance of every measured component, (m,).
        hypotheses: hypotheses sorted by run, at least one for every run.
    """
    there = ~np.isnan(innovations)
    innovations = np.where(there, innovations, 0.0)
    groups, group = _distinct(np.concatenate([hypotheses.run[:, None], there], axis=1))
    run, seen = groups[:, 0], groups[:, 1:].astype(bool)
    masked = rows if seen.all() else rows * seen[:, :, None]
    matrices = np.where(seen, noise, 1.0)[:, :, None] * np.eye(len(noise))
    gains = gain_of(joint.covariance[run], masked, matrices)
    distance = np.einsum("hi,hij,hj->h", innovations, gains.inverse[group], innovations)
    counted = np.log(2.0 * np.pi) * there.sum(axis=1)
    likelihood = -0.5 * (distance + gains.log_determinant[group] + counted)
    return Weighed(hypotheses.log_weight + likelihood, innovations, group, run, gains)


def collapse(
    joint: Joint, rows: Floats, innovations: Floats, noise: Floats, hypotheses: Hypotheses
) -> Joint:
    """Compute the Gaussian with the moments of the mixture over all associations of an unordered set.

    The weights are exact: for a complete set, the weights of all maps are the terms of a permanent. The
    result is therefore the Gaussian to which an exact symmetric measurement equation filter collapses.

    Args:
        joint, rows, innovations, noise, hypotheses: as for `weigh`.
    """
    score, innovations, group, run, gains = weigh(joint, rows, innovations, noise, hypotheses)
    weight = normalised(score, hypotheses.run)
    total = _sums(weight, group, len(run))
    first = _sums(weight[:, None] * innovations, group, len(run))
    squares = innovations[:, :, None] * innovations[:, None, :]
    second = _sums(weight[:, None, None] * squares, group, len(run))
    moved = (gains.gain @ first[..., None])[..., 0]
    spread = gains.gain @ second @ gains.gain.swapaxes(1, 2) + total[:, None, None] * gains.covariance
    shift = _sums(moved, run, len(joint.mean))
    covariance = _sums(spread, run, len(joint.mean)) - shift[:, :, None] * shift[:, None, :]
    return Joint(joint.mean + shift, covariance)


def _distinct(pattern: NDArray) -> tuple[Integers, Integers]:
    """Find the distinct rows of a pattern whose first column is sorted, and the index of each row."""
    if len(pattern) == 0 or pattern[:, 1:].all():
        runs, group = np.unique(pattern[:, 0], return_inverse=True)
        return np.concatenate([runs[:, None], np.ones_like(pattern[: len(runs), 1:])], axis=1), group
    groups, group = np.unique(pattern, axis=0, return_inverse=True)
    return groups, group.reshape(-1)


def _sums(values: Floats, group: Integers, groups: int) -> Floats:
    """Sum rows by group; most groups have a single row."""
    out = np.zeros((groups, *values.shape[1:]))
    if len(values) == groups and np.array_equal(group, np.arange(groups)):
        return values
    np.add.at(out, group, values)
    return out


def normalised(score: Floats, run: Integers) -> Floats:
    """Compute exp(score), scaled to a sum of one in each run.

    Args:
        score, run: (h,); `run` is sorted.
    """
    first = np.flatnonzero(np.append(True, run[1:] != run[:-1]))
    count = np.diff(np.append(first, len(run)))
    weight = np.exp(score - np.repeat(np.maximum.reduceat(score, first), count))
    return weight / np.repeat(np.add.reduceat(weight, first), count)


def spread_of(places: Floats) -> Floats:
    """Compute the sum of squared distances from the mean, (...,), of positions (..., vehicles, 2)."""
    return np.sum((places - places.mean(axis=-2, keepdims=True)) ** 2, axis=(-2, -1))


def topology(places: Floats) -> Floats:
    """Compute the sum (...,) of squared distances of all pairs of positions (..., vehicles, 2), (18)."""
    return places.shape[-2] * spread_of(places)


def topology_moments(places: Floats, variance_m2: float) -> tuple[Floats, Floats]:
    """Compute mean and variance (...,) of the error that noise adds to the measured topology.

    Args:
        places: (..., vehicles, 2), in m.
        variance_m2: variance of the noise, per axis.
    """
    count = places.shape[-2]
    added = 2.0 * count * (count - 1) * variance_m2
    variance = 4.0 * count**2 * variance_m2 * (spread_of(places) + (count - 1) * variance_m2)
    return np.full(places.shape[:-2], added), variance


class Scalar(NamedTuple):
    """Linearized scalar measurement: Jacobian (runs, 1, n), innovations (runs,) and their variances.

    `noise` (runs,) is the part of the variance due to the measurement.
    """

    rows: Floats
    innovation: Floats
    variance: Floats
    noise: Floats


def topology_measurement(motion: Motion, joint: Joint, detections: Floats, variance_m2: float) -> Scalar:
    """Linearize the topology of scans, which does not depend on their frame and order.

    The innovation is NaN if it is too improbable: a vehicle was then probably missed and something else
    was detected.

    Args:
        motion, joint: motion and joint states of the vehicles in all runs.
        detections: full scans, (runs, vehicles, 2), in m.
        variance_m2: variance of a detection, per axis.
    """
    places = positions(motion, joint.mean)
    added, noise = topology_moments(places, variance_m2)
    innovation = topology(detections) - added - topology(places)
    count, states = motion.vehicles, joint.mean.shape[1]
    gradient = 2.0 * count * (places - places.mean(axis=1, keepdims=True))
    rows = gradient.reshape(-1, 1, 2 * count) @ position_rows(count, states)
    variance = (rows @ joint.covariance @ rows.swapaxes(1, 2))[:, 0, 0] + noise
    innovation[innovation**2 > TOPOLOGY_GATE * variance] = np.nan
    return Scalar(rows, innovation, variance, noise)


def update_by_scalar(joint: Joint, measured: Scalar) -> Joint:
    """Apply the Kalman update with a scalar measurement."""
    return update(joint, measured.rows, measured.innovation[:, None], measured.noise[:, None, None])


class Sight(NamedTuple):
    """Predicted detections of the infrastructure sensor (runs, m), and their Jacobian (runs, m, n)."""

    predicted: Floats
    rows: Floats


def sight_of(motion: Motion, joint: Joint) -> Sight:
    """Predict the sensor's detections of the estimated vehicles from the sensor's estimated pose."""
    count, states = motion.vehicles, joint.mean.shape[1]
    places, pose = positions(motion, joint.mean), joint.mean[:, -POSE:]
    seen = np.stack(into_frame(pose.T[:, :, None], np.moveaxis(places, -1, 0)), axis=-1)
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turned = np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], axis=1)
    rows = np.zeros((len(seen), count, 2, states))
    for vehicle in range(count):
        first = STATES * vehicle
        rows[:, vehicle, :, first] = turned[:, :, 0]
        rows[:, vehicle, :, first + 2] = turned[:, :, 1]
    rows[:, :, :, -POSE : -POSE + 2] = -turned[:, None]
    rows[:, :, 0, -1], rows[:, :, 1, -1] = seen[..., 1], -seen[..., 0]
    return Sight(seen.reshape(len(seen), -1), rows.reshape(len(seen), 2 * count, states))


def update_by_shape(
    motion: Motion, joint: Joint, pose: Floats, seen: Floats, variance_m2: float
) -> Joint:
    """Update with detections of a sensor whose pose has no prior information.

    The update of the vehicles uses only the part of the detections that does not depend on the pose; the
    pose is then computed from the vehicles.

    Args:
        motion, joint: motion and joint states of the vehicles in all runs.
        pose: (runs, 3), x, y, heading; used only as the linearization point.
        seen: (runs, vehicles, 2) in the sensor's frame, NaN if not seen.
        variance_m2: variance of a detection, per axis.
    """
    own = slice(0, STATES * motion.vehicles)
    mean = joint.mean.copy()
    mean[:, -POSE:] = pose
    sight = sight_of(motion, Joint(mean, joint.covariance))
    innovation = seen.reshape(len(seen), -1) - sight.predicted
    there = np.isfinite(innovation)
    innovation = np.where(there, innovation, 0.0)
    rows = np.where(there[..., None], sight.rows, 0.0)
    by_place, by_pose = rows[..., own], rows[..., -POSE:]
    turned, triangle = np.linalg.qr(by_pose, mode="complete")
    shape = np.swapaxes(turned[..., POSE:], 1, 2)
    solve = np.linalg.solve(triangle[:, :POSE], np.swapaxes(turned[..., :POSE], 1, 2))
    vehicles = update(
        Joint(mean[:, own], joint.covariance[:, own, own]),
        shape @ by_place,
        (shape @ innovation[..., None])[..., 0],
        variance_m2 * np.eye(shape.shape[1]),
    )
    shift = (vehicles.mean - mean[:, own])[..., None]
    follows = -solve @ by_place
    cross = vehicles.covariance @ np.swapaxes(follows, 1, 2)
    covariance = np.empty_like(joint.covariance)
    covariance[:, own, own] = vehicles.covariance
    covariance[:, own, -POSE:] = cross
    covariance[:, -POSE:, own] = np.swapaxes(cross, 1, 2)
    covariance[:, -POSE:, -POSE:] = follows @ cross + variance_m2 * solve @ np.swapaxes(solve, 1, 2)
    moved = (solve @ innovation[..., None] + follows @ shift)[..., 0]
    return Joint(np.concatenate([vehicles.mean, pose + moved], axis=1), covariance)
