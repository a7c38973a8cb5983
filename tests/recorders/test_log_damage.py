"""A damaged log is refused with one sentence, or read exactly as far as it is whole; never wrongly."""

from collections import Counter
from io import BytesIO

import pytest
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.stream_reader import breakup_chunk

from recorders.errors import BadInput
from recorders.log import LogWriter, RunMetadata, open_log, read_streams
from tests.recorders.log_samples import assert_same, some_streams

RUN = RunMetadata("demo", {"speed_mps": 3}, seed=123, epoch_ns=456)
STREAMS = some_streams(6, count=6)[:2]
TOPICS = [stream.topic for stream in STREAMS]


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


def test_a_log_cut_off_anywhere_is_refused_or_read_to_its_last_whole_chunk(whole):
    """No cut gives a wrong, half or doubled message; the three compressions take turns at the bytes."""
    raw, honest, path = whole
    chunks = messages_by_chunk(raw)
    assert len(chunks) > 3
    for cut in range(len(raw) - 1, 8, -11):
        path.write_bytes(raw[:cut])
        readable = [counts for end, counts in chunks if end <= cut]
        assert f"{len(readable)} whole chunk" in refusal(path)
        log, _, found = everything(path, recover=True)
        assert log.loss_statement.startswith(f"{path}: it")
        kept = readable[-1] if readable else Counter()
        assert set(found) >= set(kept)
        for topic, stream in found.items():
            assert len(stream) == kept[topic]
            if len(stream):
                assert_same(stream, honest[topic], slice(kept[topic]))


def test_a_flipped_bit_is_told_or_changes_nothing(whole):
    """Either a sentence, or exactly the log as it was written; with recover no message is another."""
    raw, honest, path = whole
    for place in range(len(raw) % 11, len(raw), 11):
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
