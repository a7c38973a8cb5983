"""Maps of the earth with points by latitude and longitude.

The tiles of the map are loaded from the network; offline, the points are still drawn at their positions.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from fuselog.recorders.log import Stream
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import Canvas, Colour, escaped, thin
from fuselog.replay.timeline.drawing.plane import TRAIL_S, trail_of

# Colours of fixes up to these standard deviations in m: ambiguity fixed, ambiguity float, code only.
QUALITIES: tuple[tuple[float, Colour], ...] = (
    (0.05, (180, 255, 120)),
    (0.5, (130, 190, 85)),
    (5.0, (90, 135, 60)),
)
POOR: Colour = (120, 95, 60)
SHOWN_SHARE = 0.9
# Positions beyond this multiple of the displayed extent are far off.
FAR = 10.0
# Approximate width of the map and width of its tiles.
MAP_PIXELS, TILE_PIXELS = 700.0, 256.0


def degrees_of(stream: Stream) -> Floats:
    """Return latitude and longitude (n, 2) in deg of geodetic fixes."""
    return np.stack([stream["latitude_deg"], stream["longitude_deg"]], axis=1)


def draw_fixes(canvas: Canvas, entity: str, stream: Stream, colour: Colour) -> None:
    """Draw geodetic fixes as points connected by a thin line, omitting positions that are far off.

    Points are coloured by the stated standard deviation of the fixes, or with `colour` if no deviation
    is stated.
    """
    degrees = degrees_of(stream)
    rows = np.flatnonzero(are_near(degrees))
    rows = rows[thin(stream.publish_time_ns[rows])]
    colours = by_deviation(stream["covariance_m2"][rows], colour)
    packed = colours.astype(np.uint32) @ np.array([1 << 24, 1 << 16, 1 << 8], np.uint32) + 255
    points = rr.GeoPoints.columns(positions=degrees[rows], colors=packed)
    canvas.send(entity, stream.publish_time_ns[rows], points)
    canvas.fix(entity, rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(4.0)))
    draw_way(canvas, f"{entity}/way", degrees[rows], colour)


def draw_way(canvas: Canvas, entity: str, degrees: Floats, colour: Colour) -> None:
    """Draw a whole path as a thin line.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        degrees: latitude and longitude of the path in deg, (n, 2).
        colour: colour of the line.
    """
    way = rr.GeoLineStrings(lat_lon=[degrees], colors=[(*colour, 120)], radii=rr.Radius.ui_points(1.0))
    canvas.fix(entity, way)


def by_deviation(covariance_m2: Floats, unknown: Colour) -> NDArray[np.uint8]:
    """Return colours (n, 3) of fixes by their mean standard deviation.

    Args:
        covariance_m2: (n, d * d), row-major; d is 0 if fixes have no covariance.
        unknown: colour of fixes whose deviation is NaN.
    """
    size = round(covariance_m2.shape[1] ** 0.5)
    sigma_m = np.full(len(covariance_m2), np.nan)
    if size:  # fixes may have no covariance
        sigma_m = np.sqrt(covariance_m2[:, :: size + 1].mean(axis=1))
    limits = [limit for limit, _ in QUALITIES]
    colours = np.array([*(colour for _, colour in QUALITIES), POOR, unknown], np.uint8)
    # NaN sorts after all numbers
    return colours[np.searchsorted([*limits, np.inf], sigma_m)]


def map_view(
    canvas: Canvas, root: str, degrees: Floats, paths: Sequence[str] = (), trail_s: float = TRAIL_S
) -> rrb.MapView:
    """Make a map that shows at least the positions that are not far off.

    Args:
        canvas: the canvas.
        root: entity to show.
        degrees: latitude and longitude of positions in deg, (n, 2).
        paths: entities to show up to `trail_s` before the cursor.
        trail_s: length of these trails in s.
    """
    near = are_near(degrees)
    left_out = "" if near.all() or canvas.is_shared else f", without {(~near).sum()} distant points"
    trail = trail_of(canvas, trail_s)
    return rrb.MapView(
        origin=escaped(root),
        name=f"OpenStreetMap{left_out}",
        zoom=_zoom(degrees[near]),
        overrides={escaped(path): [trail] for path in paths},
    )


def usual(places: Floats) -> Floats:
    """Compute corners (2, d) of a box around most positions, so that outliers do not shrink the view."""
    tail = 0.5 * (1.0 - SHOWN_SHARE)
    return np.nanquantile(places, [tail, 1.0 - tail], axis=0)


def are_near(places: Floats) -> NDArray[np.bool_]:
    """Find the positions that are not outliers; outliers would shift the centre of a map's view."""
    low, high = usual(places)
    margin = FAR * (high - low).max()
    return ((places >= low - margin) & (places <= high + margin)).all(axis=1)


def _zoom(degrees: Floats) -> float:
    """Compute the zoom at which all positions fill the map; at zoom z the world is 2^z tiles wide."""
    low, high = degrees.min(axis=0), degrees.max(axis=0)
    latitude = np.radians(0.5 * (low[0] + high[0]))
    width = max(high[1] - low[1], (high[0] - low[0]) / max(np.cos(latitude), 0.1), 1e-3)
    return float(np.clip(np.log2(360.0 / width * MAP_PIXELS / TILE_PIXELS), 1.0, 19.0))
