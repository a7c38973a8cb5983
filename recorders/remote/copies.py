"""Copies of remote files in the user's cache, whose total size is limited."""

import json
import logging
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from fuselog.recorders.atomic import clear_leftovers, whole_file
from fuselog.recorders.compiling.cache import in_turn, is_own, is_private
from fuselog.recorders.environment import REMOTE_GB, cache_folder, remote_bytes
from fuselog.recorders.errors import BadInput
from fuselog.recorders.remote.backends import Identity, blocks_of, masked

_LOG = logging.getLogger("fuselog")
_NAME = re.compile(r"[0-9a-f]{64}(\.\w+)?")
# A copy of this size or more is announced in a terminal.
_ANNOUNCED_BYTES = 1 << 24


def place_of(url: str, identity: Identity, suffix: str) -> Path:
    """Return the path at which the cache keeps a copy of this version of a file."""
    key = json.dumps([url, identity.size, identity.version])
    return _folder() / (sha256(key.encode()).hexdigest() + suffix)


def is_copied(place: Path, identity: Identity) -> bool:
    """Test whether the cache has a complete copy that only this user can have written."""
    with suppress(OSError):
        state = place.stat()
        return is_own(state) and identity.size in (None, state.st_size) and is_private(place.parent)
    return False


def copy(url: str, identity: Identity, place: Path) -> None:
    """Copy a file into the cache, unless it is there; the copies used least recently make room.

    Raises BadInput if the file cannot be fetched or is larger than the cache may be.
    """
    if not is_copied(place, identity):
        if not is_private(place.parent):
            raise BadInput(f"{masked(url)}: cannot be copied without a cache; set FUSELOG_CACHE")
        with in_turn(place):
            if not is_copied(place, identity):
                _fetch(url, identity, place)
    with suppress(OSError):
        os.utime(place, ns=(time.time_ns(), place.stat().st_mtime_ns))


def _fetch(url: str, identity: Identity, place: Path) -> None:
    size = identity.size or 0
    _make_room(url, size)
    if size >= _ANNOUNCED_BYTES:
        _LOG.info("%s: copying %.0f MB into the cache", masked(url), size / 1e6)
    with whole_file(place, parents=False) as new:
        with new.open("wb") as file:
            for position, block in blocks_of(url, identity):
                file.seek(position)
                file.truncate()
                file.write(block)
                if identity.size is None and file.tell() > size:
                    size = file.tell() + len(block)
                    _make_room(url, size)
        new.chmod(0o600)


def _make_room(url: str, size: int) -> None:
    """Remove copies, those used least recently first, until there is room for `size` bytes."""
    limit = remote_bytes()
    if size > limit:
        raise BadInput(
            f"{masked(url)}: has {size / 1e9:.3g} GB, the cache for remote logs {limit / 1e9:.3g} GB; "
            f"set {REMOTE_GB} to a larger number"
        )
    for work in _folder().glob(".*.part"):
        clear_leftovers(work.with_name(work.name[1:].rpartition(".")[0].rpartition(".")[0]))
    found = []
    for path in kept_copies():
        with suppress(OSError):
            state = path.stat()
            found.append((state.st_atime_ns, state.st_size, path))
    total = size + sum(each for _, each, _ in found)
    for _, each, path in sorted(found):
        if total <= limit:
            break
        with suppress(OSError):
            path.unlink()
            total -= each


def kept_copies() -> Iterator[Path]:
    """Yield the copies of remote files in this user's cache."""
    folder = _folder()
    if folder.is_dir() and is_private(folder):
        for path in sorted(folder.iterdir()):
            if _NAME.fullmatch(path.name) and path.suffix != ".lock" and path.is_file():
                yield path


def _folder() -> Path:
    return cache_folder() / "remote"
