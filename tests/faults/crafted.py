"""Logs that were made to trouble. What they state of themselves is false, or no reader expects it.

Where the end or the index of a log lies, what is read is compared with what was written, as for flips.
Where names, texts and messages trouble, every command must end with 0, or with 2 and one sentence.
"""

import contextlib
import io
import struct
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from fuselog.pipeline.command_line import main
from fuselog.recorders.log import Stream
from fuselog.recorders.log.container.chunks import MAGIC
from fuselog.recorders.log.container.sealed import seal
from fuselog.recorders.recording import record_run
from tests.faults import Tally
from tests.faults.damaged_logs import tally

COMMANDS = (
    "info LOG",
    "info LOG --json",
    "replay LOG -e ekf -o NEW/estimates.mcap",
    "replay LOG -e ekf --recover --json -o NEW/recovered.mcap",
    "evaluate NEW/estimates.mcap --out NEW/result",
    "evaluate LOG --out NEW/own",
    "view LOG --save NEW.rrd",
    "record --again LOG -o NEW/again.mcap",
)
# fmt: off
NAMES = ("\0", "robot\x1b[31m", "$\\foo$", "$\\frac{1}$", "$", "..", "", "a//b", "\u202erobot", "\u2028",
         "%s{0}", "<b>&", "robot" * 5000)
TEXTS = ("", "nan", "inf", "-1", "0", "1e999", "abc", "\0", ",", "x_m", "x_m,x_m,x_m", "x_m,y_m,$\\foo$",
         "linear,linear,linear", "quaternion,linear,angle", "1" * 5000)
VALUES = ("[1]", "{}", "null", '"x"', "3", "-1", "0.5", "true", "NaN", "1e999", "{", "", '{"a": NaN}',
          '{"log": "."}', '{"log": "\\u0000"}', '{"\\ud800": "x"}', '{"robots": 1e300}',
          '{"duration_s": -1}', '{"robots": {"robots": {}}}', "[" * 100_000, "1" * 5000, str(2**63),
          '{"a":' * 60 + "1" + "}" * 60)
NUMBERS = (0, 1, 7, 255, 1 << 16, 1 << 31, 1 << 40, 1 << 63, (1 << 64) - 1)
# fmt: on


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Half of the time for logs that lie, half for logs that trouble; at most so many of each."""
    lies = tally(_lying, seconds / 2, rng, most)
    end = time.monotonic() + seconds / 2
    tried, notes = 0, list(lies.notes)
    while time.monotonic() < end and tried != most:
        trouble = TROUBLES[tried % len(TROUBLES)]
        with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder:
            path = Path(folder, "log.mcap")
            done = trouble(path, rng)
            wrong = next(filter(None, (_complaint(each, path) for each in COMMANDS)), "")
        if wrong:
            notes.append(f"{done}: {wrong}")
        tried += 1
    return Tally(lies.tried + tried, lies.tried + tried - len(notes), notes)


def _complaint(command: str, log: Path) -> str:
    """What is wrong with how a command ended; empty where nothing is."""
    places = {"LOG": str(log), "NEW": str(log.with_name("new"))}
    for word, place in places.items():
        command = command.replace(word, place)
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(command.split())
    except Exception as error:  # a traceback, whatever it is of
        return f"{command}: {type(error).__name__}: {str(error)[:200]}"
    said = err.getvalue()
    if code == 0 or (code == 2 and said.startswith("fuselog: ") and said.count("\n") == 1):
        return ""
    return f"{command}: code {code}, {said[:200]!r}"


# Lies about the index, the end and the chunks of a log.


def _lying(raw: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    lie = LIES[int(rng.integers(len(LIES)))]
    return lie(raw, rng)


def _of_the_index(raw: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    """One number of one record of the summary is another, and the checksum says that it is right."""
    (start,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    summary = list(StreamReader(io.BytesIO(raw[start:]), skip_magic=True).records)
    kept = [each for each in summary if not isinstance(each, records.Footer | records.SummaryOffset)]
    lies = [each for each in kept if not isinstance(each, records.Schema | records.Channel)]
    record = lies[int(rng.integers(len(lies)))]
    names = [name for name, value in vars(record).items() if isinstance(value, int)]
    name = names[int(rng.integers(len(names)))]
    value = getattr(record, name)
    other = int(rng.choice([value + 1, max(value - 1, 0), value // 2, value * 2 % (1 << 32), 0]))
    setattr(record, name, other)
    builder = RecordBuilder()
    for each in kept:
        each.write(builder)
    section = builder.end() + struct.pack("<BQQQ", 2, 20, start, 0)
    lying = raw[:start] + section + struct.pack("<I", zlib.crc32(section)) + MAGIC
    return lying, f"{type(record).__name__}.{name} {other} for {value}"


def _of_the_end(raw: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    """Another log, a part of one, or any bytes are joined to the log."""
    part = raw[int(rng.integers(len(raw))) :]
    tail = [raw, part, rng.bytes(int(rng.integers(1, 500))), MAGIC][int(rng.integers(4))]
    return raw + tail, f"{len(tail)} bytes joined to {len(raw)}"


def _of_a_chunk(raw: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    """A chunk of its own at the end of the data, of any size, by words and in truth."""
    (start,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    stated, size = NUMBERS[int(rng.integers(len(NUMBERS)))], int(rng.choice([0, 50, 40 << 20]))
    pack: Callable[[bytes], bytes]
    name, pack = [(b"lz4", lz4.frame.compress), (b"zstd", zstandard.compress), (b"", bytes)][
        int(rng.integers(3))
    ]
    packed = pack(bytes(size if name else min(size, 5000)))
    body = struct.pack("<QQQII", 0, 0, stated, 0, len(name)) + name + struct.pack("<Q", len(packed))
    chunk = struct.pack("<BQ", 6, len(body) + len(packed)) + body + packed
    end = start - 13
    lying = bytearray(raw[:end] + chunk + raw[end:])
    struct.pack_into("<Q", lying, len(lying) - 28, start + len(chunk))
    struct.pack_into("<Q", lying, len(lying) - 20, 0)
    struct.pack_into("<I", lying, len(lying) - 12, 0)
    return bytes(lying), f"a chunk '{name.decode()}' of {size} bytes that states {stated}"


LIES = (_of_the_index, _of_the_end, _of_a_chunk)


# Logs with names, texts and messages that nobody expects.


def _run_metadata(path: Path, rng: np.random.Generator) -> str:
    key = str(rng.choice(["scenario", "parameters", "seed", "run", "epoch_ns", "notes"]))
    value = VALUES[int(rng.integers(len(VALUES)))]
    _write(path, change_run=lambda run: {**run, key: value})
    return f"run metadata, {key} = {value[:40]!r}"


def _topic_name(path: Path, rng: np.random.Generator) -> str:
    name = NAMES[int(rng.integers(len(NAMES)))]
    _write(path, change_topic=lambda topic: topic.replace("robot1", name))
    return f"robot {name[:40]!r}"


def _stream_metadata(path: Path, rng: np.random.Generator) -> str:
    chosen = int(rng.integers(1 << 30))
    text = TEXTS[int(rng.integers(len(TEXTS)))]

    def change(topic: str, metadata: dict[str, str]) -> dict[str, str]:
        names = sorted({*metadata, "components", "kinds"})
        return {**metadata, names[(chosen + len(topic)) % len(names)]: text}

    _write(path, change_metadata=change)
    return f"metadata of streams {text[:40]!r}, {chosen}"


def _description(path: Path, rng: np.random.Generator) -> str:
    place, bit = int(rng.integers(1 << 30)), int(rng.integers(8))

    def change(description: bytes) -> bytes:
        changed = bytearray(description)
        changed[place % len(changed)] ^= 1 << bit
        return bytes(changed)

    _write(path, change_description=change)
    return f"descriptions, bit {bit} of byte {place}"


def _message(path: Path, rng: np.random.Generator) -> str:
    kind = int(rng.integers(5))
    row, noise = int(rng.integers(3)), rng.bytes(30)

    def change(number: int, message: bytes) -> bytes:
        if number != row:
            return message
        cut = len(message) // 2
        return [b"", message[:cut], message + noise, noise, message[:-8] + noise[:8]][kind]

    _write(path, change_message=change)
    return f"message {row} of each stream, kind {kind}, {noise.hex()}"


def _stamp(path: Path, rng: np.random.Generator) -> str:
    row, stamp = int(rng.integers(3)), NUMBERS[int(rng.integers(len(NUMBERS)))]
    _write(path, change_time=lambda number, time_ns: stamp if number == row else time_ns)
    return f"stamp {row} of each stream is {stamp}"


TROUBLES = (_run_metadata, _topic_name, _stream_metadata, _description, _message, _stamp)


def _same(*arguments: Any) -> Any:
    return arguments[-1]


def _write(
    path: Path,
    *,
    change_run: Callable[[dict[str, str]], dict[str, str]] = _same,
    change_topic: Callable[[str], str] = _same,
    change_metadata: Callable[[str, dict[str, str]], dict[str, str]] = _same,
    change_description: Callable[[bytes], bytes] = _same,
    change_message: Callable[[int, bytes], bytes] = _same,
    change_time: Callable[[int, int], int] = _same,
) -> None:
    """Two seconds of a robot among landmarks by the official writer, which checks nothing."""
    recording, run = record_run("landmarks", {"duration_s": 2.0}, 0)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=3000)
        writer.start()
        writer.add_metadata("fuselog.run", seal(change_run(run.to_record())))
        for stream in recording.streams:
            schema = stream.schema
            schema_id = writer.register_schema(
                schema.full_name, "protobuf", change_description(schema.descriptor_set)
            )
            metadata = change_metadata(stream.topic, dict(stream.metadata))
            channel = writer.register_channel(
                change_topic(stream.topic), "protobuf", schema_id, metadata
            )
            for row, message in enumerate(_messages(stream)):
                time_ns = change_time(row, int(stream.publish_time_ns[row]))
                writer.add_message(channel, time_ns, change_message(row, message), time_ns)
        writer.finish()


def _messages(stream: Stream) -> list[bytes]:
    names = list(stream.columns)
    rows = zip(*(column.tolist() for column in stream.columns.values()), strict=True)
    make = stream.schema.message_class
    return [make(**dict(zip(names, row, strict=True))).SerializeToString() for row in rows]
