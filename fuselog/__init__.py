"""Offers the public interface that programs, notebooks and plug-ins import; docs/python.md shows how.

Names are imported when they are first asked for, from the places that the stub beside this file lists:
`import fuselog` is quick, and editors and type checkers see everything.
"""

import ast
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

_HERE = Path(__file__).parent
_INSIDE, _BESIDE = _HERE / "recorders", _HERE.parent / "recorders"
if not _INSIDE.exists() or (_BESIDE.exists() and _INSIDE.samefile(_BESIDE)):
    __path__ = [str(_HERE.parent), str(_HERE)]  # in a clone the rooms stand beside this folder

from fuselog import replay as _room  # noqa: E402

_RENAMED = {"Told": "Diagnostics"}  # names of the release before


def _names() -> dict[str, tuple[str, str]]:
    """Return for each public name its module, and what it is called there."""
    stub = ast.parse((_HERE / "__init__.pyi").read_text(encoding="utf-8"))
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def _public(name: str) -> Any:
    module, there = _NAMES[name]
    return getattr(__import__(module, fromlist=[there]), there)


class _Replay(ModuleType):
    """The package `replay`, which can be called: a function of the interface has the same name."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return _public("replay")(*arguments, **options)

    @property
    def __signature__(self) -> Any:
        from inspect import signature

        return signature(_public("replay"))


_NAMES = _names()
__all__ = list(_NAMES)
_room.__class__ = _Replay


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        new = _RENAMED[name]
        message = f"fuselog.{name} is called fuselog.{new} now; the old name goes in the next release"
        warnings.warn(message, FutureWarning, stacklevel=2)
        return getattr(sys.modules[__name__], new)
    if name not in _NAMES:
        raise AttributeError(f"module 'fuselog' has no attribute '{name}'")
    found = globals()[name] = _public(name)
    return found


def __dir__() -> list[str]:
    return sorted(_NAMES)
