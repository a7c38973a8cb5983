"""Logs that others wrote, or that lie about themselves: read slowly perhaps, wrongly never."""

import itertools
import struct
import zlib
from io import BytesIO

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.writer import Writer as ProtobufWriter

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, open_log, read_blocks, read_span, read_streams, schemas
from fuselog.recorders.log.schemas import message_class
from fuselog.recorders.log.streams import concatenate
from tests.recorders.log_samples import assert_same, rows_read, some_streams

FIELD = descriptor_pb2.FieldDescriptorProto
DOUBLE, FLOAT, SFIXED64, FIXED32 = (
    FIELD.TYPE_DOUBLE,
    FIELD.TYPE_FLOAT,
    FIELD.TYPE_SFIXED64,
    FIELD.TYPE_FIXED32,
)


def described(name: str, *fields: tuple, syntax: str = "proto3") -> bytes:
    """A FileDescriptorSet of one message; a field is name, number, type, "repeated" or "optional"."""
    package, _, bare = name.rpartition(".")
    file = descriptor_pb2.FileDescriptorProto(name="any.proto", package=package, syntax=syntax)
    declared = file.message_type.add(name=bare)
    for field, number, kind, *presence in fields:
        entry = declared.field.add(name=field, number=number, type=kind, label=FIELD.LABEL_OPTIONAL)
        if presence == ["repeated"]:
            entry.label = FIELD.LABEL_REPEATED
        elif presence == ["optional"] and syntax == "proto3":
            entry.proto3_optional = True
            entry.oneof_index = len(declared.oneof_decl)
            declared.oneof_decl.add(name=f"_{field}")
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


def write_payloads(
    path, name: str, description: bytes, payloads, topic="/topic", chunk_size=1 << 20
) -> None:
    """One topic with the given payloads, logged at 0, 1, 2, ..."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size)
        writer.start()
        channel = writer.register_channel(
            topic, "protobuf", writer.register_schema(name, "protobuf", description)
        )
        for time, payload in enumerate(payloads):
            writer.add_message(channel, time, payload, time)
        writer.finish()


def read(path, topic="/topic", **options):
    return read_streams(open_log(path, **options), [topic])[topic]


OFFICIAL_OPTIONS = [
    {},
    {"index_types": IndexType.NONE},
    {"index_types": IndexType.CHUNK},
    {"index_types": IndexType.MESSAGE},
    {"use_chunking": False},
    {"use_chunking": False, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
    {"use_statistics": False},
    {"repeat_channels": False},
    {"repeat_schemas": False},
    {"use_summary_offsets": False, "enable_crcs": False},
    {"enable_data_crcs": True, "compression": CompressionType.LZ4},
    {"enable_data_crcs": True, "use_chunking": False},
    {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
        "enable_data_crcs": True,
        "compression": CompressionType.NONE,
    },
]


@pytest.mark.paper
@pytest.mark.parametrize("recover", [False, True])
@pytest.mark.parametrize("options", OFFICIAL_OPTIONS, ids=lambda options: ",".join(options))
def test_a_log_by_the_mcap_library_is_read_whatever_it_leaves_out(tmp_path, options, recover):
    """No message index, no chunks, no summary, chunks that overlap in time: the columns are the same."""
    streams = some_streams(4, count=80)
    path = tmp_path / "run.mcap"
    generator = np.random.default_rng(0)
    order = [(stream, row) for stream in streams for row in range(len(stream))]
    order = [order[place] for place in generator.permutation(len(order))]
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, **options)
        writer.start(profile="other", library="other")
        writer.add_metadata("notes", {"crc32": "not ours"})
        writer.add_attachment(0, 0, "picture", "image/png", b"\x05" * 100)
        channels = {}
        for stream in streams:
            schema = writer.register_schema(
                stream.schema.full_name, "protobuf", stream.schema.descriptor_set
            )
            channels[stream.topic] = writer.register_channel(
                stream.topic, "protobuf", schema, dict(stream.metadata)
            )
        for stream, row in order:
            content = stream.schema.message_class(
                **{name: column[row] for name, column in stream.columns.items()}
            )
            writer.add_message(
                channels[stream.topic],
                int(stream.log_time_ns[row]),
                content.SerializeToString(),
                int(stream.publish_time_ns[row]),
                sequence=7,
            )
        writer.finish()
    log = open_log(path, recover=recover)
    assert log.loss_statement is None
    assert log.container.metadata == {"notes": {"crc32": "not ours"}}
    assert [topic.messages for topic in log.topics.values()] == [80] * 4
    for clock in ("publish_time", "log_time"):
        found = read_streams(log, [stream.topic for stream in streams], order=clock)
        for stream in streams:
            in_file = np.array([row for each, row in order if each is stream])
            rows = in_file[np.argsort(stream.times(clock)[in_file], kind="stable")]
            assert_same(found[stream.topic], stream, rows)
        middle = read_streams(log, ["/scan"], order=clock, start_ns=1100, end_ns=1200)["/scan"]
        times = np.sort(streams[2].times(clock))
        assert middle.times(clock).tolist() == times[(times >= 1100) & (times < 1200)].tolist()


def test_a_log_by_mcap_protobuf_is_read(tmp_path):
    """Its writer describes messages by itself, from the class in hand."""
    stream = some_streams(4, count=50)[1]
    with (tmp_path / "run.mcap").open("wb") as file, ProtobufWriter(file) as writer:
        for row in range(50):
            content = stream.schema.message_class(
                **{name: column[row] for name, column in stream.columns.items()}
            )
            writer.write_message(
                stream.topic, content, int(stream.log_time_ns[row]), int(stream.publish_time_ns[row])
            )
    found = read(tmp_path / "run.mcap", stream.topic)
    assert found["position_m"].tobytes() == stream["position_m"].tobytes()
    assert found["covariance_m2"].tobytes() == stream["covariance_m2"].tobytes()


def test_messages_outside_chunks_are_read_piece_by_piece(tmp_path):
    """More than one piece's worth of them, declared among the messages."""
    description = schemas.SCAN.descriptor_set
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        for topic in ("/one", "/two"):
            schema = writer.register_schema("fuselog.Scan", "protobuf", description)
            channel = writer.register_channel(topic, "protobuf", schema)
            for time in range(20_000):
                payload = struct.pack("<BqBIBI", 9, time, 21, time, 29, 1)
                writer.add_message(channel, time, payload, time)
        writer.finish()
    log = open_log(tmp_path / "run.mcap")
    assert len(log.container.regions) == 2
    found = read_streams(log, ["/one", "/two"])
    for stream in found.values():
        assert stream["scan_id"].tolist() == list(range(20_000))


BEARING = schemas.BEARING.descriptor_set
CLOCK, TARGET, ANGLE = (
    b"\x09" + struct.pack("<q", 5),
    b"\x15" + struct.pack("<I", 6),
    b"\x19" + struct.pack("<d", 7.0),
)


@pytest.mark.parametrize(
    "payload",
    [
        CLOCK + TARGET + ANGLE,
        *map(b"".join, itertools.permutations([CLOCK, TARGET, ANGLE])),
        ANGLE.replace(b"\x1c", b"\x2c") + CLOCK + TARGET + ANGLE,  # twice: the last counts
        CLOCK + TARGET + ANGLE + b"\x22\x03abc",  # a field that we do not know
        CLOCK + TARGET + b"\x22\x00" + ANGLE,
    ],
    ids=str,
)
def test_fields_may_stand_in_any_order_on_the_wire(tmp_path, payload):
    """A writer may order, repeat and add fields, and a chunk may mix such messages with plain ones."""
    plain = CLOCK + TARGET + ANGLE
    write_payloads(
        tmp_path / "run.mcap", "fuselog.Bearing", BEARING, [plain, payload, plain], chunk_size=90
    )
    found = read(tmp_path / "run.mcap")
    assert found["sensor_time_ns"].tolist() == [5] * 3
    assert found["target_id"].tolist() == [6] * 3
    assert found["bearing_rad"].tolist() == [7.0] * 3


@settings(max_examples=40)
@given(
    st.lists(
        st.fixed_dictionaries(
            {
                "sensor_time_ns": st.sampled_from([0, 1, -5]),
                "target_id": st.sampled_from([0, 3]),
                "bearing_rad": st.sampled_from([0.0, -0.0, 1.5, np.inf]),
            }
        ),
        min_size=1,
        max_size=12,
    )
)
def test_a_field_left_out_because_it_is_zero_is_zero(tmp_path_factory, rows):
    """Without `optional` proto3 does not write a zero, so messages of one stream differ in length."""
    description = described(
        "fuselog.Bearing",
        ("sensor_time_ns", 1, SFIXED64),
        ("target_id", 2, FIXED32),
        ("bearing_rad", 3, DOUBLE),
    )
    content = message_class(description, "fuselog.Bearing")
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    payloads = [content(**row).SerializeToString() for row in rows]
    write_payloads(path, "fuselog.Bearing", description, payloads, chunk_size=100)
    found = read(path)
    for name, column in found.columns.items():
        assert column.tobytes() == np.array([row[name] for row in rows], column.dtype).tobytes()


@pytest.mark.parametrize("declared", [("range_m", "bearing_rad"), ("bearing_rad", "range_m")], ids=str)
@pytest.mark.parametrize("numbers", [(3, 4), (4, 3)], ids=str)
def test_the_description_in_the_file_says_what_a_number_means(tmp_path, declared, numbers):
    """Fields 3 and 4 are both doubles: every message has our layout, whatever they stand for."""
    description = described(
        "fuselog.RangeBearing",
        ("sensor_time_ns", 1, SFIXED64, "optional"),
        ("target_id", 2, FIXED32, "optional"),
        (declared[0], numbers[0], DOUBLE, "optional"),
        (declared[1], numbers[1], DOUBLE, "optional"),
    )
    payload = CLOCK + TARGET + b"\x19" + struct.pack("<d", 3.0) + b"\x21" + struct.pack("<d", 4.0)
    write_payloads(tmp_path / "run.mcap", "fuselog.RangeBearing", description, [payload] * 3)
    found = read(tmp_path / "run.mcap")
    assert found[declared[0]].tolist() == [numbers[0]] * 3
    assert found[declared[1]].tolist() == [numbers[1]] * 3


def test_unpacked_and_split_vectors_are_whole_vectors(tmp_path):
    """A repeated double may come element by element, in several packs, or in both ways."""
    name, description = "fuselog.VectorMeasurement", schemas.VECTOR_MEASUREMENT.descriptor_set
    numbers = [struct.pack("<d", value) for value in (1.0, 2.0, 3.0)]
    packed = b"\x12\x18" + b"".join(numbers)
    unpacked = b"".join(b"\x11" + number for number in numbers)
    mixed = b"\x12\x10" + numbers[0] + numbers[1] + b"\x11" + numbers[2]
    for payloads in itertools.permutations([packed, unpacked, mixed]):
        write_payloads(tmp_path / "run.mcap", name, description, [CLOCK + each for each in payloads])
        assert read(tmp_path / "run.mcap")["value"].tolist() == [[1.0, 2.0, 3.0]] * 3


def test_other_numeric_types_become_our_columns(tmp_path):
    """Single precision, varints and booleans are kept exactly; what is no number is left out."""
    description = described(
        "other.Odometry",
        ("stamp", 1, FIELD.TYPE_INT64),
        ("count", 2, FIELD.TYPE_UINT32),
        ("valid", 3, FIELD.TYPE_BOOL),
        ("speed", 4, FLOAT),
        ("frame", 5, FIELD.TYPE_STRING),
        ("pose", 6, FLOAT, "repeated"),
    )
    content = message_class(description, "other.Odometry")
    speeds = np.array([0.1, np.nan, -np.inf], np.float32)
    payloads = [
        content(
            stamp=-7, count=2**32 - 1, valid=True, speed=speed, frame="map", pose=[1.5, speed]
        ).SerializeToString()
        for speed in speeds
    ]
    write_payloads(tmp_path / "run.mcap", "other.Odometry", description, payloads)
    found = read(tmp_path / "run.mcap")
    assert [(field.name, field.kind) for field in found.schema] == [
        ("stamp", "time_ns"),
        ("count", "identifier"),
        ("valid", "identifier"),
        ("speed", "real"),
        ("pose", "vector"),
    ]
    assert found["stamp"].tolist() == [-7] * 3
    assert found["count"].tolist() == [2**32 - 1] * 3
    assert found["valid"].tolist() == [1] * 3
    assert np.array_equal(found["speed"], speeds.astype(np.float64), equal_nan=True)
    assert np.array_equal(found["pose"][:, 1], speeds.astype(np.float64), equal_nan=True)


@pytest.mark.parametrize("chunk_size", [1, 1 << 20], ids=["a chunk each", "one chunk"])
@pytest.mark.parametrize("lengths", [(2, 3), (0, 2), (2, 0)], ids=str)
def test_vectors_of_differing_lengths_make_no_column(tmp_path, lengths, chunk_size):
    name, description = "fuselog.VectorMeasurement", schemas.VECTOR_MEASUREMENT.descriptor_set
    content = message_class(description, name)
    payloads = [
        content(sensor_time_ns=1, value=[0.5] * length).SerializeToString() for length in lengths
    ]
    write_payloads(tmp_path / "run.mcap", name, description, payloads, chunk_size=chunk_size)
    with pytest.raises(
        BadInput, match=rf"field value has vectors of different lengths \[{min(lengths)}, "
    ):
        read(tmp_path / "run.mcap")


def test_a_missing_number_is_nan_where_it_may_be(tmp_path):
    """An optional field that was not set: NaN if the schema allows it, else an error, never zero."""
    name, description = "fuselog.ShotDetection", schemas.SHOT_DETECTION.descriptor_set
    content = message_class(description, name)
    whole = {"sensor_time_ns": 1, "shot_id": 2, "muzzle_blast_azimuth_rad": 0.5}
    full = {**whole, "shockwave_azimuth_rad": 0.25, "time_difference_s": 0.1}
    write_payloads(
        tmp_path / "run.mcap",
        name,
        description,
        [content(**each).SerializeToString() for each in (whole, full)],
    )
    found = read(tmp_path / "run.mcap")
    assert np.array_equal(found["shockwave_azimuth_rad"], [np.nan, 0.25], equal_nan=True)
    for missing, sentence in {
        "muzzle_blast_azimuth_rad": "is NaN in message 1 .1 in all., which fuselog.ShotDetection",
        "shot_id": "field shot_id is absent from 1 messages; write every field",
    }.items():
        payloads = [content(**full), content(**{key: full[key] for key in full if key != missing})]
        write_payloads(
            tmp_path / "run.mcap", name, description, [each.SerializeToString() for each in payloads]
        )
        with pytest.raises(BadInput, match=sentence):
            read(tmp_path / "run.mcap")


def test_channels_that_share_a_topic_are_merged(tmp_path):
    """Two publishers of one topic: one stream in time order, equal stamps in file order."""
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=300)
        writer.start()
        schemas_of = [writer.register_schema("fuselog.Bearing", "protobuf", BEARING) for _ in range(2)]
        channels = [
            writer.register_channel(
                "/topic", "protobuf", schema, {"frame": "map", "callerid": f"/node{place}"}
            )
            for place, schema in enumerate(schemas_of)
        ]
        times = [5, 5, 3, 3, 3, 9, 1, 1, 5, 5, 5, 0]
        for place, time in enumerate(times):
            writer.add_message(
                channels[place % 3 % 2], time, CLOCK + b"\x15" + struct.pack("<I", place) + ANGLE, time
            )
        writer.finish()
    found = read(tmp_path / "run.mcap")
    assert found["target_id"].tolist() == np.argsort(times, kind="stable").tolist()
    assert found.metadata == {"frame": "map"}


def test_topics_of_others_do_not_hinder_ours(tmp_path):
    """JSON, ROS, no schema, a damaged description, two schemas on one topic: only who asks is told."""
    path = tmp_path / "run.mcap"
    wrong_field = described(
        "fuselog.Bearing", ("sensor_time_ns", 1, SFIXED64), ("bearing_rad", 3, FLOAT, "repeated")
    )
    words = described("other.Words", ("text", 1, FIELD.TYPE_STRING))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        ours = writer.register_schema("fuselog.Bearing", "protobuf", BEARING)
        for topic, encoding, schema in [
            ("/ours", "protobuf", ours),
            ("/json", "json", writer.register_schema("Pose", "jsonschema", b"{}")),
            ("/ros", "cdr", writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"float64 x")),
            ("/bare", "protobuf", 0),
            ("/torn", "protobuf", writer.register_schema("fuselog.Bearing", "protobuf", BEARING[:-3])),
            ("/nameless", "protobuf", writer.register_schema("fuselog.Range", "protobuf", BEARING)),
            ("/two", "protobuf", ours),
            ("/two", "json", ours),
            ("/old", "protobuf", writer.register_schema("fuselog.Bearing", "protobuf", wrong_field)),
            ("/words", "protobuf", writer.register_schema("other.Words", "protobuf", words)),
            ("/noise", "protobuf", ours),
        ]:
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(
                channel, 1, b"\xff\xff" if topic == "/noise" else CLOCK + TARGET + ANGLE, 1
            )
        writer.finish()
    assert read(path, "/ours")["bearing_rad"].tolist() == [7.0]
    for topic, sentence in {
        "/json": "is Pose in the encoding 'json'; fuselog replays protobuf messages with numeric",
        "/ros": "is nav_msgs/msg/Odometry in the encoding 'cdr'; fuselog replays protobuf messages",
        "/bare": "is without a schema in the encoding 'protobuf'",
        "/torn": "the description of fuselog.Bearing is damaged",
        "/nameless": "the description of fuselog.Range is damaged",
        "/two": "has channels of different schemas; give each its own topic",
        "/old": "this fuselog.Bearing has no numeric field target_id, bearing_rad; it was written",
        "/words": "this other.Words has no numeric field at all",
        "/noise": "a message cannot be read as fuselog.Bearing .*; leave the topic out",
    }.items():
        with pytest.raises(BadInput, match=f"run.mcap: topic {topic}:? {sentence}"):
            read(path, topic)


def test_a_stamp_past_the_year_2262_is_told_and_not_wrapped(tmp_path):
    """MCAP's clocks are unsigned, our columns signed."""
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("fuselog.Bearing", "protobuf", BEARING)
        channel = writer.register_channel("/topic", "protobuf", schema)
        for time in (1, 2**63 + 5, 2**64 - 1):
            writer.add_message(channel, time, CLOCK + TARGET + ANGLE, time)
        writer.finish()
    with pytest.raises(BadInput, match="is before 1970 or after the year 2262"):
        read(tmp_path / "run.mcap")


def test_a_real_ros_log_is_listed_and_refused_with_a_sentence(real_data):
    path = real_data / "nav2_turtlebot.mcap"
    log = open_log(path)
    counts = {topic.name: topic.messages for topic in log.topics.values()}
    assert counts == {"/amcl_pose": 135, "/odom": 2639, "/tf": 5422, "/tf_static": 1}
    assert log.topics["/odom"].schema_name == "nav_msgs/msg/Odometry"
    assert log.run is None
    recovered = open_log(path, recover=True)
    assert {topic.name: topic.messages for topic in recovered.topics.values()} == counts
    with pytest.raises(
        BadInput, match=r"topic /odom is nav_msgs/msg/Odometry in the encoding 'cdr'; fuselog repl"
    ):
        read_streams(log, ["/odom"])


def with_summary(raw: bytes, change) -> bytes:
    """A log's bytes with its summary changed in place by `change` and sealed again."""
    footer = raw[-37:]
    (start,) = struct.unpack_from("<Q", footer, 9)
    summary = list(StreamReader(BytesIO(raw[start:]), skip_magic=True).records)
    kept = [each for each in summary if not isinstance(each, records.Footer | records.SummaryOffset)]
    change(kept)
    builder = RecordBuilder()
    for each in kept:
        each.write(builder)
    section = builder.end() + struct.pack("<BQQQ", 2, 20, start, 0)
    return raw[:start] + section + struct.pack("<I", zlib.crc32(section)) + raw[-8:]


def test_messages_beside_indexed_chunks_are_read(tmp_path):
    """MCAP lets messages stand outside the chunks of an indexed file; no index tells of them."""
    path = tmp_path / "run.mcap"
    (bearings,) = [stream for stream in some_streams(2) if stream.topic == "/bearing"]
    with LogWriter(path, chunk_bytes=700) as log:
        log.write([bearings])
    raw = bytearray(path.read_bytes())
    payload = struct.pack("<HIQQ", 1, 99, 1100, 1050) + CLOCK + TARGET + ANGLE
    loose = struct.pack("<BQ", 5, len(payload)) + payload
    (start,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    struct.pack_into("<Q", raw, len(raw) - 28, start + 2 * len(loose))
    second_chunk = open_log(path).container.regions[1].offset
    data_end = start - 13
    raw = raw[:second_chunk] + loose + raw[second_chunk:data_end] + loose + raw[data_end:]

    def count_them(summary):
        for entry in chunk_indexes(summary)[1:]:
            entry.chunk_start_offset += len(loose)
        statistics(summary).channel_message_counts[1] += 2
        statistics(summary).message_count += 2

    path.write_bytes(with_summary(bytes(raw), count_them))
    for recover in (False, True):
        found = read(path, "/bearing", recover=recover)
        assert sorted(found.publish_time_ns) == sorted([*bearings.publish_time_ns, 1050, 1050])
        assert found["target_id"][found.log_time_ns == 1100][-2:].tolist() == [6, 6]


@pytest.mark.paper
def test_a_chunk_without_messages_has_no_time(tmp_path):
    """The index of one states the time 0, at which such a log does not begin."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(schemas.BEARING.full_name, "protobuf", BEARING)
        channel = writer.register_channel("/bearing", "protobuf", schema)
        writer.add_message(channel, 1100, CLOCK + TARGET + ANGLE, 1050)
        writer.finish()
    raw = path.read_bytes()
    (start,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    content = struct.pack("<QQQIIQ", 0, 0, 0, 0, 0, 0)
    chunk = struct.pack("<BQ", 6, len(content)) + content
    data_end = start - 13
    raw = raw[:data_end] + chunk + raw[data_end:-28] + struct.pack("<Q", start + len(chunk)) + raw[-20:]

    def tell_of_it(summary):
        statistics(summary).chunk_count += 1
        summary.append(records.ChunkIndex(len(chunk), data_end, "", 0, 0, 0, {}, 0, 0))

    path.write_bytes(with_summary(raw, tell_of_it))
    assert read_span(open_log(path), "publish_time") == (1050, 1050)
    assert read_span(open_log(path), "log_time") == (1100, 1100)
    assert read(path, "/bearing").publish_time_ns.tolist() == [1050]


def chunk_indexes(summary):
    return [each for each in summary if isinstance(each, records.ChunkIndex)]


def statistics(summary):
    return next(each for each in summary if isinstance(each, records.Statistics))


def leave_out_a_chunk(summary):
    summary.remove(chunk_indexes(summary)[1])
    statistics(summary).chunk_count -= 1


def point_elsewhere(summary):
    chunk_indexes(summary)[1].chunk_start_offset += 3


def point_outside(summary):
    chunk_indexes(summary)[1].chunk_start_offset = 1 << 60


def state_a_wrong_length(summary):
    chunk_indexes(summary)[1].chunk_length += 5


def step_over_the_next_chunk(summary):
    first, second = chunk_indexes(summary)[:2]
    first.message_index_length = (
        second.chunk_start_offset + second.chunk_length - first.chunk_start_offset
    )
    first.message_index_length += second.message_index_length - first.chunk_length


def step_out_of_the_file(summary):
    chunk_indexes(summary)[1].message_index_length = 1 << 40


def narrow_the_span(summary):
    chunk_indexes(summary)[1].message_end_time -= 1


def shift_the_span(summary):
    chunk_indexes(summary)[1].message_start_time = 0
    chunk_indexes(summary)[1].message_end_time = 5


def forget_a_channel(summary):
    del chunk_indexes(summary)[1].message_index_offsets[3]


def forget_a_message(summary):
    statistics(summary).channel_message_counts[3] -= 1
    statistics(summary).message_count -= 1


def count_no_messages(summary):
    statistics(summary).channel_message_counts.clear()


def forget_a_schema(summary):
    summary.remove(next(each for each in summary if isinstance(each, records.Schema)))


LIES = [
    leave_out_a_chunk,
    point_elsewhere,
    point_outside,
    state_a_wrong_length,
    step_over_the_next_chunk,
    step_out_of_the_file,
    narrow_the_span,
    shift_the_span,
    forget_a_channel,
    forget_a_message,
    count_no_messages,
    forget_a_schema,
]

# What is read right without them: no chunk is stepped over that the walk through the file has not seen.
HARMLESS = [
    leave_out_a_chunk,
    state_a_wrong_length,
    step_over_the_next_chunk,
    step_out_of_the_file,
    count_no_messages,
    forget_a_schema,
]


def assert_reads_as(log, honest, clock: str) -> None:
    """Whole, alone, block by block and by spans of time, a log gives what the honest one gave."""
    for topic, expected in honest.items():
        stream = expected.take(np.lexsort((expected.position, expected.times(clock))))
        assert_same(read_streams(log, [topic], order=clock)[topic], stream)
        times = stream.times(clock)
        for start in range(int(times[0]), int(times[-1]) + 1, 200):
            found = read_streams(log, [topic], order=clock, start_ns=start, end_ns=start + 200)[topic]
            assert_same(found, stream, (times >= start) & (times < start + 200))
        blocks = [block[topic] for block in read_blocks(log, [topic], order=clock, block_messages=10)]
        assert_same(concatenate(blocks), stream)


@pytest.fixture(scope="module")
def honest_log(tmp_path_factory):
    """The bytes of a log whose index is right, and its streams, which are read the same in all ways."""
    path = tmp_path_factory.mktemp("honest") / "run.mcap"
    streams = some_streams(2)
    with LogWriter(path, chunk_bytes=2500) as log:
        log.write(streams)
    honest = read_streams(open_log(path), [stream.topic for stream in streams])
    for clock in ("publish_time", "log_time"):
        assert_reads_as(open_log(path), honest, clock)
    return path.read_bytes(), honest


@pytest.mark.paper
@pytest.mark.parametrize("clock", ["publish_time", "log_time"])
@pytest.mark.parametrize("lie", LIES, ids=lambda lie: lie.__name__)
def test_an_index_that_lies_is_found_out(tmp_path, honest_log, lie, clock):
    """Whatever a summary says, all messages are read or the lie is told; recover reads them all."""
    path = tmp_path / "run.mcap"
    raw, honest = honest_log
    path.write_bytes(with_summary(raw, lie))
    assert_reads_as(open_log(path, recover=True), honest, clock)
    if lie in HARMLESS:
        assert_reads_as(open_log(path), honest, clock)
    else:
        with pytest.raises(BadInput, match="--recover"):
            assert_reads_as(open_log(path), honest, clock)


def test_a_chunk_that_an_index_leaves_out_and_steps_over_is_not_lost(tmp_path):
    """Index and statistics agree that there is none: only a walk through the file can tell."""
    path = tmp_path / "run.mcap"
    streams = some_streams(2)
    with LogWriter(path, chunk_bytes=2500) as log:
        log.write(streams)
    raw = path.read_bytes()
    topics = [stream.topic for stream in streams]

    def lie(summary):
        step_over_the_next_chunk(summary)
        left_out = chunk_indexes(summary)[1]
        leave_out_a_chunk(summary)
        for channel, offset in left_out.message_index_offsets.items():
            (entry_bytes,) = struct.unpack_from("<I", raw, offset + 11)
            statistics(summary).channel_message_counts[channel] -= entry_bytes // 16
            statistics(summary).message_count -= entry_bytes // 16

    path.write_bytes(with_summary(raw, lie))
    with pytest.raises(BadInput, match=r"topic /bearing has \d+ messages by the file's statistics"):
        read_streams(open_log(path), topics)
    found = read_streams(open_log(path, recover=True), topics)
    for stream in streams:
        assert_same(found[stream.topic], stream, rows_read(stream))
