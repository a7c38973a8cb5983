"""How fast logs are read and written beside the ready-made ways, measured side by side in one run.

Run it with `python tests/bench/bench_log.py`; `make bench` calls `main`. It asserts nothing: numbers of a
shared machine move, their ratios within one run say what holds.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rerun.chunk import McapReader

from recorders.log import LogWriter, Stream, make_stream, open_log, read_blocks, read_streams, write_log
from recorders.log import schemas

MESSAGES = 200_000
REPEATS = 3
WIDTHS = {"position_m": 3, "covariance_m2": 9, "state": 6, "axis": 3, "quaternion": 4, "value": 2}
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


class Row(NamedTuple):
    """One comparison, in messages per second."""

    name: str
    ours: float
    theirs: float
    ratio: float


def synthetic_streams(messages: int, seed: int, start_ns: int = 0) -> list[Stream]:
    """Ten topics of one rate whose messages interleave, stamped a few ms before they are logged."""
    generator = np.random.default_rng(seed)
    count = messages // len(TOPICS)
    streams = []
    for place, schema in enumerate(TOPICS):
        published = start_ns + np.arange(count) * 10_000_000 + place * 1_000_000
        logged = published + generator.integers(1_000_000, 9_000_000, count)
        columns = {
            field.name: generator.integers(0, 50, count)
            if field.kind == "identifier"
            else generator.normal(
                size=(count, WIDTHS.get(field.name, 3)) if field.kind == "vector" else count
            )
            for field in list(schema)[1:]
        }
        streams.append(make_stream(f"/{schema.name}", schema, published, log_time_ns=logged, **columns))
    return streams


def seconds(*ways: Callable[[], object]) -> list[float]:
    """The median wall time of each way, the ways taking turns so that a busy spell meets all of them."""
    taken = np.empty((REPEATS, len(ways)))
    for turn in taken:
        for place, way in enumerate(ways):
            begin = time.perf_counter()
            way()
            turn[place] = time.perf_counter() - begin
    return list(np.median(taken, axis=0))


def read_with_mcap(path: Path) -> int:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def read_with_rerun(path: Path) -> dict[str, dict[str, NDArray]]:
    columns: dict[str, dict[str, NDArray]] = {}
    for chunk in McapReader(str(path), decoders=["protobuf"]).stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        name = next(n for n in batch.schema.names if n.endswith(":message"))
        struct = batch.column(name).flatten()
        columns[chunk.entity_path] = {
            field.name: struct.field(field.name).to_numpy(zero_copy_only=False)
            if not str(field.type).startswith("list")
            else struct.field(field.name).flatten().to_numpy(zero_copy_only=False)
            for field in struct.type
        }
    return columns


def serialised(streams: list[Stream]) -> list[list[bytes]]:
    found = []
    for s in streams:
        make = s.schema.message_class
        cols = {k: v.tolist() for k, v in s.columns.items()}
        found.append([make(**dict(zip(cols, row))).SerializeToString() for row in zip(*cols.values())])
    return found


def write_with_mcap(path, streams, payloads, compression):
    with path.open("wb") as file:
        w = Writer(file, compression=compression)
        w.start()
        rows = []
        for k, s in enumerate(streams):
            sid = w.register_schema(s.schema.full_name, "protobuf", s.schema.descriptor_set)
            cid = w.register_channel(s.topic, "protobuf", sid)
            rows += zip(s.log_time_ns.tolist(), s.publish_time_ns.tolist(), [cid] * len(s), payloads[k])
        rows.sort(key=lambda r: r[0])
        for log, pub, cid, data in rows:
            w.add_message(cid, log, data, pub)
        w.finish()


if __name__ == "__main__":
    streams = synthetic_streams(MESSAGES, 1)
    n = sum(map(len, streams))
    with tempfile.TemporaryDirectory() as folder:
        for comp in ("none", "lz4", "zstd"):
            p = Path(folder) / f"{comp}.mcap"
            t = seconds(lambda: write_log(p, streams, compression=comp))[0]
            names = [s.topic for s in streams]
            (r,) = seconds(lambda: read_streams(open_log(p), names))
            print(comp, f"write {n / t:.3g}/s {p.stat().st_size / n:.1f} B/msg read {n / r:.3g}/s")
        if len(sys.argv) > 1:
            payloads = serialised(streams)
            a, b, c = seconds(
                lambda: read_streams(open_log(p), names),
                lambda: read_with_rerun(p),
                lambda: read_with_mcap(p),
            )
            print("read", n / a, n / b, n / c, b / a, c / a)
            q = Path(folder) / "theirs.mcap"
            a, b, c = seconds(
                lambda: write_log(p, streams),
                lambda: write_with_mcap(q, streams, payloads, CompressionType.ZSTD),
                lambda: write_with_mcap(q, streams, serialised(streams), CompressionType.ZSTD),
            )
            print("write", n / a, n / b, n / c, b / a, c / a)
