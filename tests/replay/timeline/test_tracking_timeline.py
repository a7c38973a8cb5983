"""The timeline of tracks: scans in the world, empty ones too, rays, ways of tracks, GOSPA."""

from pathlib import Path

import numpy as np

from recorders.log import make_stream, schemas
from recorders.models.states import state_metadata
from recorders.recording import SIMULATION_EPOCH_NS
from replay.engine.replaying.estimator import bind
from replay.engine.replaying.replaying import collect, replay
from replay.judging.tracks.errors import instants_of, track_errors, tracks_at
from replay.timeline.show import show
from tests.replay.estimators.test_tracker import CAMERA, RADAR, SECOND, log, passing, sensor
from tests.replay.timeline.reading import Wanted, check_views, compare, picture_of
from tests.replay.timeline.test_timeline import read, told


def test_the_map_holds_scans_rays_and_tracks(tmp_path: Path, uncompiled: None):
    """The sensors are on a ship at (10, 0); its radar sees nothing at 15 s."""
    seconds = np.arange(24)
    stamps = SIMULATION_EPOCH_NS + seconds * SECOND
    seen = [[(x - 10.0, y)] for [(x, y)] in passing(24)]
    seen[15] = []
    bearings = [[np.arctan2(100.0, 2.0 * second - 10.0)] for second in seconds]
    place = state_metadata(("x_m", "y_m"))
    ship = make_stream(
        "/ship/fix",
        schemas.POSITION_FIX,
        stamps,
        metadata=place,
        position_m=np.tile([10.0, 0.0], (24, 1)),
        covariance_m2=np.full((24, 4), np.nan),
    )
    truth = make_stream(
        "/vessel/truth",
        schemas.TRUTH_STATE,
        stamps,
        metadata=place,
        state=np.stack([2.0 * seconds, np.full(24, 100.0)], axis=1),
    )
    source = log(
        [ship, truth],
        sensor("radar", {**RADAR, "origin": "/ship/fix"}, seconds, seen),
        sensor("camera", {**CAMERA, "origin": "/ship/fix"}, seconds, bearings),
        scenario="autoferry",
    )
    outputs = collect(replay([source], bind("jipda", [source], {"kind": "tracker:jipda"})))
    show(source, outputs, [], save=tmp_path / "run.rrd")
    found = read(tmp_path / "run.rrd")
    points = found["/map/scans/radar"]["Points2D:positions"]
    assert [len(row) for row in points] == [1] * 15 + [0] + [1] * 8
    np.testing.assert_allclose(np.concatenate(points[:3]), [[0, 100], [2, 100], [4, 100]], atol=1e-5)
    rays = [strip for row in found["/map/scans/camera"]["LineStrips2D:strips"] for strip in row]
    np.testing.assert_allclose(np.array(rays)[:, 0], np.tile([10, 0], (24, 1)), atol=1e-5)
    tracks = outputs["/estimates/jipda/track"].stream
    assert set(tracks["track_id"]) == {1}
    way = found["/map/jipda/track1/way"]["LineStrips2D:strips"]
    assert len(way) == len(tracks) - 1
    np.testing.assert_allclose(way[-1][0][1], tracks["mean"][-1][[0, 2]], rtol=1e-5)
    legend = read(tmp_path / "run.rrd", static=True)["/map/legend"]
    assert legend["Points2D:labels"] == [["truth", "sensors", "radar", "camera"]]
    at_ns, truths = instants_of(source)
    sizes = outputs["/estimates/jipda/set"].stream
    gospa = track_errors(tracks_at(sizes, tracks, at_ns), truths).gospa
    existence = outputs["/estimates/jipda/existence"].stream
    curves = {
        "gospa/jipda": (at_ns, gospa),
        "count/jipda": (sizes.publish_time_ns, sizes["elements"]),
        "existence/track1": (tracks.publish_time_ns, existence["existence"]),
    }
    picture = picture_of(tmp_path / "run.rrd")
    plots = {name: picture.moving[f"/plots/{name}"] for name in curves}
    compare(plots, {name: Wanted("curve", *curve) for name, curve in curves.items()})
    titles = {("GOSPA (m), c = 20 m", "plots/gospa"), ("Confirmed tracks", "plots/count")}
    titles |= {("Existence", "plots/existence"), ("Events", "events"), ("jipda", "map/jipda")}
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
    source = log([truth], radar, scenario="autoferry")
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
        f"hungarian: target 1 goes on with track {second}, before with {first}",
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
