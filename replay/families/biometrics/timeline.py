"""Timeline of score fusion: distributions of scores, error rates, and probes over time."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.families.biometrics.models import TOPIC, matchers_of
from fuselog.recorders.log import schemas
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
# Share of the genuine scores that are below the histogram's upper end.
SHOWN_SHARE = 0.95
# The scores of a probe's comparisons that are plotted.
OF_PROBE = "genuine and greatest impostor score of each probe"


class Fusion(NamedTuple):
    """Scores fused by an estimator; `note` explains a threshold that the estimator does not state."""

    estimator: str
    fused: Fused
    time_ns: Times
    threshold: float
    note: str


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw a panel for every fused subset of matchers; without estimates, draw all scores."""
    return draw_cases(scene, partial(_draw_case, canvas, scene))


def _draw_case(canvas: Canvas, scene: Scene, case: str) -> rrb.Container | rrb.View:
    """Draw distributions and errors of fused scores, and in another tab the scores of each probe."""
    fusions = list(_fusions(scene, case))
    probes = [_draw_fused_probes(canvas, case, fusion) for fusion in fusions]
    rows = [rrb.Horizontal(*views) for views in (probes, _draw_matchers(canvas, scene, case)) if views]
    boards = [rrb.Vertical(*rows, name="scores of each probe")] if rows else []
    colours = scene.colours(case) | {"genuine": GENUINE, "impostor": IMPOSTOR}
    if fusions:
        colours["threshold"] = WRONG
        spreads = [_draw_distribution(canvas, case, fusion) for fusion in fusions]
        rates = _draw_rates(canvas, scene, case, fusions), _draw_errors(canvas, scene, case, fusions)
        spread = rrb.Tabs(*spreads, active_tab=len(spreads) - 1)
        boards.insert(0, rrb.Vertical(spread, rrb.Horizontal(*rates), name="fused"))
    board = with_legend(canvas, entity_path("biometrics", case), colours, rrb.Tabs(*boards))
    return rrb.Vertical(board, name=case or "run")


def _fusions(scene: Scene, case: str) -> Iterator[Fusion]:
    """Yield the fusions of a case.

    If a fusion has no threshold, the mean of the medians of genuine and impostor scores is used.
    """
    for estimator, stream in scene.outputs_of(case, schemas.SCORE_VECTOR):
        fused = fused_of(stream)
        threshold, note = fused.threshold, ""
        if threshold is None:
            medians = [np.median(fused.score[rows]) for rows in (fused.genuine, ~fused.genuine)]
            threshold, note = float(np.mean(medians)), "; threshold half-way between medians"
        yield Fusion(estimator, fused, stream.publish_time_ns, threshold, note)


def _quantity_of(fusion: Fusion) -> str:
    return f"{fusion.estimator}: {'log-likelihood ratio' if fusion.fused.is_ratio else 'fused score'}"


def _draw_fused_probes(canvas: Canvas, case: str, fusion: Fusion) -> rrb.View:
    """Draw the genuine score and the greatest impostor score of each probe."""
    plot = entity_path("fusion", case, fusion.estimator, "scores")
    _draw_probes(canvas, plot, fusion.fused, fusion.time_ns)
    ends = fusion.time_ns[[0, -1]]
    canvas.send(f"{plot}/threshold", ends, rr.Scalars.columns(scalars=[fusion.threshold] * 2))
    canvas.fix(f"{plot}/threshold", LINE(names=["threshold"], colors=[WRONG]))
    return plot_view(plot, f"{_quantity_of(fusion)}, {OF_PROBE}", "-", note=fusion.note, legend=False)


def _draw_rates(canvas: Canvas, scene: Scene, case: str, fusions: Sequence[Fusion]) -> rrb.View:
    """Draw the ROC curve of each fusion of a case: both error rates at every threshold."""
    curves, strokes = {}, {}
    for estimator, fused, *_ in fusions:
        found = roc(fused.score, fused.genuine)
        curves[estimator] = np.stack([found.false_accept, 1.0 - found.genuine_accept], axis=1)
        strokes[estimator] = stroke_of(scene, estimator)
    name = "ROC: false reject rate over false accept rate"
    return curve_view(canvas, entity_path("rates", case), CurvePanel(name, curves, strokes))


def _draw_errors(canvas: Canvas, scene: Scene, case: str, fusions: Sequence[Fusion]) -> rrb.View:
    """Plot the share of wrong decisions so far for every fusion of a case."""
    plot = entity_path("errors", case)
    for estimator, fused, time_ns, threshold, _ in fusions:
        wrong = _errors_so_far(fused, threshold)
        # a probe's comparisons have the same stamp: use the last of them
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


def _greatest_of_each_time(time_ns: Times, score: Floats) -> Times:
    """Return the row of the greatest score at each distinct time."""
    order = np.lexsort((score, time_ns))
    return order[np.append(time_ns[order][1:] != time_ns[order][:-1], True)]


def _errors_so_far(fused: Fused, threshold: float) -> Floats:
    """Compute the percentage of wrong decisions so far, as the mean of both classes' error rates."""
    wrong = (fused.score > threshold) != fused.genuine
    rates = []
    for chosen in (fused.genuine, ~fused.genuine):
        count = np.cumsum(chosen)
        rates.append(np.cumsum(wrong & chosen) / np.maximum(count, 1))
    return 50 * np.sum(rates, axis=0)


def _draw_distribution(canvas: Canvas, case: str, fusion: Fusion) -> rrb.BarChartView:
    """Draw two normalized histograms of scores so far; the end bars include scores outside the range.

    The two bars of a bin are side by side. A bar as high as the largest bar of the final histograms
    marks the threshold.
    """
    estimator, fused, time_ns, threshold, note = fusion
    entity = entity_path("fusion", case, estimator, "distribution")
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
    # Rerun does not draw a single bar
    heights, places = np.array([0.0, largest]), np.array([low, threshold])
    mark = rr.BarChart(heights, abscissa=places, color=WRONG, widths=[0.2 * width] * 2)
    canvas.fix(f"{entity}/threshold", mark)
    return rrb.BarChartView(
        origin=escaped(entity),
        name=f"{_quantity_of(fusion)}, all comparisons so far (share in each bin){note}",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _draw_matchers(canvas: Canvas, scene: Scene, case: str) -> list[rrb.View]:
    """Draw the scores that the case's matchers give each probe, without failures to enrol."""
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
        without = f", failures to enrol left out: {left_out}" if left_out else ""
        extent = below_legend([fused.score[fused.genuine], fused.score[~fused.genuine]])
        title, note = f"{matchers[index].name}: score", f"{without}; {OF_PROBE}"
        views.append(plot_view(plot, title, "-", extent, note=note, legend=False, zoom_lock=False))
    return views


TIMELINE = Timeline(draw)
