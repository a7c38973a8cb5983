"""Draws score fusion: how scores are spread, rates of both errors, probes as they come."""

from functools import partial

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.families.biometrics.models import TOPIC, matchers_of
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.families.biometrics.pairs import subsets_of
from fuselog.replay.families.biometrics.verification import Floats, Fused, fused_of, roc
from fuselog.replay.timeline.drawing.canvas import (
    PALETTE,
    WRONG,
    Canvas,
    Scene,
    Timeline,
    Times,
    draw_cases,
    entity_path,
    escaped,
)
from fuselog.replay.timeline.drawing.curves import CurvePanel, curve_view
from fuselog.replay.timeline.drawing.plane import stroke_of, with_legend
from fuselog.replay.timeline.drawing.plots import LINE, POINTS, below_legend, plot_view

GENUINE, IMPOSTOR = PALETTE[2], PALETTE[1]
BINS = 60
UPDATES = 50
# How many of the genuine scores are below the histogram's upper end.
SHOWN_SHARE = 0.95


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw a board for every subset of matchers that was fused; without estimates, all scores."""
    return draw_cases(scene, partial(_draw_case, canvas, scene))


def _draw_case(canvas: Canvas, scene: Scene, case: str) -> rrb.Container | rrb.View:
    fusions = scene.outputs_of(case, schemas.SCORE_VECTOR)
    rows = [_draw_fusion(canvas, case, *fusion) for fusion in fusions]
    matched = _draw_matchers(canvas, scene, case)
    boards: list[rrb.Container | rrb.View] = []
    if rows:
        rates = rrb.Horizontal(_draw_rates(canvas, scene, case), _draw_errors(canvas, scene, case))
        boards = [rrb.Tabs(*rows, active_tab=len(rows) - 1), rates]
    if matched:
        boards.append(rrb.Horizontal(*matched))
    colours = scene.colours(case) | {"genuine": GENUINE, "impostor": IMPOSTOR}
    board = with_legend(canvas, entity_path("biometrics", case), colours, rrb.Vertical(*boards))
    return rrb.Vertical(board, name=case or "run")


def _draw_fusion(canvas: Canvas, case: str, estimator: str, stream: Stream) -> rrb.Container:
    """Draw genuine and greatest impostor score of each probe, and how the scores so far are spread."""
    fused, time_ns = fused_of(stream), stream.publish_time_ns
    root = entity_path("fusion", case, estimator)
    of_probe = "Log-likelihood ratio" if fused.is_ratio else "Fused score"
    _draw_probes(canvas, f"{root}/scores", fused, time_ns)
    return rrb.Horizontal(
        _draw_distribution(canvas, f"{root}/distribution", fused, time_ns),
        plot_view(f"{root}/scores", f"{of_probe} of each probe", "-", legend=False),
        name=estimator,
    )


def _draw_rates(canvas: Canvas, scene: Scene, case: str) -> rrb.View:
    """Draw both rates of errors at every threshold, a curve for each fusion of a case."""
    curves, strokes = {}, {}
    for estimator, stream in scene.outputs_of(case, schemas.SCORE_VECTOR):
        fused = fused_of(stream)
        found = roc(fused.score, fused.genuine)
        curves[estimator] = np.stack([found.false_accept, 1.0 - found.genuine_accept], axis=1)
        strokes[estimator] = stroke_of(scene, estimator)
    name = "ROC: genuine rejected (share) over impostors accepted (share)"
    return curve_view(canvas, entity_path("rates", case), CurvePanel(name, curves, strokes))


def _draw_errors(canvas: Canvas, scene: Scene, case: str) -> rrb.View:
    """Plot the share of wrong decisions so far of every fusion of a case."""
    plot = entity_path("errors", case)
    for estimator, stream in scene.outputs_of(case, schemas.SCORE_VECTOR):
        wrong, time_ns = _errors_so_far(fused_of(stream)), stream.publish_time_ns
        # a probe's comparisons share a stamp: the last one holds
        last = np.flatnonzero(np.append(time_ns[1:] != time_ns[:-1], True))
        canvas.send(f"{plot}/{estimator}", time_ns[last], rr.Scalars.columns(scalars=wrong[last]))
        canvas.fix(f"{plot}/{estimator}", LINE(names=[estimator], colors=[scene.colour(estimator)]))
    return plot_view(plot, "Wrong decisions so far", "%", legend=False)


def _draw_probes(canvas: Canvas, plot: str, fused: Fused, time_ns: Times) -> None:
    for name, colour, chosen in (
        ("impostor", IMPOSTOR, ~fused.genuine),
        ("genuine", GENUINE, fused.genuine),
    ):
        rows = _greatest_of_each_time(time_ns[chosen], fused.score[chosen])
        score = fused.score[chosen][rows]
        canvas.send(f"{plot}/{name}", time_ns[chosen][rows], rr.Scalars.columns(scalars=score))
        canvas.fix(f"{plot}/{name}", POINTS(names=[name], colors=[colour]))
    if fused.threshold is not None:
        ends = np.array([time_ns[0], time_ns[-1]])
        level = rr.Scalars.columns(scalars=[fused.threshold] * 2)
        canvas.send(f"{plot}/threshold", ends, level)
        canvas.fix(f"{plot}/threshold", LINE(names=["threshold"], colors=[WRONG]))


def _greatest_of_each_time(time_ns: Times, score: Floats) -> Times:
    """Return the row of the greatest score of each distinct time."""
    order = np.lexsort((score, time_ns))
    return order[np.append(time_ns[order][1:] != time_ns[order][:-1], True)]


def _errors_so_far(fused: Fused) -> Floats:
    """Compute per cent of comparisons so far that were decided wrongly: the mean of both classes' rates.

    A fusion without a threshold is judged half-way between the medians of genuine and impostor scores.
    """
    threshold = fused.threshold
    if threshold is None:
        medians = [np.median(fused.score[rows]) for rows in (fused.genuine, ~fused.genuine)]
        threshold = float(np.mean(medians))
    wrong = (fused.score > threshold) != fused.genuine
    rates = []
    for chosen in (fused.genuine, ~fused.genuine):
        count = np.cumsum(chosen)
        rates.append(np.cumsum(wrong & chosen) / np.maximum(count, 1))
    return 50 * np.sum(rates, axis=0)


def _draw_distribution(canvas: Canvas, entity: str, fused: Fused, time_ns: Times) -> rrb.BarChartView:
    """Draw two histograms of scores so far, each of sum 1; what is off the scale is in the end bars.

    Their bars stand side by side within each bin. A bar as high as all marks the threshold.
    """
    low = np.quantile(fused.score[~fused.genuine], 0.001)
    high = np.quantile(fused.score[fused.genuine], SHOWN_SHARE)
    edges = np.linspace(low, max(high, low + 1e-9), BINS + 1)
    place = np.clip(np.searchsorted(edges, fused.score) - 1, 0, BINS - 1)
    middle, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    moments = np.unique(np.linspace(0, len(time_ns) - 1, UPDATES).astype(int))
    largest = 0.0
    for label, colour, chosen, side in (
        ("impostor", IMPOSTOR, ~fused.genuine, -0.25),
        ("genuine", GENUINE, fused.genuine, 0.25),
    ):
        counts = [
            np.bincount(place[: moment + 1][chosen[: moment + 1]], minlength=BINS) for moment in moments
        ]
        shares = np.array([count / max(count.sum(), 1) for count in counts])
        for moment, share in zip(moments, shares, strict=True):
            chart = rr.BarChart.columns(
                values=[share],
                abscissa=[middle + side * width],
                color=[colour],
                widths=np.full((1, BINS), 0.5 * width),
            )
            canvas.send(f"{entity}/{label}", time_ns[[moment]], chart)
        largest = max(largest, float(shares[-1].max()))
    if fused.threshold is not None:
        # a single bar is none to Rerun
        heights, places = np.array([0.0, largest]), np.array([low, fused.threshold])
        mark = rr.BarChart(heights, abscissa=places, color=WRONG, widths=[0.2 * width] * 2)
        canvas.fix(f"{entity}/threshold", mark)
    return rrb.BarChartView(
        origin=escaped(entity),
        name="Scores so far (share in each bin)",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _draw_matchers(canvas: Canvas, scene: Scene, case: str) -> list[rrb.View]:
    """Draw the scores that the case's matchers gave each probe, without failures to enrol."""
    if TOPIC not in scene.source.topics:
        return []
    stream = scene.read(TOPIC)
    matchers = matchers_of(stream.metadata)
    views: list[rrb.View] = []
    for index in subsets_of(matchers).get(case, range(len(matchers))):
        plot = entity_path("matchers", case, matchers[index].name)
        probe, gallery = (stream[name].astype(np.int64) for name in ("probe_id", "gallery_id"))
        score = stream["scores"][:, index]
        known = ~np.isnan(score) & (score != matchers[index].failure)
        fused = Fused(score[known], probe[known], gallery[known], None, None, False)
        _draw_probes(canvas, plot, fused, stream.publish_time_ns[known])
        left_out = len(np.unique(probe[~known]))
        without = f", without {left_out} that it could not enrol" if left_out else ""
        extent = below_legend([fused.score[fused.genuine], fused.score[~fused.genuine]])
        title = f"{matchers[index].name}: score of each probe{without}"
        views.append(plot_view(plot, title, "-", extent, legend=False, zoom_lock=False))
    return views


TIMELINE = Timeline(draw)
