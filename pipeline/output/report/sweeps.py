"""What the page of a sweep opens with: where each estimator errs least, and what chance leaves open."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd

from pipeline.output.report.evidence import MARGIN, Consistency, Spread, runs_of
from pipeline.output.report.gauge import gauge
from pipeline.output.report.story import Card, Story
from pipeline.output.results import Result
from pipeline.output.words import count, is_error, listed, number, quantity, scale, stated

MOST_POINTS = 4  # more are counted


def story_of_sweep(result: Result, tables: Mapping[str, pd.DataFrame]) -> tuple[str, Story]:
    """What was tried, and at which point each estimator errs least."""
    table, points = tables["sweep"], result.settings["sweep"]
    keys = list(points[0])
    runs = runs_of(result, tables)
    main = next((key for key in table["quantity"].unique() if is_error(key)), "")
    cards: list[Card] = []
    verdict, still = [], []
    labels = list(table["estimator"].unique())
    for label in labels:
        own = _errors_at_points(table, label, main)
        if own.empty:
            continue
        if float(own.max() - own.min()) <= 1e-9 * float(own.max()):
            unit = scale(quantity(main).unit, float(own.max()))
            still.append(f"{label} ({unit.with_unit(float(own.max()))})")
            continue
        card, sentence = _swept(table, points, label, main, own)
        cards.append(replace(card, notes=[*card.notes, *_overlap(table, points, label, main, own)]))
        verdict.append(sentence)
    if still and cards:
        is_are = "do not depend" if len(still) > 1 else "does not depend"
        verdict.append(f"{listed(still)} {is_are} on it.")
    elif still:
        verdict.append(f"None of the errors depends on {listed(keys)}.")
    elif not cards:
        verdict.append(
            "Without a truth nobody's error is known; the charts show what the innovations say."
        )
    over = listed([f"{key} from {_ends([point[key] for point in points])}" for key in keys])
    source = result.settings.get("record", {}).get("scenario")
    of = f" of {source}" if source else ""
    swept = f"{over}: {count(len(points), 'point')}, {count(runs, 'run')}{of} at each"
    tried = f"{swept}, for {listed([str(label) for label in labels])}."
    return tried, Story(verdict, cards)


def _ends(values: Sequence[object]) -> str:
    numbers = [float(each) for each in values if isinstance(each, int | float)]
    if len(numbers) < len(values):
        return ", ".join(dict.fromkeys(map(str, values)))
    return f"{stated(min(numbers))} to {stated(max(numbers))}"


def _errors_at_points(table: pd.DataFrame, label: object, main: str) -> "pd.Series[float]":
    """An estimator's error at each point, over all cases."""
    own = table[(table["estimator"] == label) & (table["quantity"] == main)].dropna(subset=["value"])
    if "rmse" in main:
        squared = own.assign(value=own["value"] ** 2).groupby("point")["value"].mean()
        return squared**0.5
    return own.groupby("point")["value"].mean()


def _swept(
    table: pd.DataFrame,
    points: Sequence[Mapping[str, object]],
    label: object,
    main: str,
    own: "pd.Series[float]",
) -> tuple[Card, str]:
    """Where an estimator errs least, where that matters little, and if it is consistent there."""
    best = int(own.index[int(own.to_numpy().argmin())])
    unit = scale(quantity(main).unit, float(own.min()))
    where = ", ".join(f"{key} = {_value(each)}" for key, each in points[best].items())
    error = quantity(main).name.removesuffix(", RMS")
    sentence = f"{label} has its least {error}, {unit.with_unit(float(own.min()))}, at {where}"
    by = _consistency_at(table, label, best)
    notes = [
        f"From {unit.text(float(own.min()))} to {unit.with_unit(float(own.max()))} over all points."
    ]
    near = [points[place] for place in own.index[own <= (1.0 + MARGIN) * own.min()]]
    key = next(iter(points[best]))
    if len(points[best]) == 1 and len(near) > 1:
        notes.append(
            f"It makes less than 2 % of a difference from {_ends([each[key] for each in near])}."
        )
    look, mark, chip, claim = "fair", "○", f"Best at {where}", ""
    if by is not None and by.state != "honest":
        sentence += f"; there it is {by.state}, with NEES {number(by.found.value)} for {number(by.aim)}"
        look, mark, chip = "careful", "○", f"Best at {where}, but {by.state}"
    elif by is not None:
        nees = f"NEES {number(by.found.value)}, {number(by.aim)} is right"
        sentence += f", and its covariance can be believed there ({nees})"
        look, mark, claim = "best", "✓", "Its errors are as large as it states there"
    sure = [
        ", ".join(_value(each) for each in points[place].values())
        for place in own.index
        if (there := _consistency_at(table, label, place)) and there.state == "too sure"
    ]
    if sure:
        notes.append(f"It is overconfident at {', '.join(sure)}.")
    numbers = f"NEES {number(by.found.value)}; {number(by.aim)} is right" if by else ""
    card = Card(
        str(label),
        "best" if look == "best" else "careful" if look == "careful" else "fair",
        mark,
        chip,
        unit.text(float(own.min())),
        unit.sign,
        quantity(main).name,
        claim,
        gauge(by) if by else None,
        numbers,
        notes=notes,
    )
    return card, f"{sentence}."


def _overlap(
    table: pd.DataFrame,
    points: Sequence[Mapping[str, object]],
    label: object,
    main: str,
    own: "pd.Series[float]",
) -> list[str]:
    """At which other points single runs err as little as at the best: there chance may have decided."""
    rows = table[(table["estimator"] == label) & (table["quantity"] == main)]
    spreads = rows.groupby("point")[["low", "high"]].agg({"low": "min", "high": "max"}).dropna()
    best = int(own.index[int(own.to_numpy().argmin())])
    if best not in spreads.index:
        return []
    within = spreads.index[spreads["low"] <= spreads["high"][best]].drop(best)
    where = [", ".join(_value(each) for each in points[place].values()) for place in within]
    if not where:
        return []
    others = listed(where[:MOST_POINTS]) if len(where) <= MOST_POINTS else f"{len(where)} other points"
    return [
        f"The errors of its runs at {others} overlap those at the best point: a sweep does not test "
        "whether that is chance; fuselog compare does."
    ]


def _value(value: object) -> str:
    return stated(float(value)) if isinstance(value, int | float) else str(value)


def _consistency_at(table: pd.DataFrame, label: object, point: int) -> Consistency | None:
    """NEES at a point, where the sweep kept its interval: of the first case."""
    if "bound_low" not in table:
        return None
    own = table[
        (table["estimator"] == label) & (table["quantity"] == "nees") & (table["point"] == point)
    ].dropna(subset=["value", "bound_low"])
    if own.empty:
        return None
    row = own.iloc[0]
    return Consistency(
        "NEES", Spread(float(row["value"])), float(row["aim"]), (row["bound_low"], row["bound_high"])
    )
