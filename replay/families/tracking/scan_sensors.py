"""Kinds of sensors with unordered scans that a tracker can use.

A target is (x_m, vx_mps, y_m, vy_mps) in the plane; `origin` is the position of the sensor.
"""

from typing import Any

import numpy as np

from fuselog.recorders.log import schemas
from fuselog.recorders.models.planar import Component, Components
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.families.tracking.association.scans import ScanSensor


def away(target: Components, origin: Any) -> tuple[Any, Any]:
    """Compute the position of a target relative to the sensor."""
    return target[0] - origin[0], target[2] - origin[1]


def is_within(bearing_rad: Component, begin_rad: Component, end_rad: Component) -> bool:
    """Test whether a bearing is in the anticlockwise sector between two angles; NaN means no sector."""
    turned = (bearing_rad - begin_rad) % (2.0 * np.pi)
    return turned < (end_rad - begin_rad) % (2.0 * np.pi)


def between(range_m: Component, near: Component, far: Component, parameters: Any) -> Component:
    """Return `near` below the near range, `far` above the far range; between, interpolate linearly."""
    if range_m <= parameters.near_range_m:
        return near
    if range_m >= parameters.far_range_m:
        return far
    share = (range_m - parameters.near_range_m) / (parameters.far_range_m - parameters.near_range_m)
    return near + share * (far - near)


def detection_of(target: Components, origin: Any, parameters: Any) -> Component:
    """Compute the probability of detection by range, scaled in one sector and 0 in the blind sector."""
    x, y = away(target, origin)
    bearing_rad = np.arctan2(y, x)
    if is_within(bearing_rad, parameters.blind_from_rad, parameters.blind_to_rad):
        return 0.0
    near, far = parameters.detection_probability, parameters.far_detection_probability
    probability = between(np.hypot(x, y), near, far, parameters)
    if is_within(bearing_rad, parameters.sector_from_rad, parameters.sector_to_rad):
        probability *= parameters.sector_detection_factor
    return probability


def clutter_in_plane(range_m: Component, bearing_rad: Component, parameters: Any) -> Component:
    """Compute the clutter per m^2 by range, scaled in one sector."""
    near, factor = parameters.clutter_per_m2, parameters.far_clutter_factor
    density = between(range_m, near, near * factor, parameters)
    if is_within(bearing_rad, parameters.sector_from_rad, parameters.sector_to_rad):
        density *= parameters.sector_clutter_factor
    return density


# Positions


def place_of(target: Components, origin: Any, parameters: Any) -> Components:
    """Compute the measured position of a target relative to the sensor, with lag and bias."""
    x, y = away(target, origin)
    lag_s = parameters.lag_s
    return x - lag_s * target[1] + parameters.bias_x_m, y - lag_s * target[3] + parameters.bias_y_m


def place_noise(target: Components, origin: Any, parameters: Any) -> Components:
    """Compute the lower triangle of a position's covariance; it is larger across the line of sight."""
    x, y = away(target, origin)
    along, across = parameters.sigma_m**2, parameters.sigma_across_rad**2
    return along + across * y * y, -across * x * y, along + across * x * x


def place_clutter(detection: Any, parameters: Any) -> Component:
    """Compute the clutter per m^2 at a detection."""
    x, y = detection
    return clutter_in_plane(np.hypot(x, y), np.arctan2(y, x), parameters)


def place_birth(
    detection: Any, origin: Any, parameters: Any
) -> tuple[Components, Components, Component]:
    """Return the position at a detection, its covariance, and the area in m^2 per measurement unit."""
    x = detection[0] - parameters.bias_x_m + origin[0]
    y = detection[1] - parameters.bias_y_m + origin[1]
    return (x, y), place_noise((x, 0.0, y, 0.0), origin, parameters), 1.0


# Bearings


def bearing_of(target: Components, origin: Any, parameters: Any) -> Components:
    """Compute the biased bearing of a target, anticlockwise from the x axis."""
    x, y = away(target, origin)
    return (np.arctan2(y, x) + parameters.bias_rad,)


def bearing_noise(target: Components, origin: Any, parameters: Any) -> Components:
    """Compute the variance of a bearing; the effect of `sigma_across_m` decreases with the range."""
    across = parameters.sigma_across_m / np.hypot(*away(target, origin))
    return (parameters.sigma_rad**2 + across**2,)


def bearing_clutter(detection: Any, parameters: Any) -> Component:
    """Compute the clutter per rad at a bearing."""
    density = parameters.clutter_per_rad
    if is_within(detection[0], parameters.sector_from_rad, parameters.sector_to_rad):
        density *= parameters.sector_clutter_factor
    return density


# Ranges with bearings


def polar_of(target: Components, origin: Any, parameters: Any) -> Components:
    """Compute measured range and bearing of a target, with the sensor's lag and biases."""
    x, y = away(target, origin)
    x, y = x - parameters.lag_s * target[1], y - parameters.lag_s * target[3]
    return np.hypot(x, y) + parameters.bias_range_m, np.arctan2(y, x) + parameters.bias_rad


def polar_noise(target: Components, origin: Any, parameters: Any) -> Components:
    """Compute the variances of range and bearing."""
    (variance,) = bearing_noise(target, origin, parameters)
    return parameters.sigma_m**2, variance


def polar_clutter(detection: Any, parameters: Any) -> Component:
    """Compute the clutter per m and rad: the clutter per m^2 times the range."""
    range_m, bearing_rad = detection
    return range_m * clutter_in_plane(range_m, bearing_rad, parameters)


def polar_birth(
    detection: Any, origin: Any, parameters: Any
) -> tuple[Components, Components, Component]:
    """Return the position at a detection, its covariance, and the area in m^2 per measurement unit."""
    range_m, bearing_rad = detection[0] - parameters.bias_range_m, detection[1] - parameters.bias_rad
    cosine, sine = np.cos(bearing_rad), np.sin(bearing_rad)
    x, y = origin[0] + range_m * cosine, origin[1] + range_m * sine
    along, turned = polar_noise((x, 0.0, y, 0.0), origin, parameters)
    across = turned * range_m**2
    triangle = (
        along * cosine**2 + across * sine**2,
        (along - across) * cosine * sine,
        along * sine**2 + across * cosine**2,
    )
    return (x, y), triangle, range_m


PLACES = ScanSensor(
    "detection",
    schemas.DETECTION,
    ("position_m",),
    dict.fromkeys(PLANE, "linear"),
    place_of,
    place_noise,
    detection_of,
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
    detection_of,
    bearing_clutter,
)
RANGES_BEARINGS = ScanSensor(
    "range_bearing",
    schemas.SCAN_RANGE_BEARING,
    ("range_m", "bearing_rad"),
    {"range_m": "linear", "bearing_rad": "angle"},
    polar_of,
    polar_noise,
    detection_of,
    polar_clutter,
    polar_birth,
)
KINDS = (PLACES, BEARINGS, RANGES_BEARINGS)
SEEN = {(kind.leaf, kind.schema.full_name) for kind in KINDS}  # topics with detections
# Defaults for values that a channel does not state: the effect is absent.
UNSTATED: dict[str, float] = {
    "sigma_across_rad": 0.0,
    "lag_s": 0.0,
    "bias_x_m": 0.0,
    "bias_y_m": 0.0,
    "joined_within_m": 0.0,
    "sigma_across_m": 0.0,
    "bias_range_m": 0.0,
    "bias_rad": 0.0,
    "interval_s": 0.0,
    "registration_sigma_m": 0.0,
    "registration_sigma_rad": 0.0,
    "correlated_sigma_m": 0.0,
    "correlated_sigma_rad": 0.0,
    "correlation_s": np.inf,
    "blind_from_rad": np.nan,
    "blind_to_rad": np.nan,
    "near_range_m": np.inf,
    "far_range_m": np.inf,
    "far_detection_probability": np.nan,
    "far_clutter_factor": 1.0,
    "sector_from_rad": np.nan,
    "sector_to_rad": np.nan,
    "sector_detection_factor": 1.0,
    "sector_clutter_factor": 1.0,
    "gate_probability": 0.99,
}
# Parameters that apply only to the other kinds of sensors.
FOREIGN = {
    PLACES.leaf: (
        "sigma_rad",
        "clutter_per_rad",
        "registration_sigma_rad",
        "correlated_sigma_rad",
    ),
    BEARINGS.leaf: (
        "sigma_m",
        "clutter_per_m2",
        "joined_within_m",
        "registration_sigma_m",
        "correlated_sigma_m",
    ),
    RANGES_BEARINGS.leaf: ("clutter_per_rad", "joined_within_m"),
}
