"""Types for the warnings, causes and stress verdicts that results store next to their metrics.

`fuselog.pipeline.output.alarming` finds the warnings, `fuselog run --diagnose` finds the causes, and
`--stress` finds the verdicts.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, PlainSerializer

from fuselog.recorders.checks.finding import Finding


def as_alarm(found: Finding) -> dict[str, Any]:
    """Convert a finding about a judged replay to the form of results and `--json`."""
    return {
        "kind": found.kind,
        "estimator": found.where,
        "case": found.part,
        "excess": found.value,
        "words": found.sentence,
    }


def _of_alarm(value: Any) -> Any:
    """Rename the fields of a stored warning to those of a finding."""
    if not isinstance(value, dict):
        return value
    names = {"estimator": "where", "case": "part", "excess": "value", "words": "evidence"}
    return {names.get(name, name): each for name, each in value.items()}


Alarm = Annotated[Finding, BeforeValidator(_of_alarm), PlainSerializer(as_alarm)]  # in result.json


@dataclass(frozen=True)
class Cause:
    """The likeliest reason why an estimator is inconsistent, from a diagnosis.

    Attributes:
        estimator: the estimator's label.
        words: description of the cause in one sentence.
        short: description of the cause in a few words, for the report's first sentence.
        setting: the `--set` value that corrects the cause; empty if no setting does.
        mended: the outcome of the same runs with `setting`; empty if they were not replayed.
    """

    estimator: str
    words: str
    short: str
    setting: str = ""
    mended: str = ""


Verdict = Literal["harmless", "sensitive", "discontinuous or chaotic", "not tried"]
NOT_TESTED = "not stress-tested: --stress tests whether changes that should not matter change a verdict"


@dataclass(frozen=True)
class Stressing:
    """The effect on an estimator of changes that should not matter, over all runs.

    Attributes:
        estimator: the estimator's label.
        verdict: the worst verdict among those that more than 1 % of the runs have.
        words: the verdict with its numbers, then an explanation.
        moved: the largest change of a metric's mean over the runs, by `quantity.case`, and by `quantity`
            for all cases together.
    """

    estimator: str
    verdict: Verdict
    words: list[str]
    moved: Mapping[str, float] = field(default_factory=dict)
