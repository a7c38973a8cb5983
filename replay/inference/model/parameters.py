"""The numbers among a model's parameters, as its functions get them."""

from collections import namedtuple
from functools import cache, lru_cache
from typing import Any

from recorders.parameters import Parameters


@cache
def number_fields(parameters: type[Parameters]) -> tuple[str, ...]:
    """The parameters that model functions may read: all that are numbers."""
    schema = parameters.model_json_schema()["properties"]
    numeric = ("number", "integer", "boolean", "null")
    return tuple(
        name
        for name, entry in schema.items()
        if all(each.get("type") in numeric for each in entry.get("anyOf", [entry]))
    )


@lru_cache(maxsize=64)
def settings_type(names: tuple[str, ...]) -> type[Any]:
    """The NamedTuple that model functions get as their parameters."""
    return namedtuple("Settings", names)
