"""Goldens: small stored replays that later ones are checked against, field by field.

A golden is packed JSON: settings, a hash of every input, tolerances, and of every output stream the
number of rows, the metadata, hashes of both clocks, a checksum of each row, and of every column some
rows spread evenly, in full precision, and sums over all rows. How long anything took is no part of it.
"""

import base64
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.checking.stored import FORMAT, Golden
from pipeline.runs.ensemble import Settings, hash_files, hash_streams, replay_in_memory
from pipeline.runs.initial_states import order_of
from recorders.errors import BadInput, some_of
from recorders.log import Stream, schemas
from recorders.models.planar import wrap_angle
from replay.engine.streams.sources import LogSource, MemorySource
from replay.judging.errors.evaluation import split_topic

# Of each stream as many rows as this many numbers of the whole golden allow, between the bounds.
NUMBERS, FEWEST_ROWS, MOST_ROWS = 6000, 6, 32
TOLERANCE, TOLERANCE_ELSEWHERE = 1e-12, 1e-6
# Their values are numbers of sentences, which may be worded anew.
REASONS = {schemas.FAILURE.full_name, schemas.SKIPPED.full_name, schemas.STARTED.full_name}

Floats = NDArray[np.float64]
Outputs = Mapping[str, Stream]


class Tolerance(NamedTuple):
    """A difference that is allowed: how large relative to a column's size, and why."""

    relative: float
    reason: str = ""
    elsewhere: bool = False
    """Whether only where the CPU's arithmetic is not the golden's."""


Tolerances = Mapping[str, Tolerance]


class Discrepancy(NamedTuple):
    """A part of a replay that is not the golden's.

    Attributes:
        run: whose.
        topic: where.
        part: the column, or what else of the stream.
        apart: how far, relative to the column's size; infinite where one is missing.
        allowed: how far it may be.
        row: the first kept row that is too far; None where none of them is.
        component: which one of the column.
        before, after: the golden's value there, and the replay's.
        stamp_ns: of the row, where the replayed stream is at hand.
    """

    run: str
    topic: str
    part: str
    apart: float
    allowed: float
    row: int | None = None
    component: str = ""
    before: float = math.nan
    after: float = math.nan
    stamp_ns: int | None = None

    @property
    def sentence(self) -> str:
        """All of it in words."""
        where = " ".join(filter(None, (self.run, self.topic, self.part)))
        told = ""
        if self.row is not None:
            what = f"{self.component} is " if self.component else ""
            at = f"in row {self.row}" if self.stamp_ns is None else f"at {self.stamp_ns} ns"
            told = f"{what}{self.after!r} {at}, the golden has {self.before!r}; "
        elif math.isinf(self.apart):
            return f"{where}: is not as in the golden"
        else:
            told = "rows between those that the golden keeps differ; "
        return f"{where}: {told}{self.apart:.2g} of its size apart, {self.allowed:g} is allowed"


class Replayed(NamedTuple):
    """What is checked: a golden of now, and the output streams of each run that it is made of."""

    golden: Golden
    outputs: Mapping[str, Outputs]


def make(
    sources: Mapping[str, LogSource | MemorySource],
    estimators: Settings,
    *,
    late: str | None = None,
    arrival_order: bool = False,
    columns: Sequence[str] = ("*",),
    tolerances: Tolerances | None = None,
) -> Replayed:
    """Replay runs, each by itself.

    Args:
        sources: the runs by name.
        estimators: settings by label.
        late: what is done about late messages, in the order of their arrival.
        arrival_order: go by log time.
        columns: patterns of what is kept, as `TOPIC COLUMN`.
        tolerances: by patterns as these.

    Raises BadInput where an estimator can follow no run.
    """
    order, policy = order_of(arrival_order=arrival_order, late=late)
    runs: dict[str, Any] = {}
    outputs: dict[str, Outputs] = {}
    for name, source in sources.items():
        replayed = replay_in_memory([source], estimators, order=order, late=policy)
        own = {topic: each.stream for topic, each in replayed.items() if _is_estimated(each.stream)}
        kept = [
            column
            for topic, stream in own.items()
            for field, column in stream.columns.items()
            if _is_kept(topic, field, columns)
        ]
        width = sum(math.prod(column.shape[1:]) for column in kept)
        rows = min(max(NUMBERS // max(width, 1), FEWEST_ROWS), MOST_ROWS)
        streams = {topic: _stream(stream, rows, columns) for topic, stream in own.items()}
        recorded = isinstance(source, MemorySource)
        runs[name] = {"input": input_hash(source), "recorded": recorded, "streams": streams}
        outputs[name] = own
    settings = {
        "estimators": estimators,
        "late": late,
        "arrival_order": arrival_order,
        "columns": list(columns),
    }
    return Replayed(golden_of(runs=runs, settings=settings, tolerances=tolerances), outputs)


def golden_of(
    *,
    runs: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    metrics: Mapping[str, Any] | None = None,
    tolerances: Tolerances | None = None,
) -> Golden:
    """A golden of these parts, as reading gives it back."""
    found = {
        "format": FORMAT,
        "arithmetic": arithmetic(),
        "settings": settings or {},
        "tolerances": {key: each._asdict() for key, each in (tolerances or {}).items()},
        "runs": runs or {},
        "metrics": metrics or {},
    }
    golden: Golden = json.loads(json.dumps(found, default=str))
    return golden


def input_hash(source: LogSource | MemorySource) -> str:
    """SHA-256 of a run: of a log its file, of a recording its columns."""
    return hash_files([source.log.path]) if isinstance(source, LogSource) else hash_streams([source])


def _is_estimated(stream: Stream) -> bool:
    """Whether an output is an estimator's; how much was estimated, and that nothing failed, is not."""
    schema = stream.schema.full_name
    return schema != schemas.COVERAGE.full_name and (len(stream) > 0 or schema not in REASONS)


def _is_kept(topic: str, column: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(f"{topic} {column}", pattern) for pattern in patterns)


def _stream(stream: Stream, rows: int, columns: Sequence[str]) -> dict[str, Any]:
    """What a golden has of a stream; of failures and the like only how many there were, and when."""
    has_values = stream.schema.full_name not in REASONS
    kept = _kept_rows(len(stream), rows)
    values = {
        name: column.astype(float)
        for name, column in stream.columns.items()
        if has_values and _is_kept(stream.topic, name, columns)
    }
    return {
        "rows": len(stream),
        "publish_times": _sha256(stream.publish_time_ns),
        "log_times": _sha256(stream.log_time_ns),
        "metadata": dict(stream.metadata) if has_values else {},
        "checksums": base64.b64encode(checksums(values).tobytes()).decode() if values else "",
        "columns": {name: _column(column, kept) for name, column in values.items()},
    }


def _kept_rows(count: int, most: int) -> NDArray[np.int64]:
    """So many of a stream's rows, evenly."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(np.int64)


def checksums(columns: Mapping[str, Floats]) -> NDArray[np.uint16]:
    """A checksum (rows,) of each row's bits: which tells where the first that differs is."""
    parts = [
        column.reshape(len(column), math.prod(column.shape[1:])) for _, column in sorted(columns.items())
    ]
    words = np.ascontiguousarray(np.hstack(parts)).view(np.uint64)
    odd = np.random.default_rng(0).integers(1, 2**63, words.shape[1], np.uint64) * 2 + 1
    mixed = (words ^ (words >> np.uint64(32))) * odd
    return (mixed.sum(axis=1, dtype=np.uint64) >> np.uint64(48)).astype("<u2")


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

    Where it is not a golden's, neither is a recorded input, and nothing can be equal to 1e-12.
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


def discrepancies(golden: Golden, replayed: Replayed) -> Iterator[Discrepancy]:
    """Everything in which a replay is not the golden, run by run.

    Raises BadInput where the runs, or what was put in, are others.
    """
    found = replayed.golden
    is_same_cpu = golden["arithmetic"] == found["arithmetic"]
    for name, stored, new in _pairs(golden["runs"], found["runs"]):
        if stored is None or new is None:
            there = some_of(golden["runs"])
            raise BadInput(
                f"{name}: the golden is of {there}; check the same runs, or write a new one with "
                "--update"
            )
        is_same_input = stored["input"] == new["input"]
        if not is_same_input and (is_same_cpu or not stored["recorded"]):
            raise BadInput(
                f"{name}: the recorded or imported data have changed, so that estimates cannot be "
                "compared; check the golden's own data, or write a new one with --update"
            )
    known = {key: Tolerance(**each) for key, each in golden["tolerances"].items()}

    def missing(run: str, topic: str, part: str) -> Discrepancy:
        tolerances = [
            each.relative
            for pattern, each in known.items()
            if fnmatch(f"{topic} {part}", pattern) and not (is_same_cpu and each.elsewhere)
        ]
        allowed = max([TOLERANCE if is_same_cpu else TOLERANCE_ELSEWHERE, *tolerances])
        return Discrepancy(run, topic, part, np.inf, allowed)

    for each in _distances(golden, found, missing):
        if each.apart <= each.allowed:
            continue
        stream = replayed.outputs.get(each.run, {}).get(each.topic)
        if each.row is not None and stream is not None and each.row < len(stream):
            each = each._replace(stamp_ns=int(stream.publish_time_ns[each.row]))
        yield each


def _distances(
    golden: Golden, found: Golden, missing: Callable[[str, str, str], Discrepancy]
) -> Iterator[Discrepancy]:
    """How far every part is from the golden's, relative to its size; infinite where one is missing."""
    for key, stored, new in _pairs(golden["metrics"], found["metrics"]):
        before, after = _floats(stored), _floats(new)
        if before.shape != after.shape:
            yield missing("", "metric", key)
            continue
        apart = float(np.max(_relative(_difference(before, after), np.abs(before)), initial=0.0))
        yield missing("", "metric", key)._replace(apart=apart)
    for name, run in golden["runs"].items():
        for topic, stored, new in _pairs(run["streams"], found["runs"][name]["streams"]):
            if new is None or stored is None:
                yield missing(name, topic, "as a whole")
                continue
            for part in ("rows", "publish_times", "log_times", "metadata"):
                apart = 0.0 if stored[part] == new[part] else np.inf
                yield missing(name, topic, part)._replace(apart=apart)
            for column in sorted(stored["columns"].keys() | new["columns"].keys()):
                yield _column_distance(missing(name, topic, column), stored, new)


def _pairs(stored: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    for key in sorted(stored.keys() | new.keys()):
        yield key, stored.get(key), new.get(key)


def _column_distance(
    about: Discrepancy, stored: Mapping[str, Any], new: Mapping[str, Any]
) -> Discrepancy:
    """The largest of a column, relative to its root mean square; angles are as large as one radian."""
    name, rows, kinds = about.part, stored["rows"], stored["metadata"].get("kinds", "").split(",")
    if name not in stored["columns"] or name not in new["columns"]:
        return about
    if not rows:
        return about._replace(apart=0.0)
    before, after = (
        {key: _floats(value) for key, value in each["columns"][name].items()} for each in (stored, new)
    )
    if before["kept"].shape != after["kept"].shape:
        return about
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
    relative = {key: _relative(apart[key], sizes[key]) for key in sizes}
    largest = float(np.max([np.max(each, initial=0.0) for each in relative.values()]))
    too_far = np.argwhere(~(relative["kept"] <= about.allowed))
    if not len(too_far):
        return about._replace(apart=largest)
    place = tuple(too_far[0])
    return about._replace(
        apart=largest,
        row=int(_kept_rows(rows, len(before["kept"]))[place[0]]),
        component=_component(stored["metadata"], place[1:], before["kept"].shape[1:]),
        before=float(before["kept"][place]),
        after=float(after["kept"][place]),
    )


def _component(metadata: Mapping[str, str], place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """What an entry of a row is called; of a matrix its row and its column."""
    if not place:
        return ""
    names = metadata.get("components", "").split(",")
    if shape == (len(names),):
        return names[place[0]]
    if shape == (len(names) ** 2,):
        row, column = (names[each] for each in divmod(int(place[0]), len(names)))
        return row if row == column else f"{row} and {column}"
    return f"[{', '.join(map(str, place))}]"


def _floats(values: Any) -> Floats:
    """An array; a null is NaN."""
    return np.asarray(values, float)


def _difference(before: Floats, after: Floats) -> Floats:
    """What is missing in both is equal."""
    return np.where(np.isnan(before) & np.isnan(after), 0.0, after - before)


def _relative(difference: Floats, size: ArrayLike) -> Floats:
    """Differences relative to their size; NaN where a value is missing in one of the two."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative: Floats = np.where(difference == 0.0, 0.0, np.abs(difference) / size)
    return relative


def first_of(found: Sequence[Discrepancy], replayed: Replayed, golden: Golden) -> list[str]:
    """What is said of the first discrepancy in time: itself, where it begins, the innovation there."""
    timed = [each for each in found if each.stamp_ns is not None]
    first = min(timed, key=lambda each: each.stamp_ns or 0) if timed else found[0]
    said = [first.sentence]
    if not first.run or first.topic not in replayed.outputs[first.run]:
        return said
    outputs = replayed.outputs[first.run]
    begin_ns = _first_changed(first, replayed, golden)
    if begin_ns is not None:
        said.append(f"bits of {first.topic} differ from {begin_ns} ns on, which may be rounding")
    stamp_ns = first.stamp_ns if begin_ns is None else begin_ns
    if stamp_ns is not None:
        said += _innovation_at(outputs, split_topic(first.topic), stamp_ns)
    return said


def _first_changed(first: Discrepancy, replayed: Replayed, golden: Golden) -> int | None:
    """The stamp of the first row with other bits; None where rows cannot be compared one by one."""
    stored, new = (
        each["runs"][first.run]["streams"].get(first.topic) for each in (golden, replayed.golden)
    )
    if stored is None or stored["publish_times"] != new["publish_times"]:
        return None
    if golden["arithmetic"] != replayed.golden["arithmetic"]:
        return None
    before, after = (np.frombuffer(base64.b64decode(each["checksums"]), "<u2") for each in (stored, new))
    if len(before) != len(after):
        return None
    changed = np.flatnonzero(before != after)
    stamps_ns = replayed.outputs[first.run][first.topic].publish_time_ns
    return int(stamps_ns[changed[0]]) if len(changed) else None


def _innovation_at(outputs: Outputs, what: tuple[str, str], stamp_ns: int) -> Iterator[str]:
    """The innovation of an estimator at a stamp, or the last before it, of each innovation stream."""
    for topic, stream in outputs.items():
        if split_topic(topic) != what or stream.schema.full_name != schemas.INNOVATION.full_name:
            continue
        row = int(np.searchsorted(stream.publish_time_ns, stamp_ns))
        if row == len(stream) or stream.publish_time_ns[row] != stamp_ns:
            row -= 1  # none at the stamp itself: the last one before
        if row >= 0:
            values = ", ".join(f"{value:.6g}" for value in np.atleast_1d(stream["innovation"][row]))
            nis = stream["normalised_innovation_squared"][row]
            at_ns = stream.publish_time_ns[row]
            yield f"the innovation there: {values} with NIS {nis:.4g} at {at_ns} ns ({topic})"
