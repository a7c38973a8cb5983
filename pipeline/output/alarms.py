"""Defines what makes a replay's numbers doubtful, and why: alarms, causes, verdicts of stress.

`fuselog.pipeline.output.alarming` finds alarms, `fuselog run --diagnose` causes, and `--stress` its
verdicts.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Kind = Literal[
    "innovations",
    "errors",
    "uninformed",
    "origin",
    "lever arm",
    "minimum",
    "digits",
    "unused",
    "gates",
]


@dataclass(frozen=True)
class Alarm:
    """Represents one reason to doubt the numbers of a replay.

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
    """Says why an estimator is likeliest inconsistent, as a diagnosis found it.

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


Verdict = Literal["harmless", "sensitive", "discontinuous or chaotic", "not tried"]
NOT_TESTED = "not stress-tested: --stress says whether changes that should not matter change a verdict"


@dataclass(frozen=True)
class Stressing:
    """States what changes that should not matter do to an estimator, over all runs.

    Attributes:
        estimator: whose.
        verdict: the worst that more than one of a hundred runs have.
        words: the verdict with its numbers, then what explains it.
        moved: how far a change moves the mean of a metric over the runs at most, by `quantity.case`, and
            by `quantity` over all cases.
    """

    estimator: str
    verdict: Verdict
    words: list[str]
    moved: Mapping[str, float] = field(default_factory=dict)
