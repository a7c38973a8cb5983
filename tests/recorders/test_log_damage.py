"""A damaged log is refused with one sentence, or read exactly as far as it is whole; never wrongly."""

import re
import struct
import tracemalloc
from collections import Counter
from io import BytesIO

import lz4.frame
import pytest
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, RunMetadata, open_log, read_streams, schemas, write_log
from tests.recorders.log_samples import assert_same, some_streams

RUN = RunMetadata("demo", {"speed_mps": 3}, seed=123, epoch_ns=456)
STREAMS = some_streams(6, count=6)[:2]
TOPICS = [stream.topic for stream in STREAMS]
RECORD = RUN.to_record()


def written(folder, compression: str):
    """A small log of several chunks."""
    path = folder / "run.mcap"
    with LogWriter(path, RUN, compression=compression, chunk_bytes=250) as log:
        log.write(STREAMS)
    return path


@pytest.fixture(scope="module", params=["zstd", "lz4", "none"])
def whole(request, tmp_path_factory):
    """The bytes of a small log, the streams in it, and a path to write damaged copies to."""
    path = written(tmp_path_factory.mktemp("log"), request.param)
    return (
        path.read_bytes(),
        read_streams(open_log(path), TOPICS, order="log_time"),
        path.with_name("damaged.mcap"),
    )


def refusal(path, read=open_log) -> str:
    """The sentence with which a log is refused."""
    with pytest.raises(BadInput) as caught:
        read(path)
    return str(caught.value)


def everything(path, recover=False):
    """All that a log says: its run, topics and streams."""
    log = open_log(path, recover=recover)
    return log, log.run, read_streams(log, list(log.topics), order="log_time")


def test_what_is_no_log_is_refused(tmp_path):
    """A missing file, a folder, an empty file, another format: one sentence each."""
    (tmp_path / "empty").touch()
    (tmp_path / "text").write_text("time,x,y\n")
    for name, sentence in {
        "missing": "missing: cannot be read (No such file or directory)",
        "": f"{tmp_path}: cannot be read (Is a directory)",
        "empty": "empty: not an MCAP file; give a log that starts with the MCAP magic",
        "text": "text: not an MCAP file; give a log that starts with the MCAP magic",
    }.items():
        assert refusal(tmp_path / name).endswith(sentence)
        assert refusal(tmp_path / name, lambda path: open_log(path, recover=True)).endswith(sentence)


def test_a_log_that_vanishes_or_changes_after_it_was_opened_is_told(whole):
    """Another program may remove or replace a log while it is read."""
    raw, _, path = whole
    path.write_bytes(raw)
    log = open_log(path)
    path.unlink()
    assert refusal(log, lambda log: read_streams(log, TOPICS)).endswith("(No such file or directory)")
    path.write_bytes(raw[:100])
    assert refusal(log, lambda log: read_streams(log, TOPICS)).endswith(
        "(it became shorter while it was read)"
    )
    path.write_bytes(raw[:20] + raw)
    assert "is damaged" in refusal(log, lambda log: read_streams(log, TOPICS))


def messages_by_chunk(raw: bytes) -> list[tuple[int, Counter]]:
    """Where each chunk ends, and how many messages each topic has up to there, as mcap reads it."""
    ends, topics, counts = [], {}, Counter()
    summary = make_reader(BytesIO(raw)).get_summary()
    topics = {channel.id: channel.topic for channel in summary.channels.values()}
    for entry in summary.chunk_indexes:
        end = entry.chunk_start_offset + entry.chunk_length
        chunk = records.Chunk.read(ReadDataStream(BytesIO(raw[entry.chunk_start_offset + 9 : end])))
        counts.update(
            topics[each.channel_id] for each in breakup_chunk(chunk) if isinstance(each, records.Message)
        )
        ends.append((end, Counter(counts)))
    return ends


@pytest.mark.paper
def test_a_log_cut_off_anywhere_is_refused_or_read_to_its_last_whole_chunk(whole):
    """No cut gives a wrong, half or doubled message; the three compressions take turns at the bytes."""
    raw, honest, path = whole
    chunks = messages_by_chunk(raw)
    assert len(chunks) > 3
    for cut in range(len(raw) - 1, 8, -97):
        path.write_bytes(raw[:cut])
        readable = [counts for end, counts in chunks if end <= cut]
        assert f"{len(readable)} intact chunk" in refusal(path)
        log, _, found = everything(path, recover=True)
        assert log.loss_statement.startswith(f"{path}: it")
        kept = readable[-1] if readable else Counter()
        assert set(found) >= set(kept)
        for topic, stream in found.items():
            assert len(stream) == kept[topic]
            if len(stream):
                assert_same(stream, honest[topic], slice(kept[topic]))


@pytest.mark.paper
def test_a_flipped_bit_is_told_or_changes_nothing(whole):
    """Either a sentence, or exactly the log as it was written; with recover no message is another."""
    raw, honest, path = whole
    for place in range(len(raw) % 179, len(raw), 179):
        damaged = bytearray(raw)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        try:
            log, run, found = everything(path)
        except BadInput:
            assert refusal(path, everything).startswith(f"{path}: ")
        else:
            assert (run, log.loss_statement, list(found)) == (RUN, None, TOPICS)
            for topic, stream in found.items():
                assert_same(stream, honest[topic])
        try:
            log, run, found = everything(path, recover=True)
        except BadInput:
            continue
        assert run == RUN or (run is None and log.loss_statement)
        for topic, stream in found.items():
            stamps = list(zip(honest[topic].log_time_ns, honest[topic].publish_time_ns, strict=True))
            assert len(set(stamps)) == len(stamps)
            rows = [
                stamps.index(each)
                for each in zip(stream.log_time_ns, stream.publish_time_ns, strict=True)
            ]
            assert rows == sorted(set(rows))
            assert_same(stream, honest[topic], rows)
            assert len(stream) == len(honest[topic]) or log.loss_statement


def test_a_log_with_a_damaged_chunk_loses_that_chunk_and_says_so(tmp_path):
    """The chunks behind it are read, with and without a summary; without recover nothing is."""
    path = written(tmp_path, "zstd")
    raw = bytearray(path.read_bytes())
    ends = [end for end, _ in messages_by_chunk(raw)]
    honest = everything(path)[2]
    raw[ends[1] - 10] ^= 1
    for length in (len(raw), len(raw) - 1):
        path.write_bytes(raw[:length])
        assert "is damaged" in refusal(path, everything)
        log, _, found = everything(path, recover=True)
        assert "the chunk at byte" in log.loss_statement
        assert sum(map(len, found.values())) > sum(map(len, honest.values())) / 2
        for topic, stream in found.items():
            assert 0 < len(stream) < len(honest[topic])


def test_many_damages_are_told_in_one_short_sentence(tmp_path):
    path = tmp_path / "run.mcap"
    with LogWriter(path, chunk_bytes=1) as log:
        log.write(STREAMS)
    raw = bytearray(path.read_bytes())
    for end, _ in messages_by_chunk(raw):
        raw[end - 10] ^= 1
    path.write_bytes(raw)
    statement = open_log(path, recover=True).loss_statement
    assert statement.count("is damaged") == 3
    assert statement.endswith(", and 10 more damages")


def without_checksums(path, times=(1, 2, 3)) -> bytearray:
    """A log of one uncompressed chunk by the mcap library, in which no checksum tells of a damage."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start()
        schema = writer.register_schema("fuselog.Scan", "protobuf", schemas.SCAN.descriptor_set)
        channel = writer.register_channel("/scan", "protobuf", schema, {"frame": "map"})
        for time in times:
            content = schemas.SCAN.message_class(sensor_time_ns=time, scan_id=time, detections=time)
            writer.add_message(channel, time, content.SerializeToString(), time)
        writer.finish()
    return bytearray(path.read_bytes())


def test_what_does_not_fit_together_is_told_without_a_checksum(tmp_path):
    """Sizes and lengths are compared with what is there, in the chunk and in the records around it."""
    path = tmp_path / "run.mcap"
    raw = without_checksums(path)
    assert everything(path)[2]["/scan"]["scan_id"].tolist() == [1, 2, 3]
    chunk = raw.index(b"\x06", 40)
    last_message = raw.rindex(struct.pack("<QQ", 3, 3)) - 15
    for place, sentence in {
        chunk + 25: "its size is wrong",  # the chunk's size when uncompressed
        chunk + 45: "its length is wrong",  # the length of the chunk's data
        last_message + 1: "a record in it is incomplete",
        raw.index(b"fuselog.Scan") - 4: "it is incomplete",  # the length of the schema's name
        raw.index(b"frame") - 8: "it is incomplete",  # the length of the channel's metadata
    }.items():
        damaged = bytearray(raw)
        damaged[place] += 1
        path.write_bytes(damaged)
        assert sentence in refusal(path, everything)
        log, _, found = everything(path, recover=True)
        assert sentence in log.loss_statement
        assert sum(map(len, found.values())) == 0


def test_a_chunk_that_states_less_than_it_holds_is_told(tmp_path):
    """Bytes behind its data would be read, or left out, in silence."""
    path = tmp_path / "run.mcap"
    raw = without_checksums(path)
    place = raw.index(b"\x06", 40) + 41  # the length of the chunk's data
    (length,) = struct.unpack_from("<Q", raw, place)
    struct.pack_into("<Q", raw, place, length - 1)
    path.write_bytes(raw)
    assert "its length is wrong" in refusal(path, everything)


def test_a_number_that_means_two_channels_is_told(tmp_path):
    """Two logs in one file, say; without a summary nothing else would tell."""
    path = tmp_path / "run.mcap"
    raw = without_checksums(path)
    data = slice(raw.index(b"\x06", 40), raw.index(b"\x0f" + struct.pack("<Q", 4)))
    other = bytearray(raw[data]).replace(b"/scan", b"/scam")
    path.write_bytes(raw[: data.stop] + other)
    assert "it declares channel 1 twice, in different ways" in refusal(path)
    log, _, found = everything(path, recover=True)
    assert "it declares channel 1 twice, in different ways" in log.loss_statement
    assert found["/scan"]["scan_id"].tolist() == [1, 2, 3]


def test_a_tail_of_zeros_is_lost_and_counted(tmp_path):
    """What a file system leaves of a file that was growing when the power went."""
    path = written(tmp_path, "zstd")
    raw = path.read_bytes()
    end = messages_by_chunk(raw)[1][0]
    path.write_bytes(raw[:end] + bytes(5000))
    assert (
        "it was cut off: its last 5000 bytes are not a complete record; 2 intact chunks are"
        in refusal(path)
    )


def with_chunk(path, size: int, packed: bytes, compression: bytes = b"lz4") -> None:
    """A log of one chunk that states its uncompressed size as `size`, without a summary."""
    head = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression
    body = head + struct.pack("<Q", len(packed)) + packed
    end = struct.pack("<BQI", 0x0F, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0)
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + struct.pack("<BQ", 6, len(body)) + body + end + magic)


@pytest.mark.parametrize("compression", [b"lz4", b"zstd"])
def test_a_chunk_gets_no_more_memory_than_it_states(tmp_path, compression):
    """Half a megabyte of either unpacks to a hundred."""
    pack = {b"lz4": lz4.frame.compress, b"zstd": zstandard.compress}[compression]
    with_chunk(tmp_path / "bomb.mcap", 1000, pack(bytes(100 << 20)), compression)
    tracemalloc.start()
    try:
        assert "its size is wrong" in refusal(tmp_path / "bomb.mcap")
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("compression", [b"lz4", b"zstd", b""])
def test_a_chunk_that_states_more_than_its_bytes_can_be_is_not_given_the_memory(tmp_path, compression):
    pack = {
        b"lz4": lz4.frame.compress,
        b"zstd": zstandard.ZstdCompressor(write_content_size=False).compress,
    }
    for size in (1 << 30, 1 << 62):
        with_chunk(tmp_path / "giant.mcap", size, pack.get(compression, bytes)(b"abc"), compression)
        tracemalloc.start()
        try:
            assert "its size is wrong" in refusal(tmp_path / "giant.mcap")
            assert tracemalloc.get_traced_memory()[1] < 4 << 20
        finally:
            tracemalloc.stop()


def test_a_chunk_that_does_not_fit_into_memory_is_told_as_such(tmp_path, monkeypatch):
    """A lack of memory is no damage of the file, and its exception says nothing of itself."""
    path = tmp_path / "run.mcap"
    with_chunk(path, 3, lz4.frame.compress(b"abc"))

    def lack(_):
        raise MemoryError

    monkeypatch.setattr("fuselog.recorders.log.container.chunks.scan", lack)
    assert "the chunk at byte 8 does not fit into memory: it states 3 bytes" in refusal(path)
    assert "does not fit into memory" in open_log(path, recover=True).loss_statement


@pytest.mark.parametrize("second", ["the same", "another", "without a summary", "cut off", "text"])
@pytest.mark.parametrize("first", ["ours", "without a summary"])
def test_what_is_joined_to_a_log_is_refused_or_named(tmp_path, first, second):
    """`cat a b > c` reads as a alone, which is said; none of b is taken for a part of a."""
    ours = written(tmp_path, "zstd").read_bytes()
    with_chunk(tmp_path / "bare.mcap", 0, b"", b"")
    bare = (tmp_path / "bare.mcap").read_bytes()
    end, begin = (ours.index(b"\x0f" + struct.pack("<Q", 4)) + 13, len(ours) - 37)
    unindexed = ours[:end] + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + ours[-8:]
    assert begin > end
    write_log(tmp_path / "another.mcap", some_streams(9))
    one = ours if first == "ours" else unindexed
    two = {
        "the same": one,
        "another": (tmp_path / "another.mcap").read_bytes(),
        "without a summary": bare,
        "cut off": ours[: len(ours) // 2],
        "text": b"any other bytes",
    }[second]
    path = tmp_path / "joined.mcap"
    path.write_bytes(one)
    honest = everything(path)[2]
    path.write_bytes(one + two)
    left_out = f"it ends at byte {len(one)}, and the {len(two)} bytes after that"
    assert left_out in refusal(path)
    log, _, found = everything(path, recover=True)
    assert left_out in log.loss_statement
    for topic, stream in found.items():
        assert_same(stream, honest[topic])


def test_bytes_between_data_and_summary_are_not_left_out_in_silence(tmp_path):
    """A chunk behind the end of the data is in no index, and no walk through the data meets it."""
    raw = bytearray(written(tmp_path, "zstd").read_bytes())
    (start,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    body = raw[start : len(raw) - 37]
    footer = struct.pack("<BQQQI", 2, 20, start + 50, 0, 0)
    path = tmp_path / "gap.mcap"
    path.write_bytes(raw[:start] + struct.pack("<BQ", 6, 41) + bytes(41) + body + footer + raw[-8:])
    assert f"its data end at byte {start} and its summary begins at byte {start + 50}" in refusal(path)
    assert "are left out" in open_log(path, recover=True).loss_statement


@pytest.mark.parametrize("summary", [True, False])
def test_messages_of_a_channel_that_nothing_declares_are_counted(tmp_path, summary):
    """They are of no topic; a reader that goes by topics does not see them."""
    path = tmp_path / "run.mcap"
    raw = without_checksums(path)
    last = raw.rindex(struct.pack("<QQ", 3, 3)) - 6
    struct.pack_into("<H", raw, last, 7)
    if not summary:
        end = raw.index(b"\x0f" + struct.pack("<Q", 4)) + 13
        raw = raw[:end] + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + raw[-8:]
    path.write_bytes(raw)
    assert "channel 7" in refusal(path, everything)
    log, _, found = everything(path, recover=True)
    assert "1 messages of channel 7, which it does not declare, are left out" in log.loss_statement
    assert ("1 of 3 of /scan: " in log.loss_statement) == summary
    assert found["/scan"]["scan_id"].tolist() == [1, 2]


def test_recover_goes_on_behind_a_broken_head_and_names_what_it_left_out(whole):
    """A whole summary says where the next chunk is: the damage of one head costs one chunk, no more."""
    raw, honest, path = whole
    ends = messages_by_chunk(raw)
    entries = make_reader(BytesIO(raw)).get_summary().chunk_indexes
    before = Counter()
    for entry, (_, counts) in zip(entries, ends, strict=True):
        own, before = counts - before, counts
        for byte in (0, 1, 3, 8):
            damaged = bytearray(raw)
            damaged[entry.chunk_start_offset + byte] ^= 0x81
            path.write_bytes(damaged)
            refusal(path, everything)
            log, run, found = everything(path, recover=True)
            assert run == RUN
            for topic, count in own.items():
                assert len(found[topic]) == len(honest[topic]) - count
                assert f"{count} of {len(honest[topic])} of {topic}" in log.loss_statement
            for topic, stream in found.items():
                kept = [
                    row
                    for row, stamp in enumerate(honest[topic].log_time_ns)
                    if stamp in stream.log_time_ns
                ]
                assert_same(stream, honest[topic], kept)


def test_recover_without_a_summary_says_how_many_bytes_it_cannot_read(tmp_path):
    """Behind a broken head nothing can be found then; `info` and `replay` print the sentence."""
    path = written(tmp_path, "zstd")
    raw = bytearray(path.read_bytes())
    second = make_reader(BytesIO(raw)).get_summary().chunk_indexes[1].chunk_start_offset
    raw[second + 8] ^= 0x80
    raw[-8:] = bytes(8)
    path.write_bytes(raw)
    statement = open_log(path, recover=True).loss_statement
    assert statement.endswith(f"its last {len(raw) - second} bytes are not a complete record")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"parameters": "[1]"}, "parameters is [1], expected an object"),
        ({"parameters": "[" * 100_000}, "it is nested more than 50 levels deep"),
        ({"parameters": '{"a":' * 60 + "1" + "}" * 60}, "it is nested more than 50 levels deep"),
        ({"parameters": '{"a": 1e999}'}, "it has 1e999, which is not a JSON number"),
        ({"parameters": '{"a": NaN}'}, "it has NaN, which is not a JSON number"),
        ({"seed": '"x"'}, 'seed is "x", expected a whole number or null'),
        ({"seed": "true"}, "seed is true, expected a whole number or null"),
        ({"seed": "-3"}, "seed is negative"),
        ({"seed": "1" * 5000}, "it has a whole number of more than 4300 digits"),
        ({"run": "0.5"}, "run is 0.5, expected a whole number"),
        ({"epoch_ns": str(2**63)}, "epoch_ns is after the year 2262"),
        ({"notes": "3"}, "notes is 3, expected an object"),
        ({"notes": '{"a": 3}'}, "some notes are not texts"),
        ({"notes": "{"}, "Expecting property name"),
    ],
)
def test_run_metadata_of_wrong_types_are_told(changes, sentence):
    """They are sealed with a checksum, which says nothing of who wrote them."""
    record = RUN.to_record()
    assert RunMetadata.from_record(record, "run.mcap") == RUN
    with pytest.raises(BadInput, match=re.escape(sentence)):
        RunMetadata.from_record({**record, **changes}, "run.mcap")
    del record["notes"]
    with pytest.raises(BadInput, match="'notes' is missing"):
        RunMetadata.from_record(record, "run.mcap")


def test_a_log_of_another_format_is_refused_and_one_of_before_formats_is_read(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    for stated, sentence in {
        "2": "a newer version of fuselog wrote it (format 2, this version reads 1); update fuselog",
        "0": "an older version of fuselog wrote it (format 0, this version reads 1); write it again",
        '"x"': 'format is "x", expected a whole number',
    }.items():
        monkeypatch.setattr(RunMetadata, "to_record", lambda _, f=stated: {**RECORD, "format": f})
        write_log(path, STREAMS, RUN)
        with pytest.raises(BadInput, match=re.escape(sentence)) as refusal:
            _ = open_log(path).run
        assert str(refusal.value).startswith(f"{path}: ")
    before = {name: text for name, text in RECORD.items() if name != "format"}
    monkeypatch.setattr(RunMetadata, "to_record", lambda _: before)
    write_log(path, STREAMS, RUN)
    assert open_log(path).run == RUN
