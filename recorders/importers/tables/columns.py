"""Selection of table columns by their names, axes, units and sizes."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.units import unit

# The unit in names of columns with times of day as hhmmss.
TIME_OF_DAY = "hhmmss"
# The beginning of lines in a guessed mapping that state an assumption.
ASSUMED = "# Assumed: "


class GuessedColumn(NamedTuple):
    """A column of numbers.

    Attributes:
        name: name in the file.
        plain: name in lower case, without unit and frame.
        unit: unit that the name or a row of units states; empty if there is none.
        values: numbers (rows,).
        unknown: text found where the unit is expected, if it is not a known unit.
        frame: "ned" for axes north, east, down, "enu" for east, north, up; empty if unknown.
    """

    name: str
    plain: str
    unit: str
    values: NDArray
    unknown: str = ""
    frame: str = ""


class GuessedTable(NamedTuple):
    """The facts about a table from which its streams are guessed.

    Attributes:
        path: the file.
        columns: columns that are not in a stream yet.
        texts: cells (rows,) of text columns, by name.
        prefix: beginning of topics.
        has_truth: whether other columns are the truth.
        time_s: times of the rows (rows,), NaN if missing; None without times.
        whole: all columns.
        places: east and north of the rows, once they are known; courses are computed from them.
        made: lines of the table's mapping outside its streams.
        prepared: entries of the mapping that prepare columns, such as `missing`, by name.
    """

    path: Path
    columns: list[GuessedColumn]
    texts: Mapping[str, Sequence[str]]
    prefix: str
    has_truth: bool
    time_s: NDArray | None
    whole: list[GuessedColumn]
    places: list[GuessedColumn]
    made: list[str]
    prepared: dict[str, dict[str, Any]]


def column_named(
    columns: Iterable[GuessedColumn], pattern: str, usual: str = ""
) -> GuessedColumn | None:
    """Return the first column whose name matches, or None.

    A column whose unit measures another quantity than the usual unit, such as a speed in rpm, is
    skipped.
    """
    for each in columns:
        is_usual = not (usual and each.unit) or stated_unit(each, usual)
        if re.fullmatch(pattern, each.plain) and is_usual:
            return each
    return None


def take(columns: list[GuessedColumn], *patterns: str, usual: str = "") -> list[GuessedColumn]:
    """Take a column for each pattern from the list; if one is missing, take none and return []."""
    found = [each for pattern in patterns if (each := column_named(columns, pattern, usual))]
    if len(found) < len(patterns):
        return []
    columns[:] = [each for each in columns if each not in found]
    return found


def take_axes(
    columns: list[GuessedColumn], *stems: str, axes: str = "xyz", usual: str = ""
) -> list[GuessedColumn]:
    """Take the columns of a vector's axes, trying several names of the vector."""
    for stem in stems:
        before = f"(.*_)?{stem}_?" if stem else ""
        if found := take(columns, *(before + axis for axis in axes), usual=usual):
            return found
    return []


def known_of(column: GuessedColumn) -> NDArray:
    """Return the finite numbers of a column."""
    values = column.values
    return values[np.isfinite(values)]


def stated_unit(column: GuessedColumn, usual: str) -> str:
    """Return the unit that a column's name states, if it measures the same quantity as the usual unit.

    For a turn rate, deg means deg/s, and for a latitude, minutes are minutes of arc.
    """
    meant = {"rad/s": f"{column.unit}/s", "deg": "arcmin" if column.unit == "min" else ""}
    for stated in (column.unit, meant.get(usual, "")):
        if column.unit and _is_unit(stated) and unit(stated).powers == unit(usual).powers:
            return stated
    return ""


def unit_by_size(
    columns: Sequence[GuessedColumn], sizes: Mapping[str, tuple[float, float]]
) -> tuple[str, str]:
    """Choose the unit in which a vector has its expected length, or the first; return the reason too."""
    usual = next(iter(sizes))
    if stated := stated_unit(columns[0], usual):
        return stated, "as its name says"
    length = length_of(columns)
    for name, (low, high) in sizes.items():
        if low <= length <= high:
            return name, f"its median length is {length:.4g}"
    return usual, f"a guess: its median length is {length:.4g}"


def length_of(columns: Sequence[GuessedColumn]) -> float:
    """Return the median length of the vectors in some columns."""
    return float(np.nanmedian(np.linalg.norm([column.values for column in columns], axis=0)))


def unit_by_largest(
    columns: Sequence[GuessedColumn], usual: str, other: str, limit: float
) -> tuple[str, str]:
    """Choose the other unit if numbers exceed a limit, else the usual one; also return the reason."""
    if stated := stated_unit(columns[0], usual):
        return stated, "as its name says"
    largest = largest_of(columns)
    return (other if largest > limit else usual), f"the largest is {largest:.4g}"


def largest_of(columns: Sequence[GuessedColumn]) -> float:
    """Return the largest magnitude among some columns."""
    return float(np.nanmax(np.abs([column.values for column in columns])))


# Words of other languages in names, with the English words.
_WORDS = {
    "geschwindigkeit": "speed", "gierrate": "yaw_rate", "drehrate": "turn_rate", "breite": "latitude",
    "breitengrad": "latitude", "laenge": "longitude", "laengengrad": "longitude", "hoehe": "altitude",
    "kompass": "compass", "kompasskurs": "compass_course", "kurs": "course", "genauigkeit": "accuracy",
    "zeit": "time", "uhrzeit": "time", "zeitstempel": "time", "datum": "date",
}  # fmt: skip
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
# Units at the end of names.
_SPELT = {
    "kmh": "km/h", "kph": "km/h", "mph": "mi/h", "kts": "kn", "knots": "kn", "dps": "deg/s",
    "feet": "ft", "meters": "m", "metres": "m", "degrees": "deg", "cdeg": "0.01 deg",
    "microdeg": "1e-6 deg", "microdegrees": "1e-6 deg", "udeg": "1e-6 deg",
    "semicircles": "semicircle", "sec": "s", "seconds": "s", "msec": "ms", "usec": "us", "nsec": "ns",
}  # fmt: skip
# Units at the end of names; the first that fits counts.
_ENDINGS = {
    "mps": "m/s", "m_s": "m/s", "km_h": "km/h", "fps": "ft/s", "ft_s": "ft/s", "kn": "kn",
    "radps": "rad/s", "rad_s": "rad/s", "degps": "deg/s", "deg_s": "deg/s",
    "mps2": "m/s^2", "m_s2": "m/s^2", "ut": "uT", "rad": "rad", "deg": "deg", "m": "m",
    "ft": "ft", "ns": "ns", "us": "us", "ms": "ms", "s": "s",
    "mm": "mm", "cm": "cm", "mm_s": "mm/s", "cm_s": "cm/s",
    "1e7": "1e-7 deg", "e7": "1e-7 deg", "e6": "1e-6 deg", "e5": "1e-5 deg",
    "micro_degrees": "1e-6 deg", "secs": "s", "nanoseconds": "ns", "microseconds": "us",
    "milliseconds": "ms", "km": "km", **_SPELT,
}  # fmt: skip
# Units in brackets that are written differently from ours.
_WRITTEN = {
    **_SPELT, "degree": "deg", "grad": "deg", "°": "deg", "fuss": "ft", "kt": "kn", "meter": "m",
    "metre": "m", "second": "s", "mdps": "1e-3 deg/s", "radians": "rad", "gee": "g",
    "arcminutes": "arcmin", "minutes": "min", "centidegrees": "0.01 deg", "µs": "us", "µt": "uT",
    "ft_msl": "ft", "m/s/s": "m/s^2", "m/s2": "m/s^2", "m/s²": "m/s^2", "degc": "", "utesla": "uT",
    "gauss": "G",
}  # fmt: skip
_MARKS = str.maketrans({"\u03bc": "\u00b5", "°": "deg", "(": "", ")": ""})


def parted(name: str) -> tuple[str, str]:
    """Split a name into its lower-case form (with underscores) and its unit, in brackets or at the end.

    >>> parted("Höhe [ft]"), parted("speed_kmh"), parted("TimeUS")
    (('altitude', 'ft'), ('speed', 'km/h'), ('time', 'us'))
    """
    if match := bracketed(name):
        return underlined(_words(name[: match.start()])), unit_in(match[1])
    plain = underlined(_words(name))
    ending = next((each for each in _ENDINGS if plain.endswith(f"_{each}")), "")
    return plain.removesuffix(f"_{ending}"), _ENDINGS.get(ending, "")


def bracketed(name: str) -> re.Match[str] | None:
    """Find text in brackets in a name, unless it is an index or an axis, as in q[0]."""
    match = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]", name)
    return None if match and re.fullmatch(r"(?i)\d+|[wxyz]", match[1]) else match


def unit_in(text: str) -> str:
    """Return the unit that a text such as °/s, knots or m/(s^2) means, or an empty string."""
    bare = text.strip().strip("()[]").translate(_MARKS)
    if re.fullmatch(r"(?i)hh:?mm:?ss(\.s+)?", bare):
        return TIME_OF_DAY
    if bare.lower().startswith("deg") and (scaled := re.fullmatch(r"(?i)deg_?\*?1?e-?(\d)", bare)):
        return f"1e-{scaled[1]} deg"
    parts = re.split(r"([^\w.-])", bare)
    given = "".join(_WRITTEN.get(part.lower().translate(_UMLAUTS), part) for part in parts)
    given = _WRITTEN.get(given.lower(), given)
    return given if _is_unit(given) else ""


def _words(name: str) -> str:
    """Separate the words of a name such as TimeUS or yawRate."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)


def _is_unit(text: str) -> bool:
    try:
        return bool(unit(text))
    except BadInput:
        return False


def underlined(name: str) -> str:
    """Return a name in lower case, in English, with underscores between words."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower().translate(_UMLAUTS)).strip("_")
    return "_".join(_WORDS.get(word, word) for word in plain.split("_"))


# How much better one direction must agree with the course than another, as a share of the path.
_CLEAR = 0.4
# Agreement of a direction that equals the course, and of one that does not.
_CLOSE, _APART = 0.995, 0.98
# The largest angle from the course of directions that follow it.
_ALIKE_RAD = 0.1


class Direction(NamedTuple):
    """The unit and convention of a heading, and the reason for the choice."""

    unit: str
    is_compass: bool
    why: str
    is_sure: bool = False


def direction_of(
    heading: GuessedColumn, places: Sequence[GuessedColumn], *, usual: bool | None = None
) -> Direction:
    """Determine a heading's unit and convention from the course of positions, or from its numbers.

    A heading may be unwrapped, so its largest value does not determine the unit. `usual` states whether
    such a heading is usually a compass heading; this is assumed if the course is not clear.
    """
    stated = stated_unit(heading, "rad")
    units = [stated] if stated else _angle_units(largest_of([heading]))
    course = _course(places) if places else None
    if course is not None:
        rows, angle_rad, length = course
        known = np.flatnonzero(np.isfinite(heading.values))
        if len(known):
            at = known[np.clip(np.searchsorted(known, rows, side="right") - 1, 0, None)]
            likeness = {}
            for name in units:
                own_rad = unit(name).size * heading.values[at]
                for is_compass, turned in ((False, own_rad), (True, np.pi / 2 - own_rad)):
                    likeness[name, is_compass] = np.sum(length * np.cos(angle_rad - turned))
            best = max(likeness, key=lambda each: likeness[each])
            whole = np.sum(length)
            alike = best[0], best[1] if usual is None else usual
            is_close = likeness[best] > _CLOSE * whole and likeness[alike] < _APART * whole
            if not is_close and likeness[best] - likeness[alike] < _CLEAR * whole < likeness[alike]:
                best = alike
            if likeness[best] > 0.5 * whole:
                other = likeness[best[0], not best[1]]
                is_sure = usual is None or bool(likeness[best] - other > _CLEAR * whole)
                return Direction(*best, "which agrees with the course", is_sure=is_sure)
    why = "as its name says" if stated else f"the largest is {largest_of([heading]):.4g}"
    return Direction(units[0], bool(re.search("compass|course|heading|hdg|cog", heading.plain)), why)


def frame_of(steps: Sequence[NDArray], places: Sequence[GuessedColumn]) -> str:
    """Determine from the motion of positions whether two axes are east and north or north and east.

    Args:
        steps: displacement along the first and the second axis (rows,), NaN if unknown.
        places: east and north of the rows; empty if unknown.

    Returns:
        "enu", "ned", or an empty string if the steps fit neither clearly.
    """
    if not places:
        return ""
    moved = [np.diff(each.values, prepend=np.nan) for each in places[:2]]
    course = moved[0] + 1j * moved[1]
    off_rad = {}
    for frame, (east, north) in {"enu": (0, 1), "ned": (1, 0)}.items():
        product = course * np.conj(steps[east] + 1j * steps[north])
        moving = product[np.abs(product) > 0]
        if not len(moving):
            return ""
        off_rad[frame] = float(np.median(np.abs(np.angle(moving))))
    best, other = sorted(off_rad, key=lambda frame: off_rad[frame])
    return best if off_rad[best] < _ALIKE_RAD < off_rad[other] - off_rad[best] else ""


def _angle_units(largest: float) -> list[str]:
    """Return the possible units of angles with this largest value, the likeliest first."""
    if largest <= 720.0:
        return ["rad", "deg"] if largest <= 2 * np.pi else ["deg", "rad"]
    scales = ("0.1 deg", "0.01 deg", "1e-3 deg", "1e-5 deg")
    fitting = [each for each in scales if largest <= 370.0 * _per_deg(each)]
    return [*fitting, "deg", "rad"]  # unwrapped angles may be large


def _per_deg(name: str) -> float:
    return unit("deg").size / unit(name).size


def scatter_rad(heading: GuessedColumn, in_unit: str) -> float:
    """Estimate a heading's white noise (sigma in rad, at least 0.5 deg) from second differences."""
    angle = unit(in_unit).size * heading.values[np.isfinite(heading.values)]
    bend = np.angle(np.exp(1j * np.diff(angle, n=2)))
    sigma = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0) if len(bend) else 0.0
    return max(sigma, float(np.radians(0.5)))


def _course(places: Sequence[GuessedColumn]) -> tuple[NDArray, NDArray, NDArray] | None:
    """Find the rows, directions (rad) and lengths of steps; return None for fewer than 3 positions."""
    east, north = (each.values for each in places[:2])
    rows = np.flatnonzero(np.isfinite(east) & np.isfinite(north))
    if len(rows) < 3:
        return None
    steps = np.diff(east[rows]), np.diff(north[rows])
    return rows[:-1], np.arctan2(steps[1], steps[0]), np.hypot(*steps)


def stream_lines(topic: str, becomes: str, why: str, *lines: str) -> list[str]:
    """Write one stream of a mapping: its topic, its message with the reason, and further lines."""
    head = ["", f"# {becomes}: {why}.", "[[tables.streams]]"]
    return [*head, f'topic = "{topic}"', f'becomes = "{becomes}"', *lines]


def names_of(columns: Sequence[GuessedColumn]) -> str:
    """Write the names of columns as a TOML list."""
    return json.dumps([column.name for column in columns], ensure_ascii=False)


def name_of(column: GuessedColumn) -> str:
    """Write the name of a column as a TOML string."""
    return json.dumps(column.name, ensure_ascii=False)
