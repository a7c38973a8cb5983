"""What a function is made of, in words: its code, and that of all that it calls, with their constants.

Two functions with the same words do the same. They are found without reading sources: from compiled
bytecode, closures and the globals that it names.
"""

from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from importlib.resources import files
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np


def identity(function: FunctionType) -> str:
    """The words of a function, each thing that it needs described once."""
    told: dict[int, int] = {}
    kept: list[Any] = []  # whose ids are keys
    return "\n".join(_words(function, told, kept))


@cache
def digest_of(room: str) -> str:
    """The digest of a room's own sources: what it made before is made anew after a change."""
    places = sorted(files(room).iterdir(), key=lambda place: place.name)
    sources = [place.read_bytes() for place in places if place.name.endswith(".py")]
    return sha256(b"".join(sources)).hexdigest()


def _words(value: Any, told: dict[int, int], kept: list[Any]) -> Iterator[str]:
    own = getattr(value, "kernel_identity", None)
    if callable(own) and not isinstance(value, type):  # it knows what it is, see replay.tracing
        yield own()
    elif isinstance(value, FunctionType):
        if id(value) in told:
            yield f"again {told[id(value)]}"
            return
        told[id(value)] = len(told)
        kept.append(value)
        yield f"def {value.__name__} {value.__defaults__!r}"
        yield from _code(value.__code__)
        for cell in value.__closure__ or ():
            yield from _words(cell.cell_contents, told, kept)
        wrapped = getattr(value, "__wrapped__", None)
        if wrapped is not None:
            yield from _words(wrapped, told, kept)
        for name in sorted(set(_names(value.__code__))):
            if name in value.__globals__:
                yield name
                yield from _words(value.__globals__[name], told, kept)
    elif isinstance(value, ModuleType):
        yield f"module {value.__name__}"
    elif isinstance(value, type):
        yield f"type {value.__module__}.{value.__qualname__} {getattr(value, '_fields', '')}"
    elif isinstance(value, tuple | list):
        yield f"{type(value).__qualname__} of {len(value)}"
        for each in value:
            yield from _words(each, told, kept)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape} {sha256(value.tobytes()).hexdigest()}"
    elif isinstance(value, bool | int | float | complex | str | bytes | None | np.generic):
        yield repr(value)
    elif callable(value):
        yield f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', repr(value))}"
    else:
        yield repr(value)


def _code(code: CodeType) -> Iterator[str]:
    yield code.co_code.hex()
    yield f"{code.co_names} {code.co_varnames} {code.co_freevars} {code.co_argcount}"
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from _code(each)
        else:
            yield repr(each)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from _names(each)
