"""Public interface for programs, notebooks and plug-ins; see docs/python.md.

A name is imported on first use, from the module that the stub file in this folder lists for it. Imports
on first use make `import fuselog` fast, and editors and type checkers still see every name.
"""

import sys
import warnings
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

_HERE = Path(__file__).parent
_INSIDE, _BESIDE = _HERE / "recorders", _HERE.parent / "recorders"
if not _INSIDE.exists() or (_BESIDE.exists() and _INSIDE.samefile(_BESIDE)):
    __path__ = [str(_HERE.parent), str(_HERE)]  # in a clone, the packages are next to this folder

from fuselog import replay as _room  # noqa: E402

_RENAMED = {"Told": "Diagnostics"}  # names of the previous release


@cache
def _names() -> dict[str, tuple[str, str]]:
    """Read the stub file, and map each public name to its module and to its name in that module."""
    import ast  # as slow to import as the rest of this file; commands need no public name

    stub = ast.parse((_HERE / "__init__.pyi").read_text(encoding="utf-8"))
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def _public(name: str) -> Any:
    module, there = _names()[name]
    return getattr(__import__(module, fromlist=[there]), there)


class _Replay(ModuleType):
    """The package `replay`, made callable because a public function has the same name."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return _public("replay")(*arguments, **options)

    @property
    def __signature__(self) -> Any:
        from inspect import signature

        return signature(_public("replay"))


_room.__class__ = _Replay


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        new = _RENAMED[name]
        message = f"fuselog.{name} was renamed to fuselog.{new}; the next release removes the old name"
        warnings.warn(message, FutureWarning, stacklevel=2)
        return getattr(sys.modules[__name__], new)
    if name == "__all__":
        return list(_names())
    if name.startswith("__") or name not in _names():
        raise AttributeError(f"module 'fuselog' has no attribute '{name}'")
    found = globals()[name] = _public(name)
    return found


def __dir__() -> list[str]:
    return sorted(_names())
