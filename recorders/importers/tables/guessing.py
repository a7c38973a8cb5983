"""A mapping to start from: which messages the columns of tables are, by their names and numbers.

Every guess stands in the mapping with its reason as a comment beside it; columns that fit no message
become a vector of plain numbers. A person reads and mends it: the text is the product, not the import.
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

# How many rows are read.
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
_POSITIONS = ("pos", "position", "pose", "p", "translation", "t", "")
_FORWARD_SPEED = (
    r"(?!.*(ang|yaw|turn|rot|vert|lateral|wind))(.*_)?"
    r"(v|vel|velocity|speed|v_?x|vel_?x|velocity_x|linear(_velocity|_speed)?(_x)?|forward)"
)
_YAW_RATE = (
    r"w|(.*_)?(omega(_?z)?|(yaw|turn|heading|rotation)_?rate|(yaw|psi|theta|heading)_?dot|gyr(o|oscope)?_?z"
    r"|gz|w_?z|ang(ular)?_?(vel(ocity)?|speed|rate)(_?z)?|angular(_z)?)"
)
_HEADING = r"(.*_)?(heading|hdg|yaw|theta|psi|orientation)"
_EAST, _NORTH = "(x_)?east(ing)?|e", "(y_)?north(ing)?|n"
_TARGET = (
    r"(.*_)?(target|landmark|subject|barcode|beacon|anchor|marker|feature)(_?(id|number|nr|no))?|id"
)
# Names of files with the truth.
_REFERENCE = r"(?i)(^|[^a-z])(ref|reference|gt|(ground)?_?-?truth|mocap|vicon|optitrack)([^a-z]|$)"
# Units at the end of a name, as they are written there.
_ENDINGS = {
    "mps": "m/s", "m_s": "m/s", "kmh": "km/h", "kph": "km/h", "km_h": "km/h",
    "radps": "rad/s", "rad_s": "rad/s", "degps": "deg/s", "deg_s": "deg/s", "dps": "deg/s",
    "mps2": "m/s^2", "m_s2": "m/s^2", "ut": "uT", "rad": "rad", "deg": "deg", "m": "m",
    "ns": "ns", "us": "us", "ms": "ms", "s": "s",
}  # fmt: skip
# No vehicle goes round a bend faster, and no turn rate of one is larger in rad/s.
_LARGEST_ACCELERATION_MPS2 = 20.0
_LARGEST_RATE_RADPS = 10.0


class _Column(NamedTuple):
    """A column: its name, that without its unit in lower case, the unit, and its numbers (rows,)."""

    name: str
    plain: str
    unit: str
    values: NDArray


class _Table(NamedTuple):
    """The columns that no stream has yet, how topics begin, and whether the file's name says truth."""

    columns: list[_Column]
    prefix: str
    is_reference: bool


def guess(paths: Sequence[Path]) -> str:
    """A mapping of tables, in TOML; raises BadInput where a file is no table."""
    files = []
    for path in paths:
        if not path.exists():
            raise BadInput(f"{path}: no such file or folder; give the tables to guess from")
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
        raise BadInput(
            notes[0]
            if len(notes) == 1
            else f"{paths[0]}: has no table among its files; give a folder or files of tables"
        )
    head = [
        "# What fuselog guessed; mend what is wrong: docs/your-log.md says how.",
        f"summary = {json.dumps(f'guessed from {paths[0].name}')}",
        *(f"# not taken: {note}" for note in notes),
        *_warnings("\n".join(tables)),
    ]
    return "\n".join(head) + "\n\n" + "\n".join(tables)


def _warnings(text: str) -> Iterator[str]:
    """What a person must still say of streams that belong together: their vehicle and their origin."""
    namespaces = dict.fromkeys(re.findall(r'^topic = "(/.+)/', text, re.MULTILINE))
    if len(namespaces) > 1:
        yield f"# The topics lie in {len(namespaces)} namespaces, {', '.join(namespaces)}."
        yield "# An estimator takes those of one: give all topics of one vehicle the same, such as"
        yield "# /car/odometry, /car/fix and /car/truth."
    becomes = re.findall(r'^becomes = "(\w+)"', text, re.MULTILINE)
    if {"GeodeticFix", "TruthState"} <= {*becomes}:
        yield "# The truth is in a plane, fixes are latitudes and longitudes. Where the plane touches"
        yield "# (by default at the first fix, from which the truth may be shifted):"
        yield "# [origin]"
        yield "# latitude_deg = "
        yield "# longitude_deg = "
        yield "# altitude_m = "


def _table(path: Path, name: str, *, is_alone: bool) -> str:
    """One [[tables]] of a mapping, with its streams."""
    table = open_table(path)
    batch = next(table.batches((), table.columns), None)
    if batch is None:
        raise BadInput(f"{path}: has no rows")
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
            f"{path}: has no column of times, and no column of {_FEWEST} numbers or more; write a "
            "mapping by hand, as docs/your-log.md says"
        )
    lines = ["[[tables]]", f"files = {json.dumps(name)}", *told, f"time = {time}"]
    if all(column.isdecimal() for column in table.columns):
        blanks = ", ".join(f'"{column}"' for column in table.columns)
        lines.append(f"# The file does not name its columns; to name them: columns = [{blanks}]")
    if not_taken := [text for text in texts if text not in used]:
        lines.append(f"# Columns with texts, not taken: {', '.join(not_taken)}")
    prefix = (
        "" if is_alone else "/" + re.sub(r"\W+", "_", Path(name).with_suffix("").as_posix()).strip("_")
    )
    left = [column for column in columns if column.name not in used]
    rest = _Table(left, prefix, bool(re.search(_REFERENCE, path.stem)))
    for guessed in _GUESSES:
        lines += guessed(rest)
    return "\n".join([*lines, *_rest(rest)]) + "\n"


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
    """A name without its unit, in lower case with underlines; and the unit, from brackets or its end."""
    match = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]", name)
    if match:
        given = match[1].replace("degrees", "deg").replace("°", "deg").replace("meters", "m")
        return _underlined(name[: match.start()]), given if _is_unit(given) else ""
    plain = _underlined(name)
    ending = next((each for each in _ENDINGS if plain.endswith(f"_{each}")), "")
    return plain.removesuffix(f"_{ending}"), _ENDINGS.get(ending, "")


def _is_unit(text: str) -> bool:
    try:
        return bool(unit(text))
    except BadInput:
        return False


def _underlined(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


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
    rate = f"{1 / usual_s:.4g}"
    told = f"# {rate} {'row' if rate == '1' else 'rows'} a second"
    if len(gaps):
        what = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        told += f"; {what} over {5 * usual_s:.3g} s, the longest {gaps.max():.3g} s"
    for one, many, which in (
        ("repeats", "repeat", steps_s == 0),
        ("goes back", "go back", steps_s < 0),
    ):
        if which.any():
            told += f"; 1 stamp {one}" if which.sum() == 1 else f"; {which.sum()} stamps {many}"
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


def _axes(columns: list[_Column], *stems: str, axes: str = "xyz") -> list[_Column]:
    """The columns of the axes of a vector whose name is one of some."""
    for stem in stems:
        before = f"(.*_)?{stem}_?" if stem else ""
        if found := _take(columns, *(before + axis for axis in axes)):
            return found
    return []


def _stated(column: _Column, usual: str) -> str:
    """The unit that a column's name states, if it is one of the usual one's kind."""
    return column.unit if column.unit and unit(column.unit).powers == unit(usual).powers else ""


def _by_size(columns: Sequence[_Column], sizes: Mapping[str, tuple[float, float]]) -> tuple[str, str]:
    """The unit in which a vector's length is as it must be, else the first; and the reason."""
    usual = next(iter(sizes))
    if stated := _stated(columns[0], usual):
        return stated, "as its name says"
    length = _length(columns)
    for name, (low, high) in sizes.items():
        if low <= length <= high:
            return name, f"its median length is {length:.4g}"
    return usual, f"a guess: its median length is {length:.4g}"


def _length(columns: Sequence[_Column]) -> float:
    return float(np.nanmedian(np.linalg.norm([column.values for column in columns], axis=0)))


def _by_largest(column: _Column, usual: str, other: str, limit: float) -> tuple[str, str]:
    """The unit of a column: the other one if its numbers go beyond a limit; and the reason."""
    if stated := _stated(column, usual):
        return stated, "as its name says"
    largest = _largest([column])
    return (other if largest > limit else usual), f"the largest is {largest:.4g}"


def _largest(columns: Sequence[_Column]) -> float:
    return float(np.nanmax(np.abs([column.values for column in columns])))


def _stream(topic: str, becomes: str, why: str, *lines: str) -> list[str]:
    head = ["", f"# {becomes}: {why}.", "[[tables.streams]]"]
    return [*head, f'topic = "{topic}"', f'becomes = "{becomes}"', *lines]


def _names(columns: Sequence[_Column]) -> str:
    return json.dumps([column.name for column in columns], ensure_ascii=False)


def _name(column: _Column) -> str:
    return json.dumps(column.name, ensure_ascii=False)


def _inertial(table: _Table) -> Iterator[str]:
    columns = table.columns
    whole = list(columns)
    force = _axes(columns, *_ACCELEROMETERS)
    rate = _axes(columns, *_GYROSCOPES)
    if not (force and rate):
        columns[:] = whole
        return
    force_unit, why = _by_size(force, {"m/s^2": (8, 12), "g": (0.8, 1.2), "mg": (800, 1200)})
    largest = _largest(rate)
    rate_unit = _stated(rate[0], "rad/s") or ("deg/s" if largest > _LARGEST_RATE_RADPS else "rad/s")
    yield from _stream(
        f"{table.prefix}/inertial",
        "InertialSample",
        "the names are those of an accelerometer and of a gyroscope",
        f"fields.specific_force_mps2 = {_names(force)}",
        f"fields.turn_rate_radps = {_names(rate)}",
        f"units.specific_force_mps2 = {json.dumps(force_unit)}   # {why}",
        f"units.turn_rate_radps = {json.dumps(rate_unit)}   # the largest is {largest:.4g}",
        "# The axes of the body are forward, left, up; to turn those of the sensor (roll, pitch, yaw):",
        "# mounting_deg = [0, 0, 0]",
    )


def _magnetic(table: _Table) -> Iterator[str]:
    field = _axes(table.columns, "mag", "magnetometer", "magnetic_field", "m")
    if field:
        sizes = {"uT": (15, 90), "G": (0.15, 0.9), "mG": (150, 900), "nT": (15e3, 90e3)}
        given, why = _by_size(field, sizes)
        yield from _stream(
            f"{table.prefix}/magnetic_field",
            "MagneticField",
            "the names are those of a magnetometer",
            f"fields.magnetic_field_ut = {_names(field)}",
            f"units.magnetic_field_ut = {json.dumps(given)}   # {why}",
        )


def _fix(table: _Table) -> Iterator[str]:
    place = _take(table.columns, r"(.*_)?lat(itude)?", r"(.*_)?(lon|lng|long)(gitude)?")
    if not place:
        return
    fields = ("latitude_deg", "longitude_deg")
    lines = [f"fields.{field} = {_name(each)}" for field, each in zip(fields, place, strict=True)]
    latitude, longitude = (_largest([column]) for column in place)
    if place[0].unit == "rad" or (latitude < np.pi / 2 and longitude <= np.pi):
        lines += [f'units.{field} = "rad"   # latitudes up to {latitude:.4g}' for field in fields]
    elif 90 < latitude <= 90e7:
        lines += [
            f"factors.{field} = 1e-7   # latitudes up to {latitude:.4g} are not degrees"
            for field in fields
        ]
    height = _take(table.columns, r"(.*_)?(alt|altitude|height|ellipsoidal_height|ele|elevation|h)")
    if height:
        lines.append(f"fields.altitude_m = {_name(height[0])}")
    deviations = _take(table.columns, r"sd_?e", r"sd_?n", r"sd_?u")
    if deviations:
        lines.append(f"deviations.covariance_m2 = {_names(deviations)}")
    elif dilution := _take(table.columns, r"(.*_)?hdop"):
        lines += [
            "# Standard deviations, east, north, up: the dilution times the receiver's range error,",
            "# horizontally divided by the root of 2. A guess of that error is 2 m; fill in your own.",
            f"deviations.covariance_m2 = {_names(3 * dilution)}",
            "factors.covariance_m2 = [1.4, 1.4, 2.8]",
        ]
    else:
        lines += [
            "# No standard deviations are named; stated ones, east, north, up:",
            "# deviations.covariance_m2 = [1, 1, 2]",
        ]
    why = "the names are a latitude and a longitude"
    yield from _stream(f"{table.prefix}/fix", "GeodeticFix", why, *lines)


def _target(table: _Table) -> Iterator[str]:
    """Ranges and bearings; one alone only with a target's number, since its name says too little."""
    columns = table.columns
    whole = list(columns)
    number = _take(columns, _TARGET)
    distance = _take(columns, r"(.*_)?(range|distance|dist)|r")
    direction = _take(columns, r"(.*_)?(bearing|azimuth)|angle|phi")
    if not (distance and direction) and not (number and (distance or direction)):
        columns[:] = whole
        return
    becomes = "Range" * bool(distance) + "Bearing" * bool(direction)
    what = " and ".join(["a range"] * bool(distance) + ["a bearing"] * bool(direction))
    lines = [f"fields.target_id = {_name(each)}" for each in number]
    if not number:
        lines.append("# No column numbers the targets, so that all rows are of target 0.")
    for each in distance:
        lines.append(f"fields.range_m = {_name(each)}")
        if stated := _stated(each, "m"):
            lines.append(f"units.range_m = {json.dumps(stated)}   # as its name says")
    for each in direction:
        in_unit, why = _by_largest(each, "rad", "deg", 2 * np.pi)
        lines += [
            f"fields.bearing_rad = {_name(each)}",
            f"units.bearing_rad = {json.dumps(in_unit)}   # {why}",
            "# Bearings are anticlockwise from the sensor's x axis; if these are clockwise:",
            "# factors.bearing_rad = -1",
        ]
    topic = {"RangeBearing": "range_bearing"}.get(becomes, becomes.lower())
    why = f"the names are {what}" + " of numbered targets" * bool(number)
    yield from _stream(f"{table.prefix}/{topic}", becomes, why, *lines)


def _twist(table: _Table) -> Iterator[str]:
    columns = table.columns
    whole = list(columns)
    velocity = _axes(columns, "linear", "linear_velocity")
    rate = _axes(columns, "angular", "angular_velocity")
    if not (velocity and rate):
        columns[:] = whole
        return
    yield from _stream(
        f"{table.prefix}/twist",
        "Twist",
        "the names are a linear and an angular velocity along x, y and z",
        f"fields.velocity_mps = {_names(velocity)}",
        f"fields.turn_rate_radps = {_names(rate)}",
    )


def _odometry(table: _Table) -> Iterator[str]:
    both = _take(table.columns, _FORWARD_SPEED, _YAW_RATE)
    if not both:
        return
    speed, rate = both
    speed_unit = _stated(speed, "m/s")
    rate_unit, why = _by_largest(rate, "rad/s", "deg/s", _LARGEST_RATE_RADPS)
    if rate_unit == "rad/s" and not _stated(rate, "rad/s"):
        size = unit(speed_unit).size if speed_unit else 1.0
        sideways = float(np.nanquantile(np.abs(size * speed.values * rate.values), 0.99))
        if sideways > _LARGEST_ACCELERATION_MPS2:
            rate_unit = "deg/s"
            why = f"in rad/s its product with the speed would be {sideways:.3g} m/s^2"
    yield from _stream(
        f"{table.prefix}/odometry",
        "Odometry",
        "the names are a forward speed and a yaw rate",
        f"fields.forward_mps = {_name(speed)}",
        f"fields.turn_radps = {_name(rate)}",
        f"units.forward_mps = {json.dumps(speed_unit or 'm/s')}   # "
        + ("as its name says" if speed_unit else f"a guess: the largest is {_largest([speed]):.4g}"),
        f"units.turn_radps = {json.dumps(rate_unit)}   # {why}",
        "# Yaw rates are anticlockwise seen from above; if these are clockwise:",
        "# factors.turn_radps = -1",
    )


def _pose(table: _Table) -> Iterator[str]:
    """Positions with and without orientation, and orientations alone."""
    columns = table.columns
    place, factors = _position(columns)
    turn = _quaternion(columns)
    heading = _take(columns, _HEADING) if place and not turn else []
    if not (place or turn):
        return
    if place and (table.is_reference or heading):
        why = "the names are a position and a heading, without a covariance, as the truth has them"
        if table.is_reference:
            why = "the file's name says that it is the truth"
        yield from _stream(
            f"{table.prefix}/truth", "TruthState", why, *_truth(place, factors, turn, heading)
        )
        return
    lines = []
    if place:
        lines.append(f"fields.position_m = {_names(place)}")
        lines += [f"factors.position_m = {factors}"] * (-1 in factors)
    if turn:
        lines.append(f"fields.quaternion = {_names(turn)}")
    else:
        ones = ", ".join("1" for _ in place)
        lines.append(f"deviations.covariance_m2 = [{ones}]   # fill in the standard deviations")
    if place:
        lines += [
            "# If this is the truth:",
            '# topic = "/truth", becomes = "TruthState", and in place of the fields above',
            *(f"# {line}" for line in _truth(place, factors, turn, heading)),
        ]
    names = ["a position"] * bool(place) + ["a unit quaternion"] * bool(turn)
    becomes = "Orientation" if not place else "Pose" if turn else "PositionFix"
    topic = {"PositionFix": "position"}.get(becomes, becomes.lower())
    why = f"the names are {' and '.join(names)}"
    yield from _stream(f"{table.prefix}/{topic}", becomes, why, *lines)


def _position(columns: list[_Column]) -> tuple[list[_Column], list[int]]:
    """The columns of a position, and what they are multiplied by to be of east, north and up."""
    for up, sign in (("up", 1), ("down", -1)):
        if found := _take(columns, _EAST, _NORTH, f"(z_)?{up}|{up[0]}"):
            return found, [1, 1, sign]
    found = (
        _axes(columns, *_POSITIONS)
        or _axes(columns, *_POSITIONS, axes="xy")
        or _take(columns, _EAST, _NORTH)
    )
    return found, [1] * len(found)


def _quaternion(columns: list[_Column]) -> list[_Column]:
    """The columns w, x, y, z of a quaternion, or those of its parts 0 to 3, if its length is one."""
    whole = list(columns)
    found = next(
        filter(
            None, (_axes(columns, stem, axes=axes) for stem in _QUATERNIONS for axes in ("wxyz", "0123"))
        ),
        [],
    )
    if found and not 0.99 < _length(found) < 1.01:
        columns[:] = whole
        return []
    return found


def _truth(
    place: list[_Column], factors: list[int], turn: list[_Column], heading: list[_Column]
) -> list[str]:
    """The lines of a TruthState of these columns."""
    names = [f"{axis}_m" for axis, _ in zip("xyz", place, strict=False)]
    names += [f"orientation_{part}" for part, _ in zip("wxyz", turn, strict=False)]
    kinds = ["linear"] * len(place) + ["quaternion"] * len(turn)
    lines, signs = [], [*factors, *[1] * len(turn)]
    if heading:
        names, kinds = [*names, "heading_rad"], [*kinds, "angle"]
        in_unit, why = _by_largest(heading[0], "rad", "deg", 2 * np.pi)
        lines.append(
            f"units.state = {json.dumps([*['m'] * len(place), in_unit])}   # the heading: {why}"
        )
        if _is_compass(place, heading[0], unit(in_unit).size):
            quarter = round(np.pi / 2 / unit(in_unit).size, 9)
            lines.append("# By the path, the heading is clockwise from north; fuselog's is from east:")
            lines.append(f"offsets.state = {[*[0] * len(place), quarter]}")
            signs.append(-1)
        else:
            signs.append(1)
    if -1 in signs:
        lines.append(f"factors.state = {signs}")
    return [
        f"fields.state = {_names([*place, *turn, *heading])}",
        f'components = "{",".join(names)}"',
        f'kinds = "{",".join(kinds)}"',
        *lines,
    ]


def _is_compass(place: Sequence[_Column], heading: _Column, size_rad: float) -> bool:
    """Whether a body that goes where it heads does so rather with a heading clockwise from north."""
    steps = np.diff(place[0].values), np.diff(place[1].values)
    course_rad = np.arctan2(steps[1], steps[0])
    heading_rad = size_rad * heading.values[:-1]
    length = np.hypot(*steps)
    as_is, compass = (
        np.nansum(length * np.cos(course_rad - each)) for each in (heading_rad, np.pi / 2 - heading_rad)
    )
    return bool(compass > as_is and compass > 0.5 * np.nansum(length))


def _velocity(table: _Table) -> Iterator[str]:
    velocity = _axes(table.columns, "vel", "velocity", "v") or _take(table.columns, "ve", "vn", "vu")
    if velocity:
        yield from _stream(
            f"{table.prefix}/velocity",
            "VelocityFix",
            "the names are a velocity along three axes",
            f"fields.velocity_mps = {_names(velocity)}",
            "deviations.covariance_m2ps2 = [0.1, 0.1, 0.1]   # fill in the standard deviations",
        )


_GUESSES: tuple[Callable[[_Table], Iterator[str]], ...] = (
    _inertial, _magnetic, _fix, _target, _twist, _velocity, _odometry, _pose,
)  # fmt: skip


def _rest(table: _Table) -> list[str]:
    """The columns that fit no message."""
    if not table.columns:
        return []
    plain = [
        name if re.match("[a-z]", name) else f"column_{name}"
        for name in (_underlined(column.name) for column in table.columns)
    ]
    counts = Counter(plain)
    names = [name if counts[name] == 1 else f"{name}_{number}" for number, name in enumerate(plain, 1)]
    return _stream(
        f"{table.prefix}/values",
        "VectorMeasurement",
        "the names fit no other message",
        f"fields.value = {_names(table.columns)}",
        f'components = "{",".join(names)}"',
    )
