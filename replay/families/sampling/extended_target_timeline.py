"""Timeline of the extended target: true and estimated rectangles, and the measured points."""

import numpy as np
import rerun.blueprint as rrb

from fuselog.recorders.log import Stream, schemas, topics_of
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import WRONG, Board, Canvas, Scene, Timeline, beside
from fuselog.replay.timeline.drawing.events import above_events, draw_events
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    TRUE,
    Stroke,
    draw_dots,
    draw_outlines,
    plane_view,
    stroke_of,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import draw_components, draw_quality

TARGET = ("half_x_m", "half_y_m", "x_m", "y_m")
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw the plane next to plots of consistency and errors; plots of sizes are in a separate tab."""
    turn_up(canvas)
    shown = [np.empty((0, 2))]
    points = f"{ROOT}/points"
    for stream in _seen(scene):
        draw_dots(canvas, points, stream.publish_time_ns, stream["position_m"], Stroke(WRONG))
        shown.append(stream["position_m"])
    for stream in filter(_is_target, scene.truths_of("")):
        _draw_target(canvas, "truth", stream, stream["state"], TRUE)
    for estimator, stream in scene.outputs_of("", schemas.GAUSSIAN_ESTIMATE):
        if _is_target(stream):
            _draw_target(canvas, estimator, stream, stream["mean"], stroke_of(scene, estimator))
    plane = plane_view(canvas, ROOT, [], [points], np.concatenate(shown))
    colours = scene.colours("") | {"measured": WRONG}
    board = with_legend(canvas, ROOT, colours, plane)
    board = above_events(board, draw_events(canvas, scene, ""))
    sizes = [*draw_components(canvas, scene, "", legend=False).values()][:2]
    plots: dict[str, list[Board]] = {
        "errors": draw_quality(canvas, scene, "", legend=False),
        "sizes": [*sizes],
    }
    tabs = [rrb.Vertical(*views, name=name) for name, views in plots.items() if views]
    return beside(board, [rrb.Tabs(*tabs)] if tabs else [], "")


def _seen(scene: Scene) -> list[Stream]:
    found = map(scene.read, topics_of(scene.source.topics, schemas.POSITION_FIX))
    return [stream for stream in found if len(stream)]


def _is_target(stream: Stream) -> bool:
    return tuple(stream.components) == TARGET


def _draw_target(canvas: Canvas, name: str, stream: Stream, states: Floats, stroke: Stroke) -> None:
    outlines = states[:, None, 2:] + CORNERS * states[:, None, :2]
    draw_outlines(canvas, f"{ROOT}/{name}", stream.publish_time_ns, outlines, stroke)


TIMELINE = Timeline(draw)
