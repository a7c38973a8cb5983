"""How fast logs are read and written beside the ready-made ways, measured side by side in one run.

`python -m tests.bench log` prints the ratios. `python tests/bench/bench_log.py` writes and reads ten
million messages block by block, and prints how much memory that took.
"""

import resource  # noqa: TID251
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rerun.chunk import McapReader

from fuselog.recorders.log import (
    LogWriter,
    Stream,
    make_stream,
    open_log,
    read_blocks,
    read_streams,
    schemas,
    write_log,
)

COMPRESSIONS = ["zstd", "lz4", "none"]  # the first is the default
MESSAGES = 200_000
REPEATS = 5
TOPICS = [
    schemas.BEARING,
    schemas.RANGE,
    schemas.RANGE_BEARING,
    schemas.LINE_OF_SIGHT,
    schemas.POSITION_FIX,
    schemas.GEODETIC_FIX,
    schemas.DETECTION,
    schemas.ORIENTATION,
    schemas.INERTIAL_SAMPLE,
    schemas.TRUTH_STATE,
]
WIDTHS = {"covariance_m2": 9, "state": 6, "quaternion": 4}
PERIOD_NS = 10_000_000


class Row(NamedTuple):
    """One comparison: messages per second, or bytes per message, and ours over theirs."""

    name: str
    ours: float
    theirs: float
    ratio: float


def noisy_streams(messages: int, seed: int, start_ns: int = 0) -> list[Stream]:
    """Ten topics whose messages interleave, 1 to 9 ms late; noisy doubles hardly compress."""
    generator = np.random.default_rng(seed)
    count = messages // len(TOPICS)
    streams = []
    for place, schema in enumerate(TOPICS):
        published = start_ns + np.arange(count) * PERIOD_NS + place * PERIOD_NS // len(TOPICS)
        columns: dict[str, NDArray] = {}
        for field in list(schema)[1:]:
            if field.kind == "identifier":
                columns[field.name] = generator.integers(0, 50, count)
            else:
                width = WIDTHS.get(field.name, 3)
                columns[field.name] = generator.normal(
                    size=(count, width) if field.kind == "vector" else count
                )
        logged = published + generator.integers(1_000_000, 9_000_000, count)
        streams.append(make_stream(f"/{schema.name}", schema, published, log_time_ns=logged, **columns))
    return streams


def seconds(*ways: Callable[[], object]) -> list[float]:
    """The best time of each way; they take turns, so that a busy spell meets all of them."""
    taken = np.empty((REPEATS, len(ways)))
    for turn in taken:
        for place, way in enumerate(ways):
            begin = time.perf_counter()
            way()
            turn[place] = time.perf_counter() - begin
    return taken.min(axis=0).tolist()


def read_with_mcap(path: Path) -> None:
    """Decode every message as the mcap library does it."""
    with path.open("rb") as file:
        for _ in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            pass


def read_with_rerun(path: Path) -> dict[tuple[str, str], list[NDArray]]:
    """Columns as NumPy arrays, by entity and field, as the chunks of the file come."""
    columns: dict[tuple[str, str], list[NDArray]] = {}
    for chunk in McapReader(str(path), decoders=["protobuf"]).stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            (name,) = [name for name in batch.schema.names if name.endswith(":message")]
            messages = batch.column(name).flatten()
            for field in messages.type:
                values = messages.field(field.name)
                values = values.flatten() if "list" in str(field.type) else values
                columns.setdefault((chunk.entity_path, field.name), []).append(values.to_numpy())
    return columns


def serialised(streams: list[Stream]) -> list[list[bytes]]:
    """Every message as protobuf makes it, one by one."""
    found = []
    for stream in streams:
        names, kind = list(stream.columns), stream.schema.message_class
        rows = zip(*(column.tolist() for column in stream.columns.values()), strict=True)
        found.append([kind(**dict(zip(names, row, strict=True))).SerializeToString() for row in rows])
    return found


def write_with_mcap(path: Path, streams: list[Stream], payloads: list[list[bytes]]) -> None:
    """Write serialised messages in the order of their log times with the mcap library."""
    rows: list[tuple] = []
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for stream, payload in zip(streams, payloads, strict=True):
            schema = stream.schema
            schema_id = writer.register_schema(schema.full_name, "protobuf", schema.descriptor_set)
            channel = writer.register_channel(stream.topic, "protobuf", schema_id)
            times = (stream.log_time_ns.tolist(), stream.publish_time_ns.tolist())
            rows += zip(*times, [channel] * len(stream), payload, strict=True)
        rows.sort(key=lambda row: row[0])
        for log_time, publish_time, channel, data in rows:
            writer.add_message(channel, log_time, data, publish_time)
        writer.finish()


def main() -> list[Row]:
    """Ours beside the mcap library and Rerun's reader, and our default compression beside the others."""
    streams = noisy_streams(MESSAGES, seed=1)
    topics = [stream.topic for stream in streams]
    payloads = serialised(streams)
    with tempfile.TemporaryDirectory() as folder:
        logs = {name: Path(folder) / f"{name}.mcap" for name in ("zstd", "lz4", "none", "theirs")}
        write = {
            name: partial(write_log, logs[name], streams, compression=name) for name in COMPRESSIONS
        }
        read = {
            name: lambda path=logs[name]: read_streams(open_log(path), topics) for name in COMPRESSIONS
        }
        writing = seconds(
            *write.values(),
            lambda: write_with_mcap(logs["theirs"], streams, payloads),
            lambda: write_with_mcap(logs["theirs"], streams, serialised(streams)),
        )
        read["zstd"]()  # compiles, once per installation
        reading = seconds(
            *read.values(), lambda: read_with_mcap(logs["zstd"]), lambda: read_with_rerun(logs["zstd"])
        )
        sizes = [logs[name].stat().st_size / MESSAGES for name in COMPRESSIONS]
    rows = [
        _speeds("write: fuselog, mcap of serialised bytes", writing[0], writing[3]),
        _speeds("write: fuselog, mcap and protobuf", writing[0], writing[4]),
        _speeds("read: fuselog, mcap decoded", reading[0], reading[3]),
        _speeds("read: fuselog, rerun columns", reading[0], reading[4]),
    ]
    for place, name in enumerate(COMPRESSIONS[1:], start=1):
        rows += [
            _speeds(f"write: zstd, {name}", writing[0], writing[place]),
            _speeds(f"read: zstd, {name}", reading[0], reading[place]),
            Row(f"bytes per message: zstd, {name}", sizes[0], sizes[place], sizes[0] / sizes[place]),
        ]
    return rows


def _speeds(name: str, ours_s: float, theirs_s: float) -> Row:
    """Messages per second of both."""
    return Row(name, MESSAGES / ours_s, MESSAGES / theirs_s, theirs_s / ours_s)


def memory() -> None:
    """Write and read ten million messages block by block, and print the peak memory of doing so."""
    subprocess.run([sys.executable, __file__], check=True)


def _write_and_read_ten_million() -> None:
    block, blocks = 200_000, 50
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        begin = time.perf_counter()
        with LogWriter(path) as log:
            for number in range(blocks):
                log.write(noisy_streams(block, number, number * block // len(TOPICS) * PERIOD_NS))
        _report(
            f"made and wrote {block * blocks:,} messages, {path.stat().st_size / 1e6:,.0f} MB", begin
        )
        begin = time.perf_counter()
        log = open_log(path)
        count = sum(
            len(stream) for found in read_blocks(log, list(log.topics)) for stream in found.values()
        )
        _report(f"read {count:,} messages in blocks", begin)


def _report(what: str, begin: float) -> None:
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{what} in {time.perf_counter() - begin:.1f} s; peak memory so far {peak_mb:,.0f} MB",
        flush=True,
    )


if __name__ == "__main__":
    _write_and_read_ten_million()
