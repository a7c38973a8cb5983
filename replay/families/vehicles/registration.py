"""Finds where an infrastructure sensor stands, from unordered detections and the vehicles' estimates.

Places are complex numbers here: a turn is a factor of length one, and the best one between centred
points is the phase of their inner product (Procrustes in the plane). Which detection is of which vehicle
is found by trying all permutations.
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
# A fit with so improbable a residual is of other things than the vehicles.
IMPROBABLE = 1e-4
# By how many squared sigmas the next permutation must fit worse for the best to be believed.
LEAST_LEAD = 30.0
# Least spread of the vehicles, in sigmas of a place: without it no heading can be told.
LEAST_SPREAD = 5.0


class Registration(NamedTuple):
    """Holds sensor poses (runs, 3), the detection of every vehicle, and whether both can be believed."""

    pose: Floats
    detection: Integers
    is_clear: Booleans


def register(places: Floats, detections: Floats, variance_m2: Floats | float) -> Registration:
    """Find the pose that lays full scans best on places, in any order.

    It is not clear where even the best fits badly (something else was taken for a vehicle), another
    order fits nearly as well, or the vehicles are too close together. `variance_m2` (runs,) is that of a
    place and a detection together. Raises BadInput for too many vehicles.

    Args:
        places: (runs, vehicles, 2), in m.
        detections: (runs, vehicles, 2), in the sensor's frame, in m.
        variance_m2: (runs,), that of a place and a detection together.
    """
    vehicles = places.shape[1]
    if vehicles > MOST_VEHICLES:
        raise BadInput(
            f"registration tries all permutations of {vehicles} vehicles; give {MOST_VEHICLES} at most"
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
    """Tell whether detections (runs, vehicles, 2), NaN for none, are far enough apart for a heading.

    Args:
        detections: (runs, vehicles, 2), in m, NaN for none.
        variance_m2: (runs,), of a detection.
    """
    count = np.isfinite(detections[..., 0]).sum(axis=1)
    squared = np.nansum((detections - _middle(detections)) ** 2, axis=(1, 2))
    return np.asarray((count > 1) & (squared > count * LEAST_SPREAD**2 * variance_m2))


def _middle(places: Floats) -> Floats:
    """Return means (runs, 1, 2) of what is there of places (runs, vehicles, 2); zero for nothing."""
    there = np.isfinite(places)
    count = np.maximum(there.sum(axis=1, keepdims=True), 1)
    return np.asarray(np.where(there, places, 0.0).sum(axis=1, keepdims=True) / count)


def fitted_pose(places: Floats, detections: Floats) -> Floats:
    """Find the poses that lay detections best on places in the same order.

    Pairs where either is NaN are left out.

    Args:
        places: (runs, vehicles, 2), in m.
        detections: (runs, vehicles, 2), in the sensor's frame, in m, in the same order.

    Returns:
        (runs, 3), x, y in m and heading in rad.
    """
    missing = np.any(np.isnan(places + detections), axis=2, keepdims=True)
    places, detections = np.where(missing, np.nan, places), np.where(missing, np.nan, detections)
    heading = np.angle(np.nansum(_centred(places) * _centred(detections).conj(), axis=1))
    middle = np.stack([_middle(places)[:, 0], _middle(detections)[:, 0]]) @ np.array([1.0, 1j])
    place = middle[0] - np.exp(1j * heading) * middle[1]
    return np.stack([place.real, place.imag, heading], axis=1)


def _centred(places: Floats) -> NDArray[np.complex128]:
    """Return places (runs, vehicles, 2) about their mean, as complex numbers."""
    return np.asarray((places - _middle(places)) @ np.array([1.0, 1j]))


@lru_cache(maxsize=MOST_VEHICLES)
def _permutations(count: int) -> Integers:
    return np.array(list(permutations(range(count))))
