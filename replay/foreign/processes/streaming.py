"""Protocol for programs that read messages from standard input and write answers.

Each frame is a length (4 bytes), followed by a body of this length: a letter for the kind of frame, and
little-endian numbers. The program first sends its description; it then answers every frame except the
first, in order:

    D  program: the description, JSON, with the version of this protocol
    C  create: seed u64, parameters f64 each
    S  start: number u32, time i64, 1 or 0 whether there is a prior, and its mean and covariance f64 each
    T  take: number u32, topic i32, time i64, 1 or 0 whether an estimate is wanted, fields f64 each
    P  predict: number u32, time i64; an estimate is wanted
    R  program: number u32 of the frame that it answers, status i32, flags u8; mean and covariance with
       flag 1; innovation and its covariance with flag 2, and 4 if a gate rejected the measurement

A status above zero is an index, from one, in the failures of the description; a negative status and
other flags are errors. The program ends at the end of its standard input; an answer without a frame is
an error.
"""

import queue
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import count
from typing import NamedTuple

import numpy as np
import psutil

from fuselog.recorders.errors import BadInput, printable
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.foreign.description import Description, read_description
from fuselog.replay.foreign.native.following import (
    INNOVATION_UNSOUND,
    OWN,
    followed,
    offsets_of,
    reason_of_code,
)
from fuselog.replay.foreign.processes.isolation import (
    LOOKS_S,
    STARTS_S,
    Ended,
    Limits,
    Program,
    Ran,
    Watch,
    failure_at,
    in_threads,
)
from fuselog.replay.foreign.processes.tasks import RunGiven, sizes_of
from fuselog.replay.foreign.results import Results, begun, fill_squares, results

MOST_BYTES = 16 << 20  # largest frame
_REPLY, _HEAD = struct.Struct("<IiB"), struct.Struct("<I")
PROTOCOL = 2
ENDS_S = 1.0  # time for a program to end by itself
ESTIMATE, INNOVATION, REJECTED = 1, 2, 4  # flags


class _Frame(NamedTuple):
    """Frame from the program, or the reason why there are no more frames."""

    body: bytes
    fault: str = ""


class Stream(Program):
    """Program that answers frames."""

    def __init__(self, words: Sequence[str], limits: Limits) -> None:
        super().__init__(words)
        self._frames: queue.SimpleQueue[_Frame] = queue.SimpleQueue()
        self._watch = Watch(psutil.Process(self.process.pid), limits)
        self._count = 0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        """Split the output of the program into frames as it arrives.

        The method reads from the file object and not from the file descriptor, which may belong to
        another program after `end` has closed the file.
        """
        assert self.process.stdout is not None
        buffer = bytearray()
        with suppress(OSError, ValueError):
            while came := self.process.stdout.read1(1 << 16):  # type: ignore[attr-defined]
                buffer += came
                while len(buffer) >= 4:
                    size = _HEAD.unpack_from(buffer)[0]
                    if not 0 < size <= MOST_BYTES:
                        text = printable(bytes(buffer[:60]).splitlines()[0].decode(errors="replace"))
                        fault = f"wrote '{text}' to standard output, which is not a frame,"
                        self._frames.put(_Frame(b"", fault))
                        return
                    if len(buffer) < 4 + size:
                        break
                    self._frames.put(_Frame(bytes(buffer[4 : 4 + size])))
                    del buffer[: 4 + size]
        self._frames.put(_Frame(b"", "ended within a frame" if buffer else ""))

    def write(self, frames: Iterator[bytes]) -> None:
        """Write frames in a thread while answers are read."""

        def work() -> None:
            assert self.process.stdin is not None
            with suppress(OSError, ValueError):
                for frame in frames:
                    self.process.stdin.write(_HEAD.pack(len(frame)) + frame)
                self.process.stdin.close()

        threading.Thread(target=work, daemon=True).start()

    def next(self, letter: bytes, allowed_s: float | None = None) -> bytes:
        """Return the body of the next frame of this kind; raise Ended if there is no such frame."""
        while True:
            try:
                frame = self._frames.get(timeout=LOOKS_S)
            except queue.Empty:
                self._watch.look(self._count, allowed_s)
                continue
            self._count += 1
            if frame.fault:
                raise Ended(frame.fault)
            if not frame.body:
                raise Ended(self.how_ended())
            if frame.body[:1] != letter:
                raise Ended(f"sent a frame {frame.body[:1]!r} instead of {letter!r}")
            return frame.body[1:]

    def check_end(self) -> None:
        """Raise Ended if the program sends more answers than there were frames."""
        with suppress(queue.Empty):
            frame = self._frames.get(timeout=ENDS_S)
            if frame.body or frame.fault:
                raise Ended(frame.fault or "sent one answer too many,")


def describe_stream(words: Sequence[str], where: str, limits: Limits) -> Description:
    """Ask a program for its description; raise BadInput if it is missing or its protocol differs."""
    stream = Stream(words, limits)
    try:
        found = read_description(stream.next(b"D"), where)
    except Ended as ended:
        why = str(ended).rstrip(",")
        raise BadInput(f"{where}: the program {why} before it sent its description") from None
    finally:
        stream.end()
    if found.protocol != PROTOCOL:
        raise BadInput(
            f"{where}: its description states protocol {found.protocol}, but this version uses "
            f'{PROTOCOL}: add "protocol": {PROTOCOL} to it, and begin each answer with the number (u32) '
            "at the beginning of the S, T or P frame, as this version's client.py and client.hpp do"
        )
    return found


def frames_of(given: RunGiven, description: Description) -> Iterator[bytes]:
    """Yield the input of a filter for a run as frames."""
    static, events = given.static, given.events
    widths = [each.width for each in description.topics]
    yield struct.pack("<cQ", b"C", given.seed) + np.array(given.parameters, "<f8").tobytes()
    numbers = count()
    taken = struct.Struct("<cIiqB")
    for source, time_ns, row in zip(static.source, static.time_ns, static.data, strict=True):
        head = taken.pack(b"T", next(numbers), source, time_ns, 0)
        yield head + row[: widths[source]].astype("<f8").tobytes()
    if given.prior is None:
        yield struct.pack("<cIqB", b"S", next(numbers), int(events.time_ns[0]), 0)
    else:
        time_ns, mean, covariance = given.prior
        prior = np.concatenate([mean.ravel(), covariance.ravel()]).astype("<f8").tobytes()
        yield struct.pack("<cIqB", b"S", next(numbers), time_ns, 1) + prior
    columns = zip(
        events.source.tolist(), events.time_ns.tolist(), events.wants_estimate.tolist(), strict=True
    )
    for (source, time_ns, wants), row in zip(columns, events.data.astype("<f8"), strict=True):
        if source < 0:
            yield struct.pack("<cIq", b"P", next(numbers), time_ns)
        else:
            head = taken.pack(b"T", next(numbers), source, time_ns, wants)
            yield head + row[: widths[source]].tobytes()


def follow_stream(
    words: Sequence[str],
    given: RunGiven,
    description: Description,
    limits: Limits,
    started: list[Program],
) -> Ran:
    """Process one run with a program, which is added to `started`; results before a failure are kept."""
    if given.prior is not None:  # older messages are not used
        given = given.from_time(given.prior[0])
    due, recorded = offsets_of(description, given.events)
    made = begun(results(due, recorded, sizes_of(description)), due, recorded)
    made.progress[0] = -1
    failure: Failure | None = None
    stream = Stream(words, limits)
    started.append(stream)
    try:
        stream.next(b"D", STARTS_S)
        stream.write(frames_of(given, description))
        before = len(given.static.source) + 1
        for number in range(before):
            _reply(stream.next(b"R"), number, description)
        for event in range(len(given.events.time_ns)):
            made.progress[0] = event
            mean, innovation = _reply(stream.next(b"R"), before + event, description)
            _note(made, event, given, mean, innovation)
        stream.check_end()
    except _Failed as failed:
        at = max(int(made.progress[0]), 0)
        failure = Failure(int(given.events.time_ns[at]), str(failed))
    except Ended as ended:
        failure = failure_at(int(made.progress[0]), given, description, str(ended))
    finally:
        stream.end()
    unsound = fill_squares(made.innovations)
    if unsound >= 0:
        time_ns = int(made.innovations.time_ns[unsound])
        failure = Failure(time_ns, reason_of_code(INNOVATION_UNSOUND, description))
    return Ran(followed(made, due, recorded), failure)


class _Failed(Exception):
    """Reason why the filter itself failed."""


def _reply(
    body: bytes, due: int, description: Description
) -> tuple[np.ndarray | None, tuple[np.ndarray, bool] | None]:
    """Read the reply to a frame: mean and covariance; innovation, covariance and acceptance.

    Raises Ended if the reply is to another frame or has a wrong length, and _Failed if it reports a
    failure of the filter.
    """
    n, t, m = sizes_of(description)
    number, status, flags = _REPLY.unpack_from(body) if len(body) >= _REPLY.size else (due, 0, 0xFF)
    if number != due:
        raise Ended(
            f"answered frame {number} instead of {due} (it must answer every frame exactly once)"
        )
    estimate, innovation = (n + t * t) * bool(flags & ESTIMATE), (m + m * m) * bool(flags & INNOVATION)
    wanted = _REPLY.size + 8 * (estimate + innovation)
    if len(body) != wanted:
        sizes = f"{1 + len(body)} bytes with flags {flags} instead of {1 + wanted} bytes"
        raise Ended(f"sent a reply of {sizes}")
    if status < 0 or flags > ESTIMATE | INNOVATION | REJECTED:
        raise Ended(
            f"answered with status {status} and flags {flags}, which this protocol does not define,"
        )
    if status > 0:
        raise _Failed(reason_of_code(OWN + status, description))
    numbers = np.frombuffer(body, "<f8", offset=_REPLY.size)
    state = numbers[:estimate] if estimate else None
    return state, (numbers[estimate:], not flags & REJECTED) if innovation else None


def _note(
    made: Results,
    event: int,
    given: RunGiven,
    state: np.ndarray | None,
    innovation: tuple[np.ndarray, bool] | None,
) -> None:
    """Store the results of a filter for a message."""
    events, time_ns = given.events, given.events.time_ns[event]
    if state is not None and events.wants_estimate[event]:
        row, estimates = made.estimates.end[0], made.estimates
        estimates.mean[row] = state[: estimates.mean.shape[1]]
        estimates.covariance[row].ravel()[:] = state[estimates.mean.shape[1] :]
        estimates.time_ns[row] = time_ns
        made.issued_ns[row] = events.arrival[event, 0] if events.arrival.shape[1] else time_ns
        estimates.end[0] = row + 1
    if innovation is not None and events.source[event] >= 0:
        row, innovations = made.innovations.end[0], made.innovations
        numbers, is_used = innovation
        m = innovations.difference.shape[1]
        innovations.difference[row] = numbers[:m]
        innovations.covariance[row].ravel()[:] = numbers[m:]
        innovations.numbers[row, 2] = is_used
        innovations.time_ns[row], innovations.target_id[row] = time_ns, events.target_id[event]
        innovations.end[0] = row + 1


def follow_runs_streaming(
    words: Sequence[str], runs: Sequence[RunGiven | None], description: Description, limits: Limits
) -> list[Ran | None]:
    """Process runs with programs in parallel, one per core; the result is None without input."""
    started: list[Program] = []

    def one(given: RunGiven | None) -> Ran | None:
        return None if given is None else follow_stream(words, given, description, limits, started)

    return in_threads(one, runs, started)
