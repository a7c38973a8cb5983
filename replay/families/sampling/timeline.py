"""Timeline of sample sets: the points of each sampling in the plane, with the 95 % circle."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.timeline.drawing.canvas import MUTED, WRONG, Canvas, Scene, Timeline
from fuselog.replay.timeline.drawing.plane import ROOT, Stroke, plane_view, turn_up

PIXELS = 14.0  # radius of a sample with weight 1


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw a view for each set; the area of a point shows its weight, and negative weights are red."""
    turn_up(canvas)
    views = [
        _draw_set(canvas, scene, name, stream)
        for name, stream in scene.outputs_of("", schemas.DENSITY_ESTIMATE)
    ]
    return rrb.Grid(*views)


def _draw_set(canvas: Canvas, scene: Scene, name: str, stream: Stream) -> rrb.Spatial2DView:
    root, places, weight = f"{ROOT}/{name}", stream["mean"][:, :2], stream["weight"]
    circle = ellipses(np.zeros((1, 2)), np.eye(2)[None])
    canvas.fix(f"{root}/circle", rr.LineStrips2D([circle[0]], **Stroke(MUTED).fields()))
    colours = np.where(weight[:, None] < 0, WRONG, scene.colour(name))
    radii = rr.Radius.ui_points(PIXELS * np.sqrt(np.abs(weight)))
    canvas.fix(f"{root}/samples", rr.Points2D(places, colors=colours, radii=radii))
    view = plane_view(canvas, root, [], [], circle[0])
    view.name = f"{name}, {len(places)} samples"
    return view


TIMELINE = Timeline(draw)
