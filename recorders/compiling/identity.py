"""Description of a function as text: its code, its constants, and all functions that it calls.

Functions with the same description behave identically. The description is made from bytecode, closures
and the globals that the function names, without reading sources.
"""

import sys
from collections.abc import Iterator, Sequence
from functools import cache
from hashlib import sha256
from importlib.resources import files
from types import CodeType, FunctionType, ModuleType

import numpy as np

from fuselog.recorders.compiling.kinds import Value

# Packages whose parts are described by their names only.
OF_PYTHON = {"numpy", *sys.stdlib_module_names}


def identity(function: FunctionType) -> str:
    """Describe a function as text, in which each object that it needs is described once."""
    known: dict[int, int] = {}
    kept: list[Value] = []  # keeps objects alive whose ids are keys of `known`
    return "\n".join(_words(function, known, kept, ()))


@cache
def digest_of(room: str) -> str:
    """Compute the digest of a package's own sources, so that a change invalidates its cached results."""
    places = sorted(files(room).iterdir(), key=lambda place: place.name)
    sources = [place.read_bytes() for place in places if place.name.endswith(".py")]
    return sha256(b"".join(sources)).hexdigest()


def _words(
    value: Value, known: dict[int, int], kept: list[Value], names: Sequence[str]
) -> Iterator[str]:
    """Yield the description of a value, including only the attributes that the code uses (`names`)."""

    def of(part: Value) -> Iterator[str]:
        return _words(part, known, kept, names)

    own = getattr(value, "kernel_identity", None)
    if callable(own) and not isinstance(value, type):  # see fuselog.replay.tracing
        yield own()
    elif isinstance(value, bool | int | float | complex | str | bytes | None | np.generic):
        yield repr(value)
    elif isinstance(value, tuple | list):
        yield f"{type(value).__qualname__} of {len(value)} {getattr(value, '_fields', '')}"
        for each in value:
            yield from of(each)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape} {sha256(value.tobytes()).hexdigest()}"
    elif isinstance(value, FunctionType):
        if _is_known(value, known, kept):
            yield f"again {known[id(value)]}"
            return
        yield f"def {value.__name__} {value.__defaults__!r}"
        yield from _code(value.__code__, value.__doc__)
        names = sorted(set(_names(value.__code__)))
        for cell in value.__closure__ or ():
            yield from of(cell.cell_contents)
        if hasattr(value, "__wrapped__"):
            yield from of(value.__wrapped__)
        for name in names:
            if name in value.__globals__:
                yield name
                yield from of(value.__globals__[name])
    elif isinstance(value, ModuleType | type):
        module = value.__name__ if isinstance(value, ModuleType) else value.__module__
        yield f"{module} {getattr(value, '__qualname__', '')} {getattr(value, '_fields', '')}"
        if module.partition(".")[0] not in OF_PYTHON:
            for name in names:
                if name in vars(value):
                    yield name
                    yield from of(vars(value)[name])
    elif hasattr(value, "__dict__") and not callable(value):
        if _is_known(value, known, kept):
            yield f"again {known[id(value)]}"
            return
        yield from of(type(value))
        for name, each in sorted(vars(value).items()):
            yield name
            yield from of(each)
    elif callable(value):
        yield f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', repr(value))}"
        if hasattr(value, "__wrapped__"):
            yield from of(value.__wrapped__)
    else:
        yield repr(value)


def _is_known(value: Value, known: dict[int, int], kept: list[Value]) -> bool:
    """Test whether a value was described before, and mark it as described."""
    if id(value) in known:
        return True
    known[id(value)] = len(known)
    kept.append(value)
    return False


def _code(code: CodeType, description: str | None = None) -> Iterator[str]:
    """Yield the bytecode and the constants of a function, except its docstring."""
    yield code.co_code.hex()
    yield f"{code.co_names} {code.co_varnames} {code.co_freevars} {code.co_argcount}"
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from _code(each)
        elif each is not description:
            yield repr(each)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from _names(each)
