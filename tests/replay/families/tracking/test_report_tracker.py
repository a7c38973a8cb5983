"""The tracker of reports without identities: known cases, blocks, and the targets on real data."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording, import_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Block, gather, merge_events
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.tracking.judging.tracks import kept, live_counts, track_table
from fuselog.replay.families.tracking.report_association import ReportSettings, is_held
from fuselog.replay.judging.metrics.measuring import Output, find_metrics, measure

TOPIC = "/estimates/report-tracker/track"


def source(*vessels: np.ndarray, seed: int = 0) -> MemorySource:
    """A log of vessels, each with rows of time (s), x, y, vx, vy; noise of a metre and 0.1 m/s."""
    rng = np.random.default_rng(seed)
    rows = np.concatenate([np.column_stack([np.full(len(v), n), v]) for n, v in enumerate(vessels, 1)])
    rows = rows[np.lexsort((rng.uniform(size=len(rows)), rows[:, 1]))]
    number, time_s, x, y, vx, vy = rows.T
    place = np.stack([x, y], axis=1) + rng.normal(size=(len(rows), 2))
    velocity = np.stack([vx, vy], axis=1) + 0.1 * rng.normal(size=(len(rows), 2))
    time_ns = SIMULATION_EPOCH_NS + np.rint(time_s * 1e9).astype(np.int64)
    streams = [
        make_stream(
            "/reports",
            schemas.COURSE_FIX,
            time_ns,
            position_m=place,
            course_rad=np.arctan2(velocity[:, 0], velocity[:, 1]) % (2 * np.pi),
            speed_mps=np.hypot(*velocity.T),
        ),
        make_stream("/identity", schemas.IDENTITY, time_ns, thing_id=number),
    ]
    return memory_source(Recording(streams), RunMetadata("ais", {}, None, 0, SIMULATION_EPOCH_NS, {}))


def straight(
    start: tuple[float, float], velocity: tuple[float, float], every_s: float, first_s: float = 0.0
) -> np.ndarray:
    """Ten minutes of a vessel that keeps its course."""
    time_s = np.arange(first_s, 600.0, every_s)
    place = np.array(start) + time_s[:, None] * np.array(velocity)
    return np.column_stack([time_s, place, np.tile(velocity, (len(time_s), 1))])


def tracks_of(source: MemorySource) -> np.ndarray:
    return replay_in_memory([source], {"report-tracker": {}})[TOPIC]["track_id"].astype(np.int64)


def shares(source: MemorySource) -> tuple[list[float], int]:
    """Every vessel's share of reports in a track of its own, and how many tracks there are."""
    tracks = tracks_of(source)
    table = track_table(source.streams["/identity"]["thing_id"].astype(np.int64), tracks)
    return table["share"].tolist(), len(np.unique(tracks))


def test_crossing_vessels_keep_their_tracks():
    """They meet in one place at one time; course and speed tell them apart."""
    first = straight((-1500, 0), (5, 0), 7.0)
    second = straight((0, -1500), (0, 5), 9.0)
    assert shares(source(first, second)) == ([1.0, 1.0], 2)


def test_reports_of_one_stamp_are_of_different_vessels():
    """Two vessels side by side, twelve metres apart, always report together."""
    first, second = (straight((0, y), (4, 0), 10.0) for y in (0.0, 12.0))
    found = tracks_of(source(first, second)).reshape(-1, 2)
    assert np.all(found[:, 0] != found[:, 1])
    assert shares(source(first, second)) == ([1.0, 1.0], 2)


def test_a_vessel_is_found_again_after_a_gap():
    """Silent for two minutes under way, and slightly off where it was expected."""
    vessel = straight((0, 0), (6, 1), 10.0)
    silent = (vessel[:, 0] > 200) & (vessel[:, 0] < 320)
    vessel[vessel[:, 0] >= 320, 1] += 60.0
    assert shares(source(vessel[~silent])) == ([1.0], 1)


def test_moored_neighbours_are_two_and_a_passer_by_takes_neither():
    """Moored 15 m apart, one reports rarely; a third passes between them."""
    moored = [straight((0, y), (0, 0), every) for y, every in ((0, 10.0), (15.0, 180.0))]
    passing = straight((-1000, 7), (5, 0), 5.0, first_s=2.5)
    found, tracks = shares(source(*moored, passing))
    assert found == [1.0, 1.0, 1.0]
    assert tracks == 3


def test_what_cannot_be_one_vessel_is_another():
    """A report 40 km away, as real data has, begins a track and does not disturb the vessel's own."""
    vessel = straight((0, 0), (5, 0), 10.0)
    vessel[30, 1] += 40_000
    found, tracks = shares(source(vessel))
    assert found == [59 / 60]
    assert tracks == 2


def test_course_and_speed_may_be_missing():
    """Positions alone keep two distant vessels apart."""
    good = source(straight((0, 0), (5, 0), 10.0), straight((0, 900), (5, 0), 10.0, first_s=5))
    reports = good.streams["/reports"]
    columns = dict(reports.columns)
    columns["course_rad"] = np.full(len(reports), np.nan)
    columns["speed_mps"] = np.where(np.arange(len(reports)) % 3 == 0, np.nan, columns["speed_mps"])
    streams = {**good.streams, "/reports": type(reports)(**{**vars(reports), "columns": columns})}
    assert shares(MemorySource(streams, good.run, good.name)) == ([1.0, 1.0], 2)


def test_estimates_are_near_the_truth_and_as_sure_as_they_say():
    """Of a vessel on a straight course, the position's error is within what the covariance says."""
    vessel = straight((0, 0), (6, 2), 5.0)
    stream = replay_in_memory([source(vessel)], {"report-tracker": {}})[TOPIC].stream
    assert stream.components == ["x_m", "vx_mps", "y_m", "vy_mps"]
    error = stream["mean"][20:] - vessel[20:, [1, 3, 2, 4]]
    covariance = stream["covariance"][20:].reshape(-1, 4, 4)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert 1.0 < nees.mean() < 8.0
    assert np.abs(error[:, ::2]).max() < 5.0


def test_with_equal_levels_it_is_a_kalman_filter():
    """Means and covariances of one vessel are those of the textbook's matrices."""
    equal = {
        "acceleration_density": [0.05] * 4,
        "sigma_position_m": [5.0] * 4,
        "sigma_velocity_mps": [0.3] * 4,
    }
    log = source(straight((0, 0), (6, 2), 7.0))
    stream = replay_in_memory([log], {"report-tracker": equal})[TOPIC].stream
    reports = log.streams["/reports"]
    course, speed = reports["course_rad"], reports["speed_mps"]
    x, y = reports["position_m"].T
    seen = np.stack([x, speed * np.sin(course), y, speed * np.cos(course)], axis=1)
    noise = np.diag([25.0, 0.09, 25.0, 0.09])
    motion = np.kron(np.eye(2), [[1.0, 7.0], [0.0, 1.0]])
    disturbance = 0.05 * np.kron(np.eye(2), [[7.0**3 / 3, 7.0**2 / 2], [7.0**2 / 2, 7.0]])
    mean, covariance = seen[0], noise
    for row in range(1, len(seen)):
        mean, covariance = motion @ mean, motion @ covariance @ motion.T + disturbance
        gain = covariance @ np.linalg.inv(covariance + noise)
        mean = mean + gain @ (seen[row] - mean)
        covariance = covariance - gain @ covariance
        assert_allclose(stream["mean"][row], mean, rtol=1e-11, atol=1e-9)
        assert_allclose(stream["covariance"][row].reshape(4, 4), covariance, rtol=1e-9, atol=1e-11)


def test_blocks_and_ensembles_change_nothing():
    """Three runs at once, and one run in three blocks, give the same bits."""
    runs = [source(straight((0, 0), (5, k), 7.0), straight((0, 50), (5, 0), 9.0)) for k in range(3)]
    together = replay_in_memory(runs, {"report-tracker": {}})[TOPIC]
    [bound] = bind("report-tracker", runs[:1], {})
    for run, each in enumerate(runs):
        alone = collect(replay([each], [bound]))[TOPIC].stream
        for name, column in alone.columns.items():
            assert_array_equal(column, together.of_run(run)[name])
    reports = runs[0].streams["/reports"]
    cuts = np.searchsorted(reports.publish_time_ns, SIMULATION_EPOCH_NS + np.array([200, 400]) * 10**9)
    state, parts = bound.start({}), []
    for rows in np.split(np.arange(len(reports)), cuts):
        block = {"/reports": gather([reports.take(rows)])}
        state, [told] = bound.run(state, Block(block, merge_events(block, "publish_time")))
        parts.append(told["mean"])
    assert_array_equal(np.concatenate(parts), together.of_run(0)["mean"])


def test_silent_tracks_are_dropped_and_numbers_stay():
    """After `forget_s` a vessel that comes back is a new one; numbers are never given twice."""
    vessel = straight((0, 0), (0, 0), 10.0)
    vessel[20:, 0] += 300.0
    vessel[40:, 0] += 300.0
    settings = {"report-tracker": {"forget_s": 200.0}}
    found = replay_in_memory([source(vessel)], settings)[TOPIC]["track_id"]
    assert found.tolist() == [0] * 20 + [1] * 20 + [2] * 20


def test_levels_in_another_order_are_refused():
    with pytest.raises(BadInput, match="give the smallest first"):
        bind(
            "report-tracker", [source(straight((0, 0), (1, 0), 9.0))], {"sigma_position_m": (9, 3, 2, 1)}
        )


def test_table_of_tracks_by_hand():
    """A track that swallows two vessels is the own track of the one with more reports."""
    things = np.array([7, 7, 7, 8, 8, 7, 7, 9])
    table = track_table(things, np.array([1, 1, 2, 1, 1, 1, 1, 4])).set_index("target")
    assert table["track"].to_dict() == {7: 1, 8: -1, 9: 4}
    assert table["share"].to_dict() == {7: 0.8, 8: 0.0, 9: 1.0}
    assert table["largest_share"].to_dict() == {7: 0.8, 8: 1.0, 9: 1.0}
    assert table.loc[7, ["reports", "tracks", "switches", "others"]].tolist() == [5, 2, 2, 2]
    assert kept(table, "largest_share", 1) == (2, 0.5, 0.9)
    assert np.isnan(kept(table, reports=50).mean_share)


def test_live_counts_by_hand():
    """Two numbers, one silent for longer than the limit."""
    time_ns = np.array([0, 5, 8, 30]) * 10**9
    at_ns, live = live_counts(time_ns, np.array([1, 2, 1, 2]), 10.0)
    assert (at_ns / 1e9).tolist() == [0, 5, 15, 18, 30]
    assert live.tolist() == [1, 2, 1, 0, 1]


def test_the_solent_with_identities_hidden(real_data: Path):
    """The targets: 70 % of 37 vessels keep one track, the mean share is .88, in one-to-one pairs."""
    solent = memory_source(*import_run("ais", real_data / "solent_ais.csv.xz", {}))
    outputs = replay_in_memory([solent], {"report-tracker": {}})
    stream = outputs[TOPIC].stream
    table = track_table(
        solent.streams["/identity"]["thing_id"].astype(np.int64), stream["track_id"].astype(np.int64)
    )
    found = kept(table)
    assert found.targets == 37
    assert found.kept_share >= 0.70
    assert found.mean_share >= 0.88
    values = measure([Output("t", "", "track", outputs[TOPIC], [solent])], find_metrics(["tracks"]))
    assert_allclose(values["t.own_track_mean_percent"], 100 * found.mean_share)


def test_other_parts_of_the_solent_do_as_well(real_data: Path):
    """No setting is made for one file: its first and second half, and every second vessel, do it too."""
    whole = memory_source(*import_run("ais", real_data / "solent_ais.csv.xz", {}))
    things = whole.streams["/identity"]["thing_id"]
    count = len(things)
    parts = {
        "first half": np.arange(count) < count // 2,
        "second half": np.arange(count) >= count // 2,
        "even": things % 2 == 0,
        "odd": things % 2 == 1,
    }
    for name, rows in parts.items():
        streams = {topic: each.take(rows) for topic, each in whole.streams.items()}
        tracks = tracks_of(MemorySource(streams, whole.run, whole.name))
        found = kept(track_table(things[rows].astype(np.int64), tracks))
        assert found.kept_share >= 0.70, name
        assert found.mean_share >= 0.88, name


@pytest.mark.parametrize(
    ("course_rad", "before_rad", "is_so"),
    [
        (1.0, 1.0, True),
        (1.0, 1.09, True),
        (1.0, 1.11, False),
        (0.02, 2 * np.pi - 0.07, True),  # across north
        (0.02, 2 * np.pi - 0.09, False),
        (np.nan, np.nan, True),
        (np.nan, 1.0, False),
        (1.0, np.nan, False),
    ],
)
def test_a_course_is_held_within_its_width(course_rad: float, before_rad: float, is_so: bool) -> None:
    settings = ReportSettings(*np.zeros(len(ReportSettings._fields)))._replace(course_width_rad=0.1)
    assert is_held(course_rad, before_rad, settings) == is_so
