"""Readers and recorders at their limits: first and last stamps, codes, parts by number, quanta."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuselog.recorders.importers.ros.files.bags import _members
from fuselog.recorders.log import LogWriter, make_stream, open_log, read_blocks, read_streams, schemas
from fuselog.recorders.recording import import_run, record_run
from fuselog.recorders.simulators.landmarks import _dead
from fuselog.recorders.simulators.landmarks_parameters import Sensor
from tests.recorders.families.tracking.test_ais import HEADER, table

STAMPS = st.lists(st.integers(0, 6), min_size=1, max_size=25)


@settings(max_examples=25)
@given(STAMPS, STAMPS, st.integers(0, 7), st.integers(0, 7), st.integers(1, 5))
def test_a_span_has_its_first_stamp_and_ends_before_its_last(
    tmp_path_factory: pytest.TempPathFactory,
    first: list[int],
    second: list[int],
    start: int,
    end: int,
    block: int,
) -> None:
    """Equal stamps stay together and in order, wherever a chunk or a block ends."""
    path = tmp_path_factory.mktemp("span") / "log.mcap"
    streams = {
        topic: make_stream(
            topic, schemas.VECTOR_MEASUREMENT, np.sort(stamps), value=np.arange(len(stamps))[:, None]
        )
        for topic, stamps in (("/first", first), ("/second", second))
    }
    with LogWriter(path, chunk_bytes=1 << 7) as writer:
        writer.write(streams.values())
    log, found = open_log(path), {topic: [] for topic in streams}
    last = -1
    for part in read_blocks(log, [*streams], start_ns=start, end_ns=end, block_messages=block):
        stamps = np.concatenate([each.publish_time_ns for each in part.values()])
        assert stamps.min() > last
        last = stamps.max()
        for topic, stream in part.items():
            found[topic] += stream["value"][:, 0].tolist()
    whole = read_streams(log, [*streams], start_ns=start, end_ns=end)
    for topic, stream in streams.items():
        within = (stream.publish_time_ns >= start) & (stream.publish_time_ns < end)
        wanted = np.flatnonzero(within).tolist()
        assert found[topic] == whole[topic]["value"].reshape(-1).tolist() == wanted


@settings(max_examples=15)
@given(st.permutations(range(12)), st.sampled_from(["bag_{}.db3", "{}.mcap", "a1_{}.mcap.zstd"]))
def test_parts_of_a_bag_come_by_their_numbers(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], name: str
) -> None:
    """Part 10 comes after part 9, unless the bag says itself how they follow."""
    folder = tmp_path_factory.mktemp("bag")
    for number in order:
        (folder / name.format(number)).touch()
    assert [each.name for each in _members(folder, {})] == [name.format(number) for number in range(12)]
    stated = [f"elsewhere/{name.format(number)}" for number in order]
    found = _members(folder, {"relative_file_paths": stated})
    assert [each.name for each in found] == [name.format(number) for number in order]


@pytest.mark.parametrize(
    ("place", "is_known"),
    [("90,170", True), ("80,180", True), ("91,170", False), ("80,181", False), ("91,181", False)],
)
def test_a_report_lacks_its_place_where_either_coordinate_is_missing(
    tmp_path: Path, place: str, is_known: bool
) -> None:
    rows = [
        f"2016-01-12 13:02:{second},{second},{where},90,10"
        for second, where in ((11, "80,170"), (12, place))
    ]
    recording, _ = import_run("ais", table(tmp_path, rows, HEADER), {"origin_deg": (80.0, 170.0)})
    assert len(recording.streams[0]) == 1 + is_known
    assert ("position not available" in recording.notes) != is_known


def test_a_sensor_is_dead_from_the_start_of_an_outage_up_to_its_end() -> None:
    sensor = Sensor(outages_per_minute=3.0, outage_s=0.5)
    outages_s, _ = _dead(sensor, np.zeros(1), 60.0, np.random.default_rng(2))
    assert len(outages_s) > 1
    begin, end = outages_s.T
    for times, wanted in (
        (begin, True),
        (np.nextafter(end, 0.0), True),
        (np.nextafter(begin, 0.0), False),
        (end, False),
    ):
        found = _dead(sensor, times, 60.0, np.random.default_rng(2))[1]
        assert found.all() if wanted else not found.any()


def test_stated_quanta_round_what_an_inertial_unit_says() -> None:
    """Each number to its own quantum, and by no more than half of it; zero leaves all as it is."""
    unit = {"force_quantum_mps2": 0.05, "gyro_quantum_radps": 0.002}
    exact, rounded = (
        next(each for each in recording.streams if each.schema is schemas.INERTIAL_SAMPLE)
        for recording, _ in (
            record_run("navigation", {"duration_s": 11.0, "unit": of}, 1) for of in ({}, unit)
        )
    )
    for field, quantum in (("specific_force_mps2", 0.05), ("turn_rate_radps", 0.002)):
        steps = rounded[field] / quantum
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
        off = np.abs(rounded[field] - exact[field])
        assert 0.4 * quantum < off.max() <= 0.5 * quantum * (1 + 1e-9)
