"""Timeline of moving targets and sensors: tracks, lines of sight, and close-ups of errors.

It applies to any log with moving lines of sight. Errors are small compared with distances, so each
target has its own view around its true position.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.families.los.models import direction
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.families.los.timeline import BEYOND, SENSOR, draw_rays, ellipsoids
from fuselog.replay.timeline.drawing.canvas import (
    TRUTH,
    WRONG,
    Board,
    Canvas,
    Colour,
    Scene,
    Times,
    entity_path,
    escaped,
    nice,
    thin,
)
from fuselog.replay.timeline.drawing.plane import with_legend

AXES = "xyz"
# Extent of a close-up, in units of the smallest median error, and the position of its camera.
REACH, EYE = 1.0, np.array([1.6, 1.2, -1.9])
MARK, THIN = rr.Radius.ui_points(5.0), rr.Radius.ui_points(1.5)


class Track(NamedTuple):
    """Positions (n, 3) of a target, true or estimated."""

    name: str
    target: str
    colour: Colour
    time_ns: Times
    places: Floats


def draw_moving_sights(canvas: Canvas, scene: Scene, case: str) -> list[Board]:
    """Draw the scene above a close-up of each target's errors, if there are sensors and targets."""
    schema = schemas.MOVING_LINE_OF_SIGHT.full_name
    topics = [
        each for each in scene.topics_near(case) if scene.source.topics[each].schema_name == schema
    ]
    sensors = [stream for stream in map(scene.read, topics) if len(stream)]
    tracks = list(_tracks(scene, case))
    if not sensors or not tracks:
        return []
    root = entity_path("sights", case)
    canvas.fix(root, rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    places = np.concatenate([*(track.places for track in tracks), *(s["position_m"] for s in sensors)])
    extent = float(np.ptp(places, axis=0).max())
    for track in tracks:
        label = track.target if track.name == "truth" else None
        _draw_way(canvas, f"{root}/{track.name}/{track.target}", track, label)
    for stream in sensors:
        _draw_sensor(canvas, root, stream, BEYOND * extent)
    centre = places.mean(axis=0)
    space = rrb.Spatial3DView(
        origin=escaped(root),
        name="Scene, y up",
        eye_controls=rrb.EyeControls3D(
            position=centre + extent * np.array([0.9, 0.6, -0.9]), look_target=centre, eye_up=(0, 1, 0)
        ),
    )
    close = [
        view
        for target in dict.fromkeys(track.target for track in tracks)
        for view in _draw_close(canvas, scene, case, target)
    ]
    board = rrb.Vertical(space, rrb.Horizontal(*close), row_shares=[3, 2]) if close else space
    colours = scene.colours(case) | {"sensors": SENSOR, "measured": WRONG}
    return [rrb.Vertical(with_legend(canvas, root, colours, board), name="scene")]


def _tracks(scene: Scene, case: str) -> Iterator[Track]:
    """Yield the positions of each target from the truth and from all estimates."""
    found = [("truth", TRUTH, each, each["state"]) for each in scene.truths_of(case)]
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        found.append((estimator, scene.colour(estimator), stream, stream["mean"]))
    for name, colour, stream, states in found:
        for target in _targets(stream.components):
            rows = thin(stream.publish_time_ns)
            columns = _columns(stream.components, target)
            yield Track(name, target, colour, stream.publish_time_ns[rows], states[rows][:, columns])


def _targets(components: Sequence[str]) -> list[str]:
    """Return the names of targets, such as target_1, whose positions are among the components."""
    names = [name.removesuffix("_x_m") for name in components if name.endswith("_x_m")]
    return [name for name in names if {f"{name}_{axis}_m" for axis in AXES} <= set(components)]


def _columns(components: Sequence[str], target: str) -> list[int]:
    return [components.index(f"{target}_{axis}_m") for axis in AXES]


def _draw_way(canvas: Canvas, entity: str, track: Track, label: str | None) -> None:
    """Draw the whole path of a target, and its position at the cursor."""
    way = rr.LineStrips3D([track.places], colors=[track.colour], radii=THIN)
    canvas.fix(f"{entity}/way", way)
    canvas.send(entity, track.time_ns, rr.Points3D.columns(positions=track.places))
    labels = [label.replace("_", " ")] if label else None
    canvas.fix(
        entity,
        rr.Points3D.from_fields(colors=[track.colour], radii=MARK, labels=labels, show_labels=True),
    )


def _draw_sensor(canvas: Canvas, root: str, stream: Stream, length_m: float) -> None:
    """Draw the path of a sensor, and its measured line of sight for the stated attitude."""
    from scipy.spatial.transform import Rotation  # slow to import

    rows = thin(stream.publish_time_ns)
    name = stream.topic.strip("/").partition("/")[0]
    time_ns, places = stream.publish_time_ns[rows], stream["position_m"][rows]
    _draw_way(canvas, f"{root}/{name}", Track(name, "", SENSOR, time_ns, places), name)
    angles = stream["azimuth_rad"][rows], stream["elevation_rad"][rows]
    ahead = np.stack(direction(*angles, np.zeros((3, len(rows)))), axis=1)
    to_world = Rotation.from_quat(stream["quaternion"][rows], scalar_first=True)
    rays = np.stack([places, places + length_m * to_world.apply(ahead)], axis=1)
    draw_rays(canvas, f"{root}/measured/{name}", time_ns, time_ns, rays, WRONG)


def _draw_close(canvas: Canvas, scene: Scene, case: str, target: str) -> list[rrb.Spatial3DView]:
    """Draw a target's errors and their ellipsoids around its true position, if there are errors."""
    found = [each for each in scene.errors_of(case) if target in _targets(each.components)]
    if not found:
        return []
    root, sizes = entity_path("close", case, target), []
    canvas.fix(root, rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    for errors in found:
        columns, rows = _columns(errors.components, target), thin(errors.time_ns)
        places, colour = errors.error[rows][:, columns], scene.colour(errors.estimator)
        half_axes, turns = ellipsoids(errors.covariance[rows][:, columns][:, :, columns])
        spheres = rr.Ellipsoids3D.columns(centers=places, half_sizes=half_axes, quaternions=turns)
        entity = f"{root}/{errors.estimator}"
        canvas.send(entity, errors.time_ns[rows], spheres)
        canvas.fix(entity, rr.Ellipsoids3D.from_fields(colors=[colour]))
        canvas.send(f"{entity}/place", errors.time_ns[rows], rr.Points3D.columns(positions=places))
        canvas.fix(f"{entity}/place", rr.Points3D.from_fields(colors=[colour], radii=MARK))
        away = np.linalg.norm(places, axis=1) + half_axes.max(axis=1)
        sizes.append(float(np.nanmedian(away)))
    reach_m = max(min(sizes), np.finfo(float).tiny)
    length_m = nice(reach_m / 3.0)
    arrows = rr.Arrows3D(
        vectors=length_m * np.eye(3), colors=[TRUTH], radii=THIN, labels=[*AXES], show_labels=True
    )
    canvas.fix(f"{root}/axes", arrows)
    canvas.fix(f"{root}/truth", rr.Points3D([[0.0, 0.0, 0.0]], colors=[TRUTH], radii=MARK))
    eye = rrb.EyeControls3D(position=REACH * reach_m * EYE, look_target=(0, 0, 0), eye_up=(0, 1, 0))
    name = f"Error of {target.replace('_', ' ')}, 95 %, arrows {length_m:g} m"
    return [rrb.Spatial3DView(origin=escaped(root), name=name, eye_controls=eye)]
