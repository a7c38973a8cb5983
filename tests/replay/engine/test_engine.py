"""The replay: ensembles, blocks, files and memory give the same numbers, bit for bit."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, LogWriter, RunMetadata, Stream, make_stream, open_log, schemas
from fuselog.recorders.recording import Recording, record_run
from fuselog.replay.engine.replaying.estimator import Bound, Recursive, bind
from fuselog.replay.engine.replaying.replaying import Report, collect, replay
from fuselog.replay.engine.replaying.usage import Usage
from fuselog.replay.engine.streams import ensembles
from fuselog.replay.engine.streams.blocks import (
    Block,
    Ragged,
    filled_rows,
    gather,
    merge_events,
    ragged_rows,
)
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.results import state_stream
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source, memory_source
from fuselog.replay.inference.run import events
from fuselog.replay.inference.run.events import filter_events

ESTIMATORS = ("dead-reckoning", "ekf", "ukf")

# Late messages (latency with jitter, so that they overtake one another), equal stamps of odometry and
# sensors (20, 5 and 10 Hz), messages before the prior (a sensor that stamps early). All kinds of sensors
# as in the tests of localization, since another choice of them is another kernel.
LATE = {
    "duration_s": 15.0,
    "odometry_latency_s": 0.03,
    "range_bearing": {"rate_hz": 5.0, "latency_s": 0.2, "latency_jitter_s": 0.3},
    "range": {"rate_hz": 5.0},
    "bearing": {"rate_hz": 10.0, "latency_s": 0.05, "stamp_offset_s": -0.1},
}
CLOCKS: tuple[Clock, ...] = ("publish_time", "log_time")
# Runs of one ensemble whose schedules have nothing in common.
SCHEDULES = [
    {},
    {"duration_s": 3.0},
    {"duration_s": 31.7, "odometry_rate_hz": 7.0},
    {"range_bearing": {"rate_hz": 3.0, "dropout_probability": 0.7}},
    {"range_bearing": {"rate_hz": 9.0, "outages_per_minute": 12.0, "outage_s": 2.0}},
    {"range_bearing": {"rate_hz": 5.0, "maximum_range_m": 0.01}},
    {"landmarks": 0},
]


def record(run: int, **parameters: object) -> MemorySource:
    return memory_source(*record_run("landmarks", {"duration_s": 10.0, **parameters}, 5, run))


def bound(sources: list[Source]) -> list[Bound]:
    """All estimators at once, as a replay takes them."""
    return [each for name in ESTIMATORS for each in bind(name, sources, {})]


def replayed(sources: list[Source], order: Clock = "publish_time", **options: int) -> dict[str, Ragged]:
    return collect(replay(sources, bound(sources), order=order, **options))


def assert_equal(ours: dict[str, Stream], theirs: dict[str, Stream]) -> None:
    """Equal to the last bit, NaN where the other has NaN."""
    assert ours.keys() == theirs.keys()
    for topic, stream in ours.items():
        assert_array_equal(stream.publish_time_ns, theirs[topic].publish_time_ns)
        for name, column in stream.columns.items():
            assert_array_equal(
                column, theirs[topic].columns[name], err_msg=f"{topic} {name}", strict=True
            )


def of_run(outputs: dict[str, Ragged], run: int) -> dict[str, Stream]:
    return {topic: ragged.of_run(run) for topic, ragged in outputs.items()}


@pytest.fixture(scope="module")
def ensemble() -> list[MemorySource]:
    return [record(run, **schedule) for run, schedule in enumerate(SCHEDULES)]


@pytest.mark.parametrize("cores", [1, 2, 5])
def test_an_ensemble_is_its_runs_alone(
    cores: int, ensemble: list[MemorySource], on_cores: Callable[[int], None]
):
    """Whatever the schedules of the other runs, and on however many cores."""
    alone = [replayed([source]) for source in ensemble]
    on_cores(cores)
    together = replayed(ensemble)
    for run, single in enumerate(alone):
        assert_equal(of_run(together, run), of_run(single, 0))
    poses = together["/estimates/ekf/robot1/pose"]
    assert np.all(np.diff(poses.offsets) > 50)


@pytest.mark.paper
def test_what_an_ensemble_keeps_changes_no_replay():
    """Replayed again, by either clock, with other settings between, and after it went to a worker."""
    ensemble = Ensemble([record(0, **LATE)])
    wanted = {order: of_run(replayed([record(0, **LATE)], order), 0) for order in CLOCKS}
    for order in (*CLOCKS, *CLOCKS):
        collect(replay(ensemble, bind("ekf", ensemble, {"gate_probability": 0.5}), order=order))
        assert_equal(of_run(replayed(ensemble, order), 0), wanted[order])
    assert bind("ekf", ensemble, {}) == bind("ekf", ensemble, {})
    sent = pickle.loads(pickle.dumps(ensemble))
    assert_equal(of_run(replayed(sent), 0), wanted["publish_time"])


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> tuple[MemorySource, Path]:
    """A run with late messages, in memory and as a log of many small chunks."""
    source = record(0, **LATE)
    path = tmp_path_factory.mktemp("logs") / "late.mcap"
    with LogWriter(path, source.run, chunk_bytes=4096) as writer:
        writer.write(source.streams.values())
    bearing = source.streams["/robot1/bearing"]
    assert np.any(np.diff(source.streams["/robot1/range_bearing"].log_time_ns) < 0)
    assert bearing.publish_time_ns[0] < source.streams["/robot1/prior"].publish_time_ns[0]
    return source, path


@pytest.mark.parametrize("order", ["publish_time", "log_time"])
def test_a_log_in_small_blocks_is_the_recording_in_memory(order: Clock, late: tuple[MemorySource, Path]):
    """State carried over block boundaries, and reading, change nothing; small blocks are small."""
    source, path = late
    whole = replayed([source], order)
    for block_messages in (50, 1000, 1 << 18):
        log = LogSource(open_log(path))
        outputs = list(replay([log], bound([log]), order=order, block_messages=block_messages))
        assert len(outputs) > 5 if block_messages == 50 else len(outputs) >= 1
        assert_equal(of_run(collect(outputs), 0), of_run(whole, 0))


def test_logs_and_recordings_make_one_ensemble(late: tuple[MemorySource, Path]):
    """Runs whose blocks end at different times wait for nobody."""
    source, path = late
    other = record(1, **LATE)
    outputs = replayed([LogSource(open_log(path)), other], block_messages=100)
    assert_equal(of_run(outputs, 0), of_run(replayed([source]), 0))
    assert_equal(of_run(outputs, 1), of_run(replayed([other]), 0))


def test_arrival_order_is_what_a_recorder_with_one_clock_would_have_seen(
    late: tuple[MemorySource, Path],
):
    """By log time it is the replay of the log whose publish times are the log times; not the other."""
    source, _ = late
    arrived = {
        topic: make_stream(
            topic,
            stream.schema,
            stream.log_time_ns,
            metadata=stream.metadata,
            **{name: column for name, column in stream.columns.items() if name != "sensor_time_ns"},
        )
        for topic, stream in source.streams.items()
    }
    for topic, stream in arrived.items():
        stream.position[:] = source.streams[topic].position
    by_arrival = replayed([source], "log_time")
    assert_equal(
        of_run(by_arrival, 0), of_run(replayed([MemorySource(arrived, source.run, "arrived")]), 0)
    )
    published = replayed([source])["/estimates/ekf/robot1/pose"]
    assert len(published) != len(by_arrival["/estimates/ekf/robot1/pose"])


def late_by_a_block(*, finish: bool = True, raises_at: int | None = None) -> Recursive:
    """Gives every block's estimates with the next one, the last when all is done."""

    def run(before: Ragged | None, block: Block) -> tuple[Ragged, list[Ragged]]:
        if raises_at is not None and np.any(block.events.time_ns >= raises_at):
            raise BadInput("it is too late")
        ragged = block.streams["/robot1/range_bearing"]
        ones, time_ns = np.ones((len(ragged), 1)), ragged.stream.publish_time_ns
        state = state_stream(
            "/estimates/late/state", time_ns, {"x_m": "linear"}, "", ones, ones[:, :, None]
        )
        return Ragged(state, ragged.offsets), [] if before is None else [before]

    def last(waiting: Ragged | None) -> list[Ragged]:
        return [] if waiting is None else [waiting]

    streams = ("/robot1/range_bearing",)
    return Recursive("late", streams, (), lambda _: None, run, finish=last if finish else None)


def test_what_waits_is_given_when_all_is_done(late: tuple[MemorySource, Path]):
    """As the last block of all, and watched as any: it counts as estimated."""
    source, path = late
    times_ns = source.streams["/robot1/range_bearing"].publish_time_ns
    log = LogSource(open_log(path))
    for each, block_messages in ((source, 1 << 18), (log, 50)):
        report = Report()
        outputs = replay([each], [late_by_a_block()], block_messages=block_messages, report=report)
        found = collect(outputs)
        assert_array_equal(found["/estimates/late/state"].stream.publish_time_ns, np.sort(times_ns))
        assert len(found["/estimates/late/failure"]) == 0
        (coverage,) = report.coverage
        assert coverage["estimated_s"][0] == pytest.approx(np.ptp(times_ns) * 1e-9)
    without = collect(replay([log], [late_by_a_block(finish=False)], block_messages=50))
    assert len(without["/estimates/late/state"]) < len(times_ns)


def test_what_waits_of_a_failed_run_is_not_given(ensemble: list[MemorySource]):
    """Only what is before its end; a `finish` that raises is said to be the estimator's."""
    first, second = ensemble[0], ensemble[3]
    times_ns = first.streams["/robot1/range_bearing"].publish_time_ns
    stop_ns = int(times_ns[len(times_ns) // 2])
    cut = second.streams["/robot1/range_bearing"]
    cut = cut.take(cut.publish_time_ns < stop_ns)
    other = MemorySource({**second.streams, cut.topic: cut}, second.run, "other")
    found = collect(replay([first, other], [late_by_a_block(raises_at=stop_ns)]))
    state = found["/estimates/late/state"]
    assert_array_equal(state.of_run(0).publish_time_ns, times_ns[times_ns < stop_ns])
    assert len(state.of_run(1)) == len(cut) > 0
    assert np.diff(found["/estimates/late/failure"].offsets).tolist() == [1, 0]
    broken = replace(late_by_a_block(), finish=lambda _: 1 // 0)
    with pytest.raises(BadInput, match="estimator late raised ZeroDivisionError"):
        collect(replay([first], [broken]))


def test_equal_stamps_keep_the_order_of_the_log_in_memory_too(tmp_path: Path):
    """Three messages of one stamp that arrived in reverse: the log has them as they arrived."""
    reversed_ = make_stream(
        "/bearing",
        schemas.BEARING,
        [5, 5, 5, 9],
        log_time_ns=[30, 20, 10, 40],
        target_id=[3, 2, 1, 4],
        bearing_rad=np.zeros(4),
    )
    source = memory_source(Recording([reversed_]), RunMetadata("reversed"))
    with LogWriter(tmp_path / "log.mcap", source.run) as writer:
        writer.write([reversed_])
    log = LogSource(open_log(tmp_path / "log.mcap"))
    assert source.read(["/bearing"])["/bearing"]["target_id"].tolist() == [1, 2, 3, 4]
    assert_equal(log.read(["/bearing"]), source.read(["/bearing"]))


def test_streams_without_messages_are_told_and_stop_no_other_run(tmp_path: Path):
    """No run with messages is bad input, in memory as from a log; one without beside others is empty."""
    source = record(0)
    empty = {
        topic: stream if topic.endswith("prior") else stream.take(slice(0, 0))
        for topic, stream in source.streams.items()
    }
    with LogWriter(tmp_path / "empty.mcap", source.run) as writer:
        writer.write(empty.values())
    silent = MemorySource(empty, source.run, "silent")
    log = LogSource(open_log(tmp_path / "empty.mcap"))
    for nothing in (silent, log):
        with pytest.raises(BadInput, match="no messages on /robot1/odometry"):
            replayed([nothing])
    together = replayed([log, source, silent])
    assert_equal(of_run(together, 1), of_run(replayed([source]), 0))


def test_runs_with_other_topics_are_no_ensemble():
    first, second = record(0), record(1, robots=1, range_bearing={"rate_hz": 0.0})
    with pytest.raises(BadInput, match="topic /robot1/range_bearing differs from that of run 0"):
        replayed([first, second])


def test_runs_that_state_other_noise_are_no_ensemble():
    """What the first run's channels state would be taken for all of them."""
    sensor = {"rate_hz": 5.0, "sigma_range_m": 0.3}
    with pytest.raises(BadInput, match="topic /robot1/range_bearing differs from that of run 0"):
        replayed([record(0), record(1, range_bearing=sensor)])


def test_names_and_variants_are_checked():
    source = record(0)
    for name, words in (("ekv", "did you mean 'ekf'"), ("ekf:fast", "has no variants")):
        with pytest.raises(BadInput, match=words):
            bind(name, [source], {})
    with pytest.raises(BadInput, match="no parameter 'gate'"):
        bind("ekf", [source], {"gate": 1})
    both = bind("mine", [source], {"kind": "ekf", "gate_probability": 0.5})
    assert [each.name for each in both] == ["mine/robot1"]


# Events: the merged order, against sorting.


def bearings(topic: str, times_ns: list[int], positions: list[int]) -> Stream:
    stream = make_stream(
        topic,
        schemas.BEARING,
        times_ns,
        target_id=np.arange(len(times_ns)),
        bearing_rad=np.zeros(len(times_ns)),
    )
    stream.position[:] = positions
    return stream


@st.composite
def ragged_topics(draw: st.DrawFn) -> dict[str, Ragged]:
    """A few topics of a few runs, some empty, with many equal stamps; positions differ within a run."""
    topics, runs = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    parts: dict[str, list[Stream]] = {f"/{topic}": [] for topic in range(topics)}
    for _ in range(runs):
        stamps = draw(
            st.lists(st.tuples(st.integers(0, 5), st.sampled_from(sorted(parts))), max_size=30)
        )
        for topic in parts:
            mine = sorted((time, place) for place, (time, name) in enumerate(stamps) if name == topic)
            parts[topic].append(
                bearings(topic, [time for time, _ in mine], [place for _, place in mine])
            )
    return {topic: gather(streams) for topic, streams in parts.items()}


@pytest.mark.paper
@given(ragged_topics())
def test_events_are_the_messages_sorted_by_run_time_and_place(topics: dict[str, Ragged]):
    events = merge_events(topics, "publish_time")
    expected = sorted(
        (run, time_ns, position, index, int(start) + row)
        for (index, ragged), start in zip(
            enumerate(topics.values()), np.cumsum([0, *map(len, topics.values())]), strict=False
        )
        for run in range(ragged.runs)
        for row, (time_ns, position) in enumerate(
            zip(ragged.of_run(run).publish_time_ns, ragged.of_run(run).position, strict=True),
            int(ragged.offsets[run]),
        )
    )
    run_of = np.repeat(np.arange(len(events.offsets) - 1), np.diff(events.offsets))
    found = zip(run_of, events.time_ns, events.topic, events.source, strict=True)
    assert list(found) == [(run, time_ns, index, row) for run, time_ns, _, index, row in expected]
    stamps = [each[:2] for each in expected]
    is_last = [stamp != after for stamp, after in zip(stamps, [*stamps[1:], None], strict=False)]
    assert_array_equal(events.is_last, np.array(is_last, bool))


def test_a_column_of_a_block_takes_from_each_topic_what_it_has():
    first = make_stream("/range", schemas.RANGE, [10, 30], target_id=[1, 2], range_m=[1.5, 2.5])
    second = make_stream("/bearing", schemas.BEARING, [20], target_id=[7], bearing_rad=[0.5])
    streams = {"/range": gather([first]), "/bearing": gather([second])}
    block = Block(streams, merge_events(streams, "publish_time"))
    assert_array_equal(block.column("range_m"), [1.5, np.nan, 2.5])
    assert_array_equal(block.column("nothing", "range_m", "bearing_rad"), [1.5, 0.5, 2.5])
    assert_array_equal(block.column("target_id", missing=0), [1, 7, 2])


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=6))
def test_filled_rows_are_those_before_every_runs_end(runs: list[tuple[int, int]]):
    """Each run has room for some rows and filled some of them."""
    room = [max(run) for run in runs]
    filled = [min(run) for run in runs]
    offsets = np.cumsum([0, *room])
    rows, packed = filled_rows(offsets, offsets[:-1] + filled)
    expected = [
        start + row for start, count in zip(offsets, filled, strict=False) for row in range(count)
    ]
    assert_array_equal(np.arange(sum(room))[rows], expected)
    assert_array_equal(packed, np.cumsum([0, *filled]))
    chosen = np.isin(np.arange(sum(room)), expected)
    assert_array_equal(ragged_rows(chosen, offsets), packed)


@pytest.mark.parametrize("order", ["publish_time", "log_time"])
def test_an_ensemble_lays_its_recordings_end_to_end_once(order: Clock):
    """However often it is replayed, by either clock; what was kept is what would be read anew."""
    sources = [record(run, **LATE, **values) for run, values in enumerate(({}, {"landmarks": 3}))]
    ensemble = Ensemble(sources)
    first, again = replayed(ensemble, order), replayed(ensemble, order)
    anew = replayed(sources, order)
    for ours in (first, again):
        assert_equal(
            {topic: rows.stream for topic, rows in ours.items()},
            {topic: rows.stream for topic, rows in anew.items()},
        )
    topics = ["/robot1/odometry", "/robot1/range_bearing"]
    [one], [other] = (list(ensemble.blocks(topics, order, 1)) for _ in range(2))
    assert all(one[topic] is other[topic] for topic in topics)
    assert_array_equal(
        one[topics[1]].of_run(1).times(order), np.sort(sources[1].streams[topics[1]].times(order))
    )


@pytest.mark.parametrize("few", [0, ensembles.FEW_MESSAGES], ids=["long", "short"])
def test_filters_of_the_same_topics_share_their_events(few: int, monkeypatch: pytest.MonkeyPatch):
    """Also of long runs, whose blocks are not kept for another replay."""
    made = []

    def counted(*arguments: object) -> object:
        made.append(arguments)
        return filter_events(*arguments)

    monkeypatch.setattr(ensembles, "FEW_MESSAGES", few)
    monkeypatch.setattr(events, "filter_events", counted)
    sources = [record(run) for run in range(2)]
    bounds = [each for label in ("ekf", "ukf") for each in bind(label, sources, {})]
    together = collect(replay(sources, bounds))
    assert len(made) == 1
    for each in bounds:
        alone = {topic: rows.stream for topic, rows in collect(replay(sources, [each])).items()}
        assert_equal(alone, {topic: together[topic].stream for topic in alone})


def test_a_map_that_states_two_positions_of_a_landmark_is_doubtful() -> None:
    """Only within a run; if several runs do, the last one is named."""
    of_runs = [
        ([5, 6], [[0, 0], [1, 0]]),
        ([7, 5, 7], [[0, 0], [9, 0], [0, 2]]),
        ([5, 6, 6, 5], [[0, 0], [1, 0], [1, 1], [3, 4]]),
        ([5, 5, 6], [[8, 0], [8, 0], [7, 7]]),
    ]
    maps = [
        make_stream("/map", schemas.LANDMARK, [0] * len(ids), landmark_id=ids, position_m=places)
        for ids, places in of_runs
    ]
    usage = Usage("ekf")
    usage.note_start({"/map": gather(maps)})
    assert usage.doubtful == {"/map": "landmark 5 is stated at two positions, 5 m apart"}
    assert usage.given["/map"] == 12
    sound = Usage("ekf")
    sound.note_start({"/map": gather([maps[0], maps[3]])})
    assert not sound.doubtful


def test_impossible_messages_of_one_run_of_an_ensemble_are_left_out_and_counted() -> None:
    topic = "/robot1/range_bearing"
    sound, bad = (memory_source(*record_run("landmarks", {"duration_s": 2.0}, 3, k)) for k in (0, 1))
    stream = bad.streams[topic]
    values = stream["range_m"].copy()
    values[[3, 5]] = np.inf
    wrong = replace(stream, columns={**stream.columns, "range_m": values})
    bad = replace(bad, streams={**bad.streams, topic: wrong})
    runs = Ensemble([sound, bad])
    (block,) = runs.blocks([topic], "publish_time", 100)
    counts = len(sound.streams[topic]), len(stream) - 2
    assert np.diff(block[topic].offsets).tolist() == list(counts)
    assert np.isfinite(block[topic]["range_m"]).all()
    assert not sound.rejections
    assert bad.rejections[topic].total() == 2
