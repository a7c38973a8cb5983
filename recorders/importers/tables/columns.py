"""Takes the columns of a table by their names, axes, units and sizes."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.units import unit

# What stands for a unit in names of columns with times of the day, hhmmss.
TIME_OF_DAY = "hhmmss"
# How a line of a guessed mapping begins that says what was assumed.
ASSUMED = "# Assumed: "


class GuessedColumn(NamedTuple):
    """Holds a column of numbers.

    Attributes:
        name: as the file has it.
        plain: the name in lower case, without its unit and frame.
        unit: that its name or a row of units states; empty without one.
        values: its numbers (rows,).
        unknown: what the name or a row of units states in place of a unit, and is none that is known.
        frame: "ned" for axes of north, east, down, "enu" for east, north, up; empty if nothing says it.
    """

    name: str
    plain: str
    unit: str
    values: NDArray
    unknown: str = ""
    frame: str = ""


class GuessedTable(NamedTuple):
    """Holds what is known of a table while its streams are guessed.

    Attributes:
        path: the file.
        columns: those without a stream yet.
        texts: the cells (rows,) of the columns of texts, by name.
        prefix: how topics begin.
        has_truth: whether other columns are the truth.
        time_s: the rows' times (rows,), NaN where there is none; None without times.
        whole: all columns.
        places: east and north of the rows, by which courses are told, as soon as they are known.
        made: lines of the table itself.
        prepared: tables of the mapping's columns, such as `missing`, by name.
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


def take(columns: list[GuessedColumn], *patterns: str, usual: str = "") -> list[GuessedColumn]:
    """Take the columns whose names fit the patterns, one each, out of the list; none unless all do.

    A column whose unit is of another kind than the usual one, such as a speed in rpm, does not fit.
    """
    found = []
    for pattern in patterns:
        match = next(
            (
                each
                for each in columns
                if re.fullmatch(pattern, each.plain)
                and (not (usual and each.unit) or stated_unit(each, usual))
            ),
            None,
        )
        if match is None:
            return []
        found.append(match)
    columns[:] = [each for each in columns if each not in found]
    return found


def take_axes(
    columns: list[GuessedColumn], *stems: str, axes: str = "xyz", usual: str = ""
) -> list[GuessedColumn]:
    """Return the columns of the axes of a vector whose name is one of some."""
    for stem in stems:
        before = f"(.*_)?{stem}_?" if stem else ""
        if found := take(columns, *(before + axis for axis in axes), usual=usual):
            return found
    return []


def known_of(column: GuessedColumn) -> NDArray:
    """Return the numbers of a column that are known."""
    values = column.values
    return values[np.isfinite(values)]


def stated_unit(column: GuessedColumn, usual: str) -> str:
    """Return the unit that a column's name states, if it is one of the usual one's kind.

    A turn rate in deg is one in deg/s, and a latitude in minutes one in minutes of arc.
    """
    meant = {"rad/s": f"{column.unit}/s", "deg": "arcmin" if column.unit == "min" else ""}
    for stated in (column.unit, meant.get(usual, "")):
        if column.unit and _is_unit(stated) and unit(stated).powers == unit(usual).powers:
            return stated
    return ""


def unit_by_size(
    columns: Sequence[GuessedColumn], sizes: Mapping[str, tuple[float, float]]
) -> tuple[str, str]:
    """Return the unit in which a vector's length is as it must be, else the first; and the reason."""
    usual = next(iter(sizes))
    if stated := stated_unit(columns[0], usual):
        return stated, "as its name says"
    length = length_of(columns)
    for name, (low, high) in sizes.items():
        if low <= length <= high:
            return name, f"its median length is {length:.4g}"
    return usual, f"a guess: its median length is {length:.4g}"


def length_of(columns: Sequence[GuessedColumn]) -> float:
    """Return the median length of the vectors of some columns."""
    return float(np.nanmedian(np.linalg.norm([column.values for column in columns], axis=0)))


def unit_by_largest(
    columns: Sequence[GuessedColumn], usual: str, other: str, limit: float
) -> tuple[str, str]:
    """Return the unit of columns: the other one if their numbers go beyond a limit; and the reason."""
    if stated := stated_unit(columns[0], usual):
        return stated, "as its name says"
    largest = largest_of(columns)
    return (other if largest > limit else usual), f"the largest is {largest:.4g}"


def largest_of(columns: Sequence[GuessedColumn]) -> float:
    """Return the largest magnitude among some columns."""
    return float(np.nanmax(np.abs([column.values for column in columns])))


# Words of other languages in names, by what they are called here.
_WORDS = {
    "geschwindigkeit": "speed", "gierrate": "yaw_rate", "drehrate": "turn_rate", "breite": "latitude",
    "breitengrad": "latitude", "laenge": "longitude", "laengengrad": "longitude", "hoehe": "altitude",
    "kompass": "compass", "kompasskurs": "compass_course", "kurs": "course", "genauigkeit": "accuracy",
    "zeit": "time", "uhrzeit": "time", "zeitstempel": "time", "datum": "date",
}  # fmt: skip
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
# Units at the end of a name, as they are written there.
_ENDINGS = {
    "mps": "m/s", "m_s": "m/s", "kmh": "km/h", "kph": "km/h", "km_h": "km/h", "mph": "mi/h",
    "fps": "ft/s", "ft_s": "ft/s", "kn": "kn", "kts": "kn", "knots": "kn",
    "radps": "rad/s", "rad_s": "rad/s", "degps": "deg/s", "deg_s": "deg/s", "dps": "deg/s",
    "mps2": "m/s^2", "m_s2": "m/s^2", "ut": "uT", "rad": "rad", "deg": "deg", "m": "m",
    "ft": "ft", "feet": "ft", "ns": "ns", "us": "us", "ms": "ms", "s": "s",
    "mm": "mm", "cm": "cm", "mm_s": "mm/s", "cm_s": "cm/s", "cdeg": "0.01 deg",
    "semicircles": "semicircle",
    "1e7": "1e-7 deg", "e7": "1e-7 deg", "e6": "1e-6 deg", "e5": "1e-5 deg", "microdeg": "1e-6 deg",
    "micro_degrees": "1e-6 deg", "microdegrees": "1e-6 deg", "udeg": "1e-6 deg", "usec": "us",
    "msec": "ms",
    "nsec": "ns", "sec": "s", "secs": "s", "seconds": "s", "nanoseconds": "ns", "microseconds": "us",
    "milliseconds": "ms", "degrees": "deg", "meters": "m", "metres": "m", "km": "km",
}  # fmt: skip
# Units in brackets that others write otherwise than we do.
_WRITTEN = {
    "degrees": "deg", "degree": "deg", "grad": "deg", "°": "deg", "meters": "m", "feet": "ft",
    "fuss": "ft", "knots": "kn", "kts": "kn", "kt": "kn", "kmh": "km/h", "kph": "km/h", "mph": "mi/h",
    "metres": "m", "meter": "m", "metre": "m", "sec": "s", "seconds": "s", "second": "s", "usec": "us",
    "msec": "ms", "nsec": "ns", "dps": "deg/s",
    "mdps": "1e-3 deg/s", "radians": "rad", "semicircles": "semicircle",
    "gee": "g",
    "arcminutes": "arcmin", "minutes": "min",
    "microdegrees": "1e-6 deg", "microdeg": "1e-6 deg", "udeg": "1e-6 deg", "cdeg": "0.01 deg",
    "centidegrees": "0.01 deg", "µs": "us", "µt": "uT",
    "ft_msl": "ft", "m/s/s": "m/s^2", "m/s2": "m/s^2",
    "m/s²": "m/s^2", "degc": "", "utesla": "uT", "gauss": "G",
}  # fmt: skip


def parted(name: str) -> tuple[str, str]:
    """Split a name, in lower case with underlines, from its unit, in brackets or at its end.

    >>> parted("Höhe [ft]"), parted("speed_kmh"), parted("TimeUS")
    (('altitude', 'ft'), ('speed', 'km/h'), ('time', 'us'))
    """
    if match := bracketed(name):
        return underlined(_words(name[: match.start()])), unit_in(match[1])
    plain = underlined(_words(name))
    ending = next((each for each in _ENDINGS if plain.endswith(f"_{each}")), "")
    return plain.removesuffix(f"_{ending}"), _ENDINGS.get(ending, "")


def bracketed(name: str) -> re.Match[str] | None:
    """Find what stands in brackets in a name, unless it is an index or an axis, as in q[0]."""
    match = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]", name)
    return None if match and re.fullmatch(r"(?i)\d+|[wxyz]", match[1]) else match


def unit_in(text: str) -> str:
    """Return the unit that a text such as °/s, knots or m/(s^2) means; empty if it means none."""
    bare = (
        text.strip()
        .strip("()[]")
        .replace("\u03bc", "\u00b5")
        .replace("°", "deg")
        .replace("(", "")
        .replace(")", "")
    )
    if re.fullmatch(r"(?i)hh:?mm:?ss(\.s+)?", bare):
        return TIME_OF_DAY
    if bare.lower().startswith("deg") and (scaled := re.fullmatch(r"(?i)deg_?\*?1?e-?(\d)", bare)):
        return f"1e-{scaled[1]} deg"
    parts = re.split(r"([^\w.-])", bare)
    given = "".join(_WRITTEN.get(part.lower().translate(_UMLAUTS), part) for part in parts)
    given = _WRITTEN.get(given.lower(), given)
    return given if _is_unit(given) else ""


def _words(name: str) -> str:
    """Set apart the words of a name such as TimeUS or yawRate."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)


def _is_unit(text: str) -> bool:
    try:
        return bool(unit(text))
    except BadInput:
        return False


def underlined(name: str) -> str:
    """Return a name in lower case, its English words with underlines between them."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower().translate(_UMLAUTS)).strip("_")
    return "_".join(_WORDS.get(word, word) for word in plain.split("_"))


# By how much of the path one direction has to be more like the course than another.
_CLEAR = 0.4
# Of a direction that is the course, and of one that is not.
_CLOSE, _APART = 0.995, 0.98
# How far from the course directions are, at most, that are along it.
_ALIKE_RAD = 0.1


class Direction(NamedTuple):
    """States what a heading is in, whether it is clockwise from north, and why."""

    unit: str
    is_compass: bool
    why: str
    is_sure: bool = False


def direction_of(
    heading: GuessedColumn, places: Sequence[GuessedColumn], *, usual: bool | None = None
) -> Direction:
    """Find a heading's unit and convention, by the course of places, else by its numbers.

    A heading may be unwrapped, so that its largest value says little. `usual` is whether such a heading
    mostly is a compass's, which decides if the course does not tell clearly.
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
                return Direction(*best, "so it goes with the course", is_sure=is_sure)
    why = "as its name says" if stated else f"the largest is {largest_of([heading]):.4g}"
    return Direction(units[0], bool(re.search("compass|course|heading|hdg|cog", heading.plain)), why)


def frame_of(steps: Sequence[NDArray], places: Sequence[GuessedColumn]) -> str:
    """Tell whether steps along two axes are east and north or north and east, by how places move.

    Args:
        steps: along the first and the second axis (rows,), NaN if there is none.
        places: east and north of the rows; none if these are not known.

    Returns:
        "enu", "ned", or nothing if the steps do not tell clearly.
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
    """Return what angles up to a largest one may be in, the likeliest first."""
    if largest <= 720.0:
        return ["rad", "deg"] if largest <= 2 * np.pi else ["deg", "rad"]
    scales = ("0.1 deg", "0.01 deg", "1e-3 deg", "1e-5 deg")
    fitting = [each for each in scales if largest <= 370.0 * _per_deg(each)]
    return [*fitting, "deg", "rad"]  # unwrapped ones may be large


def _per_deg(name: str) -> float:
    return unit("deg").size / unit(name).size


def scatter_rad(heading: GuessedColumn, in_unit: str) -> float:
    """Estimate the sigma of a heading's white noise by second differences, at least .5 deg."""
    angle = unit(in_unit).size * heading.values[np.isfinite(heading.values)]
    bend = np.angle(np.exp(1j * np.diff(angle, n=2)))
    sigma = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0) if len(bend) else 0.0
    return max(sigma, float(np.radians(0.5)))


def _course(places: Sequence[GuessedColumn]) -> tuple[NDArray, NDArray, NDArray] | None:
    """Find rows from which places move, in which direction (rad) and how far; None where none do."""
    east, north = (each.values for each in places[:2])
    rows = np.flatnonzero(np.isfinite(east) & np.isfinite(north))
    if len(rows) < 3:
        return None
    steps = np.diff(east[rows]), np.diff(north[rows])
    return rows[:-1], np.arctan2(steps[1], steps[0]), np.hypot(*steps)


def stream_lines(topic: str, becomes: str, why: str, *lines: str) -> list[str]:
    """Write one stream of a mapping: its topic, what it becomes and why, and further lines."""
    head = ["", f"# {becomes}: {why}.", "[[tables.streams]]"]
    return [*head, f'topic = "{topic}"', f'becomes = "{becomes}"', *lines]


def names_of(columns: Sequence[GuessedColumn]) -> str:
    """Write the names of columns as a list of TOML."""
    return json.dumps([column.name for column in columns], ensure_ascii=False)


def name_of(column: GuessedColumn) -> str:
    """Write the name of a column as TOML."""
    return json.dumps(column.name, ensure_ascii=False)
