"""The server of the page, on the loopback interface at a secret address.

Requests without the token in the address are refused, and so are requests with another host name or
origin. The WebSocket requires the origin of the page. The server ends when the last page is closed.
"""

import asyncio
import atexit
import logging
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hmac import compare_digest
from threading import Event, Thread
from typing import Any

from bokeh.application import Application
from bokeh.application.application import SessionContext
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.web import Application as Handlers
from tornado.web import RequestHandler

from fuselog.pipeline.exploring.page import Page
from fuselog.pipeline.exploring.session import Session
from fuselog.pipeline.exploring.widgets import NAME_SLIDERS
from fuselog.recorders.errors import printable

LOOPBACK = "127.0.0.1"
TEMPLATE = """
{% block preamble %}
<meta name="referrer" content="no-referrer">
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
  body { font: 14px/1.4 Inter, system-ui, sans-serif; margin: 16px; color: #1c1f24; }
  @media (prefers-color-scheme: dark) {
    html { background: #121417; }
    body { filter: invert(.93) hue-rotate(180deg); }
  }
</style>
{% endblock %}
{% block postamble %}
<script>
"""
TEMPLATE += NAME_SLIDERS + "</script>{% endblock %}"
# time in ms until the server ends after a page is closed; a reloaded page returns earlier
CLOSED_MS = 3000

# Loggers that report invalid requests with their address.
_LOGGERS = ("asyncio", "bokeh", "tornado")
_LONGEST = 300


class Explorer:
    """A server of pages.

    Attributes:
        session: the session that the pages show.
        url: its address, which can be reached only from this machine.
    """

    def __init__(self, session: Session) -> None:
        """Serve pages on a free port of the loopback interface, in a separate thread."""
        self.session = session
        self._token = secrets.token_urlsafe(24)
        self._pages: dict[str, Page] = {}
        self._is_up, self._is_ended = Event(), Event()
        self._stop: Callable[[], None] = lambda: None
        self.url = ""
        self._thread = Thread(target=self._serve, name="fuselog explore, server", daemon=True)
        self._thread.start()
        self._is_up.wait()
        # Python up to 3.13 kills daemon threads at exit, which can abort the process
        atexit.register(self.close)

    def close(self) -> None:
        """Stop the server and its work."""
        atexit.unregister(self.close)
        self._stop()
        self._thread.join(timeout=5.0)

    def wait(self) -> None:
        """Wait until the last page is closed; an interrupt closes all pages."""
        try:
            self._is_ended.wait()
        finally:
            self.close()

    def _repr_html_(self) -> str:
        """Return the page for a notebook's cell."""
        return f'<iframe src="{self.url}" width="100%" height="900" style="border:0"></iframe>'

    def _serve(self) -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        loop = IOLoop.current()
        application = Application(FunctionHandler(self._fill))
        server = Server(
            {"/": application},
            io_loop=loop,
            address=LOOPBACK,
            port=0,
            prefix=f"/{self._token}",
            allow_websocket_origin=["localhost:0"],
            check_unused_sessions_milliseconds=1000,
            unused_session_lifetime_milliseconds=CLOSED_MS,
            use_index=False,
            extra_patterns=[],
        )
        origin = f"{LOOPBACK}:{server.port}"
        server._tornado.websocket_origins.clear()
        server._tornado.websocket_origins.add(origin)
        _guard(server._tornado, origin, f"/{self._token}")
        self.url = f"http://{origin}/{self._token}/"
        self._stop = lambda: loop.add_callback(loop.stop)
        server.start()
        self._is_up.set()
        try:
            with _quiet(self._token):
                loop.start()
        finally:
            for page in self._pages.values():
                page.end()
            server.stop()
            self._is_ended.set()

    def _fill(self, document: Document) -> None:
        document.template = TEMPLATE
        identity = secrets.token_hex(8)
        self._pages[identity] = Page(self.session, document)

        def closed(_: SessionContext) -> None:
            self._pages.pop(identity).end()
            if not self._pages:
                self._stop()

        document.on_session_destroyed(closed)


class _Refused(RequestHandler):
    """A request handler that refuses requests from outside the page."""

    def initialize(self, code: int) -> None:
        """Store the HTTP code of the answer."""
        self._code = code

    def prepare(self) -> None:
        """Send the answer before any method is called."""
        self.send_error(self._code)

    def log_exception(self, *_: Any) -> None:
        """Log nothing, because refused requests may be frequent."""


def _guard(application: Handlers, origin: str, prefix: str) -> None:
    """Restrict an application to requests for the printed address of its page."""
    find = application.find_handler

    def find_own(request: HTTPServerRequest, **given: Any) -> Any:
        code = _code_of(request, origin, prefix)
        if code is None:
            return find(request, **given)
        return application.get_handler_delegate(request, _Refused, {"code": code})

    application.find_handler = find_own  # type: ignore[method-assign]
    application.settings["log_function"] = lambda _: None


def _code_of(request: HTTPServerRequest, origin: str, prefix: str) -> int | None:
    """Return the HTTP code for a request to refuse, or None.

    The code is 404 for a request without the secret, and 403 for one from another host or origin.
    """
    path = (request.path or "").encode()
    begin = f"{prefix}/".encode()
    if not compare_digest(path[: len(begin)], begin):
        return 404
    stated = request.headers.get_list("Origin")
    needed = "websocket" in request.headers.get("Upgrade", "").lower()
    is_own = stated == [f"http://{origin}"] or not (stated or needed)
    return None if request.headers.get_list("Host") == [origin] and is_own else 403


class _OneLineAKind(logging.Handler):
    """A logging handler that emits one line per kind of error, without the secret."""

    def __init__(self, secret: str) -> None:
        super().__init__(logging.WARNING)
        self._secret = secret
        self._said: set[object] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Log an error unless a similar one was logged before."""
        error = record.exc_info[1] if record.exc_info else None
        kind = (record.name, type(error), None if error else record.msg)
        if kind not in self._said:
            self._said.add(kind)
            text = f"{type(error).__name__}: {error}" if error else record.getMessage()
            line = printable(text.replace(self._secret, "...").replace("\n", " "))
            logging.getLogger("fuselog").warning("explore: a request failed: %s", line[:_LONGEST])


@contextmanager
def _quiet(secret: str) -> Iterator[None]:
    """Reduce the log messages of the server's libraries to one line per kind of error."""
    handler = _OneLineAKind(secret)
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(each, each.handlers, each.propagate) for each in loggers]
    for each in loggers:
        each.handlers, each.propagate = [handler], False
    try:
        yield
    finally:
        for each, handlers, propagate in before:
            each.handlers, each.propagate = handlers, propagate
