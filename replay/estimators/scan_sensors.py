"""The kinds of sensors of unordered scans that a tracker takes, and what they are like.

A target is (x_m, vx_mps, y_m, vy_mps) in the plane; `origin` is where the sensor is.
"""

from typing import Any

import numpy as np

from recorders.log import schemas
from recorders.models.planar import Component, Components
from replay.engine.measurements import PLANE
from replay.inference.scanning import ScanSensor


def away(target: Components, origin: Any) -> tuple[Any, Any]:
    """Where a target is from a sensor."""
    return target[0] - origin[0], target[2] - origin[1]


def is_blind(target: Components, origin: Any, parameters: Any) -> bool:
    """Whether a target is in the sector, anticlockwise from one angle to another, that is not seen."""
    if np.isnan(parameters.blind_from_rad):
        return False
    x, y = away(target, origin)
    turned = (np.arctan2(y, x) - parameters.blind_from_rad) % (2.0 * np.pi)
    return turned < (parameters.blind_to_rad - parameters.blind_from_rad) % (2.0 * np.pi)


def place_of(target: Components, origin: Any, parameters: Any) -> Components:
    """Where a target is from the sensor, `lag_s` ago, as a sensor says that is out by its bias."""
    x, y = away(target, origin)
    lag_s = parameters.lag_s
    return x - lag_s * target[1] + parameters.bias_x_m, y - lag_s * target[3] + parameters.bias_y_m


def place_noise(target: Components, origin: Any, parameters: Any) -> Components:
    """The lower triangle of a place's covariance: wider across the line of sight than along it."""
    x, y = away(target, origin)
    along, across = parameters.sigma_m**2, parameters.sigma_across_rad**2
    return along + across * y * y, -across * x * y, along + across * x * x


def place_detection(target: Components, origin: Any, parameters: Any) -> Component:
    """Falls linearly between two ranges."""
    if is_blind(target, origin, parameters):
        return 0.0
    near, far = parameters.detection_probability, parameters.far_detection_probability
    range_m = np.hypot(*away(target, origin))
    if range_m <= parameters.near_range_m:
        return near
    if range_m >= parameters.far_range_m:
        return far
    share = (range_m - parameters.near_range_m) / (parameters.far_range_m - parameters.near_range_m)
    return near + share * (far - near)


def place_clutter(detection: Any, parameters: Any) -> Component:
    """Per m^2."""
    return parameters.clutter_per_m2


def place_birth(detection: Any, origin: Any, parameters: Any) -> tuple[Components, Components]:
    """A target where it was detected."""
    x, y = detection[0] + origin[0], detection[1] + origin[1]
    return (x, y), place_noise((x, 0.0, y, 0.0), origin, parameters)


def bearing_of(target: Components, origin: Any, parameters: Any) -> Components:
    """Anticlockwise from the x axis, as a sensor says that is turned by its bias."""
    x, y = away(target, origin)
    return (np.arctan2(y, x) + parameters.bias_rad,)


def bearing_noise(target: Components, origin: Any, parameters: Any) -> Components:
    """The variance of a bearing; it does not matter much where on a hull it points when that is far."""
    across = parameters.sigma_across_m / np.hypot(*away(target, origin))
    return (parameters.sigma_rad**2 + across**2,)


def bearing_detection(target: Components, origin: Any, parameters: Any) -> Component:
    """The same at all ranges."""
    return 0.0 if is_blind(target, origin, parameters) else parameters.detection_probability


def bearing_clutter(detection: Any, parameters: Any) -> Component:
    """Per rad."""
    return parameters.clutter_per_rad


PLACES = ScanSensor(
    "detection",
    schemas.DETECTION,
    ("position_m",),
    dict.fromkeys(PLANE, "linear"),
    place_of,
    place_noise,
    place_detection,
    place_clutter,
    place_birth,
)
BEARINGS = ScanSensor(
    "bearing",
    schemas.SCAN_BEARING,
    ("bearing_rad",),
    {"bearing_rad": "angle"},
    bearing_of,
    bearing_noise,
    bearing_detection,
    bearing_clutter,
)
KINDS = (PLACES, BEARINGS)
# What a channel need not state, by kind: none of what it does not say is there.
UNSTATED: dict[str, float] = {
    "sigma_across_rad": 0.0,
    "lag_s": 0.0,
    "bias_x_m": 0.0,
    "bias_y_m": 0.0,
    "joined_within_m": 0.0,
    "sigma_across_m": 0.0,
    "bias_rad": 0.0,
    "interval_s": 0.0,
    "blind_from_rad": np.nan,
    "blind_to_rad": np.nan,
    "near_range_m": np.inf,
    "far_range_m": np.inf,
    "far_detection_probability": np.nan,
    "gate_probability": 0.99,
}
FOREIGN = {PLACES.leaf: ("sigma_rad", "clutter_per_rad"), BEARINGS.leaf: ("sigma_m", "clutter_per_m2")}
