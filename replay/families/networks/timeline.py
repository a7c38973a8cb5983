"""Timeline of a sensor network: graph with messages, estimates of the nodes, and NEES per node.

A message is drawn from its sender to its receiver when it is sent; a lost message is red and ends
half-way. Each fusion rule has its own maps: the trajectories, and every node's error with its 95 %
ellipse.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.judging.errors.evaluation import Errors, split_topic
from fuselog.replay.timeline.drawing.canvas import (
    MUTED,
    TRUTH,
    WRONG,
    Canvas,
    Scene,
    Timeline,
    entity_path,
    escaped,
    thin,
)
from fuselog.replay.timeline.drawing.events import above_events, draw_events, events_view, stamped
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    Stroke,
    draw_dots,
    draw_ellipses,
    draw_lines,
    draw_path,
    draw_points,
    neighbours,
    plane_view,
    stroke_of,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import draw_errors, draw_nees, in_strips

GRAPH = f"{ROOT}/graph"
PLACE = ("x_m", "y_m")
ARRIVED = (0, 158, 115, 255)
LOST = (*WRONG, 255)
# Largest number of nodes with plots, and of lost messages that an event lists.
PLOTTED_NODES = 6
NAMED_MESSAGES = 8
# Largest number of times at which nodes are labelled on the map of errors.
NAMED_TIMES = 500
# Share of the errors that are inside the bounds of their map.
SHOWN_SHARE = 0.9
# Distance between the two directions of a link, as a share of the circle's radius.
APART = 0.05


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw the graph, the maps of all rules and the events, next to the NEES and errors of the nodes."""
    turn_up(canvas)
    links = scene.read("/links")
    nodes = _nodes(scene, links)
    maps = rrb.Horizontal(_draw_graph(canvas, links, nodes), _draw_maps(canvas, scene))
    colours = scene.colours("") | {name: scene.colour(name) for name in scene.estimators}
    colours |= {"arrived": ARRIVED[:3], "lost": LOST[:3]}
    board = with_legend(canvas, "network", colours, maps)
    board = above_events(board, _draw_events(canvas, scene, links))
    cases = [case for case in scene.cases if scene.errors_of(case)][:PLOTTED_NODES]
    if not cases:
        return board
    nees = [view for case in cases for view in _draw_nees(canvas, scene, case)]
    errors = [in_strips(draw_errors(canvas, scene, case), case) for case in cases]
    plots = rrb.Tabs(rrb.Vertical(*nees, name="NEES"), *errors)
    return rrb.Horizontal(board, plots, column_shares=[1, 1])


def _draw_nees(canvas: Canvas, scene: Scene, case: str) -> list[rrb.TimeSeriesView]:
    """Draw the NEES plots of one node, with its name as the title."""
    views = draw_nees(canvas, scene, case, legend=False)
    for view in views:
        view.name = f"{case}: {view.name}"
    return views


def _nodes(scene: Scene, links: Stream) -> NDArray[np.int64]:
    """Return the numbers (n,) of all nodes that measure, send or receive."""
    parts = [topic.removeprefix("/node").partition("/") for topic in scene.source.topics]
    sensing = [int(number) for number, _, leaf in parts if leaf == "sensor" and number.isdigit()]
    numbers = np.concatenate([links["sender_id"], links["receiver_id"], sensing])
    return np.unique(numbers.astype(np.int64))


def _draw_graph(canvas: Canvas, links: Stream, nodes: NDArray[np.int64]) -> rrb.Spatial2DView:
    """Draw nodes on a circle, links as lines, and the current messages on them."""
    angle = 0.5 * np.pi - 2.0 * np.pi * np.arange(len(nodes)) / max(len(nodes), 1)
    places = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    draw_points(canvas, f"{GRAPH}/nodes", nodes, places)
    ends = np.stack([links["sender_id"], links["receiver_id"]], axis=1).astype(int)
    known = np.unique(np.sort(ends, axis=1), axis=0)
    strips = places[np.searchsorted(nodes, known)]
    style = Stroke(MUTED, 0.5).fields()
    canvas.fix(f"{GRAPH}/links", rr.LineStrips2D(strips, **style))
    lost = links["lost"] > 0
    sender, receiver = (places[np.searchsorted(nodes, side)] for side in ends.T)
    way = receiver - sender
    left = np.stack([-way[:, 1], way[:, 0]], axis=1)
    left *= 0.5 * APART / np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    tip = sender + left + np.where(lost, 0.5, 0.95)[:, None] * way
    lines = np.stack([sender + left + 0.05 * way, tip], axis=1)
    colours = np.where(lost[:, None], LOST, ARRIVED).astype(np.uint8)
    draw_lines(canvas, f"{GRAPH}/messages", links.publish_time_ns, lines, colours)
    extent = (-1.3, 1.3)
    return rrb.Spatial2DView(
        origin="/",
        contents=[f"{escaped(GRAPH)}/**"],
        name="Network: links, arriving and lost messages",
        visual_bounds=rrb.VisualBounds2D(x_range=extent, y_range=extent),
    )


def _draw_maps(canvas: Canvas, scene: Scene) -> rrb.Tabs | rrb.Spatial2DView:
    """Draw the true trajectory and the nodes' trajectories for each estimator, with the errors below."""
    truth, shown = f"{ROOT}/truth", [np.empty((0, 2))]
    for stream in scene.truths_of(""):
        places = stream["state"][:, [stream.components.index(name) for name in PLACE]]
        draw_path(canvas, f"{truth}/path", stream.publish_time_ns, places, Stroke(TRUTH, 2.0))
        draw_dots(canvas, f"{truth}/place", stream.publish_time_ns, places, Stroke(TRUTH, 2.0))
        shown.append(places)
    places = np.concatenate(shown)
    if not scene.errors:
        return plane_view(canvas, truth, [], [f"{truth}/path"], places)
    views = []
    for estimator in scene.estimators:
        found = [errors for errors in scene.errors if errors.estimator == estimator]
        ways, errors = (entity_path(ROOT, part, estimator) for part in ("ways", "errors"))
        paths = [f"{truth}/path", *(_draw_way(canvas, scene, ways, each) for each in found)]
        extents = [_draw_error(canvas, scene, errors, each) for each in found]
        _draw_names(canvas, f"{errors}/names", found, np.max(extents, initial=0.0))
        extent = np.max(extents, initial=0.0) * np.array([[-1.0, -1.0], [1.0, 1.0]])
        views.append(
            rrb.Vertical(
                plane_view(canvas, ways, [truth], paths, places),
                plane_view(canvas, errors, [], [], extent, name="Errors and 95 % ellipses"),
                name=estimator,
            )
        )
    sharing = [split_topic(topic)[0] for topic in scene.outputs if topic.endswith("/sent")]
    return rrb.Tabs(*views, active_tab=scene.estimators.index(sharing[0]) if sharing else 0)


def _draw_way(canvas: Canvas, scene: Scene, root: str, errors: Errors) -> str:
    """Draw the trajectory of one node's estimates; return its entity."""
    stroke = stroke_of(scene, errors.estimator)
    for name, stream in scene.outputs_of(errors.case, schemas.GAUSSIAN_ESTIMATE):
        # sent messages are also Gaussians, but they have no truth
        if name == errors.estimator and "truth" in stream.metadata:
            places = stream["mean"][:, [stream.components.index(name) for name in PLACE]]
            draw_path(canvas, f"{root}/{errors.case}", stream.publish_time_ns, places, stroke)
    return f"{root}/{errors.case}"


def _draw_error(canvas: Canvas, scene: Scene, root: str, errors: Errors) -> float:
    """Draw one node's position error, with the truth at the origin; return the extent to show."""
    stroke, entity = Stroke(scene.colour(errors.estimator)), f"{root}/{errors.case}"
    columns = [errors.components.index(name) for name in PLACE]
    error, covariance = errors.error[:, columns], errors.covariance[:, columns][:, :, columns]
    draw_dots(canvas, f"{entity}/place", errors.time_ns, error, stroke)
    draw_ellipses(canvas, f"{entity}/ellipse", errors.time_ns, error, covariance, stroke)
    canvas.fix(f"{root}/truth", rr.Points2D([[0.0, 0.0]], **Stroke(TRUTH, 2.0).fields(widen=2.0)))
    reach = np.abs(error).max(axis=1) + 2.5 * np.sqrt(covariance[:, [0, 1], [0, 1]].max(axis=1))
    return float(np.quantile(reach, SHOWN_SHARE))


def _draw_names(canvas: Canvas, entity: str, found: Sequence[Errors], extent_m: float) -> None:
    """Label errors with the numbers of the nodes, and join labels that would overlap."""
    if not found:
        return
    known = np.unique(np.concatenate([errors.time_ns for errors in found]))
    time_ns = known[thin(known, NAMED_TIMES)]
    numbers = np.array([errors.case.removeprefix("node") for errors in found])
    places = np.full((len(time_ns), len(found), 2), np.nan)
    for node, errors in enumerate(found):
        row = np.searchsorted(errors.time_ns, time_ns, side="right") - 1
        columns = [errors.components.index(name) for name in PLACE]
        places[row >= 0, node] = errors.error[row[row >= 0]][:, columns]
    spots, labels, sizes = [], [], []
    for there in places:
        rows = np.flatnonzero(np.isfinite(there).all(axis=1))
        groups = neighbours(there[rows], 2.0 * extent_m) if len(rows) else []
        spots += [there[rows[group]].mean(axis=0) for group in groups]
        labels += [" ".join(numbers[rows[group]]) for group in groups]
        sizes.append(len(groups))
    points = rr.Points2D.columns(positions=np.array(spots).reshape(-1, 2), labels=labels)
    canvas.send(entity, time_ns, points.partition(sizes))
    style = rr.Points2D.from_fields(colors=[TRUTH], radii=[0.0], show_labels=True)
    canvas.fix(entity, style)


def _draw_events(canvas: Canvas, scene: Scene, links: Stream) -> list[rrb.TextLogView]:
    """List the events of estimators, sensors and messages."""
    plotted, others = scene.cases[: PLOTTED_NODES + 1], scene.cases[PLOTTED_NODES + 1 :]
    happened = [draw_events(canvas, scene, case, more=others) for case in plotted[:1]]
    happened += [draw_events(canvas, scene, case) for case in plotted[1:]]
    times, first = np.unique(links.publish_time_ns, return_index=True)
    texts = [_line_of(links.take(rows)) for rows in np.split(np.arange(len(links)), first)[1:]]
    levels = ["WARN" if "lost" in text else "INFO" for text in texts]
    lines = stamped(canvas, times, texts)
    canvas.send("events/links", times, rr.TextLog.columns(text=lines, level=levels))
    return [events_view("events")] if texts or any(happened) else []


def _line_of(sent: Stream) -> str:
    """Summarize, in one line of text, the messages that are sent at the same time."""
    ways = [f"{a}>{b}" for a, b in zip(sent["sender_id"], sent["receiver_id"], strict=True)]
    late_s = (sent["arrival_time_ns"] - sent.publish_time_ns) * 1e-9
    parts = [f"{len(sent)} messages sent"]
    lost = [way for way, is_lost in zip(ways, sent["lost"] > 0, strict=True) if is_lost]
    parts += [f"lost {_listed(lost)}"] * bool(lost)
    parts += [f"up to {late_s.max():.3g} s late"] * bool(late_s.max() > 0)
    return "; ".join(parts)


def _listed(names: Sequence[str]) -> str:
    more = len(names) - NAMED_MESSAGES
    return " ".join(names[:NAMED_MESSAGES]) + (f" and {more} more" if more > 0 else "")


TIMELINE = Timeline(draw)
