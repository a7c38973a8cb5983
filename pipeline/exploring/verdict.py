"""The verdict on a filter on a log, with its evidence."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from fuselog.pipeline.exploring.curves import Case
from fuselog.pipeline.output.words import quantity
from fuselog.recorders.checks.finding import Finding
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.verdicts import Consistency, Squares, decisive

LIKELIHOOD = "log-likelihood, open gate"
Level = Literal["good", "doubtful", "failed"]


class Summary(NamedTuple):
    """A verdict in words.

    Attributes:
        level: its severity.
        headline: the verdict in a few words.
        detail: its evidence.
    """

    level: Level
    headline: str
    detail: str


def verdict_of(case: Case, alarms: Sequence[Finding], failures: Sequence[str]) -> Summary:
    """Judge a filter by its NEES, NIS and warnings in one case of a log."""
    if failures:
        return Summary("failed", "It stopped.", failures[0])
    own = [each for each in alarms if each.part in ("", case.name)]
    by = decisive(_squares_of(case))
    has_other_cause = bool(own) and {"errors", "innovations"}.isdisjoint(each.kind for each in own)
    if by is None or by.verdict == Consistency.CONSISTENT or has_other_cause:
        if own:
            return Summary("doubtful", "Doubtful.", own[0].sentence)
        return Summary("good", "No problem found.", _evidence(case))
    times = "times what" if by.verdict == Consistency.OVERCONFIDENT else "of what"
    detail = f"Its {by.name} are {by.factor:.2g} {times} it states."
    return Summary("doubtful", f"{by.verdict.capitalize()}.", detail)


def _squares_of(case: Case) -> list[Squares]:
    """Return NEES and NIS of one log, if available."""
    found = []
    if case.errors is not None and np.isfinite(case.errors.nees).any():
        nees, size = float(np.nanmean(case.errors.nees)), len(case.errors.components)
        found.append(Squares("errors", Interval(nees), size, chi_square_interval(size, 1)))
    if not math.isnan(nis := mean_nis(case)):
        size = sum(each.size for each in case.whiteness.values() if np.isfinite(each.mean_square))
        low, high = chi_square_interval(size, 1)
        found.append(Squares("innovations", Interval(nis), 1.0, (low / size, high / size)))
    return found


def mean_nis(case: Case) -> float:
    """Compute the mean square of the whitened innovations; NaN without any."""
    known = {name: each for name, each in case.whiteness.items() if np.isfinite(each.mean_square)}
    count = sum(each.size for each in known.values())
    if not count:
        return math.nan
    return sum(each.size * each.mean_square for each in known.values()) / count


def _evidence(case: Case) -> str:
    words = {"innovations": "NIS is {:.2f} per component", "errors": "NEES is {:.2f} for {:.0f}"}
    facts = [words[each.name].format(each.found.value, each.aim) for each in _squares_of(case)[::-1]]
    within = "within its interval" if len(facts) == 1 else "within their intervals"
    return (
        f"{' and '.join(facts)}, {within}."
        if facts
        else "The log has neither a truth nor innovations to judge the estimator by."
    )


def numbers_of(case: Case) -> Mapping[str, tuple[float, str]]:
    """Return the numbers at the top of the page by name, each with its unit."""
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
