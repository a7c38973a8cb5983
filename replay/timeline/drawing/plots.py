"""Plots for every family: components, errors with bands, NEES and NIS with bounds.

Every function sends its columns and returns the views that show them. A band is Rerun's `Measurements`,
which draws one standard deviation: a band of k sigma is sent with k^2 times the variance.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import compress, cycle
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.log import schemas
from fuselog.recorders.units import parted, written
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import Errors, Floats, chi_square_interval, innovations_of
from fuselog.replay.timeline.drawing.canvas import (
    DRAWN_ROWS,
    MUTED,
    PALETTE,
    TRUTH,
    WIDTH,
    Board,
    Canvas,
    Colour,
    Scene,
    Times,
    entity_path,
    escaped,
    nice,
    strips_of,
    thin,
    thin_curve,
    thin_scatter,
)
from fuselog.replay.timeline.drawing.plane import (
    TRUE,
    Stroke,
    draw_dots,
    draw_outlines,
    plane_view,
    stroke_of,
    turn_up,
)

SIGMAS = 2.0
_AXES = ("w", "x", "y", "z", "vx", "vy", "vz", "yaw", "pitch", "roll")
_TITLES = {"NEES": "NEES of this run,", "NIS": "NIS of"}
# Largest number of plots below each other, and largest number in one tab.
MOST_STRIPS, TAB_STRIPS = 6, 4
# Height of a legend as a fraction of a plot: constant part, part per entry, and maximum.
LEGEND_MARGIN, LEGEND_ENTRY, LEGEND_MOST = 0.1, 0.1, 0.6
# The same in the smaller panels of NEES and NIS.
SMALL_ENTRY, SMALL_MOST = 0.15, 0.7
# An error plot lists the estimators with more than this fraction of errors outside its range.
SILENT_SHARE = 0.01
# Upper end of plots of shares and probabilities, which leaves room for their legends.
SHARES = 1.5
WHOLE_RUN = rrb.TimeAxis(
    view_range=rr.TimeRange(rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite())
)
Style = Callable[..., rr.AsComponents]

# Height of a line of text below the ellipses, as a fraction of the height of the picture.
LINE_SHARE = 0.1


def line(width: float) -> Style:
    """Return the style of a curve as a line of a width in pixels."""
    return partial(rr.SeriesLines, widths=[width])


def dots(size: float) -> Style:
    """Return the style of a curve as points of a size in pixels."""
    return partial(rr.SeriesPoints, marker_sizes=[size])


LINE, POINTS, SINGLE = line(WIDTH), dots(WIDTH), dots(5.0)


class Squares(NamedTuple):
    """Chi-square values of an estimator with their degrees of freedom, and names of the components.

    `of`, the names, is empty if the degrees of freedom are a sufficient description.
    """

    degrees: int
    of: str
    estimator: str
    time_ns: Times
    values: Floats


def draw_quality(canvas: Canvas, scene: Scene, case: str, *, legend: bool = True) -> list[Board]:
    """Draw NEES, errors, NIS and effective particles of a case, at most `MOST_STRIPS` at a time.

    If there are more plots, errors are in tabs by quantity; if there are still too many, the other plots
    are in tabs too. Single estimates in the plane are first shown in a close-up, because their plots
    over time are single points. If there are no errors and no innovations, there are no plots. `legend`
    is False if a scene has its own legend.
    """
    errors = draw_errors(canvas, scene, case)
    nees = draw_nees(canvas, scene, case, legend=legend)
    nis = draw_nis(canvas, scene, case, legend=legend)
    particles = draw_effective(canvas, scene, case)
    strips: list[Board] = [*nees, *errors.values(), *nis, *particles]
    if len(strips) > MOST_STRIPS:
        in_tabs = [_tabs(_by_quantity(errors), TAB_STRIPS)] if errors else []
        room = MOST_STRIPS - sum(strips_of(each) for each in in_tabs)
        strips = [*nees, *in_tabs, *nis, *particles]
        if len(nees) + len(nis) + len(particles) > room:
            strips = [_tabs({"NEES": nees, "NIS": nis, "particles": particles}, room), *in_tabs]
    close_up = draw_close_up(canvas, scene, case)
    if close_up is None:
        return strips
    shares = [float(strips_of(each)) for each in strips]
    return [rrb.Tabs(close_up, rrb.Vertical(*strips, name="over time", row_shares=shares))]


def in_strips(views: Mapping[str, rrb.View], name: str) -> rrb.Container:
    """Return views of components below each other, or in tabs by quantity if there are too many."""
    if len(views) <= MOST_STRIPS:
        return rrb.Vertical(*views.values(), name=name)
    return _tabs(_by_quantity(views), TAB_STRIPS, name)


def _tabs(groups: Mapping[str, Sequence[rrb.View]], most: int, name: str | None = None) -> rrb.Tabs:
    """Return one tab for each group, or several tabs if a group has more than `most` strips."""
    return rrb.Tabs(
        *(
            rrb.Vertical(*views[first : first + most], name=title)
            for title, views in groups.items()
            for first in range(0, len(views), most)
        ),
        name=name,
    )


def _by_quantity(views: Mapping[str, rrb.View]) -> dict[str, list[rrb.View]]:
    """Group views into tabs: axes of a vector together, and at most `TAB_STRIPS` other components."""
    groups: dict[str, list[rrb.View]] = {}
    for component, view in views.items():
        groups.setdefault(_vector_of(component), []).append(view)
    tabs: list[tuple[list[str], list[rrb.View]]] = []
    for name, own in groups.items():
        is_number = len(own) == 1 and bool(tabs) and len(tabs[-1][0]) == len(tabs[-1][1]) < TAB_STRIPS
        if is_number:
            tabs[-1] = ([*tabs[-1][0], name], [*tabs[-1][1], *own])
        else:
            tabs.append(([name], own))
    return {
        ", ".join(names) if len(names) < 3 else f"{names[0]} to {names[-1]}": own for names, own in tabs
    }


def _vector_of(component: str) -> str:
    """Return the vector quantity to which a component belongs, such as the position or the gyro bias."""
    quantity, unit, _ = shown_unit(component)
    words = quantity.split()
    kept = [word for word in words if word not in _AXES]
    if {"vx", "vy", "vz"} & {*words}:
        return " ".join([*kept, "velocity"])
    if len(kept) < len(words) and unit == "m":
        return " ".join([*kept, "size" if kept[-1:] == ["half"] else "position"])
    return " ".join(kept) or quantity


def draw_errors(canvas: Canvas, scene: Scene, case: str) -> dict[str, rrb.TimeSeriesView]:
    """Draw a plot for each component of a case: the error of each estimator in its band of ±2 sigma."""
    found = scene.errors_of(case)
    components = dict.fromkeys(name for errors in found for name in errors.components)
    return {
        name: _draw_error(canvas, scene, case, name, [each for each in found if name in each.components])
        for name in components
    }


def _draw_error(
    canvas: Canvas, scene: Scene, case: str, component: str, found: Sequence[Errors]
) -> rrb.TimeSeriesView:
    quantity, unit, scale = shown_unit(component)
    plot = entity_path("plots", case, f"error_{component}")
    extents, judged, outside = [], [], []
    for errors in found:
        column = errors.components.index(component)
        rows = thin_curve(errors.time_ns, errors.error[:, column])
        error = scale * errors.error[rows, column]
        bound = scale * SIGMAS * np.sqrt(np.maximum(errors.covariance[rows, column, column], 0.0))
        extents.append(float(np.quantile(np.maximum(np.abs(error), bound), 0.99)))
        judged.append(errors.is_bound or _is_credible(errors))
        zero = np.zeros(len(rows))
        entity, colour = f"{plot}/{errors.estimator}", scene.colour(errors.estimator)
        if len(rows) == 1:
            _draw_point(canvas, entity, errors, colour, float(error[0]), float(bound[0]))
            continue
        columns = rr.Measurements.columns(
            values=np.stack([error, zero], axis=1).ravel(),
            variances=np.stack([zero, bound**2], axis=1).ravel(),
        )
        canvas.send(entity, errors.time_ns[rows], columns.partition([2] * len(rows)))
        names = [errors.estimator, f"{errors.estimator} band"]
        style = rr.Measurements.from_fields(
            names=names, colors=[colour, (*colour, 150)], widths=[scene.width(errors.estimator), 0.0]
        )
        canvas.fix(entity, style)
    # the most accurate estimator with a credible NEES determines the range, otherwise the most accurate
    # of all
    credible = list(compress(extents, judged)) or extents
    extent = nice(1.2 * max(min(credible), np.finfo(float).tiny))
    for errors in found:
        beyond = np.abs(scale * errors.error[:, errors.components.index(component)]) > extent
        if np.mean(beyond) > SILENT_SHARE:
            outside.append(f"{errors.estimator} {np.count_nonzero(beyond)} of {len(beyond)}")
    note = f", axis to ±{extent:g}, bands ±{SIGMAS:g} sigma"
    note += f"; outside: {', '.join(outside)}" if outside and not canvas.is_shared else ""
    return plot_view(plot, f"Error of {quantity}", unit, (-extent, extent), note=note, legend=False)


def _is_credible(errors: Errors) -> bool:
    """Test whether the median NEES of a run is below the 95 % bound of consistent estimators."""
    high = chi_square_interval(len(errors.components), 1)[1]
    known = errors.nees[np.isfinite(errors.nees)]
    return bool(len(known)) and float(np.median(known)) <= high


def _draw_point(
    canvas: Canvas, entity: str, errors: Errors, colour: Colour, error: float, bound: float
) -> None:
    """Draw the error of a single estimate as a point between the ends of its band."""
    marks = rr.Scalars.columns(scalars=[error, -bound, bound])
    canvas.send(entity, errors.time_ns, marks.partition([3]))
    names = [errors.estimator, *(f"{errors.estimator} band" for _ in range(2))]
    style = rr.SeriesPoints(
        names=names, colors=[colour] * 3, markers=["Circle", "Up", "Down"], marker_sizes=[5.0, 4.0, 4.0]
    )
    canvas.fix(entity, style)


def draw_nees(
    canvas: Canvas, scene: Scene, case: str, *, legend: bool = True
) -> list[rrb.TimeSeriesView]:
    """Draw the NEES of each estimator with the bounds of a run, in one plot per number of components."""
    found = [
        Squares(len(errors.components), "", errors.estimator, errors.time_ns, errors.nees)
        for errors in scene.errors_of(case)
        if not errors.is_bound
    ]
    return _draw_squares(canvas, scene, case, "NEES", found, legend=legend)


def draw_nis(
    canvas: Canvas, scene: Scene, case: str, *, legend: bool = True
) -> list[rrb.TimeSeriesView]:
    """Draw the NIS of each estimator as points, in one plot per set of measured components."""
    found = []
    for estimator, stream in scene.outputs_of(case, schemas.INNOVATION):
        innovations = innovations_of(gather([stream]))
        patterns, of_pattern = np.unique(np.isfinite(stream["innovation"]), axis=0, return_inverse=True)
        degrees = patterns.sum(axis=1)
        for number in np.flatnonzero(degrees > 0).tolist():
            rows, own = of_pattern.ravel() == number, int(degrees[number])
            is_named = len(stream.components) == patterns.shape[1]
            alike = np.count_nonzero(degrees == own) > 1
            of = ", ".join(compress(stream.components, patterns[number])) if is_named and alike else ""
            squares = innovations.time_ns[rows], innovations.squared[rows]
            found.append(Squares(own, of, estimator, *squares))
    return _draw_squares(canvas, scene, case, "NIS", found, scatter=True, legend=legend)


def _draw_squares(
    canvas: Canvas,
    scene: Scene,
    case: str,
    name: str,
    found: Sequence[Squares],
    *,
    scatter: bool = False,
    legend: bool = True,
) -> list[rrb.TimeSeriesView]:
    """Draw chi-square values of one run, as lines or points, and the 95 % band of consistent estimators.

    Values above the panel are marked at its upper edge and counted in its title. The panel ends above
    the band or, if most values of all estimators are above the band, above the values of the best
    estimator.
    """
    views = []
    for degrees, of in sorted({(each.degrees, each.of) for each in found}):
        plot = entity_path("plots", case, f"{name.lower()}_{degrees}{of and '_' + of.partition(',')[0]}")
        low, high = chi_square_interval(degrees, 1)
        alike = [each for each in found if (each.degrees, each.of) == (degrees, of)]
        ends = [min(each.time_ns[0] for each in alike), max(each.time_ns[-1] for each in alike)]
        band = rr.Measurements.columns(
            values=[0.5 * (low + high)] * 2, variances=[0.25 * (high - low) ** 2] * 2
        )
        grey = rr.Measurements.from_fields(names=["95 %"], colors=[MUTED], widths=[0.0])
        canvas.send(f"{plot}/bounds", np.array(ends), band)
        canvas.fix(f"{plot}/bounds", grey)
        end = _end_of(high, [each.values for each in alike])
        counted = []
        for _, _, estimator, time_ns, values in alike:
            colour = scene.colour(estimator)
            width = scene.width(estimator)
            look = dots(0.5 * (WIDTH + width)) if scatter else line(width)
            rows = thin_scatter(len(values)) if scatter else np.arange(len(values))
            draw_curve(canvas, plot, estimator, colour, time_ns[rows], values[rows], look)
            above = values > end
            if above.any():
                _mark_above(canvas, plot, estimator, colour, time_ns[above], end)
                counted.append(f"{estimator} {np.count_nonzero(above)} of {len(values)}")
        is_counted = counted and not canvas.is_shared
        note = f"; above {end:.3g}: {', '.join(counted)}" if is_counted else ""
        note += f"; 95 % within {low:.3g} to {high:.3g}" if high < 0.2 * end or not legend else ""
        title = f"{_TITLES[name]} {of or f'{degrees} component' + 's' * (degrees != 1)}"
        extent, locked = (-0.1 * end, end), not counted
        views.append(plot_view(plot, title, "-", extent, note=note, legend=legend, zoom_lock=locked))
    return views


def _end_of(high: float, values: Sequence[Floats]) -> float:
    """Compute the upper end of a panel of chi-square values whose band ends at `high`."""
    room = min(LEGEND_MARGIN + SMALL_ENTRY * (1 + len(values)), SMALL_MOST)
    medians = [np.median(each[np.isfinite(each)]) for each in values if np.isfinite(each).any()]
    if not medians or min(medians) <= high:
        return high * max(2.5, 1.05 / (1.0 - room))
    best = values[int(np.argmin(medians))]
    return nice(max(float(np.quantile(best[np.isfinite(best)], 0.99)), high) / (1.0 - room))


def _mark_above(
    canvas: Canvas, plot: str, name: str, colour: Colour, time_ns: Times, end: float
) -> None:
    """Mark, at the upper edge of a panel, the times of values above it."""
    rows = thin(time_ns)
    edge = rr.Scalars.columns(scalars=np.full(len(rows), 0.98 * end))
    canvas.send(f"{plot}/{name} above", time_ns[rows], edge)
    marks = rr.SeriesPoints(names=[name], colors=[colour], markers=["Up"], marker_sizes=[4.0])
    canvas.fix(f"{plot}/{name} above", marks)


def draw_modes(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """Draw the probabilities of all modes, in one plot per estimator; smoothed ones separately."""
    views = []
    for estimator, stream in scene.outputs_of(case, schemas.MODE_PROBABILITIES):
        name = stream.topic.rpartition("/")[2]
        plot = entity_path("plots", case, name, estimator)
        curves = zip(stream.components, stream["probability"].T, cycle(PALETTE), strict=False)
        for mode, probability, colour in curves:
            draw_curve(canvas, plot, mode, colour, stream.publish_time_ns, probability, LINE)
        title = f"{name.replace('_', ' ').capitalize()} of {estimator}"
        views.append(plot_view(plot, title, "probability", (-0.05, SHARES)))
    return views


def draw_effective(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """Draw the effective share of particles of each filter."""
    plot, found = entity_path("plots", case, "effective"), False
    for estimator, stream in scene.outputs_of(case, schemas.EFFECTIVE_PARTICLES):
        share, found = stream["effective"] / stream["particles"], True
        look = (scene.colour(estimator), stream.publish_time_ns, share, line(scene.width(estimator)))
        draw_curve(canvas, plot, estimator, *look)
    return [plot_view(plot, "Effective particles", "share", (-0.05, SHARES))] if found else []


def draw_components(
    canvas: Canvas, scene: Scene, case: str, *, legend: bool = True
) -> dict[str, rrb.TimeSeriesView]:
    """Draw one plot per component of the Gaussian estimates of a case, with means and truth."""
    found = [("truth", TRUTH, LINE, stream, stream["state"]) for stream in scene.truths_of(case)]
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        style = line(scene.width(estimator))
        found.append((estimator, scene.colour(estimator), style, stream, stream["mean"]))
    drawn: dict[str, list[Floats]] = {}
    for name, colour, style, stream, values in found:
        for column, component in enumerate(stream.components):
            scale, plot = shown_unit(component)[2], entity_path("plots", case, component)
            drawn.setdefault(component, []).append(scale * values[:, column])
            draw_curve(canvas, plot, name, colour, stream.publish_time_ns, drawn[component][-1], style)
    views = {}
    for component, curves in drawn.items():
        quantity, unit, _ = shown_unit(component)
        plot, title = entity_path("plots", case, component), quantity.capitalize()
        extent = below_legend(curves) if legend else None
        views[component] = plot_view(plot, title, unit, extent, legend=legend, zoom_lock=False)
    return views


def below_legend(curves: Sequence[Floats]) -> tuple[float, float] | None:
    """Compute a range of a plot with room for a legend above all curves; None if it has no values."""
    values = np.concatenate([np.ravel(each) for each in curves] or [np.empty(0)])
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low, high = float(values.min()), float(values.max())
    span = high - low or max(abs(high), 1.0)
    room = min(LEGEND_MARGIN + LEGEND_ENTRY * len(curves), LEGEND_MOST)
    return low - 0.05 * span, high + span * room / (1.0 - room)


def draw_curve(
    canvas: Canvas,
    plot: str,
    name: str,
    colour: Colour,
    time_ns: Times,
    values: Floats,
    style: Style,
    most: int = DRAWN_ROWS,
) -> None:
    """Draw one curve of a plot.

    Args:
        canvas: the canvas.
        plot, name, colour: the entity of the plot, and name and colour of the curve.
        time_ns, values: (n,), in order of time.
        style: style as a line or as points; a single value is a point.
        most: largest number of values; peaks are kept.
    """
    rows = thin_curve(time_ns, values, most)
    canvas.send(f"{plot}/{name}", time_ns[rows], rr.Scalars.columns(scalars=values[rows]))
    canvas.fix(f"{plot}/{name}", (style if len(rows) > 1 else SINGLE)(names=[name], colors=[colour]))


def plot_view(
    entity: str,
    quantity: str,
    unit: str,
    extent: tuple[float, float] | None = None,
    *,
    note: str = "",
    legend: bool = True,
    zoom_lock: bool = True,
) -> rrb.TimeSeriesView:
    """Plot everything below an entity over the whole run; the title has quantity, unit and note.

    A given range is locked by default.
    """
    return rrb.TimeSeriesView(
        origin=escaped(entity),
        name=f"{quantity} ({unit}){note}",
        axis_x=WHOLE_RUN,
        axis_y=rrb.ScalarAxis(range=extent, zoom_lock=zoom_lock and extent is not None),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def shown_unit(component: str) -> tuple[str, str, float]:
    """Return quantity, displayed unit, and factor to this unit; angles are displayed in degrees.

    A name that does not end in a unit, such as `pressure_a`, is a quantity without a unit.
    """
    quantity, own = parted(component)
    if own in ("rad", "rad/s"):
        own, factor = own.replace("rad", "deg"), 180 / np.pi
    else:
        factor = 1.0
    return quantity.replace("_", " "), written(own) or "-", factor


def draw_close_up(canvas: Canvas, scene: Scene, case: str) -> rrb.Spatial2DView | None:
    """Draw the errors of a case in which each estimator has a single estimate, with the NEES below.

    Return None if there are more estimates, or if no estimate has a position.
    """
    found = [each for each in scene.errors_of(case) if not each.is_bound]
    placed = [each for each in found if set(PLANE) <= set(each.components)]
    if not placed or any(len(each.time_ns) > 1 for each in found):
        return None
    root = entity_path("close", case)
    turn_up(canvas, root)
    radii = rr.Radius.ui_points(2.0 * TRUE.radius_px)
    canvas.fix(f"{root}/truth", rr.Points2D([(0.0, 0.0)], colors=[TRUTH], radii=radii))
    shown, texts = [np.zeros((1, 2))], []
    for errors in placed:
        columns = [errors.components.index(name) for name in PLANE]
        places, covariances = errors.error[:, columns], errors.covariance[:, columns][:, :, columns]
        stroke, entity = stroke_of(scene, errors.estimator), f"{root}/{errors.estimator}"
        outlines = ellipses(places, covariances)
        mark = Stroke(stroke.colour, stroke.radius_px + 1.0)
        draw_dots(canvas, f"{entity}/place", errors.time_ns, places, mark)
        draw_outlines(canvas, f"{entity}/ellipse", errors.time_ns, outlines, stroke)
        shown += [places, outlines[0]]
        low, high = chi_square_interval(len(errors.components), 1)
        nees = f"NEES {errors.nees[0]:.3g}, 95 % within {low:.3g} to {high:.3g}"
        texts.append(f"{errors.estimator}: {nees}")
    extent = np.concatenate(shown)
    extent = extent[np.isfinite(extent).all(axis=1)]
    low_m, high_m = extent.min(axis=0), extent.max(axis=0)
    line_m = LINE_SHARE * float((high_m - low_m).max() or 1.0)
    lines = 1.0 + np.arange(len(texts))
    spots = np.stack([np.full(len(texts), 0.5 * (low_m + high_m)[0]), low_m[1] - line_m * lines], axis=1)
    colours = [scene.colour(each.estimator) for each in placed]
    canvas.fix(
        f"{root}/judged",
        rr.Points2D(spots, labels=texts, colors=colours, radii=0.0, show_labels=True),
    )
    name = "Error in the plane, 95 % ellipses"
    return plane_view(canvas, root, [], [], np.concatenate([extent, spots]), name=name)
