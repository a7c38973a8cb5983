"""Every function of every registered model in numbers: what its formulas give at two states.

Whatever a formula is given has a number that its name decides; derivatives, which are exact, are told by
the root mean square of those that are there.
"""

import re
from collections.abc import Iterator, Mapping
from zlib import crc32

import numpy as np

from replay.inference.estimators import registered_models
from replay.inference.formulas import formulas_by_function

_NAME = re.compile(r"[A-Za-z_]\w*")
_ENTRY = re.compile(r"[A-Za-z_]\w*(?:\[[^\]]*\]|(?:\.\w+)+)")
_HELPER = re.compile(r"v\d+")
_POSITIVE = re.compile("sigma|density|variance|probability|duration|mach|speed_of_sound|_per_s")
_WORDS = {"if", "else", "and", "or", "not", "abs", "True", "False"}


def in_words() -> Iterator[str]:
    """Of every model its functions, each with what it gives."""
    for name in sorted(registered_models()):
        yield f"# {name}"
        for function, lines in formulas_by_function(name).items():
            yield f"{function}:"
            for turn in ("one", "two"):
                yield f"  {', '.join(_told(_values(lines, turn)))}"
        yield ""


def _values(lines: list[str], turn: str) -> dict[str, float]:
    """What formulas define, in their order."""
    defined = [_ENTRY.sub(_named, line).partition(" = ") for line in lines]
    own = {name for name, _, _ in defined}
    used = {each for _, _, formula in defined for each in _NAME.findall(formula)} - own - _WORDS
    scope = {each: getattr(np, each, None) or _given(each, turn) for each in used}
    found: dict[str, float] = {}
    with np.errstate(all="ignore"):
        for name, _, formula in defined:
            found[name] = scope[name] = float(eval(formula, {**scope}))
    return found


def _named(entry: re.Match[str]) -> str:
    """An entry of a vector or matrix as a name."""
    return re.sub(r"\W+", "_", entry[0]).strip("_")


def _given(name: str, turn: str) -> float:
    """A number that its name decides: from -1 to 1, or from 1.1 to 2.1 of what is greater than zero."""
    share = crc32(f"{turn}{name}".encode()) % 1009 / 1009
    return 1.1 + share if _POSITIVE.search(name) else 2.0 * share - 1.0


def _told(values: Mapping[str, float]) -> Iterator[str]:
    slopes = [value for name, value in values.items() if name.startswith("d ")]
    for name, value in values.items():
        if not name.startswith("d ") and not _HELPER.fullmatch(name):
            yield f"{name} {value:.4g}"
    if slopes:
        yield f"derivatives ({len(slopes)}) {np.sqrt(np.mean(np.square(slopes))):.4g}"
