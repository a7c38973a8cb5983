"""Paths of logs at URLs: shown as their URLs, and opened as copies in the user's cache or by ranges."""

import io
import logging
import os
import posixpath
import re
import sys
from collections.abc import Iterator, Sequence
from errno import EISDIR
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, cast
from urllib.parse import urlsplit

from fuselog.recorders.errors import BadInput
from fuselog.recorders.remote.backends import (
    MASK,
    Identity,
    NoRanges,
    RangeFile,
    check_unchanged,
    identity_of,
    masked,
    matches_of,
)
from fuselog.recorders.remote.copies import copy, is_copied, place_of

if sys.platform == "win32":
    from pathlib import WindowsPath as _LocalPath
else:
    from pathlib import PosixPath as _LocalPath

_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://")
# The URLs of this process by their texts, which lack passwords and keys.
_urls: dict[str, str] = {}


class RemotePath(_LocalPath):
    """The path of a log at a URL; opening it copies the log into the user's cache.

    It is shown without passwords and keys. A URL with `*` or a final `/` is a folder. The parent is the
    current folder, so outputs that would be written next to a local log are written there.

    Attributes:
        url: the URL, in one of the forms that fsspec knows.
        by_ranges: whether `open_binary` fetches only the requested bytes, without a copy.
        ends: the first and last bytes of the file with their positions, once they have been fetched;
            they suffice for the metadata and the summary of most logs.
    """

    url: str
    by_ranges: bool
    ends: list[tuple[int, bytes]]

    def __new__(cls, url: str, *_: object, **__: object) -> "RemotePath":
        """Create the path whose name and suffix are those of the file at the URL."""
        return super().__new__(cls, _named(url))

    def __init__(self, url: str, identity: Identity | None = None, *, by_ranges: bool = False) -> None:
        if sys.version_info >= (3, 12):
            super().__init__(_named(url))
        self.url, self.by_ranges, self.ends = url, by_ranges, []
        _urls[str(self)] = url
        if identity is not None:
            self.identity = identity

    def __reduce__(self) -> Any:  # another process opens the same version
        return _again, (self.url, self.__dict__.get("identity"), self.by_ranges)

    @cached_property
    def identity(self) -> Identity:
        """Ask once for the version of the file; other versions are refused later."""
        if MASK in self.url:
            raise BadInput(f"{self}: was stored without its password or key; give the complete URL")
        if self.is_dir():
            raise IsADirectoryError(EISDIR, os.strerror(EISDIR), str(self))
        return identity_of(self.url)

    def __str__(self) -> str:
        return masked(self.url)

    def __fspath__(self) -> str:
        place = self._place
        copy(self.url, self.identity, place)
        return str(place)

    @property
    def _place(self) -> Path:
        return place_of(self.url, self.identity, self.suffix)

    @property
    def has_copy(self) -> bool:
        """Test whether this version is in the cache."""
        return is_copied(self._place, self.identity)

    def __eq__(self, other: object) -> bool:
        return self.url == other.url if isinstance(other, RemotePath) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.url)

    def __truediv__(self, name: str | os.PathLike[str]) -> Path:  # type: ignore[override]
        return Path(_named(self.url), name)

    @property
    def parent(self) -> Path:  # type: ignore[override]
        """Return the current folder."""
        return Path()

    @property
    def parents(self) -> Sequence[Path]:  # type: ignore[override]
        """Return the current folder."""
        return [self.parent]

    def with_name(self, name: str) -> Path:  # type: ignore[override]
        """Return a path in the current folder."""
        return Path(name)

    def with_suffix(self, suffix: str) -> Path:  # type: ignore[override]
        """Return a path in the current folder."""
        return Path(self.stem + suffix)

    def resolve(self, strict: bool = False) -> "RemotePath":  # noqa: ARG002
        """Return the path itself."""
        return self

    def absolute(self) -> "RemotePath":
        """Return the path itself."""
        return self

    def exists(self, *, follow_symlinks: bool = True) -> bool:  # noqa: ARG002
        """Return True; opening the path tests it."""
        return True

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:  # noqa: ARG002
        """Test whether the URL has `*` or a final `/`."""
        first = self.url.partition("::")[0]
        return first.endswith("/") or "*" in first.replace(MASK, "")

    def is_file(self, *, follow_symlinks: bool = True) -> bool:  # noqa: ARG002
        """Test whether the URL names a single file."""
        return not self.is_dir()

    def iterdir(self) -> Iterator["RemotePath"]:  # type: ignore[override]
        """Yield the files in a folder."""
        return self.glob("*")

    def rglob(self, pattern: str, **options: Any) -> Iterator["RemotePath"]:  # type: ignore[override]
        """Yield the files in a folder whose names match, excluding its subfolders."""
        return self.glob(pattern, **options)

    def glob(self, pattern: str, **options: Any) -> Iterator["RemotePath"]:  # type: ignore[override] # noqa: ARG002
        """Yield the files in a folder whose names match, with one request for the list."""
        first, sign, archive = self.url.partition("::")
        asked = first if "*" in first else first + pattern
        for url in matches_of(asked + sign + archive):
            path = RemotePath(url)
            if path.match(pattern):
                yield path


def _again(url: str, identity: Identity | None, by_ranges: bool) -> RemotePath:
    return RemotePath(url, identity, by_ranges=by_ranges)


def _named(url: str) -> str:
    """Return the path of a file in its file system, with the scheme but without user and query."""
    scheme, _, rest = url.partition("::")[0].partition("://")
    if scheme.lower() in ("http", "https"):
        parts = urlsplit(f"//{rest}")
        rest = parts.netloc.rpartition("@")[2] + parts.path
    return f"{scheme}://{rest}"


def is_url(text: str) -> bool:
    """Test whether a text is a URL or the text of a `RemotePath`, not a local path."""
    return _URL.match(text) is not None


def located(name: str | Path) -> Path:
    """Return the path of a file, which may be given as a URL or as the text of a `RemotePath`."""
    if isinstance(name, Path):
        return name
    return RemotePath(_urls.get(name, name)) if is_url(name) else Path(name)


def partly(path: Path) -> Path:
    """Return a path that `open_binary` reads by ranges if it is remote."""
    return RemotePath(path.url, by_ranges=True) if isinstance(path, RemotePath) else path


def size_of(path: Path) -> int:
    """Return the size of a file in bytes."""
    stated = path.identity.size if isinstance(path, RemotePath) else None
    return path.stat().st_size if stated is None else stated


def state_of(path: Path) -> tuple[int, int, str]:
    """Return a file's size in bytes, modification time in ns, and version as the server states it.

    A remote file has no modification time, and no version if its server states none. Raises OSError or
    BadInput if the file cannot be reached.
    """
    if not isinstance(path, RemotePath):
        found = path.stat()
        return found.st_size, found.st_mtime_ns, ""
    now = path.identity
    return now.size or 0, 0, now.version if now.is_stated else ""


def reference_to(log: Path, beside: Path) -> str:
    """Return the text by which the file `beside` refers to a log: a relative path, or the URL."""
    if isinstance(log, RemotePath):
        return str(log)
    return os.path.relpath(log.resolve(), beside.resolve().parent)


def seen_from(path: Path, place: Path, log: Path) -> Path:
    """Return a path to a log to which the file `path` can refer, also after it is moved to `place`."""
    return log if isinstance(log, RemotePath) else path.parent / reference_to(log, place)


def referred_to(text: str, beside: Path) -> Path:
    """Find the log to which the file `beside` refers with a text of `reference_to`."""
    if is_url(text):
        return located(text)
    if not isinstance(beside, RemotePath):
        return (beside.parent / text).resolve()
    first, sign, archive = beside.url.partition("::")
    scheme, _, place = first.partition("?")[0].partition("://")
    return RemotePath(
        f"{scheme}://{posixpath.normpath(posixpath.join(posixpath.dirname(place), text))}{sign}{archive}"
    )


def open_binary(path: Path) -> BinaryIO:
    """Open a file for reading; a `RangeStream` if it is to be read by ranges and not yet copied."""
    if isinstance(path, RemotePath) and path.by_ranges and not path.has_copy:
        try:
            if path.identity.has_ranges:
                return cast(BinaryIO, RangeStream(path))
        except NoRanges:
            pass
        copy_whole(path, "its server cannot send parts of a file")
    return path.open("rb")


def copy_whole(path: Path, reason: str) -> None:
    """Copy a file into the cache although parts of it would suffice; warn with the reason."""
    logging.getLogger("fuselog").warning(
        "%s: all of it is fetched, %.3g MB, because %s", path, size_of(path) / 1e6, reason
    )
    os.fspath(path)


class RangeStream(io.RawIOBase):
    """A remote file as a stream; each read is a request, except near the beginning and the end.

    Raises NoRanges if the server can only send the whole file.
    """

    def __init__(self, path: RemotePath) -> None:
        self._path, self._position = path, 0
        self._size = path.identity.size or 0
        self._file = RangeFile(path.url)
        if not path.ends:
            head = min(max(self._size // 400, 1 << 9), 1 << 12, self._size)
            tail = min(max(self._size // 100, 1 << 13), 1 << 18, self._size)
            extents = (0, head), (self._size - tail, tail)
            path.ends += [(offset, self._file.read(offset, length)) for offset, length in extents]

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a position from the beginning or, with SEEK_END, from the end."""
        self._position = offset + (self._size if whence == io.SEEK_END else 0)
        return self._position

    def read(self, size: int = -1) -> bytes:
        """Fetch bytes; fewer only at the end of the file."""
        start, rest = self._position, max(self._size - self._position, 0)
        length = rest if size < 0 else min(size, rest)
        self._position += length
        for offset, data in self._path.ends:
            if offset <= start and start + length <= offset + len(data):
                return data[start - offset : start - offset + length]
        return self._file.read(start, length)

    def close(self) -> None:
        """Close the stream without a request; garbage collection, which calls this, must not wait."""
        if not self.closed:
            super().close()
            self._file.close()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Close the stream; raise BadInput if the file has changed since the path was made.

        This is not checked if the caller ends early; a generator may do so in garbage collection.
        """
        self.close()
        if not self._file.is_lost and (error is None or isinstance(error, Exception)):
            check_unchanged(self._path.url, self._path.identity)
