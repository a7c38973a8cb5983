"""Turns recordings and outcomes into quantities: named numbers that a person can read.

A column of a stream, a table or a chart becomes its mean, its standard deviation, its mean step from one
row to the next, and its last value. Together they notice another value or sign, swapped columns, another
order of rows, and a lost row. `tests/goldens/keeping.py` stores and compares them.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import gettempdir
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from fuselog.pipeline.output.charts import Band, Chart, Panel
from fuselog.pipeline.output.results import MetricValue, Outcome, split_metric
from fuselog.recorders.log import Stream
from fuselog.recorders.recording import Recording

SPREAD = ("std", "step", "last")
LEAST = 2e-6  # of an outcome: angles between equal directions, in degrees, have as much rounding
MOST_CASES = 2  # of a metric that are stated one by one
LONGEST = 60  # letters of a text that is stated
WIDEST = 12  # components that are stated one by one
BY_THE_CLOCK = re.compile("cpu|step_ms|growth|factor_per|^power$|^work$", re.IGNORECASE)
SINGULAR = ("powers", "products")  # estimators that rounding decides, see `store.py`
# paths differ between machines and runs: temporary folders, the checkout, the folder of real data
ROOT = Path(__file__).parents[2]
DATA = os.environ.get("FUSELOG_DATA", str(ROOT.parent / "shared"))
PATHS = re.compile(f"(?:{'|'.join(map(re.escape, (gettempdir(), str(ROOT), DATA)))})[^\\s:]*")
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.]*[A-Za-z_])")

Statistics = dict[str, float | str]


class Name(NamedTuple):
    """Names a quantity: the topic, table, chart or estimator that it is of, and its own name."""

    of: str
    column: str = ""


Quantities = dict[Name, Statistics]


def of_recording(recording: Recording) -> Quantities:
    """Return the numbers of a recording; a column that is zero in all rows has none.

    Stamps are stated in s: the publish time since the run's time zero, others since the publish time.
    """
    found: Quantities = {}
    for name, note in recording.notes.items():
        short = name if len(name) <= LONGEST else f"{name[:LONGEST]}... ({len(name)} letters)"
        found[Name("notes", short)] = _numbers_in(note)
    for stream in recording.streams:
        found.update(_of_stream(stream, recording.epoch_ns))
    return found


def _of_stream(stream: Stream, epoch_ns: int) -> Quantities:
    of = stream.topic
    columns = {name: each for name, each in stream.columns.items() if not name.endswith("_time_ns")}
    stamps = {name: each for name, each in stream.columns.items() if name not in columns}
    found: Quantities = {Name(of): {"rows": float(len(stream))}}
    for key, text in {"schema": stream.schema.full_name, **stream.metadata}.items():
        found[Name(of, key if key == "schema" else f"metadata {key}")] = _text(text)
    found[Name(of, "publish_time_s")] = statistics((stream.publish_time_ns - epoch_ns) / 1e9)
    for name, values in {"log_time_ns": stream.log_time_ns, **stamps}.items():
        after_s = (values - stream.publish_time_ns) / 1e9
        found[Name(of, f"{name.removesuffix('_ns')}_s - publish_time_s")] = statistics(after_s)
    for name, values in columns.items():
        parts = {Name(of, each): statistics(x) for each, x in _components(name, values, stream)}
        first, *others = parts.values() or [{}]
        found.update(parts if any(each != first for each in others) else {Name(of, name): first})
    return {name: each for name, each in found.items() if each != {"mean": 0.0}}


def _components(name: str, values: NDArray[Any], stream: Stream) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield a column's components with their names; a wide column stays whole."""
    width = values.shape[1] if values.ndim == 2 else 1
    if values.ndim == 1 or width > WIDEST:
        yield name, values
        return
    names = stream.components
    pairs = [f"{one} {other}" for one in names for other in names]
    of_width = {len(pairs): pairs, len(names): names}
    for place, each in enumerate(of_width.get(width, map(str, range(width)))):
        yield f"{name} {each}", values[:, place]


def of_outcome(outcome: Outcome) -> Quantities:
    """Return the numbers of what a command found, without what depends on the clock or on rounding."""
    found: Quantities = {}
    found.update(_of_metrics("metrics", outcome.metrics))
    for kind in ("bounds", "intervals"):
        for end, place in (("low", 0), ("high", 1)):
            ends = {key: each[place] for key, each in getattr(outcome, kind).items()}
            for name, each in _of_metrics(kind, ends).items():
                value = each.get("", each.get("mean", np.nan))
                found[name] = {**found.get(name, {}), end: value}
    for name, table in outcome.tables.items():
        if name != "summary":  # it repeats the metrics
            found.update(_of_table(f"table {name}", table))
    for name, figure in outcome.figures.items():
        if isinstance(figure, Chart):
            found[Name(f"figure {name}")] = {"panels": float(len(figure.panels))}
            for place, panel in enumerate(figure.panels, 1):
                if not BY_THE_CLOCK.search(panel.y.label):
                    found.update(_of_panel(Name(f"figure {name}", f"panel {place}"), panel))
    for alarm in outcome.alarms:
        name = " ".join(filter(None, (alarm.kind, alarm.where, alarm.part)))
        found[Name("alarms", name)] = {"excess": _number(alarm.value), **_numbers_in(alarm.sentence)}
    for cause in outcome.causes:
        found[Name("causes", cause.estimator)] = _numbers_in(f"{cause.setting} {cause.words}")
    for stress in outcome.stress:
        moved = {key: _number(value) for key, value in stress.moved.items()}
        found[Name("stress", stress.estimator)] = {"verdict": stress.verdict, **moved}
    return {name: each for name, each in found.items() if not _is_uncertain(name)}


def _of_metrics(kind: str, metrics: Mapping[str, MetricValue]) -> Quantities:
    """Return an estimator's metrics; those of many cases, and lists, are stated as columns."""
    cases: dict[Name, dict[str, MetricValue]] = defaultdict(dict)
    for key, value in metrics.items():
        estimator, quantity, case = split_metric(key)
        cases[Name(f"{kind} {estimator}".strip(), quantity)][case] = value
    found: Quantities = {}
    for name, values in cases.items():
        if len(values) > MOST_CASES or any(isinstance(each, list) for each in values.values()):
            flat = np.hstack([np.asarray(each, dtype=float) for each in values.values()])
            found[name] = {"cases": float(len(values)), **statistics(flat, LEAST)}
        else:
            for case, value in values.items():
                found[Name(name.of, f"{name.column} {case}".strip())] = {"": _number(value)}
    return found


def _is_uncertain(name: Name) -> bool:
    """Return whether a quantity depends on the clock, or on rounding alone."""
    return bool(BY_THE_CLOCK.search(name.column)) or name.of.split(" ")[-1] in SINGULAR


def _of_table(of: str, table: pd.DataFrame) -> Quantities:
    rows = table[~table["estimator"].isin(SINGULAR)] if "estimator" in table else table
    columns = {Name(of, str(name)): statistics(rows[name], LEAST) for name in rows.columns}
    return {Name(of): {"rows": float(len(rows))}, **columns}


def _of_panel(name: Name, panel: Panel) -> Quantities:
    """Return the numbers of a panel: of what is drawn, one after the other, and of where that is."""
    drawn = [*panel.series, *panel.bands]
    values = [[each.low, each.high] if isinstance(each, Band) else [each.y] for each in drawn]
    x = statistics([each for one in drawn for each in one.x], LEAST)
    y = statistics([each for several in values for one in several for each in one], LEAST)
    labels = [PATHS.sub("", each.label) for each in drawn]
    words = (
        " ".join(labels) if len(" ".join(labels)) <= LONGEST else " ... ".join([labels[0], labels[-1]])
    )
    return {
        Name(name.of, f"{name.column}, x {panel.x.label}"): x,
        Name(name.of, f"{name.column}, y {panel.y.label}"): {"": words, **y},
    }


def statistics(values: ArrayLike | Iterable[Any], least: float = 0.0) -> Statistics:
    """Return what states a column: of numbers, or else its different words.

    Numbers that are missing or infinite are counted. A column of one value has only its mean.

    Args:
        values: of any shape; None is a missing number.
        least: what is smaller is taken for zero.
    """
    try:
        flat = np.ravel(np.asarray(values, dtype=float))
    except (TypeError, ValueError):
        words = list(dict.fromkeys(PATHS.sub("", str(each)) for each in values))  # type: ignore[union-attr]
        return {"different": float(len(words)), **_text(" ".join(words))}
    finite = flat[np.isfinite(flat)]
    finite = np.where(np.abs(finite) < least, 0.0, finite)
    found: Statistics = {} if len(finite) == len(flat) else {"missing": float(len(flat) - len(finite))}
    if len(finite):
        found["mean"] = float(finite.mean())
        if np.ptp(finite) > max(least, 1e-9 * np.abs(finite).max()):
            found["std"] = float(finite.std())
            found["step"] = float(np.abs(np.diff(finite)).mean())
            found["last"] = float(finite[-1])
    return found


def _text(text: str) -> Statistics:
    """Return a text, or the length of a long one: prose and formats are held elsewhere."""
    text = PATHS.sub("", text)
    return {"": text} if len(text) <= LONGEST else {"letters": float(len(text))}


def _numbers_in(text: str) -> Statistics:
    """Return the numbers of a sentence by their place in it; a short text without numbers as it is."""
    numbers = NUMBER.findall(PATHS.sub("", text))
    return {f"{place}.": float(each) for place, each in enumerate(numbers, 1)} or _text(text)


def _number(value: float | None) -> float:
    value = np.nan if value is None else float(value)
    return 0.0 if abs(value) < LEAST else value


def brief(quantities: Mapping[Name, Statistics]) -> Quantities:
    """Return the least that states a run: means of columns; no charts, bounds or words of tables."""
    return {
        name: {key: value for key, value in each.items() if key not in SPREAD}
        for name, each in quantities.items()
        if not name.of.startswith(("figure ", "bounds ")) and "different" not in each
    }
