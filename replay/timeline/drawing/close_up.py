"""Close-up of single estimates: errors in the plane with 95 % ellipses, and the truth at the origin."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from fuselog.replay.timeline.drawing.canvas import TRUTH, Canvas, Scene, entity_path
from fuselog.replay.timeline.drawing.plane import (
    TRUE,
    Stroke,
    draw_dots,
    draw_outlines,
    plane_view,
    stroke_of,
    turn_up,
)

# Height of a line of text below the ellipses, as a fraction of the height of the picture.
LINE_SHARE = 0.1


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
