"""Timeline of shots: a map with sensors, rays of detections and ellipses of shots, next to the NEES."""

from typing import NamedTuple

import numpy as np
import rerun.blueprint as rrb

from fuselog.recorders.families.acoustic.models import Medium, sensor_components
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.channels import numbered
from fuselog.replay.families.acoustic.estimator import gather_detections
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    Canvas,
    Scene,
    Timeline,
    Times,
    beside,
    usual_interval_ns,
)
from fuselog.replay.timeline.drawing.events import above_events, draw_events
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    TRUE,
    Stroke,
    draw_ellipses,
    draw_lines,
    draw_points,
    extent_of,
    plane_view,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import draw_quality

CASE = "shooter"
MUZZLE_BLAST = (150, 150, 150, 160)
SHOCKWAVE = (170, 110, 60, 160)
# Length of the bullet's drawn path as a share of the map.
CONE_SHARE = 0.7


class Cone(NamedTuple):
    """Size and duration of a drawn shot.

    Attributes:
        length_m: length of the bullet's path.
        mach_angle_rad: half the opening angle of the shockwave's cone.
        interval_ns: the usual time between shots.
    """

    length_m: float
    mach_angle_rad: float
    interval_ns: float


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw the map and events next to errors and NEES."""
    turn_up(canvas)
    numbers = list(numbered(scene.source.topics, "sensor", "detections", schemas.SHOT_DETECTION))
    sensors = [s for s in numbers if f"/sensor{s}/position" in scene.source.topics]
    places = np.array([_place(scene, s) for s in sensors]).reshape(-1, 2)
    truths = scene.truths_of(CASE)
    shown = np.concatenate([places, *(truth["state"][:1, :2] for truth in truths)])
    extent_m = extent_of(shown)
    draw_points(canvas, f"{ROOT}/sensors", np.array(sensors, np.int64), places)
    heard_ns = _draw_heard(canvas, scene, sensors, extent_m) if sensors else np.empty(0, np.int64)
    mach_angle_rad = _mach_angle_rad(scene, sensors)
    cone = Cone(CONE_SHARE * extent_m, mach_angle_rad, usual_interval_ns(np.sort(heard_ns)))
    for truth in truths:
        then = truth.take(np.isin(truth.publish_time_ns, heard_ns))
        _draw_shot(canvas, "truth", TRUE, then, then["state"], cone)
    for estimator, stream in scene.outputs_of(CASE, schemas.GAUSSIAN_ESTIMATE):
        _draw_estimates(canvas, estimator, Stroke(scene.colour(estimator)), stream, cone)
    name = "Map; the bullet's path ends at its shockwave"
    colours = scene.colours(CASE) | {"muzzle blast": MUZZLE_BLAST[:3], "shockwave": SHOCKWAVE[:3]}
    board = with_legend(canvas, ROOT, colours, plane_view(canvas, ROOT, [], [], shown, name=name))
    board = above_events(board, draw_events(canvas, scene, CASE))
    return beside(board, draw_quality(canvas, scene, CASE, legend=False), CASE)


def _place(scene: Scene, sensor: int) -> Floats:
    """Find a sensor's position (2,) from the truth or its first fix, or NaN if it has neither."""
    for truth in scene.truths_of(CASE):
        columns = [truth.components.index(name) for name in sensor_components(sensor)]
        return truth["state"][0, columns]
    fixes: Floats = scene.read(f"/sensor{sensor}/position")["position_m"]
    return fixes[0] if len(fixes) else np.full(2, np.nan)


def _mach_angle_rad(scene: Scene, sensors: list[int]) -> float:
    """Return the Mach angle that the detections' channels state, or the default medium's angle."""
    for sensor in sensors:
        stated = scene.source.topics[f"/sensor{sensor}/detections"].metadata
        if "mach_number" in stated:
            return Medium(mach_number=float(stated["mach_number"])).mach_angle_rad
    return Medium().mach_angle_rad


def _draw_heard(canvas: Canvas, scene: Scene, sensors: list[int], length_m: float) -> Times:
    """Draw each shot's rays at the time when all sensors have heard the shot; return these times."""
    detections, positions = (
        [gather([scene.read(f"/sensor{sensor}/{leaf}")]) for sensor in sensors]
        for leaf in ("detections", "position")
    )
    batches, heard = gather_detections(detections, positions)
    for name, angle, colour in (
        ("muzzle blast", heard.muzzle_blast_rad, MUZZLE_BLAST),
        ("shockwave", heard.shockwave_rad, SHOCKWAVE),
    ):
        shot, sensor = np.nonzero(np.isfinite(angle))
        start = heard.position_m[shot, sensor]
        rays = np.stack([start, start + length_m * _unit(angle[shot, sensor])], axis=1)
        colours = np.tile(np.array(colour, np.uint8), (len(rays), 1))
        draw_lines(canvas, f"{ROOT}/{name}", batches.time_ns[shot], rays, colours)
    return batches.time_ns


def _draw_estimates(canvas: Canvas, estimator: str, stroke: Stroke, stream: Stream, cone: Cone) -> None:
    """Draw the shooter's ellipse, and the shot if its direction is estimated."""
    size = len(stream.components)
    covariances = stream["covariance"].reshape(-1, size, size)[:, :2, :2]
    outline = (stream["mean"][:, :2], covariances, stroke)
    draw_ellipses(canvas, f"{ROOT}/{estimator}/shooter", stream.publish_time_ns, *outline)
    _draw_shot(canvas, estimator, stroke, stream, stream["mean"], cone)


def _draw_shot(
    canvas: Canvas, name: str, stroke: Stroke, stream: Stream, states: Floats, cone: Cone
) -> None:
    """Draw the bullet's path and the shockwave's cone behind it, if the trajectory is known."""
    if "trajectory_rad" not in stream.components or len(stream) == 0:
        return
    place, angle = states[:, :2], states[:, 2]
    tip = place + cone.length_m * _unit(angle)
    wings = [tip - 0.5 * cone.length_m * _unit(angle + side * cone.mach_angle_rad) for side in (1, -1)]
    lines = np.stack([np.stack([end, tip], axis=1) for end in (place, *wings)], axis=1)
    colours = np.tile(np.array((*stroke.colour, 255), np.uint8), (3 * len(states), 1))
    times_ns: Times = np.repeat(stream.publish_time_ns, 3)
    lines = lines.reshape(-1, 2, 2)
    look = (stroke.radius_px, cone.interval_ns)
    draw_lines(canvas, f"{ROOT}/{name}/shot", times_ns, lines, colours, *look)


def _unit(angle: Floats) -> Floats:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


TIMELINE = Timeline(draw)
