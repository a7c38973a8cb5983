"""Drawings that families register for schemas, for use in the scenes of other families."""

from collections.abc import Callable, Iterable

from fuselog.recorders.log import Stream
from fuselog.recorders.registry import available, load
from fuselog.replay.timeline.drawing.canvas import Board, Canvas, Scene

Draw = Callable[[Canvas, Scene, str], list[Board]]


def draw_registered(canvas: Canvas, scene: Scene, case: str, streams: Iterable[Stream]) -> list[Board]:
    """Draw a case with the registered `fuselog.drawings` entry points, and return their panels.

    Each entry point has the name of a schema. It is loaded if one of `streams` has this schema.
    """
    found = dict.fromkeys(stream.schema.full_name for stream in streams)
    drawn: list[Board] = []
    for name in [each for each in found if each in available("drawings")]:
        draw: Draw = load("drawings", name)
        drawn += draw(canvas, scene, case)
    return drawn
