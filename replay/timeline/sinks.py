"""Sends a timeline to a file, or to a live viewer.

A file appears under its name only when it is whole. Rerun encodes it into memory, and it is written from
here: Rerun's own writer of files tells nobody of a disk that is full as it ends, and may wait forever.
A live receiver is asked before anything is sent, because Rerun itself waits many seconds for one that is
not there, and forever for one that is silent.
"""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput

# The first bytes of an HTTP/2 client: its preface and empty settings. A server answers with its own.
_HTTP2_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
_SETTINGS = 4
_ANSWER_S = 2.0
_FLUSH_S = 60.0
_GIVEN_UP_S = 2.0


@contextmanager
def open_recording(
    application_id: str, recording_id: str, *, save: Path | None = None, connect: str | None = None
) -> Iterator[rr.RecordingStream]:
    """Open a recording whose rows carry no clock of this machine: the same input is the same content.

    Args:
        application_id: what the viewer keeps one layout for.
        recording_id: recordings of one id are one recording to a viewer.
        save: the .rrd file to write, in a folder that exists.
        connect: in place of a file a receiver, `rerun+http://HOST:PORT/proxy`.

    Raises BadInput where neither is given, the file cannot be written, or the receiver is not there or
    goes away; then no file is left.
    """
    if connect is not None:
        _require_receiver(connect)
    elif save is None:
        raise BadInput("a timeline needs a destination: give --save FILE.rrd, --connect URL, or both")
    with ExitStack() as stack:
        recording = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
        stack.callback(_close, recording, _GIVEN_UP_S)
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        if connect is not None:
            recording.set_sinks(rr.GrpcSink(connect))
            yield recording
            _finish(recording, connect)
        elif save is not None:
            new = stack.enter_context(whole_file(save, parents=False))
            encoded = rr.binary_stream(recording)
            yield recording
            new.write_bytes(encoded.read() or b"")


def rerun_path(path: Path) -> str:
    """Return a file's name where Rerun takes it as UTF-8, whatever the locale is.

    Raises BadInput where the name is not UTF-8.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise BadInput(f"{path}: Rerun opens only files whose names are UTF-8; rename it") from None


def _finish(recording: rr.RecordingStream, connect: str) -> None:
    """Hand over everything that is still queued, and close."""
    failure: Exception | None = None
    try:
        recording.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:
        failure = error
    is_closed = _close(recording, _FLUSH_S if failure is None else _GIVEN_UP_S)
    if not _answers(connect):  # which a flush does not always notice
        raise BadInput(
            f"--connect {connect}: the connection to the receiver was lost; start it again"
        ) from failure
    if failure is not None or not is_closed:
        why = failure or "Rerun does not end"
        raise BadInput(f"{connect}: the timeline could not be sent ({why})") from failure


def _close(recording: rr.RecordingStream, limit_s: float) -> bool:
    """Disconnect, and tell whether that ended: with a silent receiver, Rerun may wait forever."""
    closing = threading.Thread(target=recording.disconnect, daemon=True)
    closing.start()
    closing.join(limit_s)
    return not closing.is_alive()


def _require_receiver(url: str) -> None:
    """Raise BadInput unless a receiver answers there."""
    host, port = _address(url)
    if host is None or port is None:
        raise BadInput(
            f"--connect {url}: expected rerun+http://HOST:PORT/proxy, as a running Rerun viewer shows it"
        )
    if not _answers(url):
        raise BadInput(
            f"--connect {url}: no Rerun receiver answers there; start one: rerun --port {port}"
        )


def _address(url: str) -> tuple[str | None, int | None]:
    """Host and port; None where the URL is not that of a receiver."""
    try:
        parts = urlsplit(url)
        is_receiver = parts.scheme == "rerun+http" and parts.path == "/proxy"
        return (parts.hostname, parts.port) if is_receiver else (None, None)
    except ValueError:
        return None, None


def _answers(url: str) -> bool:
    """Tell whether an HTTP/2 server, as Rerun's receivers are, greets back."""
    try:
        with socket.create_connection(_address(url), timeout=_ANSWER_S) as connection:
            connection.sendall(_HTTP2_GREETING)
            answer = connection.recv(9)
    except OSError:
        return False
    return len(answer) > 3 and answer[3] == _SETTINGS
