"""All texts: the help, the sentences that commands print, and made cases of those they may print."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from tests.words import commands, helps
from tests.words.made import (
    alarms,
    claims,
    comparing,
    deploying,
    diagnosing,
    edges,
    guessing,
    page,
    plausibility,
    reporting,
    sensing,
    tuning,
)

# By command, a case's title is its docstring, and it gives sentences that its command may print.
MADE: Mapping[str, tuple[Callable[[], Iterable[str]], ...]] = {
    "check": comparing.CHECKED,
    "compare": comparing.COMPARED,
    "deploy": deploying.DEPLOYED,
    "diagnose": diagnosing.DIAGNOSED,
    "explore": page.EXPLORED,
    "import": guessing.GUESSED,
    "info": plausibility.FOUND,
    "lint": edges.EDGES,
    "noise": sensing.SENSED,
    "replay": alarms.ALARMED,
    "report": reporting.REPORTED,
    "run": claims.CLAIMED,
    "tune": tuning.TUNED,
}


def everything(folder: Path) -> dict[str, str]:
    """The sentences of every command, and the help of all; an empty folder takes files."""
    found = commands.texts(folder)
    for command, cases in MADE.items():
        for case in cases:
            lines = [f"# {case.__doc__}", *case()]
            found[command] = "\n".join([*filter(None, [found.get(command)]), *lines]) + "\n"
    found["help"] = "\n".join(helps.in_words()) + "\n"
    return found
