"""Scene of a body that moves and rotates in space: its path, its axes, and their uncertainty.

The scene is drawn for every estimate of a 3D position with an orientation, in any log. In long gaps
between fixes, the path is marked and the plots are shaded.
"""

from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.geodetic import in_plane, origins_of
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.timeline.drawing.canvas import (
    MUTED,
    PALETTE,
    TRUTH,
    WIDTH,
    WRONG,
    Canvas,
    Colour,
    Scene,
    Times,
    entity_path,
    escaped,
    nice,
    thin,
    thin_curve,
)
from fuselog.replay.timeline.drawing.events import gaps
from fuselog.replay.timeline.drawing.geodetic import POOR, QUALITIES, by_deviation
from fuselog.replay.timeline.drawing.plane import with_legend
from fuselog.replay.timeline.drawing.plots import LINE, SIGMAS, draw_curve, plot_view, shown_unit

PLACE = ("x_m", "y_m", "z_m")
ORIENTATION = tuple(f"orientation_{part}" for part in "wxyz")
VELOCITY = ("vx_mps", "vy_mps", "vz_mps")
ANGLES = ("roll", "pitch", "yaw")
# Components that are plotted in one view, by the beginning of their names.
BIASES = (("gyro_bias_", "Gyro bias"), ("accelerometer_bias_", "Accelerometer bias"))
FORWARD: tuple[Colour, ...] = ((230, 60, 40), (0, 158, 115), (0, 114, 178))
# Ellipsoids along a path, which overlap and form a tube: largest number, and distance relative to size.
TUBE, TUBE_STEP = 300, 0.5
# A tube thinner than this fraction of the scene is not drawn, because it would hide the path.
TUBE_SHARE = 0.005
# Brightness of the components of a vector if several bodies are plotted.
SHADES = (1.0, 0.75, 0.5)


class Body(NamedTuple):
    """Estimated or true states of a body.

    Attributes:
        width: width of its lines in pixels.
        time_ns: (n,).
        values: (n, components), in the order of `names`.
        deviations: (n, tangent components) standard deviations in the order of `tangent`; None for the
            truth.
        covariance: (n, 3, 3) of the position; None for the truth.
    """

    label: str
    colour: Colour
    width: float
    time_ns: Times
    names: list[str]
    values: Floats
    tangent: list[str]
    deviations: Floats | None
    covariance: Floats | None

    def columns(self, names: Sequence[str]) -> Floats:
        """Return the columns (n, k) of components."""
        return self.values[:, [self.names.index(name) for name in names]]


def draw_navigation(
    canvas: Canvas, scene: Scene, case: str, sensed: Sequence[Stream]
) -> list[rrb.Container]:
    """Draw a 3D scene and plots of the motion, if an estimate has a position and an orientation."""
    bodies = list(_bodies(scene, case))
    if all(body.deviations is None for body in bodies):
        return []
    fixes = list(_fixes_of(sensed))
    silent = [spans for _, stream in fixes for spans in [gaps(stream, canvas.end_ns)] if len(spans)]
    outages = np.concatenate([np.empty((0, 2), np.int64), *silent])
    root = entity_path("navigation", case)
    for name, stream in fixes:
        _draw_fixes(canvas, f"{root}/{name}", stream)
    for body in bodies:
        _draw_body(canvas, f"{root}/{body.label}", body, outages)
    plots = [_draw_group(canvas, case, bodies, *group, outages) for group in _groups(bodies)]
    colours = {body.label: body.colour for body in bodies} | _fix_colours(fixes)
    if len(outages):
        colours["without fixes"] = WRONG
    board = with_legend(canvas, root, colours, _space(root, bodies))
    return [rrb.Vertical(board, name="navigation"), rrb.Grid(*plots, grid_columns=2, name="motion")]


def _bodies(scene: Scene, case: str) -> Iterator[Body]:
    """Yield the truth if it has a 3D position, and all estimates that also have an orientation."""
    for truth in scene.truths_of(case):
        if set(PLACE) <= set(truth.components):
            known = np.isfinite(truth["state"]).all(axis=1)
            rows = np.flatnonzero(known)[thin(truth.publish_time_ns[known])]
            yield Body(
                "truth",
                TRUTH,
                2.0 * WIDTH,
                truth.publish_time_ns[rows],
                truth.components,
                truth["state"][rows],
                [],
                None,
                None,
            )
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        names = stream.components
        if not {*PLACE, *ORIENTATION} <= set(names):
            continue
        kinds = stream.metadata.get("kinds", "").split(",")
        tangent = [name for name, _ in tangent_components(names, kinds)]
        rows = thin(stream.publish_time_ns)
        rows = rows[np.isfinite(stream["mean"][rows]).all(axis=1)]
        covariance = stream["covariance"][rows].reshape(len(rows), len(tangent), len(tangent))
        place = [tangent.index(name) for name in PLACE]
        yield Body(
            estimator,
            scene.colour(estimator),
            scene.width(estimator),
            stream.publish_time_ns[rows],
            names,
            stream["mean"][rows],
            tangent,
            np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)),
            covariance[:, place][:, :, place],
        )


def _fixes_of(sensed: Sequence[Stream]) -> Iterator[tuple[str, Stream]]:
    """Yield fixes in the local tangent plane, including geodetic fixes if their origin is stated."""
    for stream in sensed:
        name = stream.topic.strip("/").replace("/", " ")
        schema = stream.schema.full_name
        if schema == schemas.POSITION_FIX.full_name and stream["position_m"].shape[1] == 3:
            yield name, stream
        elif schema == schemas.GEODETIC_FIX.full_name and "origin_latitude_deg" in stream.metadata:
            fixes = gather([stream])
            yield name, in_plane(fixes, origins_of(fixes)).stream


def _draw_fixes(canvas: Canvas, entity: str, stream: Stream) -> None:
    """Draw fixes as points, coloured by their stated standard deviations."""
    rows = thin(stream.publish_time_ns)
    place = stream["position_m"][rows].astype(np.float32)
    colours = by_deviation(stream["covariance_m2"][rows], MUTED)
    canvas.fix(entity, rr.Points3D(place, colors=colours, radii=rr.Radius.ui_points(2.0)))


def _fix_colours(fixes: Sequence[tuple[str, Stream]]) -> dict[str, Colour]:
    """Return the colours of fixes by name, for ranges of the stated standard deviation."""
    drawn = [by_deviation(stream["covariance_m2"], MUTED) for _, stream in fixes]
    found = {tuple(colour) for colours in drawn for colour in np.unique(colours, axis=0).tolist()}
    named = {f"fixes to {limit:g} m": colour for limit, colour in QUALITIES}
    named |= {f"fixes beyond {QUALITIES[-1][0]:g} m": POOR, "fixes": MUTED}
    return {name: colour for name, colour in named.items() if colour in found}


def _draw_body(canvas: Canvas, entity: str, body: Body, outages: Times) -> None:
    """Draw the whole path with its tube, red in gaps between fixes, and the axes at the cursor."""
    place, radii = body.columns(PLACE), rr.Radius.ui_points(body.width)
    canvas.fix(f"{entity}/path", rr.LineStrips3D([place], colors=[body.colour], radii=radii))
    if body.covariance is not None:
        _draw_tube(canvas, f"{entity}/tube", place, body.covariance, body.colour)
        inside = [
            place[(body.time_ns >= begin_ns) & (body.time_ns <= end_ns)] for begin_ns, end_ns in outages
        ]
        strips = [strip for strip in inside if len(strip) > 1]
        if strips:
            marked = rr.LineStrips3D(strips, colors=[WRONG], radii=rr.Radius.ui_points(3.0))
            canvas.fix(f"{entity}/without_fixes", marked)
    if set(ORIENTATION) <= set(body.names):
        turned = rr.Transform3D.columns(
            translation=place, quaternion=np.roll(body.columns(ORIENTATION), -1, axis=1)
        )
        canvas.send(f"{entity}/body", body.time_ns, turned)
        length_m = _extent(place) / (15.0 if body.covariance is None else 12.0)
        axes = rr.Arrows3D(vectors=length_m * np.eye(3), colors=FORWARD, radii=0.03 * length_m)
        canvas.fix(f"{entity}/body/axes", axes)


def _draw_tube(canvas: Canvas, entity: str, place: Floats, covariance: Floats, colour: Colour) -> None:
    """Draw ellipsoids of two standard deviations along the path, if they are wider than its line.

    The ellipsoids are wireframes, because the camera may be inside one.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    rows = np.unique(np.linspace(0, len(place) - 1, min(TUBE, len(place))).astype(int))
    reach = SIGMAS * np.sqrt(np.linalg.eigvalsh(covariance[rows])[:, -1].clip(0.0))
    kept = [0]
    for row, here in enumerate(place[rows]):
        if np.linalg.norm(here - place[rows[kept[-1]]]) > TUBE_STEP * reach[kept[-1]]:
            kept.append(row)
    rows = rows[kept]
    rows = rows[reach[kept] > TUBE_SHARE * _extent(place)]
    values, vectors = np.linalg.eigh(covariance[rows])
    vectors[np.linalg.det(vectors) < 0, :, 0] *= -1.0  # a rotation, not a reflection
    canvas.fix(
        entity,
        rr.Ellipsoids3D(
            centers=place[rows],
            half_sizes=SIGMAS * np.sqrt(np.maximum(values, 0.0)),
            quaternions=Rotation.from_matrix(vectors).as_quat(),
            colors=[colour],
            line_radii=rr.Radius.ui_points(0.3),
            fill_mode="majorwireframe",
        ),
    )


def _extent(place: Floats) -> float:
    return max(float(np.ptp(place, axis=0).max()), 1.0)


def _space(root: str, bodies: Sequence[Body]) -> rrb.Spatial3DView:
    """Return a view of the scene from the south-west and above."""
    place = np.concatenate([body.columns(PLACE) for body in bodies])
    centre, extent = 0.5 * (place.min(axis=0) + place.max(axis=0)), _extent(place)
    return rrb.Spatial3DView(
        origin=escaped(root),
        name=f"Scene, tubes of {SIGMAS:g} sigma",
        eye_controls=rrb.EyeControls3D(
            position=centre + extent * np.array([-0.5, -1.0, 0.75]), look_target=centre, eye_up=(0, 0, 1)
        ),
    )


def _groups(bodies: Sequence[Body]) -> Iterator[tuple[str, str, str, list[str]]]:
    """Yield the name, title, unit and components of each plot."""
    names = dict.fromkeys(name for body in bodies for name in body.names)
    if set(VELOCITY) <= set(names):
        yield "velocity", "Velocity", "m/s", list(VELOCITY)
    yield "attitude", "Attitude", "deg", list(ANGLES)
    for stem, title in BIASES:
        own = [name for name in names if name.startswith(stem)]
        if own:
            yield f"{stem}plot".removesuffix("_plot"), title, shown_unit(own[0])[1], own


def _draw_group(
    canvas: Canvas,
    case: str,
    bodies: Sequence[Body],
    name: str,
    title: str,
    unit: str,
    components: Sequence[str],
    outages: Times,
) -> rrb.TimeSeriesView:
    """Plot components of all bodies, with bands for biases and shades in gaps between fixes."""
    plot, largest = entity_path("plots", case, "motion", name), 0.0
    for body in bodies:
        shades = [_shaded(body.colour, share) for share in SHADES]
        colours = cycle(PALETTE if len(bodies) == 1 else shades)
        for component, colour in zip(components, colours, strict=False):
            found = _curve(body, component)
            if found is None:
                continue
            values, deviation = found
            label = component if len(bodies) == 1 else f"{component} {body.label}"
            if deviation is not None and "bias" in name:
                _draw_band(canvas, f"{plot}/{label}_band", body.time_ns, values, deviation, colour)
            draw_curve(canvas, plot, label, colour, body.time_ns, values, LINE)
            largest = max(largest, float(np.quantile(np.abs(values), 0.995)))
    extent = nice(1.2 * max(largest, np.finfo(float).tiny))
    _draw_shades(canvas, f"{plot}/without_fixes", outages, extent)
    return plot_view(plot, title, unit, (-extent, extent))


def _shaded(colour: Colour, share: float) -> Colour:
    red, green, blue = (round(share * part) for part in colour)
    return red, green, blue


def _curve(body: Body, component: str) -> tuple[Floats, Floats | None] | None:
    """Return values (n,) and sigmas (n,) of a component in the displayed unit; None if missing."""
    if component in ANGLES:
        if not set(ORIENTATION) <= set(body.names):
            return None
        return euler_deg(body.columns(ORIENTATION))[:, ANGLES.index(component)], None
    if component not in body.names:
        return None
    scale = shown_unit(component)[2]
    values = scale * body.values[:, body.names.index(component)]
    if body.deviations is None:
        return values, None
    return values, scale * body.deviations[:, body.tangent.index(component)]


def euler_deg(quaternions: Floats) -> Floats:
    """Convert quaternions to roll, pitch and yaw (n, 3) in deg (about x, y and z); NaN if invalid."""
    from scipy.spatial.transform import Rotation  # slow to import

    angles = np.full((len(quaternions), 3), np.nan)
    known = np.linalg.norm(quaternions, axis=1) > 0.0
    turned = Rotation.from_quat(quaternions[known], scalar_first=True)
    angles[known] = turned.as_euler("ZYX", degrees=True)[:, ::-1]
    return angles


def _draw_band(
    canvas: Canvas, entity: str, time_ns: Times, values: Floats, deviation: Floats, colour: Colour
) -> None:
    rows = thin_curve(time_ns, values)
    columns = rr.Measurements.columns(values=values[rows], variances=(SIGMAS * deviation[rows]) ** 2)
    canvas.send(entity, time_ns[rows], columns)
    name = entity.rpartition("/")[2]
    canvas.fix(entity, rr.Measurements.from_fields(names=[name], colors=[(*colour, 90)], widths=[0.0]))


def _draw_shades(canvas: Canvas, entity: str, outages: Times, extent: float) -> None:
    """Shade the whole height of a plot in gaps between fixes."""
    if not len(outages):
        return
    # a NaN after each outage ends its shade
    time_ns = np.concatenate([outages, outages[:, 1:] + 1], axis=1).ravel()
    values = np.tile([0.0, 0.0, np.nan], len(outages))
    variances = np.tile([extent**2, extent**2, np.nan], len(outages))
    canvas.send(entity, time_ns, rr.Measurements.columns(values=values, variances=variances))
    canvas.fix(
        entity,
        rr.Measurements.from_fields(names=["without fixes"], colors=[(*WRONG, 60)], widths=[0.0]),
    )
