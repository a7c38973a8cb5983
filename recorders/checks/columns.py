"""Checks of single columns: values that freeze, are rounded, or are clipped at the sensor's range."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding, Severity, since_first
from fuselog.recorders.checks.losses import FEWEST, REGULARS, is_measured
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.orientation import heading

Floats = NDArray[np.float64]
# Number of rows, and multiple of the usual run, for which a value may stay the same.
LONG, TIMES = 10, 10.0
NEXT = 2.5  # grid steps within which a value is a neighbour
MOVING = 0.5  # share of the rows of a span in which another column changes
LOOKED_AT = 20_000  # rows from which a resolution is determined
LEVELS, CHANGES = 3, 0.05  # least number of values of a rounded column, and least share of changes
SHARE, ROWS, NEAR = 1e-3, 5, 5e-3
# For an end at which values are clipped: its share of the rows, how many times more frequent it is than
# other values, the number of values, how many times it is reached, and the share of the other rows that
# differ.
CLIPPED, MORE_OFTEN, MANY_LEVELS, RUNS, MEASURED = 5e-3, 5.0, 20, 3, 0.9
# For a code among values: its step in usual steps, the share of it by which others differ, and its
# count.
ALONE, ALIKE, OFTEN = 20.0, 0.2, 3
FAR = 0.1  # distance of a code from all other values, as a share of their range
RANGES = {
    "turn_rate_radps": np.radians([125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0]),
    "specific_force_mps2": 9.80665 * np.array([2.0, 4.0, 8.0, 16.0, 32.0]),
}
COUNTS = 2**15
_DRIVEN = {schemas.ODOMETRY.full_name, schemas.TWIST.full_name}  # where exact zeros mean standstill


def frozen(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find a value that stays the same far longer than usual, while other columns change.

    If the values of a rounded column before and after are at most two grid steps away, the body was at
    rest, and the column was not frozen.
    """
    entries = list(_entries(stream))
    for field, name, column in entries:
        missing = np.isnan(column)
        is_new = (column[1:] != column[:-1]) & ~(missing[1:] & missing[:-1])
        edges = np.flatnonzero(np.append(True, is_new))
        if len(edges) < 2 or len(column) < FEWEST:
            continue
        runs = np.diff(np.append(edges, len(column)))
        usual = float(np.quantile(runs, 0.99))  # rounded or slow columns stay sometimes
        if runs.max() > max(LONG, TIMES * usual):
            runs[_rests(column, edges)] = 0
        begin, length = int(edges[np.argmax(runs)]), int(runs.max())
        is_standing = stream.schema.full_name in _DRIVEN and column[begin] == 0.0
        if length <= max(LONG, TIMES * usual) or is_standing or not np.isfinite(column[begin]):
            continue
        others = [other for of, at, other in entries if (of, at) != (field, name)]
        if any(_changes(other[begin : begin + length]) > MOVING / max(usual, 1.0) for other in others):
            yield Finding(
                "values",
                stream.topic,
                field,
                float(length),
                f"{stream.topic}: {name} is frozen at {column[begin]:.6g} for {length} messages, from "
                f"{since_first(stream, stream.publish_time_ns[begin])}, while {usual:.3g} are usual and "
                "others change",
                otherwise="cut out these messages: fuselog cut LOG --start ... --end ...",
            )


def codes(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find a number that recurs far from the values around it, as codes for missing values do."""
    entries = [(*each, np.inf) for each in _entries(stream) if each[0] not in RANGES]
    if stream.schema.full_name == schemas.ORIENTATION.full_name:
        entries = [("quaternion", "the heading in rad", heading(stream["quaternion"]), np.pi)]
    elif stream.schema.full_name == schemas.GEODETIC_FIX.full_name:
        entries = [("altitude_m", "altitude_m", stream["altitude_m"], np.inf)]
    for field, name, column, half_turn in entries:
        known = np.flatnonzero(np.isfinite(column))
        if len(known) < FEWEST:
            continue
        values = column[known]
        steps, two = _apart(np.diff(values), half_turn), _apart(values[2:] - values[:-2], half_turn)
        usual, smaller = float(np.median(steps)), np.minimum(steps[1:], steps[:-1])
        alone = (smaller > ALONE * usual) & (two < ALIKE * smaller)
        found, counts = np.unique(values[1:-1][alone], return_counts=True)
        if counts.max(initial=0) < max(OFTEN, 0.8 * alone.sum()):
            continue
        code = float(found[np.argmax(counts)])
        others = values[values != code]
        is_pulse = (
            usual == 0.0 and abs(code) < 2.0 * np.abs(others).max()
        )  # of a column that mostly rests
        if is_pulse or counts.max() < 0.5 * (len(values) - len(others)):
            continue
        yield Finding(
            "values",
            stream.topic,
            field,
            code,
            f"{stream.topic}: {name} is {code:.6g} in {counts.max()} messages, each far from those "
            "before and after it: a code for a missing value, which is used as a value",
            otherwise="missing = { COLUMN = [...] } in the table of the mapping",
        )


def negative(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find negative distances: a repeated one is a code for a missing value, others may be noise."""
    if "range_m" not in stream.columns:
        return
    ranges_m = stream["range_m"]
    is_there = ranges_m < 0.0
    if not is_there.any():
        return
    least_m = float(ranges_m[is_there].min())
    is_code = int(is_there.sum()) >= OFTEN and bool((ranges_m[is_there] == least_m).all())
    first_ns = int(stream.publish_time_ns[int(np.argmax(is_there))])
    words, fix = (
        "below zero, down to",
        "correct the offset of the sensor, or of range_m under `offsets` in the mapping",
    )
    if is_code:
        words, fix = (
            "a code for a missing value,",
            "missing = { COLUMN = [...] } in the table of the mapping",
        )
    yield Finding(
        "values",
        stream.topic,
        "range_m",
        float(is_there.sum()),
        f"{stream.topic}: range_m is {words} {least_m:.4g} m in {int(is_there.sum())} of {len(stream)} "
        f"messages, the first {since_first(stream, first_ns)}",
        otherwise=fix,
        severity="likely" if is_code else "hint",
        time_ns=first_ns,
    )


def _apart(steps: Floats, half_turn: float) -> Floats:
    """Return the sizes of steps; the sizes of steps in an angle are those in the shorter direction."""
    sizes = np.abs(steps)
    return sizes if half_turn == np.inf else np.minimum(sizes, 2 * half_turn - sizes)


def rounded(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find columns that are rounded to a grid coarser than their noise."""
    for field, name, column in _entries(stream):
        known = column[:LOOKED_AT][np.isfinite(column[:LOOKED_AT])]
        step = resolution(known)
        if not step or _changes(known) < CHANGES:
            continue
        noise = float(np.std(np.diff(known, 2)) / np.sqrt(6.0))
        if step > noise > 0.0:
            yield Finding(
                "values",
                stream.topic,
                field,
                step,
                f"{stream.topic}: {name} is rounded to {step:.3g}, but its noise is {noise:.2g}: "
                "smaller changes are lost, and its errors are not white",
                otherwise="write it with more digits, or state a noise of at least "
                f"{step / np.sqrt(12.0):.2g}",
                severity="hint",
            )


def saturated(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find columns that are clipped at the end of a common sensor range, or at another value.

    Values that are constant because the body is at rest, and exact zeros, are not reported.
    """
    entries = list(_entries(stream, is_regular=False))
    for field, name, column in entries:
        known = column[np.isfinite(column)]
        levels, counts = np.unique(known, return_counts=True)
        ends: list[float] = []
        severity: Severity = "hint"
        is_range = False
        for at in (-1, 0) if len(levels) > 1 else ():
            end, count = float(levels[at]), int(counts[at])
            if count < max(ROWS, SHARE * len(column)) or end == 0.0:
                continue
            is_there = column == end
            others = [other for of, which, other in entries if (of, which) != (field, name)]
            varying = [other for other in others if len(np.unique(other[np.isfinite(other)])) > 1]
            is_end = _is_end_of_range(stream, field, known, end)
            usual = max(len(known) / len(levels), counts[-2 if at else 1])
            is_clipped = _is_clipped(is_there, len(levels), usual, varying)
            if not is_end and (not is_clipped or _is_code(levels, at)):
                continue
            is_noisy = _changes(known[known != end]) > MEASURED
            is_sure = stream.schema.full_name in REGULARS and is_noisy
            ends.append(end)
            is_range |= is_end
            if is_end or (is_sure and (varying or not others)):
                severity = "likely"
        if not ends:
            continue
        is_there = np.isin(column, ends)
        first_ns = int(stream.publish_time_ns[int(np.argmax(is_there))])
        which = "greatest" if ends == [levels[-1]] else "least"
        what = "the end of a range" if is_range else f"its {which} value"
        if len(ends) == 2:
            what = "the ends of a range" if is_range else "its greatest and its least value"
        yield Finding(
            "values",
            stream.topic,
            field,
            float(is_there.sum()),
            f"{stream.topic}: {name} is saturated: {int(is_there.sum())} of {len(column)} messages are "
            f"at {' or '.join(f'{end:.6g}' for end in ends)}, {what}, the first "
            f"{since_first(stream, first_ns)}",
            otherwise="set the sensor to a larger range"
            if is_range
            else "if this is the end of the sensor's range, set it to a larger range; if it is a limit "
            "of the vehicle, nothing is wrong",
            severity=severity,
            time_ns=first_ns,
        )


def _is_code(levels: Floats, at: int) -> bool:
    """Test whether an end of sorted values is far from all others, like a code for a missing value."""
    step = abs(levels[at] - levels[-2 if at else 1])
    others = np.ptp(levels[:-1] if at else levels[1:])
    return bool(len(levels) > 2 and step > FAR * others)


def _is_end_of_range(stream: Stream, field: str, column: Floats, end: float) -> bool:
    """Test whether an inertial value is the end of a usual sensor range, or of 16-bit integers."""
    ranges = RANGES.get(field)
    if ranges is None or stream.schema.full_name != schemas.INERTIAL_SAMPLE.full_name:
        return False
    step = resolution(column[:LOOKED_AT])
    is_last = step > 0.0 and COUNTS - 1.5 < abs(end) / step < COUNTS + 0.5
    return is_last or bool(np.abs(abs(end) / ranges - 1.0).min() < NEAR)


def _is_clipped(
    is_there: NDArray[np.bool_], levels: int, usual: float, others: Sequence[Floats]
) -> bool:
    """Test whether an extreme value is far more frequent than others, while other columns change."""
    if levels < MANY_LEVELS or is_there.sum() <= max(CLIPPED * len(is_there), MORE_OFTEN * usual):
        return False
    runs = int(is_there[0]) + int(np.sum(np.diff(is_there.astype(np.int8)) > 0))
    moves = not others or any(_changes(other[is_there]) > MOVING for other in others)
    return moves and runs >= RUNS


def resolution(values: Floats) -> float:
    """Determine the spacing of the grid on which all values are; return zero without such a grid."""
    levels = np.unique(values)
    if len(levels) < LEVELS or len(levels) > len(values) / 2:
        return 0.0
    steps = np.diff(levels)
    step = float(steps.min())
    largest = max(abs(float(levels[0])), abs(float(levels[-1])))
    if step < 1e-9 * largest:
        return 0.0
    places = (levels - levels[0]) / step
    # a step is known to the rounding of the numbers, which accumulates over the grid
    tolerance = 0.01 + 4e-16 * largest / step * places
    return step if (np.abs(places - np.rint(places)) < tolerance).all() else 0.0


def _entries(stream: Stream, *, is_regular: bool = True) -> Iterator[tuple[str, str, Floats]]:
    """Yield field, name and values (n,) of each component, for regular or for all measured topics."""
    if stream.schema.full_name not in REGULARS if is_regular else not is_measured(stream):
        return
    for entry in stream.schema:
        column = stream.columns[entry.name]
        if entry.kind not in ("real", "vector") or entry.name.startswith("covariance"):
            continue
        if column.ndim == 1:
            yield entry.name, entry.name, column
        for index in range(column.shape[1] if column.ndim == 2 else 0):
            axis = "xyz"[index] if column.shape[1] <= 3 else str(index)
            yield entry.name, f"{entry.name} {axis}", column[:, index]


def _rests(column: Floats, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Test which repeated values result from rounding: both neighbours are a few grid steps away."""
    steps = np.abs(np.diff(column[edges]))
    farther = np.maximum(np.append(0.0, steps), np.append(steps, 0.0))
    levels = np.unique(column[np.isfinite(column)])
    return np.less_equal(farther, NEXT * np.diff(levels).min(initial=np.inf))


def _changes(values: Floats) -> float:
    return float(np.mean(values[1:] != values[:-1])) if len(values) > 1 else 0.0
