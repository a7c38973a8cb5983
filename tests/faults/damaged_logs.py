"""What reading a damaged log may give: all that was written, a part of it that is stated, a sentence.

A wrong number, a traceback, and memory without bound are what may not be. Flips and cuts share this.
"""

import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, RunMetadata, Stream, open_log, read_streams
from tests.faults import Tally
from tests.recorders.log_samples import some_streams

COMPRESSIONS = ("zstd", "lz4", "none")
RUN = RunMetadata("demo", {"speed_mps": 3.5}, seed=123, epoch_ns=456)
# What a log of some kilobytes may take while it is read.
MEMORY_BYTES = 32 << 20


class Sample(NamedTuple):
    """The bytes of a whole log, and the messages of its topics in file order, each as bytes."""

    raw: bytes
    messages: dict[str, list[bytes]]


def tally(
    damage: Callable[[bytes, np.random.Generator], tuple[bytes, str]],
    seconds: float,
    rng: np.random.Generator,
    most: int | None = None,
) -> Tally:
    """Damage logs of each compression in turn and read them, for so long or so many times.

    `damage` returns the damaged bytes, and what was done to them in words.
    """
    end = time.monotonic() + seconds
    tried, notes = 0, []
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder:
        path = Path(folder, "run.mcap")
        samples = {each: sample(path, each, int(rng.integers(1 << 32))) for each in COMPRESSIONS}
        _read_once(path, samples["zstd"])
        while time.monotonic() < end and tried != most:
            compression = COMPRESSIONS[tried % len(COMPRESSIONS)]
            whole = samples[compression]
            raw, done = damage(whole.raw, rng)
            path.write_bytes(raw)
            for recover in (False, True):
                wrong = _complaint(path, whole, recover=recover)
                if wrong:
                    notes.append(f"{compression}, {done}, recover={recover}: {wrong}")
                    break
            tried += 1
    return Tally(tried, tried - len(notes), notes)


def _read_once(path: Path, whole: Sample) -> None:
    """Read a log, so that loading what reads counts for no other."""
    path.write_bytes(whole.raw[:-100])
    log = open_log(path, recover=True)
    read_streams(log, list(log.topics), order="log_time")


def sample(path: Path, compression: str, seed: int) -> Sample:
    """A log of four topics in two blocks and a dozen chunks, with late messages and equal stamps."""
    with LogWriter(path, RUN, compression=compression, chunk_bytes=900) as log:
        log.write(some_streams(seed, count=20))
        log.write(some_streams(seed + 1, count=15))
    log = open_log(path)
    found = read_streams(log, list(log.topics), order="log_time")
    return Sample(path.read_bytes(), {topic: _messages(stream) for topic, stream in found.items()})


def _messages(stream: Stream) -> list[bytes]:
    """Both clocks and all fields of each message; no two are equal, for their numbers are random."""
    columns = (stream.log_time_ns, stream.publish_time_ns, *stream.columns.values())
    return [
        b"".join(row) for row in zip(*([each.tobytes() for each in c] for c in columns), strict=True)
    ]


def _complaint(path: Path, whole: Sample, *, recover: bool) -> str:
    """What is wrong with how the log is read; empty where nothing is."""
    tracemalloc.start()
    try:
        wrong = _difference(path, whole, recover=recover)
    except BadInput as error:
        sentence = str(error)
        wrong = "" if str(path) in sentence and len(sentence.splitlines()) == 1 else f"says {sentence!r}"
    except Exception as error:  # a traceback, whatever it is of
        wrong = f"{type(error).__name__}: {error}"
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return wrong or ("" if most < MEMORY_BYTES else f"{most} bytes of memory")


def _difference(path: Path, whole: Sample, *, recover: bool) -> str:
    """How what is read differs from what was written, where nothing says so. Raises BadInput."""
    log = open_log(path, recover=recover)
    stated = log.loss_statement if recover else None
    if log.run != RUN and not (log.run is None and stated):
        return f"its run is {log.run}"
    found = read_streams(log, list(log.topics), order="log_time")
    if found.keys() != whole.messages.keys() and not (stated and found.keys() < whole.messages.keys()):
        return f"its topics are {', '.join(found)}"
    for topic, stream in found.items():
        messages, written = _messages(stream), whole.messages[topic]
        rest = iter(written)
        if not all(each in rest for each in messages):  # each is sought behind the one before it
            return f"{topic} has messages that nobody wrote, or in another order"
        if len(messages) < len(written) and not stated:
            return f"{topic} lacks {len(written) - len(messages)} messages and nothing says so"
    return ""
