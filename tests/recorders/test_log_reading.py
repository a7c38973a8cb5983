"""What is written to a log is what is read from it, in the order promised."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import (
    LogWriter,
    RunMetadata,
    make_stream,
    open_log,
    read_blocks,
    read_streams,
    reader,
    schemas,
    write_log,
)
from fuselog.recorders.log.container.ahead import THREADS, ahead
from fuselog.recorders.log.schemas import SCHEMAS
from tests.recorders.log_samples import LARGEST_TIME, assert_same, rows_read, some_streams, streams

COMPRESSIONS = ["zstd", "lz4", "none"]
FEW_STAMPS = st.integers(0, 30)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("log") / "run.mcap"


@pytest.mark.paper
@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=list(SCHEMAS))
@settings(max_examples=4)
@given(data=st.data(), compression=st.sampled_from(COMPRESSIONS))
def test_every_schema_reads_back_bit_for_bit(path, schema, data, compression):
    """Infinities, zeros, NaN where allowed, empty streams and vectors, wide vectors: all are kept."""
    stream = data.draw(streams(schema, times=st.one_of(FEW_STAMPS, st.integers(0, LARGEST_TIME))))
    write_log(path, [stream], compression=compression)
    found = read_streams(open_log(path), [stream.topic])[stream.topic]
    if len(stream):
        assert_same(found, stream, rows_read(stream))
    else:
        assert len(found) == 0
        assert [column.ndim for column in found.columns.values()] == [
            column.ndim for column in stream.columns.values()
        ]


@pytest.mark.paper
@settings(max_examples=12)
@given(
    data=st.data(),
    chunk_bytes=st.sampled_from([1, 150, 500, 1 << 20]),
    block_messages=st.sampled_from([1, 5, 20, 1 << 18]),
    order=st.sampled_from(["publish_time", "log_time"]),
    parts=st.integers(1, 4),
)
def test_blocks_follow_one_another_in_time_however_late_messages_come(
    path, data, chunk_bytes, block_messages, order, parts
):
    """Late messages cross chunks and blocks, and a topic still reads as a plain stable sort of them."""
    kinds = [schemas.BEARING, schemas.TRUTH_STATE, schemas.SCAN]
    written = [data.draw(streams(kind, f"/{kind.name}", FEW_STAMPS, most=25)) for kind in kinds]
    with LogWriter(path, chunk_bytes=chunk_bytes) as log:
        for part in range(parts):
            log.write([stream.take(slice(part, None, parts)) for stream in written])
    blocks = list(
        read_blocks(
            open_log(path),
            [stream.topic for stream in written],
            order=order,
            block_messages=block_messages,
        )
    )
    spans = [
        (
            min(stream.times(order)[0] for stream in block.values()),
            max(stream.times(order)[-1] for stream in block.values()),
        )
        for block in blocks
    ]
    assert all(before[1] < after[0] for before, after in pairwise(spans))
    for stream in written:
        found = [block[stream.topic] for block in blocks if stream.topic in block]
        in_file = np.concatenate(
            [
                part + parts * np.argsort(stream.log_time_ns[part::parts], kind="stable")
                for part in range(parts)
            ]
        )
        rows = in_file[np.argsort(stream.times(order)[in_file], kind="stable")]
        assert sum(map(len, found)) == len(stream)
        begin = 0
        for each in found:
            assert_same(each, stream, rows[begin : begin + len(each)])
            begin += len(each)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 5),
    order=st.sampled_from(["publish_time", "log_time"]),
    start_ns=st.none() | st.integers(900, 1700),
    end_ns=st.none() | st.integers(900, 1700),
    chosen=st.sets(st.integers(0, 3), min_size=1),
    recover=st.booleans(),
)
def test_a_time_range_of_some_topics_is_what_a_mask_would_leave(
    path, seed, order, start_ns, end_ns, chosen, recover
):
    """Skipping chunks by their spans never loses a message: the start is included, the end is not."""
    written = some_streams(seed)
    with LogWriter(path, chunk_bytes=700) as log:
        log.write(written)
    written = [written[place] for place in chosen]
    found = read_streams(
        open_log(path, recover=recover),
        [stream.topic for stream in written],
        order=order,
        start_ns=start_ns,
        end_ns=end_ns,
    )
    for stream in written:
        rows = rows_read(stream, order)
        times = stream.times(order)[rows]
        is_inside = (times >= (start_ns or 0)) & (times < (end_ns or LARGEST_TIME))
        assert_same(found[stream.topic], stream, rows[is_inside])


def test_memory_is_bounded_by_the_block_and_not_by_the_log(path):
    """One message that comes very late does not make the reader hold the whole log until then."""
    count = 3000
    published = np.arange(count) * 10
    logged = published.copy()
    logged[5] = published[-1]
    stream = make_stream(
        "/a", schemas.SCAN, published, log_time_ns=logged, scan_id=published, detections=published
    )
    with LogWriter(path, chunk_bytes=2000) as log:
        log.write([stream])
    sizes = [len(block["/a"]) for block in read_blocks(open_log(path), ["/a"], block_messages=200)]
    assert sum(sizes) == count
    assert max(sizes) < 500


def test_messages_that_wait_are_not_sorted_again_for_every_chunk(path, monkeypatch):
    """Where all chunks overlap everything waits for the last: the work must not grow with its square."""
    zeros = [0] * 400
    stream = make_stream(
        "/b", schemas.SCAN, zeros, log_time_ns=range(400), scan_id=zeros, detections=zeros
    )
    with LogWriter(path, chunk_bytes=500) as log:
        log.write([stream])
    sorted_at_once = []

    def counting(stream, clock):
        sorted_at_once.append(len(stream))
        return in_order(stream, clock)

    in_order = reader._in_order
    monkeypatch.setattr(reader, "_in_order", counting)
    (block,) = read_blocks(open_log(path), ["/b"], block_messages=1)
    assert len(block["/b"]) == 400
    assert sum(sorted_at_once) < 4 * 400


def test_threads_work_a_few_items_ahead_and_no_more():
    """Else a long log would be in memory as a whole before its first block is used."""
    begun = []

    def items():
        for item in range(50):
            begun.append(item)
            yield item

    results = ahead(lambda item: -item, items())
    for item in range(40):
        assert next(results) == -item
        assert len(begun) <= item + THREADS + 2
    assert list(results) == [-item for item in range(40, 50)]


def test_an_unknown_topic_is_told_with_those_there_are(path):
    write_log(path, some_streams(1))
    with pytest.raises(
        BadInput, match=r"no topic /imu; it has /bearing, /positionfix, /scan, /truthstate$"
    ):
        read_streams(open_log(path), ["/imu"])


def test_an_opened_log_tells_its_topics_and_its_run(path):
    """Names, counts, components and the run's metadata come back as they were written."""
    run = RunMetadata(
        "demo", {"sigma_rad": 0.1, "sensors": [1, 2]}, 7, 3, 1000, {"barcodes": "two unknown"}
    )
    write_log(path, some_streams(1, count=20), run)
    log = open_log(path)
    assert log.run == run
    assert log.loss_statement is None
    assert [(topic.name, topic.schema_name, topic.messages) for topic in log.topics.values()] == [
        ("/bearing", "fuselog.Bearing", 20),
        ("/positionfix", "fuselog.PositionFix", 20),
        ("/scan", "fuselog.Scan", 20),
        ("/truthstate", "fuselog.TruthState", 20),
    ]
    scan = read_streams(log, ["/scan"])["/scan"]
    assert scan.components == ["x_m", "y_m"]
    for rows, told in ((slice(1), "1 message"), (slice(2), "2 messages")):
        assert repr(scan.take(rows)).startswith(
            f"<Stream /scan, fuselog.Scan, {told}: publish_time_ns, "
        )


@pytest.mark.parametrize("count", [1, 2])
def test_numbers_of_packed_records_are_aligned_for_kernels(path, count):
    """A log's messages are such records, and a user may have some; one alone may stay where it is."""
    packed = np.zeros(count, [("odd", "u1"), ("time_ns", "i8"), ("x_m", "f8", 2)])
    packed["time_ns"], packed["x_m"] = np.arange(count), 1.5
    given = make_stream("/truth", schemas.TRUTH_STATE, packed["time_ns"], state=packed["x_m"])
    write_log(path, [given])
    for stream in (given, read_streams(open_log(path), ["/truth"])["/truth"]):
        numbers = [stream.publish_time_ns, stream.log_time_ns, *stream.columns.values()]
        assert all(each.flags.aligned for each in numbers)
        assert stream["state"].tolist() == [[1.5, 1.5]] * count


def test_a_log_without_messages_is_a_log(path):
    write_log(path, [])
    assert open_log(path).topics == {}
    assert list(read_blocks(open_log(path), [])) == []
    empty = make_stream("/empty", schemas.TRUTH_STATE, [], state=np.empty((0, 4)))
    write_log(path, [empty])
    assert len(read_streams(open_log(path), ["/empty"])["/empty"]) == 0
    assert list(read_blocks(open_log(path), ["/empty"])) == []
