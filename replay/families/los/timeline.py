"""Timeline of optical sensors, targets and lines of sight in space, with NEES, errors and events.

Lines of sight are drawn twice: with the nominal attitudes when they arrive, and corrected by the
estimated biases when these are available.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from fuselog.recorders.families.los.models import bias_components, direction
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine import chi2
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    TRUTH,
    WRONG,
    Canvas,
    Colour,
    Scene,
    Timeline,
    Times,
    beside,
    nice,
)
from fuselog.replay.timeline.drawing.events import above_events, draw_events
from fuselog.replay.timeline.drawing.plane import with_legend
from fuselog.replay.timeline.drawing.plots import draw_quality

ROOT = "space"
SENSOR: Colour = (240, 228, 66)
# The longest half axis of an ellipsoid is drawn as about this share of the scene.
ELLIPSOID_SHARE = 0.03
MARK = rr.Radius.ui_points(4.0)
# Length of a ray as a factor of the scene's extent, so that rays end behind the targets.
BEYOND = 1.05
# Position of the camera relative to the centre of the scene, in units of the scene's extent.
EYE = np.array([0.2, 0.5, 1.1])


class Sensor(NamedTuple):
    """A sensor with its position (3,), nominal yaw, pitch, roll (3,), and lines of sight."""

    number: int
    place: Floats
    attitude: Floats
    sights: Stream


class Targets(NamedTuple):
    """Ellipsoids of an estimator's targets; each stamp has `at_once` ellipsoids."""

    estimator: str
    colour: Colour
    stream: Stream
    at_once: int
    centres: Floats
    half_axes: Floats
    turns: Floats


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw the scene in space next to NEES and the errors of all components."""
    canvas.fix(ROOT, rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    sensors = list(_sensors(scene))
    targets = _targets(scene)
    places = np.concatenate([np.array([each.place for each in sensors]).reshape(-1, 3), targets])
    extent = float(np.ptp(places, axis=0).max()) if len(places) else 1.0
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0)) if len(places) else np.zeros(3)
    eye = rrb.EyeControls3D(position=middle + extent * EYE, look_target=middle, eye_up=(0.0, 1.0, 0.0))
    _draw_points(canvas, "sensors", places[: len(sensors)], SENSOR)
    _draw_points(canvas, "targets", targets, TRUTH)
    _draw_measured(canvas, sensors, BEYOND * extent)
    estimates = [
        _targets_of(name, scene.colour(name), stream)
        for name, stream in scene.outputs_of("", schemas.GAUSSIAN_ESTIMATE)
    ]
    sizes = [float(np.median(each.half_axes.max(axis=1))) for each in estimates]
    scale = max(1.0, nice(ELLIPSOID_SHARE * extent / max(sizes))) if sizes else 1.0
    for each in estimates:
        _draw_estimates(canvas, each, sensors, scale, BEYOND * extent)
    drawn = f"Scene; 95 % ellipsoids enlarged {scale:g} times" if estimates else "Scene"
    space = rrb.Spatial3DView(origin=ROOT, name=drawn, eye_controls=eye)
    colours = scene.colours("") | {"sensors": SENSOR, "measured": WRONG}
    board = above_events(with_legend(canvas, ROOT, colours, space), draw_events(canvas, scene, ""))
    return beside(board, draw_quality(canvas, scene, "", legend=False), "")


def _sensors(scene: Scene) -> Iterator[Sensor]:
    """Yield the sensors whose position and attitude are in the log."""
    from scipy.spatial.transform import Rotation  # slow to import

    for topic in scene.source.topics:
        number = re.fullmatch(r"/sensor(\d+)/line_of_sight", topic)
        if number is None:
            continue
        mounting = [topic.replace("line_of_sight", leaf) for leaf in ("position", "attitude")]
        if not set(mounting) <= set(scene.source.topics):
            continue
        position, attitude = map(scene.read, mounting)
        if not len(position) or not np.linalg.norm(attitude["quaternion"][:1]) > 0.0:
            continue
        turned = Rotation.from_quat(attitude["quaternion"][0], scalar_first=True).inv()
        yield Sensor(
            int(number[1]), position["position_m"][0], turned.as_euler("ZYX"), scene.read(topic)
        )


def _targets(scene: Scene) -> Floats:
    """Return the true positions (n, 3) of all targets."""
    for truth in scene.truths_of(""):
        names = [name for name in truth.components if name.startswith("target_")]
        columns = [truth.components.index(name) for name in names]
        return truth["state"][0, columns].reshape(-1, 3)
    return np.empty((0, 3))


def _draw_points(canvas: Canvas, name: str, places: Floats, colour: Colour) -> None:
    """Draw fixed points (n, 3), numbered from 1."""
    labels = [f"{name.removesuffix('s')} {number + 1}" for number in range(len(places))]
    radii = rr.Radius.ui_points(5.0)
    canvas.fix(f"{ROOT}/{name}", rr.Points3D(places, labels=labels, colors=[colour], radii=radii))


def _draw_measured(canvas: Canvas, sensors: list[Sensor], length_m: float) -> None:
    """Draw the lines of sight when they arrive, without a correction of their biases."""
    for sensor in sensors:
        rays = _rays(sensor, sensor.sights, np.zeros(3), length_m)
        times_ns = sensor.sights.publish_time_ns
        draw_rays(canvas, f"{ROOT}/measured/{sensor.number}", times_ns, times_ns, rays, WRONG)


def _rays(sensor: Sensor, sights: Stream, bias: Floats, length_m: float) -> Floats:
    """Compute lines (n, 2, 3) from the sensor along its sights, corrected by biases (3,) or (n, 3)."""
    attitude = np.broadcast_to(sensor.attitude + bias, (len(sights), 3)).T
    unit = np.stack(direction(sights["azimuth_rad"], sights["elevation_rad"], attitude), axis=1)
    return np.stack([np.broadcast_to(sensor.place, unit.shape), sensor.place + length_m * unit], axis=1)


def draw_rays(
    canvas: Canvas, entity: str, shown_ns: Times, time_ns: Times, rays: Floats, colour: Colour
) -> None:
    """Draw rays, each at its time.

    Args:
        canvas, entity: the canvas, and the entity on it.
        shown_ns: sorted times at which rays are drawn.
        time_ns: (n,), sorted, the time of each ray, which is one of `shown_ns`.
        rays: (n, 2, 3), in m, the start and the end of each ray.
        colour: colour of the rays.
    """
    times = np.unique(shown_ns)
    sizes = np.bincount(np.searchsorted(times, time_ns), minlength=len(times))
    columns = rr.LineStrips3D.columns(strips=rays.astype(np.float32))
    canvas.send(entity, times, columns.partition(sizes))
    radii = rr.Radius.ui_points(0.75)
    canvas.fix(entity, rr.LineStrips3D.from_fields(colors=[colour], radii=radii))


def _targets_of(estimator: str, colour: Colour, stream: Stream) -> Targets:
    """Compute the ellipsoids of all targets, stamp by stamp."""
    count = sum(name.startswith("target_") for name in stream.components) // 3
    covariances = stream["covariance"].reshape(len(stream), len(stream.components), -1)
    blocks = np.stack([covariances[:, i : i + 3, i : i + 3] for i in range(0, 3 * count, 3)], axis=1)
    centres = stream["mean"][:, : 3 * count].reshape(-1, 3)
    return Targets(estimator, colour, stream, count, centres, *ellipsoids(blocks.reshape(-1, 3, 3)))


def _draw_estimates(
    canvas: Canvas, targets: Targets, sensors: list[Sensor], scale: float, length_m: float
) -> None:
    """Draw targets' ellipsoids, enlarged by a scale, and corrected lines of sight."""
    estimator, colour, stream = targets.estimator, targets.colour, targets.stream
    components, times_ns = stream.components, stream.publish_time_ns
    columns = rr.Ellipsoids3D.columns(
        centers=targets.centres, half_sizes=scale * targets.half_axes, quaternions=targets.turns
    )
    entity = f"{ROOT}/{estimator}/targets"
    canvas.send(entity, times_ns, columns.partition([targets.at_once] * len(stream)))
    canvas.fix(entity, rr.Ellipsoids3D.from_fields(colors=[colour]))
    # a point stays visible if the ellipsoid is too small
    points = rr.Points3D.columns(positions=targets.centres)
    canvas.send(f"{entity}/place", times_ns, points.partition([targets.at_once] * len(stream)))
    canvas.fix(f"{entity}/place", rr.Points3D.from_fields(colors=[colour], radii=MARK))
    for sensor in sensors:
        names = bias_components(sensor.number)
        if not set(names) & set(components):
            continue
        bias = np.zeros((len(stream), 3))
        for axis, name in enumerate(names):
            if name in components:
                bias[:, axis] = stream["mean"][:, components.index(name)]
        batch = np.searchsorted(times_ns, sensor.sights.publish_time_ns)
        known = batch < len(times_ns)
        rays = _rays(sensor, sensor.sights.take(known), bias[batch[known]], length_m)
        name = f"{ROOT}/{estimator}/corrected/{sensor.number}"
        draw_rays(canvas, name, times_ns, times_ns[batch[known]], rays, colour)


def ellipsoids(covariances: Floats) -> tuple[Floats, NDArray[np.float64]]:
    """Compute half axes (n, 3) and orientations (n, 4) of the 95 % ellipsoids of Gaussians (n, 3, 3)."""
    from scipy.spatial.transform import Rotation  # slow to import

    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    half_axes = np.sqrt(chi2.ppf(0.95, 3) * np.maximum(variances, 0.0))
    return half_axes, Rotation.from_matrix(axes).as_quat()


TIMELINE = Timeline(draw)
