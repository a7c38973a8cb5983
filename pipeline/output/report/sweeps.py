"""Openings of the pages of sweeps, which recommend an estimator and its parameters.

Each estimator is represented by the point with its smallest error, and `story` recommends one as in an
experiment. Points at which an estimator is overconfident are used only if it is overconfident at all
points.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import pandas as pd

from fuselog.pipeline.output.report.evidence import (
    Findings,
    findings,
    relation,
    runs_of,
)
from fuselog.pipeline.output.report.story import Card, Story, story
from fuselog.pipeline.output.results import Result
from fuselog.pipeline.output.words import count, is_error, listed, quantity, scale, stated
from fuselog.recorders.units import unit_of, written
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.verdicts import Comparison, Consistency, Squares

MOST_POINTS = 4  # more points than this are counted instead of named
RUNS_TABLE = "sweep-runs"  # name of the table with the errors of every run at every point
Tables = Mapping[str, pd.DataFrame]


@dataclass(frozen=True)
class Sweep:
    """The result of a sweep, with the tables from which its sentences are written.

    Attributes:
        result: the result of the sweep.
        table: a row per point, estimator, quantity and case.
        rows: errors of every run at every point; empty if the result does not contain them.
        runs: the number of runs at each point.
    """

    result: Result
    table: pd.DataFrame
    rows: pd.DataFrame
    runs: int

    @cached_property
    def points(self) -> list[dict[str, object]]:
        """Return the values of the parameters at each point."""
        return list(self.result.settings["sweep"])

    @cached_property
    def main(self) -> str:
        """Return the error by which points are compared; return "" if the sweep has no errors."""
        return next((key for key in self.table["quantity"].unique() if is_error(key)), "")

    def errors(self, label: str) -> "pd.Series[float]":
        """Compute an estimator's error at each point, over all cases."""
        table = self.table
        is_own = (table["estimator"] == label) & (table["quantity"] == self.main)
        own = table[is_own].dropna(subset=["value"])
        if "rmse" in self.main:
            squared = own.assign(value=own["value"] ** 2).groupby("point")["value"].mean()
            return squared**0.5
        return own.groupby("point")["value"].mean()

    def consistency(self, label: str, point: int) -> Squares | None:
        """Return the NEES of the first case at a point, if the sweep stored its interval."""
        table = self.table
        if "bound_low" not in table:
            return None
        is_own = (table["estimator"] == label) & (table["quantity"] == "nees")
        own = table[is_own & (table["point"] == point)].dropna(subset=["value", "bound_low"])
        if own.empty:
            return None
        row = own.iloc[0]
        ends = float(row["bound_low"]), float(row["bound_high"])
        return Squares("NEES", Interval(float(row["value"])), float(row["aim"]), ends)

    def is_overconfident(self, label: str, point: int) -> bool:
        """Test whether an estimator is overconfident at a point."""
        by = self.consistency(label, point)
        return by is not None and by.verdict == Consistency.OVERCONFIDENT

    def at(self, places: Mapping[str, tuple[str, int]]) -> Findings:
        """Collect findings for estimators at one point each, as for the estimators of an experiment."""
        found, rows = {}, []
        for name, (label, point) in places.items():
            own = self.table[(self.table["estimator"] == label) & (self.table["point"] == point)]
            for row in own.to_dict("records"):
                found[".".join(filter(None, (name, row["quantity"], row["case"])))] = row
            if len(self.rows):
                is_here = (self.rows["estimator"] == label) & (self.rows["point"] == point)
                rows.append(self.rows[is_here].assign(estimator=name))
        return self._findings(found, {"runs": pd.concat(rows)} if rows else {})

    def _findings(self, rows: Mapping[str, Mapping[Any, Any]], tables: Tables) -> Findings:
        """Collect findings from rows of the table; `rows` maps the keys of metrics to these rows."""
        metrics = {key: row["value"] for key, row in rows.items()}
        bounds = {
            key: (row["bound_low"], row["bound_high"])
            for key, row in rows.items()
            if math.isfinite(row.get("bound_low", math.nan))
        }
        here = self.result.model_copy(update={"metrics": metrics, "bounds": bounds})
        return findings(here, tables)

    @property
    def of_world(self) -> bool:
        """Test whether the sweep also changes the scenario, so that its points cannot be compared."""
        estimators: Mapping[str, Any] = self.result.settings.get("estimators") or {}
        of_all = {key for values in estimators.values() for key in values}
        return any(
            {key.partition(".")[0], key}.isdisjoint({*estimators, *of_all}) for key in self.points[0]
        )

    def everywhere(self) -> Findings:
        """Collect findings over all points, as if each point were a case of an experiment."""
        found = {}
        for row in self.table.to_dict("records"):
            case = ", ".join(filter(None, (self.where(int(row["point"]), brief=True), row["case"])))
            found[f"{row['estimator']}.{row['quantity']}.{case}"] = row
        return self._findings(found, {"runs": self.rows})

    def where(self, point: int, *, brief: bool = False) -> str:
        """Describe a point by its values, with the parameters' names unless `brief`."""
        parts = []
        for key, value in self.points[point].items():
            text = f"{_value(value)} {written(unit_of(key)) if _is_number(value) else ''}".rstrip()
            parts.append(text if brief else f"{self.name(key)} = {text}")
        return f"({', '.join(parts)})" if brief and len(parts) > 1 else ", ".join(parts)

    def name(self, key: str, *, with_key: bool = False) -> str:
        """Return a parameter's name for readers, which is its meaning if known."""
        meaning = str(self.result.settings.get("meanings", {}).get(key, ""))
        name = meaning or quantity(key.rpartition(".")[2]).name
        return f"{name} ({key})" if with_key else name


def story_of_sweep(result: Result, tables: Tables) -> tuple[str, Story, Findings]:
    """Write the story of a sweep, with the findings on which it is based.

    If the scenario is swept, a user cannot choose the point, so estimators are judged over all
    points.
    """
    table = tables["sweep"]
    sweep = Sweep(result, table, tables.get(RUNS_TABLE, pd.DataFrame()), runs_of(result, tables))
    labels = [str(each) for each in table["estimator"].unique()]
    tried = _tried(sweep, labels)
    errors = {label: own for label in labels if not (own := sweep.errors(label)).empty}
    if not errors:
        none = "Without a truth, errors are unknown; the charts show the innovations."
        return tried, Story([none]), Findings([], pd.DataFrame(), sweep.runs, labels)
    if sweep.of_world:
        found = sweep.everywhere()
        return tried, story(found), found
    best = {label: _best(sweep, label, own) for label, own in errors.items()}
    still = [label for label, own in errors.items() if _is_still(own)]
    found = sweep.at({label: (label, point) for label, point in best.items()})
    if len(still) < len(errors):
        base = story(found, at_best=True)
        return tried, _with_points(sweep, base, errors, best, still), found
    base = story(found)
    keys = listed([sweep.name(key) for key in sweep.points[0]])
    return tried, replace(base, verdict=[f"No error depends on {keys}.", *base.verdict]), found


def _tried(sweep: Sweep, labels: list[str]) -> str:
    """Describe the swept values, the number of runs, and the estimators."""
    over = []
    for key in sweep.points[0]:
        unit = written(unit_of(key))
        ends = _ends([point[key] for point in sweep.points])
        over.append(f"{sweep.name(key, with_key=True)} from {ends} {unit}".rstrip())
    source = sweep.result.settings.get("record", {}).get("scenario")
    of = f" of {source}" if source else ""
    runs = f"{count(len(sweep.points), 'point')}, {count(sweep.runs, 'run')}{of} at each"
    text = f"{listed(over)}: {runs}, for {listed(labels)}."
    return text[:1].upper() + text[1:]


def _best(sweep: Sweep, label: str, own: "pd.Series[float]") -> int:
    """Find the point with an estimator's smallest error, ignoring overconfident points if possible."""
    sure = [point for point in own.index if sweep.is_overconfident(label, int(point))]
    left = own.drop(sure) if len(sure) < len(own) else own
    return int(left.index[int(left.to_numpy().argmin())])


def _is_still(own: "pd.Series[float]") -> bool:
    return float(own.max() - own.min()) <= 1e-9 * float(own.max())


def _with_points(
    sweep: Sweep,
    base: Story,
    errors: Mapping[str, "pd.Series[float]"],
    best: Mapping[str, int],
    still: list[str],
) -> Story:
    """Add the best points of the estimators to the story."""
    moved = [label for label in errors if label not in still]
    sentences = []
    for point in dict.fromkeys(best[label] for label in moved):
        there = [label for label in moved if best[label] == point]
        err = "has its" if len(there) == 1 else "have their"
        sentences.append(f"{listed(there)} {err} smallest error with {sweep.where(point)}.")
    if still:
        are = "do not depend" if len(still) > 1 else "does not depend"
        sentences.append(f"{listed(still)} {are} on it.")
    doubts: list[str] = []
    cards = []
    for card in base.cards:
        if card.estimator in moved:
            own, point = errors[card.estimator], best[card.estimator]
            alike = _as_good(sweep, card.estimator, own, point)
            cards.append(_at_its_best(sweep, card, own, point, alike))
            doubts += _doubts(sweep, card.estimator, own, point, alike)
        else:
            cards.append(replace(card, notes=["Its errors are the same at all points.", *card.notes]))
    first, *further = base.verdict or [""]
    verdict = [*filter(None, [first]), *sentences, *further]
    at_best = ", each at its smallest error" if len(base.cards) > 1 else ", at its smallest error"
    others = [f"{each}{at_best if each.startswith('the covariances') else ''}" for each in base.doubts]
    return replace(base, verdict=verdict, cards=cards, doubts=[*doubts, *others])


def _as_good(sweep: Sweep, label: str, own: "pd.Series[float]", best: int) -> list[int]:
    """Find points whose error differs from the smallest by no more than chance or the margin."""
    found = sweep.at({str(point): (label, int(point)) for point in own.index})
    return [
        int(point)
        for point in own.index
        if point != best
        and relation(found, str(best), str(point)) in (Comparison.TIE, Comparison.UNDECIDED)
    ]


def _at_its_best(sweep: Sweep, card: Card, own: "pd.Series[float]", best: int, alike: list[int]) -> Card:
    unit = scale(quantity(sweep.main).unit, float(own.min()))
    ends = f"{unit.text(float(own.min()))} to {unit.with_unit(float(own.max()))}"
    notes = [f"With {sweep.where(best)}; from {ends} over all points."]
    if alike:
        are = "is" if len(alike) == 1 else "are"
        notes.append(f"{_named(sweep, alike)} {are} as good, within chance or 2 %.")
    there = f"{card.consistency} there" if card.consistency else ""
    return replace(card, consistency=there, notes=[*notes, *card.notes])


def _doubts(sweep: Sweep, label: str, own: "pd.Series[float]", best: int, alike: list[int]) -> list[str]:
    """List the doubts about a best point."""
    parts = []
    sure = [int(point) for point in own.index if sweep.is_overconfident(label, int(point))]
    if sure and best not in sure:
        parts.append(f"{label} at {_named(sweep, sure)}, where it is overconfident")
    if alike:
        parts.append(f"which point is best for {label}, because {_named(sweep, alike)} may be as good")
    key, *others = sweep.points[0]
    values = [each for point in sweep.points if _is_number(each := point[key])]
    if not others and len(values) == len(sweep.points) and sweep.points[best][key] in _ends_of(values):
        where = sweep.where(best, brief=True)
        parts.append(f"whether the error of {label} is smaller beyond {where}, where the range ends")
    return parts


def _named(sweep: Sweep, points: list[int]) -> str:
    where = [sweep.where(point, brief=True) for point in points]
    return listed(where) if len(where) <= MOST_POINTS else f"{len(where)} other points"


def _ends(values: Sequence[object]) -> str:
    numbers = list(filter(_is_number, values))
    if len(numbers) < len(values):
        return ", ".join(dict.fromkeys(map(str, values)))
    return " to ".join(map(stated, _ends_of(numbers)))


def _ends_of(values: Sequence[Any]) -> tuple[float, float]:
    return float(min(values)), float(max(values))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float)


def _value(value: object) -> str:
    return stated(float(value)) if isinstance(value, int | float) else str(value)
