"""Other people's programs read our files: the mcap library, plain protobuf, Rerun."""

import struct
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap_protobuf.decoder import DecoderFactory

from fuselog.recorders.log import LogWriter, RunMetadata, write_log
from tests.bench.bench_log import read_with_rerun
from tests.recorders.log_samples import rows_in_file, some_streams


@pytest.fixture(params=["zstd", "lz4", "none"])
def written(request, tmp_path):
    """A log of several chunks and blocks, and the streams in it."""
    streams = some_streams(3)
    path = tmp_path / "run.mcap"
    with LogWriter(path, RunMetadata("demo"), compression=request.param, chunk_bytes=2500) as log:
        log.write(streams)
    return path, {stream.topic: stream for stream in streams}


def rows_of(decoded) -> dict[str, list[tuple]]:
    """Topic -> rows of both clocks and all fields, as the official reader yields them."""
    found: dict[str, list[tuple]] = {}
    for _, channel, message, content in decoded:
        fields = [getattr(content, field.name) for field in content.DESCRIPTOR.fields]
        values = [tuple(value) if hasattr(value, "__len__") else value for value in fields]
        found.setdefault(channel.topic, []).append((message.log_time, message.publish_time, *values))
    return found


def expected_rows(streams) -> dict[str, list[tuple]]:
    """The same, of our streams."""
    rows = {}
    for topic, stream in streams.items():
        in_file = stream.take(rows_in_file(stream))
        columns = [
            map(tuple, column.tolist()) if column.ndim == 2 else column.tolist()
            for column in in_file.columns.values()
        ]
        rows[topic] = list(
            zip(in_file.log_time_ns.tolist(), in_file.publish_time_ns.tolist(), *columns, strict=True)
        )
    return rows


def test_the_mcap_library_decodes_equal_values_and_finds_its_checksums_right(written):
    """Read with and without seeking; only the latter checks the data section's checksum."""
    path, streams = written
    with path.open("rb") as file:
        seeking = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert rows_of(seeking.iter_decoded_messages()) == expected_rows(streams)
        file.seek(0)
        straight = NonSeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert rows_of(straight.iter_decoded_messages(log_time_order=False)) == expected_rows(streams)


def test_the_mcap_library_finds_a_time_range_of_a_topic_by_our_index(written):
    """The chunk index that we write has the right spans and channels."""
    path, streams = written
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = reader.iter_messages(topics=["/scan"], starting_at=1150, ending_before=1300)
        times = [message.log_time for _, _, message in found]
    logged = np.sort(streams["/scan"].log_time_ns)
    assert times == logged[(logged >= 1150) & (logged < 1300)].tolist()


def test_every_message_index_points_at_its_messages(written):
    """Foxglove reads by message indexes, our own reader does not: each must lead to its message."""
    path, streams = written
    found: dict[int, list[int]] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            if isinstance(record, records.Chunk):
                data, _ = get_chunk_data_stream(record, validate_crc=True)
                chunk = data.read(record.uncompressed_size)
            elif isinstance(record, records.MessageIndex):
                for log_time, offset in record.records:
                    opcode, length = struct.unpack_from("<BQ", chunk, offset)
                    message = records.Message.read(ReadDataStream(BytesIO(chunk[offset + 9 :])), length)
                    assert opcode == Opcode.MESSAGE
                    assert (message.channel_id, message.log_time) == (record.channel_id, log_time)
                    found.setdefault(record.channel_id, []).append(message.sequence)
    assert list(found.values()) == [list(range(len(stream))) for stream in streams.values()]


def test_the_chunk_index_tells_where_the_message_indexes_are(written):
    """Each chunk is followed by its message indexes, one per channel, and these by the next chunk."""
    path, _ = written
    raw = path.read_bytes()
    summary = make_reader(BytesIO(raw)).get_summary()
    (spans,) = [each for each in summary.metadata_indexes if each.name == "fuselog.publish_spans"]
    followers = [each.chunk_start_offset for each in summary.chunk_indexes[1:]] + [spans.offset]
    for entry, follower in zip(summary.chunk_indexes, followers, strict=True):
        place = entry.chunk_start_offset + entry.chunk_length
        for channel_id, offset in entry.message_index_offsets.items():
            opcode, length, found = struct.unpack_from("<BQH", raw, offset)
            assert (opcode, found, offset) == (Opcode.MESSAGE_INDEX, channel_id, place)
            place += 9 + length
        assert (
            place
            == follower
            == entry.chunk_start_offset + entry.chunk_length + entry.message_index_length
        )


def test_plain_protobuf_decodes_the_payload_from_the_description_in_the_file(written):
    """No fuselog, no mcap_protobuf: the FileDescriptorSet in the file is enough."""
    path, streams = written
    with path.open("rb") as file:
        schema, channel, message = next(make_reader(file).iter_messages(topics=["/positionfix"]))
    pool = descriptor_pool.DescriptorPool()
    for described in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        assert described.syntax == "proto3"
        pool.Add(described)
    content = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(
        message.data
    )
    stream = streams[channel.topic]
    first = rows_in_file(stream)[0]
    assert list(content.position_m) == stream["position_m"][first].tolist()
    assert list(content.covariance_m2) == stream["covariance_m2"][first].tolist()
    assert content.sensor_time_ns == stream["sensor_time_ns"][first]
    assert content.SerializeToString(deterministic=True) == message.data


def test_statistics_and_metadata_are_what_the_mcap_library_expects(written):
    path, streams = written
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    statistics = summary.statistics
    assert list(statistics.channel_message_counts.values()) == [
        len(stream) for stream in streams.values()
    ]
    assert statistics.message_count == sum(map(len, streams.values()))
    assert statistics.message_start_time == min(stream.log_time_ns.min() for stream in streams.values())
    assert statistics.message_end_time == max(stream.log_time_ns.max() for stream in streams.values())
    assert statistics.chunk_count == len(summary.chunk_indexes) > 3
    assert statistics.metadata_count == len(metadata) == 2
    assert metadata["fuselog.run"]["scenario"] == "demo"


@pytest.mark.paper
def test_rerun_checks_converts_and_reads_the_log(written, tmp_path):
    """Rerun's own reader finds no fault and gets the columns that we wrote, bit for bit."""
    path, streams = written
    home = {"HOME": f"{tmp_path}", "XDG_CONFIG_HOME": f"{tmp_path}", "XDG_DATA_HOME": f"{tmp_path}"}
    rerun = Path(sys.executable).with_name("rerun")

    def run(*arguments: object) -> str:
        done = subprocess.run(
            [rerun, *map(str, arguments)],
            env=home,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run("analytics", "disable")
    prompt = tmp_path / "prompt.mcap"  # the check calls it a problem where messages come late
    write_log(prompt, some_streams(3, latest_delay_ns=0))
    topics = [
        line for line in run("mcap", "check", prompt).splitlines() if "fuselog" in line or " /" in line
    ]
    assert [line.split()[0] for line in topics] == ["ok"] * 4
    run("mcap", "convert", path, "-o", tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").stat().st_size > 1000

    found = read_with_rerun(path)
    for topic, stream in streams.items():
        for name, column in stream.columns.items():
            expected = column[rows_in_file(stream)].tobytes()
            assert np.concatenate(found[topic, name]).tobytes() == expected
