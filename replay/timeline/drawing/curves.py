"""Curves with logarithmic axes, one view per panel, because plots of Rerun support only time axes."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import MUTED, Canvas, Colour
from fuselog.replay.timeline.drawing.plane import GRID, Stroke, bounds_of, turn_up, with_legend
from fuselog.replay.timeline.sinks import open_recording

# Distance of the numbers of an axis from the edge, as a fraction of the panel.
LABEL_SHARE = 0.08


class CurvePanel(NamedTuple):
    """Curves of a view: name with axes, positive points (n, 2) by curve, and strokes by curve."""

    name: str
    curves: Mapping[str, Floats]
    strokes: Mapping[str, Stroke]


def save_curves(title: str, panels: Sequence[CurvePanel], rrd: Path) -> None:
    """Write curves with logarithmic axes as a static timeline.

    Raises BadInput if the file cannot be written.
    """
    with open_recording("fuselog-curves", title, save=rrd) as recording:
        recording.send_recording_name(title)
        canvas = Canvas(recording, 0, 0, np.zeros(1, np.int64))
        views = []
        for number, panel in enumerate(panels):
            view = curve_view(canvas, f"curves/{number}", panel)
            views.append(with_legend(canvas, str(number), _colours(panel), view))
        recording.send_blueprint(rrb.Blueprint(rrb.Grid(*views), collapse_panels=True))


def _colours(panel: CurvePanel) -> dict[str, Colour]:
    return {name: panel.strokes[name].colour for name in panel.curves}


def curve_view(canvas: Canvas, root: str, panel: CurvePanel) -> rrb.Spatial2DView:
    """Draw a panel below an entity and return its view."""
    turn_up(canvas, root)
    logs = {name: _drawn(places) for name, places in panel.curves.items()}
    places = np.concatenate(list(logs.values()))
    low, high = bounds_of(places)
    _draw_decades(canvas, f"{root}/decades", low, high)
    for name, line in logs.items():
        canvas.fix(f"{root}/{name}", rr.LineStrips2D([line], **panel.strokes[name].fields()))
    return rrb.Spatial2DView(
        origin="/",
        contents=[f"{root}/**"],
        name=panel.name,
        visual_bounds=rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1])),
    )


def _drawn(places: Floats) -> Floats:
    """Compute decimal logarithms of points (n, 2); points that are not positive are left out."""
    is_there = (np.isfinite(places) & (places > 0)).all(axis=1)
    found: Floats = np.log10(places[is_there])
    return found


def _draw_decades(canvas: Canvas, entity: str, low: Floats, high: Floats) -> None:
    """Draw lines at 1, 2 and 5 times the powers of ten, with numbers near their lower or left end.

    Over more than two decades, only the powers are drawn.
    """
    lines, at, labels = [], [], []
    inside = low + LABEL_SHARE * (high - low)
    steps = (1, 2, 5) if float(np.max(high - low)) <= 2.0 else (1,)
    for axis, power, step in product(range(2), range(-30, 31), steps):
        place = power + np.log10(step)
        if inside[axis] <= place <= high[axis]:
            ends = np.stack([low, high])
            ends[:, axis] = place
            lines.append(ends)
            at.append(np.where(np.arange(2) == axis, place, inside))
            labels.append(f"{step * 10.0**power:g}")
    strips = rr.LineStrips2D(lines, colors=[GRID], radii=rr.Radius.ui_points(0.5), draw_order=-1.0)
    canvas.fix(entity, strips)
    numbers = rr.Points2D(at, labels=labels, colors=[MUTED], radii=rr.Radius.ui_points(1.0))
    canvas.fix(f"{entity}/numbers", numbers)
