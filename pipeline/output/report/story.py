"""Tells the story of a result: what was tried, what to do, a card per estimator, what differs.

It is data: sentences and numbers. The template only sets it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from fuselog.pipeline.output.alarming import dominating_run
from fuselog.pipeline.output.alarms import Alarm, Cause, Stressing
from fuselog.pipeline.output.report import choosing
from fuselog.pipeline.output.report.doubts import doubts_of
from fuselog.pipeline.output.report.evidence import (
    MARGIN,
    Evidence,
    Findings,
    Spread,
    Timings,
    is_withheld,
    relation,
)
from fuselog.pipeline.output.report.gauge import Gauge, gauge, numbers_of
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
from fuselog.replay.judging.diagnostics import LEAST_SHARE
from fuselog.replay.judging.errors.differences import FEWEST_RUNS

CHEAPER = 0.9  # a time that is less than this of another's is worth a word,
TIMED_S = 0.02  # if it was measured for so long

NONE_SOUND = "Believe none of them as they are set."
NONE_SOUND_AT_BEST = "Where each errs least, none of them can be believed."
Look = Literal["broken", "careful", "best", "fair", "claims"]


@dataclass(frozen=True)
class Card:
    """What is said of one estimator: how good it is, if it can be believed, why not, what it costs.

    The look `claims` is of the card that says how many of a result's claims hold.
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
    """Says what a page says of a result, first of all.

    Attributes:
        verdict: what to do, the most important sentence first.
        cards: of the estimators, whom to take first, then who cannot be believed.
        draws: sentences on pairs that cannot be told apart, differences: on those that can.
        left_out: estimators that have no card.
        doubts: what is doubtful, in a few words each, the worst first.
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
    alarms: Sequence[Alarm] = (),
    *,
    at_best: bool = False,
) -> Story:
    """Return the story of estimators that were judged; `at_best`, each at the point where it errs least.

    Causes, what each cost, and alarms are told where they are known.
    """
    known = [each for each in found.of.values() if each.error is not None]
    broken = choosing.broken_of(found)
    own = scale(quantity(found.main).unit, *(each.error.value for each in known if each.error))
    take, equal = choosing.choice_of(found)
    ordered = choosing.in_order(found, broken, take, equal)
    by_label = {each.estimator: each for each in causes}
    cards = [
        _card(found, found.of[label], take, equal, own, by_label.get(label), timings or {})
        for label in ordered[: choosing.MOST_CARDS]
    ]
    draws, differences = _pairs(found, take, ordered[: choosing.MOST_CARDS], own)
    none_sound = NONE_SOUND_AT_BEST if at_best else NONE_SOUND
    verdict = _verdict(found, broken, take, equal, own, by_label, timings or {}, none_sound)
    doubts = doubts_of(found, alarms, take, equal)
    return Story(verdict, cards, draws, differences, ordered[choosing.MOST_CARDS :], doubts)


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
    """Say what to do, then who cannot be believed, and why."""
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
        has = f"The least error has {least.estimator}, {_value(least.error, own)}."
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
    """Say whom to take; or that who errs least is not to be believed."""
    error = found.of[take].error
    main = found.error_name
    better = [
        each
        for each in broken
        if each.error
        and error
        and each.error.value < (1.0 - MARGIN) * error.value
        and relation(found, take, each.estimator) in ("beyond chance", "untold")
    ]
    if better:
        best = min(better, key=lambda each: each.error.value if each.error else math.inf)
        return (
            f"{best.estimator} errs least, {_value(best.error, own)}, but mend it before you believe "
            f"its covariance; of the others {take} errs least, {_value(error, own)}."
        )
    runs, cases = count(found.runs, "run"), len(found.cases)
    how = "RMS" if "rmse" in found.main else "mean"
    of_cases = f" ({how} of {cases} cases)" if cases > 1 else ""
    if equal:
        tied = [take, *equal]
        both = listed(tied) if len(tied) <= choosing.MOST_CARDS else f"{take} and {len(equal)} others"
        whom, left = choosing.of_the_tied(found, tied)
        if all(relation(found, take, each) == "draw" for each in equal):
            return f"{both} tie in {main}: {whom}{_cheapest(left, timings)}."
        if any(relation(found, take, each) == "withheld" for each in equal):
            return (
                f"No verdict between {both}: changes that should not matter move the {main} "
                "farther than they differ."
            )
        return f"A tie so far: {runs} do not tell {both} apart; {whom}."
    if all(relation(found, take, each) == "untold" for each in found.labels if each != take):
        alone = "on this run" if found.runs == 1 else f"over {runs}"
        few = found.runs < FEWEST_RUNS
        tells = f"{FEWEST_RUNS} runs or more tell" if few else "is not known"
        chance = f"; whether by chance{',' if few else ''} {tells}"
        return f"Take {take}: it has the least {main} {alone}, {_value(error, own)}{of_cases}{chance}."
    return f"Take {take}: it has the least {main}, {_value(error, own)}{of_cases}."


def _cheapest(labels: list[str], timings: Timings) -> str:
    """Say who of equally good estimators needs the least time, where that is known and matters."""
    of = sorted((timings.get(label, {}).get("seconds", 0.0), label) for label in labels)[:2]
    if len(of) < 2 or not TIMED_S < of[0][0] < CHEAPER * of[1][0]:
        return ""
    (least_s, first), (next_s, second) = of
    return f"; {first} needs {number(least_s / next_s, 2)} times the time of {second}"


def _alone(found: Findings, only: Evidence, own: Scale, causes: dict[str, Cause]) -> list[str]:
    """Say what there is of the only estimator."""
    error = f"{found.error_name} of {_value(only.error, own)} RMS"
    errs = f"{only.estimator} has a {error}" if only.error else ""
    if only.state in ("too sure", "failed"):
        return [*filter(None, [errs and f"{errs}."]), _doubt(only, causes)]
    if only.decisive is None:
        return [f"{errs}; whether its covariance is right is not known." if errs else ""]
    believed = _claim(only, found.runs)
    return [f"{errs}; {believed}." if errs else f"{only.estimator}: {believed}."]


def _of_innovations(found: Findings) -> str:
    """Say what is known without a truth."""
    honest = [each.estimator for each in found.of.values() if each.state == "honest"]
    without = "Without a truth nobody's error is known"
    if not honest:
        return f"{without}."
    is_are = "is" if len(honest) == 1 else "are"
    return f"{without}; by the innovations {listed(honest)} {is_are} honest."


def _value(error: Spread | None, own: Scale) -> str:
    return own.with_unit(error.value) if error else MISSING


def _doubt(each: Evidence, causes: dict[str, Cause]) -> str:
    """Say in a sentence why an estimator is not to be believed."""
    if each.decisive is None or each.decisive.state != "too sure":
        return f"{each.estimator} fails in every run."
    how = "is overconfident" if each.decisive.is_far else "is slightly overconfident"
    how = "diverged" if each.has_diverged else how
    sure = f"{each.estimator} {how}: {_claim(each, 0)}"
    cause = causes.get(each.estimator)
    return f"{sure}. The likeliest cause: {cause.short}." if cause else f"{sure}."


def _times(factor: float) -> str:
    return f"{number(factor, 2)} times"


def _claim(each: Evidence, runs: int) -> str:
    """Say in a few words what errors are to what is claimed of them."""
    by = each.decisive
    if by is None:
        return "its covariance was not judged"
    what = "innovations" if by.name == "NIS" else "errors"
    if by.state == "too sure":
        return f"its {what} are {_times(by.factor)} what it states"
    if by.state == "too careful":
        return f"its {what} are {number(by.factor, 2)} of what it states"
    if runs == 1 and by.name != "NIS" and each.also is None:
        return "one run does not show it to be inconsistent"
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
        if each.error.is_known:
            value, low, high = alike(each.error, own)
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
    """Return how a card looks, its sign, and its word."""
    state = each.state
    if state == "failed":
        return "broken", "✕", "Fails in every run"
    if state == "too sure":
        if each.has_diverged:
            return "broken", "✕", "Diverged"
        is_far = each.decisive is None or each.decisive.is_far
        return ("broken", "✕", "Overconfident") if is_far else ("careful", "✕", "Slightly overconfident")
    if each.estimator in (take, *equal) and len(found.labels) > 1:
        others = [label for label in (take, *equal) if label != each.estimator]
        as_who = listed(others) if len(others) < choosing.MOST_CARDS else f"{len(others)} others"
        if others and state == "too careful":
            return "careful", "○", f"As accurate as {as_who}, but too careful"
        return "best", "✓", f"As good as {as_who}" if others else "Take this one"
    if state == "too careful":
        return "careful", "○", "Too careful"
    honest = "Honest" if state == "honest" else "Not judged"
    if take and each.estimator != take:
        return "fair", "○", f"{honest}, less accurate" if state == "honest" else "Less accurate"
    return "fair", "○", honest


def _notes(found: Findings, each: Evidence, take: str, equal: list[str]) -> list[str]:
    """Say what else is worth a sentence."""
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
    if each.also is not None and each.decisive is each.consistency and found.runs == 1:
        notes.append(
            f"By its innovations, NIS is {number(each.also.found.value)} per component; 1 is right."
        )
    if each.share < LEAST_SHARE:
        notes.append(f"It estimated {number(100 * each.share)} % of the time.")
    return notes


def _of_tracks(found: Findings, label: str) -> list[str]:
    """Say what a tracker misses, invents and mixes up, on average."""
    counts = []
    for key, words in (("missed_targets", "missed"), ("false_targets", "false")):
        values = found.values(label, key)
        counts += [f"{number(sum(values) / len(values), 2)} {words}"] if values else []
    sentences = [f"Targets at a time: {listed(counts)}."] if counts else []
    switches = found.values(label, "switches")
    if switches:
        a_run = number(sum(switches) / len(switches), 2)
        sentences.append(f"Switches of identity: {a_run} a run.")
    return sentences


def _in_how_many(found: Findings, take: str) -> list[str]:
    """Say in how many cases the best is the best, or in how many runs of the only one."""
    import pandas as pd

    if len(found.cases) > 1:
        return [f"Least in {found.least_in()[take]} of {len(found.cases)} cases."]
    every = pd.concat(
        {label: found.by_run(label, found.main) for label in found.labels}, axis=1
    ).dropna()
    if len(every) < 2 or len(every.columns) < 2:
        return []
    best = int((every.idxmin(axis=1) == take).sum())
    which = "each of the" if best == len(every) else f"{best} of the"
    return [f"Least error in {which} {count(len(every), 'run')}."]


def _foot(each: Evidence, take: str, timings: Timings) -> list[str]:
    """Say what it cost, also beside the one to take, and how often it failed."""
    foot = []
    own, best = (timings.get(label, {}) for label in (each.estimator, take))
    seconds, messages = own.get("seconds", 0.0), own.get("messages", 0.0)
    if seconds > 0.0 and messages > 0.0:
        one_s = seconds / messages
        beside = ""
        if each.estimator != take and best.get("seconds", 0.0) > 0.0:
            beside = _beside(seconds / best["seconds"], take)
        foot.append(f"{scale('s', one_s).with_unit(one_s, 2)} a message{beside}")
    if each.failed is not None:
        foot.append(f"{each.failed:,} of {count(each.runs, 'run')} failed")
    return foot


def _beside(factor: float, take: str) -> str:
    """Say how much time an estimator needs, beside the one to take."""
    if CHEAPER <= factor <= 1.0 / CHEAPER:
        return f"; a run takes as long as with {take}"
    return f"; a run takes {number(factor, 2)} times as long as with {take}"


def _pairs(found: Findings, take: str, labels: list[str], own: Scale) -> tuple[list[str], list[str]]:
    """Say which estimators cannot be told apart, and what differences are beyond chance."""
    draws, differences = [], []
    main = found.error_name
    for label in labels if take else ():
        difference = found.difference(take, label, found.main, "low") if label != take else None
        if difference is None or not math.isfinite(difference.low):
            continue
        size = abs(difference.difference)
        near = scale(quantity(found.main).unit, size or own.factor)
        ends = f"95 % {interval(difference.low, difference.high, near)} {near.sign}".rstrip()
        if difference.verdict == "no difference":
            exactly = "are equal" if not size else f"differ by {near.with_unit(size)} on average, {ends}"
            draws.append(f"In {main}, {take} and {label} cannot be told apart: they {exactly}.")
        elif difference.verdict == "unclear":
            runs = count(difference.runs, "run")
            draws.append(f"In {main}, {runs} do not tell {take} and {label} apart: {ends}.")
        elif is_withheld(found, take, label, size):
            moved = near.with_unit(found.stressed(take, label))
            draws.append(
                f"In {main}, the verdict on {take} and {label} is withheld: they differ by "
                f"{near.with_unit(size)} on average, and changes that should not matter move one by "
                f"{moved}."
            )
        else:
            more = "more" if difference.difference > 0 else "less"
            errs = f"{near.with_unit(size)} {more} than {take}"
            differences.append(f"{label} errs {errs} in the mean over runs ({ends}).")
    return draws, differences
