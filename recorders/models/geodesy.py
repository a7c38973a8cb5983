"""Conversion of positions between a local tangent plane (east, north, up) and the WGS 84 ellipsoid."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.models.planar import Component, Components

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


def earth_centred(
    latitude_deg: Component, longitude_deg: Component, altitude_m: Component = 0.0
) -> tuple[Component, Component, Component]:
    """Convert a geodetic position to earth-centred, earth-fixed coordinates in m."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    return (
        (normal + altitude_m) * np.cos(latitude) * np.cos(longitude),
        (normal + altitude_m) * np.cos(latitude) * np.sin(longitude),
        (normal * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * np.sin(latitude),
    )


def tangent_axes(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> NDArray[np.float64]:
    """Compute the directions east, north and up at positions on WGS 84, in earth-centred axes.

    Args:
        latitude_deg: (...), in deg.
        longitude_deg: (...), in deg.

    Returns:
        (..., 3, 3), unit vectors as rows.
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    zero = np.zeros_like(latitude)
    rows = (
        (-np.sin(longitude), np.cos(longitude), zero),
        (
            -np.sin(latitude) * np.cos(longitude),
            -np.sin(latitude) * np.sin(longitude),
            np.cos(latitude),
        ),
        (np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def out_of_tangent_plane(
    place_m: Components, origin_deg: Components
) -> tuple[Component, Component, Component]:
    """Convert a position (east, north, optionally up) to latitude, longitude (deg) and height (m).

    Bowring's formula, Survey Review 23, 1976: accurate to less than a micrometre near the ground.
    """
    latitude, longitude = np.radians(origin_deg[0]), np.radians(origin_deg[1])
    east, north, up = (*place_m, 0.0)[:3]
    x, y, z = earth_centred(*origin_deg)
    outward = np.cos(latitude) * up - np.sin(latitude) * north
    x = x - np.sin(longitude) * east + np.cos(longitude) * outward
    y = y + np.cos(longitude) * east + np.sin(longitude) * outward
    z = z + np.cos(latitude) * north + np.sin(latitude) * up
    from_axis = np.hypot(x, y)
    reduced = np.arctan2(z * SEMI_MAJOR_M, from_axis * SEMI_MINOR_M)
    ratio = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
    rise = z + ratio * SEMI_MINOR_M * np.sin(reduced) ** 3
    out = from_axis - ECCENTRICITY_SQUARED * SEMI_MAJOR_M * np.cos(reduced) ** 3
    found = np.arctan2(rise, out)
    sine = np.sin(found)
    height = (
        from_axis * np.cos(found)
        + z * sine
        - SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    )
    return np.degrees(found), np.degrees(np.arctan2(y, x)), height


def into_tangent_plane(
    place_deg: Components, origin_deg: Components
) -> tuple[Component, Component, Component]:
    """Compute east, north and up (m) of a position relative to the origin.

    Position and origin are latitude and longitude in deg, and optionally the height above the ellipsoid
    in m, which is 0 by default.
    """
    latitude, longitude = np.radians(origin_deg[0]), np.radians(origin_deg[1])
    x, y, z = (
        there - here
        for there, here in zip(earth_centred(*place_deg), earth_centred(*origin_deg), strict=True)
    )
    outward = np.cos(longitude) * x + np.sin(longitude) * y
    return (
        np.cos(longitude) * y - np.sin(longitude) * x,
        np.cos(latitude) * z - np.sin(latitude) * outward,
        np.cos(latitude) * outward + np.sin(latitude) * z,
    )


def local_metres(latitude_deg: Component, longitude_deg: Component) -> NDArray[np.float64]:
    """Compute east and north (n, 2) in m of positions relative to their median; NaN if unknown.

    Args:
        latitude_deg: (n,), NaN if unknown.
        longitude_deg: (n,), NaN if unknown.
    """
    middle = np.nanmedian(latitude_deg), np.nanmedian(longitude_deg)
    east, north, _ = into_tangent_plane((latitude_deg, longitude_deg, 0.0), (*middle, 0.0))
    return np.stack([east, north], axis=-1)
