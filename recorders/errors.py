"""The one exception for what a user can mend, and how its sentences offer the right name."""

from collections.abc import Collection
from difflib import get_close_matches


class BadInput(Exception):
    """Input that no run can use: one sentence with the file, topic, field or option, and the mend.

    The command line prints the sentence and exits with 2; it never shows a traceback for it.
    """


def choices(name: str, known: Collection[str]) -> str:
    """The end of a sentence on an unknown name: the one that was probably meant, else all there are."""
    near = get_close_matches(name, known, n=1) or [each for each in known if name and name in each]
    return f"did you mean '{near[0]}'?" if near else f"there are: {', '.join(known) or 'none'}"
