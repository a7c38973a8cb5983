"""Openings of report pages, by kind of result: experiment, comparison, sweep, tuning, diagnosis.

Begin with `opening`. This module writes the first sentences; `story` writes the cards and differences.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.report.evidence import (
    MARGIN,
    Findings,
    Timings,
    findings,
    runs_of,
)
from fuselog.pipeline.output.report.story import MOST_CARDS, Card, Story, story
from fuselog.pipeline.output.report.sweeps import RUNS_TABLE, story_of_sweep
from fuselog.pipeline.output.results import Measured, MetricTable, Result, read_table
from fuselog.pipeline.output.words import (
    count,
    interval,
    is_error,
    listed,
    meaning_alone,
    number,
    quantity,
    scale,
)
from fuselog.recorders.errors import some_of
from fuselog.recorders.units import unit_of, written
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from fuselog.replay.judging.verdicts import DIFFER, MATERIAL, Claimed, Comparison

Tables = Mapping[str, pd.DataFrame]
# More estimators than this are counted instead of named; more refuted claims are only in the table.
MOST_NAMED = 6
MOST_CLAIMS = 2
OF_CLAIMS: Mapping[Claimed, str] = {
    Claimed.CONFIRMED: "confirms {}",
    Claimed.REFUTED: "refutes {}",
    Claimed.INCONCLUSIVE: "leaves {} inconclusive",
    Claimed.NOT_REPRODUCIBLE: "cannot reproduce {}",
    Claimed.NO_VERDICT: "does not judge {}",
}
MOST_PAIRS = 3
# Names of the tables from which the sentences are written.
TOLD_BY = ("runs", "times", "differences", "sweep", RUNS_TABLE, "parameters")


@dataclass(frozen=True)
class Opening:
    """The beginning of a page.

    Attributes:
        tried: a sentence on the runs and estimators.
        story: the outcome.
        found: the findings about the estimators.
        also: further sentences, in a list below the cards.
        chart: a picture specific to this kind of result.
        numbers_of: sentence on the runs that the table of metrics covers, if these are not all runs.
    """

    tried: str
    story: Story
    found: Findings
    also: list[str] = field(default_factory=list)
    chart: Chart | None = None
    numbers_of: str = ""


def opening(result: Result, tables: Tables, timings: Timings | None = None) -> Opening:
    """Write the beginning of a result's page; `timings` are the estimators' run times, if known."""
    if result.made_by == "compare":
        return _of_comparison(result, tables)
    if result.made_by == "sweep":
        return Opening(
            *story_of_sweep(result, tables),
            numbers_of="Each estimator at the point with its smallest error.",
        )
    found = findings(result, tables)
    base = story(found, result.causes, timings, result.alarms)
    notes = [str(each) for each in result.settings.get("notes", [])]
    tried = what_was_tried(result, found, tables)
    if result.made_by == "diagnose":
        further = [re.sub(r"^\d+\. ", "", each) for each in notes[1:]]
        return Opening(tried, _of_diagnosis(base, notes), found, further)
    if result.made_by == "tune":
        meanings = result.settings.get("meanings", {})
        return Opening(tried, _of_tuning(base, tables, meanings), found, notes)
    if result.claims:
        base = _with_claims(_of_a_study(result, found, timings), result)
    return Opening(tried, base, found, notes)


def run_sentences(result: Result, folder: Path) -> tuple[str, str]:
    """Describe the runs and their outcome for the terminal; `folder` is the result's folder."""
    paths = [folder / "tables" / f"{name}.parquet" for name in TOLD_BY]
    begun = opening(result, {path.stem: read_table(path) for path in paths if path.is_file()})
    return begun.tried, " ".join(
        begun.story.verdict
    ) or "The result has neither errors against a truth nor claims."


def what_was_tried(result: Result, found: Findings, tables: Tables) -> str:
    """Describe the estimators, the runs, their duration, and their source."""
    settings = result.settings
    estimators = list(settings.get("estimators") or [*found.labels, *found.bounds])
    named = listed(estimators) if len(estimators) <= MOST_NAMED else some_of(estimators, MOST_NAMED)
    scenario = settings.get("record", {}).get("scenario")
    source = settings.get("import", {}).get("source")
    what = count(found.runs, "simulated run" if scenario else "log" if settings.get("logs") else "run")
    of = f" (scenario {scenario})" if scenario else f" of {source}" if source else ""
    long = _length(tables)
    seed = f", seed {settings['seed']}" if scenario and "seed" in settings else ""
    same = "" if len(estimators) < 2 else ", each on the same measurements"
    return f"{named or result.experiment} over {what}{long}{of}{seed}{same}."


def _length(tables: Tables) -> str:
    """Describe the duration of a run, if a table contains the time."""
    for name, column in (("times", "until_s"), ("steps", "elapsed_s")):
        if name in tables and column in tables[name] and len(tables[name]):
            seconds = float(tables[name][column].max())
            return f" of {number(round(seconds))} s" if seconds >= 1.5 else f" of {number(seconds, 2)} s"
    return ""


def _of_a_study(result: Result, found: Findings, timings: Timings | None) -> Story:
    """Write the story of an experiment's estimators, or an empty one if they cannot be compared.

    A quantity that only one of several estimators has cannot be used to compare them.
    """
    stated = result.settings.get("estimators") or {}
    own = replace(found, labels=[label for label in found.labels if label in stated] or found.labels)
    base = story(own, result.causes, timings, result.alarms)
    is_compared = len(own.compared) > 1 or len(own.labels) == len(own.compared)
    return base if is_compared else Story([], doubts=base.doubts)


def _with_claims(base: Story, result: Result) -> Story:
    """Add to a story the number of confirmed claims, and a card with all other claims."""
    counts = Counter(claim.verdict for claim in result.claims)
    refuted = [claim.claim for claim in result.claims if claim.verdict == Claimed.REFUTED]
    notes = [f"Refuted: {each}" for each in refuted[:MOST_CLAIMS]]
    if len(refuted) > MOST_CLAIMS:
        more = len(refuted) - MOST_CLAIMS
        are = "is" if more == 1 else "are"
        notes.append(f"{more} more {are} refuted; the table has all claims.")
    does = [text.format(counts[verdict]) for verdict, text in OF_CLAIMS.items() if counts[verdict]]
    text = f"The experiment states {count(len(result.claims), 'claim')}; this result {listed(does)}."
    card = Card("Claims", "claims", "", "", consistency=text, notes=notes)
    cards = base.cards[: MOST_CARDS - 1]
    left_out = [each.estimator for each in base.cards[MOST_CARDS - 1 :]] + base.left_out
    verdict = [*base.verdict, *claims_sentences(result)]
    return replace(base, verdict=verdict, cards=[*cards, card], left_out=left_out)


def claims_sentences(result: Result) -> list[str]:
    """Summarise how many claims are confirmed and how many are not."""
    counts = Counter(claim.verdict for claim in result.claims)
    of_all = count(len(result.claims), "claim")
    if counts[Claimed.CONFIRMED] == len(result.claims):
        return [f"{'The only claim is' if len(result.claims) == 1 else f'All {of_all} are'} confirmed."]
    others = (Claimed.REFUTED, Claimed.INCONCLUSIVE, Claimed.NOT_REPRODUCIBLE)
    counted = [f"{counts[each]} {each}" for each in others if counts[each]]
    if counts[Claimed.NO_VERDICT]:
        counted.append(f"{counts[Claimed.NO_VERDICT]} about another recording, without a verdict")
    return [f"{counts[Claimed.CONFIRMED]} of {of_all} confirmed; {listed(counted)}."]


def _of_diagnosis(base: Story, notes: Sequence[str]) -> Story:
    """Begin the story with the cause of the inconsistency, and add a card for the estimator."""
    first = notes[0].removeprefix("1. ") if notes else ""
    what, _, advice = meaning_alone(first).partition("; try ")
    is_name = "_" in what.split(" ")[0]
    verdict = [f"{what if is_name else what[:1].upper() + what[1:]}."] if what else []
    return replace(base, verdict=[*verdict, *([f"Try {advice}."] if advice else [])] or base.verdict)


def _of_tuning(base: Story, tables: Tables, meanings: Mapping[str, str]) -> Story:
    """Begin the story with the tuned values, followed by their effect on the estimator."""
    sentences = []
    for row in tables.get("parameters", pd.DataFrame()).to_dict("records")[:3]:
        low, high = row["low"], row["high"]
        known = math.isfinite(low) and math.isfinite(high)
        ends = f" (95 % {number(low)} to {number(high)})" if known else ", without an interval"
        begun = "" if row["start"] == row["value"] else f"; the search started at {number(row['start'])}"
        meaning = meanings.get(row["parameter"], "")
        what = f"The {meaning} ({row['parameter']})" if meaning else row["parameter"]
        unit = f" {sign}" if (sign := written(unit_of(row["parameter"]))) else ""
        sentences.append(f"{what} is estimated at {number(row['value'])}{unit}{ends}{begun}.")
    return replace(base, verdict=[*sentences, *base.verdict])


# A comparison.


def _of_comparison(result: Result, tables: Tables) -> Opening:
    rows = tables["differences"]
    rows = rows[rows["case"] != "all"].assign(verdict=rows["verdict"].map(Comparison))
    sides = [label for group in result.settings["sides"] for label in group]
    found = _findings_of_comparison(result, tables, list(dict.fromkeys(sides)))
    base = story(found)
    differ = rows[rows["verdict"].isin(DIFFER)]
    unclear = rows[rows["verdict"] == Comparison.UNDECIDED]
    margin = f"{number(100 * float(result.settings.get('margin', MARGIN)))} %"
    runs = count(found.runs, "run")
    if found.runs and rows["low"].isna().all():
        summary = f"{runs} give no interval: the differences may be due to chance."
    else:
        open_in = f"; {unclear['quantity'].nunique()} are inconclusive" if len(unclear) else ""
        summary = f"Over {runs} {how_many_differ(rows)} by more than chance and {margin}"
        summary += f"{open_in if differ.empty else ''}."
    also = [_difference_sentence(row) for row in differ.to_dict("records")]
    tried = f"{listed(list(dict.fromkeys(sides)))} over the same {runs}{_length(tables)}, run by run."
    notes = [str(each) for each in result.settings.get("notes", [])]
    chart = _forest(rows, float(result.settings.get("margin", MARGIN)))
    doubts = []
    for (first, second), of in unclear.groupby(["first", "second"], sort=False):
        keys = dict.fromkeys(map(str, of["quantity"]))
        names = listed([quantity(key).name.removesuffix(", RMS") for key in keys])
        doubts.append(f"whether {first} or {second} is better in {names}, which {runs} do not decide")
    base = replace(base, verdict=[*base.verdict[:2], summary], doubts=[*base.doubts, *doubts])
    return Opening(tried, base, found, [*also, *notes], chart)


def _findings_of_comparison(result: Result, tables: Tables, labels: list[str]) -> Findings:
    """Convert the candidates of a comparison to estimators, with means over their common runs."""
    quantities: dict[str, dict[str, dict[str, Measured]]] = {}
    for row in tables["differences"].to_dict("records"):
        if row["case"] == "all":
            continue
        bounds = None
        aim = pd.to_numeric(row["aim"], errors="coerce")
        if row["quantity"] in ("nees", "position_nees") and math.isfinite(aim):
            bounds = chi_square_interval(int(aim), int(row["runs"]))
        if row["quantity"] == "nis_per_component":  # the number of innovations is not stored
            bounds = (1.0 - MATERIAL, 1.0 + MATERIAL)
        of = quantities.setdefault(str(row["case"]), {}).setdefault(str(row["quantity"]), {})
        for side in ("first", "second"):
            of.setdefault(str(row[side]), Measured(float(row[f"{side}_mean"]), bounds))
    tables_of = [MetricTable(case, labels, of) for case, of in quantities.items()]
    rows = tables.get("runs", pd.DataFrame())
    stress = {each.estimator: each for each in result.stress}
    return Findings(tables_of, rows, runs_of(result, tables), labels, stress=stress)


def how_many_differ(rows: pd.DataFrame) -> str:
    """Summarise in how many metrics each pair differs; many pairs are summarised together."""
    pairs = rows.groupby(["first", "second"], sort=False)
    if len(pairs) > MOST_PAIRS:
        number_of = int(rows["verdict"].isin(DIFFER).sum())
        return f"{len(pairs)} pairs differ in {number_of or 'none'} of {len(rows)} metrics"
    parts = []
    for (first, second), of in pairs:
        number_of = int(of["verdict"].isin(DIFFER).sum())
        parts.append(f"{first} and {second} in {number_of or 'none'} of {count(len(of), 'metric')}")
    return listed([parts[0].replace(" in ", " differ in ", 1), *parts[1:]])


def _difference_sentence(row: Mapping[Any, Any]) -> str:
    """Describe one difference in words."""
    words = quantity(str(row["quantity"]))
    first, second = (_number(row[f"{side}_mean"]) for side in ("first", "second"))
    own = scale(words.unit, first, second)
    low, high = _number(row["low"]), _number(row["high"])
    of = f" of {row['case']}" if row["case"] else ""
    near = scale(words.unit, _number(row["difference"]))
    sign = near.sign if near.sign == "°" else f" {near.sign}"
    ends = f"95 % {interval(low, high, near)}{sign}".rstrip()
    return (
        f"{words.name}{of}: {row['second']} is {row['verdict']} than {row['first']}, "
        f"{own.with_unit(second)} against {own.with_unit(first)} (difference {ends})."
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _forest(rows: pd.DataFrame, margin: float) -> Chart | None:
    """Draw the differences of metrics in percent, with their intervals and the margin."""
    shown = rows[(rows["margin"] > 0) & rows["low"].notna()]
    shown = shown[[key in FOREST or is_error(key) for key in shown["quantity"]]][:12]
    if shown.empty or not margin:
        return None
    panels = []
    for (first, second), own in shown.groupby(["first", "second"], sort=False):
        places = np.arange(len(own), 0, -1)
        factor = 100.0 * margin / own["margin"].to_numpy()
        low, middle, high = (own[name].to_numpy() * factor for name in ("low", "difference", "high"))
        several = len({*own["case"]}) > 1
        names = [
            quantity(key).name + (f", {case}" if several else "")
            for key, case in zip(own["quantity"], own["case"], strict=True)
        ]
        ticks = dict(zip(map(float, places), names, strict=True))
        y = Axis(ticks=ticks, limits=(0.4, len(own) + 0.6))
        least, most = min(*low, -100.0 * margin), max(*high, 100.0 * margin)
        room = 0.05 * float(most - least)
        x = Axis(
            label=f"{second} minus {first} (%)",
            limits=(float(least) - room, float(most) + room),
        )
        edges = [
            curve(
                f"margin, {number(100 * margin)} %",
                [side, side],
                [0.4, len(own) + 0.6],
                "dashed",
                reference=True,
            )
            for side in (-100.0 * margin, 100.0 * margin)
        ]
        edges.append(curve("no difference", [0.0, 0.0], [0.4, len(own) + 0.6], reference=True))
        gaps = np.full(len(own), np.nan)
        lines = np.array([[low, high, gaps], [places, places, gaps]]).transpose(0, 2, 1)
        ends = curve(str(second), *lines.reshape(2, -1))
        panels.append(
            Panel(x=x, y=y, series=[*edges, ends, curve(str(second), middle, places, "markers")])
        )
    title = (
        "Differences in percent of the first estimator's value or of the aim, with 95 % intervals; "
        "differences between the dashed lines do not matter"
    )
    return Chart(title=title, panels=panels, legend=False)


FOREST = (
    "nees",
    "position_nees",
    "nis_per_component",
    "nees_steps_within_95",
    "hota",
    "idf1",
    "referenced_hota",
    "referenced_idf1",
)
