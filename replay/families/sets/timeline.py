"""Timeline of set-valued estimates: the sets as polygons around the truth, and their areas.

At a frame with an empty set, no set is drawn; the wrong relative bearing is listed in the events.
"""

from functools import partial

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.log import schemas
from fuselog.replay.families.sets.judging.regions import areas_of, rings_of
from fuselog.replay.families.sets.regions.feasible_sets import Pairs, exact_set, rings
from fuselog.replay.families.sets.regions.frames import Known, frames
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    TRUTH,
    Board,
    Canvas,
    Scene,
    Timeline,
    beside,
    draw_cases,
    entity_path,
    nice,
    thin,
)
from fuselog.replay.timeline.drawing.events import above_events, draw_events
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    Stroke,
    draw_dots,
    draw_points,
    draw_polygons,
    plane_view,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import draw_curve, plot_view

# Number of frames, evenly spaced in time, at which the regions of single bearings are drawn.
BEARING_FRAMES = 100
ALLOWED = (110, 110, 90)
FRAMES = partial(rr.SeriesPoints, marker_sizes=[2.5])
# Share of the sets that the map's extent contains, along each axis.
SHOWN_SHARE = 0.9
SIZE = schemas.ESTIMATE_SIZE


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw, for each robot, the plane and a list of events next to plots of the areas."""
    turn_up(canvas)
    landmarks = scene.read("/landmarks") if "/landmarks" in scene.source.topics else None
    if landmarks is not None:
        draw_points(
            canvas, f"{ROOT}/landmarks", landmarks["landmark_id"], landmarks["position_m"][:, :2]
        )
    return draw_cases(scene, partial(_draw_robot, canvas, scene))


def _draw_robot(canvas: Canvas, scene: Scene, robot: str) -> rrb.Container | rrb.View:
    root = entity_path(ROOT, robot)
    shown = [np.empty((0, 2))]
    for stream in scene.truths_of(robot):
        places = stream["state"][:, [stream.components.index(name) for name in ("x_m", "y_m")]]
        draw_dots(canvas, f"{root}/truth", stream.publish_time_ns, places, Stroke(TRUTH, 2.0))
        shown.append(places)
    reach, plots = draw_sets(canvas, scene, robot, root)
    landmarks = f"{ROOT}/landmarks"
    colours, scene_root = scene.colours(robot), entity_path(ROOT, "bearings", robot)
    allowed = _draw_allowed(canvas, scene, robot, f"{scene_root}/allowed")
    name, is_single = "Map", all(len(each) == 1 for _, each in scene.outputs_of(robot, SIZE))
    if plots and is_single:  # a plot would be a single dot
        name, plots = f"Map; {plots[0].name}", []
    places = np.concatenate([*shown, reach])
    board: Board = plane_view(canvas, root, [landmarks, *allowed], [], places, name=name)
    if allowed:
        colours |= {"allowed by one relative bearing": ALLOWED}
        sets = [entity_path(root, each) for each in ("truth", *scene.estimators_of(robot))]
        marks = scene.read("/landmarks")["position_m"][:, :2]
        around = np.concatenate([places, marks])
        whole = plane_view(canvas, scene_root, [landmarks, *sets], [], around, name="Landmarks")
        board = rrb.Horizontal(whole, board)
    board = with_legend(canvas, root, colours, board)
    board = above_events(board, draw_events(canvas, scene, robot), 4.0)
    return beside(board, plots, robot)


def _draw_allowed(canvas: Canvas, scene: Scene, robot: str, entity: str) -> list[str]:
    """Draw the positions that each single bearing and its bound allow; return the entities drawn.

    The metadata of a set's channel contains the topic of the bearings, and the bounds.
    """
    stated = [stream.metadata for _, stream in scene.outputs_of(robot, SIZE)]
    stated = [each for each in stated if {"measured", *Known._fields} <= {*each}]
    if not stated or not {stated[0]["measured"], "/landmarks"} <= {*scene.source.topics}:
        return []
    seen, marks = (scene.read(topic) for topic in (stated[0]["measured"], "/landmarks"))
    found = list(frames(seen, marks, Known.of(stated[0])))
    time_ns = np.array([frame.time_ns for frame in found], np.int64)
    counts, polygons = np.zeros(len(found), np.int64), []
    for row in thin(time_ns, BEARING_FRAMES):
        allowed = [rings(exact_set(pair, found[row].arena)) for pair in _single(found[row].pairs)]
        counts[row] = sum(map(len, allowed))
        polygons += [ring for each in allowed for ring in each]
    draw_polygons(canvas, entity, time_ns, counts, polygons, Stroke(ALLOWED, 2.0))
    return [entity] if polygons else []


def _single(pairs: Pairs) -> list[Pairs]:
    """Split a frame into frames of one relative bearing each."""
    rows = [slice(row, row + 1) for row in range(len(pairs.angle_rad))]
    return [
        Pairs(pairs.first[row], pairs.second[row], pairs.angle_rad[row], pairs.bound_rad) for row in rows
    ]


def draw_sets(
    canvas: Canvas, scene: Scene, case: str, root: str
) -> tuple[Floats, list[rrb.TimeSeriesView]]:
    """Draw the sets of a case; return a box (2, 2) around most of them, and the plot of areas."""
    plot, corners, areas = entity_path("plots", case, "area"), [], {}
    for estimator, sizes in scene.outputs_of(case, SIZE):
        topic = "/" + entity_path("estimates", estimator, case, "set")
        if topic not in scene.outputs:
            continue
        frames, colour = rings_of(sizes, scene.outputs[topic]), scene.colour(estimator)
        counts = np.array([len(rings) for rings in frames], np.int64)
        polygons = [ring for rings in frames for ring in rings]
        time_ns = sizes.publish_time_ns
        draw_polygons(canvas, f"{root}/{estimator}", time_ns, counts, polygons, Stroke(colour, 1.5))
        areas[estimator] = areas_of(frames)
        draw_curve(canvas, plot, estimator, colour, time_ns, areas[estimator], FRAMES)
        corners += [[ring.min(axis=0), ring.max(axis=0)] for ring in polygons]
    if not corners:
        return np.empty((0, 2)), []
    tail = 0.5 * (1.0 - SHOWN_SHARE)
    low, high = np.moveaxis(np.array(corners), 1, 0)
    reach = np.stack([np.quantile(low, tail, axis=0), np.quantile(high, 1.0 - tail, axis=0)])
    last = ", ".join(f"{each[-1]:.3g} for {estimator}" for estimator, each in areas.items())
    largest = max(np.max(each, initial=np.finfo(float).tiny) for each in areas.values())
    extent, note = (0.0, nice(1.2 * float(largest))), f", at the end {last}"
    if all(len(each) == 1 for each in areas.values()):
        note = f", {last}"
    return reach, [plot_view(plot, "Area of the set", "m²", extent, note=note, legend=False)]


def draw_areas(canvas: Canvas, scene: Scene, case: str) -> list[Board]:
    """Draw the sets of a case in the plane of its positions, and return the plot of their areas."""
    _, plots = draw_sets(canvas, scene, case, entity_path(ROOT, case))
    return [*plots]


TIMELINE = Timeline(draw)
