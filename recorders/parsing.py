"""Parses JSON and TOML from outside, or refuses them as the one kind of error that says why.

The parsers of the standard library also raise RecursionError, and accept what is nested so deeply that
any code that walks it would.
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
    """Read the value that a JSON text states; raises ValueError where there is none, or one too deep.

    Numbers that JSON does not know (NaN, and what is beyond the range of a double) are none, unless
    `constants` takes them as Python writes them.
    """
    number = float if constants else _finite
    return _shallow(
        partial(json.loads, parse_int=_whole, parse_float=number, parse_constant=number), text
    )


def parse_toml(text: str) -> dict[str, Any]:
    """Return the values of a TOML text; raises ValueError where it is malformed or too deep."""
    if _DOTTED_TOO_DEEP.search(text):
        raise ValueError(_TOO_DEEP)
    return _shallow(_toml, text)


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file's values; raises BadInput where it is missing or malformed."""
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read as TOML ({error})") from None


_TOO_DEEP = f"it is nested more than {DEEPEST} levels deep"
_TOO_LONG = f"it has a whole number of more than {sys.get_int_max_str_digits()} digits"
# tomllib keeps every beginning of a dotted key: one of 100,000 parts would take all memory.
_DOTTED_TOO_DEEP = re.compile(rf"(?<![^\s.])(?:[^\s.]++\s*+\.\s*+){{{DEEPEST}}}")


def _shallow(parse: Callable[[str], Any], text: str) -> Any:
    """Return the parsed value unless it is too deep; it goes by levels, as dotted keys never recurse."""
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
