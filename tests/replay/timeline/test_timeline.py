"""The timeline: what a .rrd holds, live streams, pictures, and what is refused."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit
from urllib.request import urlopen

import matplotlib.image
import numpy as np
import psutil
import pyarrow as pa
import pytest
import rerun as rr
import rerun.chunk as rc
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from scipy.stats import chi2

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, open_log, schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect
from fuselog.replay.engine.replaying.replaying import replay as replayed
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.measurements import PLANE, covariances_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, memory_source
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import Errors, chi_square_interval
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.drawing.canvas import DRAWN_ROWS, PALETTE, thin
from fuselog.replay.timeline.landmarks import GATED
from fuselog.replay.timeline.show import Drawing, read_moments, show, worst_at
from fuselog.replay.timeline.sinks import open_recording
from fuselog.replay.timeline.viewer import Listener, listen, screenshot, view
from tests.conftest import heeding_interrupts

SENSOR = {"rate_hz": 5.0, "outlier_probability": 0.05, "outages_per_minute": 9.0, "outage_s": 2.0}
RUN = 1
# The colours of the viewer's badges and warnings, and of its notices.
BADGE, NOTICE = (255, 122, 12), (173, 187, 255)
Columns = dict[str, list]


class Replayed(NamedTuple):
    """An ensemble, what the estimators made of it, and how well."""

    sources: list[MemorySource]
    outputs: dict[str, Ragged]
    errors: list[Errors]


def replay_landmarks(runs: int, duration_s: float) -> Replayed:
    scenario = {"duration_s": duration_s, "range_bearing": SENSOR}
    sources = [memory_source(*record_run("landmarks", scenario, 3, run)) for run in range(runs)]
    bound = [each for name in ("dead-reckoning", "ekf") for each in bind(name, sources, {})]
    outputs = collect(replayed(sources, bound))
    found = Judge(sources, {}, gap_limit_s=0.2).add(outputs).errors
    return Replayed(sources, outputs, [each for each in found if each is not None])


@pytest.fixture(scope="module")
def ensemble() -> Replayed:
    return replay_landmarks(2, 20.0)


@pytest.fixture(scope="module")
def rrd(ensemble: Replayed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("timeline") / "run.rrd"
    show(ensemble.sources[RUN], ensemble.outputs, ensemble.errors, run=RUN, save=path)
    return path


def read(path: Path, *, static: bool = False) -> dict[str, Columns]:
    """Entity -> column -> a list per row, as any reader of the file gets them."""
    found: dict[str, Columns] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a live stream's file has no footer
        chunks = list(rc.RrdReader(str(path)).stream())
    for chunk in chunks:
        batch = chunk.to_record_batch()
        for name in batch.schema.names[1:]:  # the first is Rerun's own row id, which is random
            column = batch.column(name)
            if pa.types.is_temporal(column.type):
                column = column.cast("int64")
            if chunk.is_static == static:
                found.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(column.to_pylist())
    return found


def told(events: Columns) -> list[str]:
    """What events say, without the time of the run that each opens with: the viewer's column cuts it."""
    texts = [text for (text,) in events["TextLog:text"]]
    stamps = [text.partition(" s, ")[0] for text in texts]
    assert stamps == [f"{time_ns * 1e-9:.3f}" for time_ns in events["sim_time"]]
    return [text.partition(" s, ")[2] for text in texts]


def views(path: Path) -> set[str]:
    """The names of all views of a file's layout."""
    reader, name = rc.RrdReader(str(path)), "ViewBlueprint:display_name"
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=reader.blueprints()[0])]
    rows = [row for batch in batches if name in batch.schema.names for row in batch.column(name)]
    return {each for row in rows for each in row.as_py()}


def of_run(errors: list[Errors], estimator: str) -> tuple[Errors, np.ndarray]:
    (found,) = [each for each in errors if each.estimator == estimator]
    return found, found.run == RUN


def test_a_file_says_what_it_is_and_has_a_layout(rrd: Path) -> None:
    reader = rc.RrdReader(str(rrd))
    (recording,) = reader.recordings()
    assert recording.application_id == "fuselog-landmarks"
    assert len(reader.blueprints()) == 1
    indexes = reader.stream().collect().schema().index_columns()
    assert {each.name for each in indexes} == {"step", "sim_time", "utc"}


def test_plots_hold_the_errors_of_the_run_with_their_bands_and_bounds(
    rrd: Path, ensemble: Replayed
) -> None:
    found = read(rrd)
    for estimator in ("dead-reckoning", "ekf"):
        errors, rows = of_run(ensemble.errors, estimator)
        for column, (component, scale) in enumerate(
            [("x_m", 1.0), ("y_m", 1.0), ("heading_rad", 180 / np.pi)]
        ):
            plot = found[f"/plots/robot1/error_{component}/{estimator}"]
            values = np.array(plot["Measurements:values"])
            np.testing.assert_allclose(values[:, 0], scale * errors.error[rows, column], rtol=1e-12)
            assert not values[:, 1].any()
            sigma = scale * np.sqrt(errors.covariance[rows, column, column])
            variances = np.array(plot["Measurements:variances"])
            np.testing.assert_allclose(np.sqrt(variances[:, 1]), 2 * sigma, rtol=1e-12)
        nees = found[f"/plots/robot1/nees_3/{estimator}"]
        assert np.array_equal(np.ravel(nees["Scalars:scalars"]), errors.nees[rows])
        assert np.array_equal(nees["utc"], errors.time_ns[rows])
        assert np.array_equal(nees["step"], errors.step[rows])
        np.testing.assert_allclose(nees["sim_time"], errors.elapsed_s[rows] * 1e9, atol=1)
    band = found["/plots/robot1/nees_3/bounds"]
    middle = np.array(band["Measurements:values"])[:, 0]
    half = np.sqrt(np.array(band["Measurements:variances"])[:, 0])
    np.testing.assert_allclose(
        [middle - half, middle + half], np.tile(chi_square_interval(3, 1), (2, 1)).T
    )
    innovations = ensemble.outputs["/estimates/ekf/robot1/innovation"].of_run(RUN)
    nis = np.ravel(found["/plots/robot1/nis_2/ekf"]["Scalars:scalars"])
    assert np.array_equal(nis, innovations["normalised_innovation_squared"])


def test_mode_probabilities_are_plots(tmp_path: Path) -> None:
    """A curve for every mode, by the filter and given all data; drawn by the timeline of any log."""
    source = memory_source(*record_run("manoeuvres", {"duration_s": 20.0}, 3, 0))
    outputs = collect(replayed([source], bind("imm", [source], {"smoothed_modes": True})))
    show(source, outputs, [], save=tmp_path / "run.rrd")
    found = read(tmp_path / "run.rrd")
    for topic in ("modes", "smoothed_modes"):
        probability = outputs[f"/estimates/imm/vehicle1/{topic}"]["probability"]
        for column, mode in enumerate(("drive", "manoeuvre", "stand")):
            curve = found[f"/plots/vehicle1/{topic}/imm/{mode}"]
            assert np.array_equal(np.ravel(curve["Scalars:scalars"]), probability[:, column])


def test_vehicles_have_their_particles_and_a_tab_for_their_modes(tmp_path: Path) -> None:
    """Particles lie on the map where they are, and close up beside the true place if they are near."""
    source = memory_source(*record_run("vehicles", {"duration_s": 5.0, "vehicles": 2}, 1, 0))
    settings: dict[str, dict[str, object]] = {
        "cloud": {"kind": "particles:50", "model": "vehicle", "cloud": True},
        "imm": {"model": "vehicle", "smoothed_modes": True},
    }
    bound = [each for name in settings for each in bind(name, [source], settings[name])]
    outputs = collect(replayed([source], bound))
    show(source, outputs, [], save=tmp_path / "run.rrd")
    found = read(tmp_path / "run.rrd")
    left_out = 0
    for number, case in enumerate(("vehicle1", "vehicle2")):
        cloud, truth = outputs[f"/estimates/cloud/{case}/particle"], source.streams[f"/{case}/truth"]
        places = cloud["mean"].reshape(5, 50, 4)[:, :, 0::2]
        weights = cloud["weight"].reshape(5, 50)
        at = np.searchsorted(truth.publish_time_ns, cloud.stream.publish_time_ns[::50])
        apart = places - truth["state"][at, None, 0::2]
        is_near = np.abs(apart).max(axis=2) < 3.8
        left_out += np.count_nonzero(~is_near)
        beside = apart + np.array([8.0 * number, 0.0])
        everywhere = np.ones_like(is_near)
        for entity, expected, is_drawn in (("map", places, everywhere), ("close", beside, is_near)):
            points = found[f"/map/{entity}/{case}/cloud/particles"]
            for step in range(5):
                drawn, radii = (points[f"Points2D:{name}"][step] for name in ("positions", "radii"))
                np.testing.assert_allclose(drawn, expected[step, is_drawn[step]], rtol=1e-5, atol=1e-5)
                area = 1.5**2 * 50 * weights[step, is_drawn[step]]
                np.testing.assert_allclose(np.square(radii), area, rtol=1e-4, atol=1e-9)
        for topic in ("modes", "smoothed_modes"):
            probability = outputs[f"/estimates/imm/{case}/{topic}"]["probability"]
            curve = found[f"/plots/{case}/{topic}/imm/stand"]["Scalars:scalars"]
            assert np.array_equal(np.ravel(curve), probability[:, 2])
        kinds = ("Modes of imm (probability)", "Smoothed modes of imm (probability)")
        tabs = {f"{kind}, {case}" for kind in (*kinds, "Effective particles (share)")}
        assert tabs <= views(tmp_path / "run.rrd")
    assert 0 < left_out < 250


def test_the_map_holds_poses_paths_and_ellipses_in_true_coordinates(
    rrd: Path, ensemble: Replayed
) -> None:
    found = read(rrd)
    stream = ensemble.outputs["/estimates/ekf/robot1/pose"].of_run(RUN)
    truth = ensemble.sources[RUN].streams["/robot1/truth"]
    for name, states in (("ekf", stream["mean"]), ("truth", truth["state"])):
        pose = found[f"/map/robot1/{name}/pose"]
        np.testing.assert_allclose(np.array(pose["Arrows2D:origins"])[:, 0], states[:, :2], rtol=1e-6)
        arrow = np.array(pose["Arrows2D:vectors"])[:, 0]
        heading = np.arctan2(arrow[:, 1], arrow[:, 0])
        np.testing.assert_allclose(np.cos(heading - states[:, 2]), 1.0, atol=1e-6)
        path = np.array(found[f"/map/robot1/{name}/path"]["LineStrips2D:strips"])[:, 0]
        np.testing.assert_allclose(path[:, 0], states[:-1, :2], rtol=1e-6)
        np.testing.assert_allclose(path[:, 1], states[1:, :2], rtol=1e-6)
    outlines = np.array(found["/map/robot1/ekf/ellipse"]["LineStrips2D:strips"])[:, 0]
    away = outlines - stream["mean"][:, None, :2]
    precision = np.linalg.inv(stream["covariance"].reshape(-1, 3, 3)[:, :2, :2])
    squared = np.einsum("nvi,nij,nvj->nv", away, precision, away)
    np.testing.assert_allclose(squared, chi2.ppf(0.95, 2), rtol=1e-3)
    landmarks = ensemble.sources[RUN].streams["/landmarks"]
    points = read(rrd, static=True)["/map/landmarks"]
    np.testing.assert_allclose(points["Points2D:positions"][0], landmarks["position_m"], rtol=1e-6)
    assert points["Points2D:labels"][0] == [str(number) for number in landmarks["landmark_id"]]


def test_events_tell_what_came_late(ensemble: Replayed, tmp_path: Path) -> None:
    """What was left out, and what an estimator went back for, at their stamps."""
    begin_ns = ensemble.sources[0].epoch_ns
    became = [
        make_stream(
            "/estimates/ekf/robot1/skipped",
            schemas.SKIPPED,
            [begin_ns + 10**9],
            metadata={"reasons": '["too late"]'},
            reason=[0],
        ),
        make_stream(
            "/estimates/ekf/robot1/rewound",
            schemas.REWOUND,
            [begin_ns + 2 * 10**9],
            log_time_ns=[begin_ns + 2 * 10**9 + 250_000_000],
            repeated=[3],
        ),
        make_stream(
            "/estimates/ekf/robot1/waited", schemas.WAITED, [begin_ns + 3 * 10**9], behind_s=[0.125]
        ),
    ]
    outputs = {each.topic: gather([each]) for each in became}
    show(ensemble.sources[0], outputs, [], save=tmp_path / "late.rrd")
    events = read(tmp_path / "late.rrd")["/events/robot1/ekf"]
    assert dict(zip(events["utc"], told(events), strict=True)) == {
        begin_ns + 10**9: "ekf: not used: too late",
        begin_ns + 2 * 10**9: "ekf: came 0.250 s late: 3 messages after it were reprocessed",
        begin_ns + 3 * 10**9: "ekf: came late, 0.125 s behind newer messages, which waited for it",
    }


def test_sight_lines_go_to_what_is_seen_and_vanish_with_it(rrd: Path, ensemble: Replayed) -> None:
    seen = ensemble.sources[RUN].streams["/robot1/range_bearing"]
    innovations = ensemble.outputs["/estimates/ekf/robot1/innovation"].of_run(RUN)
    looks, counts = np.unique(seen.publish_time_ns, return_counts=True)
    lines = read(rrd)["/map/robot1/sights"]
    times = np.array(lines["utc"])
    sizes = np.array([len(each) for each in lines["LineStrips2D:strips"]])
    assert np.array_equal(times[sizes > 0], looks)
    assert np.array_equal(sizes[sizes > 0], counts)
    assert (sizes == 0).sum() >= 2  # the outages
    assert np.diff(times)[sizes[:-1] > 0].max() <= 1.5 * 0.2e9
    red = int.from_bytes(bytes(GATED), "big")
    drawn_red = sum(colours.count(red) for colours in lines["LineStrips2D:colors"])
    assert drawn_red == (innovations["accepted"] == 0).sum() > 0
    places = ensemble.sources[RUN].streams["/landmarks"]
    place_of = dict(zip(places["landmark_id"].tolist(), places["position_m"], strict=True))
    ends = np.concatenate([np.array(each)[:, 1] for each in lines["LineStrips2D:strips"] if each])
    order = np.lexsort((seen["target_id"], seen.publish_time_ns))
    expected = [place_of[target] for target in seen["target_id"][order].tolist()]
    np.testing.assert_allclose(ends, expected, rtol=1e-6)


def test_events_tell_gated_measurements_dropouts_and_failures(
    rrd: Path, ensemble: Replayed, tmp_path: Path
) -> None:
    found = read(rrd)
    innovations = ensemble.outputs["/estimates/ekf/robot1/innovation"].of_run(RUN)
    gated = innovations.take(innovations["accepted"] == 0)
    texts = told(found["/events/robot1/ekf"])
    assert len(texts) == len(gated)
    assert texts[0].startswith(f"ekf: rejected range_bearing of target {gated['target_id'][0]}: NIS ")
    outages = ensemble.sources[RUN].streams["/robot1/range_bearing/outages"]
    dropouts = found["/events/robot1/range_bearing"]
    assert dropouts["utc"] == outages.publish_time_ns.tolist()
    assert set(told(dropouts)) == {"range_bearing: outage of 2.0 s"}

    source = ensemble.sources[0]
    without = {topic: each for topic, each in source.streams.items() if not topic.endswith("outages")}
    failure = make_stream(
        "/estimates/ekf:2/robot1/failure",
        schemas.FAILURE,
        [source.streams["/robot1/truth"].publish_time_ns[9]],
        metadata={"reasons": '["one; two", "another"]'},
        reason=[1],
    )
    show(
        replace(source, streams=without), {failure.topic: gather([failure])}, [], save=tmp_path / "a.rrd"
    )
    found = read(tmp_path / "a.rrd")
    assert told(found["/events/robot1/ekf\\:2"]) == ["ekf:2: failed: another"]
    silent = told(found["/events/robot1/range_bearing"])
    pauses_s = np.diff(np.unique(source.streams["/robot1/range_bearing"].publish_time_ns)) * 1e-9
    assert silent == [f"range_bearing: no messages for {pause:.1f} s" for pause in pauses_s if pause > 1]
    assert silent


def test_the_same_replay_is_the_same_recording_and_another_is_not(
    rrd: Path, ensemble: Replayed, tmp_path: Path
) -> None:
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    show(ensemble.sources[RUN], ensemble.outputs, ensemble.errors, run=RUN, save=again)
    ekf = {topic: each for topic, each in ensemble.outputs.items() if "/ekf/" in topic}
    show(ensemble.sources[RUN], ekf, ensemble.errors, run=RUN, save=other)
    names = [rc.RrdReader(str(path)).recordings()[0].recording_id for path in (rrd, again, other)]
    assert names[0] == names[1] != names[2]
    assert read(rrd) == read(again)
    assert read(rrd, static=True) == read(again, static=True)


@pytest.mark.paper
def test_a_long_run_is_thinned_and_says_so(tmp_path: Path) -> None:
    long = replay_landmarks(1, 300.0)
    show(long.sources[0], long.outputs, long.errors, save=tmp_path / "long.rrd")
    found = read(tmp_path / "long.rrd")
    assert len(long.outputs["/estimates/ekf/robot1/pose"]) > DRAWN_ROWS
    rows = {entity: len(columns["utc"]) for entity, columns in found.items()}
    assert rows["/plots/robot1/error_x_m/ekf"] == DRAWN_ROWS
    assert max(rows.values()) <= DRAWN_ROWS
    assert told(found["/events/robot1/ekf"])[0] == "ekf: drawn at 16.7 Hz instead of 20 Hz"


@given(st.lists(st.integers(0, 10**12), min_size=1), st.integers(1, 50))
def test_thinning_keeps_the_last_of_every_span(times: list[int], rows: int) -> None:
    time_ns = np.sort(np.array(times))
    kept = thin(time_ns, rows)
    assert len(kept) <= max(rows, 1)
    assert kept[-1] == len(time_ns) - 1
    assert np.all(np.diff(kept) > 0)
    if len(time_ns) > rows:
        span_ns = max((time_ns[-1] - time_ns[0]) / rows, 1.0)
        nearest_ns = np.abs(time_ns[:, None] - time_ns[kept]).min(axis=1)
        assert nearest_ns.max() <= span_ns


@given(st.integers(0, 2**32 - 1))
def test_ellipses_lie_on_the_chosen_level_and_are_nan_without_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    means, roots = rng.normal(size=(2, 2)), rng.normal(size=(2, 2, 2))
    covariances = roots @ roots.transpose(0, 2, 1) + 1e-3 * np.eye(2)
    covariances[1] -= 2 * np.trace(covariances[1]) * np.eye(2)
    outlines = ellipses(means, covariances, 0.9)
    away = outlines[0] - means[0]
    squared = np.sum(away * np.linalg.solve(covariances[0], away.T).T, axis=1)
    np.testing.assert_allclose(squared, chi2.ppf(0.9, 2), rtol=1e-6)
    np.testing.assert_allclose(outlines[0, 0], outlines[0, -1], rtol=1e-9, atol=1e-9)
    assert np.isnan(outlines[1]).any()
    flat = ellipses(means, np.array([np.zeros((2, 2)), [[0.0, 1.0], [1.0, 0.0]]]))
    assert not np.isfinite(flat).all(axis=(1, 2)).any()


def test_a_scenario_without_a_timeline_gets_every_component(ensemble: Replayed, tmp_path: Path) -> None:
    source = ensemble.sources[0]
    assert source.run is not None
    unknown = replace(source, run=replace(source.run, scenario="unheard-of"))
    show(unknown, ensemble.outputs, ensemble.errors, save=tmp_path / "generic.rrd")
    found = read(tmp_path / "generic.rrd")
    assert {"/map/robot1/truth/path", "/map/robot1/ekf/pose"} <= found.keys()
    truth = source.streams["/robot1/truth"]["state"]
    drawn = np.ravel(found["/plots/robot1/heading_rad/truth"]["Scalars:scalars"])
    np.testing.assert_allclose(drawn, np.degrees(truth[:, 2]), rtol=1e-12)
    assert {f"/plots/robot1/{plot}/ekf" for plot in ("x_m", "error_x_m", "nees_3", "nis_2")} <= set(
        found
    )


def test_a_log_that_no_family_draws_is_drawn_by_schema(tmp_path: Path) -> None:
    """Fixes and landmarks on the plane, numbers as plots, and what is no numbers among the events."""
    time_ns = np.arange(5 * 10**9, 6 * 10**9, 10**8)
    places, pressure = np.stack([np.arange(10.0), np.arange(10.0) ** 2], axis=1), np.ones((10, 2))
    streams = [
        make_stream("/landmarks", schemas.LANDMARK, [2 * 10**9], landmark_id=[7], position_m=[[1, 2]]),
        make_stream(
            "/gps/fix",
            schemas.POSITION_FIX,
            time_ns,
            position_m=places,
            covariance_m2=np.full((10, 4), np.nan),
        ),
        make_stream(
            "/beacon", schemas.BEARING, time_ns, target_id=np.ones(10), bearing_rad=np.full(10, np.pi)
        ),
        make_stream("/air", schemas.VECTOR_MEASUREMENT, time_ns, value=pressure),
    ]
    path = tmp_path / "bare.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        said = writer.register_schema("Said", "jsonschema", b"{}")
        channel = writer.register_channel("/said", "json", said)
        writer.add_message(channel, 5 * 10**9, b"{}", 5 * 10**9)
        for stream in streams:
            schema = stream.schema
            number = writer.register_schema(schema.full_name, "protobuf", schema.descriptor_set)
            channel = writer.register_channel(stream.topic, "protobuf", number)
            for row, stamp_ns in enumerate(stream.publish_time_ns.tolist()):
                values = {name: column[row].tolist() for name, column in stream.columns.items()}
                data = schema.message_class(**values).SerializeToString()
                writer.add_message(channel, stamp_ns, data, stamp_ns)
        writer.finish()
    show(LogSource(open_log(path)), {}, [], save=tmp_path / "bare.rrd")
    found = read(tmp_path / "bare.rrd")
    assert found["/map/gps/fix"]["Points2D:positions"] == [[row] for row in places.tolist()]
    assert found["/plots/beacon/bearing_rad/bearing_rad"]["Scalars:scalars"] == [[180.0]] * 10
    assert {"/plots/air/value/0", "/plots/air/value/1", "/plots/gps/fix/position_m/1"} <= found.keys()
    assert found["/plots/air/value/0"]["sim_time"][0] == 3 * 10**9  # since the first stamp, the map's
    (event,) = found["/events/log"]["TextLog:text"]
    assert "/said is not drawn" in event[0]
    assert "/map/landmarks" in read(tmp_path / "bare.rrd", static=True)


def drawn_bare(streams: list[Stream], path: Path) -> dict[str, Columns]:
    """What is drawn of streams that no family knows."""
    source = MemorySource({each.topic: each for each in streams}, RunMetadata("unheard-of"), "bare")
    show(source, {}, [], save=path)
    return read(path)


def test_what_sensors_see_is_drawn_about_them_and_on_the_map(tmp_path: Path) -> None:
    """Ranges are circles, bearings rays, detections points; landmarks are sighted from the robot."""
    time_ns = np.arange(0, 10**9, 10**8)
    truth = {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"}
    twice, ids = np.repeat(time_ns, 2), np.tile([1, 2], 10)
    away_m, angle_rad = np.linspace(1.0, 3.0, 20), np.linspace(0.0, 6.0, 20)
    seen = np.stack([away_m * np.cos(angle_rad), away_m * np.sin(angle_rad)], axis=1)
    streams = [
        make_stream(
            "/landmarks", schemas.LANDMARK, [0, 0], landmark_id=[1, 2], position_m=[[5, 0], [0, 5]]
        ),
        make_stream("/truth", schemas.TRUTH_STATE, time_ns, metadata=truth, state=np.ones((10, 3))),
        make_stream("/beacon", schemas.RANGE, twice, target_id=ids, range_m=away_m),
        make_stream("/camera", schemas.BEARING, twice, target_id=ids, bearing_rad=angle_rad),
        make_stream(
            "/lidar", schemas.RANGE_BEARING, twice, target_id=ids, range_m=away_m, bearing_rad=angle_rad
        ),
        make_stream(
            "/radar", schemas.DETECTION, twice, scan_id=np.repeat(range(10), 2), position_m=seen
        ),
    ]
    found = drawn_bare(streams, tmp_path / "bare.rrd")
    circles = np.array(found["/about/beacon/seen"]["LineStrips2D:strips"][:10])
    np.testing.assert_allclose(np.linalg.norm(circles, axis=3)[..., 0].ravel(), away_m, rtol=1e-6)
    rays = np.array(found["/about/lidar/seen"]["LineStrips2D:strips"][:10]).reshape(20, 2, 2)
    np.testing.assert_allclose(rays[:, 1], seen, rtol=1e-5, atol=1e-6)
    assert not rays[:, 0].any()
    directions = np.array(found["/about/camera/seen"]["LineStrips2D:strips"][:10]).reshape(20, 2, 2)
    np.testing.assert_allclose(directions[:, 1], seen / away_m[:, None], rtol=1e-5, atol=1e-6)
    points = found["/about/radar/detections"]["Points2D:positions"]
    np.testing.assert_allclose(np.array(points).reshape(20, 2), seen, rtol=1e-6)
    sights = np.array(found["/map/sights"]["LineStrips2D:strips"][0])
    assert sights.tolist() == [[[1, 1], [5, 0]], [[1, 1], [0, 5]]]
    assert "Events" not in views(tmp_path / "bare.rrd")  # nothing happened
    scans = make_stream("/scan", schemas.SCAN, time_ns, scan_id=range(10), detections=[2] * 10)
    found = drawn_bare([*streams, scans], tmp_path / "bare.rrd")
    why = "it has no field that can be plotted over time"
    assert told(found["/events/log"]) == [f"log: /scan is not drawn: {why}"]
    assert "Events" in views(tmp_path / "bare.rrd")


def test_poses_orientations_and_geodetic_fixes_have_their_places(tmp_path: Path) -> None:
    """Poses lie on the plane of their frame, what stands still is left out; rotations are angles."""
    time_ns = np.arange(0, 10**10, 10**9)
    yaw = np.linspace(0.0, 1.0, 10)
    turned = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
    places = np.stack([np.arange(10.0), -np.arange(10.0), np.ones(10)], axis=1)
    unknown = np.full((10, 36), np.nan)
    still = {"position_m": np.ones((10, 3)), "quaternion": turned, "covariance": unknown}
    moving = {**still, "position_m": places}
    degrees = {"latitude_deg": 49.0 + 1e-4 * yaw, "longitude_deg": np.full(10, 8.0)}
    streams = [
        make_stream("/odom", schemas.POSE, time_ns, metadata={"frame_id": "odom"}, **moving),
        make_stream("/pose", schemas.POSE, time_ns, metadata={"frame_id": "world/a"}, **moving),
        make_stream("/wheel", schemas.POSE, time_ns, metadata={"frame_id": "base"}, **still),
        make_stream("/imu/orientation", schemas.ORIENTATION, time_ns, quaternion=turned),
        make_stream("/gps", schemas.GEODETIC_FIX, time_ns, altitude_m=np.full(10, np.nan), **degrees),
    ]
    found = drawn_bare(streams, tmp_path / "bare.rrd")
    for entity in ("/frames/odom/odom", "/frames/world/a/pose"):
        arrows = found[f"{entity}/pose"]
        np.testing.assert_allclose(np.array(arrows["Arrows2D:origins"])[:, 0], places[:, :2])
        vectors = np.array(arrows["Arrows2D:vectors"])[:, 0]
        np.testing.assert_allclose(np.arctan2(vectors[:, 1], vectors[:, 0]), yaw, atol=1e-6)
    assert not any(entity.startswith("/frames/base") for entity in found)
    for topic in ("odom", "wheel", "imu/orientation"):
        angle = np.ravel(found[f"/plots/{topic}/quaternion/yaw"]["Scalars:scalars"])
        np.testing.assert_allclose(angle, np.degrees(yaw))
    triads = np.array(found["/space/imu/orientation"]["Transform3D:quaternion"])[:, 0]
    np.testing.assert_allclose(triads, np.roll(turned, -1, axis=1), atol=1e-7)
    fixes = np.array(found["/geodetic/gps"]["GeoPoints:positions"])[:, 0]
    np.testing.assert_allclose(fixes, np.stack([*degrees.values()], axis=1))
    assert {"Frame odom, grid 1 m", "OpenStreetMap", "Orientation"} <= views(tmp_path / "bare.rrd")


@pytest.mark.parametrize("scenario", ["acoustic-shots", "optical-los"])
def test_a_moment_in_which_sensors_are_silent_is_drawn(scenario: str, tmp_path: Path) -> None:
    """What is said but once, as where a sensor stands, holds for every span."""
    source = memory_source(*record_run(scenario, {}, 1))
    first_ns, last_ns = source.extent("publish_time")
    middle_ns = (first_ns + last_ns) // 2
    moment = replace(source, start_ns=middle_ns, end_ns=middle_ns + 10**6)
    with Drawing(moment, identity="moment", save=tmp_path / "moment.rrd"):
        pass
    times = [stamp for columns in read(tmp_path / "moment.rrd").values() for stamp in columns["utc"]]
    assert all(stamp < middle_ns + 10**9 for stamp in times)


def test_a_log_with_nothing_to_draw_says_so(tmp_path: Path) -> None:
    path = tmp_path / "said.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(
            "/said", "json", writer.register_schema("Said", "jsonschema", b"{}")
        )
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(BadInput, match=r"nothing to draw, .* its topics are /said \(json\)"):
        show(LogSource(open_log(path)), {}, [], save=tmp_path / "said.rrd")
    assert not (tmp_path / "said.rrd").exists()


def test_a_log_without_estimates_and_one_of_estimates_alone_are_shown(
    ensemble: Replayed, tmp_path: Path
) -> None:
    source = ensemble.sources[0]
    show(source, {}, [], save=tmp_path / "log.rrd")
    found = read(tmp_path / "log.rrd")
    assert len(found["/map/robot1/truth/pose"]["utc"]) == len(source.streams["/robot1/truth"])
    assert "/map/robot1/sights" in found
    streams = {topic: ragged.of_run(0) for topic, ragged in ensemble.outputs.items()}
    estimates = MemorySource(streams, source.run, "estimates")
    outputs = {topic: gather([stream]) for topic, stream in estimates.items()}
    show(estimates, outputs, [], save=tmp_path / "estimates.rrd")
    found = read(tmp_path / "estimates.rrd")
    pose = streams["/estimates/ekf/robot1/pose"]
    assert len(found["/map/robot1/ekf/pose"]["utc"]) == len(pose)


@pytest.mark.paper
def test_one_pass_goes_to_a_file_and_to_a_running_receiver(
    rrd: Path, ensemble: Replayed, tmp_path: Path
) -> None:
    both, live = tmp_path / "both.rrd", tmp_path / "live.rrd"
    wanted = [read(rrd, static=each) for each in (False, True)]
    with listen(tmp_path, "--save", str(live)) as receiver:
        source = ensemble.sources[RUN]
        show(source, ensemble.outputs, ensemble.errors, run=RUN, save=both, connect=receiver.url)
        end = time.monotonic() + 30
        while time.monotonic() < end:
            with suppress(RuntimeError):  # the receiver is still writing
                if [read(live, static=each) for each in (False, True)] == wanted:
                    break
            time.sleep(0.1)
    assert read(both) == wanted[0]
    assert read(live) == wanted[0]
    assert read(live, static=True) == wanted[1]
    port = int(receiver.url.rpartition(":")[2].partition("/")[0])
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=1)


@pytest.mark.paper
def test_a_receiver_that_is_not_there_is_refused_at_once(ensemble: Replayed, tmp_path: Path) -> None:
    def refused(url: str) -> None:
        begin = time.monotonic()
        with pytest.raises(
            BadInput, match=r"--connect .*(no Rerun receiver answers|expected rerun\+http)"
        ):
            show(ensemble.sources[0], {}, [], save=tmp_path / "a.rrd", connect=url)
        assert time.monotonic() - begin < 4
        assert not list(tmp_path.iterdir())

    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        port = silent.getsockname()[1]
        refused(f"rerun+http://127.0.0.1:{port}/proxy")
        silent.listen()  # somebody is there, but says nothing
        refused(f"rerun+http://127.0.0.1:{port}/proxy")
    for url in ("127.0.0.1:9876", "http://127.0.0.1:9876/proxy", "rerun+http://127.0.0.1:port/proxy"):
        refused(url)


@pytest.mark.unix
def test_a_receiver_that_goes_away_is_told(tmp_path: Path) -> None:
    def lose(receiver: Listener) -> None:
        with open_recording("app", "id", connect=receiver.url) as recording:
            os.killpg(receiver.process.pid, signal.SIGKILL)  # noqa: TID251
            receiver.process.wait()
            steps = [rr.TimeColumn("step", sequence=[1])]
            recording.send_columns("a", steps, rr.Scalars.columns(scalars=[1.0]))

    with (
        listen(tmp_path, "--save", str(tmp_path / "live.rrd")) as receiver,
        pytest.raises(BadInput, match="the connection to the receiver was lost"),
    ):
        lose(receiver)


def test_a_full_disk_is_told_and_nothing_half_written(ensemble: Replayed, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    place = tmp_path / "a.rrd"
    show(ensemble.sources[0], ensemble.outputs, ensemble.errors, save=place)
    size = place.stat().st_size
    place.unlink()
    for limit in (
        0,
        50_000,
        size * 97 // 100,
    ):  # the last: full as Rerun ends the file, whose size varies
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            with pytest.raises(BadInput, match=r"a\.rrd: cannot be written"):
                show(ensemble.sources[0], ensemble.outputs, ensemble.errors, save=place)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert not list(tmp_path.iterdir())


def test_what_cannot_be_shown_is_refused(ensemble: Replayed, tmp_path: Path) -> None:
    source, outputs, errors = ensemble.sources[0], ensemble.outputs, ensemble.errors
    with pytest.raises(BadInput, match=r"give --save FILE.rrd, --connect URL, or both"):
        show(source, outputs, errors)
    with pytest.raises(BadInput, match="no run 2 to show; the runs are 0 to 1"):
        show(source, outputs, errors, run=2, save=tmp_path / "a.rrd")
    with pytest.raises(
        BadInput, match="--focus robot9: no case in this log has this name; did you mean 'robot1'"
    ):
        show(source, outputs, errors, focus="robot9", save=tmp_path / "a.rrd")
    with pytest.raises(BadInput, match="cannot be written"):
        show(source, outputs, errors, save=tmp_path / "nowhere" / "a.rrd")
    (tmp_path / "a.txt").write_text("no timeline")
    with pytest.raises(BadInput, match="not a timeline"):
        screenshot(tmp_path / "a.txt", tmp_path / "a.png")
    with pytest.raises(BadInput, match="cannot be read"):
        screenshot(tmp_path / "a.rrd", tmp_path / "a.png")


def test_a_timeline_keeps_its_worst_moments(rrd: Path, ensemble: Replayed, tmp_path: Path) -> None:
    moments = read_moments(rrd)
    for estimator in ("dead-reckoning", "ekf"):
        errors, rows = of_run(ensemble.errors, estimator)
        row = np.flatnonzero(rows)[np.argmax(errors.nees[rows])]
        found = worst_at(moments, f"worst:{estimator}")
        assert found[:4] == (estimator, "robot1", "nees", errors.nees[row])
        assert found[4:] == (RUN, errors.time_ns[row], errors.elapsed_s[row])
        events = read(rrd)[f"/events/robot1/{estimator}/worst"]
        at = events["utc"].index(errors.time_ns[row])
        assert told(events)[at] == f"{estimator}: largest {found.words} of robot1"
    assert worst_at(moments, "worst") == max(moments, key=lambda each: each.value)
    with pytest.raises(BadInput, match=r"--at worst:efk: .* did you mean 'ekf'"):
        worst_at(moments, "worst:efk")
    show(ensemble.sources[RUN], {}, [], save=tmp_path / "log.rrd")
    with pytest.raises(BadInput, match="--at worst: the timeline has no errors of estimates"):
        worst_at(read_moments(tmp_path / "log.rrd"), "worst")


def test_events_tell_where_an_estimator_diverges(ensemble: Replayed, tmp_path: Path) -> None:
    source = ensemble.sources[RUN]
    nis = np.random.default_rng(1).chisquare(1, 400)
    nis[250:] *= 50.0
    time_ns = source.epoch_ns + 10**7 * np.arange(400)
    stream = make_stream(
        "/estimates/ekf/robot1/innovation",
        schemas.INNOVATION,
        time_ns,
        metadata={"components": "range_m", "kinds": "linear"},
        target_id=np.ones(400),
        accepted=np.ones(400),
        innovation=np.sqrt(nis)[:, None],
        covariance=np.ones((400, 1)),
        normalised_innovation_squared=nis,
        log_likelihood=-0.5 * nis,
    )
    show(source, {stream.topic: gather([stream])}, [], save=tmp_path / "run.rrd")
    events = read(tmp_path / "run.rrd")["/events/robot1/ekf"]
    assert [level for (level,) in events["TextLog:level"]] == ["ERROR"]
    [text], [stamp] = told(events), events["utc"]
    assert time_ns[245] < stamp < time_ns[260]
    after = nis[time_ns > stamp].mean()
    assert text.startswith("ekf: diverges: NIS per component is ")
    assert float(text.split()[6]) == pytest.approx(after, rel=0.02)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a screen")
def test_without_a_screen_other_ways_are_offered(rrd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(BadInput, match=r"no screen .*--web .*--screenshot .*--save .*--connect"):
        view(rrd)
    monkeypatch.setenv("DISPLAY", ":54321")
    with pytest.raises(BadInput, match=r"the viewer ended with an error: .*X server"):
        view(rrd)


def test_without_a_vulkan_driver_the_picture_says_what_to_install(
    rrd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nowhere")
    with pytest.raises(BadInput, match="apt-get install mesa-vulkan-drivers"):
        screenshot(rrd, tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.paper
def test_the_picture_shows_the_estimators_and_no_view_complains(rrd: Path, tmp_path: Path) -> None:
    png = tmp_path / "picture.png"
    try:
        reports = screenshot(rrd, png, at_s=15.0, size=(1200, 800))
    except BadInput as error:
        if "Vulkan driver" in str(error):
            pytest.skip(str(error))
        raise
    assert reports == []
    picture = np.rint(255 * matplotlib.image.imread(png)[..., :3]).astype(int)
    assert picture.shape == (800, 1200, 3)
    scene, plots = picture[24:460, :590], picture[24:, 610:]
    for colour in (BADGE, NOTICE):  # of the viewer's own: that it draws in software, where it listens
        for place in (picture[:24], plots):
            assert not (np.abs(place - colour).max(axis=-1) < 4).any()
    for colour in PALETTE[:2]:
        assert (np.abs(scene - colour).max(axis=-1) < 12).sum() > 100
        assert (np.abs(plots - colour).max(axis=-1) < 12).sum() > 100


def test_the_cursor_stays_inside_the_run(rrd: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput) as refused:
        screenshot(rrd, tmp_path / "a.png", at_s=99.0)
    if "Vulkan driver" in str(refused.value):
        pytest.skip(str(refused.value))
    refused.match("--at 99: give a time within the run, from 0 to 20 s")


@pytest.mark.paper
@pytest.mark.unix
def test_a_page_is_served_to_this_machine_alone_and_ends_with_the_command(
    rrd: Path, tmp_path: Path
) -> None:
    program = str(Path(sys.executable).with_name("fuselog"))
    command = [program, "view", str(rrd), "--web"]
    with heeding_interrupts():
        running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    with running:
        assert running.stdout is not None
        try:
            [url] = re.findall(r"http:[^;\s]+", running.stdout.readline())
            with urlopen(url, timeout=10) as page:
                assert (page.status, b"rerun" in page.read().lower()) == (200, True)
            children = psutil.Process(running.pid).children(recursive=True)
            sockets = [each for child in children for each in child.net_connections("inet")]
            listening = [each.laddr for each in sockets if each.status == psutil.CONN_LISTEN]
            running.send_signal(signal.SIGINT)
            running.wait(30)
        finally:
            running.kill()
    assert {address.ip for address in listening} == {"127.0.0.1"}
    assert urlsplit(url).port in {address.port for address in listening}
    assert not any(child.is_running() for child in children)
    assert not list(tmp_path.iterdir())


def test_no_viewer_outlives_a_killed_fuselog(tmp_path: Path) -> None:
    """Nobody is left to end it: it notices that the pipe from its parent has closed."""
    program = (
        "import sys, time; from pathlib import Path; from fuselog.replay.timeline.viewer import listen\n"
        "with listen(Path(sys.argv[1]), '--headless') as listener:\n"
        "    print(listener.url, flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        port = int(parent.stdout.readline().rpartition(":")[2].partition("/")[0])
        parent.kill()
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return
        time.sleep(0.05)
    raise AssertionError("the viewer still answers")


def test_a_path_of_states_with_a_quaternion_has_the_ellipses_of_its_position(tmp_path):
    """A covariance has three rows for the four numbers of a quaternion."""
    time_ns = np.arange(5) * 10**9
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))
    place = np.column_stack([np.linspace(0, 4, 5), np.zeros(5)])
    components = {
        "components": "q_w,q_x,q_y,q_z,x_m,y_m",
        "kinds": "quaternion,quaternion,quaternion,quaternion,linear,linear",
    }
    stated = np.tile(np.diag([0.1, 0.1, 0.1, 4.0, 9.0]).ravel(), (5, 1))
    estimates = make_stream(
        "/estimates/own/pose",
        schemas.GAUSSIAN_ESTIMATE,
        time_ns,
        metadata=components,
        mean=np.hstack([quaternion, place]),
        covariance=stated,
    )
    source = MemorySource({}, RunMetadata("own"), "own")
    show(source, {"/estimates/own/pose": gather([estimates])}, [], save=tmp_path / "own.rrd")
    assert np.array_equal(covariances_of(estimates, PLANE)[0], np.diag([4.0, 9.0]))
