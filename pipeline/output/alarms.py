"""Defines what results store of doubts about their numbers: alarms, causes, verdicts of stress.

`fuselog.pipeline.output.alarming` finds alarms, `fuselog run --diagnose` causes, and `--stress` its
verdicts.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, PlainSerializer

from fuselog.recorders.checks.finding import Finding


def as_alarm(found: Finding) -> dict[str, Any]:
    """Return a finding about a judged replay as results and `--json` have it, an alarm."""
    return {
        "kind": found.kind,
        "estimator": found.where,
        "case": found.part,
        "excess": found.value,
        "words": found.sentence,
    }


def _of_alarm(value: Any) -> Any:
    """Return the fields of a finding for those of an alarm."""
    if not isinstance(value, dict):
        return value
    names = {"estimator": "where", "case": "part", "excess": "value", "words": "evidence"}
    return {names.get(name, name): each for name, each in value.items()}


Alarm = Annotated[Finding, BeforeValidator(_of_alarm), PlainSerializer(as_alarm)]  # in result.json


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
