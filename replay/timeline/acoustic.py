"""The shooter's timeline: a map of sensors, what they heard as rays, the shot's ellipses; NEES."""

import numpy as np
import rerun.blueprint as rrb

from recorders.log import Stream, schemas
from recorders.models.acoustic import Medium
from replay.blocks import gather
from replay.estimators.acoustic_streams import gather_detections
from replay.estimators.solutions import sensor_numbers
from replay.evaluation import Floats
from replay.timeline.canvas import TRUTH, Canvas, Scene, Timeline, Times, beside
from replay.timeline.events import draw_events
from replay.timeline.plane import (
    ROOT,
    Stroke,
    draw_ellipses,
    draw_lines,
    draw_points,
    extent_of,
    plane_view,
    turn_up,
)
from replay.timeline.plots import draw_quality_in_tabs

CASE = "shooter"
MUZZLE_BLAST = (150, 150, 150, 160)
SHOCKWAVE = (170, 110, 60, 160)
CONE_LENGTH = 0.7


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """The map and events beside errors and NEES."""
    turn_up(canvas)
    numbers, sensors, shooter = _places(scene)
    shown = np.concatenate([sensors, shooter])
    extent_m, mach_angle_rad = extent_of(shown), _mach_angle_rad(scene)
    draw_points(canvas, f"{ROOT}/sensors", numbers, sensors)
    _draw_heard(canvas, scene, extent_m)
    for truth in scene.truths_of(CASE):
        _draw_shot(canvas, "truth", Stroke(TRUTH, 2.0), truth, truth["state"], extent_m, mach_angle_rad)
    for estimator, stream in scene.outputs_of(CASE, schemas.GAUSSIAN_ESTIMATE):
        stroke = Stroke(scene.colour(estimator), 1.5)
        size = len(stream.components)
        covariances = stream["covariance"].reshape(-1, size, size)
        outline = (stream["mean"][:, :2], covariances[:, :2, :2], stroke)
        draw_ellipses(canvas, f"{ROOT}/{estimator}/shooter", stream.publish_time_ns, *outline)
        _draw_shot(canvas, estimator, stroke, stream, stream["mean"], extent_m, mach_angle_rad)
    board = rrb.Vertical(
        plane_view(canvas, ROOT, [], [], shown),
        draw_events(canvas, scene, CASE),
        row_shares=[3, 1],
    )
    return beside(board, draw_quality_in_tabs(canvas, scene, CASE), CASE)


def _places(scene: Scene) -> tuple[np.ndarray, Floats, Floats]:
    """The sensors' numbers and true places (n, 2), and the shooter's (1, 2), where the log says them."""
    for truth in scene.truths_of(CASE):
        numbers = [int(n.split("_")[1]) for n in truth.components if n.endswith("_x_m") and n != "x_m"]
        state = truth["state"][0]
        return np.array(numbers), state[3:].reshape(-1, 2), state[None, :2]
    return np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2))


def _mach_angle_rad(scene: Scene) -> float:
    """As the first sensor's channel states it, else as usual."""
    stated = [dict(topic.metadata) for topic in scene.source.topics.values()]
    mach = [float(each["mach_number"]) for each in stated if "mach_number" in each]
    return Medium(mach_number=mach[0]).mach_angle_rad if mach else Medium().mach_angle_rad


def _draw_heard(canvas: Canvas, scene: Scene, length_m: float) -> None:
    """A ray for each direction of arrival, when all sensors have heard the shot."""
    numbers = sensor_numbers(scene.source.topics, "detections", schemas.SHOT_DETECTION)
    topics = [[f"/sensor{n}/{leaf}" for n in numbers] for leaf in ("detections", "position")]
    if not numbers or not set(topics[1]) <= set(scene.source.topics):
        return
    batches, heard = gather_detections(*([gather([scene.read(t)]) for t in each] for each in topics))
    for name, angle, colour in (
        ("muzzle blast", heard.muzzle_blast_rad, MUZZLE_BLAST),
        ("shockwave", heard.shockwave_rad, SHOCKWAVE),
    ):
        shot, sensor = np.nonzero(np.isfinite(angle))
        start = heard.position_m[shot, sensor]
        rays = np.stack([start, start + length_m * _unit(angle[shot, sensor])], axis=1)
        colours = np.tile(np.array(colour, np.uint8), (len(rays), 1))
        draw_lines(canvas, f"{ROOT}/{name}", batches.time_ns[shot], rays, colours)


def _draw_shot(
    canvas: Canvas,
    name: str,
    stroke: Stroke,
    stream: Stream,
    states: Floats,
    extent_m: float,
    mach_angle_rad: float,
) -> None:
    """The bullet's way and the shockwave's cone behind it, where the trajectory is known."""
    if "trajectory_rad" not in stream.components:
        return
    place, angle = states[:, :2], states[:, 2]
    tip = place + CONE_LENGTH * extent_m * _unit(angle)
    wing = extent_m * 0.5 * CONE_LENGTH
    half = mach_angle_rad
    ends = [tip - wing * _unit(angle + side * half) for side in (1, -1)]
    lines = np.stack([np.stack([place, tip], 1), *(np.stack([tip, end], 1) for end in ends)], axis=1)
    colours = np.tile(np.array((*stroke.colour, 255), np.uint8), (3 * len(states), 1))
    times_ns: Times = np.repeat(stream.publish_time_ns, 3)
    draw_lines(canvas, f"{ROOT}/{name}/shot", times_ns, lines.reshape(-1, 2, 2), colours)


def _unit(angle: Floats) -> Floats:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


TIMELINE = Timeline(draw)
