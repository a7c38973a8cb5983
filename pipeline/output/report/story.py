"""The story of a result: advice, a card for each estimator, and the differences between estimators.

A story consists of sentences and numbers; the template only arranges them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from fuselog.pipeline.output.alarming import dominating_run
from fuselog.pipeline.output.alarms import Cause, Stressing
from fuselog.pipeline.output.report.evidence import (
    MARGIN,
    Evidence,
    Findings,
    Timings,
    is_withheld,
    relation,
)
from fuselog.pipeline.output.words import (
    MISSING,
    Scale,
    alike,
    count,
    interval,
    listed,
    number,
    quantity,
    scale,
)
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import some_of
from fuselog.replay.judging.diagnostics import LEAST_SHARE
from fuselog.replay.judging.intervals import FEWEST_RUNS, Interval
from fuselog.replay.judging.verdicts import ALIKE, MATERIAL, Comparison, Consistency, Squares

CHEAPER = 0.9  # a run time is mentioned if it is below this share of another's
TIMED_S = 0.02  # a run time is mentioned only if it was measured over at least this time

NONE_SOUND = "None of the estimators can be trusted with its current settings."
NONE_SOUND_AT_BEST = "Even at the point with its smallest error, none of the estimators can be trusted."
MOST_CARDS = 4
MOST_NAMED = 4  # more estimators than this are counted instead of named
# Warnings about a replay, phrased for the estimators concerned.
_OF_COVARIANCES = {"innovations": "innovations", "errors": "errors"}
_CHECKS: dict[str, Callable[[str], str]] = {
    "uninformed": lambda whose: (
        f"components that {whose} cannot estimate, because no measurement informs the method about them"
    ),
    "origin": lambda whose: (
        f"the error of {whose}, which is mostly constant: truth and estimate may have different origins"
    ),
    "lever arm": lambda whose: (
        f"the error of {whose}, which is mostly constant in the body frame: the truth may refer to "
        f"another point"
    ),
    "minimum": lambda whose: f"the search of {whose}, which may have ended at a local minimum",
    "digits": lambda whose: (
        f"the precision of {whose}, whose covariances have lost most of their digits to rounding"
    ),
    "unused": lambda whose: f"{whose}, because measurements were not used",
    "gates": lambda _: "likelihoods: the gates differ, so they are based on different measurements",
}
# The scale is logarithmic, from a third of the ideal value to ten times the ideal value.
GAUGE_ENDS = (1 / 3, 10.0)
Look = Literal["broken", "careful", "best", "fair", "claims"]


class Gauge(NamedTuple):
    """The position of a mean NEES or NIS, in percent of a scale from conservative to overconfident.

    Attributes:
        usual: the range that counts as consistent: the 95 % range, widened to include all small
            deviations.
        aim, value: the ideal value, and the measured one.
        spread: the 95 % interval of the value; both ends are the value if the interval is unknown.
        is_beyond: whether the value is beyond the end of the scale.
        words: a description for screen readers.
    """

    usual: tuple[float, float]
    aim: float
    value: float
    spread: tuple[float, float]
    is_beyond: bool
    words: str


@dataclass(frozen=True)
class Card:
    """The card of one estimator, with its accuracy, run time, and reasons not to trust it.

    A card with the look `claims` states how many of a result's claims are confirmed.
    """

    estimator: str
    look: Look
    mark: str
    chip: str
    value: str = ""
    unit: str = ""
    about: str = ""
    consistency: str = ""
    gauge: Gauge | None = None
    numbers: str = ""
    cause: Cause | None = None
    stress: Stressing | None = None
    notes: list[str] = field(default_factory=list)
    foot: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Story:
    """The opening of a page about a result.

    Attributes:
        verdict: advice on which estimator to use, the most important sentence first.
        cards: cards of estimators: the recommended one, then those that cannot be trusted.
        draws: sentences on pairs of estimators that cannot be distinguished; `differences` has those on
            pairs that can.
        left_out: estimators without a card.
        doubts: reasons to doubt the result, in a few words each, the worst first.
    """

    verdict: list[str]
    cards: list[Card] = field(default_factory=list)
    draws: list[str] = field(default_factory=list)
    differences: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def story(
    found: Findings,
    causes: Sequence[Cause] = (),
    timings: Timings | None = None,
    alarms: Sequence[Finding] = (),
    *,
    at_best: bool = False,
) -> Story:
    """Write the story of judged estimators; with `at_best`, each is at the point of its smallest error.

    Causes, run times and warnings are included if they are given.
    """
    known = [each for each in found.of.values() if each.error is not None]
    broken = broken_of(found)
    own = scale(quantity(found.main).unit, *(each.error.value for each in known if each.error))
    take, equal = choice_of(found)
    ordered = in_order(found, broken, take, equal)
    by_label = {each.estimator: each for each in causes}
    cards = [
        _card(found, found.of[label], take, equal, own, by_label.get(label), timings or {})
        for label in ordered[:MOST_CARDS]
    ]
    draws, differences = _pairs(found, take, ordered[:MOST_CARDS], own)
    none_sound = NONE_SOUND_AT_BEST if at_best else NONE_SOUND
    verdict = _verdict(found, broken, take, equal, own, by_label, timings or {}, none_sound)
    doubts = doubts_of(found, alarms, take, equal)
    return Story(verdict, cards, draws, differences, ordered[MOST_CARDS:], doubts)


def _verdict(
    found: Findings,
    broken: list[Evidence],
    take: str,
    equal: list[str],
    own: Scale,
    causes: dict[str, Cause],
    timings: Timings,
    none_sound: str,
) -> list[str]:
    """Write advice, then name the estimators that cannot be trusted, and the reasons."""
    if not found.labels:
        return []
    if len(found.labels) == 1:
        return _alone(found, found.of[found.labels[0]], own, causes)
    doubts = [_doubt(each, causes) for each in broken]
    named = [*doubts[:2], *([f"{count(len(doubts) - 2, 'other')} too."] if len(doubts) > 2 else [])]
    if not found.main or all(each.error is None for each in found.of.values()):
        return [_of_innovations(found), *named]
    if not take:
        least = min(broken, key=lambda each: each.error.value if each.error else math.inf)
        has = f"The smallest error is that of {least.estimator}, {_value(least.error, own)}."
        return [none_sound, *named, *([has] if least.error else [])]
    return [_advice(found, broken, take, equal, own, timings), *named]


def _advice(
    found: Findings,
    broken: list[Evidence],
    take: str,
    equal: list[str],
    own: Scale,
    timings: Timings,
) -> str:
    """Recommend an estimator, or explain that the one with the smallest error cannot be trusted."""
    error = found.of[take].error
    main = found.error_name
    better = [
        each
        for each in broken
        if each.error
        and error
        and each.error.value < (1.0 - MARGIN) * error.value
        and relation(found, take, each.estimator) not in ALIKE
    ]
    if better:
        best = min(better, key=lambda each: each.error.value if each.error else math.inf)
        return (
            f"{best.estimator} has the smallest error, {_value(best.error, own)}, but fix its "
            f"covariance "
            f"before you rely on it; of the others, {take} has the smallest error, {_value(error, own)}."
        )
    runs, cases = count(found.runs, "run"), len(found.cases)
    how = "RMS" if "rmse" in found.main else "mean"
    of_cases = f" ({how} of {cases} cases)" if cases > 1 else ""
    if equal:
        tied = [take, *equal]
        both = listed(tied) if len(tied) <= MOST_CARDS else f"{take} and {len(equal)} others"
        whom, left = of_the_tied(found, tied)
        if all(relation(found, take, each) == Comparison.TIE for each in equal):
            return f"{both} tie in {main}: {whom}{_cheapest(left, timings)}."
        if any(relation(found, take, each) == Comparison.WITHHELD for each in equal):
            return (
                f"No verdict between {both}: changes that should not matter change the {main} by more "
                "than these estimators differ."
            )
        return f"A tie so far: {runs} cannot distinguish {both}; {whom}."
    if all(relation(found, take, each) is None for each in found.labels if each != take):
        alone = "on this run" if found.runs == 1 else f"over {runs}"
        few = found.runs < FEWEST_RUNS
        tells = f"use {FEWEST_RUNS} or more runs" if few else "is not known"
        chance = f"; {'to rule out chance,' if few else 'whether by chance'} {tells}"
        return (
            f"Take {take}: it has the smallest {main} {alone}, {_value(error, own)}{of_cases}{chance}."
        )
    return f"Take {take}: it has the smallest {main}, {_value(error, own)}{of_cases}."


def _cheapest(labels: list[str], timings: Timings) -> str:
    """Name the fastest of equally good estimators, if the difference in run time matters."""
    of = sorted((timings.get(label, {}).get("seconds", 0.0), label) for label in labels)[:2]
    if len(of) < 2 or not TIMED_S < of[0][0] < CHEAPER * of[1][0]:
        return ""
    (least_s, first), (next_s, second) = of
    return f"; {first} takes {number(least_s / next_s, 2)} times as long as {second}"


def _alone(found: Findings, only: Evidence, own: Scale, causes: dict[str, Cause]) -> list[str]:
    """Describe the only estimator of a result."""
    error = f"{found.error_name} of {_value(only.error, own)} RMS"
    errs = f"{only.estimator} has a {error}" if only.error else ""
    if only.is_broken:
        return [*filter(None, [errs and f"{errs}."]), _doubt(only, causes)]
    if only.decisive is None:
        return [f"{errs}; whether its covariance is right is unknown." if errs else ""]
    believed = _claim(only, found.runs)
    return [f"{errs}; {believed}." if errs else f"{only.estimator}: {believed}."]


def _of_innovations(found: Findings) -> str:
    """Describe the consistency of innovations, if there is no truth."""
    right = [each.estimator for each in found.of.values() if each.verdict == Consistency.CONSISTENT]
    without = "Without a truth, errors are unknown"
    if not right:
        return f"{without}."
    is_are = "is" if len(right) == 1 else "are"
    return f"{without}; according to the innovations, {listed(right)} {is_are} consistent."


def _value(error: Interval | None, own: Scale) -> str:
    return own.with_unit(error.value) if error else MISSING


def _doubt(each: Evidence, causes: dict[str, Cause]) -> str:
    """Explain in a sentence why an estimator cannot be trusted."""
    if each.decisive is None or each.decisive.verdict != Consistency.OVERCONFIDENT:
        return f"{each.estimator} fails in every run."
    how = "is overconfident" if each.decisive.is_far else "is slightly overconfident"
    how = "diverged" if each.has_diverged else how
    sure = f"{each.estimator} {how}: {_claim(each, 0)}"
    cause = causes.get(each.estimator)
    return f"{sure}. The likeliest cause: {cause.short}." if cause else f"{sure}."


def _times(factor: float) -> str:
    return f"{number(factor, 2)} times"


def _claim(each: Evidence, runs: int) -> str:
    """Describe in a few words how errors compare with the covariance that the estimator states."""
    by = each.decisive
    if by is None:
        return "its covariance was not judged"
    what = "innovations" if by.name == "NIS" else "errors"
    if by.verdict == Consistency.OVERCONFIDENT:
        return f"its {what} are {_times(by.factor)} what it states"
    if by.verdict == Consistency.CONSERVATIVE:
        return f"its {what} are {number(by.factor, 2)} times what it states"
    if runs == 1 and by.name != "NIS" and len(each.squares) == 1:
        return "one run does not show that it is inconsistent"
    return f"its {what} are as large as it states"


def _card(
    found: Findings,
    each: Evidence,
    take: str,
    equal: list[str],
    own: Scale,
    cause: Cause | None,
    timings: Timings,
) -> Card:
    look, mark, chip = _chip(found, each, take, equal)
    claim = _claim(each, found.runs)
    notes, stress = _notes(found, each, take, equal), found.stress.get(each.estimator)
    card = Card(each.estimator, look, mark, chip, cause=cause, stress=stress, notes=notes)
    if each.error is not None:
        about, value = quantity(found.main).name, own.text(each.error.value)
        if each.error.is_bounded:
            value, low, high = alike(each.error[:3], own)
            about += f"; 95 % {low} to {high}"
        card = replace(card, value=value, unit=own.sign, about=about)
    if each.decisive is not None:
        card = replace(
            card,
            consistency=claim[0].upper() + claim[1:],
            gauge=gauge(each.decisive),
            numbers=numbers_of(each.decisive),
        )
    return replace(card, foot=_foot(each, take, timings))


def _chip(found: Findings, each: Evidence, take: str, equal: list[str]) -> tuple[Look, str, str]:
    """Return the look, the mark and the label of a card."""
    verdict = each.verdict
    if each.has_failed:
        return "broken", "✕", "Fails in every run"
    if verdict == Consistency.OVERCONFIDENT:
        if each.has_diverged:
            return "broken", "✕", "Diverged"
        is_far = each.decisive is None or each.decisive.is_far
        return ("broken", "✕", "Overconfident") if is_far else ("careful", "✕", "Slightly overconfident")
    if each.estimator in (take, *equal) and len(found.labels) > 1:
        others = [label for label in (take, *equal) if label != each.estimator]
        as_who = listed(others) if len(others) < MOST_CARDS else f"{len(others)} others"
        if others and verdict == Consistency.CONSERVATIVE:
            return "careful", "○", f"As accurate as {as_who}, but conservative"
        return "best", "✓", f"As good as {as_who}" if others else "Take this one"
    if verdict == Consistency.CONSERVATIVE:
        return "careful", "○", "Conservative"
    is_right = verdict == Consistency.CONSISTENT
    if take and each.estimator != take:
        return "fair", "○", "Consistent, less accurate" if is_right else "Less accurate"
    return "fair", "○", "Consistent" if is_right else "Not judged"


def _notes(found: Findings, each: Evidence, take: str, equal: list[str]) -> list[str]:
    """Collect remarks for a card."""
    notes = _of_tracks(found, each.estimator)
    best = found.of[take].error if take else None
    if each.estimator == take and len(found.labels) > 1 and not equal:
        notes += _in_how_many(found, take)
    elif best and each.error and best.value and each.error.value > 1.05 * best.value:
        notes.append(f"{number(each.error.value / best.value, 2)} times the error of {take}.")
    if one_run := dominating_run(found.by_run(each.estimator, "nees")):
        notes.append(f"Mean NEES: {one_run}.")
    outside, cases = each.outside
    if cases > 1:
        notes.append(f"Its NEES is outside its interval in {outside} of {cases} cases.")
    if each.squares[1:] and each.decisive is each.squares[0] and found.runs == 1:
        nis = number(each.squares[1].found.value)
        notes.append(f"The NIS of its innovations is {nis} per component; 1 is ideal.")
    if each.age_s:
        own = scale("s", each.age_s)
        age = f"{own.text(each.age_s)} {own.sign}"
        notes.append(f"Its estimates are on average {age} old when they become available.")
    if each.share < LEAST_SHARE:
        notes.append(f"It estimated {number(100 * each.share)} % of the time.")
    return notes


def _of_tracks(found: Findings, label: str) -> list[str]:
    """Summarise a tracker's missed targets, false targets and identity switches."""
    counts = []
    for key, words in (("missed_targets", "missed"), ("false_targets", "false")):
        values = found.values(label, key)
        counts += [f"{number(sum(values) / len(values), 2)} {words}"] if values else []
    sentences = [f"Targets on average: {listed(counts)}."] if counts else []
    switches = found.values(label, "switches")
    if switches:
        a_run = number(sum(switches) / len(switches), 2)
        sentences.append(f"Identity switches: {a_run} per run.")
    return sentences


def _in_how_many(found: Findings, take: str) -> list[str]:
    """Count the cases, or the runs of a single case, in which `take` has the smallest error."""
    import pandas as pd

    if len(found.cases) > 1:
        return [f"Smallest error in {found.least_in()[take]} of {len(found.cases)} cases."]
    every = pd.concat(
        {label: found.by_run(label, found.main) for label in found.labels}, axis=1
    ).dropna()
    if len(every) < 2 or len(every.columns) < 2:
        return []
    best = int((every.idxmin(axis=1) == take).sum())
    which = "each of the" if best == len(every) else f"{best} of the"
    return [f"Smallest error in {which} {count(len(every), 'run')}."]


def _foot(each: Evidence, take: str, timings: Timings) -> list[str]:
    """Write the run time, also relative to the recommended estimator, and the number of failures."""
    foot = []
    own, best = (timings.get(label, {}) for label in (each.estimator, take))
    seconds, messages = own.get("seconds", 0.0), own.get("messages", 0.0)
    if seconds > 0.0 and messages > 0.0:
        one_s = seconds / messages
        beside = ""
        if each.estimator != take and best.get("seconds", 0.0) > 0.0:
            beside = _beside(seconds / best["seconds"], take)
        foot.append(f"{scale('s', one_s).with_unit(one_s, 2)} per message{beside}")
    if each.failed is not None:
        foot.append(f"{each.failed:,} of {count(each.runs, 'run')} failed")
    return foot


def _beside(factor: float, take: str) -> str:
    """Compare an estimator's run time with that of the recommended one."""
    if CHEAPER <= factor <= 1.0 / CHEAPER:
        return f"; a run takes as long as with {take}"
    return f"; a run takes {number(factor, 2)} times as long as with {take}"


def _pairs(found: Findings, take: str, labels: list[str], own: Scale) -> tuple[list[str], list[str]]:
    """Describe the pairs of estimators that cannot be distinguished, and the significant differences."""
    draws, differences = [], []
    main = found.error_name
    for label in labels if take else ():
        difference = found.difference(take, label, found.main, "low") if label != take else None
        is_tie = difference is not None and difference.verdict == Comparison.TIE
        if difference is None or not (is_tie or difference.more.is_bounded):
            continue
        more = difference.more
        size = abs(more.value)
        near = scale(quantity(found.main).unit, size or own.factor)
        ends = f"95 % {interval(more.low, more.high, near)} {near.sign}".rstrip()
        if is_tie:
            exactly = "are equal" if not size else f"differ by {near.with_unit(size)} on average, {ends}"
            draws.append(f"In {main}, {take} and {label} cannot be distinguished: they {exactly}.")
        elif difference.verdict == Comparison.UNDECIDED:
            runs = count(difference.runs, "run")
            draws.append(f"In {main}, {runs} do not distinguish {take} from {label}: {ends}.")
        elif is_withheld(found, take, label, size):
            moved = near.with_unit(found.stressed(take, label))
            draws.append(
                f"In {main}, the verdict on {take} and {label} is withheld: they differ by "
                f"{near.with_unit(size)} on average, and changes that should not matter change one by "
                f"{moved}."
            )
        else:
            errs = (
                f"{near.with_unit(size)} {'larger' if more.value > 0 else 'smaller'} than that of {take}"
            )
            differences.append(f"The error of {label} is {errs} on average over the runs ({ends}).")
    return draws, differences


# The choice of an estimator


def broken_of(found: Findings) -> list[Evidence]:
    """List the estimators that cannot be trusted, failing ones first, then the most overconfident."""

    def badness(each: Evidence) -> float:
        return math.inf if each.has_failed else each.decisive.factor if each.decisive else 0.0

    bad = [each for each in found.of.values() if each.is_broken]
    return sorted(bad, key=badness, reverse=True)


def choice_of(found: Findings) -> tuple[str, list[str]]:
    """Choose the trusted estimator to use ("" if no estimator is trusted), and list those tied with it.

    Conservative estimators come last among those that tie.
    """
    sound = [each for each in found.of.values() if each.error is not None and not each.is_broken]
    if not sound:
        return "", []
    best = min(sound, key=lambda each: each.error.value if each.error else math.inf).estimator
    others = [each.estimator for each in sound if each.estimator != best]
    tied = [best, *(label for label in others if relation(found, best, label) in ALIKE)]
    first, *equal = sorted(tied, key=lambda label: found.of[label].verdict == Consistency.CONSERVATIVE)
    return first, equal


def in_order(found: Findings, broken: list[Evidence], take: str, equal: list[str]) -> list[str]:
    """Order estimators: recommended ones, untrusted ones (worst first), then all others by error."""
    rest = sorted(
        found.labels,
        key=lambda label: error.value if (error := found.of[label].error) else math.inf,
    )
    first = [each.estimator for each in broken]
    return list(dict.fromkeys([*filter(None, [take]), *equal, *first, *rest]))


def of_the_tied(found: Findings, tied: list[str]) -> tuple[str, list[str]]:
    """Recommend one of the tied estimators, a conservative one only if all of them are conservative."""
    careful = [label for label in tied if found.of[label].verdict == Consistency.CONSERVATIVE]
    left = [label for label in tied if label not in careful] or tied
    whom = left[0] if len(left) == 1 else "either" if len(left) == 2 else "any of them"
    if careful == tied:
        return f"take {whom}, but reduce its covariance, which is too large", left
    if careful:
        whom = " or ".join(left) if len(left) <= MOST_CARDS else "any of the others"
        are = "is" if len(careful) == 1 else "are"
        return f"take {whom}, because {listed(careful)} {are} conservative", left
    return f"take {whom}", left


# Doubts


def doubts_of(found: Findings, alarms: Sequence[Finding], take: str, equal: Sequence[str]) -> list[str]:
    """List the doubts about a result; `take` is the recommended estimator, `equal` are tied with it."""
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
    """Name estimators, or count them if there are many; `among` is the total number of estimators."""
    if len(labels) == among > 1:
        return "both" if among == 2 else f"all {among}"
    return some_of(labels, MOST_NAMED) if len(labels) > MOST_NAMED else listed(list(labels))


def _of_covariances(found: Findings, alarms: Sequence[Finding]) -> list[str]:
    """List the estimators with wrong covariances, and what is wrong with them."""
    verdicts = {label: each.verdict for label, each in found.of.items()}
    sentences = []
    diverged = [label for label in found.labels if found.of[label].has_diverged]
    if diverged:
        sentences.append(f"the estimates of {named(diverged, len(found.labels))}, which diverged")
    for size, verdict in (("small", Consistency.OVERCONFIDENT), ("large", Consistency.CONSERVATIVE)):
        whose = [label for label in found.labels if verdicts[label] == verdict and label not in diverged]
        if whose:
            of = named(whose, len(found.labels))
            sentences.append(f"the covariances of {of}, which are too {size}")
    for kind, what in _OF_COVARIANCES.items():
        whose = [each.where for each in alarms if each.kind == kind]
        little = [
            label for label in dict.fromkeys(whose) if verdicts.get(label) == Consistency.CONSISTENT
        ]
        if little:
            sentences.append(f"the {what} of {named(little)}, which are slightly but significantly off")
    return sentences


def _of_checks(alarms: Sequence[Finding]) -> list[str]:
    """List the other warnings of a replay."""
    whose: dict[str, list[str]] = {}
    for each in alarms:
        if each.kind in _CHECKS:
            whose.setdefault(each.kind, []).append(each.where)
    return [_CHECKS[kind](named(list(dict.fromkeys(filter(None, of))))) for kind, of in whose.items()]


def _of_failures(found: Findings) -> list[str]:
    return [
        f"{label}, which failed in {each.failed} of {count(each.runs, 'run')}"
        for label, each in found.of.items()
        if each.failed and each.failed < each.runs
    ]


def _of_cases(found: Findings, take: str, equal: Sequence[str]) -> list[str]:
    """Count the cases in which another estimator has a smaller error than the recommended one."""
    best = found.least_in()
    others = {label: number for label, number in best.items() if label not in (take, *equal)}
    if not take or len(found.cases) < 2 or not others:
        return []
    who = [f"{label} in {number}" for label, number in sorted(others.items(), key=lambda each: -each[1])]
    return [
        f"that {take} is best everywhere, because in {sum(others.values())} of {len(found.cases)} cases "
        f"another estimator has the smallest {found.error_name} ({named(who)})"
    ]


def _of_chance(found: Findings, compared: Sequence[str], take: str, equal: Sequence[str]) -> list[str]:
    """List the questions for which the number of runs is too small."""
    runs = count(found.runs, "run")
    if compared and found.runs < FEWEST_RUNS:
        do = "does" if found.runs == 1 else "do"
        return [f"which one is better, because {runs} {do} not distinguish differences from chance"]
    unclear = [label for label in equal if relation(found, take, label) == Comparison.UNDECIDED]
    if unclear:
        return [f"which of {named([take, *unclear])} is better, which {runs} do not decide"]
    if len(compared) > 1 and found.by_run(take or compared[0], found.main).empty:
        return [
            f"whether differences are due to chance, because the result has no table of the "
            f"{found.error_name} of individual runs"
        ]
    return []


def _of_what_is_not_known(found: Findings) -> list[str]:
    """List the estimators that were not judged, or not compared."""
    unknown = []
    unjudged = [
        label
        for label, each in found.of.items()
        if each.decisive is None and not found.has_any(label, "nees", "nis")
    ]
    if unjudged and found.main:
        whose = named(unjudged, len(found.labels))
        unknown.append(f"the covariances of {whose}, which were not judged")
    lacking = [label for label in found.labels if label not in found.compared]
    if lacking and found.compared:
        where = " in every case" if len(found.cases) > 1 else ""
        have = "has" if len(lacking) == 1 else "have"
        unknown.append(f"a comparison with {named(lacking)}, which {have} no {found.error_name}{where}")
    return unknown


# Gauge


def numbers_of(by: Squares) -> str:
    """Write a mean NEES or NIS with its interval, and the ideal value."""
    name = "NIS per component" if by.name == "NIS" else by.name
    if not by.found.is_bounded:
        return f"{name} {number(by.found.value)}; {number(by.aim)} is ideal"
    found, low, high = alike(by.found[:3], Scale())
    return f"{name} {found} (95 % {low} to {high}); {number(by.aim)} is ideal"


def gauge(by: Squares) -> Gauge:
    """Find the position of a mean NEES or NIS on the scale of a gauge."""

    def place(value: float) -> float:
        low, high = map(math.log, GAUGE_ENDS)
        share = (math.log(max(value, 1e-12) / by.aim) - low) / (high - low)
        return round(100.0 * min(max(share, 0.0), 1.0), 2)

    low, high = by.usual
    found = by.found
    spread = (found.low, found.high) if found.is_bounded else (found.value, found.value)
    words = f"{numbers_of(by)}; for a consistent estimator {interval(low, high, Scale())}"
    is_beyond = not GAUGE_ENDS[0] < found.value / by.aim < GAUGE_ENDS[1]
    ends = (place(spread[0]), place(spread[1]))
    box = min(low, (1.0 - MATERIAL) * by.aim), max(high, (1.0 + MATERIAL) * by.aim)
    return Gauge(
        (place(box[0]), place(box[1])), place(by.aim), place(found.value), ends, is_beyond, words
    )
