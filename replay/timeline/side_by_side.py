"""Scenes of a family side by side, one per estimator, and the differences of their errors.

The family has drawn all entities once. Each scene shows all of them except the entities of other
estimators. Colours, cursor and all other properties are therefore the same in all scenes.
"""

from collections.abc import Sequence
from copy import copy
from uuid import uuid4

import numpy as np
import rerun.blueprint as rrb

from fuselog.replay.judging.errors.evaluation import Errors, Floats
from fuselog.replay.timeline.drawing.canvas import Board, Canvas, Scene, entity_path, escaped
from fuselog.replay.timeline.drawing.plane import LEGEND
from fuselog.replay.timeline.drawing.plots import LINE, draw_curve, plot_view


def draw_side_by_side(
    canvas: Canvas, scene: Scene, layout: Board, estimators: Sequence[str]
) -> rrb.Container:
    """Return the layout with a scene for each estimator, above plots of differences of errors."""
    plots = [view for case in scene.cases for view in _draw_differences(canvas, scene, case, estimators)]
    board = _split(layout, estimators)
    if not plots:
        return board if isinstance(board, rrb.Container) else rrb.Horizontal(board)
    return rrb.Vertical(board, rrb.Tabs(*plots), row_shares=[4.0, 1.0])


def _split(layout: Board, estimators: Sequence[str]) -> Board:
    """Split every view of a scene in the layout by estimator, except legends."""
    if isinstance(layout, rrb.Container):
        layout.contents = [
            _split(each, estimators) if isinstance(each, rrb.Container | rrb.View) else each
            for each in layout.contents
        ]
        return layout
    if not isinstance(layout, rrb.Spatial2DView | rrb.Spatial3DView) or layout.name == LEGEND:
        return layout
    return rrb.Horizontal(*(_alone(layout, each, estimators) for each in estimators), name=layout.name)


def _alone(view: rrb.View, estimator: str, estimators: Sequence[str]) -> rrb.View:
    """Return a copy of a view that excludes the entities of other estimators."""
    shown = [str(each) for each in np.atleast_1d(np.asarray(view.contents))]
    roots = [each.removesuffix("/**") for each in shown if each.endswith("/**")]
    hidden = [
        f"- {root}/{escaped(other)}/**" for root in roots for other in estimators if other != estimator
    ]
    alone = copy(view)
    alone.id, alone.contents, alone.name = uuid4(), [*shown, *hidden], f"{estimator}: {view.name}"
    return alone


def _draw_differences(
    canvas: Canvas, scene: Scene, case: str, estimators: Sequence[str]
) -> list[rrb.TimeSeriesView]:
    """Plot the errors of the other estimators minus the errors of the first, at common stamps."""
    found = {errors.estimator: errors for errors in scene.errors_of(case)}
    first = found.get(estimators[0])
    plot, unit, drawn = entity_path("plots", case, "difference"), "-", False
    for estimator in estimators[1:]:
        other = found.get(estimator)
        if first is None or other is None:
            continue
        time_ns, here, there = np.intersect1d(first.time_ns, other.time_ns, return_indices=True)
        larger = _sizes(other)[there] - _sizes(first)[here]
        quantity, columns, _ = first.main
        unit = quantity.rpartition("_")[2] if "_" in first.components[columns[0]] else "-"
        name = f"{estimator} - {estimators[0]}"
        draw_curve(canvas, plot, name, scene.colour(estimator), time_ns, larger, LINE)
        drawn = drawn or len(time_ns) > 0
    title = " ".join(filter(None, (case, "difference in the size of errors")))
    return [plot_view(plot, title, unit)] if drawn else []


def _sizes(errors: Errors) -> Floats:
    """Compute the magnitude (n,) of the error of the main quantity."""
    _, columns, scale = errors.main
    sizes: Floats = scale * np.linalg.norm(errors.error[:, columns], axis=1)
    return sizes
