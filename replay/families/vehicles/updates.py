"""Updates of the joint filter with fixes and the infrastructure sensor, by method.

Each function takes the joint states of some runs and their measurements at one time, and returns the
updated states.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.families.vehicles.association import (
    MISSED,
    Hypotheses,
    Scanning,
    all_maps,
    best_maps,
    log_likelihoods,
)
from fuselog.replay.families.vehicles.registration import fitted_pose, is_spread, register
from fuselog.replay.families.vehicles.symmetric_sums import (
    power_sums,
    power_sums_at,
    product_sums,
    product_sums_at,
    update_root,
)
from fuselog.replay.families.vehicles.vehicles import (
    POSE,
    STATES,
    Joint,
    Motion,
    collapse,
    position_rows,
    positions,
    sight_of,
    topology_measurement,
    update,
    update_by_scalar,
    update_by_shape,
)

FIXES = {
    "known": "fixes with known vehicles",
    "hungarian": "unordered fixes, most probable map",
    "set": "unordered fixes, exact collapse over all maps",
    "axes": "unordered x and unordered y, exact collapse of each, as with separate sums of powers",
    "powers": "sums of powers of x and of y, linearized",
    "unscented-powers": "sums of powers of x and of y, sampled",
    "products": "sums of products of x and of y, linearized",
    "complex": "sums of powers of x + iy, linearized",
}
SENSOR = {
    "": "not used",
    "topology": "the sum of squared distances between all detections",
    "registration": "detections from a pose that differs in every scan",
    "static": "detections from a constant pose",
}


class Setup(NamedTuple):
    """Settings of a bound method; `numbers` are the vehicle numbers in the names of topics."""

    name: str
    numbers: tuple[int, ...]
    fixes: str
    sensor: str
    motion: Motion
    network: Scanning
    infrastructure: Scanning
    registration_scan: int = 1
    sigma_fix_m: float | None = None

    @property
    def has_pose(self) -> bool:
        """Test whether the state contains the sensor's pose."""
        return self.sensor in ("registration", "static")

    @property
    def uses_sums(self) -> bool:
        """Test whether the method uses symmetric sums of unordered fixes instead of associating them."""
        return self.fixes not in ("known", "hungarian", "set", "axes")

    @property
    def states(self) -> int:
        """Return the number of components of the joint state."""
        return STATES * self.motion.vehicles + POSE * self.has_pose


def split_method(method: str) -> tuple[str, str]:
    """Split a method into its parts for fixes and for the infrastructure sensor ("" if unused)."""
    fixes, _, sensor = method.rpartition("-")
    return (fixes, sensor) if fixes and sensor in SENSOR else (method, "")


def put(joint: Joint, rows: Integers, changed: Joint) -> Joint:
    """Return the joint states with some rows replaced.

    Args:
        joint: joint states of all runs.
        rows: (k,), rows to replace.
        changed: their new values.
    """
    if len(rows) == len(joint.mean):
        return changed
    mean, covariance = joint.mean.copy(), joint.covariance.copy()
    mean[rows], covariance[rows] = changed
    return Joint(mean, covariance)


def where(chosen: Booleans, joint: Joint, change: Callable[[Joint], Joint]) -> Joint:
    """Apply a change to the joint states of the chosen runs.

    Args:
        chosen: (runs,), which runs to change.
        joint: joint states of all runs.
        change: function of the joint states of the chosen runs.
    """
    rows = np.flatnonzero(chosen)
    return put(joint, rows, change(joint.of(rows))) if len(rows) else joint


def update_by_fixes(setup: Setup, joint: Joint, fixes: Floats, noise: Floats) -> Joint:
    """Update with fixes of known vehicles.

    Args:
        setup: the bound method.
        joint: the Gaussians of all runs.
        fixes: (runs, vehicles, 2), in m, NaN if missing.
        noise: (runs, vehicles, 2, 2), in m^2.
    """
    vehicles = setup.motion.vehicles
    innovation = (fixes - positions(setup.motion, joint.mean)).reshape(-1, 2 * vehicles)
    spread = np.zeros((len(fixes), vehicles, 2, vehicles, 2))
    spread[:, np.arange(vehicles), :, np.arange(vehicles), :] = np.moveaxis(noise, 0, 1)
    matrices = spread.reshape(-1, 2 * vehicles, 2 * vehicles)
    return update(joint, position_rows(vehicles, setup.states), innovation, matrices)


class Associated(NamedTuple):
    """Detections (runs, vehicles) of one map, or MISSED, with innovations (..., 2) and covariances."""

    detection: Integers
    innovation: Floats
    covariance: Floats


def update_by_set(setup: Setup, joint: Joint, detections: Floats) -> tuple[Joint, Associated | None]:
    """Update with unordered fixes; also return the map of the fixes if the method uses a single map.

    Args:
        setup: the bound method.
        joint: the Gaussians of all runs.
        detections: (runs, detections, 2), in m.
    """
    vehicles = setup.motion.vehicles
    associated = None
    for axes in ((0,), (1,)) if setup.fixes == "axes" else ((0, 1),):
        rows = position_rows(vehicles, setup.states, axes)
        predicted = (joint.mean @ rows.T).reshape(-1, vehicles, len(axes))
        noise = setup.network.variance_m2 * np.ones(vehicles * len(axes))
        spread = blocks_of(rows @ joint.covariance @ rows.T + np.diag(noise), vehicles)
        places = detections[..., axes]
        likelihood = log_likelihoods(predicted, spread, places)
        maps = (best_maps if setup.fixes == "hungarian" else all_maps)(likelihood, setup.network)
        innovations = innovations_of(maps, predicted, places)
        if setup.fixes == "hungarian":
            associated = Associated(maps.detection, innovations.reshape(predicted.shape), spread)
        joint = collapse(joint, rows, innovations, noise, maps)
    return joint, associated


def update_by_sums(setup: Setup, joint: Joint, detections: Floats) -> Joint:
    """Update with symmetric sums of full scans; scans with missing or extra fixes are ignored.

    The expected mean is subtracted from the numbers first: the resulting sums are linear combinations of
    the original sums and lose fewer digits.

    Args:
        setup: the bound method.
        joint: the Gaussians of the runs.
        detections: (runs, detections, 2), in m, padded with NaN.
    """
    vehicles, states = setup.motion.vehicles, setup.states
    full = np.flatnonzero(np.isfinite(detections[..., 0]).sum(axis=1) == vehicles)
    own, places = joint.of(full), detections[full, :vehicles]
    sigma = float(np.sqrt(setup.network.variance_m2))
    by_axis = [position_rows(vehicles, states, (axis,)) for axis in (0, 1)]
    combinations = [by_axis[0] + 1j * by_axis[1]] if setup.fixes == "complex" else by_axis
    numbers = (
        [places @ np.array([1.0, 1j])] if setup.fixes == "complex" else list(places.T.swapaxes(1, 2))
    )
    for rows, measured in zip(combinations, numbers, strict=True):
        root = _root(own.covariance)
        expected = own.mean @ rows.T
        middle = expected.mean(axis=1, keepdims=True)
        at, m = expected - middle, measured - middle
        if setup.fixes == "products":
            pseudo, sums = product_sums_at(at, sigma), product_sums(m)
        else:
            pseudo, sums = power_sums_at(at, sigma), power_sums(m, sigma)
        mean, change = pseudo.expected, pseudo.jacobian @ (rows @ root)
        if setup.fixes == "unscented-powers":
            root = np.concatenate([root, -root], axis=2) * np.sqrt(0.5)
            steps = np.sqrt(2.0 * states) * np.swapaxes(rows @ root, 1, 2)
            samples = power_sums_at(at[:, None] + steps, sigma).expected
            mean = samples.mean(axis=1)
            change = np.swapaxes(samples - mean[:, None], 1, 2) / np.sqrt(2.0 * states)
        after, root = update_root(own.mean, root, change, sums - mean, pseudo.factor)
        own = Joint(after, root @ np.swapaxes(root, 1, 2))
    return put(joint, full, own)


def _root(covariance: Floats) -> Floats:
    """Compute factors X with X X' = covariance, even if rounding has made it slightly indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(covariance), np.float64)
    except np.linalg.LinAlgError:
        values, axes = np.linalg.eigh(np.nan_to_num(covariance))
        return np.asarray(axes * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def blocks_of(matrices: Floats, vehicles: int) -> Floats:
    """Return the diagonal blocks of the matrices.

    Args:
        matrices: (runs, vehicles a, vehicles a).
        vehicles: number of vehicles.

    Returns:
        Blocks (runs, vehicles, a, a).
    """
    size = matrices.shape[-1] // vehicles
    split = matrices.reshape(-1, vehicles, size, vehicles, size)
    index = np.arange(vehicles)
    return np.moveaxis(split[:, index, :, index, :], 0, 1)


def innovations_of(maps: Hypotheses, predicted: Floats, places: Floats) -> Floats:
    """Compute detections minus predictions (h, vehicles * axes), by vehicle; NaN if missed.

    Args:
        maps: h hypotheses.
        predicted: (runs, vehicles, axes).
        places: the detections, (runs, detections, axes).
    """
    if places.shape[1] == 0:
        return np.full((len(maps.run), predicted[0].size), np.nan)
    chosen = places[maps.run[:, None], maps.detection]
    innovation = np.where((maps.detection == MISSED)[..., None], np.nan, chosen - predicted[maps.run])
    return innovation.reshape(len(maps.run), -1)


def update_by_topology(setup: Setup, joint: Joint, seen: Floats) -> Joint:
    """Update with the topology of scans, but ignore incomplete scans and scans of a single point.

    Args:
        setup: the bound method.
        joint: the Gaussians of the runs.
        seen: (runs, detections, 2), in m in the sensor's frame, padded with NaN.
    """
    vehicles = setup.motion.vehicles
    rows = np.flatnonzero(np.isfinite(seen[..., 0]).sum(axis=1) == vehicles)
    if vehicles < 2 or len(rows) == 0:
        return joint
    own = joint.of(rows)
    variance_m2 = setup.infrastructure.variance_m2
    measured = topology_measurement(setup.motion, own, seen[rows, :vehicles], variance_m2)
    return put(joint, rows, update_by_scalar(own, measured))


def update_by_pose(
    setup: Setup, joint: Joint, seen: Floats, registered: Booleans, may_start: Booleans
) -> tuple[Joint, Booleans]:
    """Update with detections of the infrastructure sensor, whose pose is also estimated.

    The pose is determined from the estimates of the vehicles if it is not yet known, or if it is assumed
    to change between scans.

    Args:
        setup: the bound method.
        joint: the Gaussians of the runs.
        seen: (runs, detections, 2), in m in the sensor's frame, padded with NaN.
        registered: (runs,), whether the pose is known.
        may_start: (runs,), whether the pose may be determined if it is not known.

    Returns:
        The joint states, and whether (runs,) the pose is known now.
    """
    vehicles = setup.motion.vehicles
    ordered = np.full((len(seen), vehicles, 2), np.nan)
    places = positions(setup.motion, joint.mean)
    known = np.flatnonzero(registered)
    if len(known):
        ordered[known] = _recognised(setup, joint.of(known), seen[known])
    is_full = np.isfinite(seen[..., 0]).sum(axis=1) == vehicles
    unknown = np.flatnonzero(~registered & may_start & is_full)
    if len(unknown):
        spread = _position_blocks(setup, joint.of(unknown))
        noise = setup.infrastructure.variance_m2 + 0.5 * np.trace(spread, axis1=2, axis2=3).mean(axis=1)
        found = register(places[unknown], seen[unknown, :vehicles], noise)
        clear = unknown[found.is_clear]
        order = found.detection[found.is_clear]
        ordered[clear] = np.take_along_axis(seen[clear], order[..., None], 1)
    fresh = ~registered & np.isfinite(ordered).any(axis=(1, 2))
    changes = setup.sensor == "registration"
    variance_m2 = setup.infrastructure.variance_m2
    anew = np.flatnonzero(fresh | (registered & changes & is_spread(ordered, variance_m2)))
    if len(anew):
        pose = fitted_pose(places[anew], ordered[anew])
        own = update_by_shape(setup.motion, joint.of(anew), pose, ordered[anew], variance_m2)
        joint = put(joint, anew, own)
    stays = np.flatnonzero(registered & (not changes))
    if len(stays):
        own = joint.of(stays)
        sight = sight_of(setup.motion, own)
        innovation = ordered[stays].reshape(len(stays), -1) - sight.predicted
        own = update(own, sight.rows, innovation, variance_m2 * np.eye(2 * vehicles))
        joint = put(joint, stays, own)
    return joint, registered | fresh


def _position_blocks(setup: Setup, joint: Joint) -> Floats:
    rows = position_rows(setup.motion.vehicles, setup.states)
    return blocks_of(rows @ joint.covariance @ rows.T, setup.motion.vehicles)


def _recognised(setup: Setup, joint: Joint, seen: Floats) -> Floats:
    """Return detections (runs, vehicles, 2) in the vehicles' order, associated by the estimated pose."""
    vehicles = setup.motion.vehicles
    sight = sight_of(setup.motion, joint)
    spread = sight.rows @ joint.covariance @ sight.rows.swapaxes(1, 2)
    spread += setup.infrastructure.variance_m2 * np.eye(2 * vehicles)
    predicted = sight.predicted.reshape(-1, vehicles, 2)
    maps = best_maps(log_likelihoods(predicted, blocks_of(spread, vehicles), seen), setup.infrastructure)
    if seen.shape[1] == 0:
        return np.full((len(seen), vehicles, 2), np.nan)
    chosen = np.take_along_axis(seen, np.maximum(maps.detection, 0)[..., None], 1)
    return np.where((maps.detection == MISSED)[..., None], np.nan, chosen)
