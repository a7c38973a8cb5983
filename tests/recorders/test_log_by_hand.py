"""Small logs against numbers written by hand: bytes by struct, orders and windows as plain lists.

The property tests compare the reader with a sort; here nothing of ours stands on the other side.
"""

import hashlib
import struct
import time
import zlib
from itertools import pairwise

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import (
    LogWriter,
    RunMetadata,
    loops,
    make_stream,
    open_log,
    read_blocks,
    read_streams,
    schemas,
    write_log,
)
from fuselog.recorders.log.container.ahead import ahead
from fuselog.recorders.log.container.chunks import Damaged, Span, open_region
from fuselog.recorders.log.container.sealed import seal, unseal
from fuselog.recorders.log.layout import layout_of
from fuselog.recorders.log.loops import agree

# Two blocks of five scans; the second block reaches back, and stamps are equal within and across them.
NUMBERS = [[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]]
PUBLISHED = [[50, 10, 50, 30, 50], [50, 20, 30, 90, 10]]
LOGGED = [[60, 60, 55, 90, 60], [60, 95, 60, 90, 55]]
# Each block is in the file by log time, ties as they came: 3 1 2 5 4, then 10 6 8 9 7.
BY_LOG_TIME = [3, 10, 1, 2, 5, 6, 8, 4, 9, 7]
BY_PUBLISH_TIME = [2, 10, 7, 4, 8, 3, 1, 5, 6, 9]
ORDERS = {"publish_time": BY_PUBLISH_TIME, "log_time": BY_LOG_TIME}


def scans(numbers, published, logged, topic="/scan"):
    return make_stream(
        topic, schemas.SCAN, published, log_time_ns=logged, scan_id=numbers, detections=numbers
    )


@pytest.fixture(params=[1, 110, 1 << 20], ids=["a chunk each", "two a chunk", "a chunk a block"])
def path(request, tmp_path):
    """The two blocks as a log."""
    with LogWriter(tmp_path / "run.mcap", chunk_bytes=request.param) as log:
        for block in zip(NUMBERS, PUBLISHED, LOGGED, strict=True):
            log.write([scans(*block)])
    return tmp_path / "run.mcap"


@pytest.mark.parametrize("recover", [False, True])
@pytest.mark.parametrize("clock", ORDERS)
def test_late_messages_and_equal_stamps_are_read_in_the_order_written_here(path, clock, recover):
    log = open_log(path, recover=recover)
    found = read_streams(log, ["/scan"], order=clock)["/scan"]
    assert found["scan_id"].tolist() == ORDERS[clock]
    stamps = {
        number: (published, logged)
        for block in zip(NUMBERS, PUBLISHED, LOGGED, strict=True)
        for number, published, logged in zip(*block, strict=True)
    }
    assert found.publish_time_ns.tolist() == [stamps[number][0] for number in ORDERS[clock]]
    assert found.log_time_ns.tolist() == [stamps[number][1] for number in ORDERS[clock]]
    assert found["sensor_time_ns"].tolist() == found.publish_time_ns.tolist()
    for size in (1, 3):
        blocks = [
            each["/scan"] for each in read_blocks(log, ["/scan"], order=clock, block_messages=size)
        ]
        assert [number for each in blocks for number in each["scan_id"].tolist()] == ORDERS[clock]
        spans = [(each.times(clock)[0], each.times(clock)[-1]) for each in blocks]
        assert all(before[1] < after[0] for before, after in pairwise(spans))


@pytest.mark.parametrize(
    ("clock", "start_ns", "end_ns", "expected"),
    [
        ("publish_time", 10, 30, [2, 10, 7]),
        ("publish_time", 30, 31, [4, 8]),
        ("publish_time", 31, 50, []),
        ("publish_time", 50, 90, [3, 1, 5, 6]),
        ("publish_time", 90, None, [9]),
        ("publish_time", 91, None, []),
        ("publish_time", None, 10, []),
        ("publish_time", None, 11, [2, 10]),
        ("log_time", 55, 60, [3, 10]),
        ("log_time", 60, 90, [1, 2, 5, 6, 8]),
        ("log_time", 61, 95, [4, 9]),
        ("log_time", 95, 96, [7]),
        ("log_time", None, 55, []),
    ],
)
def test_a_window_begins_with_its_start_and_ends_before_its_end(path, clock, start_ns, end_ns, expected):
    found = read_streams(open_log(path), ["/scan"], order=clock, start_ns=start_ns, end_ns=end_ns)
    assert found["/scan"]["scan_id"].tolist() == expected


def test_equal_stamps_stay_in_file_order_across_large_chunks(tmp_path):
    """Offsets inside a chunk are larger than 16 bits: they must not run into the chunks' own order."""
    numbers = np.arange(60_000)
    write_log(tmp_path / "run.mcap", [scans(numbers, np.full(60_000, 5), numbers)])
    log = open_log(tmp_path / "run.mcap")
    assert len(log.container.regions) > 2
    assert np.array_equal(read_streams(log, ["/scan"])["/scan"]["scan_id"], numbers)


def records_of(data: bytes) -> list[tuple[int, bytes]]:
    """Opcode and content of every record, by the MCAP specification."""
    found, place = [], 0
    while place < len(data):
        opcode, length = struct.unpack_from("<BQ", data, place)
        found.append((opcode, data[place + 9 : place + 9 + length]))
        place += 9 + length
    return found


def test_the_bytes_of_messages_are_those_of_mcap_and_protobuf(tmp_path):
    """Channel, sequence, clocks, and before a vector of 16 doubles a length of two bytes."""
    states = [np.arange(16.0), np.arange(16.0) + 100]
    path = tmp_path / "run.mcap"
    with LogWriter(path, compression="none") as log:
        log.write([scans([7], [3], [4])])
        for number, state in enumerate(states):
            log.write(
                [
                    make_stream(
                        "/truth",
                        schemas.TRUTH_STATE,
                        [10 + number],
                        log_time_ns=[20 + number],
                        sensor_time_ns=[30 + number],
                        state=[state],
                    )
                ]
            )
    raw = path.read_bytes()
    chunks = [content for opcode, content in records_of(raw[8:-8]) if opcode == 6]
    messages = []
    for content in chunks:
        first, last, size, checksum, name_length, length = struct.unpack_from("<QQQIIQ", content)
        data = content[40:]
        assert (name_length, length, size) == (0, len(data), len(data))
        assert checksum == zlib.crc32(data)
        ((opcode, message),) = records_of(data)
        assert opcode == 5
        assert first == last == struct.unpack_from("<Q", message, 6)[0]
        messages.append(message)
    assert messages[0] == struct.pack("<HIQQBqBIBI", 1, 0, 4, 3, 0x09, 3, 0x15, 7, 0x1D, 7)
    for number, state in enumerate(states):
        head = struct.pack("<HIQQBq", 2, number, 20 + number, 10 + number, 0x09, 30 + number)
        assert messages[1 + number] == head + b"\x12\x80\x01" + state.tobytes()


def test_no_byte_behind_the_data_is_compared():
    """A chunk is a piece of memory, and what follows it there may look like the rest of a message."""
    stream = scans([1, 2, 3], [1, 2, 3], [1, 2, 3])
    layout = layout_of(stream.schema, {})
    raw = layout.build(stream, 1, 0).view(np.uint8)
    offsets = np.arange(3) * layout.pattern.size
    assert agree(raw, offsets, layout.pattern)
    for missing in (1, 8, layout.pattern.size - 1):
        assert not agree(raw[:-missing], offsets, layout.pattern)
    for place in range(len(raw)):
        changed = raw.copy()
        changed[place] ^= 1
        field = place % layout.pattern.size
        is_fixed = field < 9 or field in (31, 40, 45)  # opcode, length, and the tags of three fields
        assert agree(changed, offsets, layout.pattern) != is_fixed


def test_the_checksum_of_the_data_is_there_and_right(tmp_path):
    """Readers let a checksum of 0 pass: none may be written."""
    path = tmp_path / "run.mcap"
    write_log(path, [scans([1, 2], [3, 4], [5, 6])], RunMetadata("demo"))
    raw = path.read_bytes()
    (start,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    assert struct.unpack_from("<BQI", raw, start - 13) == (0x0F, 4, zlib.crc32(raw[: start - 13]))
    assert struct.unpack_from("<I", raw, len(raw) - 12)[0] == zlib.crc32(raw[start : len(raw) - 12])


def test_a_log_of_these_numbers_has_these_bytes(tmp_path):
    """Without compression a log is the same on every machine; who changes the format changes this."""
    path = tmp_path / "run.mcap"
    run = RunMetadata("demo", {"b": 0.1, "a": [1, 2]}, 7, 3, 1000, {"z": "1", "y": "2"})
    with LogWriter(path, run, compression="none", chunk_bytes=200) as log:
        for block in zip(NUMBERS, PUBLISHED, LOGGED, strict=True):
            fix = make_stream(
                "/fix",
                schemas.POSITION_FIX,
                block[1],
                log_time_ns=block[2],
                metadata={"b": "1", "a": "2"},
                position_m=np.outer(block[0], [0.5, -2.0]),
                covariance_m2=np.outer(block[0], [1.0, np.nan, np.inf, 4.0]),
            )
            log.write([scans(*block), fix])
    assert hashlib.sha256(path.read_bytes()).hexdigest() == GOLDEN_SHA256


GOLDEN_SHA256 = "8c85692bf71e1e73babfef3cbd43b6db8b3d2465bdea5c9622c6fb40291561c6"


def test_the_noted_span_of_publish_time_is_that_of_the_chunk(path):
    """Noted wrongly, a chunk is skipped; noted as the log time, it is read at the wrong time."""
    raw, noted = path.read_bytes(), open_log(path).container.metadata["fuselog.publish_spans"]
    regions = open_log(path).container.regions
    assert len(noted) == len(regions)
    for region in regions:
        data = open_region(raw[region.offset : region.offset + region.length], 0).data.tobytes()
        stamps = [struct.unpack_from("<QQ", content, 6) for opcode, content in records_of(data)]
        logged, published = zip(*stamps, strict=True)
        assert noted[f"{region.offset}+{region.length}"] == f"{min(published)} {max(published)}"
        assert region.spans["log_time"] == (min(logged), max(logged))


def test_spans_include_both_of_their_ends():
    span = Span(3, 7)
    assert [span.meets(Span(*other)) for other in [(0, 2), (0, 3), (7, 9), (8, 9), (4, 5), (0, 9)]] == [
        False, True, True, False, True, True,
    ]  # fmt: skip
    assert [span.holds(Span(*other)) for other in [(3, 7), (2, 7), (3, 8), (4, 4), (0, 9)]] == [
        True, False, False, True, False,
    ]  # fmt: skip


def test_a_seal_is_of_every_name_and_value():
    """Each change of one character is found out, whatever the order of the pairs."""
    sealed = seal({"a": "1", "b": "2"})
    assert unseal("fuselog.run", dict(reversed(sealed.items()))) == {"a": "1", "b": "2"}
    changed = [
        {**sealed, "a": "2"},
        {**sealed, "c": "1"},
        {"a": "1", "crc32": sealed["crc32"]},
        {"a": "2", "b": "1", "crc32": sealed["crc32"]},
        {"a": "1", "b": "2"},
        {**sealed, "crc32": "00000000"},
    ]
    for pairs in changed:
        with pytest.raises(Damaged, match=r"'fuselog\.run' is damaged"):
            unseal("fuselog.run", pairs)
    assert unseal("other", {"crc32": "x"}) == {"crc32": "x"}


def test_what_works_ahead_keeps_the_order():
    """The first item is slow, the others overtake it."""

    def work(item):
        time.sleep(0.02 if item in (1, 2) else 0)
        return item

    assert list(ahead(work, range(12))) == list(range(12))


def test_nan_and_negative_stamps_are_found_wherever_they_are(tmp_path):
    """In the last message, of the last component: not the first number alone is looked at."""
    field = np.zeros((3, 3))
    field[2, 2] = np.nan
    with pytest.raises(BadInput, match=r"magnetic_field_ut is NaN in message 2 \(1 in all\)"):
        make_stream(
            "/m",
            schemas.MAGNETIC_FIELD,
            [1, 2, 3],
            magnetic_field_ut=field,
            covariance_ut2=np.zeros((3, 9)),
        )
    with pytest.raises(BadInput, match="publish_time is before 1970"):
        scans([1, 2, 3], [1, 2, -3], [1, 2, 3])
    for name in ("/scan\0", "/scan\x1b[31m", "/\u202escan"):
        with pytest.raises(BadInput, match="its name has characters that cannot be printed"):
            write_log(tmp_path / "run.mcap", [scans([1], [1], [1], name)])


def test_the_widths_of_a_topic_are_those_of_its_first_message(tmp_path):
    """A single message of another width is refused as ten are."""

    def value(width):
        return make_stream("/v", schemas.VECTOR_MEASUREMENT, [1], value=np.zeros((1, width)))

    with LogWriter(tmp_path / "run.mcap") as log:
        log.write([value(2)])
        with pytest.raises(BadInput, match="has vectors of widths"):
            log.write([value(3)])


@pytest.mark.paper
def test_a_chunk_is_walked_in_plain_python_as_it_is_compiled(path, monkeypatch):
    """Whole, cut off, and with bytes that are changed, so that lengths are of any size."""
    log = open_log(path)
    region = log.container.regions[0]
    whole = open_region(path.read_bytes()[region.offset : region.offset + region.length], 0).data
    generator = np.random.default_rng(0)
    for changes in [0, *[1, 2, 8] * 40]:
        data = whole[: generator.integers(len(whole) // 2, len(whole) + 1)].copy()
        data[generator.integers(len(data), size=changes)] = generator.integers(256, size=changes)
        compiled = loops.scan(data)
        with monkeypatch.context() as plain:
            plain.setattr(loops, "kernel", lambda loop: loop)
            for ours, theirs in zip(loops.scan(data), compiled, strict=True):
                np.testing.assert_array_equal(ours, theirs)
