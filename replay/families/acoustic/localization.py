"""Localization of a shooter from a single shot: the three methods of Osborne et al., JAIF 2014.

The parameters are the shooter's position, the bullet's direction (except in bearings-only mode, which
has no information about it) and, if they are estimated, the sensors' positions. Otherwise, each sensor
is assumed to be at its position fix, and the error of the fix is added to the covariance of the
sensor's measurements.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic import models as model
from fuselog.recorders.families.acoustic.models import Medium, Noise
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.estimators.localization.least_squares import (
    Bound,
    Linearization,
    Solution,
    cramer_rao_bound,
    mask_missing,
    solve,
)
from fuselog.replay.estimators.localization.rays import intersect_rays

# Derivatives with respect to azimuth, range and trajectory.
BY_AZIMUTH = (1.0, 0.0, 0.0)
BY_RANGE = (0.0, 1.0, 0.0)
BY_TRAJECTORY = (0.0, 0.0, 1.0)
CONSTANT = (0.0, 0.0, 0.0)


class Mode(StrEnum):
    """Data that the sensors send to the fusion centre."""

    BEARINGS_ONLY = "bearings-only"
    LOCAL_ESTIMATES = "local-estimates"
    NATIVE_MEASUREMENTS = "native-measurements"


class Setting(NamedTuple):
    """Assumptions of the estimator about sensors and medium.

    `cross_covariances` keeps the covariances between range and angles in local estimates. The paper
    leaves them out. With them, the search is unstable, and the bound of eq (48) is invalid: it falls
    below the bound of the native measurements, from which the local estimates are derived.
    """

    mode: Mode
    noise: Noise
    medium: Medium = Medium()
    estimate_sensors: bool = True
    cross_covariances: bool = False


class Detections(NamedTuple):
    """Detections (runs, sensors) of one shot per run, and positions (runs, sensors, 2) of the sensors.

    The shockwave and the time difference are NaN if the shockwave was not heard.
    """

    muzzle_blast_rad: Floats
    shockwave_rad: Floats
    time_difference_s: Floats
    position_m: Floats

    def take(self, rows: NDArray[np.intp]) -> "Detections":
        """Select the runs with the indices `rows`."""
        return Detections(*(column[rows] for column in self))


def parameter_names(setting: Setting, sensors: Sequence[int]) -> list[str]:
    """Return the names of the parameters, with units, for sensors with these numbers."""
    shot = model.SHOT_COMPONENTS[: 2 if setting.mode == Mode.BEARINGS_ONLY else 3]
    estimated = sensors if setting.estimate_sensors else []
    return [*shot, *(name for sensor in estimated for name in model.sensor_components(sensor))]


def estimate(setting: Setting, heard: Detections) -> Solution:
    """Localize the shot of every run; raise BadInput for wrong shapes or noise that is not positive."""
    _check(setting, heard)
    return solve(
        lambda parameters, rows: linearize(setting, heard.take(rows), parameters),
        starting_point(setting, heard),
    )


def bound(setting: Setting, shooter_m: Floats, trajectory_rad: Floats, sensor_m: Floats) -> Bound:
    """Compute the CRLB at the truth.

    Args:
        setting: assumptions of the estimator.
        shooter_m: (runs, 2), the true positions of the shooter.
        trajectory_rad: (runs,), the true directions of the bullet.
        sensor_m: (sensors, 2), or (runs, sensors, 2), the true positions of the sensors.
    """
    heard = noise_free(setting.medium, shooter_m, trajectory_rad, sensor_m)
    parts = [shooter_m]
    if setting.mode != Mode.BEARINGS_ONLY:
        parts.append(trajectory_rad[:, None])
    if setting.estimate_sensors:
        parts.append(heard.position_m.reshape(len(shooter_m), -1))
    return cramer_rao_bound(linearize(setting, heard, np.concatenate(parts, axis=1)))


def noise_free(
    medium: Medium, shooter_m: Floats, trajectory_rad: Floats, sensor_m: Floats
) -> Detections:
    """Compute the detections of noise-free sensors.

    Args:
        medium: the speeds of sound and bullet.
        shooter_m, trajectory_rad, sensor_m: as for `bound`.
    """
    position = np.broadcast_to(sensor_m, (len(shooter_m), *sensor_m.shape[-2:]))
    with np.errstate(invalid="ignore"):
        angles = model.hear(
            shooter_m.T[:, :, None], trajectory_rad[:, None], np.moveaxis(position, -1, 0), medium
        )
    return Detections(*angles, position)


def starting_point(setting: Setting, heard: Detections) -> Floats:
    """Return the intersection of the bearings, the mean direction of the bullet, and the position fixes.

    The tangents and cotangents of eqs (32)-(34) describe the same rays with other weights.
    """
    unit = np.stack([np.cos(heard.muzzle_blast_rad), np.sin(heard.muzzle_blast_rad)], axis=-1)
    parts = [intersect_rays(heard.position_m, unit)]
    if setting.mode != Mode.BEARINGS_ONLY:
        side = model.measured_side(heard.muzzle_blast_rad, heard.shockwave_rad)
        angle = model.trajectory_from_shockwave(heard.shockwave_rad, side, setting.medium)
        mean = np.arctan2(np.nansum(np.sin(angle), axis=1), np.nansum(np.cos(angle), axis=1))
        parts.append(mean[:, None])
    if setting.estimate_sensors:
        parts.append(heard.position_m.reshape(len(unit), -1))
    return np.concatenate(parts, axis=1)


def linearize(setting: Setting, heard: Detections, parameters: Floats) -> Linearization:
    """Linearize the chosen measurements, with one block of correlated errors per sensor.

    If the sensors are not estimated, the contribution of the position fixes to the covariance depends on
    the parameters; the resulting bound ignores this dependence.

    Args:
        setting: assumptions of the estimator.
        heard: one shot per run, as detected by all sensors.
        parameters: (runs, n), the point of linearisation.
    """
    position = heard.position_m
    if setting.estimate_sensors:
        position = parameters[:, -2 * position.shape[1] :].reshape(position.shape)
    azimuth, distance = model.azimuth_range(parameters.T[:2, :, None], np.moveaxis(position, -1, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        view = _VIEWS[setting.mode](setting, heard, _Geometry(azimuth, distance, parameters[:, 2:3]))
        view = _by_parameters(view, _chain_rule(setting, azimuth, distance))
        if setting.estimate_sensors:
            view = _append_fixes(view, heard.position_m - position, setting.noise.position_m)
        else:
            view = _absorb_fixes(view, setting.noise.position_m)
    runs, sensors, k, n = view.jacobian.shape
    residual = view.residual.reshape(runs, sensors * k)
    jacobian = view.jacobian.reshape(runs, sensors * k, n)
    return mask_missing(
        Linearization(residual, jacobian, view.covariance, view.slope), np.isfinite(residual)
    )


class _Geometry(NamedTuple):
    """Position of the shooter relative to the sensors (runs, sensors), and the trajectory (runs, 1)."""

    azimuth_rad: Floats
    range_m: Floats
    trajectory_rad: Floats


class _Blocks(NamedTuple):
    """Blocks of k measurements per sensor, NaN where missing, with derivatives in the last axis.

    residual (runs, sensors, k), jacobian (..., k, d), covariance (..., k, k), and its derivative slope
    (..., k, k, d). The derivatives are first with respect to azimuth, range and trajectory (d = 3), and
    finally with respect to all parameters.
    """

    residual: Floats
    jacobian: Floats
    covariance: Floats
    slope: Floats | None


def _bearings(setting: Setting, heard: Detections, geometry: _Geometry) -> _Blocks:
    residual = wrap_angle(heard.muzzle_blast_rad - geometry.azimuth_rad)
    return _blocks([residual], [BY_AZIMUTH], [[setting.noise.muzzle_blast_rad**2]])


def _native_measurements(setting: Setting, heard: Detections, geometry: _Geometry) -> _Blocks:
    """Linearize both directions of arrival and the delay, on the side that fits the shockwave better."""
    noise, medium = setting.noise, setting.medium
    azimuth, distance, trajectory = geometry
    misses = [
        wrap_angle(heard.shockwave_rad - model.shockwave_azimuth(trajectory, side, medium))
        for side in (1.0, -1.0)
    ]
    miss = np.where(np.abs(misses[0]) <= np.abs(misses[1]), *misses)
    separation = azimuth - heard.shockwave_rad + miss
    delay = model.time_difference(distance, separation, medium)
    by_range, by_separation = model.time_difference_gradient(distance, separation, medium)
    return _blocks(
        [wrap_angle(heard.muzzle_blast_rad - azimuth), miss, heard.time_difference_s - delay],
        [BY_AZIMUTH, BY_TRAJECTORY, (by_separation, by_range, -by_separation)],
        np.diag(
            np.square([noise.muzzle_blast_rad, noise.shockwave_rad, noise.time_difference_s])
        ).tolist(),
    )


def _local_estimates(setting: Setting, heard: Detections, geometry: _Geometry) -> _Blocks:
    """Linearize the bearing, and the range and trajectory that a sensor derives from its detections."""
    noise, medium = setting.noise, setting.medium
    azimuth, distance, trajectory = geometry
    side = model.measured_side(heard.muzzle_blast_rad, heard.shockwave_rad)
    separation = heard.muzzle_blast_rad - heard.shockwave_rad
    measured_range = model.range_from_time_difference(heard.time_difference_s, separation, medium)
    measured_trajectory = model.trajectory_from_shockwave(heard.shockwave_rad, side, medium)

    separation = azimuth - model.shockwave_azimuth(trajectory, side, medium)
    variance, with_azimuth, with_trajectory = model.local_estimate_covariances(
        distance, separation, noise, medium
    )
    variance_slope, azimuth_slope, trajectory_slope = [
        (by_separation, by_range, -by_separation)
        for by_range, by_separation in model.local_estimate_covariance_gradients(
            distance, separation, noise, medium
        )
    ]
    if not setting.cross_covariances:
        with_azimuth = with_trajectory = 0.0
        azimuth_slope = trajectory_slope = CONSTANT
    return _blocks(
        [
            wrap_angle(heard.muzzle_blast_rad - azimuth),
            measured_range - distance,
            wrap_angle(measured_trajectory - trajectory),
        ],
        [BY_AZIMUTH, BY_RANGE, BY_TRAJECTORY],
        [
            [noise.muzzle_blast_rad**2, with_azimuth, 0.0],
            [with_azimuth, variance, with_trajectory],
            [0.0, with_trajectory, noise.shockwave_rad**2],
        ],
        [
            [CONSTANT, azimuth_slope, CONSTANT],
            [azimuth_slope, variance_slope, trajectory_slope],
            [CONSTANT, trajectory_slope, CONSTANT],
        ],
    )


def _check(setting: Setting, heard: Detections) -> None:
    shape = heard.muzzle_blast_rad.shape
    for name, column in heard._asdict().items():
        expected = (*shape, 2) if name == "position_m" else shape
        if len(shape) != 2 or column.shape != expected:
            raise BadInput(
                f"detections: {name} has shape {column.shape}, and muzzle blasts have shape {shape}; "
                "expected (runs, sensors), and (runs, sensors, 2) for positions"
            )
    if min(setting.noise) <= 0.0:
        raise BadInput(f"acoustic noise {setting.noise}: all standard deviations must be positive")


def _blocks(residual: list, jacobian: list, covariance: list, slope: list | None = None) -> _Blocks:
    """Make blocks from nested lists of numbers and arrays (runs, sensors)."""
    shape = residual[0].shape
    return _Blocks(
        _stack(residual, shape),
        _stack(jacobian, shape),
        _stack(covariance, shape),
        None if slope is None else _stack(slope, shape),
    )


def _stack(entries: list | tuple | Floats | float, shape: tuple[int, ...]) -> Floats:
    if isinstance(entries, list | tuple):
        return np.stack([_stack(entry, shape) for entry in entries], axis=len(shape))
    return np.broadcast_to(entries, shape)


def _chain_rule(setting: Setting, azimuth: Floats, distance: Floats) -> Floats:
    """Compute the Jacobian (runs, sensors, 3, n) of azimuth, range and trajectory for all parameters."""
    runs, sensors = distance.shape
    x, y = np.cos(azimuth), np.sin(azimuth)
    by_shooter = _stack([[-y / distance, x / distance], [x, y], [0.0, 0.0]], distance.shape)
    by_trajectory = _stack([[0.0], [0.0], [1.0]], distance.shape)
    by_position = np.zeros((runs, sensors, 3, sensors, 2))
    own = np.arange(sensors)
    by_position[:, own, :, own] = -np.swapaxes(by_shooter, 0, 1)
    parts = [by_shooter]
    if setting.mode != Mode.BEARINGS_ONLY:
        parts.append(by_trajectory)
    if setting.estimate_sensors:
        parts.append(by_position.reshape(runs, sensors, 3, 2 * sensors))
    return np.concatenate(parts, axis=-1)


def _by_parameters(view: _Blocks, chain: Floats) -> _Blocks:
    slope = None if view.slope is None else view.slope @ chain[:, :, None]
    return view._replace(jacobian=view.jacobian @ chain, slope=slope)


def _append_fixes(view: _Blocks, residual: Floats, sigma_m: float) -> _Blocks:
    """Append each sensor's position fix as two further measurements of the sensor's position."""
    runs, sensors, _, n = view.jacobian.shape
    selection = np.eye(n)[-2 * sensors :].reshape(sensors, 2, n)
    wider = [(0, 0), (0, 0), (0, 2), (0, 2)]
    covariance = np.pad(view.covariance, wider)
    covariance[..., -2:, -2:] = sigma_m**2 * np.eye(2)
    return _Blocks(
        np.concatenate([view.residual, residual], axis=2),
        np.concatenate([view.jacobian, np.broadcast_to(selection, (runs, sensors, 2, n))], axis=2),
        covariance,
        None if view.slope is None else np.pad(view.slope, [*wider, (0, 0)]),
    )


def _absorb_fixes(view: _Blocks, sigma_m: float) -> _Blocks:
    """Add the position fixes' error to the covariance; the error acts like a shift of the shooter."""
    by_shooter = view.jacobian[..., :2]
    share = sigma_m**2 * by_shooter @ np.swapaxes(by_shooter, 2, 3)
    return view._replace(covariance=view.covariance + share)


_VIEWS = {
    Mode.BEARINGS_ONLY: _bearings,
    Mode.LOCAL_ESTIMATES: _local_estimates,
    Mode.NATIVE_MEASUREMENTS: _native_measurements,
}
