"""A web server on loopback, with range requests and with the faults of real servers."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

LOGIN = b"<!DOCTYPE html><html><title>Sign in</title></html>"


class Site:
    """A folder that is served, and how.

    Attributes:
        url: the address of the folder.
        folder: the files.
        ranges: whether parts can be requested.
        versions: whether the ETag is stated.
        spared: how many of the next answers are whole, although `cuts` is set.
        cuts: how many answers end in the middle.
        stated_bytes: what HEAD adds to the size.
        silent_s: how long every answer takes.
        status: the status of every answer; None for the right one.
        login: whether every answer is a page that asks for a password.
        sent: the bytes that were sent so far.
        asked: the requests so far.
    """

    def __init__(self, folder: Path, url: str) -> None:
        self.folder, self.url = folder, url
        self.ranges = self.versions = True
        self.spared = self.cuts = self.stated_bytes = self.sent = 0
        self.silent_s, self.login = 0.0, False
        self.status: int | None = None
        self.asked: list[str] = []


class _Answer(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, site: Site, *arguments: object) -> None:
        self.site = site
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def _answer(self) -> None:
        site = self.site
        place = site.folder / self.path.partition("?")[0].lstrip("/")
        site.asked.append(f"{self.command} {self.path} {self.headers.get('Range', '')}".rstrip())
        time.sleep(site.silent_s)
        if site.status or not place.exists():
            self.send_response(site.status or 404)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        if place.is_dir():
            data = "".join(f'<a href="{each.name}">.</a>' for each in place.iterdir()).encode()
        else:
            data = LOGIN if site.login else place.read_bytes()
        part, is_head = data, self.command == "HEAD"
        if (asked := self.headers.get("Range")) and site.ranges:
            first, last = map(int, asked.removeprefix("bytes=").split("-"))
            part = data[first : last + 1]
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{first + len(part) - 1}/{len(data)}")
        else:
            self.send_response(200)
        if site.versions and not place.is_dir():
            self.send_header("ETag", f'"{place.stat().st_mtime_ns}"')
        self.send_header("Content-Length", str(len(part) + (site.stated_bytes if is_head else 0)))
        self.end_headers()
        if is_head:
            return
        if site.spared:
            site.spared -= 1
        elif site.cuts:
            site.cuts -= 1
            part = part[: len(part) // 2]
            self.close_connection = True
        site.sent += len(part)
        self.wfile.write(part)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


class _Server(ThreadingHTTPServer):
    def handle_error(self, *_: object) -> None:
        """Ignore that a client did not wait."""


@contextmanager
def served(folder: Path) -> Iterator[Site]:
    """Serve a folder."""
    site = Site(folder, "")
    with _Server(("127.0.0.1", 0), partial(_Answer, site)) as server:
        server.daemon_threads = True
        site.url = f"http://127.0.0.1:{server.server_address[1]}"
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield site
        finally:
            server.shutdown()
            thread.join()
