"""Files and folders that are written completely or not at all.

While something is being written, it is in a working folder next to its destination:

    .NAME.RANDOM.part/     created exclusively, accessible only to this user
        fuselog.lock       locked by the writer; the system releases the lock if the writer is killed
        new.SUFFIX         the file or folder being written, renamed to NAME when it is complete
        old                the folder that NAME replaces, between the two renames

Two writers of one destination never touch each other's working folder. The next writer removes the
leftovers of a killed writer, but only if the lock is free and the folder contains nothing else.
"""

import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING

from fuselog.recorders.errors import BadInput, CannotWrite

if TYPE_CHECKING:
    from filelock import FileLock

_LOCK, _NEW, _OLD = "fuselog.lock", "new", "old"
_LOG = logging.getLogger(__name__)


def settled(place: Path) -> Path:
    """Resolve `..` in a path as if its missing folders already existed.

    `MISSING/../FILE` is the same file as FILE, but the operating system cannot find it before MISSING
    exists. If the path itself is a link, the link is not followed.
    """
    if place.name in ("", ".."):  # `.` has an empty name
        return Path(os.path.realpath(place))
    return Path(os.path.realpath(place.parent), place.name) if ".." in place.parts else place


@contextmanager
def whole_file(place: Path, *, parents: bool = True) -> Iterator[Path]:
    """Yield a path to write to; if no exception occurs, the new file replaces `place` in one step.

    Args:
        place: destination of the file.
        parents: whether missing folders are created.

    Raises BadInput if the file cannot be written.
    """
    named, place = place, settled(place) if parents else place
    clear_leftovers(place)
    with parents_of(named, make=parents), _working_folder(place) as work, _telling(place, work):
        new = work / (_NEW + place.suffix)
        yield new
        with new.open("rb+") as file:
            os.fsync(file.fileno())
        new.replace(place)


@contextmanager
def whole_folder(place: Path, check: Callable[[Path], None]) -> Iterator[Path]:
    """Yield a folder to fill; if no exception occurs, it replaces `place`.

    `check` gets the folder that would be replaced, before anything is written and again after it has
    been moved aside. If `check` raises an exception, the folder stays.

    Raises BadInput if the folder cannot be written, or another process is writing it.
    """
    named, place = place, settled(place)
    if clear_leftovers(place):
        raise BadInput(
            f"{place}: another fuselog command is writing it; wait until it ends, or give another --out"
        )
    if place.exists():
        check(place)
    with parents_of(named, make=True), _working_folder(place) as work, _telling(place, work):
        new, old = work / _NEW, work / _OLD
        new.mkdir()
        yield new
        if place.exists():
            place.rename(old)
            check(old)
        new.rename(place)


@contextmanager
def scratch_folder(name: str) -> Iterator[Path]:
    """Yield a private temporary folder that is removed at the end.

    Raises BadInput if the folder cannot be created.
    """
    place = Path(tempfile.gettempdir()) / name
    clear_leftovers(place)
    with _working_folder(place) as work:
        new = work / _NEW
        new.mkdir(mode=0o700)
        yield new


@contextmanager
def _working_folder(place: Path) -> Iterator[Path]:
    with _telling(place):
        work, lock = _make(place)
    try:
        yield work
    finally:
        _remove(work, place, lock)


def clear_leftovers(place: Path) -> bool:
    """Remove leftovers of killed writers of a destination; return whether a writer is active."""
    at_work = False
    for work in place.parent.glob(f".{escape(place.name)}.*.part"):
        if "." in work.name.removeprefix(f".{place.name}.").removesuffix(".part"):
            continue  # belongs to a destination with a longer name
        if not _is_ours(work):
            if os.path.lexists(work):  # otherwise its creator has removed it meanwhile
                _LOG.warning("%s: was not written by this user's fuselog, so it is not removed", work)
            continue
        with suppress(OSError):
            work.rmdir()  # its creator was killed before it wrote anything
            continue
        from filelock import FileLock, Timeout  # slow to import, and seldom needed here

        lock = FileLock(work / _LOCK, timeout=0)
        try:
            lock.acquire()
        except (Timeout, OSError):
            at_work = True
            continue
        with suppress(FileNotFoundError):  # its creator, which has just released the lock, was faster
            _remove(work, place, lock)
    return at_work


def is_being_written(file: Path) -> bool:
    """Test whether a file is in a working folder, as a partial output or the lock."""
    return any(
        each.name.startswith(".") and each.suffix == ".part" and (each / _LOCK).exists()
        for each in file.parents
    )


def _make(place: Path) -> tuple[Path, "FileLock"]:
    """Create a working folder and lock it."""
    from filelock import FileLock, Timeout  # slow to import

    while True:
        work = Path(tempfile.mkdtemp(".part", f".{place.name}.", place.parent))
        lock = FileLock(work / _LOCK, timeout=0)
        try:
            lock.acquire()
        except (Timeout, FileNotFoundError, FileExistsError):
            continue  # removed as a leftover before it was locked; filelock may recreate the folder
        return work, lock


def _is_ours(work: Path) -> bool:
    """Test whether a folder belongs to this user and has only the entries of a working folder."""
    try:
        state = work.lstat()
        if not stat.S_ISDIR(state.st_mode) or (hasattr(os, "geteuid") and state.st_uid != os.geteuid()):
            return False
        members = {member.name: member for member in work.iterdir()}
        lock = members.get(_LOCK)
        locked = lock is not None and stat.S_ISREG(lock.lstat().st_mode)
    except OSError:
        return False
    others = {name for name in members if name not in (_LOCK, _OLD) and Path(name).stem != _NEW}
    return not others and (not members or locked)


def _remove(work: Path, place: Path, lock: "FileLock") -> None:
    """Remove a working folder whose lock is held; move a replaced folder back to its place.

    The lock file is removed last, so that after an interruption the rest is recognised as a leftover.
    """
    old, new = work / _OLD, work / _NEW
    if old.exists() and new.exists():  # interrupted between the two renames
        try:
            old.rename(place)
        except OSError:
            _LOG.warning("%s: was %s when a command was killed; move it back yourself", old, place)
            lock.release()
            return
    for member in work.iterdir():
        if member.is_dir():
            shutil.rmtree(member, ignore_errors=True)
        elif member.name != _LOCK:
            member.unlink(missing_ok=True)
    lock.release()
    with suppress(OSError):
        (work / _LOCK).unlink(missing_ok=True)
        work.rmdir()


@contextmanager
def parents_of(place: Path, *, make: bool = True) -> Iterator[None]:
    """Create the parent folders of a path; after an exception, remove those that are still empty.

    Raises BadInput if the folders cannot be created.
    """
    missing = [folder for folder in place.parents if not folder.exists()] if make else []
    with _telling(place):
        if make:
            place.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def _telling(place: Path, work: Path | None = None) -> Iterator[None]:
    """Convert the system's errors to BadInput; with `work`, only errors on files in that folder.

    Errors without an `errno`, which Python code raised itself, and errors on other files are passed on.
    """
    try:
        yield
    except OSError as error:
        about = None if error.filename is None else Path(os.fsdecode(error.filename)).absolute()
        elsewhere = work is not None and about is not None and not about.is_relative_to(work.absolute())
        if error.errno is None or elsewhere:
            raise
        raise CannotWrite(f"{place}: cannot be written ({error.strerror or error})") from error
