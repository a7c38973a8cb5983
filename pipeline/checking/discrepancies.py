"""Functions that find what differs between a replay and its golden, by how much and since when."""

import base64
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fuselog.pipeline.checking.golden import (
    TOLERANCE,
    TOLERANCE_ELSEWHERE,
    Floats,
    Outputs,
    Replayed,
    Tolerance,
    kept_rows,
)
from fuselog.pipeline.checking.stored import Golden
from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.log import schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.judging.errors.evaluation import split_topic


class Discrepancy(NamedTuple):
    """A part of a replay that differs from the golden.

    Attributes:
        run: name of the run.
        topic: topic of the stream.
        part: the column, or another part of the stream, such as its metadata.
        apart: difference relative to the size of the column; infinite if the golden or the replay lacks
            the part.
        allowed: largest allowed difference, relative to the size of the column.
        row: first row in the golden whose difference exceeds `allowed`; None if there is no such row.
        component: component of the column.
        before, after: values of the golden and of the replay in the row `row`.
        stamp_ns: stamp of the row, if the replayed stream is available.
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
        """Return a description of the discrepancy."""
        where = " ".join(filter(None, (self.run, self.topic, self.part)))
        detail = ""
        if self.row is not None:
            what = f"{self.component} is " if self.component else ""
            at = f"in row {self.row}" if self.stamp_ns is None else f"at {self.stamp_ns} ns"
            detail = f"{what}{self.after!r} {at}, the golden has {self.before!r}; "
        elif math.isinf(self.apart):
            return f"{where}: differs from the golden"
        else:
            detail = "the rows that differ are not among those stored in the golden; "
        return f"{where}: {detail}relative difference {self.apart:.2g}, allowed {self.allowed:g}"


def discrepancies(golden: Golden, replayed: Replayed) -> Iterator[Discrepancy]:
    """Yield the parts of a replay that differ from the golden by more than allowed, run by run.

    Raises BadInput if the runs or their inputs are not those of the golden.
    """
    found = replayed.golden
    is_same_cpu = golden["arithmetic"] == found["arithmetic"]
    for name, stored, new in _pairs(golden["runs"], found["runs"]):
        if stored is None or new is None:
            there = some_of(golden["runs"])
            raise BadInput(
                f"{name}: the golden contains {there}; check the same runs, or write a new golden with "
                "--update"
            )
        is_same_input = stored["input"] == new["input"]
        if not is_same_input and (is_same_cpu or not stored["recorded"]):
            raise BadInput(
                f"{name}: the recorded or imported data have changed, so estimates cannot be "
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
    """Yield every part's relative difference from the golden, which is infinite for a missing part."""
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
    """Find the largest difference of a column, relative to its root mean square.

    For angles and other bounded components, the divisor is at least one.
    """
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
    size = _size(before, rows)
    if name == "covariance":
        deviation = np.sqrt(size[:: math.isqrt(len(size)) + 1])
        size = np.outer(deviation, deviation).ravel()
    apart = {key: _difference(before[key], after[key]) for key in before}
    if size.shape == (len(kinds),):
        bounded, angle = np.array([kind != "linear" for kind in kinds]), np.array(kinds) == "angle"
        size = np.where(bounded, np.maximum(size, 1.0), size)
        for key in ("kept", "sum"):
            apart[key] = np.where(angle, wrap_angle(apart[key]), apart[key])
    with np.errstate(over="ignore"):
        squares = 2 * rows * size**2
    sizes = {"kept": size, "sum": rows * size, "sum_of_squares": squares, "missing": 1.0}
    relative = {key: _relative(apart[key], sizes[key]) for key in sizes}
    largest = float(np.max([np.max(each, initial=0.0) for each in relative.values()]))
    too_far = np.argwhere(~(relative["kept"] <= about.allowed))
    if not len(too_far):
        return about._replace(apart=largest)
    place = tuple(too_far[0])
    return about._replace(
        apart=largest,
        row=int(kept_rows(rows, len(before["kept"]))[place[0]]),
        component=_component(stored["metadata"], place[1:], before["kept"].shape[1:]),
        before=float(before["kept"][place]),
        after=float(after["kept"][place]),
    )


def _component(metadata: Mapping[str, str], place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """Name an entry of a row; entries of a matrix are named by row and column."""
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
    """Convert values to an array in which null is NaN."""
    return np.asarray(values, float)


def _size(before: Mapping[str, Floats], rows: int) -> Floats:
    """Compute the root mean square of a column, or its largest magnitude if the squares overflow."""
    size = np.sqrt(before["sum_of_squares"] / np.maximum(rows - before["missing"], 1))
    finite = np.where(np.isfinite(before["kept"]), np.abs(before["kept"]), 0.0)
    return np.where(np.isinf(size), np.max(finite, axis=0, initial=0.0), size)


def _difference(before: Floats, after: Floats) -> Floats:
    """Subtract `before` from `after`; equal infinities and values missing in both give zero."""
    with np.errstate(invalid="ignore", over="ignore"):
        difference: Floats = after - before
    return np.where((before == after) | (np.isnan(before) & np.isnan(after)), 0.0, difference)


def _relative(difference: Floats, size: ArrayLike) -> Floats:
    """Divide differences by `size`; zero differences give zero, and missing values give NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative: Floats = np.where(difference == 0.0, 0.0, np.abs(difference) / size)
    return relative


def first_of(found: Sequence[Discrepancy], replayed: Replayed, golden: Golden) -> list[str]:
    """Describe the earliest discrepancy, the stamp of the first differing bits, and the innovation."""
    timed = [each for each in found if each.stamp_ns is not None]
    first = min(timed, key=lambda each: each.stamp_ns or 0) if timed else found[0]
    sentences = [first.sentence]
    if not first.run or first.topic not in replayed.outputs[first.run]:
        return sentences
    outputs = replayed.outputs[first.run]
    begin_ns = _first_changed(first, replayed, golden)
    if begin_ns is not None:
        sentences.append(
            f"the bits of {first.topic} differ from {begin_ns} ns on, perhaps only because of rounding"
        )
    stamp_ns = first.stamp_ns if begin_ns is None else begin_ns
    if stamp_ns is not None:
        sentences += _innovation_at(outputs, split_topic(first.topic), stamp_ns)
    return sentences


def _first_changed(first: Discrepancy, replayed: Replayed, golden: Golden) -> int | None:
    """Find the stamp of the first row whose bits differ; return None if no such row can be found."""
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
    """Yield, for each stream of an estimator, the innovation at a stamp or the last one before it."""
    for topic, stream in outputs.items():
        if split_topic(topic) != what or stream.schema.full_name != schemas.INNOVATION.full_name:
            continue
        row = int(np.searchsorted(stream.publish_time_ns, stamp_ns))
        if row == len(stream) or stream.publish_time_ns[row] != stamp_ns:
            row -= 1  # no innovation at the stamp itself: use the last one before it
        if row >= 0:
            values = ", ".join(f"{value:.6g}" for value in np.atleast_1d(stream["innovation"][row]))
            nis = stream["normalised_innovation_squared"][row]
            at_ns = stream.publish_time_ns[row]
            yield f"the innovation there: {values} with NIS {nis:.4g} at {at_ns} ns ({topic})"
