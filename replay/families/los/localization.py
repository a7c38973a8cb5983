"""Estimation of targets and attitude biases from lines of sight: Belfadel et al., JAIF 2014.

The parameters are the positions of all targets (x, y, z each), followed by the unknown attitude biases
(yaw, pitch, roll of each sensor). In scheme 3 all biases are unknown; schemes 1 and 2 assume that all
are zero, which is wrong in scheme 2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import (
    bias_components,
    direction,
    line_of_sight,
    line_of_sight_gradients,
    target_components,
    turning_vector,
)
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Booleans, Floats
from fuselog.replay.estimators.localization.least_squares import (
    Linearization,
    Solution,
    cramer_rao_bound,
    describe_direction,
    mask_missing,
    solve,
    unobservable_directions,
)
from fuselog.replay.estimators.localization.rays import intersect_rays

# Sensors turn together if their turning vectors differ by less than this share of their length.
SAME_TURN = 1e-6


class Scene(NamedTuple):
    """Known properties of the sensors.

    position_m and nominal_attitude_rad (yaw, pitch, roll) are (sensors, 3), y up. sigma_rad (sensors, 2)
    is the noise of azimuth and elevation. known_bias_rad (sensors, 3) is NaN for biases to estimate.
    """

    position_m: Floats
    nominal_attitude_rad: Floats
    sigma_rad: Floats
    known_bias_rad: Floats

    @property
    def wanted(self) -> Booleans:
        """Return which biases (3 * sensors,) are estimated."""
        return np.isnan(self.known_bias_rad).ravel()


class Observability(NamedTuple):
    """Observability of the parameters from the measurements of one run.

    `turning_axis` is the unit vector about which all sensors and targets can rotate together without a
    change in the measurements. It is None if all parameters are observable, or if something other than
    this rotation is unobservable.
    """

    rank: int
    parameters: int
    turning_axis: Floats | None
    sentence: str


def parameter_names(scene: Scene, targets: Sequence[int], sensors: Sequence[int]) -> list[str]:
    """Return the names of the parameters, with units, for targets and sensors with these numbers."""
    places = [name for target in targets for name in target_components(target)]
    biases = [name for sensor in sensors for name in bias_components(sensor)]
    return places + [name for name, wanted in zip(biases, scene.wanted, strict=True) if wanted]


def predict(scene: Scene, parameters: Floats) -> Floats:
    """Predict azimuth and elevation in rad, without noise.

    Args:
        scene: known properties of the sensors.
        parameters: (runs, n).

    Returns:
        (runs, targets, sensors, 2), in rad.
    """
    return np.stack(line_of_sight(*_geometry(scene, parameters)), axis=-1)


def estimate(scene: Scene, measured: Floats, start: Floats | None = None) -> Solution:
    """Estimate positions and unknown biases from lines of sight.

    Raises BadInput if shapes do not match or a standard deviation is not positive.

    Args:
        scene: known properties of the sensors.
        measured: (runs, targets, sensors, 2), in rad, NaN if the target is not seen.
        start: (runs, n), starting point of the search; by default, the intersections of the rays.
    """
    _check(scene, measured)
    return solve(
        lambda parameters, rows: linearize(scene, measured[rows], parameters),
        starting_point(scene, measured) if start is None else start,
    )


def starting_point(scene: Scene, measured: Floats) -> Floats:
    """Compute parameters (runs, n) from the intersections of rays, with zero for unknown biases.

    Args:
        scene: known properties of the sensors.
        measured: (runs, targets, sensors, 2), in rad, NaN if the target is not seen.

    Returns:
        (runs, n).
    """
    attitude = scene.nominal_attitude_rad + np.nan_to_num(scene.known_bias_rad)
    unit = np.stack(direction(measured[..., 0], measured[..., 1], attitude.T[:, None]), axis=-1)
    targets = intersect_rays(scene.position_m, unit).reshape(len(measured), -1)
    return np.concatenate([targets, np.zeros((len(measured), scene.wanted.sum()))], axis=1)


def printed_starting_point(scene: Scene, measured: Floats) -> Floats:
    """Compute the start as printed, (21)-(23), for the first two sensors, with zero nominal attitudes.

    The paper writes z, x, y for x, y, z. The start depends on the difference between two azimuths: if
    sensors and targets are nearly in one vertical plane, as in the paper's three-sensor scenes, the
    start is too inaccurate. The function is meant for experiments.

    Args:
        scene: known properties of the sensors.
        measured: (runs, targets, sensors, 2), in rad.

    Returns:
        Parameters (runs, n), with zero for the biases.
    """
    first, second = scene.position_m[:2]
    azimuth_1, azimuth_2 = measured[:, :, 0, 0], measured[:, :, 1, 0]
    slope_1, slope_2 = np.tan(azimuth_1), np.tan(azimuth_2)
    z = (second[0] - first[0] + first[2] * slope_1 - second[2] * slope_2) / (slope_1 - slope_2)
    x = first[0] + (z - first[2]) * slope_1
    base = (first[0] - second[0]) * np.cos(azimuth_2) + (second[2] - first[2]) * np.sin(azimuth_2)
    y = first[1] + np.tan(measured[:, :, 0, 1]) * np.abs(base / np.sin(azimuth_1 - azimuth_2))
    targets = np.stack([x, y, z], axis=-1).reshape(len(measured), -1)
    return np.concatenate([targets, np.zeros((len(measured), scene.wanted.sum()))], axis=1)


def linearize(scene: Scene, measured: Floats, parameters: Floats) -> Linearization:
    """Linearize lines of sight at parameters.

    Args:
        scene: known properties of the sensors.
        measured: (runs, targets, sensors, 2), in rad, NaN if the target is not seen.
        parameters: (runs, n).
    """
    runs, targets, sensors, _ = measured.shape
    m = 2 * targets * sensors
    geometry = _geometry(scene, parameters)
    with np.errstate(divide="ignore", invalid="ignore"):
        predicted = np.stack(line_of_sight(*geometry), axis=-1)
        gradients = line_of_sight_gradients(*geometry)
    residual = wrap_angle(measured - predicted).reshape(runs, m)
    own = np.stack([np.stack(gradient, axis=-1) for gradient in gradients], axis=-2)
    by_target = own[..., None, :3] * np.eye(targets)[:, None, None, :, None]
    by_bias = own[..., None, 3:] * np.eye(sensors)[:, None, :, None]
    jacobian = np.concatenate(
        [
            by_target.reshape(runs, m, 3 * targets),
            by_bias.reshape(runs, m, 3 * sensors)[:, :, scene.wanted],
        ],
        axis=2,
    )
    variance = np.broadcast_to(scene.sigma_rad**2, measured.shape).reshape(runs, m)
    return mask_missing(Linearization(residual, jacobian, variance), np.isfinite(residual))


def observability(scene: Scene, measured: Floats, parameters: Floats) -> Observability:
    """Find rank and unobservable directions for one run.

    Args:
        scene: known properties of the sensors.
        measured: (targets, sensors, 2), NaN without a line of sight; other values do not matter.
        parameters: (n,).
    """
    counted = (range(1, count + 1) for count in measured.shape[:2])
    names = parameter_names(scene, *counted)
    [unseen] = unobservable_directions(linearize(scene, measured[None], parameters[None]))
    n, angles = len(parameters), int(np.isfinite(measured).sum())
    rank = n - unseen.shape[1]
    axis = _turning_axis(scene, parameters, unseen[:, 0]) if n - rank == 1 else None
    sentence = f"rank {rank} of {n} parameters from {angles} angles"
    if axis is not None:
        first = 3 * len(measured)
        sentence += (
            f": the measurements do not change if all sensors and targets turn together about the axis "
            f"({axis[0]:.3f}, {axis[1]:.3f}, {axis[2]:.3f}); fix one of the biases with a large share: "
            + describe_direction(names[first:], unseen[first:, 0])
        )
    elif angles < n:
        sentence += ": too few angles; each new target adds 3 parameters and 2 angles per sensor"
    elif rank < n:
        directions = (describe_direction(names, direction) for direction in unseen.T)
        sentence += f": the measurements do not change with {'; or with '.join(directions)}"
    return Observability(rank, n, axis, sentence)


def _turning_axis(scene: Scene, parameters: Floats, unseen: Floats) -> Floats | None:
    """Find the axis about which change `unseen` rotates all sensors; return None if axes differ."""
    if not scene.wanted.all():
        return None
    *_, attitude = _geometry(scene, parameters[None])
    change = unseen[-scene.position_m.size :].reshape(-1, 3)
    turn = np.stack(turning_vector(attitude[:, 0, 0], change.T), axis=1)
    mean = turn.mean(axis=0)
    length = np.linalg.norm(mean)
    if length == 0.0 or np.abs(turn - mean).max() > SAME_TURN * length:
        return None
    axis = mean / length
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def sigma_with_one_bias_known(scene: Scene, measured: Floats, parameters: Floats) -> Floats:
    """Compute the CRLB sigmas of all biases as if one bias were known, for each unknown bias in turn.

    If a row has infinite or large values, knowing its bias does not help, because the other biases are
    still unobservable.

    Args:
        scene: known properties of the sensors.
        measured: (targets, sensors, 2), in rad, for one run.
        parameters: (n,), the point of linearisation.

    Returns:
        A square matrix of sigmas in rad, with one row for each known bias and one column for each bias.
    """
    at = linearize(scene, measured[None], parameters[None])
    wanted = int(scene.wanted.sum())
    table = np.zeros((wanted, wanted))
    for known in range(wanted):
        column = len(parameters) - wanted + known
        bound = cramer_rao_bound(at._replace(jacobian=np.delete(at.jacobian, column, axis=2)))
        variance = np.diagonal(bound.covariance[0])[len(parameters) - wanted :]
        table[known] = np.insert(np.sqrt(variance), known, 0.0)
    return table


def _check(scene: Scene, measured: Floats) -> None:
    sensors = len(scene.position_m)
    for (name, column), width in zip(scene._asdict().items(), (3, 3, 2, 3), strict=True):
        if column.shape != (sensors, width):
            raise BadInput(f"optical scene: {name} has shape {column.shape}, not {(sensors, width)}")
    if measured.ndim != 4 or measured.shape[2:] != (sensors, 2):
        raise BadInput(
            f"lines of sight have shape {measured.shape}, not (runs, targets, {sensors} sensors, 2)"
        )
    if not (scene.sigma_rad > 0.0).all():
        raise BadInput("optical scene: sigma_rad must be positive for all sensors")


def _geometry(scene: Scene, parameters: Floats) -> tuple[Floats, Floats, Floats]:
    """Return targets, sensors and biased attitudes as broadcastable arrays with components first."""
    runs, sensors = len(parameters), len(scene.position_m)
    targets = (parameters.shape[1] - scene.wanted.sum()) // 3
    target = parameters[:, : 3 * targets].reshape(runs, targets, 3)
    bias = np.tile(scene.known_bias_rad.ravel(), (runs, 1))
    bias[:, scene.wanted] = parameters[:, 3 * targets :]
    attitude = scene.nominal_attitude_rad + bias.reshape(runs, sensors, 3)
    return (
        target.transpose(2, 0, 1)[..., None],
        scene.position_m.T[:, None, None],
        attitude.transpose(2, 0, 1)[:, :, None],
    )
