"""Timeline of vessels: a map and the tangent plane, with reports coloured by track.

Map tiles are loaded from the network; offline, the reports are still drawn at their positions. Next to
the map are the numbers of live tracks and vessels, and a table of the share of each vessel's reports
that are in its own track.
"""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import hsv_to_rgb
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.families.tracking.judging.tracks import live_counts, reports_of, track_tables
from fuselog.replay.judging.metrics.measuring import Output
from fuselog.replay.timeline.drawing.canvas import TRUTH, Canvas, Scene, Timeline, Times, thin
from fuselog.replay.timeline.drawing.geodetic import are_near, degrees_of, map_view, usual
from fuselog.replay.timeline.drawing.plane import ROOT, plane_view, turn_up
from fuselog.replay.timeline.drawing.plots import LINE, plot_view

REPORTS, GEODETIC, IDENTITY = "/reports", "/geodetic", "/identity"
TRAIL_S = 300.0
LIVE_S = 600.0
LISTED_VESSELS = 200
# Greatest number of reports drawn per estimator.
DRAWN_REPORTS = 50_000
# Golden ratio: its multiples modulo 1 are hues that stay far apart.
GOLDEN = 0.618034


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw the map and plane of each estimator in tabs, the live counts, and a table of vessels."""
    turn_up(canvas)
    tracks = scene.outputs_of("", schemas.TRACK_ESTIMATE)
    boards = [_draw_board(canvas, scene, name, stream) for name, stream in tracks]
    if not boards:
        boards = [_draw_board(canvas, scene, "reports", None)]
    tables = [_draw_table(canvas, scene, name, stream) for name, stream in tracks[:1]]
    side = rrb.Vertical(_draw_live(canvas, scene, tracks), *tables)
    return rrb.Horizontal(rrb.Tabs(*boards), side, column_shares=[3, 1])


def _draw_board(canvas: Canvas, scene: Scene, name: str, tracks: Stream | None) -> rrb.Container:
    """Draw the reports on the map and in the plane, in white if there are no tracks."""
    reports, geodetic = scene.read(REPORTS), scene.read(GEODETIC)
    numbers = np.zeros(len(reports), np.int64)
    if tracks is not None and len(tracks) == len(reports):
        numbers = tracks["track_id"].astype(np.int64)
    rows = np.arange(0, len(reports), 1 + len(reports) // DRAWN_REPORTS)
    colours = track_colours(numbers[rows]) if tracks is not None else np.full((len(rows), 3), 255)
    times, place = reports.publish_time_ns[rows], reports["position_m"][rows]
    radii = rr.Radius.ui_points(3.0)
    points = rr.Points2D.columns(positions=place, colors=colours)
    plane_entity, map_entity = f"{ROOT}/{name}/reports", f"geodetic/{name}/reports"
    canvas.send(plane_entity, times, points)
    canvas.fix(plane_entity, rr.Points2D.from_fields(radii=radii))
    degrees = degrees_of(geodetic)[rows]
    near = are_near(degrees)
    on_map = rr.GeoPoints.columns(positions=degrees[near], colors=colours[near])
    canvas.send(map_entity, times[near], on_map)
    canvas.fix(map_entity, rr.GeoPoints.from_fields(radii=radii))
    on_earth = map_view(canvas, f"geodetic/{name}", degrees, [map_entity], TRAIL_S)
    shown = usual(place)
    plane = plane_view(canvas, f"{ROOT}/{name}", [], [plane_entity], shown, TRAIL_S)
    return rrb.Horizontal(plane, on_earth, name=name)


def track_colours(numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return a colour (n, 3) for every track number, with very different hues for successive numbers."""
    hue = numbers * GOLDEN % 1.0
    value = np.where(numbers % 2 == 0, 1.0, 0.75)
    colours = hsv_to_rgb(np.stack([hue, np.full(len(hue), 0.7), value], axis=1))
    return np.rint(255 * colours).astype(np.uint8)


def _draw_live(canvas: Canvas, scene: Scene, tracks: list[tuple[str, Stream]]) -> rrb.TimeSeriesView:
    """Plot the numbers of tracks and vessels heard within the last ten minutes."""
    identity = scene.read(IDENTITY)
    curves = [("vessels", TRUTH, identity.publish_time_ns, identity["thing_id"])]
    for name, stream in tracks:
        curves.append((name, scene.colour(name), stream.publish_time_ns, stream["track_id"]))
    for name, colour, time_ns, numbers in curves:
        at_ns, live = live_counts(time_ns, numbers, LIVE_S)
        rows = thin(at_ns)
        _send_curve(canvas, f"plots/live/{name}", at_ns[rows], live[rows])
        canvas.fix(f"plots/live/{name}", LINE(names=[name], colors=[colour]))
    return plot_view("plots/live", f"Heard within {LIVE_S / 60:g} min", "number")


def _send_curve(canvas: Canvas, entity: str, time_ns: Times, values: NDArray) -> None:
    canvas.send(entity, time_ns, rr.Scalars.columns(scalars=values.astype(float)))


def _draw_table(canvas: Canvas, scene: Scene, name: str, tracks: Stream) -> rrb.TextDocumentView:
    """List the share of each vessel's reports in its own track, sorted by decreasing report count."""
    output = Output(name, "", "track", gather([tracks]), [scene.source])
    lines = ["|MMSI|reports|share|tracks|switches|", "|--:|--:|--:|--:|--:|"]
    for table in track_tables(reports_of(output)):
        shown = table[["target", "reports", "share", "tracks", "switches"]][:LISTED_VESSELS]
        for target, reports, share, count, switches in shown.itertuples(index=False):
            lines.append(f"|{target}|{reports}|{share:.3f}|{count}|{switches}|")
        if len(table) > LISTED_VESSELS:
            lines.append(f"\n{len(table) - LISTED_VESSELS} more are in the study's tables")
    canvas.fix("vessels", rr.TextDocument("\n".join(lines), media_type="text/markdown"))
    return rrb.TextDocumentView(origin="vessels", name=f"Vessels in tracks of {name}")


TIMELINE = Timeline(draw)
