"""Scene of a log that belongs to no family: all topics, by schema.

Positions are drawn in a plane for each frame of the log and on a map of the earth: truths, estimates,
fixes, poses, and landmarks with their measurements. The measurements of a sensor are drawn around the
sensor, and each quantity is plotted. If there are estimates, their errors, NEES and NIS are shown next
to these views.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle

import numpy as np
import rerun.blueprint as rrb

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Field, Stream, schemas
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.replay.engine.streams.geodetic import stated_origin
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    PALETTE,
    Board,
    Canvas,
    Colour,
    Scene,
    Timeline,
    beside,
    draw_cases,
    entity_path,
    thin,
)
from fuselog.replay.timeline.drawing.events import (
    NOT_SENSED,
    above_events,
    draw_events,
    draw_registered,
    within,
)
from fuselog.replay.timeline.drawing.geodetic import degrees_of, draw_fixes, draw_way, map_view
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    Stroke,
    draw_clouds,
    draw_dots,
    draw_lines,
    draw_path,
    draw_points,
    draw_poses,
    draw_scans,
    draw_triads,
    extent_of,
    plane_view,
    space_view,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import (
    POINTS,
    below_legend,
    draw_components,
    draw_curve,
    draw_modes,
    draw_quality,
    in_strips,
    plot_view,
    shown_unit,
)
from fuselog.replay.timeline.drawing.thinning import KEPT_ROWS, curves_of
from fuselog.replay.timeline.landmarks import (
    ARROW_SHARE,
    draw_sights,
    draw_track,
    landmarks_of,
    tracks_of,
)
from fuselog.replay.timeline.navigation import ANGLES, draw_navigation, euler_deg

FIXES = frozenset(schema.full_name for schema in (schemas.POSITION_FIX, schemas.COURSE_FIX))
LANDMARK, POSE = schemas.LANDMARK.full_name, schemas.POSE.full_name
GEODETIC, ORIENTATION = schemas.GEODETIC_FIX.full_name, schemas.ORIENTATION.full_name

# Length of a ray without a range, and number of vertices of a circle.
RAY_M = 1.0
CORNERS = 49


def draw(canvas: Canvas, scene: Scene) -> Board:
    """Draw planes, maps, plots and events for each case.

    Raises BadInput if there is nothing to draw.
    """
    topics = {topic for case in scene.cases for topic in scene.topics_near(case)}
    if not scene.outputs and not any(scene.source.topics[topic].messages for topic in topics):
        held = ", ".join(f"{each.name} ({each.encoding})" for each in scene.source.topics.values())
        raise BadInput(
            f"{scene.source.name}: there is nothing to draw, because it has no protobuf messages with "
            f"numeric fields; its topics are {held or 'none'}"
        )
    turn_up(canvas)
    return draw_cases(scene, partial(_draw_case, canvas, scene))


def _draw_case(canvas: Canvas, scene: Scene, case: str) -> Board:
    sensed = [scene.read(topic) for topic in scene.topics_near(case)]
    sensed = [stream for stream in sensed if len(stream)]
    earth = [each for each in sensed if each.schema.full_name == GEODETIC]
    in_space: list[Board] = [
        *draw_navigation(canvas, scene, case, sensed),
        *draw_registered(canvas, scene, case, sensed),
    ]
    places: list[Board] = [
        *in_space,
        *_draw_planes(canvas, scene, case, sensed),
        *_draw_earth(canvas, scene, case, earth),
    ]
    turned = [each for each in sensed if each.schema.full_name == ORIENTATION]
    boards: list[Board] = [*_draw_space(canvas, case, turned), *_draw_sensors(canvas, case, sensed)]
    components = draw_components(canvas, scene, case)
    state: list[Board] = [in_strips(components, "state")] if components else []
    # estimates are shown first, on a map if they have a position
    is_estimated = bool(scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE))
    is_placed = bool(in_space) or any(each.name != "truth" for each in tracks_of(scene, case))
    first = is_estimated and not is_placed
    boards = [*state, *places, *boards] if first else [*places, *boards, *state]
    modes = draw_modes(canvas, scene, case)
    if modes:
        boards.append(rrb.Vertical(*modes, name="modes"))
    events = draw_events(canvas, scene, case, _not_drawn(sensed))
    board = above_events(rrb.Tabs(*boards), events, 4.0)
    return beside(board, draw_quality(canvas, scene, case, legend=not is_placed), case)


def _not_drawn(sensed: list[Stream]) -> dict[str, str]:
    shown_elsewhere = NOT_SENSED - {schemas.LINK_EVENT.full_name}
    return {
        stream.topic: "it has no field that can be plotted over time"
        for stream in sensed
        if stream.schema.full_name not in shown_elsewhere and not list(curves_of(stream))
    }


def _draw_planes(canvas: Canvas, scene: Scene, case: str, sensed: list[Stream]) -> list[rrb.Container]:
    """Draw all positions in views side by side, one per frame; return no panel without positions."""
    by_frame: dict[str, list[Stream]] = {"": []}
    for stream in sensed:
        if stream.schema.full_name in {*FIXES, LANDMARK} and stream["position_m"].shape[1] >= 2:
            by_frame[""].append(stream)
        elif stream.schema.full_name == POSE and np.ptp(stream["position_m"][:, :2], axis=0).any():
            by_frame.setdefault(stream.metadata.get("frame_id", ""), []).append(stream)
    views = [
        view
        for frame, streams in by_frame.items()
        for view in _draw_plane(canvas, scene, case, frame, streams)
    ]
    return [rrb.Horizontal(*views, name="map")] if views else []


def _draw_plane(
    canvas: Canvas, scene: Scene, case: str, frame: str, sensed: list[Stream]
) -> list[Board]:
    """Draw the positions in one frame; truths and estimates are in the frame of the log, named ""."""
    root, shown, paths = entity_path(ROOT, case), [], []
    named: dict[str, Colour] = {}
    if frame:
        root = entity_path("frames", frame, case)
        turn_up(canvas, root)
    else:
        tracks = tracks_of(scene, case)
        for track in tracks:
            shown.append(track.poses[:, :2])
            paths.append(draw_track(canvas, root, track, extent_of(shown[-1])))
        draw_clouds(canvas, scene, case, root)
        named = {track.name: track.stroke.colour for track in tracks}
        named |= draw_sights(canvas, scene, case, tracks, landmarks_of(scene))
    for stream, colour in zip(sensed, scene.spare_colours, strict=False):
        entity, stroke = f"{root}/{within(stream.topic, case)}", Stroke(colour)
        if stream.schema.full_name != LANDMARK:  # landmarks have numbers instead
            named[within(stream.topic, case)] = colour
        rows = thin(stream.publish_time_ns)
        time_ns, places = stream.publish_time_ns[rows], stream["position_m"][rows, :2]
        if stream.schema.full_name == LANDMARK:
            places = stream["position_m"][:, :2]
            draw_points(canvas, entity, stream["landmark_id"], places)
        elif stream.schema.full_name == POSE:
            yaw = euler_deg(stream["quaternion"][rows])[:, 2:]
            poses = np.concatenate([places, np.radians(yaw)], axis=1)
            known = np.isfinite(poses).all(axis=1)
            length_m = ARROW_SHARE * extent_of(places)
            draw_path(canvas, f"{entity}/path", time_ns, places, stroke)
            draw_poses(canvas, f"{entity}/pose", time_ns[known], poses[known], stroke, length_m)
            paths.append(f"{entity}/path")
        else:
            draw_dots(canvas, entity, time_ns, places, stroke)
            paths.append(entity)
        shown.append(places)
    if not shown:
        return []
    name = f"Frame {frame}" if frame else "Map"
    view = plane_view(canvas, root, [], paths, np.concatenate(shown), name=name)
    return [with_legend(canvas, root, named, view)]


def _draw_earth(canvas: Canvas, scene: Scene, case: str, fixes: Sequence[Stream]) -> list[rrb.MapView]:
    """Draw geodetic fixes on a map of the earth, with paths of estimates if an origin is stated."""
    root = entity_path("geodetic", case)
    origin = stated_origin({each.topic: scene.source.topics[each.topic] for each in fixes[:1]})
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        if origin is not None and {"x_m", "y_m"} <= set(stream.components):
            east, north = (stream["mean"][:, stream.components.index(name)] for name in ("x_m", "y_m"))
            latitude, longitude, _ = out_of_tangent_plane((east, north), origin)
            way = np.stack([latitude, longitude], axis=1)[thin(stream.publish_time_ns)]
            known = way[np.isfinite(way).all(axis=1)]
            draw_way(canvas, f"{root}/{estimator}", known, scene.colour(estimator))
    for stream, colour in zip(fixes, cycle(PALETTE), strict=False):
        draw_fixes(canvas, f"{root}/{within(stream.topic, case)}", stream, colour)
    degrees = [degrees_of(stream) for stream in fixes]
    return [map_view(canvas, root, np.concatenate(degrees))] if fixes else []


def _draw_space(canvas: Canvas, case: str, sensed: Sequence[Stream]) -> list[rrb.Spatial3DView]:
    """Draw orientations as triads around one origin."""
    root = entity_path("space", case)
    for stream, colour in zip(sensed, cycle(PALETTE), strict=False):
        rows = thin(stream.publish_time_ns)
        rows = rows[np.isfinite(stream["quaternion"][rows]).all(axis=1)]
        turned = (stream.publish_time_ns[rows], stream["quaternion"][rows])
        draw_triads(canvas, f"{root}/{within(stream.topic, case)}", *turned, [colour] * 3, 1.0, 0.02)
    return [space_view(root, "Orientation")] if sensed else []


def _draw_sensors(canvas: Canvas, case: str, sensed: list[Stream]) -> Iterator[rrb.Container]:
    """Draw measurements at the position of their sensor, and plot their values except covariances."""
    for stream in sensed:
        if stream.schema.full_name in NOT_SENSED:
            continue
        name = within(stream.topic, case)
        plots = {
            field.name: _draw_field(canvas, case, stream, field, curves)
            for field, curves in curves_of(stream)
        }
        about = draw_about(canvas, entity_path("about", case, name), stream)
        if about:
            turn_up(canvas, entity_path("about", case, name))
        columns: list[Board] = [*about, *([in_strips(plots, name)] if plots else [])]
        if columns:
            yield rrb.Horizontal(*columns, name=name)


def _draw_field(
    canvas: Canvas, case: str, stream: Stream, field: Field, curves: Floats
) -> rrb.TimeSeriesView:
    """Plot the curves (curves, n) of a field; rotations are shown as angles."""
    quantity, unit, scale = shown_unit(field.name)
    plot = entity_path("plots", case, within(stream.topic, case), field.name)
    named: Sequence[str] = [str(element) for element in range(len(curves))]
    if field.kind == "real":
        named = [field.name]
    elif field.name == "quaternion":
        quantity, unit, named, curves = "orientation", "deg", ANGLES, euler_deg(curves.T).T
    elif len(stream.components) == len(curves):
        named = stream.components
    for curve, values, colour in zip(named, scale * curves, cycle(PALETTE), strict=False):
        draw_curve(canvas, plot, curve, colour, stream.publish_time_ns, values, POINTS, most=KEPT_ROWS)
    is_legend = len(curves) > 1
    extent = below_legend(list(scale * curves)) if is_legend else None
    return plot_view(plot, quantity.capitalize(), unit, extent, legend=is_legend, zoom_lock=False)


TIMELINE = Timeline(draw)


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
