"""Moves parameters: to another value that they accept, to the bounds that they declare, and beyond."""

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameter, Parameters, build, describe, merge, nested

# Numbers of what happens so often, by how their names end, and one under which other parameters count.
OFTEN = {"rate_hz": 2.0, "_per_minute": 20.0, "_per_scan": 2.0, "_probability": 0.5}
BOUND = re.compile(r"(?:number|integer)((?: [<>]=? \S+)+)")


def settable(kind: type[Parameters]) -> list[Parameter]:
    """The parameters that can be set by themselves.

    Not so are tables that always stand, what is in lists of tables, and what is in a table that is none
    unless it is given: that is set as a whole.
    """
    found = [each for each in describe(kind) if each.accepts != "table"]
    wholes = tuple(f"{each.name}." for each in found)
    return [
        each
        for each in found
        if not each.name.startswith(wholes) and "[]" not in each.name and ".NAME" not in each.name
    ]


def switched_on(kind: type[Parameters], *, endings: Collection[str] = OFTEN) -> dict[str, Any]:
    """The settings under which all that by default never happens does: sensors, outages, clutter."""
    settings: dict[str, Any] = {}
    for each in settable(kind):
        for ending in endings:
            if each.default == 0 and each.name.endswith(ending):
                settings = merge(settings, nested(each.name, OFTEN[ending]))
    return settings


def value_of(values: Mapping[str, Any], name: str) -> Any:
    """The value with this full name."""
    first, _, rest = name.partition(".")
    return value_of(values[first], rest) if rest else values[first]


def _others(value: Any, accepts: str) -> Iterator[Any]:
    """Values beside this one, the likelier to be accepted the earlier."""
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, str):
        yield from (each for each in accepts.split(", ") if each != value)
    elif isinstance(value, int) and "number" not in accepts:
        yield from (value + 1, value - 1)
    elif isinstance(value, int | float):
        yield from (1.3 * value, 0.7 * value) if value else (0.3, -0.3)
    elif value is None and "number" in accepts and "of number" not in accepts:
        yield from (0.37, 1.37)
    elif isinstance(value, list | tuple):
        for place, entry in enumerate(value):
            for other in _others(entry, accepts):
                yield [*value[:place], other, *value[place + 1 :]]


def moved(kind: type[Parameters], base: Mapping[str, Any], each: Parameter) -> dict[str, Any]:
    """The base with one parameter at another value; LookupError where none is known that it accepts."""
    value = value_of(build(kind, base, "base").model_dump(), each.name)
    for other in _others(value, each.accepts):
        values = merge(base, nested(each.name, other))
        try:
            build(kind, values, "moved")
        except BadInput:
            continue
        return values
    raise LookupError(f"{each.name}: no other value is known beside {value!r}; state one")


def bounds_of(each: Parameter) -> tuple[list[float], list[float]]:
    """The values on the bounds of a number that it accepts, and some that it does not."""
    found = BOUND.match(each.accepts)
    accepted, refused = [], []
    for sign, text in re.findall(r"([<>]=?) (\S+)", found[1]) if found else ():
        bound = float(text)
        beyond = max(1e-9, 1e-9 * abs(bound)) if each.accepts.startswith("number") else 1
        if sign in (">=", "<="):
            accepted.append(bound)
        refused.append(bound if sign in "<>" else bound + (beyond if sign == "<=" else -beyond))
    return accepted, refused
