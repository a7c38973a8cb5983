"""The timeline of a scenario that has none of its own: every component, its error, NEES, NIS, events."""

from functools import partial

import rerun.blueprint as rrb

from replay.timeline.canvas import Canvas, Scene, Timeline, beside, draw_cases
from replay.timeline.events import draw_events
from replay.timeline.plots import draw_components, draw_quality


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Components and events of each case on the left, errors and consistency on the right."""
    return draw_cases(scene, partial(_draw_case, canvas, scene))


def _draw_case(canvas: Canvas, scene: Scene, case: str) -> rrb.Container | rrb.View:
    left = [*draw_components(canvas, scene, case), draw_events(canvas, scene, case)]
    return beside(rrb.Vertical(*left), draw_quality(canvas, scene, case), case)


TIMELINE = Timeline(draw)
