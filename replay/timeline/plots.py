"""Plots that every family uses: components, errors with bands, NEES and NIS with chi-square bounds.

Every function sends its columns and returns the views that show them. A band is Rerun's `Measurements`,
which draws one standard deviation: a band of k sigma is sent with k^2 times the variance.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from recorders.log import schemas
from replay.blocks import gather
from replay.evaluation import Errors, Floats, chi_square_interval, innovations_of
from replay.timeline.canvas import MUTED, TRUTH, Canvas, Colour, Scene, Times, entity_path, nice, thin

SIGMAS = 2.0
WHOLE_RUN = rrb.TimeAxis(
    view_range=rr.TimeRange(rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite())
)
Curve = tuple[str, Times, Floats]


def draw_quality(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """Errors, NEES and NIS of a case: no plots where there is nothing to judge."""
    parts = (draw_errors, draw_nees, draw_nis)
    return [view for part in parts for view in part(canvas, scene, case)]


def draw_errors(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """One plot per component of a case: each estimator's error inside its band of +-2 sigma."""
    found = scene.errors_of(case)
    components = dict.fromkeys(name for errors in found for name in errors.components)
    return [
        _draw_error(canvas, scene, case, name, [each for each in found if name in each.components])
        for name in components
    ]


def _draw_error(
    canvas: Canvas, scene: Scene, case: str, component: str, found: Sequence[Errors]
) -> rrb.TimeSeriesView:
    quantity, unit, scale = shown_unit(component)
    plot = entity_path("plots", case, f"error_{component}")
    extents = []
    for errors in found:
        rows, column = thin(errors.time_ns), errors.components.index(component)
        error = scale * errors.error[rows, column]
        bound = scale * SIGMAS * np.sqrt(np.maximum(errors.covariance[rows, column, column], 0.0))
        extents.append(np.quantile(np.maximum(np.abs(error), bound), 0.99))
        zero = np.zeros(len(rows))
        columns = rr.Measurements.columns(
            values=np.stack([error, zero], axis=1).ravel(),
            variances=np.stack([zero, bound**2], axis=1).ravel(),
        )
        entity = entity_path(plot, errors.estimator)
        canvas.send(entity, errors.time_ns[rows], columns.partition([2] * len(rows)))
        names = [errors.estimator, f"{errors.estimator} band"]
        colour = scene.colour(errors.estimator)
        style = rr.Measurements.from_fields(
            names=names, colors=[colour, (*colour, 150)], widths=[1.5, 0.0]
        )
        canvas.fix(entity, style)
    # the most accurate estimator sets the range; one that drifts away leaves the picture
    extent = nice(1.2 * max(float(min(extents)), np.finfo(float).tiny))
    name = f"Error of {quantity} ({unit}), bands ±{SIGMAS:g} sigma"
    return plot_view(plot, name, (-1.1 * extent, 1.1 * extent), legend=False)


def draw_nees(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """NEES of each estimator with the bounds of a single run; one plot per number of components."""
    by_degrees: dict[int, list[Curve]] = {}
    for errors in scene.errors_of(case):
        rows = thin(errors.time_ns)
        curve = (errors.estimator, errors.time_ns[rows], errors.nees[rows])
        by_degrees.setdefault(len(errors.components), []).append(curve)
    return [
        _draw_squares(canvas, scene, entity_path("plots", case), "NEES", degrees, by_degrees[degrees])
        for degrees in sorted(by_degrees)
    ]


def draw_nis(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """NIS of each estimator, a point per measurement; one plot per number of measured components."""
    by_degrees: dict[int, list[Curve]] = {}
    for estimator, stream in scene.outputs_of(case, schemas.INNOVATION):
        found = innovations_of(gather([stream]))
        for degrees in np.unique(found.degrees).tolist():
            rows = np.flatnonzero(found.degrees == degrees)
            rows = rows[thin(found.time_ns[rows])]
            curve = (estimator, found.time_ns[rows], found.squared[rows])
            by_degrees.setdefault(degrees, []).append(curve)
    return [
        _draw_squares(canvas, scene, entity_path("plots", case), "NIS", degrees, by_degrees[degrees])
        for degrees in sorted(by_degrees)
    ]


def _draw_squares(
    canvas: Canvas, scene: Scene, root: str, name: str, degrees: int, curves: Sequence[Curve]
) -> rrb.TimeSeriesView:
    """Chi-square values of one run, and the band that holds 95 % of consistent ones."""
    plot = f"{root}/{name.lower()}_{degrees}"
    low, high = chi_square_interval(degrees, 1)
    times = np.concatenate([time_ns for _, time_ns, _ in curves])
    band = rr.Measurements.columns(
        values=[0.5 * (low + high)] * 2, variances=[0.25 * (high - low) ** 2] * 2
    )
    canvas.send(f"{plot}/bounds", np.array([times.min(), times.max()]), band)
    canvas.fix(
        f"{plot}/bounds", rr.Measurements.from_fields(names=["95 %"], colors=[MUTED], widths=[0.0])
    )
    for estimator, time_ns, values in curves:
        entity = entity_path(plot, estimator)
        canvas.send(entity, time_ns, rr.Scalars.columns(scalars=values))
        names, colours = [estimator], [scene.colour(estimator)]
        if name == "NIS":  # several at one time
            canvas.fix(entity, rr.SeriesPoints(names=names, colors=colours, marker_sizes=[1.5]))
        else:
            canvas.fix(entity, rr.SeriesLines(names=names, colors=colours, widths=[1.5]))
    return plot_view(plot, f"{name} of {degrees} components", (0.0, 2.5 * high))


def draw_components(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """One plot per component of a case's Gaussian estimates: every estimator's mean, and the truth."""
    curves: dict[str, list[tuple[Curve, Colour]]] = {}
    drawn = [("truth", TRUTH, stream, stream["state"]) for stream in scene.truths_of(case)]
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        drawn.append((estimator, scene.colour(estimator), stream, stream["mean"]))
    for name, colour, stream, values in drawn:
        rows = thin(stream.publish_time_ns)
        for column, component in enumerate(stream.components):
            curve = (name, stream.publish_time_ns[rows], values[rows, column])
            curves.setdefault(component, []).append((curve, colour))
    views = []
    for component, found in curves.items():
        quantity, unit, scale = shown_unit(component)
        plot = entity_path("plots", case, component)
        for (name, time_ns, values), colour in found:
            entity = entity_path(plot, name)
            canvas.send(entity, time_ns, rr.Scalars.columns(scalars=scale * values))
            canvas.fix(entity, rr.SeriesLines(names=[name], colors=[colour], widths=[1.5]))
        views.append(plot_view(plot, f"{quantity.capitalize()} ({unit})"))
    return views


def plot_view(
    entity: str, name: str, extent: tuple[float, float] | None = None, *, legend: bool = True
) -> rrb.TimeSeriesView:
    """A plot of everything below an entity; all plots share one time axis."""
    return rrb.TimeSeriesView(
        origin=entity,
        name=name,
        axis_x=WHOLE_RUN,
        axis_y=rrb.ScalarAxis(range=extent, zoom_lock=extent is not None),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def shown_unit(component: str) -> tuple[str, str, float]:
    """Quantity, the unit to show it in, and the factor to that unit: angles are shown in degrees."""
    quantity, _, unit = component.rpartition("_")
    if not quantity:
        return component, "-", 1.0
    shown, scale = _SHOWN.get(unit, (unit, 1.0))
    return quantity.replace("_", " "), shown, scale


_SHOWN = {
    "rad": ("deg", 180 / np.pi),
    "radps": ("deg/s", 180 / np.pi),
    "mps": ("m/s", 1.0),
    "mps2": ("m/s²", 1.0),
}
