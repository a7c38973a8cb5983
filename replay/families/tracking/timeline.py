"""Timeline of multi-target tracking: the scans of each sensor, and each track in its own colour.

The map has x east and y north. Detections stay visible until the sensor's next scan, so an empty scan
clears them; bearings are rays from the sensor's position. Lines connect a track to its associated
detections of positions; less probable associations are fainter. Next to the map are GOSPA, the number of
tracks and their probabilities of existence. Below the map are the events: when a track is confirmed or
ends, and when a target switches to another track.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.planes import frame_of
from fuselog.replay.engine.arrays import Integers
from fuselog.replay.engine.streams.detections import ORIGIN, places_of_sensor, rows_of
from fuselog.replay.engine.streams.measurements import PLANE, covariances_of, read_vectors
from fuselog.replay.families.tracking.ais_timeline import track_colours
from fuselog.replay.families.tracking.judging.clear_mot import NONE
from fuselog.replay.families.tracking.judging.errors import (
    TrackErrors,
    instants_of,
    target_topics,
    track_errors,
    tracks_at,
)
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.drawing.canvas import MUTED, PALETTE, TRUTH, Canvas, Colour, Scene, Timeline
from fuselog.replay.timeline.drawing.events import Happened, above_events, draw_events
from fuselog.replay.timeline.drawing.plane import (
    ROOT,
    Stroke,
    draw_lines,
    draw_outlines,
    draw_path,
    plane_view,
    turn_up,
    with_legend,
)
from fuselog.replay.timeline.drawing.plots import LINE, POINTS, below_legend, draw_curve, plot_view

# Length of a drawn bearing.
RAY_M = 300.0
SCANS = "scans"


def draw(canvas: Canvas, scene: Scene) -> rrb.Container | rrb.View:
    """Draw a map with all sensors for each tracker, in tabs, next to plots of all trackers."""
    turn_up(canvas)
    ground, paths, places = f"{ROOT}/ground", [], []
    for topic, place, stroke in _ways(scene):
        entity = f"{ground}{topic}"
        stream = scene.read(topic)
        draw_path(canvas, entity, stream.publish_time_ns, place, stroke)
        paths.append(entity)
        places.append(place)
    scans = _draw_scans(canvas, scene)
    shown = np.concatenate(places) if places else np.zeros((1, 2))
    colours = _legend(scene) | scans
    shared = [ground, f"{ROOT}/{SCANS}"]
    trackers = scene.outputs_of("", schemas.TRACK_ESTIMATE)
    boards = []
    for name, tracks in trackers:
        drawn = _draw_tracks(canvas, f"{ROOT}/{name}", tracks)
        _draw_associations(canvas, scene, name, tracks)
        view = plane_view(canvas, f"{ROOT}/{name}", shared, [*paths, *drawn], shown, name=name)
        boards.append(view)
    if not boards:
        return with_legend(canvas, ROOT, colours, plane_view(canvas, ground, shared, paths, shown))
    at_ns, errors = _errors(scene, trackers)
    plots = [
        _draw_gospa(canvas, scene, at_ns, errors),
        _draw_counts(canvas, scene),
        _draw_existence(canvas, scene, trackers),
    ]
    events = [each for name, tracks in trackers for each in _life(scene, name, tracks)]
    events += [each for name in errors for each in _switches(name, at_ns, errors[name])]
    board = with_legend(canvas, ROOT, colours, rrb.Tabs(*boards))
    board = above_events(board, draw_events(canvas, scene, "", also=events), share=4.0)
    return rrb.Horizontal(board, rrb.Vertical(*plots), column_shares=[3, 1])


def _ways(scene: Scene) -> Iterator[tuple[str, Floats, Stroke]]:
    """Yield known paths: the true paths of targets and the paths of sensors."""
    for topic in scene.source.topics.values():
        if topic.schema_name == schemas.TRUTH_STATE.full_name:
            yield topic.name, read_vectors(scene.read(topic.name), "state", PLANE), Stroke(TRUTH, 1.5)
        elif topic.schema_name == schemas.POSITION_FIX.full_name:
            yield topic.name, read_vectors(scene.read(topic.name), "position_m", PLANE), Stroke(MUTED)


def _legend(scene: Scene) -> dict[str, Colour]:
    """Return the colours of the true paths and of the sensors in the log."""
    schemas_of = {topic.schema_name for topic in scene.source.topics.values()}
    known = {"truth": (schemas.TRUTH_STATE, TRUTH), "sensors": (schemas.POSITION_FIX, MUTED)}
    return {name: colour for name, (of, colour) in known.items() if of.full_name in schemas_of}


def _draw_scans(canvas: Canvas, scene: Scene) -> dict[str, Colour]:
    """Draw the detections of every sensor, scan by scan; return the colours by sensor."""
    colours: dict[str, Colour] = {}
    scans = [each for each in scene.source.topics.values() if each.name.endswith("/scan")]
    for number, topic in enumerate(scans):
        prefix, colour = topic.name.removesuffix("/scan"), PALETTE[number % len(PALETTE)]
        scan, entity = scene.read(topic.name), f"{ROOT}/{SCANS}{prefix}"
        own = _own_places(scene, scan)
        colours[prefix.removeprefix("/").replace("_", " ")] = colour
        if f"{prefix}/detection" in scene.source.topics:
            seen = scene.read(f"{prefix}/detection")
            rows = rows_of(scan, seen)
            place = own[rows] + read_vectors(seen, "position_m", PLANE)
            order = np.argsort(rows, kind="stable")
            sizes = np.bincount(rows, minlength=len(scan))
            columns = rr.Points2D.columns(positions=place[order]).partition(sizes)
            canvas.send(entity, scan.publish_time_ns, columns)
            canvas.fix(entity, rr.Points2D.from_fields(**Stroke(colour, 1.5).fields(widen=2.0)))
        elif f"{prefix}/bearing" in scene.source.topics:
            seen = scene.read(f"{prefix}/bearing")
            begin, bearing = own[rows_of(scan, seen)], seen["bearing_rad"]
            away = RAY_M * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
            faint = np.tile(np.array([*colour, 90], np.uint8), (len(seen), 1))
            lines = np.stack([begin, begin + away], axis=1)
            draw_lines(canvas, entity, seen.publish_time_ns, lines, faint)
    return colours


def _own_places(scene: Scene, scan: Stream) -> Floats:
    """Find the positions (n, 2) of a sensor at its scans."""
    topic = scan.metadata.get(ORIGIN, "")
    return places_of_sensor(scan, scene.read(topic) if topic in scene.source.topics else None)


def _draw_tracks(canvas: Canvas, root: str, tracks: Stream) -> list[str]:
    """Draw the paths of all tracks and their 95 % ellipses; return the entities of the paths."""
    place, covariance = read_vectors(tracks, "mean", PLANE), covariances_of(tracks, PLANE)
    numbers = tracks["track_id"].astype(np.int64)
    ways = []
    for number in np.unique(numbers):
        rows = numbers == number
        [(red, green, blue)] = track_colours(np.array([number])).tolist()
        stroke, entity = Stroke((red, green, blue), 1.5), f"{root}/track{number}"
        time_ns = tracks.publish_time_ns[rows]
        draw_path(canvas, f"{entity}/way", time_ns, place[rows], stroke)
        draw_outlines(
            canvas, f"{entity}/ellipse", time_ns, ellipses(place[rows], covariance[rows]), stroke
        )
        ways.append(f"{entity}/way")
    return ways


def _draw_associations(canvas: Canvas, scene: Scene, name: str, tracks: Stream) -> None:
    """Draw lines from tracks to their associated detections of positions, in the tracks' colours."""
    for estimator, associations in scene.outputs_of("", schemas.ASSOCIATION):
        sensors = associations.metadata["sensors"].split(",") if estimator == name else []
        for number, sensor in enumerate(sensors):
            if f"/{sensor}/detection" not in scene.source.topics:
                continue
            own = associations.take(associations["sensor_id"] == number)
            scan = scene.read(f"/{sensor}/scan")
            seen = _joined(scan, scene.read(f"/{sensor}/detection"))
            first = np.searchsorted(seen.scan, np.arange(len(scan)))
            row = rows_of(scan, own)
            end = _own_places(scene, scan)[row] + seen.place[first[row] + own["detection"]]
            begin, is_there = _places_of(tracks, own)
            colours = np.empty((len(own), 4), np.uint8)
            colours[:, :3] = track_colours(own["track_id"].astype(np.int64))
            colours[:, 3] = np.rint(255.0 * own["probability"])
            lines = np.stack([begin, end], axis=1)[is_there]
            entity = f"{ROOT}/{name}/associations/{sensor}"
            draw_lines(canvas, entity, own.publish_time_ns[is_there], lines, colours[is_there])


class Joined(NamedTuple):
    """Detections of a sensor in the form that trackers use: rows of scans, and relative positions."""

    scan: Integers
    place: Floats


def _joined(scan: Stream, seen: Stream) -> Joined:
    """Replace each chain of near detections of a scan by its mean, in order of their first detections.

    The distance is read from the metadata of the scans' channel; see
    `fuselog.replay.families.tracking.association.scanning.join_near`.
    """
    row, place = rows_of(scan, seen), read_vectors(seen, "position_m", PLANE)
    order = np.argsort(row, kind="stable")
    row, place = row[order], place[order]
    within = float(scan.metadata.get("joined_within_m", 0.0))
    if within == 0.0 or not len(row):
        return Joined(row, place)
    apart = cKDTree(np.column_stack([place, row * 2.0 * within])).query_pairs(
        within, output_type="ndarray"
    )
    pairs = coo_matrix((np.ones(len(apart)), apart.T), (len(row), len(row)))
    count, group = connected_components(pairs, directed=False)
    first = np.unique(group, return_index=True)[1]
    sums = [np.bincount(group, axis, count) for axis in place.T]
    means = np.stack(sums, axis=1) / np.bincount(group)[:, None]
    by_first = np.argsort(first)
    return Joined(row[first[by_first]], means[by_first])


def _places_of(tracks: Stream, associations: Stream) -> tuple[Floats, NDArray[np.bool_]]:
    """Find the positions (n, 2) of associated tracks at a given time, and whether each is known."""
    keys = [
        np.stack([stream.publish_time_ns, stream["track_id"].astype(np.int64)], axis=1)
        for stream in (tracks, associations)
    ]
    _, number = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    of_track, wanted = np.split(number.ravel(), [len(tracks)])
    order = np.argsort(of_track, kind="stable")
    at = np.searchsorted(of_track[order], wanted, side="right") - 1
    found = order[np.maximum(at, 0)]
    return read_vectors(tracks, "mean", PLANE)[found], of_track[found] == wanted


def _life(scene: Scene, name: str, tracks: Stream) -> Iterator[Happened]:
    """Yield events for the confirmation and the end of each track."""
    numbers, times = tracks["track_id"].astype(np.int64), tracks.publish_time_ns
    scans_ns = dict(scene.outputs_of("", schemas.ESTIMATE_SIZE))[name].publish_time_ns
    for number in np.unique(numbers):
        own = times[numbers == number]
        yield Happened(name, "INFO", own[:1], [f"track {number} is confirmed"])
        if own[-1] < scans_ns[-1]:
            after = scans_ns[scans_ns > own[-1]]
            yield Happened(name, "INFO", after[:1], [f"track {number} ends"])


def _switches(name: str, at_ns: Integers, errors: TrackErrors) -> Iterator[Happened]:
    """Yield an event whenever a target switches to another track."""
    for target, track in enumerate(errors.kept, start=1):
        followed = np.flatnonzero(track != NONE)
        for row in np.flatnonzero(np.diff(track[followed])):
            before, now = track[followed[row]], track[followed[row + 1]]
            text = f"target {target} switches from track {before} to track {now}"
            yield Happened(name, "WARN", at_ns[followed[row + 1] :][:1], [text])


def _errors(scene: Scene, trackers: list[tuple[str, Stream]]) -> tuple[Integers, dict[str, TrackErrors]]:
    """Compute each tracker's errors at the judged instants; without scans or truths, there are none."""
    try:
        judged = instants_of(scene.source)
    except BadInput:
        return np.empty(0, np.int64), {}
    sizes = dict(scene.outputs_of("", schemas.ESTIMATE_SIZE))
    topics = scene.source.topics
    frames = {frame_of(topics[topic].metadata) for topic in target_topics(topics)}
    return judged.time_ns, {
        name: track_errors(
            tracks_at(sizes[name], tracks, judged.time_ns),
            judged.truths,
            unreferenced_m=judged.unreferenced_m,
        )
        for name, tracks in trackers
        if frames == {frame_of(tracks.metadata)}
    }


def _draw_gospa(
    canvas: Canvas, scene: Scene, at_ns: Integers, errors: Mapping[str, TrackErrors]
) -> rrb.TimeSeriesView:
    for name, of_tracker in errors.items():
        draw_curve(canvas, "plots/gospa", name, scene.colour(name), at_ns, of_tracker.gospa, LINE)
    extent = below_legend([of_tracker.gospa for of_tracker in errors.values()])
    return plot_view("plots/gospa", "GOSPA", "m", extent, note=", c = 20 m", zoom_lock=False)


def _draw_counts(canvas: Canvas, scene: Scene) -> rrb.TimeSeriesView:
    """Plot the number of tracks."""
    drawn = []
    for name, sizes in scene.outputs_of("", schemas.ESTIMATE_SIZE):
        counts = sizes["elements"].astype(float)
        draw_curve(canvas, "plots/count", name, scene.colour(name), sizes.publish_time_ns, counts, LINE)
        drawn.append(counts)
    extent = below_legend(drawn)
    return plot_view("plots/count", "Confirmed tracks", "number", extent, zoom_lock=False)


def _draw_existence(
    canvas: Canvas, scene: Scene, trackers: list[tuple[str, Stream]]
) -> rrb.TimeSeriesView:
    """Plot the probability of existence of each track of the first tracker."""
    existence = dict(scene.outputs_of("", schemas.EXISTENCE))
    for name, tracks in trackers[:1]:
        numbers = tracks["track_id"].astype(np.int64)
        for number in np.unique(numbers):
            rows = numbers == number
            [(red, green, blue)] = track_colours(np.array([number])).tolist()
            time_ns, values = tracks.publish_time_ns[rows], existence[name]["existence"][rows]
            entity = "plots/existence"
            draw_curve(canvas, entity, f"track{number}", (red, green, blue), time_ns, values, POINTS)
    return plot_view(
        "plots/existence", "Existence of each track", "probability", (0.0, 1.0), legend=False
    )


TIMELINE = Timeline(draw)
