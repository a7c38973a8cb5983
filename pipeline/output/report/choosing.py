"""Says which estimator to take: who cannot be believed, who errs least, who is as good."""

import math

from fuselog.pipeline.output.report.evidence import Evidence, Findings, relation
from fuselog.pipeline.output.words import listed

MOST_CARDS = 4


def broken_of(found: Findings) -> list[Evidence]:
    """List who cannot be believed: who fails, then who is too sure, the worst first."""

    def badness(each: Evidence) -> float:
        return math.inf if each.state == "failed" else each.decisive.factor if each.decisive else 0.0

    bad = [each for each in found.of.values() if each.state in ("failed", "too sure")]
    return sorted(bad, key=badness, reverse=True)


def choice_of(found: Findings) -> tuple[str, list[str]]:
    """Choose whom to take, empty where there is none, and who draws with it, of the believable.

    Of those that draw, whose covariances are too large comes last.
    """
    sound = [
        each
        for each in found.of.values()
        if each.error is not None and each.state not in ("failed", "too sure")
    ]
    if not sound:
        return "", []
    best = min(sound, key=lambda each: each.error.value if each.error else math.inf).estimator
    others = [each.estimator for each in sound if each.estimator != best]
    alike = ("draw", "unclear", "withheld")
    tied = [best, *(label for label in others if relation(found, best, label) in alike)]
    first, *equal = sorted(tied, key=lambda label: found.of[label].state == "too careful")
    return first, equal


def in_order(found: Findings, broken: list[Evidence], take: str, equal: list[str]) -> list[str]:
    """Order estimators: whom to take, who cannot be believed, worst first, the others by error."""
    rest = sorted(
        found.labels,
        key=lambda label: error.value if (error := found.of[label].error) else math.inf,
    )
    first = [each.estimator for each in broken]
    return list(dict.fromkeys([*filter(None, [take]), *equal, *first, *rest]))


def of_the_tied(found: Findings, tied: list[str]) -> tuple[str, list[str]]:
    """Choose whom to take of estimators that err alike, and these: not too careful ones, if any."""
    careful = [label for label in tied if found.of[label].state == "too careful"]
    left = [label for label in tied if label not in careful] or tied
    whom = left[0] if len(left) == 1 else "either" if len(left) == 2 else "any of them"
    if careful == tied:
        return f"take {whom}, but mend its covariance, which is too large", left
    if careful:
        whom = " or ".join(left) if len(left) <= MOST_CARDS else "any of the others"
        are = "is" if len(careful) == 1 else "are"
        return f"take {whom}, as {listed(careful)} {are} too careful", left
    return f"take {whom}", left
