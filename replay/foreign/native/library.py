"""Shared libraries with the functions of `fuselog_filter.h`.

This module imports very little, so that a process that only reads the description of a library starts
fast.
"""

import ctypes
import platform
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from fuselog.recorders.errors import BadInput

VERSION = 1
HEADER = Path(__file__).with_name("fuselog_filter.h")
WELL, NOTHING, REJECTED = 0, -1, -2  # status codes, see the header
# Message of glibc for an existing file that was compiled for another CPU.
NOT_OPENED = "cannot open shared object file: No such file or directory"


class Addresses(NamedTuple):
    """Addresses of the functions that a kernel calls; `innovation` is 0 if there is no such function."""

    start: int
    take: int
    predict: int
    state: int
    copy: int
    destroy: int
    innovation: int


class Library:
    """Loaded library.

    Attributes:
        path: the file.
        description: its description, JSON.
        addresses: addresses of the functions that a kernel calls.
    """

    def __init__(self, path: Path) -> None:
        """Load a library; raise BadInput if it cannot be loaded, or is of another version."""
        self.path = path
        if not path.is_file():
            raise BadInput(f"{path}: no such file; give the path of a shared library")
        try:
            self._library = ctypes.CDLL(str(path.resolve()))
        except OSError as error:
            why = str(error).removeprefix(f"{path.resolve()}: ")
            if why.startswith(NOT_OPENED):
                why = "it was compiled for another CPU or system"
            raise BadInput(
                f"{path}: cannot be loaded ({why}); compile it as a shared library for this machine, "
                f"{platform.system()} on {platform.machine()}"
            ) from None
        version = self._function("version", ctypes.c_int32)()
        if version != VERSION:
            raise BadInput(
                f"{path}: was compiled with version {version} of fuselog_filter.h; this fuselog has "
                f"version {VERSION}, so compile it again with the {HEADER.name} of this version"
            )
        names = (*Addresses._fields[:-1], "describe", "create")
        functions = {name: self._function(name, None) for name in names}
        optional = getattr(self._library, "fuselog_filter_innovation", None)
        required = {name: _address(functions[name]) for name in Addresses._fields[:-1]}
        self.addresses = Addresses(**required, innovation=_address(optional) if optional else 0)
        text = self._function("describe", ctypes.c_char_p)()
        if not text:
            raise BadInput(f"{path}: fuselog_filter_describe returns no text; it must return JSON")
        self.description: bytes = text
        self._create = self._function("create", ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint64)
        self._copy = self._function("copy", ctypes.c_void_p, ctypes.c_void_p)
        self._destroy = self._function("destroy", None, ctypes.c_void_p)

    def _function(self, name: str, returns: Any, *takes: Any) -> Any:
        try:
            function = self._library[f"fuselog_filter_{name}"]
        except AttributeError:
            raise BadInput(
                f"{self.path}: lacks the function fuselog_filter_{name}; it must export all functions "
                f"of {HEADER.name} except fuselog_filter_innovation"
            ) from None
        function.restype, function.argtypes = returns, takes
        return function

    def create(self, parameters: Iterable[float], seed: int) -> int:
        """Make a filter and return its address, or 0 if that fails."""
        values = (*parameters, 0.0)  # never empty, because an empty array has no address
        return self._create((ctypes.c_double * len(values))(*values), seed) or 0

    def copy(self, handle: int) -> int:
        """Copy a filter and return its address, or 0 if that fails or if there is no filter."""
        return (self._copy(handle) or 0) if handle else 0

    def destroy(self, handle: int) -> None:
        """Destroy a filter, unless the address is 0."""
        if handle:
            self._destroy(handle)

    def destroy_all(self, handles: Iterable[int]) -> None:
        """Destroy filters."""
        for handle in handles:
            self.destroy(handle)


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0
