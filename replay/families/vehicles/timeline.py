"""Timeline of vehicles: a map, a close-up, and errors and GOSPA over time.

Errors are about 1 m on trajectories of hundreds of metres, so everything is also drawn in close-ups
around the true positions of the vehicles, side by side. Detections of the infrastructure sensor are in
its own frame; the map shows them transformed by the true pose of the sensor, and by the estimated pose
if an estimator finds it.
"""

from collections.abc import Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.planar import out_of_frame
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.measurements import PLANE, covariances_of, read_vectors
from fuselog.replay.families.sets.judging.errors import CUTOFF_M, set_errors
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.judging.errors.label_errors import assigned_squared_error, fixed_squared_error
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.timeline.drawing.canvas import (
    MUTED,
    TRUTH,
    Board,
    Canvas,
    Colour,
    Scene,
    Timeline,
    Times,
)
from fuselog.replay.timeline.drawing.events import draw_events
from fuselog.replay.timeline.drawing.geodetic import degrees_of, draw_fixes, map_view
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    TRUE,
    clouds_of,
    draw_cloud,
    draw_clouds,
    draw_ellipses,
    draw_lines,
    draw_path,
    draw_points,
    draw_scans,
    draw_way,
    plane_view,
    stroke_of,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import (
    draw_curve,
    draw_effective,
    draw_modes,
    draw_nees,
    line,
    plot_view,
)

CLOSE = f"{ROOT}/close"
SENSOR = f"{ROOT}/sensor"
FIX: Colour = (150, 150, 90)
SEEN: Colour = (190, 110, 60)
LINK = (255, 255, 255, 255)
# Distance between close-ups, and largest distance from a vehicle at which points are drawn in its
# close-up.
CELL_M, SHOWN_M = 8.0, 3.8


class Vehicles(NamedTuple):
    """True positions (steps, vehicles, 2) of all vehicles at their common stamps (steps,)."""

    time_ns: Times
    places: Floats

    @property
    def number(self) -> int:
        """Return the number of vehicles."""
        return self.places.shape[1]

    def rows(self, time_ns: Times) -> NDArray[np.int64]:
        """Return the step of each stamp; if a stamp is between two steps, return the later one."""
        return np.searchsorted(self.time_ns, time_ns).clip(0, len(self.time_ns) - 1)


class Points(NamedTuple):
    """Positions (n, 2) at sorted stamps (n,)."""

    time_ns: Times
    places: Floats


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw the map above the close-ups, next to GOSPA, errors (in a tab) and NEES."""
    turn_up(canvas)
    vehicles = _truths(scene)
    tracks = {name: _tracks(scene, name, vehicles) for name in scene.estimators}
    tracks = {name: places for name, places in tracks.items() if places.shape[1] == vehicles.number}
    unnamed = list(_unnamed(scene))
    _draw_map(canvas, scene, vehicles, tracks, unnamed)
    _draw_close(canvas, scene, vehicles, tracks, unnamed)
    raw = _points(scene, "/infrastructure/detection")
    draw_scans(canvas, f"{SENSOR}/raw", *raw, SEEN, 3.0)
    paths = [f"{ROOT}/map/{name}/{n}" for name in ("truth", *tracks) for n in range(vehicles.number)]
    places = np.concatenate([vehicles.places.reshape(-1, 2), *(pose[:, :2] for pose in _poses(scene))])
    cells = CELL_M * np.array([[-0.5, -0.5], [vehicles.number - 0.5, 0.5]])
    run_s = (canvas.end_ns - canvas.epoch_ns) * 1e-9
    whole = plane_view(canvas, f"{ROOT}/map", [], paths, places, trail_s=run_s)
    sensor = plane_view(canvas, SENSOR, [], [], raw.places if len(raw.places) else places)
    close = plane_view(canvas, CLOSE, [], [], cells)
    sensor.name = "Raw detections in the sensor's frame"
    close.name = f"Close-up about the true positions, {CELL_M:g} m each"
    has_links = bool(len(_links(scene)[0]))
    if has_links:
        close.name += "; white lines: prediction to associated fix"
    board: Board = rrb.Vertical(
        rrb.Tabs(
            whole,
            sensor,
            *_geodetic_views(canvas, scene),
            *draw_events(canvas, scene, "", more=scene.cases),
        ),
        close,
        row_shares=[3, 1] if scene.outputs else [3, 2],
    )
    colours = {"truth": TRUTH} | {name: scene.colour(name) for name in scene.estimators}
    sensed = {"fixes": (FIX, "/network/detection"), "detections": (SEEN, "/infrastructure/detection")}
    colours |= {name: colour for name, (colour, topic) in sensed.items() if topic in scene.source.topics}
    if has_links:
        colours["association"] = LINK[:3]
    board = with_legend(canvas, "vehicles", colours, board)
    if not scene.outputs:
        return board
    quality = [
        *(view for case in scene.cases for view in _nees(canvas, scene, case)),
        *(view for case in scene.cases for view in _own(canvas, scene, case)),
    ]
    tabs = [_draw_errors(canvas, scene, vehicles, tracks), quality]
    plots = rrb.Vertical(*(rrb.Tabs(*views) for views in tabs if views))
    return rrb.Horizontal(board, plots, column_shares=[3, 2])


def _nees(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """Plot the NEES of a case, with the name of the case in the title."""
    views = draw_nees(canvas, scene, case)
    for view in views:
        view.name = f"{case}: {view.name}"
    return views


def _own(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """Plot mode probabilities and effective numbers of particles, with the case's name in the titles."""
    views = [*draw_modes(canvas, scene, case), *draw_effective(canvas, scene, case)]
    for view in views:
        view.name = f"{view.name}, {case}"
    return views


def _truths(scene: Scene) -> Vehicles:
    cases = [case for case in scene.cases if case.startswith("vehicle")]
    truths = [truth for case in cases for truth in scene.truths_of(case)]
    if not truths:
        return Vehicles(np.zeros(1, np.int64), np.zeros((1, 0, 2)))
    stamps_ns = reduce(np.intersect1d, [truth.publish_time_ns for truth in truths])
    if not len(stamps_ns):
        return Vehicles(np.zeros(1, np.int64), np.zeros((1, 0, 2)))
    rows = [np.searchsorted(truth.publish_time_ns, stamps_ns) for truth in truths]
    states = [truth["state"][row, 0::2] for truth, row in zip(truths, rows, strict=True)]
    return Vehicles(stamps_ns, np.stack(states, axis=1))


def _tracks(scene: Scene, name: str, vehicles: Vehicles) -> Floats:
    """Return an estimator's positions (steps, vehicles, 2) at stamps of the truth, NaN if missing."""
    topics = [f"/estimates/{name}/vehicle{n + 1}/state" for n in range(vehicles.number)]
    found = [scene.outputs[topic] for topic in topics if topic in scene.outputs]
    found = [stream for stream in found if set(PLANE) <= set(stream.components)]
    places = np.full((len(vehicles.time_ns), len(found), 2), np.nan)
    for n, stream in enumerate(found):
        places[vehicles.rows(stream.publish_time_ns), n] = read_vectors(stream, "mean", PLANE)
    return places


def _points(scene: Scene, topic: str) -> Points:
    if topic not in scene.source.topics:
        return Points(np.empty(0, np.int64), np.empty((0, 2)))
    stream = scene.read(topic)
    return Points(stream.publish_time_ns, stream["position_m"].reshape(-1, 2))


def _registered(scene: Scene) -> list[tuple[str, Points]]:
    """Transform the detections of the infrastructure sensor by each estimated pose of the sensor."""
    raw = _points(scene, "/infrastructure/detection")
    found = []
    for name, stream in scene.outputs_of("infrastructure", schemas.GAUSSIAN_ESTIMATE):
        if "heading_rad" not in stream.components:
            continue
        row = np.searchsorted(stream.publish_time_ns, raw.time_ns).clip(0, len(stream) - 1)
        known = np.isin(raw.time_ns, stream.publish_time_ns)
        pose = stream["mean"][row[known]].T
        places = np.stack(out_of_frame(pose, raw.places[known].T), axis=1)
        found.append((name, Points(raw.time_ns[known], places)))
    return found


def _poses(scene: Scene) -> list[Floats]:
    """Return the true poses (n, 3) of the sensor, in m and rad; an empty list if they are unknown."""
    return [
        truth["state"]
        for truth in scene.truths_of("infrastructure")
        if tuple(truth.components) == (*PLANE, "heading_rad")
    ]


def _placed(scene: Scene, points: Points) -> Points:
    """Transform points from the sensor's frame to the map; drop them if its true pose is unknown."""
    poses = _poses(scene)
    if not poses:
        return Points(points.time_ns[:0], points.places[:0])
    truth_ns = scene.truths_of("infrastructure")[0].publish_time_ns
    row = np.searchsorted(truth_ns, points.time_ns).clip(0, len(truth_ns) - 1)
    return Points(points.time_ns, np.stack(out_of_frame(poses[0][row].T, points.places.T), axis=1))


def _unnamed(scene: Scene) -> Iterator[tuple[str, Points]]:
    """Yield estimated sets of positions without labels, on the map."""
    for case in ("network", "infrastructure"):
        sizes = dict(scene.outputs_of(case, schemas.ESTIMATE_SIZE))
        for name, stream in scene.outputs_of(case, schemas.DENSITY_ESTIMATE):
            if name in sizes and set(PLANE) <= set(stream.components):
                points = Points(stream.publish_time_ns, read_vectors(stream, "mean", PLANE))
                yield name, points if case == "network" else _placed(scene, points)


def _links(scene: Scene) -> tuple[Times, Floats, NDArray[np.int64]]:
    """Return lines (n, 2, 2) from predicted positions to associated fixes, and their vehicles.

    The lines are from the first estimator that outputs its associations.
    """
    fixes = _points(scene, "/network/detection")
    rows: list[tuple[Times, Floats, NDArray[np.int64]]] = []
    for case in (case for case in scene.cases if case.startswith("vehicle")):
        streams = [stream for _, stream in scene.outputs_of(case, schemas.INNOVATION)]
        for stream in [each for each in streams if each["target_id"].min() > 0][:1]:
            first = np.searchsorted(fixes.time_ns, stream.publish_time_ns)
            ends = fixes.places[first + stream["target_id"].astype(np.int64) - 1]
            lines = np.stack([ends - stream["innovation"], ends], axis=1)
            number = np.full(len(lines), int(case.removeprefix("vehicle")) - 1)
            rows.append((stream.publish_time_ns, lines, number))
    if not rows:
        return np.empty(0, np.int64), np.empty((0, 2, 2)), np.empty(0, np.int64)
    times, lines, numbers = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(times, kind="stable")
    return times[order], lines[order], numbers[order]


def _draw_map(
    canvas: Canvas,
    scene: Scene,
    vehicles: Vehicles,
    tracks: dict[str, Floats],
    unnamed: Sequence[tuple[str, Points]],
) -> None:
    """Draw trajectories of truth and estimators, unlabelled fixes, the sensor and its detections."""
    root = f"{ROOT}/map"
    for pose in _poses(scene):
        draw_points(canvas, f"{root}/sensor", np.array(["sensor"]), pose[:1, :2])
    placed = _placed(scene, _points(scene, "/infrastructure/detection"))
    draw_scans(canvas, f"{root}/detections", *placed, SEEN, 3.0)
    for name, points in unnamed:
        draw_scans(canvas, f"{root}/{name}/elements", *points, scene.colour(name), 5.0)
    for n in range(vehicles.number):
        draw_way(canvas, f"{root}/truth/{n}/whole", vehicles.places[:, n])
        stroke = TRUE
        draw_path(canvas, f"{root}/truth/{n}", vehicles.time_ns, vehicles.places[:, n], stroke)
        for name, places in tracks.items():
            known = np.isfinite(places[:, n, 0])
            stroke = stroke_of(scene, name)
            draw_path(canvas, f"{root}/{name}/{n}", vehicles.time_ns[known], places[known, n], stroke)
        draw_clouds(canvas, scene, f"vehicle{n + 1}", f"{root}/vehicle{n + 1}")
    draw_scans(canvas, f"{root}/fixes", *_points(scene, "/network/detection"), FIX, 4.0)
    for name, points in _registered(scene):
        draw_scans(canvas, f"{root}/{name}/detections", *points, SEEN, 3.0)
    times, lines, _ = _links(scene)
    draw_lines(canvas, f"{root}/links", times, lines, np.tile(LINK, (len(lines), 1)).astype(np.uint8))


def _draw_close(
    canvas: Canvas,
    scene: Scene,
    vehicles: Vehicles,
    tracks: dict[str, Floats],
    unnamed: Sequence[tuple[str, Points]],
) -> None:
    """Draw everything relative to the true positions of the vehicles, side by side."""
    corners = CELL_M * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])
    centres = np.stack([CELL_M * np.arange(vehicles.number), np.zeros(vehicles.number)], axis=1)
    frames = rr.LineStrips2D(
        [corners + centre for centre in centres], colors=[MUTED], radii=rr.Radius.ui_points(0.5)
    )
    canvas.fix(f"{CLOSE}/cells", frames)
    names = [f"vehicle {n + 1}" for n in range(vehicles.number)]
    labels = rr.Points2D(
        centres + np.array([0.0, 0.42 * CELL_M]),
        labels=names,
        radii=0.0,
        colors=[TRUTH],
        show_labels=True,
    )
    canvas.fix(f"{CLOSE}/names", labels)
    truth = rr.Points2D(centres, colors=[TRUTH], radii=rr.Radius.ui_points(6.0))
    canvas.fix(f"{CLOSE}/truth", truth)

    def near(points: Points) -> Points:
        """Place each point in the close-up of every vehicle that it is near."""
        apart = points.places[:, None] - vehicles.places[vehicles.rows(points.time_ns)]
        row, cell = np.nonzero(np.abs(apart).max(axis=2, initial=0.0) < SHOWN_M)
        return Points(points.time_ns[row], apart[row, cell] + centres[cell])

    fixes = near(_points(scene, "/network/detection"))
    draw_scans(canvas, f"{CLOSE}/fixes", *fixes, FIX, 4.0)
    for name, points in _registered(scene):
        draw_scans(canvas, f"{CLOSE}/{name}/detections", *near(points), SEEN, 3.0)
    for name, points in unnamed:
        draw_scans(canvas, f"{CLOSE}/{name}/elements", *near(points), scene.colour(name), 5.0)
    for name in tracks:
        for n in range(vehicles.number):
            stream = scene.outputs[f"/estimates/{name}/vehicle{n + 1}/state"]
            _draw_ellipse(canvas, scene, vehicles, name, n, stream, centres[n])
    for n in range(vehicles.number):
        case = f"vehicle{n + 1}"
        for cloud in clouds_of(scene, case):
            apart = cloud.places - vehicles.places[vehicles.rows(cloud.stamps), n][cloud.row]
            shown = np.abs(apart).max(axis=1) < SHOWN_M
            places, entity = apart[shown] + centres[n], f"{CLOSE}/{case}/{cloud.estimator}/particles"
            close = cloud._replace(row=cloud.row[shown], places=places, weights=cloud.weights[shown])
            draw_cloud(canvas, entity, close, scene.colour(cloud.estimator))
    times, lines, number = _links(scene)
    apart = lines - vehicles.places[vehicles.rows(times), number][:, None]
    shown = np.abs(apart).max(axis=(1, 2)) < SHOWN_M
    colours = np.tile(LINK, (int(shown.sum()), 1)).astype(np.uint8)
    draw_lines(
        canvas, f"{CLOSE}/links", times[shown], apart[shown] + centres[number[shown]][:, None], colours
    )


def _draw_ellipse(
    canvas: Canvas,
    scene: Scene,
    vehicles: Vehicles,
    name: str,
    n: int,
    stream: Stream,
    centre: Floats,
) -> None:
    """Draw an estimate's 95 % ellipse relative to its vehicle's true position."""
    place = read_vectors(stream, "mean", PLANE)
    apart = place - vehicles.places[vehicles.rows(stream.publish_time_ns), n]
    covariance = covariances_of(stream, PLANE)
    shown = np.abs(apart).max(axis=1) < SHOWN_M
    draw_ellipses(
        canvas,
        f"{CLOSE}/{name}/{n}",
        stream.publish_time_ns[shown],
        apart[shown] + centre,
        covariance[shown],
        stroke_of(scene, name),
    )


def _geodetic_views(canvas: Canvas, scene: Scene) -> list[rrb.MapView]:
    """Draw the fixes by latitude and longitude, if there are any."""
    topics = [topic for topic in scene.source.topics if topic.endswith("/geodetic_fix")]
    fixes = [stream for topic in topics if len(stream := scene.read(topic))]
    for stream in fixes:
        draw_fixes(canvas, f"geodetic/{stream.topic.split('/')[1]}", stream, FIX)
    degrees = [degrees_of(stream) for stream in fixes]
    return [map_view(canvas, "geodetic", np.concatenate(degrees))] if degrees else []


def _draw_errors(
    canvas: Canvas, scene: Scene, vehicles: Vehicles, tracks: dict[str, Floats]
) -> list[rrb.TimeSeriesView]:
    """Plot GOSPA, which ignores labels, and the joint error of all labelled vehicles."""
    for name, places in tracks.items():
        known = np.isfinite(places).all(axis=(1, 2))
        there, truths = places[known], vehicles.places[known]
        errors = np.sqrt(fixed_squared_error(there, truths))
        gospa = np.sqrt(assigned_squared_error(there, truths, CUTOFF_M))
        curve, style = (scene.colour(name), vehicles.time_ns[known]), line(scene.width(name))
        draw_curve(canvas, "plots/error", name, *curve, errors, style)
        draw_curve(canvas, "plots/gospa", name, *curve, gospa, style)
    outputs = {topic: gather([stream]) for topic, stream in scene.outputs.items()}
    for found in set_errors(outputs, [Truths(scene.source)]).values():
        if found.case == "network":
            colour = scene.colour(found.estimator)
            curve, style = (colour, found.time_ns), line(scene.width(found.estimator))
            draw_curve(canvas, "plots/gospa", found.estimator, *curve, found.gospa, style)
    labelled = plot_view("plots/error", "Joint error of all vehicles", "m", (0.0, 4.0))
    unlabelled = plot_view("plots/gospa", f"GOSPA, cutoff {CUTOFF_M:g} m", "m", (0.0, 4.0))
    return [unlabelled, labelled] if tracks else [unlabelled]


TIMELINE = Timeline(draw)
