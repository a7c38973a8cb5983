"""Patterns of file names: * and ? as in a shell, and {name} for text that gets a name.

The time for a match is limited by the lengths of pattern and name; a regular expression of `re` would
try all ways to divide a name among many stars.
"""

import re

_WILD = re.compile(r"(\{\w+\}|\*|\?)")


def names_in(pattern: str) -> list[str]:
    """Return the names in braces."""
    return [part[1:-1] for part in _WILD.split(pattern)[1::2] if part not in "*?"]


def fitted(pattern: str, name: str) -> dict[str, str] | None:
    """Match a name with a pattern; return the texts for the names in braces, or None.

    From the left, each name in braces and each star matches as many characters as possible, a name in
    braces at least one; neither matches a slash.
    """
    parts = _WILD.split(pattern)
    # bit k of a number: the rest of the pattern after a part matches the name from character k on
    following = [1 << len(name)]
    for index in range(len(parts) - 1, -1, -1):
        following.append(_before(parts[index], is_wild=index % 2 == 1, name=name, after=following[-1]))
    following.reverse()
    if not following[0] & 1:
        return None
    place, names = 0, {}
    for index, part in enumerate(parts):
        if index % 2 == 0 or part == "?":
            place += 1 if index % 2 else len(part)
            continue
        end = name.find("/", place)
        ends = following[index + 1] & ((2 << (len(name) if end < 0 else end)) - 1)
        begin, place = place, ends.bit_length() - 1
        if part != "*":
            names[part[1:-1]] = name[begin:place]
    return names


def _before(part: str, *, is_wild: bool, name: str, after: int) -> int:
    """Find where a part may begin if it ends at one of the positions in `after`."""
    if not is_wild:
        return sum(1 << place for place in _places(part, name) if after >> (place + len(part)) & 1)
    # bit k: character k is not a slash
    within = sum(1 << place for place, each in enumerate(name) if each != "/")
    found = after if part == "*" else after >> 1 & within
    width = 1
    while part != "?" and width <= len(name):  # extend every end to the left up to a slash
        found |= found >> width & within
        within &= within >> width
        width *= 2
    return found


def _places(part: str, name: str) -> list[int]:
    return [place for place in range(len(name) - len(part) + 1) if name.startswith(part, place)]
