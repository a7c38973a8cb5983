"""The user's cache of results that can be computed again; damaged or foreign files are not used.

The first line of a file has the SHA-256 of the content and the name of its maker; the content follows.
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

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.environment import cache_folder as cache_folder
from fuselog.recorders.errors import CannotWrite

_OTHERS_MAY_WRITE = 0o022
# Every cached result is made in less time, even on a slow and busy machine.
_TURN_S = 120.0


def is_private(folder: Path) -> bool:
    """Test whether only this user can have written to a folder of the cache; warn if not.

    A missing folder is private, since `write_checked` creates it as such. The parent folder may belong
    to root and be writable for others if it is sticky, like /tmp, because other users can then not move
    its entries.
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
                f"the cache {place} is not used: another user owns it; set FUSELOG_CACHE to a folder of "
                "your own"
            )
        else:
            say_once(f"the cache {place} is not used: other users may write to it; run chmod go-w on it")
        return False
    return True


def is_own(status: os.stat_result) -> bool:
    """Test whether a file or folder belongs to this user, and other users may not write to it.

    The result is True on systems without user ids (Windows), which separate the folders of users.
    """
    return _user() is None or (status.st_uid == _user() and not status.st_mode & _OTHERS_MAY_WRITE)


def _user() -> int | None:
    return os.getuid() if hasattr(os, "getuid") else None


@cache
def say_once(sentence: str) -> None:
    """Log a warning once per process, however often its cause occurs."""
    logging.getLogger("fuselog").warning(sentence)


def kept_files() -> Iterator[Path]:
    """Yield the files in this user's cache that fuselog wrote and that are intact."""
    for path in sorted(cache_folder().glob("*/*.bin")):
        ours = not path.is_symlink() and is_private(path.parent)
        if ours and read_checked(path) is not None:
            yield path


def read_own(path: Path) -> bytes | None:
    """Read a file as `read_checked` does; also return None if others may have written the file."""
    try:
        with path.open("rb") as file:
            return _content(file.read()) if is_own(os.fstat(file.fileno())) else None
    except OSError:
        return None


def read_checked(source: Path | Traversable) -> bytes | None:
    """Read the content that `write_checked` wrote; return None if the file is damaged or missing."""
    try:
        return _content(source.read_bytes())
    except OSError:
        return None


def _content(written: bytes) -> bytes | None:
    header, _, content = written.partition(b"\n")
    return content if header.startswith(_digest(content)) else None


def write_checked(path: Path, content: bytes, made_by: str) -> None:
    """Write a private file, which appears completely or not at all, in private folders.

    Raises CannotWrite, with a message that begins with the path, if the file cannot be written.
    """
    try:
        _make_private(path.parent)
    except OSError as error:
        raise CannotWrite(f"{path}: cannot be written ({error.strerror})") from error
    with whole_file(path, parents=False) as new:
        new.write_bytes(_digest(content) + f" {made_by}\n".encode() + content)
        new.chmod(0o600)


@contextmanager
def in_turn(path: Path) -> Iterator[bool]:
    """Wait while another process makes this file; yield whether it waited, as the file may exist now.

    The system releases the lock if the process ends. If a process keeps the lock for very long, or the
    disk does not support locks, two processes make the file, which is harmless.
    """
    from filelock import FileLock, Timeout  # slow to import

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
            with suppress(OSError):  # the file exists, so the lock is no longer needed
                Path(lock.lock_file).unlink()
            lock.release()


def _make_private(folder: Path) -> None:
    """Make a folder and its missing parents, accessible only to this user."""
    if not folder.exists():
        _make_private(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)


def _digest(content: bytes) -> bytes:
    return sha256(content).hexdigest().encode()
