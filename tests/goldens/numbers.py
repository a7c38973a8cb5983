"""Numbers that tests hold to what they were: of what is recorded, imported and found by commands.

Each stands for a whole column: it moves where a value, a sign or the order of rows does. They are kept
in `numbers/*/*.json` by what was asked for; finding others fails the test that finds them.
`KEEP_FOUND=1 pytest ...` keeps what is found beside what is there.
"""

import json
import os
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel

from pipeline.output.charts import Chart
from pipeline.output.results import Outcome
from recorders.recording import Recording

FOLDER = Path(__file__).with_name("numbers")
TOLERANCE = 1e-5  # what another CPU's rounding may leave
STEP = 2.39996  # rad between the weights of rows: no two are alike
SMALL = 1e-6  # what is far below counts for little
ROUNDING = 2e-6  # of what a command finds: an angle between alike directions, in degrees, has as much
# paths of one run: what is in a folder for the time being, in the checkout or in that of real data
ROOT = Path(__file__).parents[2]
DATA = os.environ.get("FUSELOG_DATA", str(ROOT.parent / "shared"))
PLACES = (gettempdir(), str(ROOT), DATA)
OF_ONE_RUN = re.compile(f"(?:{'|'.join(map(re.escape, PLACES))})[^\\s:]*")
BY_THE_CLOCK = re.compile("cpu|step_ms|growth|factor_per|^power$|^work$", re.IGNORECASE)
SINGULAR = ("powers", "products")  # estimators of which rounding decides, see `store.py`

Numbers = dict[str, float]


def hold(kind: str, name: str, found: Numbers) -> None:
    """Raise AssertionError where these numbers are none of those that are kept under the name."""
    path = FOLDER / f"{kind}.json"
    known = _kept(path).get(name, [])
    if any(not _moved(found, each) for each in known):
        return
    if os.environ.get("KEEP_FOUND"):
        _kept.cache_clear()  # a lane beside this one may have kept some
        kept = _kept(path)
        kept[name] = [*kept.get(name, []), {key: round(value, 7) for key, value in found.items()}]
        lines = [f"{json.dumps(name)}: {json.dumps(kept[name])}" for name in sorted(kept)]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return
    differing = min((_moved(found, each) for each in known), key=len, default=list(found))
    raise AssertionError(f"{kind}, {name}: {', '.join(differing)}\nwhere it is meant: {__name__}")


@lru_cache
def _kept(path: Path) -> dict[str, list[Numbers]]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def _moved(found: Mapping[str, float], kept: Mapping[str, float]) -> list[str]:
    """The names under which two of them differ."""
    return [
        key
        for key in sorted({*found, *kept})
        if not abs(found.get(key, np.inf) - kept.get(key, np.inf)) <= TOLERANCE
    ]


def hold_outcome(kind: str, settings: Mapping[str, Any], outcome: Outcome) -> None:
    """Raise AssertionError where an outcome has other numbers than under these settings it had."""
    hold(f"outcomes/{kind}", _short(settings), of_outcome(outcome))


def hold_recording(kind: str, settings: Any, recording: Recording) -> None:
    """Raise AssertionError where a recording has other numbers than under these settings it had."""
    hold(f"recordings/{kind}", _short(settings), of_recording(recording))


def _short(settings: Any) -> str:
    given = _leaves_of(settings)
    words = [x if isinstance(x, str) else f"{x if abs(x) > 1e-9 else 0.0:.4g}" for x in given]
    return f"{zlib.crc32(' '.join(words).encode()):08x}"


def of_recording(recording: Recording) -> Numbers:
    """A number for each topic, of its columns, its stamps and its metadata; one for all notes."""
    found = {"notes": _number_of(_leaves_of(recording.notes))} if recording.notes else {}
    for stream in recording.streams:
        stamps = (stream.publish_time_ns, stream.log_time_ns)
        words = [stream.schema.full_name, *stream.columns, *_leaves_of(dict(stream.metadata))]
        since = [each - recording.epoch_ns for each in stamps]
        found[stream.topic] = _total([*since, *stream.columns.values(), words])
    return found


def of_outcome(outcome: Outcome) -> Numbers:
    """A number for the metrics of each estimator, for each table, chart and list of findings.

    Without what the clock decides.
    """
    found: dict[str, float] = {}
    parted = {key: key.partition(".") for key in sorted(outcome.metrics)}
    steady = [key for key, (_, _, of) in parted.items() if not BY_THE_CLOCK.search(of)]
    for key in steady:
        estimator = parted[key][0]
        value = _number_of(_leaves_of([key, outcome.metrics[key]]), ROUNDING)
        found[estimator] = found.get(estimator, 0.0) + value * (1.0 + 0.1 * len(key))
    for name, table in outcome.tables.items():
        rows = table[~table["estimator"].isin(SINGULAR)] if "estimator" in table else table
        kept = rows[[each for each in table.columns if not BY_THE_CLOCK.search(str(each))]]
        found[f"table {name}"] = _total([kept.columns.tolist(), *map(_column, kept.items())], ROUNDING)
    for name, figure in outcome.figures.items():
        if isinstance(figure, Chart):
            panels = [each for each in figure.panels if not BY_THE_CLOCK.search(each.y.label)]
            found[f"figure {name}"] = _number_of(_leaves_of([figure.title, *panels]), ROUNDING)
    for name in ("bounds", "intervals", "alarms", "causes", "stress"):
        if (of := getattr(outcome, name)) and len(steady) == len(outcome.metrics):
            found[name] = _number_of(_leaves_of(of), ROUNDING)
    return {name: value for name, value in found.items() if name not in SINGULAR}


def _column(named: tuple[Any, "pd.Series[Any]"]) -> Any:
    values = named[1].to_numpy()
    return values if values.dtype.kind in "fiub" else _leaves_of(values.tolist())


def _leaves_of(value: Any) -> list[float | str]:
    """The numbers and the words that something holds, without paths."""
    return list(_leaves(value))


def _leaves(value: Any) -> Iterator[float | str]:
    if isinstance(value, BaseModel):
        value = {name: getattr(value, name) for name in type(value).model_fields}
    elif is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield OF_ONE_RUN.sub("", str(key))
            yield from _leaves(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _leaves(each)
    elif isinstance(value, np.ndarray):
        yield from _leaves(value.ravel().tolist())
    elif isinstance(value, int | float | np.number):
        yield float(value)
    else:
        yield OF_ONE_RUN.sub("", str(value))


def _total(columns: Iterable[Any], least: float = 0.0) -> float:
    """One number for several columns; it matters which is which."""
    return sum((1.0 + 0.1 * place) * _number_of(each, least) for place, each in enumerate(columns))


def _number_of(values: Any, least: float = 0.0) -> float:
    """One number for a column of numbers, or of numbers and words: how large they are, how they vary.

    What is smaller than the least is taken for zero.
    """
    if isinstance(values, list):
        values = [zlib.crc32(x.encode()) / 2.0**32 if isinstance(x, str) else x for x in values]
    flat = np.ravel(np.asarray(values, dtype=float))
    finite = np.where(np.isfinite(flat) & (np.abs(flat) >= least), flat, 0.0)
    weighted = np.cos(STEP * np.arange(len(flat))) * finite
    size = np.log1p(np.abs(finite).sum() / SMALL / max(len(flat), 1))
    lacking = np.cos(STEP * np.flatnonzero(~np.isfinite(flat))).sum()
    return float(size + weighted.sum() / (np.abs(weighted).sum() + 1e-3 * SMALL) + lacking + len(flat))
