"""The timeline of a log that no family draws: all that it holds, by schema.

Places are on a plane: truths, estimates, fixes, landmarks. What sensors measure is a plot for each
number, and beside it are errors, NEES and NIS, where there are estimates.
"""

from collections.abc import Iterator
from functools import partial
from itertools import count

import numpy as np
import rerun.blueprint as rrb

from recorders.errors import BadInput
from recorders.log import Stream, schemas
from replay.judging.evaluation import Floats
from replay.timeline.canvas import (
    PALETTE,
    TRUTH,
    Canvas,
    Scene,
    Timeline,
    beside,
    draw_cases,
    entity_path,
    thin,
)
from replay.timeline.events import NOT_SENSED, draw_events
from replay.timeline.plane import (
    ROOT,
    Stroke,
    draw_clouds,
    draw_dots,
    draw_path,
    draw_points,
    draw_poses,
    extent_of,
    plane_view,
    turn_up,
)
from replay.timeline.plots import (
    POINTS,
    draw_components,
    draw_curve,
    draw_modes,
    draw_quality,
    plot_view,
    shown_unit,
)

FIXES = frozenset(schema.full_name for schema in (schemas.POSITION_FIX, schemas.COURSE_FIX))
LANDMARK = schemas.LANDMARK.full_name


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """A plane, plots and events for each case.

    Raises BadInput where there is nothing to draw.
    """
    topics = {topic for case in scene.cases for topic in scene.topics_near(case)}
    if not scene.outputs and not any(scene.source.topics[topic].messages for topic in topics):
        held = ", ".join(f"{each.name} ({each.encoding})" for each in scene.source.topics.values())
        raise BadInput(
            f"{scene.source.name}: nothing to draw: no protobuf messages with numeric fields; it holds "
            f"{held or 'no topics'}"
        )
    turn_up(canvas)
    return draw_cases(scene, partial(_draw_case, canvas, scene))


def _draw_case(canvas: Canvas, scene: Scene, case: str) -> rrb.Container | rrb.View:
    sensed = [scene.read(topic) for topic in scene.topics_near(case)]
    sensed = [stream for stream in sensed if len(stream)]
    boards: list[rrb.Container | rrb.View] = [
        *_draw_plane(canvas, scene, case, sensed),
        *(_titled(name, views) for name, views in _draw_sensors(canvas, case, sensed)),
    ]
    components = draw_components(canvas, scene, case)
    if components:
        boards.append(_titled("state", components))
    modes = draw_modes(canvas, scene, case)
    if modes:
        boards.append(_titled("modes", modes))
    events = draw_events(canvas, scene, case)
    board = rrb.Vertical(rrb.Tabs(*boards), events, row_shares=[4, 1])
    return beside(board if boards else rrb.Vertical(events), draw_quality(canvas, scene, case), case)


def _titled(name: str, views: list[rrb.TimeSeriesView]) -> rrb.Container:
    return rrb.Vertical(*views, name=name)


def _draw_plane(
    canvas: Canvas, scene: Scene, case: str, sensed: list[Stream]
) -> list[rrb.Spatial2DView]:
    """Everything that has a place: no view where nothing has."""
    root = entity_path(ROOT, case)
    tracks = [("truth", Stroke(TRUTH, 2.0), stream, "state") for stream in scene.truths_of(case)]
    for name, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        tracks.append((name, Stroke(scene.colour(name)), stream, "mean"))
    draw_clouds(canvas, scene, case, root)
    shown: list[Floats] = []
    paths: list[str] = []
    for name, stroke, stream, field in tracks:
        poses = _poses(stream, stream[field])
        rows = thin(stream.publish_time_ns)
        rows = rows[np.isfinite(poses[rows, :2]).all(axis=1)]
        if len(rows) == 0:
            continue
        entity, time_ns = f"{root}/{name}", stream.publish_time_ns[rows]
        draw_path(canvas, f"{entity}/path", time_ns, poses[rows, :2], stroke)
        if np.isfinite(poses[rows]).all():
            length_m = 0.04 * extent_of(poses[rows, :2])
            draw_poses(canvas, f"{entity}/pose", time_ns, poses[rows], stroke, length_m)
        paths.append(f"{entity}/path")
        shown.append(poses[rows, :2])
    for number, stream in enumerate(sensed):
        if stream.schema.full_name not in {*FIXES, LANDMARK} or stream["position_m"].shape[1] < 2:
            continue
        places, entity = stream["position_m"][:, :2], f"{root}/{_name(stream, case)}"
        if stream.schema.full_name == LANDMARK:
            draw_points(canvas, entity, stream["landmark_id"], places)
        else:
            rows = thin(stream.publish_time_ns)
            stroke = Stroke(PALETTE[number % len(PALETTE)])
            draw_dots(canvas, entity, stream.publish_time_ns[rows], places[rows], stroke)
        shown.append(places)
    return [plane_view(canvas, root, [], paths, np.concatenate(shown))] if shown else []


def _poses(stream: Stream, states: Floats) -> Floats:
    """Position and heading (n, 3), NaN where the stream has no such component."""
    poses = np.full((len(stream), 3), np.nan)
    for column, name in enumerate(("x_m", "y_m", "heading_rad")):
        if name in stream.components:
            poses[:, column] = states[:, stream.components.index(name)]
    return poses


def _draw_sensors(
    canvas: Canvas, case: str, sensed: list[Stream]
) -> Iterator[tuple[str, list[rrb.TimeSeriesView]]]:
    """A plot for each real field and each vector of a sensor, unless wide or a covariance."""
    for stream in sensed:
        name = _name(stream, case)
        views = []
        for field in stream.schema:
            is_plotted = field.kind == "real" or (
                field.kind == "vector"
                and not field.name.startswith("covariance")
                and stream[field.name].shape[1] <= len(PALETTE)
            )
            if stream.schema.full_name in NOT_SENSED or not is_plotted:
                continue
            quantity, unit, scale = shown_unit(field.name)
            plot = entity_path("plots", case, name, field.name)
            columns = scale * stream[field.name].reshape(len(stream), -1).T
            named = stream.components if len(stream.components) == len(columns) else count()
            for element, values, colour in zip(named, columns, PALETTE, strict=False):
                curve = str(element) if field.kind == "vector" else field.name
                draw_curve(canvas, plot, curve, colour, stream.publish_time_ns, values, POINTS)
            views.append(plot_view(plot, f"{quantity.capitalize()} ({unit})", legend=len(columns) > 1))
        if views:
            yield name, views


def _name(stream: Stream, case: str) -> str:
    """A topic as it is called within its case."""
    return stream.topic.removeprefix(f"/{case}").removeprefix("/")


TIMELINE = Timeline(draw)
