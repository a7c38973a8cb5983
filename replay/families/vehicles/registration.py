"""Registration of an infrastructure sensor from unordered detections and vehicle estimates.

Positions are complex numbers here: a rotation is a factor of length one, and the best rotation between
centred points is the phase of their inner product (Procrustes in the plane). All assignments of
detections to vehicles are tried.
"""

from functools import lru_cache
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Booleans, Floats, Integers

MOST_VEHICLES = 8
# If the residual is less probable than this, one of the detections is not a vehicle.
IMPROBABLE = 1e-4
# The best permutation must fit better than the second best by this number of squared sigmas.
LEAST_LEAD = 30.0
# Smallest spread of the vehicles, in sigmas of a position, that determines a heading.
LEAST_SPREAD = 5.0


class Registration(NamedTuple):
    """Sensor poses (runs, 3), the detection of every vehicle, and flags of reliable results."""

    pose: Floats
    detection: Integers
    is_clear: Booleans


def register(places: Floats, detections: Floats, variance_m2: Floats | float) -> Registration:
    """Find the poses that best align full scans, in any order, with positions.

    The result is unreliable if the best fit is poor (a detection is not a vehicle), if another order
    fits nearly as well, or if the vehicles are too close together. Raises BadInput if there are too many
    vehicles.

    Args:
        places: (runs, vehicles, 2), in m.
        detections: (runs, vehicles, 2), in the sensor's frame, in m.
        variance_m2: (runs,), sum of the variances of a position and a detection.
    """
    vehicles = places.shape[1]
    if vehicles > MOST_VEHICLES:
        raise BadInput(
            f"registration tries all permutations of {vehicles} vehicles; give at most {MOST_VEHICLES}"
        )
    order = _permutations(vehicles)
    there, seen = _centred(places), _centred(detections)
    products = np.einsum("rv,rpv->rp", there, seen[:, order].conj())
    variance = np.broadcast_to(variance_m2, len(places))
    fit: Floats = np.asarray(2.0 * np.abs(products) / variance[:, None])
    detection = order[fit.argmax(axis=1)]
    pose = fitted_pose(places, np.take_along_axis(detections, detection[..., None], 1))
    if vehicles < 2:
        return Registration(pose, detection, np.zeros(len(fit), bool))
    squared: Floats = np.asarray(np.sum(np.abs(there) ** 2, axis=1) / variance)
    residual = squared + np.sum(np.abs(seen) ** 2, axis=1) / variance - fit.max(axis=1)
    second, first = np.partition(fit, -2, axis=1)[:, -2:].T
    is_clear = (
        (residual < chi2.isf(IMPROBABLE, 2 * vehicles - 3))
        & (first - second > LEAST_LEAD)
        & is_spread(detections, variance)
    )
    return Registration(pose, detection, is_clear)


def is_spread(detections: Floats, variance_m2: Floats | float) -> Booleans:
    """Test whether detections are far enough apart to determine a heading.

    Args:
        detections: (runs, vehicles, 2), in m, NaN if missing.
        variance_m2: (runs,), variance of a detection.
    """
    count = np.isfinite(detections[..., 0]).sum(axis=1)
    squared = np.nansum((detections - _middle(detections)) ** 2, axis=(1, 2))
    return np.asarray((count > 1) & (squared > count * LEAST_SPREAD**2 * variance_m2))


def _middle(places: Floats) -> Floats:
    """Compute means (runs, 1, 2) of positions (runs, vehicles, 2) without NaN; zero if all are NaN."""
    there = np.isfinite(places)
    count = np.maximum(there.sum(axis=1, keepdims=True), 1)
    return np.asarray(np.where(there, places, 0.0).sum(axis=1, keepdims=True) / count)


def fitted_pose(places: Floats, detections: Floats) -> Floats:
    """Find the poses that best align detections with positions, both in the same order.

    Pairs with a NaN are ignored.

    Args:
        places: (runs, vehicles, 2), in m.
        detections: (runs, vehicles, 2), in the sensor's frame, in m, in the same order.

    Returns:
        Poses (runs, 3): x, y in m and heading in rad.
    """
    missing = np.any(np.isnan(places + detections), axis=2, keepdims=True)
    places, detections = np.where(missing, np.nan, places), np.where(missing, np.nan, detections)
    heading = np.angle(np.nansum(_centred(places) * _centred(detections).conj(), axis=1))
    middle = np.stack([_middle(places)[:, 0], _middle(detections)[:, 0]]) @ np.array([1.0, 1j])
    place = middle[0] - np.exp(1j * heading) * middle[1]
    return np.stack([place.real, place.imag, heading], axis=1)


def _centred(places: Floats) -> NDArray[np.complex128]:
    """Return positions (runs, vehicles, 2) minus their mean, as complex numbers."""
    return np.asarray((places - _middle(places)) @ np.array([1.0, 1j]))


@lru_cache(maxsize=MOST_VEHICLES)
def _permutations(count: int) -> Integers:
    return np.array(list(permutations(range(count))))
