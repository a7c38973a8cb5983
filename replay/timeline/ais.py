"""The vessels' timeline: reports in the colours of their tracks, on a map and in the tangent plane.

The map's tiles come from the network; without it the reports are still in their places. Beside it:
how many tracks and vessels are live, and the share of each vessel's reports that its own track has.
"""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import hsv_to_rgb
from numpy.typing import NDArray

from recorders.log import Stream, schemas
from replay.engine.blocks import gather
from replay.judging.evaluation import Floats
from replay.judging.metrics import Output
from replay.judging.tracks import live_counts, reports_of, track_tables
from replay.timeline.canvas import TRUTH, Canvas, Scene, Timeline, Times, escaped, thin
from replay.timeline.plane import ROOT, plane_view, trail_of, turn_up
from replay.timeline.plots import LINE, plot_view

REPORTS, GEODETIC, IDENTITY = "/reports", "/geodetic", "/identity"
TRAIL_S = 300.0
LIVE_S = 600.0
LISTED_VESSELS = 200
# What is drawn of each estimator at most.
DRAWN_REPORTS = 50_000
# Hues this far apart, in turns, never meet again soon.
GOLDEN = 0.618034
SHOWN_SHARE = 0.9
# So many times the shown extent beyond it is far off.
FAR = 10.0
# How wide the map is drawn, about, and its tiles.
MAP_PIXELS, TILE_PIXELS = 700.0, 256.0


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Map and plane of each estimator in tabs, live counts, and a table of vessels."""
    turn_up(canvas)
    tracks = scene.outputs_of("", schemas.TRACK_ESTIMATE)
    boards = [_draw_board(canvas, scene, name, stream) for name, stream in tracks]
    if not boards:
        boards = [_draw_board(canvas, scene, "reports", None)]
    tables = [_draw_table(canvas, scene, name, stream) for name, stream in tracks[:1]]
    side = rrb.Vertical(_draw_live(canvas, scene, tracks), *tables)
    return rrb.Horizontal(rrb.Tabs(*boards), side, column_shares=[3, 1])


def _draw_board(canvas: Canvas, scene: Scene, name: str, tracks: Stream | None) -> rrb.Container:
    """The reports on the map and in the plane; white without tracks."""
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
    degrees = np.stack([geodetic["latitude_deg"], geodetic["longitude_deg"]], axis=1)[rows]
    near = _is_near(degrees)
    on_map = rr.GeoPoints.columns(positions=degrees[near], colors=colours[near])
    canvas.send(map_entity, times[near], on_map)
    canvas.fix(map_entity, rr.GeoPoints.from_fields(radii=radii))
    trail = trail_of(canvas, TRAIL_S)
    map_view = rrb.MapView(
        origin=escaped(f"geodetic/{name}"),
        name="OpenStreetMap" if near.all() else f"OpenStreetMap, {(~near).sum()} far off left out",
        zoom=_zoom(degrees[near]),
        overrides={escaped(map_entity): [trail]},
    )
    shown = _usual(place)
    plane = plane_view(canvas, f"{ROOT}/{name}", [], [plane_entity], shown, TRAIL_S)
    return rrb.Horizontal(plane, map_view, name=name)


def track_colours(numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
    """A colour (n, 3) for every track number; neighbours in number are far apart in hue."""
    hue = numbers * GOLDEN % 1.0
    value = np.where(numbers % 2 == 0, 1.0, 0.75)
    colours = hsv_to_rgb(np.stack([hue, np.full(len(hue), 0.7), value], axis=1))
    return np.rint(255 * colours).astype(np.uint8)


def _usual(places: Floats) -> Floats:
    """The corners (2, d) of what holds most places: a wrong one does not shrink the picture."""
    tail = 0.5 * (1.0 - SHOWN_SHARE)
    return np.quantile(places, [tail, 1.0 - tail], axis=0)


def _is_near(places: Floats) -> NDArray[np.bool_]:
    """Which places are not far off: the map's view centres on all that it has."""
    low, high = _usual(places)
    margin = FAR * (high - low).max()
    return ((places >= low - margin) & (places <= high + margin)).all(axis=1)


def _zoom(degrees: Floats) -> float:
    """The zoom at which all places fill the map: at zoom z the world is 2^z tiles wide."""
    low, high = degrees.min(axis=0), degrees.max(axis=0)
    latitude = np.radians(0.5 * (low[0] + high[0]))
    width = max(high[1] - low[1], (high[0] - low[0]) / max(np.cos(latitude), 0.1), 1e-3)
    return float(np.clip(np.log2(360.0 / width * MAP_PIXELS / TILE_PIXELS), 1.0, 19.0))


def _draw_live(canvas: Canvas, scene: Scene, tracks: list[tuple[str, Stream]]) -> rrb.TimeSeriesView:
    """How many tracks and vessels were heard within ten minutes."""
    identity = scene.read(IDENTITY)
    curves = [("vessels", TRUTH, identity.publish_time_ns, identity["thing_id"])]
    for name, stream in tracks:
        curves.append((name, scene.colour(name), stream.publish_time_ns, stream["track_id"]))
    for name, colour, time_ns, numbers in curves:
        at_ns, live = live_counts(time_ns, numbers, LIVE_S)
        rows = thin(at_ns)
        _send_curve(canvas, f"plots/live/{name}", at_ns[rows], live[rows])
        canvas.fix(f"plots/live/{name}", LINE(names=[name], colors=[colour]))
    return plot_view("plots/live", f"Heard within {LIVE_S / 60:g} min")


def _send_curve(canvas: Canvas, entity: str, time_ns: Times, values: NDArray) -> None:
    canvas.send(entity, time_ns, rr.Scalars.columns(scalars=values.astype(float)))


def _draw_table(canvas: Canvas, scene: Scene, name: str, tracks: Stream) -> rrb.TextDocumentView:
    """Vessels with their shares, most reports first."""
    output = Output(name, "", "track", gather([tracks]), [scene.source])
    lines = ["|MMSI|reports|share|tracks|switches|", "|--:|--:|--:|--:|--:|"]
    for table in track_tables(reports_of(output)):
        shown = table[["thing", "reports", "share", "tracks", "switches"]][:LISTED_VESSELS]
        for thing, reports, share, count, switches in shown.itertuples(index=False):
            lines.append(f"|{thing}|{reports}|{share:.3f}|{count}|{switches}|")
        if len(table) > LISTED_VESSELS:
            lines.append(f"\n{len(table) - LISTED_VESSELS} more are in the study's tables")
    canvas.fix("vessels", rr.TextDocument("\n".join(lines), media_type="text/markdown"))
    return rrb.TextDocumentView(origin="vessels", name=f"Vessels in tracks of {name}")


TIMELINE = Timeline(draw)
