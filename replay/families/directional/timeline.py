"""Timelines of directional scenarios: densities of headings and axes, and triads of orientations.

The errors in degrees, with their bounds, are to the right of each view, as in all timelines.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.components import ImageFormat

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.families.directional.distributions import bingham, wrapped_normal
from fuselog.replay.families.directional.distributions.wrapped_normal import WrappedNormal
from fuselog.replay.families.directional.disturbances import COMPONENTS, disturbances
from fuselog.replay.families.directional.grid import torus_grid
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import (
    TRUTH,
    WIDTH,
    Board,
    Canvas,
    Colour,
    Scene,
    Timeline,
    Times,
    beside,
    draw_cases,
    entity_path,
    escaped,
    thin,
)
from fuselog.replay.timeline.drawing.events import Happened, above_events, draw_events
from fuselog.replay.timeline.drawing.plane import GRID, Stroke, draw_triads, space_view, with_legend
from fuselog.replay.timeline.drawing.plots import draw_quality

QUATERNION = COMPONENTS[:4]
# Images and outlines are large, so fewer of them are drawn.
PICTURES = 500
CELLS = 96
OUTLINE_POINTS = 145
MEASURED: Colour = (240, 228, 66)
SAMPLES: Colour = (140, 230, 120)
# The radius of an estimate on the torus.
DOT_PX = 6.0
AXES: tuple[Colour, Colour, Colour] = ((230, 60, 60), (80, 200, 80), (80, 120, 240))


class Track(NamedTuple):
    """States (n, d) of truth or an estimator, with covariances (n, t, t) if available."""

    name: str
    colour: Colour
    time_ns: Times
    states: Floats
    covariances: Floats | None


def _tracks(scene: Scene, case: str, width: int, rows: int) -> Iterator[Track]:
    """Yield the truth, then every estimate with `width` components, thinned for drawing."""
    for stream in scene.truths_of(case):
        if stream["state"].shape[1] == width:
            yield _track("truth", TRUTH, stream, "state", rows)
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        if stream["mean"].shape[1] == width:
            yield _track(estimator, scene.colour(estimator), stream, "mean", rows)
        elif width == 4 and set(QUATERNION) <= set(stream.components):
            found = _track(estimator, scene.colour(estimator), stream, "mean", rows)
            places = [stream.components.index(name) for name in QUATERNION]
            yield found._replace(states=found.states[:, places], covariances=None)


def _track(name: str, colour: Colour, stream: Stream, field: str, rows: int) -> Track:
    kept = thin(stream.publish_time_ns, rows)
    kept = kept[np.isfinite(stream[field][kept]).all(axis=1)]
    covariances = None
    if "covariance" in stream.columns:
        size = round(stream["covariance"].shape[1] ** 0.5)
        covariances = stream["covariance"][kept].reshape(-1, size, size)
    return Track(name, colour, stream.publish_time_ns[kept], stream[field][kept], covariances)


def _draw_with(
    board: Callable[[Canvas, Scene, str], Board], canvas: Canvas, scene: Scene
) -> rrb.Container | rrb.View:
    """Draw a panel above the events of each case, with the errors next to it."""

    def draw_case(case: str) -> rrb.Container:
        left = above_events(
            board(canvas, scene, case), draw_events(canvas, scene, case, also=_disturbed(scene, case))
        )
        return beside(left, draw_quality(canvas, scene, case), case)

    return draw_cases(scene, draw_case)


def _disturbed(scene: Scene, case: str) -> Iterator[Happened]:
    """Yield spans in which estimators of the local magnetic field find a disturbance."""
    topic = f"/{case}/inertial".replace("//", "/")
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        if topic in scene.source.topics and set(COMPONENTS) <= set(stream.components):
            found = disturbances(scene.read(topic), stream)
            lasted_s = (found.end_ns - found.begin_ns) * 1e-9
            texts = [
                f"magnetic field disturbed for {seconds:.0f} s, by up to {largest_ut:.0f} uT"
                for seconds, largest_ut in zip(lasted_s, found.largest_ut, strict=True)
            ]
            yield Happened(estimator, "WARN", found.begin_ns, texts)


def _draw_orientation(canvas: Canvas, scene: Scene, case: str) -> rrb.View:
    """Draw triads: red, green and blue for the truth; longer and in one colour for each estimate."""
    root = entity_path("space", case)
    for number, track in enumerate(_tracks(scene, case, 4, 5000)):
        is_truth = track.name == "truth"
        colours = AXES if is_truth else [track.colour] * 3
        radius = 0.025 if is_truth else 0.012
        turned = (track.time_ns, track.states)
        draw_triads(canvas, f"{root}/{track.name}", *turned, colours, 1.0 + 0.1 * number, radius)
    return space_view(root, "Orientation: truth in red, green, blue")


def _draw_axis(canvas: Canvas, scene: Scene, case: str) -> rrb.View:
    """Draw the density of each estimate around a circle; truth and measurement are lines across it."""
    root = entity_path("axis", case)
    canvas.fix(root, rr.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])))
    angle = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    canvas.fix(f"{root}/circle", rr.LineStrips2D([around], colors=[(70, 70, 70)]))
    for track in _tracks(scene, case, 2, PICTURES):
        entity = f"{root}/{track.name}"
        if track.covariances is None:
            _draw_lines(canvas, entity, track.time_ns, 1.3 * track.states, track.colour, 3.0)
            continue
        sine = np.clip(track.covariances[:, 0, 0], 1e-6, 0.4999)
        moments = np.stack([sine, 1.0 - sine], axis=-1)[..., None] * np.eye(2)
        local = bingham.fit(moments)
        relative = np.arctan2(track.states[:, 1], track.states[:, 0])[:, None] - angle
        log_density = local.concentrations[:, :1] * np.sin(relative) ** 2
        outline = (0.3 + 0.7 * np.exp(log_density))[..., None] * around
        _draw_strips(canvas, entity, track.time_ns, outline, track.colour, 1.5)
    if "/axis" in scene.source.topics:
        stream = scene.read("/axis")
        kept = thin(stream.publish_time_ns, PICTURES)
        seen = (stream.publish_time_ns[kept], 1.15 * stream["axis"][kept])
        _draw_lines(canvas, f"{root}/measurement", *seen, MEASURED, 1.0)
    bounds = rrb.VisualBounds2D(x_range=(-1.4, 1.4), y_range=(-1.4, 1.4))
    name = "Axis: truth grey, measurement yellow, densities"
    return rrb.Spatial2DView(origin=escaped(root), name=name, visual_bounds=bounds)


def _draw_lines(
    canvas: Canvas, entity: str, time_ns: Times, ends: Floats, colour: Colour, radius_px: float
) -> None:
    """Draw a line from -end to end for each row of ends (n, 2)."""
    _draw_strips(canvas, entity, time_ns, np.stack([-ends, ends], axis=1), colour, radius_px)


def _draw_strips(
    canvas: Canvas, entity: str, time_ns: Times, strips: Floats, colour: Colour, radius_px: float
) -> None:
    """Draw one line strip (points, 2) per row of strips (n, points, 2)."""
    canvas.send(entity, time_ns, rr.LineStrips2D.columns(strips=list(strips.astype(np.float32))))
    radii = rr.Radius.ui_points(radius_px)
    canvas.fix(entity, rr.LineStrips2D.from_fields(colors=[colour], radii=radii))


def _draw_torus(canvas: Canvas, scene: Scene, case: str) -> Board:
    """Draw the first estimator's density as a heat map, with its five samples sized by weight.

    The other estimates, the truth and the measurements are points. Heading 1 increases to the right and
    heading 2 upwards, from -pi to pi.
    """
    root = entity_path("torus", case)
    tracks = list(_tracks(scene, case, 2, PICTURES))
    mapped = ""
    for track in tracks:
        if track.covariances is not None and not mapped:
            mapped = track.name
            _draw_density(canvas, root, track)
        larger = 1.0 if track.name == "truth" else scene.width(track.name) / WIDTH
        radius_px = DOT_PX * larger
        _draw_dots(canvas, f"{root}/{track.name}", track.time_ns, track.states, track.colour, radius_px)
    if "/headings" in scene.source.topics:
        stream = scene.read("/headings")
        kept = thin(stream.publish_time_ns, PICTURES)
        seen = (stream.publish_time_ns[kept], stream["value"][kept])
        _draw_dots(canvas, f"{root}/measurement", *seen, MEASURED, 4.0)
    _draw_ticks(canvas, f"{root}/ticks")
    bounds = rrb.VisualBounds2D(
        x_range=(-0.12 * CELLS, 1.04 * CELLS), y_range=(-0.04 * CELLS, 1.12 * CELLS)
    )
    name = f"Heading 2 (deg) over heading 1 (deg); density and samples of {mapped or 'none'}"
    view = rrb.Spatial2DView(origin=escaped(root), name=name, visual_bounds=bounds)
    colours = scene.colours(case) | {"measured": MEASURED} | ({"samples": SAMPLES} if mapped else {})
    return with_legend(canvas, root, colours, view)


def _draw_ticks(canvas: Canvas, entity: str) -> None:
    """Draw grid lines at quarters of both headings, labelled in degrees."""
    share, ends = np.linspace(0.0, 1.0, 5), np.array([0.0, CELLS])
    across = [np.stack([ends, np.full(2, at)], axis=1) for at in CELLS * (1.0 - share)]
    lines = [*across, *(line[:, ::-1] for line in across)]
    style = Stroke(GRID).fields()
    canvas.fix(entity, rr.LineStrips2D(lines, **style))
    beside, below = np.full(5, -0.06 * CELLS), np.full(5, 1.05 * CELLS)
    at = np.concatenate(
        [np.stack([beside, CELLS * (1.0 - share)], axis=1), np.stack([CELLS * share, below], axis=1)]
    )
    labels = [f"{degrees:g}°" for degrees in 360.0 * share - 180.0] * 2
    canvas.fix(
        f"{entity}/numbers", rr.Points2D(at, labels=labels, colors=[TRUTH], radii=0.0, show_labels=True)
    )


def _draw_density(canvas: Canvas, root: str, track: Track) -> None:
    import matplotlib as mpl  # slow to import

    assert track.covariances is not None
    usable = np.linalg.eigvalsh(track.covariances)[:, 0] > 0.0
    time_ns = track.time_ns[usable]
    found = WrappedNormal(track.states[usable], track.covariances[usable])
    grid = np.swapaxes(torus_grid(CELLS), 0, 1)[::-1].reshape(-1, 2)
    colours = mpl.colormaps["magma"]
    pictures = []
    for mean, covariance in zip(*found, strict=True):
        density = wrapped_normal.density(WrappedNormal(mean, covariance), grid)
        peak = max(density.max(), np.finfo(float).tiny)  # zero if the peak is between the cells
        shown = colours(density / peak, bytes=True)[:, :3]
        pictures.append(np.ascontiguousarray(shown).ravel())
    image = ImageFormat(
        width=CELLS, height=CELLS, color_model=rr.ColorModel.RGB, channel_datatype=rr.ChannelDatatype.U8
    )
    columns = rr.Image.columns(buffer=pictures, format=[image] * len(pictures))
    canvas.send(f"{root}/density", time_ns, columns)
    samples = wrapped_normal.five_samples(wrapped_normal.circular_moments(found))
    spots = _on_map(samples.positions.reshape(-1, 2))
    radii = 1.5 * np.sqrt(samples.weights / 0.2).ravel()
    points = rr.Points2D.columns(positions=spots, radii=radii)
    canvas.send(f"{root}/samples", time_ns, points.partition([5] * len(time_ns)))
    canvas.fix(f"{root}/samples", rr.Points2D.from_fields(colors=[SAMPLES], draw_order=30.0))


def _draw_dots(
    canvas: Canvas, entity: str, time_ns: Times, headings: Floats, colour: Colour, radius_px: float
) -> None:
    if not len(headings):
        return
    canvas.send(entity, time_ns, rr.Points2D.columns(positions=_on_map(headings)))
    radii = rr.Radius.ui_points(radius_px)
    canvas.fix(
        entity, rr.Points2D.from_fields(colors=[colour], radii=radii, draw_order=50.0 - radius_px)
    )


def _on_map(headings_rad: Floats) -> Floats:
    """Convert headings (n, 2) to positions in the picture, in cells: x to the right, y down."""
    share = (headings_rad + np.pi) / (2.0 * np.pi) % 1.0
    return CELLS * np.stack([share[:, 0], 1.0 - share[:, 1]], axis=-1)


ORIENTATION = Timeline(partial(_draw_with, _draw_orientation))
AXIS = Timeline(partial(_draw_with, _draw_axis))
TORUS = Timeline(partial(_draw_with, _draw_torus))
