"""All texts: what commands print, with made cases of sentences; claims, models, logs and timelines."""

from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path

from tests.claims import limits
from tests.words import commands
from tests.words.made import (
    alarms,
    claims,
    comparing,
    defaults,
    deploying,
    diagnosing,
    edges,
    guessing,
    modelled,
    page,
    plausibility,
    recorded,
    reporting,
    sensing,
    timelines,
    tuning,
)

# By command, a case's title is its docstring, and it gives sentences that its command may print.
MADE: Mapping[str, tuple[Callable[[], Iterable[str]], ...]] = {
    "check": comparing.CHECKED,
    "compare": comparing.COMPARED,
    "deploy": deploying.DEPLOYED,
    "diagnose": diagnosing.DIAGNOSED,
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
    """The text of every command, and what no command prints; an empty folder takes files."""
    found = commands.texts(folder)
    for command, cases in MADE.items():
        for case in cases:
            lines = [f"# {case.__doc__}", *case()]
            found[command] += "\n" + "\n".join(lines) + "\n"
    found["claims"] = "\n".join(limits.in_words()) + "\n"
    found["defaults"] = "\n".join(defaults.in_words()) + "\n"
    found["modelled"] = "\n".join(modelled.in_words()) + "\n"
    if find_spec("bokeh"):
        found["page"] = "\n".join(page.in_words()) + "\n"
    found["recorded"] = "\n".join(recorded.in_words()) + "\n"
    found["timelines"] = "\n".join(timelines.in_words(folder)) + "\n"
    return found
