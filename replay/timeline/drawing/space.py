"""Orientations in space, drawn as triads around one origin."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.timeline.drawing.canvas import Canvas, Colour, Times, escaped


def draw_triads(
    canvas: Canvas,
    entity: str,
    time_ns: Times,
    quaternions: Floats,
    colours: Sequence[Colour],
    length: float,
    radius: float,
) -> None:
    """Draw the rotated axes x, y and z at each time.

    Args:
        canvas, entity: the canvas, and the path of the entity.
        time_ns: (n,).
        quaternions: (n, 4), w first.
        colours: colours of x, y and z.
        length, radius: length and radius of the axes, in the unit of the scene.
    """
    turned = rr.Transform3D.columns(quaternion=np.roll(quaternions, -1, axis=1))
    canvas.send(entity, time_ns, turned)
    labels = [f"{entity.rpartition('/')[2]} {axis}" for axis in "xyz"]
    arrows = rr.Arrows3D(
        vectors=length * np.eye(3), colors=colours, radii=radius, labels=labels, show_labels=False
    )
    canvas.fix(f"{entity}/axes", arrows)


def space_view(root: str, name: str) -> rrb.Spatial3DView:
    """Return a view of triads around one origin, with x towards the camera."""
    return rrb.Spatial3DView(
        origin=escaped(root),
        name=name,
        eye_controls=rrb.EyeControls3D(
            position=(2.4, 1.4, 1.2), look_target=(0, 0, 0), eye_up=(0, 0, 1)
        ),
    )
