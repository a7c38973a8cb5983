"""ULog: what pyulog reads too, the sheet's numbers, EKF2 as an estimator, and damage."""

import re
import struct
import tarfile
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog

import fuselog as fl
from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ulog.file import MAGIC, UlogFile
from fuselog.recorders.importers.ulog.importer import ULOG, UlogParameters, carried, stated_noise
from fuselog.recorders.models.orientation import rotate
from tests.goldens import keeping, numbers

# Of the sheet, section 6: streams, rows, changed parameters, defaults, texts, dropouts and their ms.
FILES = {
    "sample": (15, 64542, 2516782253, 6, 0, 4, 4, 119),
    "sample_appended_multiple": (20, 6852, 2525081892, 0, 0, 1, 0, 0),
    "sample_log_small": (70, 14604, 591159555.1, 0, 0, 3, 1, 30),
    "sample_logging_tagged_and_default_params": (96, 21229, 608626555.2, 0, 44, 7, 0, 0),
    "sample_px4_events": (69, 29480, 1283080374, 0, 62, 18, 0, 0),
}
GYRO_SUMS = {
    "sample": (-3.158471702941, -52.665881052214, -103.921215853254),
    "sample_log_small": (5.786301962234, 0.40459157813, 1.310431911354),
}
TAGGED = "sample_logging_tagged_and_default_params"
LATER_US = 7_000  # a message is logged after its sample


@pytest.fixture(scope="module")
def logs(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ulog")
    with tarfile.open(real_data / "sensors" / "sensors-data.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder / "ulog"


def columns_of(file: UlogFile) -> dict:
    parts = defaultdict(list)
    for block in file.blocks(bool):
        for rows in block:
            parts[rows.topic, rows.instance].append(rows.data)
    return {key: np.concatenate(each) for key, each in parts.items()}


def streams_of(path: Path) -> dict:
    recording = ULOG.read(path, UlogParameters()).together()
    keeping.hold("ulog", {"path": path.name}, numbers.of_recording(recording))
    return {stream.topic: stream for stream in recording.streams}


@pytest.mark.paper
@pytest.mark.parametrize("name", FILES)
def test_every_column_is_that_of_pyulog_and_the_counts_are_the_sheets(logs: Path, name: str):
    file, peer = UlogFile(logs / f"{name}.ulg"), ULog(str(logs / f"{name}.ulg"))
    columns = columns_of(file)
    assert columns.keys() == {(each.name, each.multi_id) for each in peer.data_list}
    for each in peer.data_list:
        own = columns[each.name, each.multi_id]
        assert list(own.dtype.names) == list(each.data)
        for field, values in each.data.items():
            np.testing.assert_array_equal(own[field], values)
    assert file.parameters == peer.initial_parameters
    assert file.changes == peer.changed_parameters
    assert file.dropouts == [(each.timestamp, 1000 * each.duration) for each in peer.dropouts]
    assert not +file.losses
    found = (
        len(columns), sum(map(len, columns.values())), sum(file.parameters.values()), len(file.changes),
        len(file.defaults), len(file.texts), len(file.dropouts),
        sum(length for _, length in file.dropouts) // 1000,
    )  # fmt: skip
    assert found == pytest.approx(FILES[name], rel=1e-9)


@pytest.mark.parametrize("name", GYRO_SUMS)
def test_inertial_samples_have_the_sheets_sums_in_our_axes(logs: Path, name: str):
    inertial = streams_of(logs / f"{name}.ulg")["/vehicle/inertial"]
    sums = inertial["turn_rate_radps"].sum(axis=0) * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(sums, GYRO_SUMS[name], rtol=1e-9)
    assert inertial["specific_force_mps2"][:, 2].mean() > 9.5


def test_rows_before_the_first_stamp_of_a_piece_are_spread_from_the_last_one() -> None:
    """In equal steps where rows are of equal length, from what was known before the piece."""
    piece = UlogFile.__new__(UlogFile)
    piece._last_us = 5_000
    at, stamps = 9 + 10 * np.arange(10), np.append(np.zeros(9, np.int64), 6_000)
    found = piece._times(at, stamps, stamps > 0)
    assert found.tolist() == [*range(5_100, 6_001, 100)]


def test_the_filters_state_is_an_estimate_near_the_simulators_truth(logs: Path):
    """The sheet's comparison: the orientation errs by .23 deg on average, the position by 1 cm."""
    streams = streams_of(logs / f"{TAGGED}.ulg")
    estimate, truth = streams["/estimates/ekf2/vehicle/state"], streams["/vehicle/truth"]
    late = estimate.publish_time_ns > 5e9
    at = np.stack(
        [np.interp(estimate.publish_time_ns, truth.publish_time_ns, each) for each in truth["state"].T],
        1,
    )[late]
    error = estimate["mean"][late] - at
    assert np.sqrt((error[:, :3] ** 2).mean(axis=0)) == pytest.approx([0.011, 0.011, 0.007], abs=0.004)
    half = np.abs((estimate["mean"][late, 6:] * at[:, 6:]).sum(axis=1)).clip(max=1.0)
    assert np.degrees(2 * np.arccos(half)).mean() == pytest.approx(0.2261, abs=0.02)
    up = rotate(at[:, 6:], [0.0, 0.0, 1.0])
    assert up[:, 2].min() > 0.99  # it stands upright
    covariance = estimate["covariance"].reshape(-1, 9, 9)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_innovations_are_new_ones_of_sensors_that_were_fused(logs: Path):
    def sensors_of(streams: dict) -> set[str]:
        return {topic.split("/")[4] for topic in streams if topic.startswith("/estimates/ekf2/v")}

    # It waits for its fixes, and holds its place until then.
    assert sensors_of(streams_of(logs / f"{TAGGED}.ulg")) == {"barometer", "heading", "state"}
    streams = streams_of(logs / "sample_px4_events.ulg")
    gnss = {"gnss_position", "gnss_velocity"}
    assert sensors_of(streams) == {"barometer", *gnss, "gravity", "heading", "state"}
    stream = streams["/estimates/ekf2/vehicle/gnss_position/innovation"]
    assert len(stream) == 22  # of 31; before it had an origin nine were a thousand kilometres long
    assert np.abs(stream["innovation"]).max() < 1.0
    assert (np.diff(stream["innovation"][:, :2], axis=0) != 0.0).any(axis=1).all()
    variance = np.diagonal(stream["covariance"].reshape(-1, 3, 3), axis1=1, axis2=2)
    nis = (stream["innovation"] ** 2 / variance).sum(axis=1)
    np.testing.assert_allclose(stream["normalised_innovation_squared"], nis)


def test_rows_without_a_stamp_lie_between_their_neighbours(logs: Path):
    blocks = UlogFile(logs / "sample.ulg").blocks("ekf2_innovations".__eq__)
    found = [rows for block in blocks for rows in block]
    time_us = np.concatenate([rows.time_us for rows in found])
    assert sum(rows.untimed for rows in found) == len(time_us) == 3271
    assert np.ptp(time_us) == pytest.approx(68.9e6, rel=0.02)
    assert 0 < np.diff(time_us).min() < np.diff(time_us).max() < 100_000


# Files by hand.


def message(kind: str, body: bytes, size: int | None = None) -> bytes:
    return struct.pack("<HB", len(body) if size is None else size, ord(kind)) + body


def by_hand(
    *extra: bytes, formats: tuple[str, ...] = (), last: bytes = b"", rows: int = 300, marks: bool = True
) -> bytes:
    """A log of `sensor_combined`, with more definitions, then messages before its rows."""
    layout = "sensor_combined:uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
    parts = [MAGIC + b"\x01" + struct.pack("<Q", 1_000_000)]
    parts += [message("F", each.encode()) for each in (layout, *formats)]
    parts += [message("P", bytes([12]) + b"float SOME_X" + struct.pack("<f", 1.5))]
    parts += [message("A", struct.pack("<BH", 0, 7) + b"sensor_combined"), *extra]
    for row in range(rows):
        values = struct.pack("<HQ6f", 7, 1_000_000 + 4000 * row, row, 2, 3, 0, 0, -9.8)
        parts.append(message("D", values))
        if marks and row % 50 == 0:
            parts.append(message("S", bytes.fromhex("2f731320250cbb12")))
    return b"".join([*parts, last])


def read(path: Path, content: bytes) -> tuple[np.ndarray, dict[str, str]]:
    """The rows that come of a file, each of them one that was written, and the notes."""
    path.write_bytes(content)
    blocks = ULOG.read(path, UlogParameters())
    stream = next(each for each in blocks.together().streams if each.topic == "/vehicle/inertial")
    row = np.rint((stream.publish_time_ns / 1000 - 1_000_000) / 4000)
    return stream["turn_rate_radps"][:, 0] - row, blocks.notes


def rows_in(path: Path, content: bytes) -> bytes:
    """The rows of `sensor_combined` that a file has, as they lie there; none where it is refused."""
    path.write_bytes(content)
    rows, said = None, ""
    try:
        rows = columns_of(UlogFile(path)).get(("sensor_combined", 0))
    except BadInput as error:
        said = str(error)
    assert re.fullmatch(r"(/[^:]*\.ulg: [^:]*[;:][^:]*(: [^:]*)?)?", said), said
    return b"" if rows is None else rows.tobytes()


@pytest.mark.paper
def test_a_log_that_is_cut_anywhere_gives_what_is_whole(tmp_path: Path):
    whole = by_hand()
    every = rows_in(tmp_path / "cut.ulg", whole)
    assert len(every) == 300 * 32
    begin = whole.index(b"D\x07\x00") - 2
    for cut in np.linspace(0, len(whole), 149).astype(int):
        found = rows_in(tmp_path / "cut.ulg", whole[:cut])
        assert every.startswith(found)
        assert len(found) // 32 >= (cut - begin - 6 * 11) // 37
    for cut in np.linspace(begin + 40, len(whole), 20).astype(int):
        off, _ = read(tmp_path / "cut.ulg", whole[:cut])
        assert len(off)
        assert not off.any()


def test_a_flipped_bit_changes_one_row_or_costs_those_up_to_the_next_mark(tmp_path: Path):
    """Numbers have no checksum, so that nobody can know of theirs."""
    whole = by_hand()
    every = {each.tobytes() for each in np.frombuffer(rows_in(tmp_path / "whole.ulg", whole), "V32")}
    rng = np.random.default_rng(6)
    for _ in range(100):
        content = bytearray(whole)
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        found = np.frombuffer(rows_in(tmp_path / "cut.ulg", bytes(content)), "V32")
        changed = sum(each.tobytes() not in every for each in found)
        assert changed <= 1
        assert len(found) + changed >= 240 or not len(found)


@pytest.mark.paper
def test_what_flips_in_heads_costs_rows_and_no_wrong_number(tmp_path: Path):
    """Heads are length and type; numbers have no checksum, so that nobody can know of theirs."""
    whole = by_hand()
    begin = whole.index(message("S", bytes.fromhex("2f731320250cbb12")))
    places = [
        match.start() for match in re.finditer(b"\x22\x00D\x07\x00", whole) if match.start() > begin
    ]
    rng = np.random.default_rng(5)
    for place in places[::15]:
        for offset in range(3):
            content = bytearray(whole)
            content[place + offset] ^= 1 << int(rng.integers(8))
            off, notes = read(tmp_path / "flip.ulg", bytes(content))
            assert not off.any()
            assert 300 > len(off) >= 240
            assert any(each.startswith("lost, ") for each in notes)


@pytest.mark.parametrize("marks", [True, False], ids=["marks", "no marks"])
@pytest.mark.parametrize("size", [0, 65535])
def test_an_impossible_length_costs_no_more_than_up_to_the_next_rows(
    tmp_path: Path, size: int, marks: bool
):
    off, notes = read(tmp_path / "length.ulg", by_hand(message("D", b"", size=size), marks=marks))
    assert not off.any()
    assert len(off) >= 299
    assert any(each.startswith("lost, ") for each in notes)


@pytest.mark.parametrize(
    ("formats", "said"),
    [
        (("loop:uint64_t timestamp;loop again;",), "lost, format loop refers to itself"),
        (("loop:uint64_t timestamp;b x;", "b:loop y;"), "lost, format loop refers to itself"),
        (
            ("loop:uint64_t timestamp;uint8_t[65535] x;",),
            "lost, format loop is longer than a message can be",
        ),
        (("loop:uint64_t timestamp;none x;",), "lost, format none is not defined"),
        (("loop:uint64_t timestamp;e[60000] x;", "e:"), "lost, format e has no fields"),
    ],
)
def test_a_format_that_cannot_be_costs_its_own_topic(
    tmp_path: Path, formats: tuple[str, ...], said: str
):
    subscribed = message("A", struct.pack("<BH", 0, 9) + b"loop")
    off, notes = read(tmp_path / "format.ulg", by_hand(subscribed, formats=formats))
    assert len(off) == 300
    assert not off.any()
    assert notes[said] == "1"


def test_a_number_that_two_topics_have_gives_rows_of_the_first_until_then(tmp_path: Path):
    other = "other:uint64_t timestamp;float[6] x;"
    again = message("A", struct.pack("<BH", 0, 7) + b"sensor_combined")
    off, _ = read(tmp_path / "same.ulg", by_hand(again))
    assert len(off) == 300
    content = by_hand(formats=(other,), last=message("A", struct.pack("<BH", 0, 7) + b"other"))
    foreign = message("D", struct.pack("<HQ6f", 7, 2_000_000, *range(6)))
    off, notes = read(tmp_path / "twice.ulg", content + foreign)
    assert len(off) == 300
    assert not off.any()
    assert notes["lost, number of sensor_combined that other also uses"] == "1"


@pytest.mark.parametrize("content", [b"", b"no ULog at all", MAGIC], ids=["empty", "magic", "short"])
def test_what_is_no_ulog_is_refused_in_a_sentence(tmp_path: Path, content: bytes):
    with pytest.raises(
        BadInput, match=r"bad\.ulg: is (empty|not a ULog file); give a \.ulg file of PX4"
    ):
        read(tmp_path / "bad.ulg", content)


def test_stamps_beyond_64_bits_are_refused(tmp_path: Path) -> None:
    content = bytearray(by_hand(rows=1, marks=False))
    content[8:16] = struct.pack("<Q", 1 << 61)
    content[-32:-24] = struct.pack("<Q", 1 << 61)
    with pytest.raises(BadInput, match=r"a stamp is before 1970 or after 2262 \(2305843009213693952 t"):
        read(tmp_path / "a.ulg", bytes(content))


def test_a_parameter_that_changes_is_no_value_from_the_start(tmp_path: Path):
    """Each has its own column, in the order of the file, and a change is of its own alone."""

    def parameter(name: str, value: float) -> bytes:
        text = f"float {name}".encode()
        return message("P", bytes([len(text)]) + text + struct.pack("<f", value))

    path = tmp_path / "change.ulg"
    first = parameter("SOME_X", 1.5)
    more = first + parameter("OTHER_Z", 7.0) + parameter("A_LAST_ONE", -3.0)
    changes = parameter("OTHER_Z", 8.0) + parameter("SOME_X", 2.5) + parameter("SOME_X", 2.5)
    content = by_hand()
    half = content.index(struct.pack("<HQ", 7, 1_000_000 + 4000 * 150)) - 3
    later = content[half:] + parameter("A_LAST_ONE", -4.0)
    path.write_bytes(content[:half].replace(first, more) + changes + later)
    stream = streams_of(path)["/vehicle/parameters"]
    assert stream.components == ["SOME_X", "OTHER_Z", "A_LAST_ONE"]
    values = [[1.5, 7.0, -3.0], [1.5, 8.0, -3.0], [2.5, 8.0, -3.0], [2.5, 8.0, -4.0]]
    assert stream["value"].tolist() == values
    elapsed_us = stream.publish_time_ns // 1000 - 1_000_000
    assert elapsed_us.tolist() == [0, *[149 * 4000] * 2, 299 * 4000]


def test_innovations_are_what_was_measured_minus_what_was_predicted_in_our_axes(tmp_path: Path):
    """PX4's are predicted minus measured, north, east, down and forward, right, down; see `_SENSORS`."""
    predicted = {
        "gps_hpos": [10, 20],
        "gps_vpos": [-30],
        "heading": [0.5],
        "mag_field": [0.2, 0.1, 0.4],
        "flow": [0.1, 0.2],
        "baro_vpos": [-30],
        "rng_vpos": [-30],
        "ev_hpos": [10, 20],
        "ev_vpos": [-30],
        "ev_hvel": [1, 2],
        "ev_vvel": [-3],
        "gps_hvel": [1, 2],
        "gps_vvel": [-3],
        "gravity": [0.2, 0.1, 0.4],
        "airspeed": [15],
        "beta": [0.5],
    }
    measured = {
        "gps_hpos": [11, 22],
        "gps_vpos": [-33],
        "heading": [0.7],
        "mag_field": [0.3, 0.15, 0.45],
        "flow": [0.15, 0.3],
        "baro_vpos": [-31],
        "rng_vpos": [-32],
        "ev_hpos": [13, 21],
        "ev_vpos": [-34],
        "ev_hvel": [1.5, 2.25],
        "ev_vvel": [-3.5],
        "gps_hvel": [1.25, 2.5],
        "gps_vvel": [-3.75],
        "gravity": [0.3, 0.15, 0.45],
        "airspeed": [16],
        "beta": [0.7],
    }
    fields = "".join(f"float[{len(each)}] {name};" for name, each in predicted.items()).replace(
        "[1]", ""
    )
    topics = ("estimator_innovations", "estimator_innovation_variances", "estimator_status")
    stamps = "uint64_t timestamp;uint64_t timestamp_sample;"
    formats = tuple(f"{topic}:{stamps}{fields}" for topic in topics[:2])
    formats += (f"{topics[2]}:{stamps}uint64_t control_mode_flags;",)
    subscribed = [message("A", struct.pack("<BH", 0, 20 + n) + t.encode()) for n, t in enumerate(topics)]
    off = np.concatenate([np.subtract(predicted[name], measured[name]) for name in predicted])
    in_use = sum(
        1 << bit for bit in (2, 3, 4, 5, 9, 10, 12, 14, 15, 19, 24, 34)
    )  # not the height of fixes

    def row(number: int, stamp: int, body: bytes) -> bytes:
        return message("D", struct.pack("<HQQ", number, stamp + LATER_US, stamp) + body)

    rows = b""
    for step, flags in enumerate((in_use, 0, in_use)):
        stamp = 1_000_000 + 100_000 * step
        rows += row(22, stamp, struct.pack("<Q", flags))
        rows += row(20, stamp, ((1 + step) * off).astype("<f4").tobytes())
        rows += row(21, stamp, np.ones(len(off), "<f4").tobytes())
    path = tmp_path / "signs.ulg"
    gate = message("P", bytes([21]) + b"float EKF2_GPS_P_GATE" + struct.pack("<f", 5.0))
    whole = by_hand(*subscribed, formats=formats, last=rows)
    other = message("P", bytes([12]) + b"float SOME_X" + struct.pack("<f", 1.5))
    path.write_bytes(whole.replace(other, other + gate))
    streams = streams_of(path)
    expected = {
        "gnss_position": [2, 1, np.nan],  # east, north; 22 and 11 were measured, 20 and 10 predicted
        "barometer": [1],
        "heading": [-0.2],  # counterclockwise from east: 90 deg less PX4's
        "magnetometer": [0.1, -0.05, -0.05],
        "flow": [0.05, -0.1],
        "range": [2],
        "vision_position": [1, 3, 4],
        "vision_velocity": [0.25, 0.5, 0.5],
        "gnss_velocity": [0.5, 0.25, 0.75],
        "gravity": [0.1, -0.05, -0.05],
        "airspeed": [1],
        "sideslip": [0.2],
    }
    for name, once in expected.items():
        innovation = streams[f"/estimates/ekf2/vehicle/{name}/innovation"]["innovation"]
        np.testing.assert_allclose(innovation, [once, np.multiply(3, once)], rtol=1e-5)
    stream = streams["/estimates/ekf2/vehicle/gnss_position/innovation"]
    assert stream.publish_time_ns.tolist() == [1_000_000_000, 1_200_000_000]  # as the samples were
    assert set(stream.log_time_ns - stream.publish_time_ns) == {1000 * LATER_US}
    assert stream["accepted"].tolist() == [1, 0]  # the last is six standard deviations to the east

    # of the first sample PX4 says that it was out of the gate, of the last it says nothing
    ratios, number = "estimator_innovation_test_ratios", 23
    subscribed.append(message("A", struct.pack("<BH", 0, number) + ratios.encode()))
    rows += row(number, 1_000_000, np.full(len(off), 2.0, "<f4").tobytes())
    path = tmp_path / "ratios.ulg"
    path.write_bytes(by_hand(*subscribed, formats=(*formats, f"{ratios}:{stamps}{fields}"), last=rows))
    streams = streams_of(path)
    for name in ("barometer", "heading", "airspeed"):
        accepted = streams[f"/estimates/ekf2/vehicle/{name}/innovation"]["accepted"]
        assert accepted.tolist() == [0, 1], name


@pytest.mark.parametrize(("count", "turned"), [(24, [0.04, 0.08, 0.12]), (23, [0.02, 0.03, 0.04])])
def test_states_are_in_our_axes_with_the_variances_of_old_and_new_firmware(
    tmp_path: Path, count: int, turned: list[float]
):
    """A level vehicle that heads north; old firmware has variances of four numbers of a quaternion."""
    fields = f"float[24] states;float[{count}] covariances;"
    layout = f"estimator_states:uint64_t timestamp;uint64_t timestamp_sample;{fields}uint8_t n_states;"
    states = np.concatenate([[1, 0, 0, 0], [1, 2, 3], [10, 20, 30], np.zeros(14)])
    turns = [0.005, 0.01, 0.02, 0.03] if count == 24 else turned
    variances = np.concatenate([turns, [0.1, 0.2, 0.3], [1, 2, 3], np.zeros(count - 6 - len(turns))])
    body = np.concatenate([states, variances]).astype("<f4").tobytes() + b"\x18"
    rows = message("D", struct.pack("<HQQ", 20, 1_000_000 + LATER_US, 1_000_000) + body)
    path = tmp_path / "states.ulg"
    subscribed = message("A", struct.pack("<BH", 0, 20) + b"estimator_states")
    path.write_bytes(by_hand(subscribed, formats=(layout,), last=rows))
    stream = streams_of(path)["/estimates/ekf2/vehicle/state"]
    assert stream.publish_time_ns.tolist() == [1_000_000_000]
    assert stream.log_time_ns.tolist() == [1_000_000_000 + 1000 * LATER_US]
    [mean], [covariance] = stream["mean"], stream["covariance"].reshape(-1, 9, 9)
    np.testing.assert_allclose(mean[:6], [20, 10, -30, 2, 1, -3])
    np.testing.assert_allclose(rotate(mean[6:], np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(covariance, np.diag([2, 1, 3, 0.2, 0.1, 0.3, *turned]), atol=1e-6)


FIX = "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;uint8_t fix_type;"
NEW_FIX = (
    "uint64_t timestamp;double latitude_deg;double longitude_deg;double altitude_msl_m;"
    "double altitude_ellipsoid_m;uint8_t fix_type;"
)
MAG = "uint64_t timestamp;float[3] magnetometer_ga;"
RAW_MAG = "uint64_t timestamp;float x;float y;float z;"
PLACE = (
    "uint64_t timestamp;uint64_t ref_timestamp;double ref_lat;double ref_lon;float ref_alt;"
    "uint8_t xy_global;"
)


def several(
    formats: dict[str, str], rows: list[tuple[str, int, str, tuple[float, ...]]], begin: bytes = b""
) -> bytes:
    """A log of rows (topic, instance, struct's codes, values) in their order, by topics' formats."""
    numbers = {key: 30 + n for n, key in enumerate(dict.fromkeys(each[:2] for each in rows))}
    subscribed = [
        message("A", struct.pack("<BH", instance, number) + topic.encode())
        for (topic, instance), number in numbers.items()
    ]
    data = [
        message("D", struct.pack(f"<HQ{codes}", numbers[topic, instance], 1_000_000 + 4000 * n, *values))
        for n, (topic, instance, codes, values) in enumerate(rows)
    ]
    layouts = tuple(f"{topic}:{fields}" for topic, fields in formats.items())
    return by_hand(*subscribed, formats=layouts, last=b"".join([begin, *data]), rows=30)


def test_instances_of_a_topic_have_streams_of_their_own(tmp_path: Path):
    """The first has the name that filters look for; no other has that of a raw sensor."""
    fixes = {0: 8.5, 1: 8.6, 2: 8.7}
    rows = [
        ("vehicle_gps_position", number, "iiiiB", (474000000, round(1e7 * fixes[number]), 0, 0, 3))
        for _ in range(3)
        for number in fixes
    ]
    rows += [
        ("vehicle_magnetometer", number, "3f", (0.1 * number, 0, 0)) for number in (3, 1, 2, 1, 3, 2)
    ]
    rows += [("sensor_mag", number, "3f", (0.5, 0, 0)) for number in (1, 2)]
    formats = {"vehicle_gps_position": FIX, "vehicle_magnetometer": MAG, "sensor_mag": RAW_MAG}
    path = tmp_path / "instances.ulg"
    path.write_bytes(several(formats, rows))
    blocks = ULOG.read(path, UlogParameters())
    streams = {each.topic.removeprefix("/vehicle/"): each for each in blocks.together().streams}
    for number, longitude in fixes.items():
        name = f"fix_vehicle_gps_position_{number}" if number else "fix"
        assert streams[name]["longitude_deg"].tolist() == pytest.approx([longitude] * 3)
    first = {name: each["magnetic_field_ut"][0, 0] for name, each in streams.items() if "magnet" in name}
    assert first == pytest.approx(
        {
            "magnetometer": 10,  # of instance 1, which is the first
            "magnetometer_vehicle_magnetometer_2": 20,
            "magnetometer_vehicle_magnetometer_3": 30,
            "magnetometer_1": 50,
            "magnetometer_2": 50,
        }
    )
    told = blocks.notes["vehicle_gps_position, instance 2"]
    assert told.startswith(
        "another instance, as /vehicle/fix_vehicle_gps_position_2, /vehicle/velocity_"
    )


def test_an_instance_that_is_subscribed_to_again_is_one_stream(tmp_path: Path):
    subscribed = [message("A", struct.pack("<BH", 0, number) + b"sensor_mag") for number in (30, 31)]
    rows = [
        message(
            "D", struct.pack("<HQ3f", 30 + number % 2, 1_000_000 + 4000 * number, 0.1 * number, 0, 0)
        )
        for number in range(4)
    ]
    path = tmp_path / "twice.ulg"
    path.write_bytes(
        by_hand(*subscribed, formats=(f"sensor_mag:{RAW_MAG}",), last=b"".join(rows), rows=4)
    )
    streams = {each.topic: each for each in ULOG.read(path, UlogParameters()).together().streams}
    found = streams["/vehicle/magnetometer_0"]["magnetic_field_ut"][:, 0]
    np.testing.assert_allclose(found, [0, 10, 20, 30], rtol=1e-6)


@pytest.mark.parametrize("is_new", [False, True], ids=["1.13", "1.15"])
@pytest.mark.parametrize(
    ("ellipsoid_m", "separation_m"),
    [
        ([0.0] * 6, 0.0),
        ([535.0] * 6, 47.0),
        ([535.0, 0.0, 535.0, 2e6, -3e5, 535.0], 47.0),
        ([0.0, 0.0, 0.0, 0.0, 535.0, 535.0], 47.0),
        ([488.0 + 151.0] * 6, 0.0),
        ([np.nan] * 6, 0.0),
        ([2147483.0] * 6, 0.0),
    ],
    ids=["zero", "good", "garbage", "zero at first", "far", "missing", "largest"],
)
def test_a_height_above_the_ellipsoid_that_is_none_is_that_above_the_sea(
    tmp_path: Path, is_new: bool, ellipsoid_m: list[float], separation_m: float
):
    """Fixes stay on one level with the origin of the filter's plane, and what was taken is counted."""
    fixes = []
    for height_m in ellipsoid_m:
        place = (47.4, 8.5, 488.0, height_m)
        scaled = (1e7, 1e7, 1e3, 1e3)
        numbers_ = (round(x * by) for x, by in zip(np.nan_to_num(place), scaled, strict=True))
        fixes.append((*(place if is_new else numbers_), 3))
    rows = [("vehicle_gps_position", 0, "ddddB" if is_new else "iiiiB", each) for each in fixes]
    rows.insert(1, ("vehicle_local_position", 0, "QddfB", (1_000_000, 47.4, 8.5, 488.0, 1)))
    formats = {"vehicle_gps_position": NEW_FIX if is_new else FIX, "vehicle_local_position": PLACE}
    path = tmp_path / "heights.ulg"
    path.write_bytes(several(formats, rows))
    blocks = ULOG.read(path, UlogParameters())
    fix = next(each for each in blocks.together().streams if each.topic == "/vehicle/fix")
    assert fix["altitude_m"] == pytest.approx(488.0 + separation_m)
    assert float(fix.metadata["origin_altitude_m"]) == pytest.approx(488.0 + separation_m)
    told = [text for text in blocks.notes if "above the ellipsoid" in text]
    wrong = sum(height_m != 535.0 for height_m in ellipsoid_m)
    assert [blocks.notes[text] for text in told] == [str(wrong)] * bool(wrong)
    assert all(text.endswith(", 47 m higher" if separation_m else "instead") for text in told)


def test_a_height_of_zero_above_the_sea_is_one_too(tmp_path: Path):
    """The filter's origin has it as well: both are on one level, whatever the ellipsoid says."""
    rows = [("vehicle_gps_position", 0, "iiiiB", (474000000, 85000000, 0, 535000, 3))] * 3
    rows.insert(1, ("vehicle_local_position", 0, "QddfB", (1_000_000, 47.4, 8.5, 0.0, 1)))
    path = tmp_path / "sea.ulg"
    path.write_bytes(several({"vehicle_gps_position": FIX, "vehicle_local_position": PLACE}, rows))
    streams = ULOG.read(path, UlogParameters()).together().streams
    fix = next(each for each in streams if each.topic == "/vehicle/fix")
    assert fix["altitude_m"].tolist() == [0.0] * 3
    assert float(fix.metadata["origin_altitude_m"]) == 0.0


def test_parameters_are_settings_of_ours_or_it_is_said_why_not():
    """Noise by the sheet, section 1: PX4's defaults are .0015 and .035 for a step of 10 ms."""
    parameters = {
        "EKF2_GYR_NOISE": 0.015,
        "EKF2_ACC_NOISE": 0.35,
        "EKF2_PREDICT_US": 10_000,
        "EKF2_GPS_DELAY": 110.0,
        "EKF2_GPS_POS_Y": 0.3,
        "EKF2_IMU_POS_Y": 0.1,
        "EKF2_ABIAS_INIT": 0.2,
        "EKF2_HDG_GATE": 2.6,
        "EKF2_TAU_POS": 0.25,
        "CAL_ACC0_XOFF": 0.1,
        "MPC_XY_P": 1.0,
    }
    stated = stated_noise(parameters)["inertial"]
    assert stated == {"gyro_noise_density": "0.0015", "force_noise_density": "0.035"}
    notes = carried(parameters)
    settings = notes.pop("settings that the filter had").split(" --set ")
    assert settings == [
        "--set fix_delay_s=0.11",
        "velocity_delay_s=0.11",
        "force_bias_sigma_mps2=0.2",
        "lever_y_m=-0.2",
    ]
    replayed = fl.replay(fl.record("navigation", duration_s=12.0), "ekf", set=dict(
        each.removeprefix("--set ").split("=") for each in settings
    ))  # fmt: skip
    assert not replayed.failures  # the model has them all
    assert notes["EKF2_HDG_GATE"].startswith("test single components")
    assert notes["EKF2_TAU_POS"] == "have no counterpart in the model inertial"
    assert notes["CAL_ACC0_XOFF"].startswith("were applied before")
    many = carried({f"EKF2_OTHER_{number}": 0.0 for number in range(200)})
    assert list(many) == ["EKF2_OTHER_0, EKF2_OTHER_1, EKF2_OTHER_10 and 197 more"]
