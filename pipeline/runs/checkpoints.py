"""Storage of finished cells, in a folder next to the result.

    OUT.unfinished/
        fuselog.lock    held by the process that computes the cells
        KEY.bin         the result of a cell, with a checksum; KEY hashes its description and the code
        KEY/            the files of that cell: logs and estimates of the first runs, the timeline

The result of a cell begins with its key and contains the SHA-256 of each of its files; a cell whose
files have changed is computed again. Other users may be able to write to the parent folder, such as a
shared disk, but the folder itself and each file that is read must belong to this user only.

The folder is created when the work begins. The folder is removed when the result is complete, or if the
folder is empty.
"""

import logging
import os
import pickle
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock, Timeout

from fuselog.pipeline.output.results import hash_of
from fuselog.pipeline.runs.estimates import ERRORS, join_tables
from fuselog.recorders.atomic import parents_of, settled
from fuselog.recorders.compiling.cache import is_own, read_own, write_checked
from fuselog.recorders.errors import BadInput

_LOCK, _SUFFIX = "fuselog.lock", ".bin"
_KEY = re.compile(r"[0-9a-f]{64}")
_LEFTOVER = re.compile(r"\.[0-9a-f]{64}\.bin\.[^.]+\.part")  # a cell whose writing was interrupted
_LOG = logging.getLogger("fuselog")


class Checkpoints:
    """The finished cells of an experiment, in a locked folder."""

    def __init__(self, folder: Path, lock: FileLock) -> None:
        self.folder = folder
        self._lock = lock

    def begin(self) -> None:
        """Create the folder if it does not exist, and lock it.

        Raises BadInput if another process has locked it, or it contains files that fuselog did not
        write.
        """
        if self._lock.is_locked:
            return
        is_new = not self.folder.exists()
        try:
            self.folder.mkdir(mode=0o700, exist_ok=True)
            self._lock.acquire()
        except Timeout:
            raise BadInput(
                f"{self.folder}: another fuselog command is using this folder; wait for it, or give "
                "another --out"
            ) from None
        except OSError as error:
            if is_new:
                self._remove()
            raise BadInput(f"{self.folder}: cannot be written ({error.strerror or error})") from error
        foreign = [each.name for each in self.folder.iterdir() if not _is_ours(each)]
        what = f"contains {foreign[0]}, which fuselog did not write" if foreign else ""
        if not is_own(self.folder.stat()):
            what = "another user owns it, or others may write to it"
        if what:
            self._lock.release()
            raise BadInput(f"{self.folder}: {what}; move it away, or give another --out")
        for path in self.folder.iterdir():
            if _LEFTOVER.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)

    def place_of(self, key: str) -> Path:
        """Return the folder for the files of a cell."""
        return self.folder / key

    def has(self, key: str) -> bool:
        """Test whether a cell is finished and all its files exist."""
        return self._left(key) is not None

    def read(self, key: str) -> Any:
        """Read the result of a cell; return None if the cell is not done."""
        left = self._left(key)
        return None if left is None else pickle.loads(left.pickled)

    def write(self, key: str, left: bytes) -> None:
        """Store the pickled result of a cell, with hashes of the files that it wrote."""
        place = self.place_of(key)
        files = sorted(path for path in place.rglob("*") if path.is_file())
        hashes = {path.relative_to(place).as_posix(): hash_of(path) for path in files}
        content = key.encode() + pickle.dumps(_Left(left, hashes))
        write_checked(self.folder / f"{key}{_SUFFIX}", content, "a cell")

    def hand_over(self, keys: Sequence[str], folder: Path) -> None:
        """Move the files of all cells to a folder, in order, and join tables of errors.

        Raises BadInput if files differ from those that the cells wrote.
        """
        tables: dict[Path, list[Path]] = {}
        for key in keys:
            left = self._left(key)
            if left is None:
                raise BadInput(
                    f"{self.place_of(key)}: was changed during the run; run the command again"
                )
            for name in map(Path, left.files):
                path = self.place_of(key) / name
                if name.is_relative_to(ERRORS):
                    tables.setdefault(name, []).append(path)
                    continue
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                _copy(path, folder / name)
        for name, parts in tables.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            join_tables(parts, folder / name)

    def end(self, *, is_done: bool) -> None:
        """Unlock the folder, and keep it if there are cells to resume."""
        if is_done and self.folder.is_dir():
            with suppress(BadInput):  # folders that are locked or contain files of other programs
                self.begin()  # unfinished cells of an earlier command
        if not self._lock.is_locked:
            return
        done = sum(1 for path in self.folder.iterdir() if path.suffix == _SUFFIX)
        if done and not is_done:
            self._lock.release()
            _LOG.warning(
                "%s: %d finished cells are kept; run the same command again to compute the others",
                self.folder,
                done,
            )
            return
        for path in self.folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.suffix == _SUFFIX:
                path.unlink(missing_ok=True)
        self._remove()

    def _remove(self) -> None:
        """Unlock the folder and remove it if it contains nothing except the lock."""
        self._lock.release()
        with suppress(OSError):
            (self.folder / _LOCK).unlink(missing_ok=True)
            self.folder.rmdir()

    def _left(self, key: str) -> "_Left | None":
        """Read the result of a cell if its files are unchanged."""
        content = read_own(self.folder / f"{key}{_SUFFIX}")
        if content is None or not content.startswith(key.encode()):
            return None
        # unpickling is safe, because only this user can write the file
        left: _Left = pickle.loads(content.removeprefix(key.encode()))
        place = self.place_of(key)
        try:
            whole = all(hash_of(place / name) == digest for name, digest in left.files.items())
        except OSError:
            return None
        return left if whole else None


class _Left(NamedTuple):
    """The pickled result of a cell, and the SHA-256 of its files by path in its folder."""

    pickled: bytes
    files: dict[str, str]


@contextmanager
def checkpoints_of(place: Path) -> Iterator[Checkpoints]:
    """Store the cells of an experiment next to its result folder, and remove them after success."""
    place = settled(place)
    folder = place.with_name(f"{place.name}.unfinished")
    checkpoints = Checkpoints(folder, FileLock(folder / _LOCK, timeout=0))
    with parents_of(place):
        try:
            yield checkpoints
        except BaseException:
            checkpoints.end(is_done=False)
            raise
        checkpoints.end(is_done=True)


def _is_ours(path: Path) -> bool:
    """Test whether this module wrote a file or folder."""
    if path.is_symlink():
        return False
    is_cell = _KEY.fullmatch(path.stem) is not None
    if path.is_dir():
        return (is_cell and not path.suffix) or _LEFTOVER.fullmatch(path.name) is not None
    return path.name == _LOCK or (is_cell and path.suffix == _SUFFIX)


def _copy(path: Path, place: Path) -> None:
    """Copy a file, as a hard link if possible."""
    try:
        os.link(path, place)
    except OSError:
        shutil.copyfile(path, place)
