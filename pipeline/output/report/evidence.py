"""Evidence about each estimator of a result: its errors, consistency and failures in every run.

The evidence is computed from the metrics and the table of runs, which exist in all kinds of results.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.output.alarms import Stressing
from fuselog.pipeline.output.results import Measured, MetricTable, Result, metric_tables, split_metric
from fuselog.pipeline.output.words import is_error, quantity
from fuselog.replay.judging.errors.differences import (
    Difference,
    Target,
    paired_difference,
    target_of,
)
from fuselog.replay.judging.intervals import (
    FEWEST_RUNS,
    Interval,
    mean_interval,
    rms_interval,
    root_mean_square,
    too_few,
)
from fuselog.replay.judging.verdicts import DIFFER, Comparison, Consistency, Squares, decisive

Timings = Mapping[str, Mapping[str, float]]  # by estimator: run time in s, number of messages
# Estimators are compared by the first of these that they have, or else by the first error.
PREFERRED = ("position_rmse_m", "orientation_rmse_deg", "gospa_m")
MARGIN = 0.02  # the default of `fuselog compare`


@dataclass(frozen=True)
class Evidence:
    """Everything that is known about one estimator.

    Attributes:
        estimator: the estimator's label.
        error: the estimator's value of the quantity by which estimators are compared; None if it has no
            such value.
        squares: NEES, or NEES of the position, and NIS, if available.
        failed: the number of failed runs; None if unknown.
        runs: the number of runs, over all cases.
        share: the share of the time that estimates cover.
        outside: the number of cases in which the estimator is inconsistent, and the number of all cases.
        age_s: the mean age of estimates when they become available, in the case where this age is
            largest.
    """

    estimator: str
    error: Interval | None
    squares: Sequence[Squares]
    failed: int | None
    runs: int
    share: float
    outside: tuple[int, int] = (0, 1)
    age_s: float = 0.0

    @property
    def has_failed(self) -> bool:
        """Test whether the estimator fails in every run."""
        return bool(self.failed and self.failed >= self.runs)

    @property
    def decisive(self) -> Squares | None:
        """Return what decides the verdict: NEES, or NIS if only NIS is outside its limits."""
        return decisive(self.squares)

    @property
    def verdict(self) -> Consistency:
        """Return the verdict on the estimator's covariances; undecided if it fails in every run."""
        by = None if self.has_failed else self.decisive
        return by.verdict if by is not None else Consistency.UNDECIDED

    @property
    def is_broken(self) -> bool:
        """Test whether the estimator cannot be trusted: it fails in every run or is overconfident."""
        return self.has_failed or self.verdict == Consistency.OVERCONFIDENT

    @property
    def has_diverged(self) -> bool:
        """Test whether the estimator's errors are too large to be explained by wrong covariances."""
        return self.decisive is not None and self.decisive.has_diverged


class Pair(NamedTuple):
    """The ratio or difference of a quantity between two estimators; NaN if it is unknown."""

    first: str
    second: str
    quantity: str
    case: str
    more: Interval


@dataclass(frozen=True)
class Findings:
    """Everything that a result contains about its estimators.

    Attributes:
        tables: the result's metrics by case.
        rows: a row per estimator, case and run, with quantities; may be empty.
        runs: the number of runs.
        labels: the estimators in order, excluding bounds.
        bounds: labels of bounds, which cannot be chosen as estimators.
        stress: the effect of changes that should not matter, by estimator; empty if not tested.
        pairs: quantities that a study measured for pairs of estimators.
    """

    tables: list[MetricTable]
    rows: pd.DataFrame
    runs: int
    labels: list[str]
    bounds: list[str] = field(default_factory=list)
    stress: Mapping[str, Stressing] = field(default_factory=dict)
    pairs: list[Pair] = field(default_factory=list)

    @cached_property
    def main(self) -> str:
        """Return the quantity by which estimators are compared, or "" if the result has no errors."""
        there = [key for table in self.tables for key in table.quantities if is_error(key)]
        return next((key for key in (*PREFERRED, *there) if key in there), "")

    @property
    def error_name(self) -> str:
        """Return the name of the main quantity in sentences, such as "position error"."""
        return quantity(self.main).name.removesuffix(", RMS")

    @property
    def about_intervals(self) -> str:
        """Explain the table's intervals, or why it has none."""
        few = self.runs < FEWEST_RUNS
        return (
            f"No 95 % intervals: {too_few(self.runs)}."
            if few
            else "Values in small type: 95 % intervals over runs."
        )

    @cached_property
    def of(self) -> Mapping[str, Evidence]:
        """Return the evidence by estimator."""
        return {label: self._evidence(label) for label in self.labels}

    @cached_property
    def cases(self) -> list[dict[str, Measured]]:
        """Return the errors by label, for each case in which estimators are compared."""
        return [each.quantities[self.main] for each in self.tables if self.main in each.quantities]

    @property
    def compared(self) -> list[str]:
        """Return the estimators that have an error in every case."""
        return [label for label in self.labels if self.of[label].error is not None]

    def least_in(self) -> Counter[str]:
        """Count, for each compared estimator, the cases in which it has the smallest error."""
        found: Counter[str] = Counter()
        for case in self.cases:
            of = {label: case[label].value for label in self.compared}
            errors = {label: float(each) for label, each in of.items() if isinstance(each, int | float)}
            if errors:
                found[min(errors, key=errors.__getitem__)] += 1
        return found

    @cached_property
    def by_run(self) -> "Callable[[str, str], pd.Series[float]]":
        """Return a function that looks up a quantity of every run by estimator and quantity."""
        return cache(self._by_run)

    def _by_run(self, label: str, key: str) -> "pd.Series[float]":
        """Return a quantity of every run, combined over cases: as RMS for errors, else as the mean."""
        if key not in self.rows:
            return pd.Series(dtype=float)
        own = self.rows[self.rows["estimator"] == label]
        if "rmse" not in key:
            return own.groupby("run")[key].mean().dropna()
        squared = own.assign(squared=own[key] ** 2).groupby("run")["squared"].mean()
        return np.sqrt(squared).dropna()

    def difference(self, first: str, second: str, key: str, target: Target = None) -> Difference | None:
        """Compute the difference of a quantity, second minus first estimator, over the runs of both."""
        one, other = self.by_run(first, key).align(self.by_run(second, key), join="inner")
        if one.empty:
            return None
        values = one.to_numpy(dtype=float), other.to_numpy(dtype=float)
        return paired_difference(*values, target or target_of(key) or "low", MARGIN)

    def stressed(self, *labels: str) -> float:
        """Return the largest effect of irrelevant changes on the main error of these estimators."""
        own = [self.stress[label].moved.get(self.main, 0.0) for label in labels if label in self.stress]
        return max(own, default=0.0)

    def values(self, label: str, key: str) -> list[float]:
        """Return an estimator's metric in every case that has it."""
        found = [table.quantities.get(key, {}).get(label) for table in self.tables]
        numbers = [each.value for each in found if each is not None]
        return [float(each) for each in numbers if isinstance(each, int | float)]

    def has_any(self, label: str, *stems: str) -> bool:
        """Test whether an estimator has a quantity with one of these strings in its name."""
        return any(
            stem in key and label in of
            for table in self.tables
            for key, of in table.quantities.items()
            for stem in stems
        )

    def _evidence(self, label: str) -> Evidence:
        failed = self.values(label, "failed_runs")
        nees = self._squares(label, "nees", "NEES")
        nees = nees or self._squares(label, "position_nees", "NEES of the position")
        judged = [
            measured.place
            for table in self.tables
            if (measured := table.quantities.get("nees", {}).get(label)) and measured.place
        ]
        return Evidence(
            label,
            self._error(label),
            [*filter(None, (nees, self._squares(label, "nis_per_component", "NIS")))],
            int(sum(failed)) if failed else None,
            self.runs * max(len(failed), 1),
            min(self.values(label, "estimated_share") or [1.0]),
            (sum(place != "within" for place in judged), max(len(judged), 1)),
            max(self.values(label, "estimate_age_s"), default=0.0),
        )

    def _error(self, label: str) -> Interval | None:
        """Combine the errors of all cases; None if the estimator lacks the error of a case."""
        values = self.values(label, self.main)
        if not values or len(values) < len(self.cases):
            return None
        squared = "rmse" in self.main
        value = root_mean_square(values) if squared else float(np.mean(values))
        each_run = self.by_run(label, self.main).to_numpy(dtype=float)
        return (rms_interval if squared else mean_interval)(each_run)._replace(value=value)

    def _squares(self, label: str, key: str, name: str) -> Squares | None:
        """Average NEES or NIS over the cases, with the widest interval; return None without cases."""
        measured = [
            each
            for table in self.tables
            if (each := table.quantities.get(key, {}).get(label)) and each.bounds and each.place
        ]
        if not measured:
            return None
        values = [float(each.value) for each in measured if isinstance(each.value, int | float)]
        usual = max(
            (each.bounds for each in measured if each.bounds), key=lambda ends: ends[1] - ends[0]
        )
        aim = 1.0 if name == "NIS" else self.size_of(usual)
        each_run = self.by_run(label, key).to_numpy(dtype=float)
        over_cases = mean_interval(each_run)._replace(value=float(np.mean(values)))
        return Squares(name, over_cases, aim, usual)

    def size_of(self, usual: tuple[float, float]) -> float:
        """Find the number of components for which the NEES has this chi-square interval."""
        from fuselog.replay.judging.errors.evaluation import chi_square_interval

        sizes = range(1, 100)
        runs = max(self.runs, 1)
        return float(min(sizes, key=lambda size: abs(chi_square_interval(size, runs)[1] - usual[1])))


def relation(found: Findings, first: str, second: str) -> Comparison | None:
    """Compare the second estimator's error with the first's by run; return None for too few runs.

    With few runs, two errors within the margin count as a tie.
    """
    difference = found.difference(first, second, found.main, "low")
    verdict: Comparison | None
    if difference is not None and (difference.more.is_bounded or difference.verdict == Comparison.TIE):
        more, verdict = difference.more.value, difference.verdict
    else:
        errors = [found.of[label].error for label in (first, second)]
        one, other = (each.value if each else math.nan for each in errors)
        more = other - one
        verdict = Comparison.TIE if abs(more) <= MARGIN * abs(one) else None
    is_moved = verdict in (*DIFFER, None) and is_withheld(found, first, second, more)
    return Comparison.WITHHELD if is_moved else verdict


def is_withheld(found: Findings, first: str, second: str, difference: float) -> bool:
    """Test whether irrelevant changes move either error by more than the two errors differ."""
    return abs(difference) < found.stressed(first, second)


def findings(result: Result, tables: Mapping[str, pd.DataFrame]) -> Findings:
    """Collect the findings about a result's estimators; `tables` are its folder's tables by name."""
    rows = tables.get("runs", pd.DataFrame())
    if not {"estimator", "run"} <= {*rows}:
        rows = pd.DataFrame()
    metrics = {key: value for key, value in result.metrics.items() if isinstance(value, int | float)}
    pairs = _pairs(result, metrics)
    of_pairs = {each.quantity for each in pairs}
    own = {key: value for key, value in metrics.items() if split_metric(key)[1] not in of_pairs}
    cases = metric_tables(own, result.bounds)
    labels = cases[0].estimators if cases else []
    found = Findings(cases, rows, runs_of(result, tables), labels)
    bounds = [label for label in labels if found.values(label, "over_ensemble")]
    labels = [label for label in labels if label not in bounds]
    stress = {each.estimator: each for each in result.stress}
    return Findings(cases, rows, found.runs, labels, bounds, stress, pairs)


def _pairs(result: Result, metrics: Mapping[str, float]) -> list[Pair]:
    """Collect metrics of pairs of estimators; their cases begin with the second estimator's label."""
    labels = {split_metric(key)[0] for key in metrics}
    found: dict[str, list[Pair | None]] = {}
    for key, value in metrics.items():
        first, quantity, case = split_metric(key)
        others = [each for each in labels - {first} if each and f"{case}-".startswith(f"{each}-")]
        if not others:
            found.setdefault(quantity, []).append(None)
            continue
        second = max(others, key=len)  # labels may be prefixes of each other
        low, high = (math.nan if end is None else end for end in result.intervals.get(key, (None, None)))
        more = Interval(float(value), low, high)
        rest = case.removeprefix(second).removeprefix("-")
        found.setdefault(quantity, []).append(Pair(first, second, quantity, rest, more))
    return [each for of in found.values() if None not in of for each in of if each is not None]


def runs_of(result: Result, tables: Mapping[str, pd.DataFrame]) -> int:
    """Count the runs of a result, from its tables or else from its settings."""
    if result.made_by == "compare" and len(tables["differences"]):
        return int(tables["differences"]["runs"].max())
    logs = result.settings.get("logs")
    if isinstance(logs, Mapping):
        logs = logs.get("files")
    return len(logs) if isinstance(logs, list) else int(result.settings.get("runs", 1))
