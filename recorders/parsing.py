"""Parsers for JSON and TOML from untrusted sources; anything unusable raises ValueError with a reason.

The parsers of the standard library also raise RecursionError, and accept values nested so deeply that
other code would exceed the recursion limit.
"""

import json
import math
import re
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from fuselog.recorders.errors import BadInput

# The parameters of recorders and estimators are tables of tables of lists: five levels.
DEEPEST = 50


def parse_json(text: str, *, constants: bool = False) -> Any:
    """Parse a JSON text; raise ValueError if it is malformed or nested too deeply.

    NaN, infinity and numbers beyond the range of a double are rejected, unless `constants` is True; NaN
    and infinity are then written as Python's json module writes them.
    """
    number = float if constants else _finite
    return _shallow(
        partial(json.loads, parse_int=_whole, parse_float=number, parse_constant=number), text
    )


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text; raise ValueError if it is malformed or nested too deeply."""
    if _DOTTED_TOO_DEEP.search(text):
        raise ValueError(_TOO_DEEP)
    return _shallow(_toml, text)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raise BadInput if it is missing or malformed."""
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read as TOML ({error})") from None


_TOO_DEEP = f"it is nested more than {DEEPEST} levels deep"
_TOO_LONG = f"it has a whole number of more than {sys.get_int_max_str_digits()} digits"
# tomllib stores every prefix of a dotted key: a key of 100,000 parts would use all memory.
_DOTTED_TOO_DEEP = re.compile(rf"(?<![^\s.])(?:[^\s.]++\s*+\.\s*+){{{DEEPEST}}}")


def _shallow(parse: Callable[[str], Any], text: str) -> Any:
    """Return the parsed value unless it is nested too deeply; a loop over levels avoids recursion."""
    try:
        value = parse(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level = [value]
    for _ in range(DEEPEST + 1):
        nested = [each for each in level if isinstance(each, dict | list)]
        if not nested:
            return value
        level = [
            inner for each in nested for inner in (each.values() if isinstance(each, dict) else each)
        ]
    raise ValueError(_TOO_DEEP)


def _toml(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:
        raise ValueError(_TOO_LONG) from None


def _whole(digits: str) -> int:
    try:
        return int(digits)
    except ValueError:
        raise ValueError(_TOO_LONG) from None


def _finite(number: str) -> float:
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"it has {number}, which is not a JSON number")
    return value
