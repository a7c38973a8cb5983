"""The timeline of tracks: scans in the world, empty ones too, rays, ways of tracks, GOSPA."""

from pathlib import Path

import numpy as np

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.states import state_metadata
from fuselog.recorders.recording import SIMULATION_EPOCH_NS
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.families.tracking.judging.errors import instants_of, track_errors, tracks_at
from fuselog.replay.families.tracking.timeline import RAY_M
from fuselog.replay.timeline.show import show
from tests.replay.families.tracking.test_tracker import CAMERA, RADAR, SECOND, log, sensor
from tests.replay.timeline.making import PLANE, block, columns, ellipses, logged_late, path, unit
from tests.replay.timeline.reading import Wanted, check_clocks, check_views, compare, picture_of
from tests.replay.timeline.test_timeline import read, told


def test_the_map_holds_scans_rays_and_tracks(tmp_path: Path, uncompiled: None):
    """The sensors are on a ship that moves; its radar sees nothing at 15 s. All is logged late."""
    seconds = np.arange(24)
    stamps = SIMULATION_EPOCH_NS + seconds * SECOND
    own = np.stack([10.0 + seconds, -0.5 * seconds], axis=1)
    target = np.stack([2.0 * seconds, np.full(24, 100.0)], axis=1)
    seen = [[tuple(each)] for each in target - own]
    seen[15] = []
    bearings = [[np.arctan2(y, x)] for x, y in target - own]
    place = state_metadata(PLANE)
    ship = make_stream(
        "/ship/fix",
        schemas.POSITION_FIX,
        stamps,
        metadata=place,
        position_m=own,
        covariance_m2=np.full((24, 4), np.nan),
    )
    truth = make_stream("/vessel/truth", schemas.TRUTH_STATE, stamps, metadata=place, state=target)
    source = logged_late(
        log(
            [ship, truth],
            sensor("radar", {**RADAR, "origin": "/ship/fix"}, seconds, seen),
            sensor("camera", {**CAMERA, "origin": "/ship/fix"}, seconds, bearings),
            scenario="autoferry",
        )
    )
    outputs = collect(replay([source], bind("jipda", [source], {"kind": "tracker:jipda"})))
    show(source, outputs, [], save=tmp_path / "run.rrd")
    picture = picture_of(tmp_path / "run.rrd")
    tracks, sizes, existence, pairs = (
        outputs[f"/estimates/jipda/{leaf}"].stream
        for leaf in ("track", "set", "existence", "association")
    )
    assert set(tracks["track_id"]) == {1}
    heard = seconds[seconds != 15]
    way = columns(tracks, "mean", *PLANE)
    at_ns, truths, limit_m = instants_of(source)
    gospa = track_errors(tracks_at(sizes, tracks, at_ns), truths, unreferenced_m=limit_m).gospa
    at = (pairs.publish_time_ns - SIMULATION_EPOCH_NS) // SECOND
    last = np.searchsorted(tracks.publish_time_ns, pairs.publish_time_ns, side="right") - 1
    by_radar = pairs["sensor_id"] == pairs.metadata["sensors"].split(",").index("radar")
    lines = np.stack([way[last], target[at]], axis=1)[by_radar]
    away = RAY_M * unit(np.ravel(bearings))
    wanted = {
        "/map/scans/radar": Wanted("dots", stamps[heard], target[heard]),
        "/map/scans/camera": Wanted("lines", stamps, np.stack([own, own + away], axis=1)),
        "/map/ground/ship/fix": path(ship, own),
        "/map/ground/vessel/truth": path(truth, target),
        "/map/jipda/track1/way": path(tracks, way),
        "/map/jipda/track1/ellipse": ellipses(tracks, way, block(tracks, *PLANE)),
        "/map/jipda/associations/radar": Wanted("lines", pairs.publish_time_ns[by_radar], lines),
        "/plots/gospa/jipda": Wanted("curve", at_ns, gospa),
        "/plots/count/jipda": Wanted("curve", sizes.publish_time_ns, sizes["elements"]),
        "/plots/existence/track1": Wanted("curve", tracks.publish_time_ns, existence["existence"]),
        "/events/jipda": Wanted("told", tracks.publish_time_ns[:1], ["jipda: track 1 is confirmed"]),
    }
    compare(picture.moving, wanted)
    check_clocks(picture.moving, SIMULATION_EPOCH_NS, [each.stream for each in outputs.values()])
    empty = [len(row) == 0 for row in picture.moving["/map/scans/radar"]["Points2D:positions"]]
    assert np.flatnonzero(empty).tolist() == [15]
    assert picture.still["/legend/map"]["Points2D:labels"] == [["truth", "sensors", "radar", "camera"]]
    titles = {("GOSPA (m), c = 20 m", "plots/gospa"), ("Confirmed tracks (number)", "plots/count")}
    titles |= {
        ("Existence of each track (probability)", "plots/existence"),
        ("Events", "events"),
        ("jipda", "map/jipda"),
    }
    check_views(picture, titles, [])


def test_associations_and_what_happened(tmp_path: Path, uncompiled: None):
    """A hull gives two detections, which are one; its track is lost, and another one follows it.

    The other detection of every scan stands first, so that the hull's is the second one of its scan.
    """
    seconds = np.arange(50)
    seen = [
        [(500.0, -500.0 + 40.0 * second), (2.0 * second - 3.0, 100.0), (2.0 * second + 3.0, 100.0)]
        for second in seconds
    ]
    seen[16:31] = [[]] * 15
    truth = make_stream(
        "/vessel/truth",
        schemas.TRUTH_STATE,
        SIMULATION_EPOCH_NS + seconds * SECOND,
        metadata=state_metadata(("x_m", "y_m")),
        state=np.stack([2.0 * seconds, np.full(50, 100.0)], axis=1),
    )
    radar = sensor("radar", {**RADAR, "joined_within_m": "12.0"}, seconds, seen)
    source = logged_late(log([truth], radar, scenario="autoferry"))
    outputs = collect(
        replay([source], bind("hungarian", [source], {"kind": "tracker", "association": "hungarian"}))
    )
    show(source, outputs, [], save=tmp_path / "run.rrd")
    found = read(tmp_path / "run.rrd")
    texts = told(found["/events/hungarian"])
    tracks = outputs["/estimates/hungarian/track"].stream
    first, second = np.unique(tracks["track_id"])
    assert texts == [
        f"hungarian: track {first} is confirmed",
        f"hungarian: track {first} ends",
        f"hungarian: track {second} is confirmed",
        f"hungarian: target 1 switches from track {first} to track {second}",
    ]
    strips = found["/map/hungarian/associations/radar"]["LineStrips2D:strips"]
    lines = np.array([strip for row in strips for strip in row])
    pairs = outputs["/estimates/hungarian/association"].stream
    assert set(pairs["detection"]) == {1}
    elapsed_s = (pairs.publish_time_ns - SIMULATION_EPOCH_NS) / SECOND
    np.testing.assert_allclose(lines[:, 1, 0], 2.0 * elapsed_s, atol=1e-4)
    np.testing.assert_allclose(lines[:, 1, 1], 100.0, atol=1e-4)
    own = np.isin(tracks.publish_time_ns, pairs.publish_time_ns)
    np.testing.assert_allclose(lines[:, 0], tracks["mean"][own][:, [0, 2]], rtol=1e-5)
