"""Lookup of recorders, estimators, metrics and studies by name.

Objects of fuselog and of third parties register in the same way: as entry points of an installed
distribution (groups `fuselog.recorders`, `fuselog.models`, `fuselog.estimators`, `fuselog.judges`,
`fuselog.metrics`, `fuselog.timelines`, `fuselog.drawings`, `fuselog.studies`, `fuselog.exports`).
Listing names does not import anything.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from textwrap import shorten
from typing import Any

from fuselog.recorders.errors import BadInput, choices

SINGULAR = {"studies": "study"}


@cache
def registered() -> EntryPoints:
    """Return all registered entry points, from one pass over the installed distributions."""
    found = entry_points()
    groups = [group for group in found.groups if group.startswith("fuselog.")]
    return EntryPoints(each for group in groups for each in found.select(group=group))


@cache
def available(kind: str) -> dict[str, EntryPoint]:
    """Return the registered entry points of a kind, such as "recorders", sorted by name."""
    found = registered().select(group=f"fuselog.{kind}")
    return {entry.name: entry for entry in sorted(found, key=lambda entry: entry.name)}


def load(kind: str, name: str, expected: type = object) -> Any:
    """Load the object registered under `name`.

    Raises BadInput if the name is unknown (with the available names), or if the object cannot be
    imported or is not of the `expected` type.
    """
    known = available(kind)
    one = SINGULAR.get(kind, kind.removesuffix("s"))
    if name not in known:
        raise BadInput(f"no {one} '{name}'; {choices(name, known)}")
    with foreign_code(f"{one} '{name}' ({known[name].value})"):
        found = _object_of(known[name])
    if not isinstance(found, expected):
        raise BadInput(
            f"{one} '{name}' ({known[name].value}) is {type(found).__name__}; "
            f"the entry point must lead to an instance of {expected.__name__}"
        )
    return found


@cache
def _object_of(entry: EntryPoint) -> Any:
    return entry.load()


@contextmanager
def foreign_code(what: str) -> Iterator[None]:
    """Guard calls of registered code: convert its exceptions to BadInput that names the code.

    BadInput, MemoryError, OSError and interrupts are passed on unchanged.
    """
    try:
        yield
    except (BadInput, MemoryError, OSError):
        raise
    except Exception as error:
        reason = shorten(str(error), 200)
        raise BadInput(
            f"{what} raised {type(error).__name__}: {reason}; set FUSELOG_TRACEBACK=1 to see where"
        ) from error
