"""Lets no request in but those of the page itself, and keeps what requests say off the terminal."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from hmac import compare_digest
from typing import Any

from tornado.httputil import HTTPServerRequest
from tornado.web import Application, RequestHandler

from recorders.errors import printable

# Whose loggers say what a request did wrong, with its address.
_LOGGERS = ("asyncio", "bokeh", "tornado")
_LONGEST = 300


class _Refused(RequestHandler):
    """Answers a request that is not the page's own."""

    def initialize(self, code: int) -> None:
        """Keep the code of the answer."""
        self._code = code

    def prepare(self) -> None:
        """Answer before any method is called."""
        self.send_error(self._code)

    def log_exception(self, *_: Any) -> None:
        """Say nothing: who is refused may ask very often."""


def guard(application: Application, origin: str, prefix: str) -> None:
    """Have an application answer only what is asked by the address that its page was printed with.

    Args:
        application: Tornado's, of a server that runs on the loopback interface.
        origin: the host and port of that address.
        prefix: the part of its path that is secret, with the slash before it.
    """
    find = application.find_handler

    def find_own(request: HTTPServerRequest, **given: Any) -> Any:
        code = _code_of(request, origin, prefix)
        if code is None:
            return find(request, **given)
        return application.get_handler_delegate(request, _Refused, {"code": code})

    application.find_handler = find_own  # type: ignore[method-assign]
    application.settings["log_function"] = lambda _: None


def _code_of(request: HTTPServerRequest, origin: str, prefix: str) -> int | None:
    """Return why a request is refused: 404 without the secret, 403 from elsewhere; None if it is not."""
    path = (request.path or "").encode()
    begin = f"{prefix}/".encode()
    if not compare_digest(path[: len(begin)], begin):
        return 404
    stated = request.headers.get_list("Origin")
    needed = "websocket" in request.headers.get("Upgrade", "").lower()
    is_own = stated == [f"http://{origin}"] or not (stated or needed)
    return None if request.headers.get_list("Host") == [origin] and is_own else 403


class _OneLineAKind(logging.Handler):
    """Says one line for each kind of fault, without the secret."""

    def __init__(self, secret: str) -> None:
        super().__init__(logging.WARNING)
        self._secret = secret
        self._said: set[object] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Say what is wrong unless its like was said before."""
        error = record.exc_info[1] if record.exc_info else None
        kind = (record.name, type(error), None if error else record.msg)
        if kind not in self._said:
            self._said.add(kind)
            text = f"{type(error).__name__}: {error}" if error else record.getMessage()
            line = printable(text.replace(self._secret, "...").replace("\n", " "))
            logging.getLogger("fuselog").warning("explore: a request failed: %s", line[:_LONGEST])


@contextmanager
def quiet(secret: str) -> Iterator[None]:
    """Reduce what the server's libraries log meanwhile to one line for each kind of fault."""
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
