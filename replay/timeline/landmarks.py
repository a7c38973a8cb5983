"""Scene of robots: for each robot, a map with landmarks, and its errors, NEES, NIS and events."""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd
import rerun.blueprint as rrb

from fuselog.recorders.log import Stream, schemas, topics_of
from fuselog.replay.engine.streams.measurements import PLANE, covariances_of
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    WRONG,
    Canvas,
    Colour,
    Scene,
    Timeline,
    Times,
    beside,
    draw_cases,
    entity_path,
    thin,
)
from fuselog.replay.timeline.drawing.events import above_events, draw_events, draw_registered
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    TRUE,
    Stroke,
    draw_clouds,
    draw_dots,
    draw_ellipses,
    draw_lines,
    draw_outlines,
    draw_path,
    draw_points,
    draw_poses,
    draw_way,
    extent_of,
    plane_view,
    stroke_of,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import draw_quality

HEADING = "heading_rad"
# Length of an arrow as a fraction of the scene.
ARROW_SHARE = 0.04
# A single position is a dot; its width is this multiple of the width of a path.
SINGLE = 1.5
# Schemas of measurements of landmarks, and the field with the number of the landmark.
SIGHTINGS = {
    schemas.RANGE_BEARING.full_name: "target_id",
    schemas.RANGE.full_name: "target_id",
    schemas.BEARING.full_name: "target_id",
    schemas.ANCHOR_RANGE.full_name: "anchor_id",
}
SEEN = (170, 170, 90, 140)
GATED = (*WRONG, 255)
# Parameters of the field of view of a sensor; number of vertices and colour of its drawing.
VIEW, CORNERS, SEEN_UP_TO = ("maximum_range_m", "field_of_view_deg"), 49, (110, 110, 90)
# Largest number of drawn fields of view.
VIEWS = 500
# A measurement is drawn from a pose only if the pose is not older than this.
FRESH_NS = 500_000_000


class Track(NamedTuple):
    """Poses (n, 3) of a robot (x, y, heading) from the truth or an estimator.

    A heading that is not stated is NaN.
    """

    name: str
    stroke: Stroke
    time_ns: Times
    poses: Floats
    covariances: Floats | None


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw a map and plots for each robot, and return the layout."""
    landmarks = landmarks_of(scene)
    turn_up(canvas)
    draw_points(canvas, f"{ROOT}/landmarks", landmarks.index.to_numpy(), landmarks.to_numpy())
    return draw_cases(scene, partial(_draw_robot, canvas, scene, landmarks))


def landmarks_of(scene: Scene) -> pd.DataFrame:
    """Return the positions (n, 2) of landmarks by number; empty if the log has no map."""
    maps = topics_of(scene.source.topics, schemas.LANDMARK)
    stream = scene.read("/landmarks" if "/landmarks" in maps else maps[0]) if maps else None
    if stream is None or not len(stream):
        return pd.DataFrame(np.empty((0, 2)), index=np.empty(0, np.int64))
    places = stream["position_m"].reshape(len(stream), -1)[:, :2]
    numbered = pd.DataFrame(places, index=stream["landmark_id"].astype(np.int64))
    return numbered[~numbered.index.duplicated()]


def _draw_robot(
    canvas: Canvas, scene: Scene, landmarks: pd.DataFrame, robot: str
) -> rrb.Container | rrb.View:
    root = entity_path(ROOT, robot)
    tracks = tracks_of(scene, robot)
    shown = np.concatenate([landmarks.to_numpy(), *(each.poses[:, :2] for each in tracks[:1])])
    paths = [draw_track(canvas, root, track, extent_of(shown)) for track in tracks]
    draw_clouds(canvas, scene, robot, root)
    sights = draw_sights(canvas, scene, robot, tracks, landmarks)
    sights |= _draw_view(canvas, scene, robot, tracks)
    areas = draw_registered(canvas, scene, robot, scene.outputs.values())
    plane = plane_view(canvas, root, [f"{ROOT}/landmarks"], paths, shown)
    board = with_legend(canvas, root, scene.colours(robot) | sights, plane)
    board = above_events(board, draw_events(canvas, scene, robot))
    return beside(board, [*draw_quality(canvas, scene, robot, legend=False), *areas], robot)


def tracks_of(scene: Scene, robot: str) -> list[Track]:
    """Return the truth and every estimate with a position of the robot, thinned for drawing."""
    found = [("truth", TRUE, each, each["state"]) for each in scene.truths_of(robot)]
    for estimator, stream in scene.outputs_of(robot, schemas.GAUSSIAN_ESTIMATE):
        found.append((estimator, stroke_of(scene, estimator), stream, stream["mean"]))
    tracks = [_track(*each) for each in found if set(PLANE) <= set(each[2].components)]
    return [track for track in tracks if len(track.time_ns)]


def _track(name: str, stroke: Stroke, stream: Stream, states: Floats) -> Track:
    rows = thin(stream.publish_time_ns)
    columns = [stream.components.index(component) for component in PLANE]
    rows = rows[np.isfinite(states[rows][:, columns]).all(axis=1)]
    poses = np.full((len(rows), 3), np.nan)
    poses[:, :2] = states[rows][:, columns]
    if HEADING in stream.components:
        poses[:, 2] = states[rows, stream.components.index(HEADING)]
    covariances = None
    if "covariance" in stream.columns:
        covariances = covariances_of(stream.take(rows), PLANE)
    return Track(name, stroke, stream.publish_time_ns[rows], poses, covariances)


def draw_track(canvas: Canvas, root: str, track: Track, extent_m: float) -> str:
    """Draw path, arrows and ellipses of a robot in a scene of this extent; return the path entity."""
    entity = f"{root}/{track.name}"
    if track.name == "truth":
        draw_way(canvas, f"{entity}/whole", track.poses[:, :2])
    if len(track.time_ns) == 1:  # a single position has no path
        stroke = Stroke(track.stroke.colour, SINGLE * track.stroke.radius_px)
        draw_dots(canvas, f"{entity}/place", track.time_ns, track.poses[:, :2], stroke)
    draw_path(canvas, f"{entity}/path", track.time_ns, track.poses[:, :2], track.stroke)
    if np.isfinite(track.poses).all():
        length_m = ARROW_SHARE * extent_m
        draw_poses(canvas, f"{entity}/pose", track.time_ns, track.poses, track.stroke, length_m)
    if track.covariances is not None:
        outline = (track.time_ns, track.poses[:, :2], track.covariances, track.stroke)
        draw_ellipses(canvas, f"{entity}/ellipse", *outline)
    return f"{entity}/path"


def draw_sights(
    canvas: Canvas, scene: Scene, robot: str, tracks: list[Track], landmarks: pd.DataFrame
) -> dict[str, Colour]:
    """Draw lines from the robot to measured landmarks, red if rejected; return the colours by name."""
    sensors = [
        scene.read(topic)
        for topic in scene.topics_near(robot)
        if scene.source.topics[topic].schema_name in SIGHTINGS
    ]
    seen = _pairs((each, SIGHTINGS[each.schema.full_name]) for each in sensors)
    seen = seen[seen.get_level_values(1).isin(landmarks.index)]
    judged = [stream for _, stream in scene.outputs_of(robot, schemas.INNOVATION)]
    gated = seen.isin(_pairs((each.take(each["accepted"] == 0), "target_id") for each in judged))
    time_ns = seen.get_level_values(0).to_numpy()
    ends = landmarks.loc[seen.get_level_values(1)].to_numpy()
    lines = np.stack([_places_at(tracks, time_ns), ends], axis=1)
    known = np.isfinite(lines).all(axis=(1, 2))
    colours = np.where(gated[:, None], GATED, SEEN).astype(np.uint8)
    draw_lines(canvas, entity_path(ROOT, robot, "sights"), time_ns[known], lines[known], colours[known])
    named = {"measured": (SEEN, known & ~gated), "rejected": (GATED, known & gated)}
    return {name: colour[:3] for name, (colour, rows) in named.items() if rows.any()}


def _draw_view(canvas: Canvas, scene: Scene, robot: str, tracks: list[Track]) -> dict[str, Colour]:
    """Draw the field of view of a sensor if the run's parameters state it; return colours by name."""
    run, truths = scene.source.run, [track for track in tracks if track.name == "truth"]
    for topic in scene.topics_near(robot):
        sensor = topic.rpartition("/")[2]
        stated = run.parameters.get(sensor) if run else None
        is_seeing = scene.source.topics[topic].schema_name in SIGHTINGS and truths
        if is_seeing and isinstance(stated, Mapping) and {*VIEW} <= {*stated}:
            reach_m, opening_deg = (float(stated[name]) for name in VIEW)
            [truth] = truths
            rows = thin(truth.time_ns, VIEWS)
            poses = truth.poses[rows]
            angle = poses[:, 2:] + np.radians(opening_deg) * np.linspace(-0.5, 0.5, CORNERS)
            place = poses[:, None, :2]
            rim = place + reach_m * np.stack([np.cos(angle), np.sin(angle)], axis=2)
            outlines = rim if opening_deg == 360.0 else np.concatenate([place, rim, place], axis=1)
            root = entity_path(ROOT, robot, "field of view")
            draw_outlines(canvas, root, truth.time_ns[rows], outlines, Stroke(SEEN_UP_TO, 0.5))
            return {"field of view": SEEN_UP_TO}
    return {}


def _pairs(streams: Iterable[tuple[Stream, str]]) -> pd.MultiIndex:
    """Return sorted, distinct (time, target) pairs of streams, each given with its field of targets."""
    times, targets = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for stream, field in streams:
        times.append(stream.publish_time_ns)
        targets.append(stream[field].astype(np.int64))
    pairs = [np.concatenate(times), np.concatenate(targets)]
    return pd.MultiIndex.from_arrays(pairs).unique().sort_values()


def _places_at(tracks: list[Track], time_ns: Times) -> Floats:
    """Interpolate the positions (n, 2) of a robot from the truth, otherwise from a recent estimate."""
    places = np.full((len(time_ns), 2), np.nan)
    for track in tracks:
        row = np.searchsorted(track.time_ns, time_ns, side="right") - 1
        fresh = (row >= 0) & (time_ns - track.time_ns[row] <= FRESH_NS) & np.isnan(places[:, 0])
        for axis in range(2):
            between = np.interp(time_ns[fresh], track.time_ns, track.poses[:, axis])
            places[fresh, axis] = between
    return places


TIMELINE = Timeline(draw)
