"""Defines an alarm: what makes a replay's numbers doubtful; `pipeline.output.alarming` finds them."""

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
