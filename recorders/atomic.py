"""Writes files and folders that appear whole or not at all.

What is being written lies in a working folder of its own, beside its place:

    .NAME.RANDOM.part/     made exclusively, for this user alone
        fuselog.lock       locked by the writer; the lock goes when the writer does, however that ends
        new.SUFFIX         the file or folder that is written, renamed to NAME when it is whole
        old                the folder that was in the place, for the moment between two renames

Two writers of one place never touch each other's working folder. What a killed writer left is removed by
the next one, and only where nobody holds its lock and nothing else is in it.
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

from filelock import FileLock, Timeout

from fuselog.recorders.errors import BadInput

_LOCK, _NEW, _OLD = "fuselog.lock", "new", "old"
_LOG = logging.getLogger(__name__)


def settled(place: Path) -> Path:
    """Return the place that is written where a name leads to, once missing folders are made.

    `MISSING/../FILE` is no other file than FILE, though no system finds it before MISSING is there. What
    is in the place may be a link, and is not followed.
    """
    if place.name in ("", ".."):  # as `.` is
        return Path(os.path.realpath(place))
    return Path(os.path.realpath(place.parent), place.name) if ".." in place.parts else place


@contextmanager
def whole_file(place: Path, *, parents: bool = True) -> Iterator[Path]:
    """Yield a path to write; what is there when all went well replaces `place`, in one step.

    Args:
        place: where the file is to be.
        parents: whether folders that are missing are made.

    Raises BadInput where it cannot be written.
    """
    named, place = place, settled(place) if parents else place
    _clear_leftovers(place)
    with parents_of(named, make=parents), _working_folder(place) as work, _telling(place, work):
        new = work / (_NEW + place.suffix)
        yield new
        with new.open("rb+") as file:
            os.fsync(file.fileno())
        new.replace(place)


@contextmanager
def whole_folder(place: Path, check: Callable[[Path], None]) -> Iterator[Path]:
    """Yield a folder to fill; when all went well it replaces `place`.

    `check` is given the folder that is to be replaced, before anything is written and again when it has
    been moved aside; it raises where that folder must stay, and then it does.

    Raises BadInput where the folder cannot be written, or another process is writing it.
    """
    named, place = place, settled(place)
    if _clear_leftovers(place):
        raise BadInput(
            f"{place}: another fuselog command is writing it; wait for it, or give another --out"
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
    """Yield a private folder among the system's temporary ones, which is removed at the end.

    Raises BadInput where it cannot be made.
    """
    place = Path(tempfile.gettempdir()) / name
    _clear_leftovers(place)
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


def is_being_written(file: Path) -> bool:
    """Tell whether a file is in a working folder: half an output, or its lock."""
    return any(
        each.name.startswith(".") and each.suffix == ".part" and (each / _LOCK).exists()
        for each in file.parents
    )


def _make(place: Path) -> tuple[Path, FileLock]:
    """Make a new working folder and its lock, held."""
    while True:
        work = Path(tempfile.mkdtemp(".part", f".{place.name}.", place.parent))
        lock = FileLock(work / _LOCK, timeout=0)
        try:
            lock.acquire()
        except (Timeout, FileNotFoundError, FileExistsError):
            continue  # taken for a leftover before it was locked; filelock may make the folder again
        return work, lock


def _clear_leftovers(place: Path) -> bool:
    """Remove what killed writers of a place left; whether one is at work."""
    at_work = False
    for work in place.parent.glob(f".{escape(place.name)}.*.part"):
        if "." in work.name.removeprefix(f".{place.name}.").removesuffix(".part"):
            continue  # of another place, whose name goes on
        if not _is_ours(work):
            if os.path.lexists(work):  # or else its maker has removed it since
                _LOG.warning("%s: was not written by this user's fuselog; it is left as it is", work)
            continue
        with suppress(OSError):
            work.rmdir()  # its maker was killed before anything was in it
            continue
        lock = FileLock(work / _LOCK, timeout=0)
        try:
            lock.acquire()
        except (Timeout, OSError):
            at_work = True
            continue
        with suppress(FileNotFoundError):  # its maker, who has just released the lock, was faster
            _remove(work, place, lock)
    return at_work


def _is_ours(work: Path) -> bool:
    """Tell whether a folder holds what working folders hold and nothing else, and is this user's."""
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


def _remove(work: Path, place: Path, lock: FileLock) -> None:
    """Remove a working folder whose lock is held; what was moved out of the place goes back there.

    The lock file goes last, so that what remains where this is stopped is known as a leftover.
    """
    old, new = work / _OLD, work / _NEW
    if old.exists() and new.exists():  # stopped between the two renames
        try:
            old.rename(place)
        except OSError:
            _LOG.warning("%s: was %s when a command was killed; move it back by hand", old, place)
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
    """Make the folders that a place is in; those that are made and of which nothing comes go again.

    Raises BadInput where they cannot be made.
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
    """Tell errors of the system as BadInput, where a folder is given only those of what is in it.

    Errors that code raises of its own have no number; they go through, as do those of other files.
    """
    try:
        yield
    except OSError as error:
        about = None if error.filename is None else Path(os.fsdecode(error.filename)).absolute()
        elsewhere = work is not None and about is not None and not about.is_relative_to(work.absolute())
        if error.errno is None or elsewhere:
            raise
        raise BadInput(f"{place}: cannot be written ({error.strerror or error})") from error
