"""Detection of the values that a function reads in addition to its arguments.

If these values have not changed, another call gives the same result. The detection is possible only if
all values are visible and cannot change unnoticed: the code, defaults and closure of the function, and
the globals and attributes of modules that its bytecode names. Each of them must be a number, a string, a
tuple of these, a function without state, or a Python function with the same properties. A list, an
array, an attribute of an object, a file and a clock may change unnoticed.
"""

import builtins
import dis
import math
from collections.abc import Mapping
from functools import lru_cache
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np

_IMMUTABLE = {
    *(bool, int, float, complex, str, bytes, type(None), type(Ellipsis)),
    *(np.bool_, np.float64, np.float32, np.int64, np.int32),
}
_OF_PYTHON = (
    "abs all any bool divmod enumerate float int len list map max min pow range reversed round slice "
    "sorted sum tuple zip"
)
_OF_NUMPY = (
    "array asarray atleast_1d atleast_2d choose clip concatenate cross diag dot eye full hstack "
    "identity inner interp ones outer prod reshape round around searchsorted sinc stack sum trace "
    "transpose vstack where zeros float64"
)
# Functions whose results depend only on their arguments; referenced here so that their ids are not
# reused.
_PURE = {
    id(each): each
    for each in (
        *(getattr(builtins, name) for name in _OF_PYTHON.split()),
        *(each for each in vars(math).values() if callable(each)),
        *(each for each in vars(np).values() if isinstance(each, np.ufunc)),
        *(getattr(np, name) for name in _OF_NUMPY.split()),
        np.linalg.norm,
    )
}
_ATTRIBUTE = ("LOAD_ATTR", "LOAD_METHOD")
_ABSENT = object()
Made = TypeVar("Made")


def pure(kind: type[Made]) -> type[Made]:
    """Declare that the results of a class depend only on its arguments."""
    _PURE[id(kind)] = kind
    return kind


class Reads(NamedTuple):
    """Variables and functions that a function reads, and their values.

    Attributes:
        functions: the function and the functions that it calls, with their code and defaults.
        cells: cells of closures.
        names: globals and attributes of modules.
    """

    functions: list[tuple[FunctionType, CodeType, Any]]
    cells: list[tuple[CellType, Any]]
    names: list[tuple[Mapping[str, Any], str, Any]]

    def are_unchanged(self) -> bool:
        """Test whether everything that was read still has the same value."""
        for function, code, defaults in self.functions:
            if function.__code__ is not code or function.__defaults__ is not defaults:
                return False
            if function.__kwdefaults__ or function.__dict__:
                return False
        try:
            if not all(cell.cell_contents is value for cell, value in self.cells):
                return False
        except ValueError:  # the cell is empty now
            return False
        return all(scope.get(name, _ABSENT) is value for scope, name, value in self.names)


def reads_of(function: Any) -> Reads | None:
    """Find the values that a function reads; None if one of them may change unnoticed."""
    reads = Reads([], [], [])
    return reads if _sees(reads, function) else None


def _sees(reads: Reads, value: Any) -> bool:
    """Record what a value reads; return False if any of it may change unnoticed."""
    if type(value) in _IMMUTABLE or id(value) in _PURE:
        return True
    if type(value) is tuple:
        return all(_sees(reads, each) for each in value)
    if type(value) is not FunctionType or value.__kwdefaults__ or value.__dict__:
        return False
    if any(each is value for each, _, _ in reads.functions):
        return True
    reads.functions.append((value, value.__code__, value.__defaults__))
    chains = _chains(value.__code__)
    if chains is None:
        return False
    try:
        contents = [(cell, cell.cell_contents) for cell in value.__closure__ or ()]
    except ValueError:
        return False
    reads.cells.extend(contents)
    inside = (*(value.__defaults__ or ()), *(content for _, content in contents))
    return all(_sees(reads, each) for each in inside) and all(
        _sees(reads, _found(reads, value, chain)) for chain in chains
    )


def _found(reads: Reads, function: FunctionType, chain: tuple[str, ...]) -> Any:
    """Return the value of a chain of names such as `np.linalg.norm` in modules; record each step."""
    name, *attributes = chain
    scope: Any = function.__globals__
    if name not in scope:
        reads.names.append((scope, name, _ABSENT))
        scope = vars(builtins)
    value = scope.get(name, _ABSENT)
    reads.names.append((scope, name, value))
    for attribute in attributes:
        if type(value) is not ModuleType:
            break
        scope = vars(value)
        value = scope.get(attribute, _ABSENT)
        reads.names.append((scope, attribute, value))
    return value


@lru_cache(maxsize=1024)
def _chains(code: CodeType) -> tuple[tuple[str, ...], ...] | None:
    """Return the globals that code names, with attributes; None if it uses names in other ways.

    Such other ways are imports, classes, assignments to globals or attributes, and `__attributes__`.
    """
    instructions = [each for each in dis.get_instructions(code) if each.opname != "EXTENDED_ARG"]
    chains: list[list[str]] = []
    is_open = False  # whether the next attribute belongs to the last chain
    for each in instructions:
        if each.opname == "LOAD_GLOBAL":
            chains.append([each.argval])
        elif each.opname in _ATTRIBUTE and not each.argval.startswith("__"):
            if is_open:
                chains[-1].append(each.argval)
        elif each.opcode in dis.hasname:
            return None
        is_open = each.opname == "LOAD_GLOBAL" or (is_open and each.opname in _ATTRIBUTE)
    found = dict.fromkeys(map(tuple, chains))
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            more = _chains(inner)
            if more is None:
                return None
            found |= dict.fromkeys(more)
    return tuple(found)
