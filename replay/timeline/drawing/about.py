"""Drawings of measurements around a sensor, in its own frame with the x axis to the right.

Ranges are circles, bearings and lines of sight are rays from the origin, and detections are points.
"""

from collections.abc import Callable

import numpy as np
import rerun.blueprint as rrb

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import PALETTE, Canvas
from fuselog.replay.timeline.drawing.plane import draw_lines, draw_scans, plane_view

# Length of a ray without a range, and number of vertices of a circle.
RAY_M = 1.0
CORNERS = 49


def draw_about(canvas: Canvas, root: str, stream: Stream) -> list[rrb.Spatial2DView]:
    """Draw measurements around a sensor, if they have positions in the plane; return the view."""
    if stream.schema.full_name == schemas.DETECTION.full_name:
        seen = stream["position_m"][:, :2]
        if seen.shape[1] == 2:
            draw_scans(canvas, f"{root}/detections", stream.publish_time_ns, seen, PALETTE[0], 3.0)
    elif stream.schema.full_name in _SHAPES:
        shapes = _SHAPES[stream.schema.full_name](stream)
        good = np.isfinite(shapes).all(axis=(1, 2))
        colours = np.array([(*colour, 255) for colour in PALETTE], np.uint8)
        of_target = colours[stream["target_id"] % len(PALETTE)]
        draw_lines(canvas, f"{root}/seen", stream.publish_time_ns[good], shapes[good], of_target[good])
        seen = shapes[good].reshape(-1, 2)
    else:
        return []
    if seen.size == 0:
        return []
    places = np.concatenate([seen, np.zeros((1, 2))])
    return [plane_view(canvas, root, [], [], places, name="About the sensor")]


def _circles(stream: Stream) -> Floats:
    """Return the circles (n, corners, 2) of possible target positions at the measured ranges."""
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return stream["range_m"][:, None, None] * around


def _rays(angle_rad: Floats, length_m: Floats | float) -> Floats:
    """Return lines (n, 2, 2) from the sensor at these angles (n,)."""
    ends = np.stack([length_m * np.cos(angle_rad), length_m * np.sin(angle_rad)], axis=1)
    return np.stack([np.zeros_like(ends), ends], axis=1)


_SHAPES: dict[str, Callable[[Stream], Floats]] = {
    schemas.RANGE.full_name: _circles,
    schemas.BEARING.full_name: lambda seen: _rays(seen["bearing_rad"], RAY_M),
    schemas.RANGE_BEARING.full_name: lambda seen: _rays(seen["bearing_rad"], seen["range_m"]),
    schemas.LINE_OF_SIGHT.full_name: lambda seen: _rays(
        seen["azimuth_rad"], RAY_M * np.cos(seen["elevation_rad"])
    ),
}
