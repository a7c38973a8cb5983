"""Defines the one exception for what a user can mend, and what reaches standard error."""

import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import islice

# So many names stand in a sentence; among so many, none of them longer, one nearly the same is sought.
_NAMED, _COMPARED = 50, 2000


class BadInput(Exception):
    """States why input cannot be used: one sentence with the file, topic, field or option, and the mend.

    The command line prints the sentence and exits with 2; it never shows a traceback for it.
    """


class UnknownName(BadInput, KeyError):
    """Says that a name is not in a mapping; `in` and `get` take it as any KeyError."""

    __str__ = Exception.__str__  # the sentence, which KeyError would put in quotes


def choices(name: str, known: Collection[str]) -> str:
    """End a sentence on an unknown name: by the one that was probably meant, else all there are."""
    from difflib import get_close_matches  # for a mistake alone, not for every start

    few = len(known) <= _COMPARED and all(len(each) <= _COMPARED for each in (name, *known))
    near = [each for each in known if each.lower() == name.lower()]
    near = near or (get_close_matches(name, known, n=1) if few else [])
    near = near or [each for each in known if name and name in each]
    return f"did you mean '{near[0]}'?" if near else f"there are: {some_of(known) or 'none'}"


def some_of(names: Collection[object]) -> str:
    """Write names in a sentence: the first ones, and how many more there are."""
    more = len(names) - _NAMED
    return ", ".join(map(str, islice(names, _NAMED))) + (f" and {more} more" if more > 0 else "")


def check_format(path: object, stated: object, read: int) -> None:
    """Raise BadInput where a file states another format than the one that this fuselog reads."""
    if type(stated) is not int:
        raise BadInput(f"{path}: its format {stated!r} is none of fuselog's; write it again")
    if stated != read:
        age, mend = ("a newer", "update fuselog") if stated > read else ("an older", "write it again")
        raise BadInput(
            f"{path}: {age} version of fuselog wrote it (format {stated}, this version reads {read}); "
            f"{mend}"
        )


def ignore_warnings_of_numbers() -> None:
    """Keep NumPy's warnings of single operations off standard error, unless warnings are asked for.

    What overflows, or is not a number, is a finding, a doubt or an empty cell, each in its own words.
    """
    warnings.simplefilter("ignore", RuntimeWarning, append=True)


@contextmanager
def without_warnings_of_numbers() -> Iterator[None]:
    """Ignore them for a while: for a command, or, as a decorator, for a call from Python."""
    with warnings.catch_warnings():
        ignore_warnings_of_numbers()
        yield


def printable(text: str) -> str:
    """Write a text for a line of a terminal: control characters are shown by their numbers."""
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
