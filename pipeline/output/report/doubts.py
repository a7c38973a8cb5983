"""Lists what is doubtful of a result, in a few words each, the worst first, for the first screen."""

from collections.abc import Callable, Sequence

from fuselog.pipeline.output.alarms import Alarm
from fuselog.pipeline.output.report.evidence import Findings, relation
from fuselog.pipeline.output.words import count, listed
from fuselog.replay.judging.errors.differences import FEWEST_RUNS

MOST_NAMED = 4  # more estimators are counted
# What the checks of a replay found, of the estimators that they found it of.
_OF_COVARIANCES = {"innovations": "innovations", "errors": "errors"}
_CHECKS: dict[str, Callable[[str], str]] = {
    "uninformed": lambda whose: (
        f"components that {whose} cannot estimate, as no measurement informs the method of them"
    ),
    "origin": lambda whose: (
        f"the error of {whose}, most of which is constant: truth and estimate may have other origins"
    ),
    "lever arm": lambda whose: (
        f"the error of {whose}, most of which turns along: the truth may be of another point of the body"
    ),
    "minimum": lambda whose: (
        f"the search of {whose}, which may have ended at a minimum that is not the least"
    ),
    "digits": lambda whose: f"the digits of {whose}, of whose covariances rounding leaves few or none",
    "unused": lambda whose: f"{whose}, as measurements came to nothing",
    "gates": lambda _: "likelihoods: the gates differ, so that they are of different measurements",
}


def doubts_of(found: Findings, alarms: Sequence[Alarm], take: str, equal: Sequence[str]) -> list[str]:
    """Return what is doubtful of estimators: `take` is the one to take, `equal` are those as good."""
    compared = found.compared if len(found.labels) > 1 else []
    return [
        *_of_covariances(found, alarms),
        *_of_checks(alarms),
        *_of_failures(found),
        *_of_cases(found, take, equal),
        *_of_chance(found, compared, take, equal),
        *_of_what_is_not_known(found),
    ]


def named(labels: Sequence[str], among: int = 0) -> str:
    """Name estimators where they are few; `among` is how many there are."""
    if len(labels) == among > 1:
        return "both" if among == 2 else f"all {among}"
    if len(labels) > MOST_NAMED:
        return f"{', '.join(labels[:MOST_NAMED])} and {len(labels) - MOST_NAMED} more"
    return listed(list(labels))


def _of_covariances(found: Findings, alarms: Sequence[Alarm]) -> list[str]:
    """Say whose covariances are not right, by what."""
    states = {label: each.state for label, each in found.of.items()}
    sentences = []
    diverged = [label for label in found.labels if found.of[label].has_diverged]
    if diverged:
        sentences.append(f"the estimates of {named(diverged, len(found.labels))}, which diverged")
    for size, state in (("small", "too sure"), ("large", "too careful")):
        whose = [label for label in found.labels if states[label] == state and label not in diverged]
        if whose:
            of = named(whose, len(found.labels))
            sentences.append(f"the covariances of {of}, which are too {size}")
    for kind, what in _OF_COVARIANCES.items():
        whose = [each.estimator for each in alarms if each.kind == kind]
        little = [label for label in dict.fromkeys(whose) if states.get(label) == "honest"]
        if little:
            sentences.append(
                f"the {what} of {named(little)}, which are off by little, but beyond chance"
            )
    return sentences


def _of_checks(alarms: Sequence[Alarm]) -> list[str]:
    """Say what else the checks of a replay found."""
    whose: dict[str, list[str]] = {}
    for each in alarms:
        if each.kind in _CHECKS:
            whose.setdefault(each.kind, []).append(each.estimator)
    return [_CHECKS[kind](named(list(dict.fromkeys(filter(None, of))))) for kind, of in whose.items()]


def _of_failures(found: Findings) -> list[str]:
    return [
        f"{label}, which failed in {each.failed} of {count(each.runs, 'run')}"
        for label, each in found.of.items()
        if each.failed and each.failed < each.runs
    ]


def _of_cases(found: Findings, take: str, equal: Sequence[str]) -> list[str]:
    """Say in how many cases another one errs less than the one to take."""
    best = found.least_in()
    others = {label: number for label, number in best.items() if label not in (take, *equal)}
    if not take or len(found.cases) < 2 or not others:
        return []
    who = [f"{label} in {number}" for label, number in sorted(others.items(), key=lambda each: -each[1])]
    return [
        f"that {take} is best everywhere, as in {sum(others.values())} of {len(found.cases)} cases "
        f"another one has the least {found.error_name} ({named(who)})"
    ]


def _of_chance(found: Findings, compared: Sequence[str], take: str, equal: Sequence[str]) -> list[str]:
    """Say what so few runs leave open."""
    runs = count(found.runs, "run")
    if compared and found.runs < FEWEST_RUNS:
        do = "does" if found.runs == 1 else "do"
        return [f"who is better, as {runs} {do} not tell differences from chance"]
    unclear = [label for label in equal if relation(found, take, label) == "unclear"]
    if unclear:
        return [f"who of {named([take, *unclear])} is better, which {runs} do not tell"]
    if len(compared) > 1 and found.by_run(take or compared[0], found.main).empty:
        return [
            f"whether differences are chance, as the result has no table of the {found.error_name} of "
            "single runs"
        ]
    return []


def _of_what_is_not_known(found: Findings) -> list[str]:
    """Say who was not judged, or not compared."""
    unknown = []
    unjudged = [
        label
        for label, each in found.of.items()
        if each.decisive is None and not found.has_any(label, "nees", "nis")
    ]
    if unjudged and found.main:
        whose = named(unjudged, len(found.labels))
        unknown.append(f"the covariances of {whose}, which nothing here judges")
    lacking = [label for label in found.labels if label not in found.compared]
    if lacking and found.compared:
        where = " in every case" if len(found.cases) > 1 else ""
        have = "has" if len(lacking) == 1 else "have"
        unknown.append(f"a comparison with {named(lacking)}, which {have} no {found.error_name}{where}")
    return unknown
