"""A mapping to start from: what the columns of tables look like by their names and numbers.

What is guessed stands in the mapping, and why as a comment beside it; what looks like nothing becomes a
vector of plain numbers. A person reads and mends it: the text is the product, not the import.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.importers.tables.files import Batch, open_table
from recorders.importers.tables.times import NOT_A_TIME, TimeMapping, stamps_ns
from recorders.importers.units import unit

# How many rows are looked at.
_ROWS = 100_000
# A file without times that has fewer is a summary or a text.
_FEWEST = 10
# Units of stamps by the least that today's date is in them.
_EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 1e8))
_UNKNOWN_ZERO = "2026-01-01"
# What vectors are called.
_ACCELEROMETERS = ("acc", "accel", "accelerometer", "acceleration", "specific_force", "a")
_GYROSCOPES = ("gyr", "gyro", "gyroscope", "angular_velocity", "rate", "omega", "w", "g")
_QUATERNIONS = ("quaternion", "quat", "orientation", "rotation", "q")


class _Column(NamedTuple):
    """A column: its name, that without unit in lower case, the unit in brackets, and its numbers."""

    name: str
    plain: str
    unit: str
    values: NDArray


def guess(paths: Sequence[Path]) -> str:
    """A mapping of tables, in TOML; raises BadInput where a file is no table."""
    files = []
    for path in paths:
        if not path.exists():
            raise BadInput(f"{path}: no such file or folder; give the tables to look at")
        inside = sorted(path.rglob("*")) if path.is_dir() else [path]
        files += [
            (file, file.relative_to(path) if path.is_dir() else Path(file.name)) for file in inside
        ]
    tables: list[str] = []
    notes: list[str] = []
    for file, name in files:
        if file.is_file():
            try:
                tables.append(_table(file, name.as_posix(), is_alone=len(files) == 1))
            except BadInput as error:
                notes.append(str(error))
    if not tables:
        raise BadInput(notes[0] if len(notes) == 1 else f"{paths[0]}: holds no table among its files")
    head = [
        "# What fuselog guessed; mend what is wrong: docs/your-log.md says how.",
        f"summary = {json.dumps(f'guessed from {paths[0].name}')}",
        *(f"# not taken: {note}" for note in notes),
    ]
    return "\n".join(head) + "\n\n" + "\n".join(tables)


def _table(path: Path, name: str, *, is_alone: bool) -> str:
    """One [[tables]] of a mapping, with its streams."""
    table = open_table(path)
    batch = next(table.batches((), table.columns), None)
    if batch is None:
        raise BadInput(f"{path}: holds no rows")
    batch = {column: cells[:_ROWS] for column, cells in batch.items()}
    columns, texts = [], []
    for column in table.columns:
        values = _numbers(batch[column])
        if values is None:
            texts.append(column)
        else:
            columns.append(_Column(column, *_parted(column), values))
    time, used, told = _time(batch, columns, texts)
    if not columns or (not used and len(columns[0].values) < _FEWEST):
        raise BadInput(
            f"{path}: has no times, and no columns of {_FEWEST} numbers or more; write a mapping "
            "by hand, as docs/your-log.md says"
        )
    lines = ["[[tables]]", f"files = {json.dumps(name)}", *told, f"time = {time}"]
    if all(column.isdecimal() for column in table.columns):
        blanks = ", ".join(f'"{column}"' for column in table.columns)
        lines.append(f"# The file does not name its columns; to name them: columns = [{blanks}]")
    if rest := [text for text in texts if text not in used]:
        lines.append(f"# Columns with texts, not taken: {', '.join(rest)}")
    prefix = (
        "" if is_alone else "/" + re.sub(r"\W+", "_", Path(name).with_suffix("").as_posix()).strip("_")
    )
    left = [column for column in columns if column.name not in used]
    for guessed in _GUESSES:
        lines += guessed(left, prefix)
    return "\n".join([*lines, *_rest(left, prefix)]) + "\n"


def _numbers(cells: pa.Array) -> NDArray | None:
    """A column's numbers, NaN for empty cells; None where it holds something else, or nothing."""
    if pa.types.is_string(cells.type):
        cells = pc.utf8_trim_whitespace(cells)
    try:
        found = cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except pa.ArrowException:
        return None
    return found if np.isfinite(found).any() else None


def _parted(name: str) -> tuple[str, str]:
    """A name without what is in brackets, in lower case with underlines; and that, if it is a unit."""
    match = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]", name)
    given = match[1].replace("degrees", "deg").replace("meters", "m") if match else ""
    try:
        known = given if given and unit(given) else ""
    except BadInput:
        known = ""
    plain = name[: match.start()] if match else name
    return re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_"), known


# The time.


def _time(
    batch: Batch, columns: Sequence[_Column], texts: Sequence[str]
) -> tuple[str, set[str], list[str]]:
    """The time as TOML, the columns that it is of, and what was seen."""
    for name in texts:
        names = ["date", "time"] if name == "date" and "time" in texts else [name]
        if found := _seen(TimeMapping(column=names, unit="date"), batch):
            zone = "# If its clock is not UTC: utc_offset_h = 8 is one 8 hours ahead."
            return f'{{ column = {json.dumps(names)}, unit = "date" }}', set(names), [*found, zone]
    named = [column for column in columns if re.search("time|stamp|utc|^t$|^sec", column.plain)]
    first = [columns[0]] if columns else []
    for column in (*named, *first):
        known = column.values[np.isfinite(column.values)]
        if len(known) < 2 or np.mean(np.diff(known) >= 0) < 0.9 or known[-1] <= known[0]:
            continue
        middle, step = float(np.median(known)), float(np.median(np.diff(known)))
        epoch = next((name for name, least in _EPOCHS if middle >= least), None)
        relative = "ns" if step > 1e5 else "us" if step > 1e3 else "ms" if step >= 1 else "s"
        in_unit = column.unit if column.unit in dict(_EPOCHS) else epoch or relative
        told = []
        if epoch is None:
            told = [
                f"# Stamps begin at {known[0]:g}: give the date that they count from; check the unit."
            ]
        zero = f', zero = "{_UNKNOWN_ZERO}"' if epoch is None else ""
        given = {"column": column.name, "unit": in_unit, "zero": _UNKNOWN_ZERO}
        mapping = TimeMapping.model_validate(given)
        text = f'{{ column = {json.dumps(column.name)}, unit = "{in_unit}"{zero} }}'
        return text, {column.name}, [*told, *_seen(mapping, batch)]
    return (
        '{ rate_hz = 1, zero = "2026-01-01" }',
        set(),
        ["# No column looks like a time: give the rate of the rows."],
    )


def _seen(mapping: TimeMapping, batch: Batch) -> list[str]:
    """The rate, gaps and repetitions of stamps; none where they cannot be read."""
    try:
        stamps = stamps_ns(mapping, batch, 0, len(next(iter(batch.values()))), "")
    except BadInput:
        return []
    steps_s = np.diff(stamps[stamps != NOT_A_TIME]) * 1e-9
    forward = steps_s[steps_s > 0]
    if not len(forward):
        return ["# All rows have one stamp."]
    usual_s = float(np.median(forward))
    gaps = forward[forward > 5 * usual_s]
    told = f"# {1 / usual_s:.4g} rows a second"
    if len(gaps):
        told += f"; {len(gaps)} gaps over {5 * usual_s:.3g} s, the longest {gaps.max():.3g} s"
    for what, which in (("repeat", steps_s == 0), ("go back", steps_s < 0)):
        if which.any():
            told += f"; {which.sum()} stamps {what}"
    return [f"{told}."]


# What columns are together.


def _take(columns: list[_Column], *patterns: str) -> list[_Column]:
    """The columns whose names fit the patterns, one each, taken out of the list; none unless all do."""
    found = []
    for pattern in patterns:
        match = next((each for each in columns if re.fullmatch(pattern, each.plain)), None)
        if match is None:
            return []
        found.append(match)
    columns[:] = [each for each in columns if each not in found]
    return found


def _axes(columns: list[_Column], *stems: str) -> list[_Column]:
    """The columns x, y, z of a vector whose name is one of some."""
    for stem in stems:
        before = f"(.*_)?{stem}_?" if stem else ""
        if found := _take(columns, *(before + axis for axis in "xyz")):
            return found
    return []


def _by_size(columns: Sequence[_Column], sizes: Mapping[str, tuple[float, float]]) -> tuple[str, str]:
    """The unit in which a vector's length is as it must be, else the first; and what was seen."""
    usual = next(iter(sizes))
    if columns[0].unit and unit(columns[0].unit).powers == unit(usual).powers:
        return columns[0].unit, "as its name says"
    length = float(np.nanmedian(np.linalg.norm([column.values for column in columns], axis=0)))
    for name, (low, high) in sizes.items():
        if low <= length <= high:
            return name, f"its median length is {length:.4g}"
    return usual, f"a guess: its median length is {length:.4g}"


def _stream(topic: str, becomes: str, *lines: str) -> list[str]:
    return ["", "[[tables.streams]]", f'topic = "{topic}"', f'becomes = "{becomes}"', *lines]


def _names(columns: Sequence[_Column]) -> str:
    return json.dumps([column.name for column in columns])


def _inertial(columns: list[_Column], prefix: str) -> Iterator[str]:
    whole = list(columns)
    force = _axes(columns, *_ACCELEROMETERS)
    rate = _axes(columns, *_GYROSCOPES)
    if not (force and rate):
        columns[:] = whole
        return
    force_unit, why = _by_size(force, {"m/s^2": (8, 12), "g": (0.8, 1.2), "mg": (800, 1200)})
    largest = float(np.nanmax(np.abs([column.values for column in rate])))
    stated = rate[0].unit if rate[0].unit and unit(rate[0].unit).powers == unit("rad/s").powers else ""
    rate_unit = stated or ("deg/s" if largest > 10 else "rad/s")
    yield from _stream(
        f"{prefix}/inertial",
        "InertialSample",
        f"fields.specific_force_mps2 = {_names(force)}",
        f"fields.turn_rate_radps = {_names(rate)}",
        f"units.specific_force_mps2 = {json.dumps(force_unit)}   # {why}",
        f"units.turn_rate_radps = {json.dumps(rate_unit)}   # the largest is {largest:.4g}",
        "# The axes of the body are forward, left, up; to turn those of the sensor (roll, pitch, yaw):",
        "# mounting_deg = [0, 0, 0]",
    )


def _magnetic(columns: list[_Column], prefix: str) -> Iterator[str]:
    field = _axes(columns, "mag", "magnetometer", "magnetic_field", "m")
    if field:
        sizes = {"uT": (15, 90), "G": (0.15, 0.9), "mG": (150, 900), "nT": (15e3, 90e3)}
        given, why = _by_size(field, sizes)
        yield from _stream(
            f"{prefix}/magnetic_field",
            "MagneticField",
            f"fields.magnetic_field_ut = {_names(field)}",
            f"units.magnetic_field_ut = {json.dumps(given)}   # {why}",
        )


def _fix(columns: list[_Column], prefix: str) -> Iterator[str]:
    place = _take(columns, r"(.*_)?lat(itude)?(_deg.*)?", r"(.*_)?(lon|lng|long)(gitude)?(_deg.*)?")
    if not place:
        return
    lines = [
        f"fields.{field}_deg = {json.dumps(each.name)}"
        for field, each in zip(("latitude", "longitude"), place, strict=True)
    ]
    largest = float(np.nanmax(np.abs(place[0].values)))
    if place[0].unit == "rad" or (largest < np.pi / 2 and np.nanmax(np.abs(place[1].values)) <= np.pi):
        lines += [
            f'units.{field}_deg = "rad"   # latitudes up to {largest:.4g}'
            for field in ("latitude", "longitude")
        ]
    height = _take(columns, r"(.*_)?(alt|altitude|height|ellipsoidal_height|ele|elevation|h)(_m)?")
    if height:
        lines.append(f"fields.altitude_m = {json.dumps(height[0].name)}")
    deviations = _take(columns, r"sd_?e", r"sd_?n", r"sd_?u")
    if deviations:
        lines.append(f"deviations.covariance_m2 = {_names(deviations)}")
    else:
        lines += [
            "# No standard deviations are named; stated ones, east, north, up:",
            "# deviations.covariance_m2 = [1, 1, 2]",
        ]
    yield from _stream(f"{prefix}/fix", "GeodeticFix", *lines)


def _pose(columns: list[_Column], prefix: str) -> Iterator[str]:
    place = _axes(columns, "pos", "position", "p", "translation", "t", "") or _take(
        columns, "east", "north", "up"
    )
    factors = "" if place else "factors.position_m = [1, 1, -1]"
    place = place or _take(columns, "east", "north", "down")
    turns = (_take(columns, *(rf"(.*_)?{stem}_?{part}" for part in "wxyz")) for stem in _QUATERNIONS)
    turn = next(filter(None, turns), [])
    if not place:
        columns += turn
        return
    lines = [f"fields.position_m = {_names(place)}", *filter(None, [factors])]
    if turn:
        lines += [f"fields.quaternion = {_names(turn)}", "# If this is the truth:"]
    else:
        lines += [
            "deviations.covariance_m2 = [1, 1, 1]   # fill in the standard deviations",
            "# If this is the truth:",
        ]
    names = "x_m,y_m,z_m" + ",orientation_w,orientation_x,orientation_y,orientation_z" * bool(turn)
    kinds = "linear,linear,linear" + ",quaternion" * 4 * bool(turn)
    lines += [
        '# topic = "/truth", becomes = "TruthState", and in place of the fields above',
        f"# fields.state = {_names([*place, *turn])}",
        f'# components = "{names}"',
        f'# kinds = "{kinds}"',
    ]
    yield from _stream(
        *((f"{prefix}/pose", "Pose") if turn else (f"{prefix}/position", "PositionFix")), *lines
    )


def _velocity(columns: list[_Column], prefix: str) -> Iterator[str]:
    velocity = _axes(columns, "vel", "velocity", "v") or _take(columns, "ve", "vn", "vu")
    if velocity:
        yield from _stream(
            f"{prefix}/velocity",
            "VelocityFix",
            f"fields.velocity_mps = {_names(velocity)}",
            "deviations.covariance_m2ps2 = [0.1, 0.1, 0.1]   # fill in the standard deviations",
        )


_GUESSES: tuple[Callable[[list[_Column], str], Iterator[str]], ...] = (
    _inertial, _magnetic, _fix, _velocity, _pose,
)  # fmt: skip


def _rest(columns: Sequence[_Column], prefix: str) -> list[str]:
    """What looks like nothing in particular."""
    if not columns:
        return []
    plain = [
        column.plain if re.match("[a-z]", column.plain) else f"column_{column.plain}"
        for column in columns
    ]
    counts = Counter(plain)
    names = [name if counts[name] == 1 else f"{name}_{number}" for number, name in enumerate(plain, 1)]
    return _stream(
        f"{prefix}/values",
        "VectorMeasurement",
        f"fields.value = {_names(columns)}",
        f'components = "{",".join(names)}"',
    )
