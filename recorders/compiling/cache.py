"""Keeps results that can be computed again in the user's cache; damaged or foreign files are not used.

A file is one line of text, which begins with the SHA-256 of all that follows it and says what made the
file, and then the content.
"""

import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from importlib.resources.abc import Traversable
from pathlib import Path

from filelock import FileLock, Timeout

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.environment import cache_folder as cache_folder
from fuselog.recorders.errors import BadInput

_OTHERS_MAY_WRITE = 0o022
# Nothing that is kept takes longer to make, on a slow and busy machine.
_TURN_S = 120.0


def is_private(folder: Path) -> bool:
    """Tell whether only this user can have written to a folder of the cache; reports why not.

    A folder that is not there yet is private: `write_checked` makes it so. Of the folder that it lies in
    others may be owners or writers where that is sticky, as /tmp is: nobody else moves an entry away.
    """
    for place in (folder.parent, folder):
        try:
            status = place.stat()
        except OSError:
            continue
        sticky = place != folder and status.st_mode & stat.S_ISVTX and status.st_uid in (0, _user())
        if sticky or is_own(status):
            continue
        if status.st_uid != _user():
            say_once(
                f"the cache {place} is not used: another user owns it; set FUSELOG_CACHE to your own"
            )
        else:
            say_once(
                f"the cache {place} is not used: other users may write to it; chmod go-w forbids them"
            )
        return False
    return True


def is_own(status: os.stat_result) -> bool:
    """Tell whether a file or folder is this user's, and nobody else may write to it.

    Systems without user numbers (Windows) keep a user's folders apart by themselves.
    """
    return _user() is None or (status.st_uid == _user() and not status.st_mode & _OTHERS_MAY_WRITE)


def _user() -> int | None:
    return os.getuid() if hasattr(os, "getuid") else None


@cache
def say_once(sentence: str) -> None:
    """Return a warning that one process gives once, however often its cause is met."""
    logging.getLogger("fuselog").warning(sentence)


def kept_files() -> Iterator[Path]:
    """Return the files in this user's cache that fuselog wrote, and that are as it wrote them."""
    for path in sorted(cache_folder().glob("*/*.bin")):
        ours = not path.is_symlink() and is_private(path.parent)
        if ours and read_checked(path) is not None:
            yield path


def read_own(path: Path) -> bytes | None:
    """Read as `read_checked`; None too where others may have written the file, whatever its folder."""
    try:
        with path.open("rb") as file:
            return _content(file.read()) if is_own(os.fstat(file.fileno())) else None
    except OSError:
        return None


def read_checked(source: Path | Traversable) -> bytes | None:
    """Return the content that `write_checked` wrote, or None where the file is damaged or not there."""
    try:
        return _content(source.read_bytes())
    except OSError:
        return None


def _content(written: bytes) -> bytes | None:
    header, _, content = written.partition(b"\n")
    return content if header.startswith(_digest(content)) else None


def write_checked(path: Path, content: bytes, made_by: str) -> None:
    """Write a file for this user alone, which appears whole or not at all, in folders of such.

    Raises BadInput, which begins with the path, where that cannot be done.
    """
    try:
        _make_private(path.parent)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror})") from error
    with whole_file(path, parents=False) as new:
        new.write_bytes(_digest(content) + f" {made_by}\n".encode() + content)
        new.chmod(0o600)


@contextmanager
def in_turn(path: Path) -> Iterator[bool]:
    """Wait until no other process makes this file; whether there was one, so that it may be there now.

    The lock goes with the process that holds it, however that ends. One that keeps it for very long, and
    a disk that cannot lock, keep nobody from the work: it is done twice then, which harms nothing.
    """
    lock = FileLock(path.with_suffix(".lock"), timeout=0)
    waited = False
    try:
        _make_private(path.parent)
        try:
            lock.acquire()
        except Timeout:
            waited = True
            lock.acquire(timeout=_TURN_S)
    except (OSError, NotImplementedError):  # Timeout too
        pass
    try:
        yield waited
    finally:
        if lock.is_locked:
            with suppress(OSError):  # the file is there: nobody needs the lock any more
                Path(lock.lock_file).unlink()
            lock.release()


def _make_private(folder: Path) -> None:
    """Make a folder and those that it lies in, where they are not there, for this user alone."""
    if not folder.exists():
        _make_private(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)


def _digest(content: bytes) -> bytes:
    return sha256(content).hexdigest().encode()
