"""Requests to the file systems of fsspec: the version of a file, its bytes, and the files in a folder.

A request that fails is repeated a few times, then raises BadInput. Messages never contain the passwords
and keys of a URL.
"""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from uuid import uuid4

from fuselog.recorders.errors import BadInput
from fuselog.recorders.extras import extra

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

Answer = TypeVar("Answer")

# The longest silence of a server, the longest time for a range, and the pauses before repetitions.
PATIENCE_S, RANGE_S, PAUSES_S = 30.0, 300.0, (0.5, 2.0, 5.0)
_BLOCK_BYTES = 4 << 20

# The facts by which file systems distinguish versions of a file.
_VERSION = re.compile(
    "etag|content-md5|digest|last-?_?modified|mtime|updated|created|md5hash|generation|version_?id|crc|"
    "date_time|sha",
    re.IGNORECASE,
)
_USER = re.compile(r"(?<=://)[^/?#@\s]+(?=@)")
_VALUE = re.compile(r"(?<=[?&])([^=&#\s]+)=(?:(?!::)[^&#\s])+?(?=::|[&#]|[:;,.)'\"]*(?:\s|$))")
_WEB_PAGE = re.compile(rb"\s*(<\?xml[^>]*>\s*)?(<!doctype html|<html)", re.IGNORECASE)


MASK = "***"


def masked(text: str) -> str:
    """Replace users, passwords and the values of queries in the URLs of a text by `MASK`."""
    return _VALUE.sub(rf"\1={MASK}", _USER.sub(MASK, text)) if "://" in text else text


class Identity(NamedTuple):
    """The version of a remote file.

    Attributes:
        size: size in bytes; None if the server does not state it.
        version: ETag, time of modification and the like; if the server states none, a random text.
        is_stated: whether the server states the version.
        has_ranges: whether parts of the file can be requested one by one, as far as the server states
            this, and a stated version shows whether they belong together.
    """

    size: int | None
    version: str
    is_stated: bool
    has_ranges: bool

    def fits(self, later: "Identity") -> bool:
        """Test whether a later request has found the same version, as far as the server states it."""
        is_known = self.is_stated and later.is_stated
        return self.size == later.size and (self.version == later.version or not is_known)


def identity_of(url: str) -> Identity:
    """Ask for the current version of a file."""
    return _answer(url, lambda: _identity(url))


def _identity(url: str) -> Identity:
    """Ask for the version of a file and, if it is in an archive, of the archive."""
    file_system, path = _backend(url)
    from fsspec.archive import AbstractArchiveFileSystem  # `_backend` reports a missing fsspec

    file_system.invalidate_cache()
    facts = file_system.info(path)
    version = [f"{key} {facts[key]}" for key in sorted(facts) if _VERSION.fullmatch(key) and facts[key]]
    if archive := url.partition("::")[2]:
        version.append(_identity(archive).version)
    size = facts.get("size")
    is_packed = isinstance(file_system, AbstractArchiveFileSystem)
    can_seek = size is not None and not is_packed and facts.get("partial", True)
    # parts that are fetched one by one belong together only if the version can be compared
    has_ranges = can_seek and bool(version)
    return Identity(size, ", ".join(version) or uuid4().hex, bool(version), has_ranges)


def check_unchanged(url: str, identity: Identity) -> None:
    """Raise BadInput if the file has another version now."""
    if not identity.fits(identity_of(url)):
        raise BadInput(f"{masked(url)}: changed while it was read; run the command again")


def matches_of(url: str) -> list[str]:
    """List the URLs that a URL with `*` matches."""

    def answer() -> list[str]:
        file_system, pattern = _backend(url)
        file_system.invalidate_cache()
        _, sign, archive = url.partition("::")
        found = file_system.glob(pattern)
        return [f"{file_system.unstrip_protocol(str(each))}{sign}{archive}" for each in found]

    return _answer(url, answer)


class RangeFile:
    """A remote file of which only the requested bytes are fetched.

    Attributes:
        is_lost: whether a request failed after all repetitions.
    """

    def __init__(self, url: str) -> None:
        self._url, self.is_lost = url, False
        self._opened: _Opened | None = None

    def read(self, offset: int, length: int) -> bytes:
        """Fetch these bytes; raise NoRanges if the server can only send the whole file."""

        def answer() -> bytes:
            try:
                self._opened = self._opened or _open(self._url)
                self._opened.file.seek(offset)
                found = bytes(self._opened.file.read(length))
            except ValueError as error:
                raise NoRanges from error
            _check_content(self._url, found, offset)
            if len(found) != length:
                raise WrongLength(f"{len(found)} of {length} bytes arrived")
            return found

        try:
            return _answer(self._url, answer)
        except BadInput:
            self.is_lost = True
            raise

    def close(self) -> None:
        """Close the file."""
        if self._opened:
            self._opened.close()


class NoRanges(Exception):
    """An error for a server that can only send whole files."""


class WrongLength(Exception):
    """An error for an answer that is shorter or longer than the server states."""


def blocks_of(url: str, identity: Identity) -> Iterator[tuple[int, bytes]]:
    """Fetch a whole file: yield the position and the bytes of each block.

    After a failure, the file is continued at the same position, or from the beginning if the server can
    only send the whole file; in this case, the position returns to 0.
    """
    done, restarts, has_ranges = 0, 0, identity.has_ranges
    opened: _Opened | None = None

    def answer() -> bytes:
        nonlocal done, restarts, has_ranges, opened
        try:
            if opened is None:
                opened = _open(url, is_whole=not has_ranges)
                done = done if has_ranges else 0
                opened.file.seek(done)
            found = bytes(opened.file.read(_BLOCK_BYTES))
            _check_content(url, found, done)
            end = done + len(found)
            size = end if identity.size is None else identity.size
            if end > size or (not found and end < size):
                raise WrongLength(f"{end} bytes arrived instead of {size}")
            return found
        except Exception as error:
            if opened:
                opened.close()
            opened = None
            if has_ranges and isinstance(error, ValueError):
                has_ranges = False  # the server does not have range requests
            else:
                restarts += not has_ranges
            if restarts > len(PAUSES_S):  # each of them may have read a part of the file
                raise BadInput(f"{masked(url)}: {_lasting(error) or _temporary(error, url)}") from None
            raise

    try:
        while found := _answer(url, answer):
            yield done, found
            done += len(found)
    finally:
        if opened:
            opened.close()
    check_unchanged(url, identity)


class _Opened(NamedTuple):
    """An open file and its file system: an archive to which nothing refers closes its files."""

    file: Any
    file_system: "AbstractFileSystem"

    def close(self) -> None:
        """Close the file, even if its connection is lost."""
        with suppress(Exception):
            self.file.close()


def _check_content(url: str, content: bytes, offset: int) -> None:
    """Raise BadInput if a server sends a web page instead of the file."""
    if offset == 0 and _WEB_PAGE.match(content):
        raise BadInput(
            f"{masked(url)}: the server sent a web page instead of the log, perhaps because it requires "
            "a login; check the URL and the credentials"
        )


def _open(url: str, *, is_whole: bool = False) -> "_Opened":
    """Open a file at its beginning; `is_whole` requests all of it together from a web server."""
    file_system, path = _backend(url, None if is_whole else RANGE_S)
    options = {"block_size": 0} if is_whole and "http" in file_system.protocol else {}
    return _Opened(file_system.open(path, "rb", cache_type="none", **options), file_system)


def _backend(url: str, most_s: float | None = RANGE_S) -> "tuple[AbstractFileSystem, str]":
    """Find the file system of a URL, and the name of the file in it.

    Args:
        url: the URL.
        most_s: time limit of a whole request to a web server; if None, a request fails only when the
            server stays silent.
    """
    with extra("remote", masked(url)):
        import fsspec

    try:
        web = {scheme for scheme in ("http", "https") if f"{scheme}://" in url}
        return fsspec.url_to_fs(url, **{scheme: _of_web(scheme, most_s) for scheme in web})
    except ImportError as error:
        why = error if isinstance(error, ModuleNotFoundError) else error.__cause__
        missing = (getattr(why, "name", None) or "a package").partition(".")[0]
        package = "'fuselog[remote]'" if missing == "aiohttp" else missing
        raise BadInput(
            f"{masked(url)}: needs {missing}, which is not installed; run: pip install {package}"
        ) from None
    except ValueError as error:
        if "Protocol not known" not in str(error):
            raise
        raise BadInput(
            f"{masked(url)}: fsspec has no file system of this name; give a URL such as https://, s3:// "
            "or gs://"
        ) from None


def _of_web(scheme: str, most_s: float | None) -> dict[str, Any]:
    """Return the options for a web server: fuselog's own, overridden by the user's configuration."""
    from aiohttp import ClientTimeout
    from fsspec.config import conf

    stated = conf.get(scheme, {})
    timeout = ClientTimeout(total=most_s, sock_connect=PATIENCE_S, sock_read=PATIENCE_S)
    return {
        "client_kwargs": {"timeout": timeout, "trust_env": True, **stated.get("client_kwargs", {})},
        "headers": {"Accept-Encoding": "identity", **stated.get("headers", {})},
    }


def _answer(url: str, action: Callable[[], Answer]) -> Answer:
    """Call a function that makes requests; repeat it if it fails for a reason that may be temporary."""
    for pause_s in (*PAUSES_S, None):
        try:
            return action()
        except (BadInput, NoRanges):
            raise
        except Exception as error:  # every file system has its own kinds
            reason = _lasting(error)
            if reason is None and pause_s is None:
                reason = _temporary(error, url)
            if reason is not None:
                raise BadInput(f"{masked(url)}: {reason}") from None
            time.sleep(pause_s or 0.0)
    raise AssertionError


def _lasting(error: BaseException) -> str | None:
    """Describe an error that a repetition would not change; otherwise return None."""
    chain = list(_causes(error))
    statuses = {getattr(each, "status", None) for each in chain}
    if statuses & {401, 403, 407} or any(
        isinstance(each, PermissionError) or "Credentials" in type(each).__name__ for each in chain
    ):
        return (
            "access refused; check the credentials, which fsspec reads from the environment or its "
            "configuration"
        )
    # fsspec raises FileNotFoundError for every error of a web server
    is_missing = isinstance(error, FileNotFoundError) and not any(map(_is_of_web, chain))
    if statuses & {404, 410} or is_missing:
        return "not found; check the URL"
    return None


def _temporary(error: BaseException, url: str) -> str:
    """Describe an error that remained after all repetitions, without the secrets of a URL."""
    tried = f"{len(PAUSES_S) + 1} times"
    *_, cause = _causes(error)
    if isinstance(cause, TimeoutError):
        return f"no answer within {PATIENCE_S:g} s, {tried}; check the network, or try again later"
    status = getattr(cause, "status", None)
    text = f"status {status}" if status else type(cause).__name__
    if not status and masked(url) == url:
        text = f"{text}: {cause}" if str(cause) else text
    return f"the request failed {tried} ({text}); check the URL and the network, or try again later"


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the errors that caused it."""
    while error is not None:
        yield error
        error = error.__cause__


def _is_of_web(error: BaseException) -> bool:
    """Test whether an error is one of a web server or of the connection to it."""
    of_client = type(error).__module__.startswith("aiohttp")
    return isinstance(error, TimeoutError | ConnectionError) or of_client
