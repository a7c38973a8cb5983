"""Writes the verdict on a filter on a log: one sentence, and what it rests on."""

import math
from collections.abc import Mapping, Sequence, Set
from typing import Literal, NamedTuple

import numpy as np

from fuselog.pipeline.exploring.curves import Case
from fuselog.pipeline.output.words import quantity
from fuselog.recorders.checks.finding import Finding

LIKELIHOOD = "log-likelihood, open gate"
Level = Literal["good", "doubtful", "failed"]


class Verdict(NamedTuple):
    """States a judgement in words.

    Attributes:
        level: how bad it is.
        headline: in a few words.
        detail: what it rests on.
    """

    level: Level
    headline: str
    detail: str


def verdict_of(case: Case, alarms: Sequence[Finding], failures: Sequence[str]) -> Verdict:
    """Judge one filter on one log, by the alarms of its replay; those of other cases do not count.

    Whether a filter is too sure of itself is what NIS and NEES say, see
    `fuselog.pipeline.output.alarming`.
    """
    if failures:
        return Verdict("failed", "It stopped.", failures[0])
    own = [each for each in alarms if each.part in ("", case.name)]
    if not own:
        return Verdict("good", "Nothing speaks against it.", _evidence(case))
    ratio, of_what = _ratio(case, {each.kind for each in own})
    if math.isnan(ratio):
        return Verdict("doubtful", "Doubtful.", own[0].sentence)
    if ratio > 1.0:
        return Verdict(
            "doubtful", "Too sure of itself.", f"Its {of_what} are {ratio:.2g} times what it claims."
        )
    return Verdict("doubtful", "Too careful.", f"Its {of_what} are {ratio:.2g} of what it claims.")


def _ratio(case: Case, about: Set[str]) -> tuple[float, str]:
    """Find how many times larger errors or innovations are than stated, and which of them it is.

    Of those that alarms are about the one that is farther from one: a filter may be right on what it
    measures and wrong on the rest. NaN where no alarm is about either, or there are no numbers.
    """
    found = []
    if "errors" in about and case.errors is not None and np.isfinite(case.errors.nees).any():
        nees = float(np.nanmean(case.errors.nees))
        found.append((math.sqrt(nees / len(case.errors.components)), "errors"))
    if "innovations" in about and not math.isnan(nis := mean_nis(case)):
        found.append((math.sqrt(nis), "innovations"))
    return max(found, key=lambda each: abs(math.log(max(each[0], 1e-12))), default=(math.nan, ""))


def mean_nis(case: Case) -> float:
    """Return the mean square of the whitened innovations; NaN without any."""
    known = {name: each for name, each in case.whiteness.items() if np.isfinite(each.mean_square)}
    count = sum(each.size for each in known.values())
    if not count:
        return math.nan
    return sum(each.size * each.mean_square for each in known.values()) / count


def _evidence(case: Case) -> str:
    facts = []
    if not math.isnan(nis := mean_nis(case)):
        facts.append(f"NIS is {nis:.2f} per component")
    if case.errors is not None and np.isfinite(case.errors.nees).any():
        nees = float(np.nanmean(case.errors.nees))
        facts.append(f"NEES is {nees:.2f} for {len(case.errors.components)}")
    within = "within its interval" if len(facts) == 1 else "within their intervals"
    return f"{' and '.join(facts)}, {within}." if facts else "There is nothing to judge by."


def numbers_of(case: Case) -> Mapping[str, tuple[float, str]]:
    """Return the numbers at the head of the page, by what they are of, each with its unit."""
    found: dict[str, tuple[float, str]] = {}
    if case.errors is not None and len(case.errors.nees):
        main = case.errors.main
        squared = case.errors.error[:, main.columns] ** 2
        unit = quantity(main.rmse).unit
        found["error, RMS"] = main.scale * math.sqrt(float(np.mean(squared.sum(axis=1)))), unit
        found[f"NEES, aim {len(case.errors.components)}"] = float(np.nanmean(case.errors.nees)), ""
    if not math.isnan(nis := mean_nis(case)):
        found["NIS, aim 1"] = nis, ""
    if not math.isnan(case.log_likelihood):
        found[LIKELIHOOD] = case.log_likelihood, ""
    return found
