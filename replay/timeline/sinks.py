"""Sinks of a timeline and of its layout: a file or a live viewer.

A file appears under its name only when it is complete. Rerun encodes the file in memory, and fuselog
writes it, because Rerun's own writer does not report a full disk at the end and may wait forever. A live
receiver is contacted before data is sent, because Rerun itself waits many seconds for a missing
receiver, and forever for a receiver that does not answer.
"""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Self
from urllib.parse import urlsplit

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.api import create_in_memory_blueprint
from rerun.blueprint.table import TableBlueprint

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput

# The first bytes of an HTTP/2 client: its preface and empty settings. A server answers with its own.
_HTTP2_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
_SETTINGS = 4
_ANSWER_S = 2.0
_FLUSH_S = 60.0
_GIVEN_UP_S = 2.0


class TableLayout(TableBlueprint):
    """The layout of a table of segments, of the same interface as that of a segment."""

    def to_blueprint(self) -> Self:
        """Return itself."""
        return self


@contextmanager
def open_recording(
    application_id: str, recording_id: str, *, save: Path | None = None, connect: str | None = None
) -> Iterator[rr.RecordingStream]:
    """Open a recording that does not contain clocks of this machine, so that it is reproducible.

    Args:
        application_id: identifier under which the viewer stores a layout.
        recording_id: identifier of the recording; a viewer merges recordings with the same identifier.
        save: the .rrd file to write, in a folder that exists.
        connect: receiver to use instead of a file, `rerun+http://HOST:PORT/proxy`.

    Raises BadInput if neither `save` nor `connect` is given, if the file cannot be written, or if the
    receiver is missing or is lost; no file is left in these cases.
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
            try:
                yield recording
            finally:  # Rerun warns of what is not read
                contents = encoded.read() or b""
            new.write_bytes(contents)


def write_layout(path: Path, application_id: str, layout: rrb.Blueprint | TableLayout) -> None:
    """Write a layout to an .rbl file; raises OSError if that fails."""
    kept = create_in_memory_blueprint(
        application_id=application_id,
        blueprint=layout,  # type: ignore[arg-type]
    )
    path.write_bytes(kept.drain_as_bytes())


def rerun_path(path: Path) -> str:
    """Return the name of a file in the form that Rerun reads as UTF-8 in any locale.

    Raises BadInput if the name is not UTF-8.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise BadInput(f"{path}: Rerun opens only files whose names are UTF-8; rename it") from None


def _finish(recording: rr.RecordingStream, connect: str) -> None:
    """Send all queued data, and close."""
    failure: Exception | None = None
    try:
        recording.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:
        failure = error
    is_closed = _close(recording, _FLUSH_S if failure is None else _GIVEN_UP_S)
    if not _answers(connect):  # a flush does not always report this
        raise BadInput(
            f"--connect {connect}: the connection to the receiver was lost; start it again"
        ) from failure
    if failure is not None or not is_closed:
        why = failure or "Rerun did not end"
        raise BadInput(f"{connect}: the timeline could not be sent ({why})") from failure


def _close(recording: rr.RecordingStream, limit_s: float) -> bool:
    """Disconnect, and test whether this succeeded; Rerun may wait forever if a receiver is silent."""
    closing = threading.Thread(target=recording.disconnect, daemon=True)
    closing.start()
    closing.join(limit_s)
    return not closing.is_alive()


def _require_receiver(url: str) -> None:
    """Raise BadInput unless a receiver answers at the URL."""
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
    """Return host and port of the URL of a receiver; None if it is not a valid URL."""
    try:
        parts = urlsplit(url)
        is_receiver = parts.scheme == "rerun+http" and parts.path == "/proxy"
        return (parts.hostname, parts.port) if is_receiver else (None, None)
    except ValueError:
        return None, None


def _answers(url: str) -> bool:
    """Test whether an HTTP/2 server, such as a Rerun receiver, answers."""
    try:
        with socket.create_connection(_address(url), timeout=_ANSWER_S) as connection:
            connection.sendall(_HTTP2_GREETING)
            answer = connection.recv(9)
    except OSError:
        return False
    return len(answer) > 3 and answer[3] == _SETTINGS
