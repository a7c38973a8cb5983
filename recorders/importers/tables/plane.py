"""The local tangent plane of a log's positions, computed from geodetic positions."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.extras import extra
from fuselog.recorders.importers.tables.mapping import Origin
from fuselog.recorders.models.geodesy import into_tangent_plane

Floats = NDArray[np.float64]


class Plane(NamedTuple):
    """A conversion to east, north and up from an origin, in the tangent plane or on a map projection.

    If the mapping states the origin, all positions of the log are in this plane.
    """

    origin: Origin
    projection: str | None = None
    is_stated: bool = False

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata for channels of streams in the plane."""
        stated = {f"origin_{name}": repr(value) for name, value in self.origin}
        # a model would take a stated origin as that of a tangent plane
        return stated if self.projection is None else {"projection": self.projection}

    def place(
        self, latitude_deg: Floats, longitude_deg: Floats, altitude_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Compute east, north and up (n,) in m from positions on WGS 84.

        Raises BadInput if pyproj is needed but not installed, or does not know the projection.
        """
        here = self.origin
        if self.projection is None:
            touch = (here.latitude_deg, here.longitude_deg, here.altitude_m)
            east, north, up = into_tangent_plane((latitude_deg, longitude_deg, altitude_m), touch)
            return np.asarray(east), np.asarray(north), np.asarray(up)
        onto_map = _onto_map(self.projection)
        east, north = onto_map.transform(longitude_deg, latitude_deg)
        zero_east, zero_north = onto_map.transform(here.longitude_deg, here.latitude_deg)
        is_on_map = np.isfinite(east) & np.isfinite(latitude_deg)
        place = np.where(is_on_map, [east - zero_east, north - zero_north], np.nan)
        return place[0], place[1], altitude_m - here.altitude_m


@cache
def _onto_map(projection: str) -> Any:
    with extra("maps", f"projection {projection}"):
        from pyproj import CRS, Transformer
        from pyproj.exceptions import CRSError
    try:
        crs = CRS.from_user_input(projection)
    except CRSError:
        raise BadInput(
            f"pyproj knows no projection '{projection}'; give one such as EPSG:25832"
        ) from None
    if not crs.is_projected:
        raise BadInput(
            f"projection {projection}: has no east and north in m; give a projected one: EPSG:25832"
        )
    return Transformer.from_crs("EPSG:4326", crs, always_xy=True)
