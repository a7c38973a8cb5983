"""Makes, keeps and compares goldens: small stored replays that later ones are checked against.

A golden is packed JSON. Of every output stream it has the number of rows, the metadata, hashes of both
clocks, and of every column some rows spread evenly, in full precision, and sums over all rows.
"""

import hashlib
import json
import lzma
import math
import tempfile
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.ensemble import hash_streams, replay_in_memory
from pipeline.experiment import run_experiment
from pipeline.starting import order_of
from recorders.log import Stream, schemas
from recorders.models.planar import wrap_angle
from tests.goldens.recipes import Recipe, first_log

FOLDER = Path(__file__).parent / "stored"
# Of each stream as many rows as this many numbers of the whole golden allow, between the bounds.
NUMBERS, FEWEST_ROWS, MOST_ROWS = 6000, 6, 32
TOLERANCE, TOLERANCE_ELSEWHERE = 1e-12, 1e-6
# Their values are numbers of sentences, which may be worded anew.
REASONS = {schemas.FAILURE.full_name, schemas.SKIPPED.full_name, schemas.STARTED.full_name}

Golden = dict[str, Any]
Floats = NDArray[np.float64]


class Allowed(NamedTuple):
    """A difference that is known and right: how large relative to a column's size, and why."""

    relative: float
    reason: str
    elsewhere: bool = False
    """Whether only where the CPU's arithmetic is not the golden's."""


SINGULAR = "its covariances come near to singular: what rounding does grows as large as the estimate"
# By "GOLDEN TOPIC COLUMN", with wildcards: "landmarks* /estimates/ekf/* covariance". Empty but for
# other CPUs, as tried with the newer instructions switched off.
ALLOWED = {
    "vehicles-* /estimates/powers/*": Allowed(np.inf, SINGULAR, elsewhere=True),
    "vehicles-* /estimates/products/*": Allowed(np.inf, SINGULAR, elsewhere=True),
    "mrclam-sets /estimates/bound-1deg/*": Allowed(
        np.inf,
        "the bound does not hold: sets that are nearly empty are found empty or not",
        elsewhere=True,
    ),
    "los-* /estimates/* cost": Allowed(
        np.inf, "as many unknowns as measurements: what is left is rounding", elsewhere=True
    ),
}


def make(recipe: Recipe, places: Mapping[str, Path]) -> Golden:
    """Replay a recipe's log; where there is none, run its experiment."""
    if not recipe.has_log:
        with tempfile.TemporaryDirectory() as folder:
            result = run_experiment(recipe.experiment, recipe.loaded, Path(folder) / "out")
        return {"arithmetic": arithmetic(), "input": "", "streams": {}, "metrics": result.metrics}
    source = first_log(recipe, places)
    order, late = order_of(arrival_order=bool(recipe.late), late=recipe.late or None)
    replayed = replay_in_memory([source], recipe.settings, order=order, late=late)
    outputs = {topic: each.stream for topic, each in replayed.items() if _is_estimated(each.stream)}
    columns = [column for stream in outputs.values() for column in stream.columns.values()]
    width = sum(math.prod(column.shape[1:]) for column in columns)
    rows = min(max(NUMBERS // width, FEWEST_ROWS), MOST_ROWS)
    streams = {topic: _stream(stream, rows) for topic, stream in outputs.items()}
    found = {"arithmetic": arithmetic(), "input": hash_streams([source])}
    return {**found, "streams": streams, "metrics": {}}


def _is_estimated(stream: Stream) -> bool:
    """Whether an output is an estimator's; how much was estimated, and that nothing failed, is not."""
    schema = stream.schema.full_name
    return schema != schemas.COVERAGE.full_name and (len(stream) > 0 or schema not in REASONS)


def _stream(stream: Stream, rows: int) -> dict[str, Any]:
    """What a golden has of a stream; of failures and the like only how many there were, and when."""
    has_values = stream.schema.full_name not in REASONS
    kept = np.linspace(0, len(stream) - 1, min(rows, len(stream))).round().astype(int)
    return {
        "rows": len(stream),
        "publish_times": _sha256(stream.publish_time_ns),
        "log_times": _sha256(stream.log_time_ns),
        "metadata": dict(stream.metadata) if has_values else {},
        "columns": {
            name: _column(column.astype(float), kept)
            for name, column in stream.columns.items()
            if has_values
        },
    }


def _column(column: Floats, kept: NDArray[np.int64]) -> dict[str, Any]:
    return {
        "kept": column[kept].tolist(),
        "missing": np.isnan(column).sum(axis=0).tolist(),
        "sum": np.nansum(column, axis=0).tolist(),
        "sum_of_squares": np.nansum(column**2, axis=0).tolist(),
    }


def _sha256(array: NDArray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()[:16]


def arithmetic() -> str:
    """A hash of what elementary functions and linear algebra give here: CPUs differ in the last digit.

    Where it is not a golden's, neither is the recorded input, and nothing can be equal to 1e-12.
    """
    x = np.linspace(0.01, 10.0, 1001)
    matrix = np.exp(-np.abs(np.subtract.outer(x[:40], x[:40])))
    both = ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "sqrt")
    parts = [
        *(getattr(np, name)(x) for name in both),
        *(np.array([getattr(math, name)(value) for value in x.tolist()]) for name in both),
        *(function(x, x[::-1]) for function in (np.arctan2, np.hypot, np.power)),
        *(matrix @ matrix, np.linalg.cholesky(matrix), np.linalg.eigh(matrix)[1]),
    ]
    return _sha256(np.concatenate([np.ravel(part) for part in parts]))


def path_of(name: str) -> Path:
    """Where a golden is kept."""
    return FOLDER / f"{name}.json.xz"


def write(name: str, golden: Golden) -> None:
    """Keep a golden; the same one gives the same bytes."""
    FOLDER.mkdir(exist_ok=True)
    text = json.dumps(golden, sort_keys=True, separators=(",", ":"))
    path_of(name).write_bytes(lzma.compress(text.encode(), preset=9))


def read(name: str) -> Golden:
    """A golden that is kept."""
    golden: Golden = json.loads(lzma.decompress(path_of(name).read_bytes()))
    return golden


def differences(
    name: str, golden: Golden, found: Golden, allowed: Mapping[str, Allowed] = ALLOWED
) -> Iterator[str]:
    """A sentence for everything in which what is found is not the golden."""
    is_same_cpu = golden["arithmetic"] == found["arithmetic"]
    if is_same_cpu and golden["input"] != found["input"]:
        yield f"{name}: what is recorded or imported has changed, so that estimates cannot be compared"
        return
    for where, apart in _distances(golden, found):
        tolerance = TOLERANCE if is_same_cpu else TOLERANCE_ELSEWHERE
        for pattern, known in allowed.items():
            if fnmatch(f"{name} {where}", pattern) and not (is_same_cpu and known.elsewhere):
                tolerance = max(tolerance, known.relative)
        if not apart <= tolerance:
            yield f"{name} {where}: {apart:.2g} of its size apart; {tolerance:g} is allowed"


def _distances(golden: Golden, found: Golden) -> Iterator[tuple[str, float]]:
    """How far every part is from the golden's, relative to its size; infinite where one is missing."""
    for key, stored, new in _pairs(golden["metrics"], found["metrics"]):
        before, after = _floats(stored), _floats(new)
        yield f"metric {key}", _relative(_difference(before, after), np.abs(before))
    for topic, stored, new in _pairs(golden["streams"], found["streams"]):
        if new is None or stored is None:
            yield f"{topic} as a whole", np.inf
            continue
        for part in ("rows", "publish_times", "log_times", "metadata"):
            yield f"{topic} {part}", 0.0 if stored[part] == new[part] else np.inf
        kinds = stored["metadata"].get("kinds", "").split(",")
        for column, before, after in _pairs(stored["columns"], new["columns"]):
            yield f"{topic} {column}", _column_distance(column, before, after, stored["rows"], kinds)


def _pairs(stored: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    for key in sorted(stored.keys() | new.keys()):
        yield key, stored.get(key), new.get(key)


def _column_distance(
    name: str, stored: dict[str, Any] | None, new: dict[str, Any] | None, rows: int, kinds: list[str]
) -> float:
    """The largest of a column, relative to its root mean square; angles are as large as one radian."""
    if stored is None or new is None:
        return np.inf
    if not rows:
        return 0.0
    before, after = ({key: _floats(value) for key, value in each.items()} for each in (stored, new))
    if before["kept"].shape != after["kept"].shape:
        return np.inf
    size = np.sqrt(before["sum_of_squares"] / np.maximum(rows - before["missing"], 1))
    if name == "covariance":
        deviation = np.sqrt(size[:: math.isqrt(len(size)) + 1])
        size = np.outer(deviation, deviation).ravel()
    apart = {key: _difference(before[key], after[key]) for key in before}
    if size.shape == (len(kinds),):
        bounded, angle = np.array([kind != "linear" for kind in kinds]), np.array(kinds) == "angle"
        size = np.where(bounded, np.maximum(size, 1.0), size)
        for key in ("kept", "sum"):
            apart[key] = np.where(angle, wrap_angle(apart[key]), apart[key])
    sizes = {"kept": size, "sum": rows * size, "sum_of_squares": 2 * rows * size**2, "missing": 1.0}
    return float(np.max([_relative(apart[key], sizes[key]) for key in sizes]))


def _floats(values: Any) -> Floats:
    """An array; a null is NaN."""
    return np.asarray(values, float)


def _difference(before: Floats, after: Floats) -> Floats:
    """What is missing in both is equal."""
    return np.where(np.isnan(before) & np.isnan(after), 0.0, after - before)


def _relative(difference: Floats, size: ArrayLike) -> float:
    """The largest difference relative to its size; NaN where a value is missing in one of the two."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(difference == 0.0, 0.0, np.abs(difference) / size)
    return float(np.max(relative, initial=0.0))
