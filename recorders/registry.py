"""Recorders, estimators, metrics and studies by name.

All register in one way, ours and third parties' alike: as entry points of an installed distribution
(groups `fuselog.recorders`, `fuselog.estimators`, `fuselog.metrics`, `fuselog.studies`,
`fuselog.timelines`). Listing names imports nothing.
"""

from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from recorders.errors import BadInput


@cache
def available(kind: str) -> Mapping[str, EntryPoint]:
    """The registered names of a kind ("recorders", say), sorted, with where each comes from."""
    found = entry_points(group=f"fuselog.{kind}")
    return {entry.name: entry for entry in sorted(found, key=lambda entry: entry.name)}


def load(kind: str, name: str) -> Any:
    """The object registered under `name`.

    Raises BadInput where there is none, with the names there are, or where it does not import.
    """
    known = available(kind)
    if name not in known:
        near = get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(known) or 'none'}"
        raise BadInput(f"no {kind.removesuffix('s')} '{name}'; {hint}")
    try:
        return known[name].load()
    except (ImportError, AttributeError) as error:
        raise BadInput(
            f"{kind.removesuffix('s')} '{name}' ({known[name].value}) does not import: {error}"
        ) from error
