"""Offers the public interface that programs, notebooks and plug-ins import; docs/python.md shows how.

Names are imported when they are first asked for, from the places that the stub beside this file lists:
`import fuselog` is quick, and editors and type checkers see everything.
"""

import ast
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parent
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


def _refuse_others() -> None:
    """Raise ImportError where Python finds another package under the name of one of ours."""
    for room in sorted({module.partition(".")[0] for module, _ in _NAMES.values()}):
        found = find_spec(room)
        ours = _HERE.parent / room / "__init__.py"
        place = found and (found.origin or next(iter(found.submodule_search_locations or ()), None))
        if place is None or not ours.samefile(place):
            raise ImportError(
                f"fuselog needs its own package '{room}' ({ours}), but Python finds "
                f"{place or 'none'}; rename that, or start Python where it is not found first"
            )


_NAMES = _names()
_refuse_others()
__all__ = list(_NAMES)


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        new = _RENAMED[name]
        message = f"fuselog.{name} is called fuselog.{new} now; the old name goes in the next release"
        warnings.warn(message, FutureWarning, stacklevel=2)
        return getattr(sys.modules[__name__], new)
    if name not in _NAMES:
        raise AttributeError(f"module 'fuselog' has no attribute '{name}'")
    module, there = _NAMES[name]
    found = globals()[name] = getattr(__import__(module, fromlist=[there]), there)
    return found


def __dir__() -> list[str]:
    return sorted(_NAMES)
