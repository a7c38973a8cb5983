"""Reviewed texts: how they are kept, and in what a new one differs.

Words, signs and whole numbers are equal; other numbers are within a thousandth, or one of the last digit
that is printed: beside a border of rounding, processors that round differently print either neighbour.
Widths of columns and tables follow from the numbers and count for nothing.
"""

import re
from difflib import SequenceMatcher, unified_diff
from pathlib import Path

FOLDER = Path(__file__).with_name("stored")
RELATIVE = 1e-3
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")


def path_of(command: str) -> Path:
    """Where the text of a command is kept."""
    return FOLDER / f"{command}.txt"


def differences(stored: str, found: str) -> str:
    """The lines in which two texts differ, as a diff; empty where they say the same."""
    before, after = stored.splitlines(), found.splitlines()
    blocks = SequenceMatcher(
        None, [*map(_words, before)], [*map(_words, after)], autojunk=False
    ).get_matching_blocks()
    for block in blocks:
        for place in range(block.size):
            old, new = before[block.a + place], after[block.b + place]
            after[block.b + place] = old if _are_near(old, new) else new
    return "\n".join(unified_diff(before, after, "stored", "found", lineterm="", n=1))


def _words(line: str) -> str:
    """A line without its numbers, and without what follows from how long they are."""
    return re.sub(r"\s+", " ", re.sub("─+", "─", _NUMBER.sub("#", line))).strip()


def _are_near(old: str, new: str) -> bool:
    pairs = zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True)
    return all(one == other or _is_near(one, other) for one, other in pairs)


def _is_near(old: str, new: str) -> bool:
    if not {*old, *new} & {*".e"}:
        return False
    values = [float(each.replace(",", "")) for each in (old, new)]
    apart = abs(values[0] - values[1])
    return apart <= max(RELATIVE * abs(values[0]), 1.01 * min(map(_last_digit, (old, new))))


def _last_digit(number: str) -> float:
    """What one of the last digit is worth that a number is printed with."""
    digits, _, exponent = number.replace(",", "").partition("e")
    return float(10.0 ** (int(exponent or 0) - len(digits.partition(".")[2])))
