"""Where a timeline goes: a file, a live viewer, or both from one pass.

A file appears under its name only when it is whole. A live receiver is asked before anything is sent,
because Rerun itself waits many seconds for one that is not there, and forever for one that is silent.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from recorders.errors import BadInput

# The first bytes of an HTTP/2 client: its preface and empty settings. A server answers with its own.
_HTTP2_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
_SETTINGS = 4
_ANSWER_S = 2.0
_FLUSH_S = 60.0


@contextmanager
def open_recording(
    application_id: str, recording_id: str, *, save: Path | None = None, connect: str | None = None
) -> Iterator[rr.RecordingStream]:
    """Open a recording whose rows carry no clock of this machine: the same input is the same content.

    Args:
        application_id: what the viewer keeps one layout for.
        recording_id: recordings of one id are one recording to a viewer.
        save: the .rrd file to write; `SAVE.part` until it is whole.
        connect: a receiver, `rerun+http://HOST:PORT/proxy`.

    Raises BadInput where neither is given, the file cannot be written, or the receiver is not there or
    goes away.
    """
    sinks: list[rr.GrpcSink | rr.FileSink] = []
    if connect is not None:
        _require_receiver(connect)
        sinks.append(rr.GrpcSink(connect))
    part = None
    if save is not None:
        part = save.with_name(save.name + ".part")
        _require_writable(part)
        sinks.append(rr.FileSink(part))
    if not sinks:
        raise BadInput("a timeline needs a place to go: give --save FILE.rrd, --connect URL, or both")
    recording = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
    try:
        recording.set_sinks(*sinks)
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        yield recording
        _finish(recording, connect)
        if part is not None and save is not None:
            part.replace(save)
    finally:
        recording.disconnect()
        if part is not None:
            part.unlink(missing_ok=True)


def _finish(recording: rr.RecordingStream, connect: str | None) -> None:
    """Hand over everything that is still queued, and close."""
    try:
        recording.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:
        raise BadInput(f"--connect {connect}: the receiver went away; start it again") from error
    recording.disconnect()


def _require_writable(part: Path) -> None:
    try:
        part.touch()
    except OSError as error:
        raise BadInput(
            f"{part}: cannot be written ({error.strerror}); --save a file in a folder that exists"
        ) from None


def _require_receiver(url: str) -> None:
    """Raises BadInput unless an HTTP/2 server, as Rerun's receivers are, answers there."""
    try:
        parts = urlsplit(url)
        address = (parts.hostname, parts.port)
    except ValueError:
        parts, address = urlsplit(""), (None, None)
    host, port = address
    if parts.scheme != "rerun+http" or parts.path != "/proxy" or host is None or port is None:
        raise BadInput(
            f"--connect {url}: expected rerun+http://HOST:PORT/proxy, as a running Rerun viewer shows it"
        )
    try:
        with socket.create_connection((host, port), timeout=_ANSWER_S) as connection:
            connection.sendall(_HTTP2_GREETING)
            answer = connection.recv(9)
    except OSError:
        answer = b""
    if len(answer) < 4 or answer[3] != _SETTINGS:
        raise BadInput(
            f"--connect {url}: no Rerun receiver answers there; start one: rerun --port {port}"
        )
