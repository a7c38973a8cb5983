"""Guesses of the units of latitudes, longitudes, altitudes and speeds, and of codes for missing values.

The guesses use names, magnitudes, and the speed from row to row; if a unit is ambiguous, the table is
rejected.
"""

import json
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.columns import (
    ASSUMED,
    GuessedColumn,
    GuessedTable,
    column_named,
    known_of,
    parted,
    stated_unit,
)
from fuselog.recorders.models.geodesy import local_metres
from fuselog.recorders.units import MISTAKEN, unit

# Codes of AIS (ITU-R M.1371) for unavailable values, by the name of the column.
_AIS = {
    r"(.*_)?(heading|hdg|true_heading)": (511.0,),
    r"(.*_)?(sog|speed(_over_ground)?|velocity)": (102.3, 1023.0),
    r"(.*_)?(cog|course(_over_ground)?)": (360.0, 3600.0),
}
# By the name of the column, its codes for no fix and for a fix, in NavSatFix, u-blox, PX4 and MAVLink,
# GGA, and gpsd.
_FIX_CODES: tuple[tuple[str, tuple[float, ...], tuple[float, ...]], ...] = (
    (r"(.*_)?status_status", (-1,), (0, 1, 2)),
    (r"^(.*[._])?fixType$", (0, 5), (1, 2, 3, 4)),
    (r"(.*_)?(fix_?type|gps_status)", (0, 1), (2, 3, 4, 5, 6, 7, 8)),
    (r"(.*_)?(fix_?quality|gps_?qual(ity)?|quality_?indicator|fix)", (0,), (1, 2, 3, 4, 5, 6, 7, 8, 9)),
    (r"(.*_)?(tpv|gps|fix)_mode", (0, 1), (2, 3)),
    (
        r"(.*_)?((has|gps|gnss|position|location)_?fix(_?ok)?|fix_?(ok|valid)|(is_|gps_)?valid)",
        (0,),
        (1,),
    ),
)
# Names of text columns on fixes, and words for no fix.
_FIX_WORDS = r"(.*_)?(fix(_?(type|status|mode))?|status|valid(ity)?)"
_NO_FIX = {"v", "void", "invalid", "none", "no", "no fix", "no_fix", "nofix", "no gps", "false"}
_NOT_A_PLACE = (91.0, 181.0)
_NO_ALTITUDE, _LOWEST_M = (-999.0, -9999.0, -32768.0), -450.0
ALTITUDE = (
    r"(.*_)?(alt|altitude|(ellipsoidal_)?height|ele|elevation)(_?(m?sl|amsl|ellipsoid|wgs84))?|h|h_?msl"
)
# Possible units of latitudes.
_SCALES = ("deg", "1e-7 deg", "1e-6 deg", "semicircle", "1e-5 deg", "1e-3 deg")
_MINUTES = "ddmm.mmmm"
_SPEEDS = {name: unit(name).size for name in ("m/s", *MISTAKEN["m/s"], "cm/s", "mm/s")}
_SPEED = r"(.*_)?(sog|speed(_over_ground)?|ground_?speed|g_?spd|velocity|gs)"
_NEAR = 0.03  # tolerance for the ratio of the path to the speed
_HIGHEST_M = 12_000.0  # usual limit for anything with a receiver
# Names of columns with hemispheres, if they have a name.
_SIDE = r"(^|_)(lat|lon|lng|ns|ew|n_s|e_w|hemi|dir|ref|side|north|south|east|west|ind|sign)|^\d+$"
_SOUTH_WEST = {"N", "S", "E", "W", "NORTH", "SOUTH", "EAST", "WEST"}


class Places(NamedTuple):
    """The unit of latitudes and longitudes, the lines that state it, and degrees (rows,) of both."""

    unit: str
    lines: list[str]
    latitude_deg: NDArray
    longitude_deg: NDArray


def without_codes(table: GuessedTable) -> GuessedTable:
    """Replace codes of missing values in a table by NaN; `prepared` lists them for the mapping."""
    plain = {column.plain for column in table.whole}
    has_ais, codes = is_ais(table), dict[str, list[float]]()
    for column in table.whole:
        known: tuple[float, ...] = ()
        if has_ais:
            known = next((those for name, those in _AIS.items() if re.fullmatch(name, column.plain)), ())
        if re.fullmatch(r"(.*_)?lat(itude)?", column.plain):
            known = tuple(code for code in _NOT_A_PLACE if _is_code(column.values, code, 90.0))
        elif re.fullmatch(r"(.*_)?(lon|lng|long)(gitude)?", column.plain):
            known = (181.0,) if _is_code(column.values, 181.0, 180.0) else ()
        elif column.plain == "yaw" and "nsats" in plain:  # ArduPilot, where north is 360
            known = (0.0,)
        elif re.fullmatch(ALTITUDE, column.plain) and np.nanmedian(column.values) > _LOWEST_M:
            known = _NO_ALTITUDE
        if found := [code for code in known if np.any(column.values == code)]:
            codes[column.name] = found
    if not codes:
        return table
    table.prepared["missing"] = codes

    def cleaned(columns: Sequence[GuessedColumn]) -> list[GuessedColumn]:
        return [
            column._replace(
                values=np.where(
                    np.isin(column.values, codes.get(column.name, [])), np.nan, column.values
                )
            )
            for column in columns
            if not np.isin(column.values[np.isfinite(column.values)], codes.get(column.name, [])).all()
        ]

    for name, values in codes.items():
        count = sum(
            int(np.isin(column.values, values).sum()) for column in table.whole if column.name == name
        )
        listed = " and ".join(f"{value:g}" for value in values)
        table.made.append(f"{ASSUMED}{name}: {listed} means not available, in {_rows(count)}; missing")
    return table._replace(columns=cleaned(table.columns), whole=cleaned(table.whole))


def _rows(count: int) -> str:
    return "1 row" if count == 1 else f"{count} rows"


def _is_code(values: NDArray, code: float, largest: float) -> bool:
    """Test whether a code occurs and all other values are within the range of degrees."""
    others = values[np.isfinite(values) & ~np.isin(values, _NOT_A_PLACE)]
    return bool(np.any(values == code)) and (not len(others) or float(np.abs(others).max()) <= largest)


def fixes_of(table: GuessedTable) -> tuple[list[str], NDArray[np.bool_]]:
    """Write the lines that select rows with a fix; return the lines, and a mask (rows,) of the rows."""
    rows = len(table.whole[0].values)
    found: list[tuple[str, NDArray[np.bool_], Sequence[float | str]]] = []
    is_of_satellites = any(column.plain == "nsats" for column in table.whole)
    for column in table.whole:
        plain = column.plain
        if (plain == "status" and is_of_satellites) or (plain == "mode" and "class" in table.texts):
            plain = f"gps_{plain}"  # in logs of ArduPilot, and of gpsd
        for name, none, valid in _FIX_CODES:
            known = known_of(column)
            if re.fullmatch(name, column.name if name[0] == "^" else plain) and len(known):
                if np.isin(known, (*none, *valid)).all():
                    found.append((column.name, ~np.isin(column.values, none), valid))
                break
    for text, cells in table.texts.items():
        words = {cell.strip() for cell in cells} - {""}
        lost = {word for word in words if word.lower() in _NO_FIX}
        if re.fullmatch(_FIX_WORDS, parted(text)[0]) and (lost or words <= {"A"}):
            has_fix = np.array([cell.strip() not in lost for cell in cells])
            found.append((text, has_fix, sorted(words - lost)))
    has_fix = np.all([which for _, which, _ in found], axis=0) if found else np.ones(rows, bool)
    lines = []
    if found:
        where = ", ".join(f"{json.dumps(name)} = {_listed(valid)}" for name, _, valid in found)
        lines.append(f"where = {{ {where} }}")
    lines += [
        f"{ASSUMED}{name}: no fix in {_rows(int((~which).sum()))}, left out; where"
        for name, which, _ in found
        if not which.all()
    ]
    return lines, has_fix if has_fix.any() else np.ones(rows, bool)


def places_of(table: GuessedTable, place: Sequence[GuessedColumn]) -> Places:
    """Determine the unit of latitudes and longitudes; raise BadInput if it is ambiguous."""
    latitude, longitude = place
    signed = [
        _signed(table, column, letters) for column, letters in zip(place, ("NS", "EW"), strict=True)
    ]
    pair = (signed[0], signed[1])
    names = f"{latitude.name} and {longitude.name}"
    fitting = [name for name in (*_SCALES, _MINUTES, "rad") if _fits(name, *pair)]
    stated = stated_unit(latitude, "deg")
    own = stated_unit(longitude, "deg") or stated
    if stated and stated not in ("deg", "rad") and stated not in fitting:
        largest = [np.nanmax(np.abs(_degrees(*each))) for each in ((stated, pair[0]), (own, pair[1]))]
        fitting = [stated] if largest[0] <= 90.0 and largest[1] <= 180.0 else []
    if not fitting:
        largest = [np.nanmax(np.abs(values)) for values in pair]
        whole_turn = largest[0] <= 90.0 and largest[1] <= 360.0
        _refuse(
            table,
            place,
            "longitudes seem to be from 0 to 360 deg; subtract 360 from those above 180"
            if whole_turn
            else "no unit fits",
        )
    by_speed = _by_speed(table, pair, fitting)
    comment = ""
    if stated and stated in fitting and not (stated == "deg" and _MINUTES in fitting):
        chosen, why = stated, "as its name says"
    elif len(by_speed) == 1 < len(fitting):
        chosen, why = by_speed[0], "in which positions agree with the speed"
    elif by_speed == [] and len(fitting) > 1 and "deg" not in fitting:
        _refuse(table, place, f"as {' or '.join(fitting)} they do not agree with the speed")
    else:
        chosen, why = _by_name(table, place, [each for each in fitting if each in by_speed] or fitting)
        if not chosen:
            _refuse(table, place, f"they may be in {', '.join(fitting)}")
    if chosen not in ("deg", stated):
        comment = f"{ASSUMED}{names}: in {chosen}, {why}"
    units = (chosen, own if chosen == stated else chosen)
    degrees = [_degrees(name, values) for name, values in zip(units, pair, strict=True)]
    lines = [f"{comment}; {_how(chosen)}"] if comment else []
    if chosen == _MINUTES:
        both = table.prepared.setdefault("degrees_minutes", {"": []})
        both[""] += [latitude.name, longitude.name]
    else:
        lines += [
            f'units.{field} = "{name}"'
            + "   # minutes that are positive to the west, as in VBOX files" * name.startswith("-")
            for field, name in zip(("latitude_deg", "longitude_deg"), units, strict=True)
            if name != "deg"
        ]
    if own == "arcmin":
        lines.append(
            f'{ASSUMED}{longitude.name}: positive to the east; units.longitude_deg = "-1 arcmin" if not'
        )
    zero = (degrees[0] == 0) & (degrees[1] == 0)
    if zero.any() and np.abs(np.nanmedian(degrees[0])) > 0.5:
        missing = table.prepared.setdefault("missing", {})
        for column in place:
            missing[column.name] = [*missing.get(column.name, []), 0.0]
        lines.append(f"{ASSUMED}{names}: 0, 0 is no fix, in {_rows(int(zero.sum()))}; missing")
        degrees = [np.where(zero, np.nan, values) for values in degrees]
    return Places(chosen, lines, *degrees)


def _how(chosen: str) -> str:
    return "degrees_minutes" if chosen == _MINUTES else "units"


def _refuse(table: GuessedTable, place: Sequence[GuessedColumn], why: str) -> None:
    largest = [float(np.nanmax(np.abs(column.values))) for column in place]
    raise BadInput(
        f"{table.path}: the unit of {place[0].name} and {place[1].name}, up to {largest[0]:.9g} and "
        f"{largest[1]:.9g}, is ambiguous: {why}; write a mapping yourself with `units` of latitude_deg "
        'and longitude_deg, such as "deg", "1e-7 deg", "1e-6 deg" or "semicircle", `degrees_minutes` '
        "for ddmm.mmmm, or `missing` for codes of missing values"
    )


def _signed(table: GuessedTable, column: GuessedColumn, letters: str) -> NDArray:
    """Apply the signs of the matching column of hemispheres, if there is one, to a column."""
    if column.name in table.prepared.get("hemispheres", {}):
        return column.values
    sides = [
        name
        for name, cells in table.texts.items()
        if re.search(_SIDE, parted(name)[0])
        and (known := {cell.strip().upper() for cell in cells if cell.strip()})
        and known <= _SOUTH_WEST
        and {cell[0] for cell in known} <= set(letters)
    ]
    if not sides:
        return column.values
    stem = column.plain.split("_")[0]
    side = next((name for name in sides if name.lower().startswith(stem[:3])), sides[0])
    table.prepared.setdefault("hemispheres", {})[column.name] = side
    initials = np.array([cell.strip().upper()[:1] for cell in table.texts[side]])
    sign = np.where(initials == letters[1], -1.0, np.where(initials == letters[0], 1.0, np.nan))
    return np.where(sign < 0, -np.abs(column.values), sign * column.values)


def _fits(name: str, latitude: NDArray, longitude: NDArray) -> bool:
    """Test whether latitudes and longitudes may be in a unit."""
    sizes = [np.abs(values[np.isfinite(values)]) for values in (latitude, longitude)]
    if not (len(sizes[0]) and len(sizes[1])):
        return name == "deg"
    if name == _MINUTES:
        # longitudes may go up to 360 deg, and may be in the column named latitude
        is_beyond = max(sizes[0].max(), sizes[1].max()) > 360.0
        in_minutes = all(np.all(np.fmod(size, 100.0) < 60.0) for size in sizes)
        return bool(is_beyond and in_minutes and sizes[0].max() <= 9000.0 and sizes[1].max() <= 18000.0)
    factor = unit(name).size / unit("deg").size
    if name == "rad":
        return bool(sizes[0].max() <= np.pi / 2 and sizes[1].max() <= np.pi)
    if not (sizes[0].max() * factor <= 90.0 and sizes[1].max() * factor <= 180.0):
        return False
    if name == "deg":
        return True
    is_whole = all(np.all(size == np.rint(size)) for size in sizes)
    # within a degree of 0, 0 there is mostly sea
    return bool(
        is_whole
        and max(sizes[0].max(), sizes[1].max()) * factor > 0.5
        and max(map(np.max, sizes)) > 1000
    )


def _degrees(name: str, values: NDArray) -> NDArray:
    if name == _MINUTES:
        size = np.abs(values)
        return np.copysign(np.floor(size / 100.0) + np.fmod(size, 100.0) / 60.0, values)
    return np.asarray(values * (unit(name).size / unit("deg").size))


def _by_speed(table: GuessedTable, pair: tuple[NDArray, NDArray], fitting: Sequence[str]) -> list[str]:
    """Return the units in which positions agree with the column of speeds; all without such a column."""
    speed = column_named(table.whole, _SPEED)
    if speed is None or len(fitting) == 1:
        return list(fitting)
    stated = stated_unit(speed, "m/s")
    units = [unit(stated).size] if stated else _speed_sizes(table)
    found = []
    for name in fitting:
        ratio = path_ratio(table, _degrees(name, pair[0]), _degrees(name, pair[1]), speed.values)
        if ratio is None:
            return list(fitting)
        if any(abs(np.log(ratio / size)) < _NEAR for size in units):
            found.append(name)
    return found


def _speed_sizes(table: GuessedTable) -> list[float]:
    return [_SPEEDS["kn"]] if is_ais(table) else list(_SPEEDS.values())


def is_ais(table: GuessedTable) -> bool:
    """Test from the column names whether a table contains AIS reports."""
    names = {each.plain for each in table.whole}
    return {"sog", "cog"} <= names or column_named(table.whole, "(.*_)?mmsi") is not None


def path_ratio(
    table: GuessedTable, latitude_deg: NDArray, longitude_deg: NDArray, speed: NDArray
) -> float | None:
    """Compute the speed along the path (m/s) per unit of `speed`; None if there are too few data.

    Args:
        table: the table with the times of the rows.
        latitude_deg: (rows,), NaN if unknown.
        longitude_deg: (rows,), NaN if unknown.
        speed: (rows,), in the unknown unit.
    """
    east, north = local_metres(latitude_deg, longitude_deg).T
    return plane_ratio(table, east, north, speed)


def plane_ratio(table: GuessedTable, east: NDArray, north: NDArray, speed: NDArray) -> float | None:
    """Compute the same ratio as `path_ratio` for positions in the local tangent plane.

    Args:
        table: the table with the times of the rows.
        east: (rows,), in m.
        north: (rows,), in m.
        speed: (rows,), in the unknown unit.
    """
    if table.time_s is None:
        return None
    known = np.isfinite(east) & np.isfinite(north) & np.isfinite(table.time_s)
    if known.sum() < 5:
        return None
    # over several rows, which reduces the effect of rounding and noise
    stride = max(1, int(known.sum()) // 12)
    moved = np.hypot(*(each[stride:] - each[:-stride] for each in (east[known], north[known])))
    span = np.abs(table.time_s[known][stride:] - table.time_s[known][:-stride])
    speeds = np.abs(speed[known])
    sums = np.cumsum(np.append(0.0, np.where(np.isfinite(speeds), speeds, 0.0)))
    counts = np.cumsum(np.append(0, np.isfinite(speeds)))
    with np.errstate(invalid="ignore"):
        fast = (sums[stride:-1] - sums[: -stride - 1]) / (counts[stride:-1] - counts[: -stride - 1])
    usable = np.isfinite(fast) & (fast > 0) & (span > 0)
    if not usable.any():
        return None
    ratios = moved[usable] / span[usable] / fast[usable]
    middle = float(np.median(ratios))
    return middle if middle > 0 else None


def _by_name(
    table: GuessedTable, place: Sequence[GuessedColumn], fitting: Sequence[str]
) -> tuple[str, str]:
    """Choose a unit by names and sizes; return it with the reason, or empty strings."""
    if "deg" in fitting and "rad" not in fitting:
        return "deg", "by their size"
    if set(fitting) == {"deg", "rad"}:
        return (
            "rad",
            f'by their size, up to {np.nanmax(np.abs(place[0].values)):.4g}; if wrong, units = "deg"',
        )
    if list(fitting) == [_MINUTES]:
        return _MINUTES, "degrees and minutes, by their size"
    if _MINUTES in fitting and "hemispheres" in table.prepared:
        return _MINUTES, "degrees and minutes as in NMEA sentences, with hemispheres"
    plain = [column.plain for column in place]
    is_fit = all(re.fullmatch("(.*_)?position_(lat|long)", name) for name in plain)
    if "semicircle" in fitting and is_fit:
        return "semicircle", "as in FIT files"
    is_alike = {"1e-7 deg", "semicircle"} <= {*fitting} and len(fitting) <= 3
    if is_alike and plain[0] in ("lat", "latitude") and np.nanmax(np.abs(place[0].values)) > 9e7:
        return "1e-7 deg", "as in data of u-blox, PX4 and MAVLink"
    if len(fitting) == 1:
        return fitting[0], "by their size"
    return "", ""


def named_unit(field: str, length: str) -> list[str]:
    """Write the unit of a length if its column's name states a unit other than m."""
    return [f'units.{field} = "{length}"   # as its name says'] if length not in ("", "m") else []


def altitude_of(table: GuessedTable, height: GuessedColumn, position_unit: str) -> list[str]:
    """Write the unit of an altitude; raise BadInput if its numbers are too large for m."""
    if length := stated_unit(height, "m"):
        return named_unit("altitude_m", length)
    known = known_of(height)
    largest = float(np.abs(known).max())
    is_whole = bool(np.all(known == np.rint(known)))
    if is_whole and position_unit == "1e-7 deg" and largest > 1000:
        said = f"{ASSUMED}{height.name}: in mm, as receivers with positions of 1e-7 deg have it; units"
        return [said, 'units.altitude_m = "mm"']
    if largest <= _HIGHEST_M:
        return [f"{ASSUMED}{height.name}: in m, as no unit is stated; units"]
    if is_whole and largest > 60_000:
        said = f"{ASSUMED}{height.name}: in mm, as {largest:.6g} m is above any receiver; units"
        return [said, 'units.altitude_m = "mm"']
    raise BadInput(
        f"{table.path}: the unit of {height.name}, up to {largest:.6g}, is ambiguous; write a mapping "
        'yourself with units.altitude_m, such as "ft" or "mm"'
    )


def accuracy_of(table: GuessedTable, accuracy: GuessedColumn, position_unit: str) -> list[str]:
    """Write the unit of a standard deviation of positions; raise BadInput if it is ambiguous."""
    if length := stated_unit(accuracy, "m"):
        return named_unit("covariance_m2", length)
    known = known_of(accuracy)
    if position_unit != "1e-7 deg" or np.any(known != np.rint(known)) or known.max() < 20:
        return [f"{ASSUMED}{accuracy.name}: in m, as no unit is stated; units"]
    if not re.search("acc", accuracy.plain):
        raise BadInput(
            f"{table.path}: the unit of {accuracy.name}, up to {known.max():.6g}, is ambiguous: whole "
            "numbers may be m, mm, or a dilution times 100; write a mapping yourself with "
            "`deviations` and `factors` of covariance_m2"
        )
    said = f"{ASSUMED}{accuracy.name}: in mm, as receivers with positions of 1e-7 deg have it; units"
    return [said, 'units.covariance_m2 = "mm"']


def speed_unit_of(table: GuessedTable, velocity: Sequence[GuessedColumn]) -> tuple[str, str]:
    """Determine the unit of a speed, or of a velocity (east, north and up), and the reason.

    The unit follows from the name, or from how fast positions change; otherwise it is m/s.
    """
    speed = velocity[0]
    if stated := stated_unit(speed, "m/s"):
        return stated, "as its name says"
    length = np.linalg.norm([each.values for each in velocity[:2]], axis=0)
    if is_ais(table) and re.search("sog|speed", speed.plain):
        return "kn", "as AIS has it"
    if len(table.places) > 1:
        ratio = plane_ratio(table, table.places[0].values, table.places[1].values, length)
        if ratio is not None:
            nearest = min(_SPEEDS, key=lambda each: abs(np.log(_SPEEDS[each] / ratio)))
            if abs(np.log(_SPEEDS[nearest] / ratio)) < _NEAR:
                return nearest, "which agrees with the positions"
    return "m/s", f"a guess: the largest is {np.nanmax(length):.4g}"


def prepared_lines(table: GuessedTable) -> Iterator[str]:
    """Write the entries of the table that prepare its columns."""
    for name, entries in table.prepared.items():
        if name == "degrees_minutes":
            names = ", ".join(f'"{each}"' for each in entries[""])
            yield f"degrees_minutes = [{names}]"
            continue
        parts = []
        for column, value in entries.items():
            shown = f'"{value}"' if isinstance(value, str) else _listed(value)
            parts.append(f'"{column}" = {shown}')
        yield f"{name} = {{ {', '.join(parts)} }}"


def _listed(values: Sequence[float | str]) -> str:
    shown = [f'"{value}"' if isinstance(value, str) else f"{value:g}" for value in values]
    return f"[{', '.join(shown)}]"
