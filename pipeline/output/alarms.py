"""Defines what makes a replay's numbers doubtful, and why: alarms and their likeliest causes.

`pipeline.output.alarming` finds the alarms, `fuselog run --diagnose` the causes.
"""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["innovations", "errors", "origin", "lever arm", "minimum", "unused", "gates"]


@dataclass(frozen=True)
class Alarm:
    """One of them.

    Attributes:
        kind: what it is about.
        estimator, case: whose; empty where it is of several.
        excess: how many times a number is beyond what a consistent filter leaves; worse ones are larger.
        words: the sentence.
    """

    kind: Kind
    estimator: str
    case: str
    excess: float
    words: str


@dataclass(frozen=True)
class Cause:
    """Why an estimator is likeliest inconsistent, as a diagnosis found it.

    Attributes:
        estimator: whose.
        words: the sentence.
        short: the same in a few words, for the report's first sentence.
        setting: what undoes it, as `--set` has it; empty where none does.
        mended: what came of the same runs with that; empty where they were not replayed.
    """

    estimator: str
    words: str
    short: str
    setting: str = ""
    mended: str = ""
