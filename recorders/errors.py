"""The exception for errors that a user can correct, and helpers for messages on standard error."""

import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import islice

# How many names a message lists; how many names, and how long ones, are searched for a similar name.
_NAMED, _COMPARED = 50, 2000


class BadInput(Exception):
    """An error in the input: the message names the file, topic, field or option, and how to correct it.

    The command line prints the message and exits with code 2, without a traceback.
    """


class CannotWrite(BadInput):
    """An error of writing a file, such as a full disk, that would occur with any other input too."""


class UnknownName(BadInput, KeyError):
    """An error for an unknown name; also a KeyError, so that `in` and `get` of mappings still work."""

    __str__ = Exception.__str__  # KeyError would quote the message


def choices(name: str, known: Collection[str]) -> str:
    """Write the end of a message about an unknown name: the most similar name, or the available ones."""
    from difflib import get_close_matches  # imported only after a mistake, not at every start

    few = len(known) <= _COMPARED and all(len(each) <= _COMPARED for each in (name, *known))
    near = [each for each in known if each.lower() == name.lower()]
    near = near or (get_close_matches(name, known, n=1) if few else [])
    near = near or [each for each in known if name and name in each]
    return f"did you mean '{near[0]}'?" if near else f"available: {some_of(known) or 'none'}"


def some_of(names: Collection[object], most: int = _NAMED) -> str:
    """Join names for a message: the first ones, and how many more there are."""
    more = len(names) - most
    return ", ".join(map(str, islice(names, most))) + (f" and {more} more" if more > 0 else "")


def check_format(path: object, stated: object, read: int) -> None:
    """Raise BadInput if a file states a format other than the one that this version of fuselog reads."""
    if type(stated) is not int:
        raise BadInput(f"{path}: format {stated!r} is not a format of fuselog; write it again")
    if stated != read:
        age, remedy = ("a newer", "update fuselog") if stated > read else ("an older", "write it again")
        raise BadInput(
            f"{path}: {age} version of fuselog wrote it (format {stated}, this version reads {read}); "
            f"{remedy}"
        )


def ignore_warnings_of_numbers() -> None:
    """Suppress NumPy's warnings about single operations, unless the user enables warnings.

    Where overflows and NaN matter, they are reported as findings, warnings or empty cells.
    """
    warnings.simplefilter("ignore", RuntimeWarning, append=True)


@contextmanager
def without_warnings_of_numbers() -> Iterator[None]:
    """Ignore NumPy's warnings in a `with` block or in a decorated function."""
    with warnings.catch_warnings():
        ignore_warnings_of_numbers()
        yield


def printable(text: str) -> str:
    """Escape control characters, so that a text fits on a line of a terminal."""
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
