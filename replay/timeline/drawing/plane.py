"""Scenes in the plane: paths, poses, covariance ellipses, numbered points, lines of sight.

Coordinates are sent unchanged. In Rerun's 2D views, y points down, so all entities below `map` have a
transform that makes y point up. Moving objects are logged at their time, and disappear when they are no
longer current. A path has one segment per row, and the view shows its last minute.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from fuselog.recorders.log import schemas
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    TRUTH,
    WIDTH,
    Board,
    Canvas,
    Colour,
    Scene,
    Times,
    escaped,
    gap_limit_ns,
    nice,
    thin,
    usual_interval_ns,
)

ROOT = "map"
GRID: Colour = (45, 45, 45)
TRAIL_S = 60.0
# The lines of a scan stay visible for this multiple of the usual interval between scans.
SHOWN_INTERVALS = 1.5
# Largest number of particles drawn; all particles of a stamp are drawn, or none. Areas are proportional
# to weights.
CLOUD_POINTS = 100_000
PARTICLE_PX = 1.5
# Margin as a fraction of a side, and smallest length of the shorter side as a fraction of the longer
# one.
MARGIN, LEAST_SIDE = 0.07, 0.3
LEGEND = "Legend"
# Row of a legend: width and gap between names in characters; height in characters and in the panel.
LEGEND_CHARACTERS, LEGEND_GAP, LEGEND_ROW, LEGEND_SHARE = 100.0, 5.0, 6.0, 0.07
# Points closer than this fraction of the extent of the map share one label.
LABEL_SHARE = 0.04


class Stroke(NamedTuple):
    """Style of a line: colour and radius in pixels; wide lines are drawn below narrow ones."""

    colour: Colour
    radius_px: float = 1.0

    def fields(self, widen: float = 1.0) -> dict[str, Any]:
        """Return the fields of Rerun's archetypes, with the radius multiplied by `widen`."""
        radius_px = self.radius_px * widen
        radii = rr.Radius.ui_points(radius_px)
        return {"colors": [self.colour], "radii": radii, "draw_order": 20.0 - radius_px}


TRUE = Stroke(TRUTH, 3.0)


def stroke_of(scene: Scene, estimator: str) -> Stroke:
    """Return the style of an estimator's lines; widths differ so that overlapping lines are visible."""
    return Stroke(scene.colour(estimator), 0.25 + 0.75 * scene.width(estimator) / WIDTH)


def turn_up(canvas: Canvas, root: str = ROOT) -> None:
    """Make y point up below an entity."""
    canvas.fix(root, rr.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])))


def draw_points(
    canvas: Canvas, entity: str, numbers: NDArray[np.int64 | np.str_], places: Floats
) -> None:
    """Draw fixed points with numbers or names; close points share a label below the lowest of them.

    Viewers draw in single precision; points that are infinite in single precision are left out.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        numbers, places: numbers or names (n,), and positions (n, 2) in m.
    """
    is_somewhere = (np.abs(places) <= np.finfo(np.float32).max).all(axis=1)
    numbers, places = numbers[is_somewhere], places[is_somewhere]
    if len(places) == 0:
        return
    texts = np.array([str(number) for number in numbers.tolist()])
    radii = rr.Radius.ui_points(4.0)
    canvas.fix(entity, rr.Points2D(places, labels=texts, colors=[TRUTH], radii=radii, show_labels=False))
    groups = neighbours(places, extent_of(places))
    spots = [(places[rows, 0].mean(), places[rows, 1].min()) for rows in groups]
    labels = [" ".join(texts[rows]) for rows in groups]
    names = rr.Points2D(spots, labels=labels, colors=[TRUTH], radii=0.0, show_labels=True)
    canvas.fix(f"{entity}/numbers", names)


def neighbours(places: Floats, extent_m: float) -> list[list[int]]:
    """Group points whose labels would overlap: all points of a group are close to each other.

    Args:
        places: (n, 2), in m.
        extent_m: extent of the view in m.

    Returns:
        The rows of each group.
    """
    farthest = LABEL_SHARE * extent_m
    groups: list[list[int]] = []
    for row, place in enumerate(places):
        for group in groups:
            if (np.linalg.norm(places[group] - place, axis=1) <= farthest).all():
                group.append(row)
                break
        else:
            groups.append([row])
    return groups


def draw_dots(canvas: Canvas, entity: str, time_ns: Times, places: Floats, stroke: Stroke) -> None:
    """Draw a point, such as a measurement, at each time.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        time_ns: (n,).
        places: (n, 2), in m.
        stroke: colour and width of the points.
    """
    canvas.send(entity, time_ns, rr.Points2D.columns(positions=places))
    canvas.fix(entity, rr.Points2D.from_fields(**stroke.fields(widen=2.0)))


def draw_scans(
    canvas: Canvas, entity: str, time_ns: Times, places: Floats, colour: Colour, radius_px: float
) -> None:
    """Draw all points of a stamp together; they are visible until the next stamp.

    Args:
        canvas, entity, time_ns, places: as for `draw_dots`, in order of time.
        colour, radius_px: colour and radius of the points.
    """
    times, sizes = np.unique(time_ns, return_counts=True)
    columns = rr.Points2D.columns(positions=places)
    canvas.send(entity, times, columns.partition(sizes))
    radii = rr.Radius.ui_points(radius_px)
    canvas.fix(entity, rr.Points2D.from_fields(colors=[colour], radii=radii))


class Cloud(NamedTuple):
    """Drawn particles of an estimator.

    Attributes:
        estimator: label of the estimator.
        stamps: (s,) times.
        row: (n,) index of each particle's stamp, in order.
        places: (n, 2).
        weights: (n,) with a mean of one over the particles of a stamp.
    """

    estimator: str
    stamps: Times
    row: NDArray[np.int64]
    places: Floats
    weights: Floats


def clouds_of(scene: Scene, case: str) -> Iterator[Cloud]:
    """Yield the particles of all estimators whose particles have positions."""
    for name, stream in scene.outputs_of(case, schemas.DENSITY_ESTIMATE):
        if not set(PLANE) <= set(stream.components):
            continue
        stamps, counts = np.unique(stream.publish_time_ns, return_counts=True)
        rows = thin(stamps, max(CLOUD_POINTS // int(counts.max()), 1))
        drawn = np.isin(stream.publish_time_ns, stamps[rows])
        columns = [stream.components.index(component) for component in PLANE]
        size = len(stream.components)
        places = stream["mean"][drawn].reshape(-1, size)[:, columns]
        weights = stream["weight"][drawn] * np.repeat(counts[rows], counts[rows])
        yield Cloud(name, stamps[rows], np.repeat(np.arange(len(rows)), counts[rows]), places, weights)


def draw_clouds(canvas: Canvas, scene: Scene, case: str, root: str) -> None:
    """Draw the particles of all estimators of a case; see `draw_cloud`."""
    for cloud in clouds_of(scene, case):
        draw_cloud(canvas, f"{root}/{cloud.estimator}/particles", cloud, scene.colour(cloud.estimator))


def draw_cloud(canvas: Canvas, entity: str, cloud: Cloud, colour: Colour) -> None:
    """Draw all particles of a stamp together; they are visible until the next stamp."""
    points = rr.Points2D.columns(
        positions=cloud.places.astype(np.float32), radii=-PARTICLE_PX * np.sqrt(cloud.weights)
    )
    counts = np.bincount(cloud.row, minlength=len(cloud.stamps))
    canvas.send(entity, cloud.stamps, points.partition(counts))
    canvas.fix(entity, rr.Points2D.from_fields(colors=[(*colour, 120)]))


def draw_polygons(
    canvas: Canvas,
    entity: str,
    time_ns: Times,
    sizes: NDArray[np.int64],
    polygons: Sequence[Floats],
    stroke: Stroke,
) -> None:
    """Draw closed polygons at each time.

    Args:
        canvas, entity, time_ns, stroke: as for `draw_dots`.
        sizes: (n,), number of polygons at each time; zero is an empty set, not a gap.
        polygons: polygons of all times one after another, (vertices, 2) in m, each without its closing
            vertex.
    """
    rows = thin(time_ns)
    first = np.cumsum(sizes) - sizes
    shown = [polygons[k] for row in rows for k in range(first[row], first[row] + sizes[row])]
    strips = [np.concatenate([ring, ring[:1]]).astype(np.float32) for ring in shown]
    times, counts = _until_stale(canvas, time_ns[rows], sizes[rows], gap_limit_ns(time_ns))
    if strips:
        canvas.send(entity, times, rr.LineStrips2D.columns(strips=strips).partition(counts))
    canvas.fix(entity, rr.LineStrips2D.from_fields(**stroke.fields()))


def draw_path(canvas: Canvas, entity: str, time_ns: Times, places: Floats, stroke: Stroke) -> None:
    """Draw the path of a point; each row is the segment from the previous position.

    Args:
        canvas, entity, time_ns, places, stroke: as for `draw_dots`.
    """
    segments = np.stack([places[:-1], places[1:]], axis=1).astype(np.float32)
    canvas.send(entity, time_ns[1:], rr.LineStrips2D.columns(strips=segments))
    canvas.fix(entity, rr.LineStrips2D.from_fields(**stroke.fields()))


def draw_way(canvas: Canvas, entity: str, places: Floats) -> None:
    """Draw the whole true path of a point as a faint line, including the part after the cursor.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        places: (n, 2), in m; unknown positions are NaN.
    """
    known = places[np.isfinite(places).all(axis=1)].astype(np.float32)
    style = Stroke(TRUTH).fields() | {"colors": [(*TRUTH, 70)], "draw_order": 0.0}
    canvas.fix(entity, rr.LineStrips2D([known], **style))


def draw_poses(
    canvas: Canvas, entity: str, time_ns: Times, poses: Floats, stroke: Stroke, length_m: float
) -> None:
    """Draw an arrow from each pose in the direction of the heading.

    Args:
        canvas, entity, time_ns, stroke: as for `draw_dots`.
        poses: (n, 3), x, y in m, heading in rad.
        length_m: length of the arrows in m.
    """
    times, sizes = _until_stale(canvas, time_ns, np.ones_like(time_ns), gap_limit_ns(time_ns))
    vectors = length_m * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    columns = rr.Arrows2D.columns(origins=poses[:, :2], vectors=vectors)
    canvas.send(entity, times, columns.partition(sizes))
    canvas.fix(entity, rr.Arrows2D.from_fields(**stroke.fields(widen=3.0)))


def draw_ellipses(
    canvas: Canvas, entity: str, time_ns: Times, means: Floats, covariances: Floats, stroke: Stroke
) -> None:
    """Draw the 95 % ellipse of each Gaussian.

    Args:
        canvas, entity, time_ns, stroke: as for `draw_dots`.
        means, covariances: (n, 2), (n, 2, 2).
    """
    draw_outlines(canvas, entity, time_ns, ellipses(means, covariances), stroke)


def draw_outlines(canvas: Canvas, entity: str, time_ns: Times, outlines: Floats, stroke: Stroke) -> None:
    """Draw the outline of an object at each time, closed or not.

    Args:
        canvas, entity, time_ns, stroke: as for `draw_dots`.
        outlines: (n, vertices, 2), in m; outlines with NaN are left out.
    """
    good = np.isfinite(outlines).all(axis=(1, 2))
    times, sizes = _until_stale(canvas, time_ns[good], np.ones(good.sum(), int), gap_limit_ns(time_ns))
    columns = rr.LineStrips2D.columns(strips=outlines[good].astype(np.float32))
    canvas.send(entity, times, columns.partition(sizes))
    canvas.fix(entity, rr.LineStrips2D.from_fields(**stroke.fields()))


def draw_lines(
    canvas: Canvas,
    entity: str,
    time_ns: Times,
    lines: Floats,
    colours: NDArray[np.uint8],
    radius_px: float = 0.75,
    interval_ns: float | None = None,
) -> None:
    """Draw all lines of one stamp together, as a scan.

    The next scan replaces the lines; if it is later than usual, they disappear before it arrives.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        time_ns: (n,), sorted.
        lines, colours: (n, points, 2) in m, (n, 4).
        radius_px: half of the lines' width in pixels; wide lines are drawn below narrow ones.
        interval_ns: usual time between scans; by default the median.
    """
    looks = np.unique(time_ns)
    looks = looks[thin(looks)]
    drawn = np.isin(time_ns, looks)
    counts = np.unique(time_ns[drawn], return_counts=True)[1]
    usual_ns = usual_interval_ns(looks) if interval_ns is None else interval_ns
    shown_ns = int(SHOWN_INTERVALS * usual_ns)
    times, sizes = _until_stale(canvas, looks, counts, shown_ns)
    columns = rr.LineStrips2D.columns(strips=lines[drawn].astype(np.float32), colors=colours[drawn])
    canvas.send(entity, times, columns.partition(sizes))
    style = rr.LineStrips2D.from_fields(
        radii=rr.Radius.ui_points(radius_px), draw_order=20.0 - radius_px
    )
    canvas.fix(entity, style)


def _until_stale(
    canvas: Canvas, time_ns: Times, sizes: NDArray[np.int64], shown_ns: int
) -> tuple[Times, NDArray[np.int64]]:
    """Return times and the number of objects at each, zero from `shown_ns` after the last object."""
    ends = time_ns + shown_ns
    gone = ends < np.append(time_ns[1:], canvas.end_ns)[: len(time_ns)]
    times = np.concatenate([time_ns, ends[gone]])
    order = np.argsort(times, kind="stable")
    return times[order], np.concatenate([sizes, np.zeros(gone.sum(), np.int64)])[order]


def plane_view(
    canvas: Canvas,
    root: str,
    others: list[str],
    paths: list[str],
    places: Floats,
    trail_s: float = TRAIL_S,
    *,
    name: str = "Map",
) -> rrb.Spatial2DView:
    """Make a view with a grid; the view contains the given positions.

    Args:
        canvas: the canvas.
        root, others: entities to show.
        paths: entities that are shown up to `trail_s` before the cursor.
        places: (n, 2), in m.
        trail_s: length of these trails in s.
        name: name of the view.
    """
    extent = extent_of(places)
    low, high = bounds_of(places)
    step_m = nice(extent / 10.0)
    _draw_grid(canvas, f"{root}/grid", low - extent, high + extent, step_m)
    trail = trail_of(canvas, trail_s)
    return rrb.Spatial2DView(
        origin="/",
        contents=[f"{escaped(each)}/**" for each in (root, *others)],
        name=f"{name}, grid {step_m:g} m",
        overrides={escaped(path): [trail] for path in paths},
        # the bounds are outside the transform that turns y up
        visual_bounds=rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1])),
    )


def bounds_of(places: Floats) -> tuple[Floats, Floats]:
    """Compute the lower left and upper right corner (2,) of a view of positions (n, 2), ignoring NaN."""
    known = places[np.isfinite(places).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else (np.zeros(2), np.zeros(2))
    margin = MARGIN * np.maximum(high - low, LEAST_SIDE * extent_of(known))
    return low - margin, high + margin


def with_legend(canvas: Canvas, name: str, colours: Mapping[str, Colour], board: Board) -> Board:
    """Return a panel with a legend above it, which is a row of coloured dots with names.

    Args:
        canvas: the canvas.
        name: name of the legend, unique in the layout.
        colours: colours by name; without colours, the panel is returned unchanged.
        board: the panel of a scene, or of several scenes with the same colours.
    """
    if not colours:
        return board
    at, row, left = [], 0, 0.0
    for label in colours:
        width = len(label) + LEGEND_GAP
        if left > 0.0 and left + width > LEGEND_CHARACTERS:
            row, left = row + 1, 0.0
        at.append((left + 0.5 * width, row * LEGEND_ROW))
        left += width
    radii = rr.Radius.ui_points(5.0)
    dots = rr.Points2D(at, labels=[*colours], colors=[*colours.values()], radii=radii, show_labels=True)
    entity = f"legend/{name}"
    canvas.fix(entity, dots)
    view = rrb.Spatial2DView(
        origin=escaped(entity),
        name=LEGEND,
        titlebar=False,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0.0, LEGEND_CHARACTERS), y_range=(-0.3 * LEGEND_ROW, (row + 0.7) * LEGEND_ROW)
        ),
    )
    return rrb.Vertical(view, board, row_shares=[LEGEND_SHARE * (row + 1), 1.0])


def trail_of(canvas: Canvas, trail_s: float) -> rrb.VisibleTimeRanges:
    """Return the time range of length `trail_s` that ends at the cursor, on every timeline."""
    steps = round(trail_s * 1e9 / max(usual_interval_ns(canvas.steps_ns), 1.0))
    cursor = rrb.TimeRangeBoundary.cursor_relative
    begin = cursor(seconds=-trail_s)
    return rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange("sim_time", start=begin, end=cursor()),
            rrb.VisibleTimeRange("utc", start=begin, end=cursor()),
            rrb.VisibleTimeRange("step", start=cursor(seq=-steps), end=cursor()),
        ]
    )


def extent_of(places: Floats) -> float:
    """Compute the longer side of the box around positions (n, 2), ignoring NaN; 1 if it is zero."""
    known = places[np.isfinite(places).all(axis=1)]
    return float(np.ptp(known, axis=0).max()) or 1.0 if len(known) else 1.0


def _draw_grid(canvas: Canvas, entity: str, low: Floats, high: Floats, step_m: float) -> None:
    lines = []
    for axis in range(2):
        at = step_m * np.arange(np.ceil(low[axis] / step_m), np.floor(high[axis] / step_m) + 1)
        ends = np.tile(np.stack([low, high]), (len(at), 1, 1))
        ends[:, :, axis] = at[:, None]
        lines.append(ends)
    radii = rr.Radius.ui_points(0.5)
    strips = rr.LineStrips2D(np.concatenate(lines), colors=[GRID], radii=radii, draw_order=-1.0)
    canvas.fix(entity, strips)


def draw_triads(
    canvas: Canvas,
    entity: str,
    time_ns: Times,
    quaternions: Floats,
    colours: Sequence[Colour],
    length: float,
    radius: float,
) -> None:
    """Draw the rotated axes x, y and z at each time.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        time_ns: (n,).
        quaternions: (n, 4), w first.
        colours: colours of x, y and z.
        length, radius: length and radius of the axes, in the unit of the scene.
    """
    turned = rr.Transform3D.columns(quaternion=np.roll(quaternions, -1, axis=1))
    canvas.send(entity, time_ns, turned)
    labels = [f"{entity.rpartition('/')[2]} {axis}" for axis in "xyz"]
    arrows = rr.Arrows3D(
        vectors=length * np.eye(3), colors=colours, radii=radius, labels=labels, show_labels=False
    )
    canvas.fix(f"{entity}/axes", arrows)


def space_view(root: str, name: str) -> rrb.Spatial3DView:
    """Return a view of triads around one origin, with x towards the camera."""
    return rrb.Spatial3DView(
        origin=escaped(root),
        name=name,
        eye_controls=rrb.EyeControls3D(
            position=(2.4, 1.4, 1.2), look_target=(0, 0, 0), eye_up=(0, 0, 1)
        ),
    )
