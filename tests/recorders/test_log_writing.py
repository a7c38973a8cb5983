"""A log appears whole or not at all, and what cannot be kept is refused with a sentence."""

import pickle
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import (
    Field,
    LogWriter,
    Mirror,
    RunMetadata,
    Schema,
    make_stream,
    open_log,
    read_streams,
    schemas,
    write_log,
)
from fuselog.recorders.log.streams import concatenate
from tests.recorders.log_samples import assert_same, rows_in_file, some_streams

COUNTS = {"scan_id": [1, 2], "detections": [3, 4]}


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def scans(**changes):
    """A stream of two scans, with some arguments changed."""
    given = {"topic": "/scan", "schema": schemas.SCAN, "publish_time_ns": [10, 20], **COUNTS, **changes}
    return make_stream(**given)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_the_same_input_gives_the_same_bytes(tmp_path, compression):
    """Threads, dictionaries and clocks leave no trace in a log."""
    for name in ("first", "second"):
        with LogWriter(
            tmp_path / name, RunMetadata("demo", {"b": 1, "a": 2}), compression=compression
        ) as log:
            log.write(some_streams(5, count=20_000))
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()


def test_an_error_inside_leaves_the_old_log_and_no_part(tmp_path):
    """Whatever is raised while a log is written, a log of that name stays as it was."""
    path = tmp_path / "run.mcap"
    write_log(path, [scans()])
    before = path.read_bytes()

    def write_and_raise(error):
        with LogWriter(path) as log:
            log.write(some_streams(1))
            raise error

    for kind in (KeyboardInterrupt, FileNotFoundError, BadInput):
        with pytest.raises(kind, match="by the caller"):
            write_and_raise(kind("by the caller"))
        assert path.read_bytes() == before
        assert names_in(tmp_path) == ["run.mcap"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full to write to")
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, monkeypatch):
    """/dev/full stands in for a disk without room: neither half a log nor a part stays."""
    path = tmp_path / "run.mcap"
    write_log(path, [scans()])
    before = path.read_bytes()
    monkeypatch.setattr(Path, "open", lambda *_: open("/dev/full", "wb"))  # noqa: PTH123, SIM115
    with pytest.raises(BadInput, match=r"run\.mcap: cannot be written \(No space left on device\)$"):
        write_log(path, some_streams(1, count=5000))
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert names_in(tmp_path) == ["run.mcap"]


def test_a_write_that_failed_is_never_finished(tmp_path):
    """Who goes on after an error of the disk gets no log with a hole in it."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def write_on_a_disk_that_is_full_for_a_while():
        with LogWriter(tmp_path / "run.mcap") as log:
            resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
            try:
                with pytest.raises(BadInput, match="File too large"):
                    log.write(some_streams(1, count=5000))
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    with pytest.raises(BadInput, match="File too large"):
        write_on_a_disk_that_is_full_for_a_while()
    assert names_in(tmp_path) == []


def test_places_that_cannot_hold_a_log_are_told(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "run.mcap", tmp_path, tmp_path / ("x" * 300)):
        with pytest.raises(BadInput, match=r"cannot be written|is a folder"):
            write_log(path, [scans()])
    with pytest.raises(BadInput, match="compression 'gzip' is not one of zstd, lz4, none"):
        write_log(tmp_path / "run.mcap", [scans()], compression="gzip")
    assert names_in(tmp_path) == ["file"]


@pytest.mark.unix
def test_a_part_left_by_a_kill_is_readable_with_recover(tmp_path):
    """A kill -9 after two blocks: what the writer had handed to the system is read back bit for bit."""
    program = """
        import sys, time
        sys.path.insert(0, sys.argv[2])
        from log_samples import some_streams
        from fuselog.recorders.log import LogWriter
        with LogWriter(sys.argv[1]) as log:
            log.write(some_streams(1, count=20_000))
            log.write(some_streams(2, count=10))
            print("written", flush=True)
            time.sleep(60)
    """
    path = tmp_path / "run.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program), path, Path(__file__).parent],
        stdout=subprocess.PIPE,
    ) as child:
        assert child.stdout.readline() == b"written\n"
        child.send_signal(signal.SIGKILL)  # noqa: TID251
    (part,) = tmp_path.glob(".run.mcap.*.part/new.mcap")
    with pytest.raises(
        BadInput, match=r"new\.mcap: it was cut off.*intact chunks are readable with --recover$"
    ):
        open_log(part)
    log = open_log(part, recover=True)
    assert "it was cut off" in log.loss_statement
    first, second = some_streams(1, count=20_000), some_streams(2, count=10)
    found = read_streams(log, [stream.topic for stream in first])
    for one, two in zip(first, second, strict=True):
        both = concatenate([one, two])
        in_file = np.concatenate([rows_in_file(one), len(one) + rows_in_file(two)])
        rows = in_file[np.argsort(both.publish_time_ns[in_file], kind="stable")]
        assert_same(found[one.topic], both, rows)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"publish_time_ns": [-1, 20]},
            "publish_time is before 1970 or after the year 2262; shift the run",
        ),
        ({"log_time_ns": [10, -20]}, "log_time is before 1970"),
        ({"log_time_ns": [10]}, "log_time has 1 values for 2 messages"),
        ({"publish_time_ns": [[10, 20]]}, r"publish_time_ns needs 1 axis, but has shape \(1, 2\)"),
        (
            {"publish_time_ns": [0.1 * 3 * 1e9, 20]},
            r"contains 300000000\.0+6, which int64 cannot store; round the values",
        ),
        ({"publish_time_ns": [np.nan, 20]}, "publish_time_ns contains nan, which int64 cannot store"),
        ({"publish_time_ns": [np.datetime64("2020-01-01"), 20]}, "publish_time_ns"),
        ({"publish_time_ns": ["a", "b"]}, "publish_time_ns is not numeric"),
        ({"scan_id": [-1, 2]}, "field scan_id contains -1, which uint32 cannot store"),
        ({"scan_id": [1, 2**32]}, "field scan_id contains 4294967296, which uint32 cannot store"),
        ({"scan_id": [1]}, "field scan_id has 1 values for 2 messages"),
        ({"scan_id": [None, 2]}, "field scan_id is not numeric"),
        ({"speed": [1, 2]}, "fuselog.Scan has no field speed; available: scan_id, detections$"),
    ],
)
def test_a_stream_that_cannot_be_kept_exactly_is_refused(changes, sentence):
    """Nothing is cut, wrapped or rounded on its way into a log."""
    with pytest.raises(BadInput, match=f"^topic /scan: .*{sentence}"):
        scans(**changes)


def test_what_a_stream_lacks_is_named():
    """The fields that are missing, and not those that were given or are made."""
    force = np.zeros((2, 3))
    given = {"specific_force_mps2": force, "turn_rate_radps": force}
    with pytest.raises(
        BadInput, match=r"InertialSample also needs magnetic_field_ut; fill magnetic_field"
    ):
        make_stream("/imu", schemas.INERTIAL_SAMPLE, [1, 2], **given)
    with pytest.raises(BadInput, match=r"^topic /f: fuselog.Detection also needs scan_id$"):
        make_stream("/f", schemas.DETECTION, [1, 2], position_m=force)
    own = Schema("Wheels", "Speeds of wheels.", (Field("left_mps", "real"),))
    with pytest.raises(BadInput, match=r'Wheels lacks .* Field\("sensor_time_ns", "time_ns"\)'):
        make_stream("/wheels", own, [1, 2], left_mps=[1.0, 2.0])


def test_nan_is_refused_where_the_schema_does_not_allow_it():
    """The sentence names the first of them and how many there are."""
    bad = np.array([[0.0, 1.0], [np.nan, 0.0], [np.nan, np.nan]])
    with pytest.raises(
        BadInput, match=r"field position_m is NaN in message 1 \(2 in all\), which fuselog\.Dete"
    ):
        make_stream("/d", schemas.DETECTION, [1, 2, 3], scan_id=[1, 1, 1], position_m=bad)
    fix = make_stream(
        "/f", schemas.POSITION_FIX, [1, 2, 3], position_m=0 * bad[:1].repeat(3, 0), covariance_m2=bad
    )
    assert np.isnan(fix["covariance_m2"]).sum() == 3


def test_a_stream_changed_after_it_was_made_is_checked_again(tmp_path):
    """A filter may put NaN into a column that it did not make; the log is the last place to notice."""
    stream = make_stream("/r", schemas.RANGE, [1, 2], target_id=[1, 1], range_m=[0.5, 1.5])
    stream.columns["range_m"][1] = np.nan
    with pytest.raises(BadInput, match=r"run\.mcap: topic /r: field range_m is NaN in message 1"):
        write_log(tmp_path / "run.mcap", [stream])
    assert names_in(tmp_path) == []


@pytest.mark.parametrize(
    ("later", "sentence"),
    [
        ({"value": [[1.0, 2.0, 3.0]]}, r"widths \{'value': 2\}, so it cannot take \{'value': 3\}"),
        ({"metadata": {"frame": "map"}}, "changes its metadata between blocks"),
        (
            {"schema": schemas.TRUTH_STATE, "state": [[1.0]]},
            "already has fuselog.VectorMeasurement, so it cannot take fuselog.TruthState; use another "
            "topic",
        ),
        (
            {
                "schema": Schema(
                    "VectorMeasurement", "Ours is another.", (Field("sensor_time_ns", "time_ns"),)
                )
            },
            "already has fuselog.VectorMeasurement, so it cannot take fuselog.VectorMeasurement",
        ),
    ],
)
def test_a_topic_keeps_its_schema_widths_and_metadata(tmp_path, later, sentence):
    """A stream has one layout from its first message to its last."""
    first = make_stream("/v", schemas.VECTOR_MEASUREMENT, [1], value=[[1.0, 2.0]])
    defaults = {"schema": schemas.VECTOR_MEASUREMENT} | (
        {} if "schema" in later else {"value": [[1.0, 2.0]]}
    )
    second = make_stream("/v", publish_time_ns=[2], **{**defaults, **later})
    with LogWriter(tmp_path / "run.mcap") as log:
        log.write([first])
        with pytest.raises(BadInput, match=f"topic /v .*{sentence}"):
            log.write([second])
    assert_same(read_streams(open_log(tmp_path / "run.mcap"), ["/v"])["/v"], first)
    with pytest.raises(BadInput, match="a topic is given twice among /v, /v"):
        write_log(tmp_path / "run.mcap", [first, first])


def test_a_topic_gets_its_width_from_its_first_message(tmp_path):
    """A block without messages, as a filter that has not begun yet gives it, does not fix a width."""
    empty = make_stream("/v", schemas.VECTOR_MEASUREMENT, [], value=np.empty((0, 0)))
    full = make_stream("/v", schemas.VECTOR_MEASUREMENT, [1], value=[[1.0, 2.0]])
    with LogWriter(tmp_path / "run.mcap") as log:
        for stream in (empty, full, empty, full):
            log.write([stream])
    found = read_streams(open_log(tmp_path / "run.mcap"), ["/v"])["/v"]
    assert_same(found, concatenate([full, full]))


@given(stamps=st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=12))
def test_mirrors_stand_in_the_order_of_log_time_and_ties_as_given(tmp_path_factory, stamps):
    """In chunks of about two messages, whose spans are those of their messages."""
    path = tmp_path_factory.mktemp("mirrors") / "run.mcap"
    given = [
        Mirror("/viewer", "/scan", Timestamp(seconds=number), *clocks)
        for number, clocks in enumerate(stamps)
    ]
    with LogWriter(path, chunk_bytes=80) as log:
        assert log.write_mirrors(given) == len(given)
    written = []
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                own = [each for each in breakup_chunk(record) if isinstance(each, Message)]
                logged = [each.log_time for each in own]
                assert (record.message_start_time, record.message_end_time) == (min(logged), max(logged))
                written += own
    numbers = [Timestamp.FromString(each.data).seconds for each in written]
    assert numbers == sorted(range(len(stamps)), key=lambda number: stamps[number][0])
    assert [(each.log_time, each.publish_time) for each in written] == [stamps[each] for each in numbers]
    assert [each.sequence for each in written] == numbers


def test_two_schemas_of_one_name_keep_their_own_fields(tmp_path):
    """A third party's message with a name of its own package, or with the names of MCAP's own fields."""
    names = ("length", "sequence", "log_time", "opcode")
    one = Schema("Thing", "", tuple(Field(name, "real") for name in ("sensor_time_ns", *names)), "maker")
    two = Schema("Thing", "", (Field("sensor_time_ns", "time_ns"), Field("height_m", "real")), "maker")
    written = [
        make_stream("/one", one, [1, 2], **{name: [1.5, 2.5] for name in names}),
        make_stream("/two", two, [1, 2], height_m=[3.5, 4.5]),
    ]
    write_log(tmp_path / "run.mcap", written)
    found = read_streams(open_log(tmp_path / "run.mcap"), ["/one", "/two"])
    for stream in written:
        assert_same(found[stream.topic], stream)


def test_a_schema_goes_to_workers_also_after_its_messages_were_decoded() -> None:
    """Its protobuf class is no part of what is pickled, for no other process could find that by name."""
    assert schemas.LANDMARK.message_class().DESCRIPTOR.full_name == "fuselog.Landmark"
    assert pickle.loads(pickle.dumps(schemas.LANDMARK)) == schemas.LANDMARK
