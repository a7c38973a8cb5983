"""Plots of the distances between an estimate and its diverging copies over time."""

from collections.abc import Sequence
from itertools import cycle
from typing import NamedTuple

import rerun.blueprint as rrb

from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import PALETTE, Board, Canvas, Times, entity_path
from fuselog.replay.timeline.drawing.plots import LINE, draw_curve, plot_view


class Fan(NamedTuple):
    """Distances between one copy and its estimate.

    Attributes:
        estimate: the original estimate; the copies of one estimate share a plot.
        copy: name of the copy.
        time_ns: (n,) stamps.
        sigmas: (n,) distance in standard deviations of the estimate.
    """

    estimate: str
    copy: str
    time_ns: Times
    sigmas: Floats


def draw_fans(canvas: Canvas, layout: Board, fans: Sequence[Fan]) -> rrb.Container:
    """Return the layout with a plot below it for each estimate that has copies."""
    plots = []
    for estimate in dict.fromkeys(fan.estimate for fan in fans):
        plot = entity_path("plots", "stress", estimate)
        own = [fan for fan in fans if fan.estimate == estimate]
        for fan, colour in zip(own, cycle(PALETTE), strict=False):
            draw_curve(canvas, plot, fan.copy, colour, fan.time_ns, fan.sigmas, LINE)
        plots.append(plot_view(plot, f"{estimate}: distance of each copy", "sigma"))
    return rrb.Vertical(layout, rrb.Tabs(*plots), row_shares=[4.0, 1.0])
