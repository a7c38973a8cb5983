"""The environment variables that fuselog reads, and their validation."""

import os
import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

from fuselog.recorders.errors import BadInput

UNCOMPILED, BOUNDSCHECK, TRACEBACK = "FUSELOG_UNCOMPILED", "FUSELOG_BOUNDSCHECK", "FUSELOG_TRACEBACK"
CORES, REMOTE_GB = "NUMBA_NUM_THREADS", "FUSELOG_REMOTE_GB"


# The encoded variables in which os.environ looks up names. Every kernel call asks for variables that are
# usually not set; os.environ itself raises two exceptions for each and takes thirty times as long.
_STORED: Mapping[object, object] | None = getattr(os.environ, "_data", None)
_key, _ON = cache(os.environ.encodekey), os.environ.encodevalue("1")


def is_on(name: str) -> bool:
    """Test whether a variable is 1."""
    return os.environ.get(name) == "1" if _STORED is None else _STORED.get(_key(name)) == _ON


def is_set(name: str) -> bool:
    """Test whether a variable is set and not empty."""
    return bool(os.environ.get(name))


def core_count() -> int | None:
    """Return the number of cores that kernels may use, or None if the variable is not set."""
    stated = os.environ.get(CORES, "")
    return int(stated) if _is_count(stated) and int(stated) > 0 else None


def processor() -> tuple[str | None, str | None]:
    """Return the processor and the features that code is compiled for, from numba's variables."""
    return os.environ.get("NUMBA_CPU_NAME"), os.environ.get("NUMBA_CPU_FEATURES")


def cache_folder() -> Path:
    """Find the folder for this user's cached results.

    The folder is FUSELOG_CACHE if it is set, otherwise $XDG_CACHE_HOME/fuselog, or ~/.cache/fuselog if
    neither is set. As in the XDG specification, a relative XDG_CACHE_HOME is ignored.
    """
    stated = os.environ.get("FUSELOG_CACHE")
    if stated:
        return Path(stated)
    home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".cache") / "fuselog"


def remote_bytes() -> int:
    """Return the largest total size of the copies of remote logs in the cache: 10 GB if not set."""
    return int(float(os.environ.get(REMOTE_GB) or 10) * 1e9)


def check() -> None:
    """Raise BadInput if a variable has an invalid value.

    Variables that would disturb commands are removed: MPLBACKEND selects a window system, RERUN disables
    drawings that the user requested, and RERUN_FLUSH_... controls how rows are batched.
    """
    for name, (is_valid, expected) in _EXPECTED.items():
        stated = os.environ.get(name)
        if stated is not None and not is_valid(stated):
            raise BadInput(f"{name}={stated}: expected {expected}; correct or unset the variable")
    for name in [each for each in os.environ if re.fullmatch("MPLBACKEND|RERUN(_FLUSH_.*)?", each)]:
        del os.environ[name]


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 16


def _is_size(text: str) -> bool:
    return re.fullmatch(r"|\d{1,9}(\.\d{1,9})?", text, re.ASCII) is not None


def _is_switch(text: str) -> bool:
    return text in ("", "0", "1")


# For each variable, a test of its value, and the expected values in words.
_EXPECTED: dict[str, tuple[Callable[[str], bool], str]] = {
    UNCOMPILED: (_is_switch, "1"),
    BOUNDSCHECK: (_is_switch, "1"),
    CORES: (lambda text: _is_count(text) and int(text) > 0, "a number of cores, 1 or more"),
    REMOTE_GB: (_is_size, "a number of gigabytes, such as 10"),
    "SOURCE_DATE_EPOCH": (_is_count, "whole seconds since 1970"),
}
