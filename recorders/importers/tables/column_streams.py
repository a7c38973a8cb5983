"""Guesses of the streams in the columns of a table: inertial, fix, pose, odometry and others."""

import json
import re
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.columns import (
    ASSUMED,
    GuessedColumn,
    GuessedTable,
    direction_of,
    frame_of,
    length_of,
    name_of,
    names_of,
    scatter_rad,
    stated_unit,
    stream_lines,
    take,
    take_axes,
    unit_by_largest,
    unit_by_size,
)
from fuselog.recorders.importers.tables.guessed_places import (
    ALTITUDE,
    accuracy_of,
    altitude_of,
    fixes_of,
    is_ais,
    named_unit,
    places_of,
    speed_unit_of,
)
from fuselog.recorders.models.geodesy import local_metres
from fuselog.recorders.units import unit

# Names of vectors.
_ACCELEROMETERS = ("acc", "accel", "accelerometer", "acceleration", "specific_force", "a")
_GYROSCOPES = ("gyr", "gyro", "gyroscope", "angular_velocity", "rate", "omega", "w", "g")
_MAGNETOMETERS = ("mag", "magnetometer", "magnetic_field", "m")
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
_HEADING_ALONE = r"(.*_)?(compass(_course|_heading)?|heading|hdg|yaw)"
_ACCURACY = r"(?!.*(bearing|head|course|yaw|speed|vel|vert|time|angle))(.*_)?(accuracy|eph|h_?acc)"
_AT = "((x|y|z|p|pos|position)_|p)?"
_EAST, _NORTH = f"{_AT}(east(ing)?|e)", f"{_AT}(north(ing)?|n)"
# Excludes the position of an origin, a home or a goal.
_HERE = r"(?!(.*_)?(ref|home|origin|base|datum|target|goal|waypoint|wp|setpoint|sp)_)(.*_)?"
_GEODETIC = rf"{_HERE}lat(itude)?", rf"{_HERE}(lon|lng|long)(gitude)?"
_ENU = "along east, north and up; order of fields, factors"
_TARGET = (
    r"(.*_)?(target|landmark|subject|barcode|beacon|anchor|marker|feature)(_?(id|number|nr|no))?|id"
)


# Limits of vehicles: lateral acceleration in a bend, and turn rate in rad/s.
_LARGEST_ACCELERATION_MPS2 = 20.0
_LARGEST_RATE_RADPS = 10.0


def _inertial(table: GuessedTable) -> Iterator[str]:
    columns = table.columns
    whole = list(columns)
    force = take_axes(columns, *_ACCELEROMETERS, usual="m/s^2")
    rate = take_axes(columns, *_GYROSCOPES, usual="rad/s")
    if not (force and rate):
        columns[:] = whole
        return
    force_unit, why = unit_by_size(force, {"m/s^2": (8, 12), "g": (0.8, 1.2), "mg": (800, 1200)})
    rate_unit, rate_why = unit_by_largest(rate, "rad/s", "deg/s", _LARGEST_RATE_RADPS)
    # with a magnetometer in the same table, this is a nine-axis unit, as orientation filters need it
    field = take_axes(list(columns), *_MAGNETOMETERS, usual="uT")
    is_ned = force[0].frame == "ned"
    axes = "forward, right, down" if is_ned else "forward, left, up"
    yield from stream_lines(
        f"{table.prefix}/inertial",
        "InertialSample",
        "the names are those of an accelerometer and of a gyroscope",
        f"fields.specific_force_mps2 = {names_of(force)}",
        f"fields.turn_rate_radps = {names_of(rate)}",
        *_field_lines(field)[:1],
        f"units.specific_force_mps2 = {json.dumps(force_unit)}   # {why}",
        f"units.turn_rate_radps = {json.dumps(rate_unit)}   # {rate_why}",
        *_field_lines(field)[1:],
        f"{ASSUMED}{', '.join(each.name for each in force + rate)}: axes {axes}; mounting_deg",
        "mounting_deg = [180, 0, 0]" if is_ned else "# mounting_deg = [0, 0, 0]",
    )


def _magnetic(table: GuessedTable) -> Iterator[str]:
    field = take_axes(table.columns, *_MAGNETOMETERS, usual="uT")
    if field:
        yield from stream_lines(
            f"{table.prefix}/magnetic_field",
            "MagneticField",
            "the names are those of a magnetometer",
            *_field_lines(field),
        )


def _field_lines(field: Sequence[GuessedColumn]) -> list[str]:
    """Write the field and unit of a magnetometer's columns, or an empty list without such columns."""
    if not field:
        return []
    sizes = {"uT": (15, 90), "G": (0.15, 0.9), "mG": (150, 900), "nT": (15e3, 90e3)}
    given, why = unit_by_size(field, sizes)
    return [
        f"fields.magnetic_field_ut = {names_of(field)}",
        f"units.magnetic_field_ut = {json.dumps(given)}   # {why}",
    ]


def _fix(table: GuessedTable) -> Iterator[str]:
    place = take(table.columns, *_GEODETIC, usual="deg")
    if not place:
        return
    lines, has_fix = fixes_of(table)
    place = [each._replace(values=np.where(has_fix, each.values, np.nan)) for each in place]
    fields = ("latitude_deg", "longitude_deg")
    lines += [f"fields.{field} = {name_of(each)}" for field, each in zip(fields, place, strict=True)]
    found = places_of(table, place)
    lines += found.lines
    plane = local_metres(found.latitude_deg, found.longitude_deg).T
    table.places.extend(
        each._replace(values=values) for each, values in zip(place[::-1], plane, strict=True)
    )
    height = take(table.columns, ALTITUDE, usual="m")
    if height:
        lines.append(f"fields.altitude_m = {name_of(height[0])}")
        lines += altitude_of(table, height[0], found.unit)
    deviations = take(table.columns, r"sd_?e", r"sd_?n", r"sd_?u", usual="m")
    if deviations:
        lines.append(f"deviations.covariance_m2 = {names_of(deviations)}")
        lines += named_unit("covariance_m2", stated_unit(deviations[0], "m"))
    elif accuracy := take(table.columns, _ACCURACY, usual="m"):
        lines += [
            f"{ASSUMED}{accuracy[0].name}: standard deviation of each axis, twice upwards; factors",
            f"deviations.covariance_m2 = {names_of(3 * accuracy)}",
            "factors.covariance_m2 = [1, 1, 2]",
            *accuracy_of(table, accuracy[0], found.unit),
        ]
    elif dilution := take(table.columns, r"(.*_)?hdop"):
        lines += [
            "# Standard deviations, east, north, up: the dilution times the receiver's range error,",
            "# horizontally divided by the root of 2.",
            f"{ASSUMED}{dilution[0].name}: for a range error of 2 m; factors",
            f"deviations.covariance_m2 = {names_of(3 * dilution)}",
            "factors.covariance_m2 = [1.4, 1.4, 2.8]",
        ]
    else:
        lines += [
            "# No columns give standard deviations; to state them for east, north and up:",
            "# deviations.covariance_m2 = [1, 1, 2]",
        ]
    why = "the names are a latitude and a longitude"
    yield from stream_lines(f"{table.prefix}/fix", "GeodeticFix", why, *lines)


def _target(table: GuessedTable) -> Iterator[str]:
    """Write ranges and bearings; a range or a bearing by itself needs a column of target numbers."""
    columns = table.columns
    whole = list(columns)
    number = take(columns, _TARGET)
    distance = take(columns, r"(.*_)?(range|distance|dist)|r", usual="m")
    direction = take(columns, r"(.*_)?(bearing|azimuth)|angle|phi", usual="rad")
    is_travelled = bool(table.places) and not number  # distance along a path, and its direction
    if is_travelled or not ((distance and direction) or (number and (distance or direction))):
        columns[:] = whole
        return
    becomes = "Range" * bool(distance) + "Bearing" * bool(direction)
    what = " and ".join(["a range"] * bool(distance) + ["a bearing"] * bool(direction))
    lines = [f"fields.target_id = {name_of(each)}" for each in number]
    if not number:
        lines.append(f"{ASSUMED}all rows: target 0, as no column numbers targets; fields.target_id")
    for each in distance:
        lines.append(f"fields.range_m = {name_of(each)}")
        if stated := stated_unit(each, "m"):
            lines.append(f"units.range_m = {json.dumps(stated)}   # as its name says")
    for each in direction:
        in_unit, why = unit_by_largest([each], "rad", "deg", 2 * np.pi)
        lines += [
            f"fields.bearing_rad = {name_of(each)}",
            f"units.bearing_rad = {json.dumps(in_unit)}   # {why}",
            f"{ASSUMED}{each.name}: anticlockwise from the x axis; factors.bearing_rad = -1 if not",
        ]
    topic = {"RangeBearing": "range_bearing"}.get(becomes, becomes.lower())
    why = f"the names are {what}" + " of numbered targets" * bool(number)
    yield from stream_lines(f"{table.prefix}/{topic}", becomes, why, *lines)


def _twist(table: GuessedTable) -> Iterator[str]:
    columns = table.columns
    whole = list(columns)
    velocity = take_axes(columns, "linear", "linear_velocity", usual="m/s")
    rate = take_axes(columns, "angular", "angular_velocity", usual="rad/s")
    if not (velocity and rate):
        columns[:] = whole
        return
    speed_unit, speed_why = speed_unit_of(table, velocity)
    rate_unit, rate_why = unit_by_largest(rate, "rad/s", "deg/s", _LARGEST_RATE_RADPS)
    yield from stream_lines(
        f"{table.prefix}/twist",
        "Twist",
        "the names are a linear and an angular velocity along x, y and z",
        f"fields.velocity_mps = {names_of(velocity)}",
        f"fields.turn_rate_radps = {names_of(rate)}",
        f"units.velocity_mps = {json.dumps(speed_unit)}   # {speed_why}",
        f"units.turn_rate_radps = {json.dumps(rate_unit)}   # {rate_why}",
    )


def _odometry(table: GuessedTable) -> Iterator[str]:
    columns = list(table.columns)
    both = take(columns, _FORWARD_SPEED, usual="m/s") + take(columns, _YAW_RATE, usual="rad/s")
    if len(both) < 2:
        return
    table.columns[:] = columns
    speed, rate = both
    speed_unit, speed_why = speed_unit_of(table, [speed])
    rate_unit, why = unit_by_largest([rate], "rad/s", "deg/s", _LARGEST_RATE_RADPS)
    if rate_unit == "rad/s" and not stated_unit(rate, "rad/s"):
        size = unit(speed_unit).size
        sideways = float(np.nanquantile(np.abs(size * speed.values * rate.values), 0.99))
        if sideways > _LARGEST_ACCELERATION_MPS2:
            rate_unit = "deg/s"
            why = f"in rad/s its product with the speed would be {sideways:.3g} m/s^2"
    yield from stream_lines(
        f"{table.prefix}/odometry",
        "Odometry",
        "the names are a forward speed and a yaw rate",
        f"fields.forward_mps = {name_of(speed)}",
        f"fields.turn_radps = {name_of(rate)}",
        f"units.forward_mps = {json.dumps(speed_unit)}   # {speed_why}",
        f"units.turn_radps = {json.dumps(rate_unit)}   # {why}",
        f"{ASSUMED}{rate.name}: anticlockwise seen from above; factors.turn_radps = -1 if not",
    )


def _pose(table: GuessedTable) -> Iterator[str]:
    """Write positions with or without orientation, and orientations."""
    columns = table.columns
    place, factors, said = _position(columns, table.places)
    turn = [] if -1 in factors else _quaternion(columns)  # ours needs a position in east, north and up
    heading = take(columns, _HEADING, usual="rad") if place and not (turn or table.has_truth) else []
    if not (place or turn):
        return
    if place and heading:
        why = "the columns give a position and a heading without a covariance, like a recorded truth"
        yield from stream_lines(
            f"{table.prefix}/truth", "TruthState", why, *_truth(place, factors, turn, heading), *said
        )
        return
    lines = said
    if place:
        lines.append(f"fields.position_m = {names_of(place)}")
        lines += [f"factors.position_m = {factors}"] * (-1 in factors)
        lines += named_unit("position_m", _length(place))
    if turn:
        lines.append(f"fields.quaternion = {names_of(turn)}")
        lines += _turned(turn)
    else:
        ones = ", ".join("1" for _ in place)
        lines.append(f"deviations.covariance_m2 = [{ones}]   # fill in the standard deviations")
    if place:
        lines += [
            "# If this is the truth:",
            '# topic = "/truth", becomes = "TruthState", and instead of the fields above:',
            *(f"# {line}" for line in _truth(place, factors, turn, heading) if not line.startswith("#")),
        ]
    names = ["a position"] * bool(place) + ["a unit quaternion"] * bool(turn)
    becomes = "Orientation" if not place else "Pose" if turn else "PositionFix"
    topic = {"PositionFix": "position"}.get(becomes, becomes.lower())
    why = f"the names are {' and '.join(names)}"
    yield from stream_lines(f"{table.prefix}/{topic}", becomes, why, *lines)


def _position(
    columns: list[GuessedColumn], places: Sequence[GuessedColumn]
) -> tuple[list[GuessedColumn], list[int], list[str]]:
    """Find the columns of a position, the factors to east, north and up, and the assumptions made."""
    for up, sign in (("up", 1), ("down", -1)):
        if found := take(columns, _EAST, _NORTH, f"{_AT}({up}|{up[0]})", usual="m"):
            return found, [1, 1, sign], []
    if found := take(columns, _EAST, _NORTH, usual="m"):
        return found, [1, 1], []
    found = take_axes(columns, *_POSITIONS, usual="m") or take_axes(
        columns, *_POSITIONS, axes="xy", usual="m"
    )
    return _along_axes(found, [np.diff(each.values, prepend=np.nan) for each in found], places)


def _along_axes(
    found: list[GuessedColumn], steps: Sequence[NDArray], places: Sequence[GuessedColumn]
) -> tuple[list[GuessedColumn], list[int], list[str]]:
    """Order x, y and z as east, north and up, according to their frame, the motion or an assumption.

    Args:
        found: the columns.
        steps: displacement along x and y from the previous row, (rows,) each.
        places: east and north of the rows, if known.
    """
    frame = (found[0].frame or frame_of(steps, places)) if found else "enu"
    if frame == "ned":
        return [found[1], found[0], *found[2:]], [1, 1, -1][: len(found)], []
    names = ", ".join(each.name for each in found)
    return found, [1] * len(found), [] if frame else [f"{ASSUMED}{names}: {_ENU}"]


def _turned(turn: Sequence[GuessedColumn]) -> list[str]:
    """Write the assumption about the frames of a quaternion."""
    if not turn:
        return []
    names = ", ".join(each.name for each in turn)
    return [
        f"{ASSUMED}{names}: turns forward, left, up to the axes of positions, or east, north, up; "
        "mounting_deg"
    ]


def _quaternion(columns: list[GuessedColumn]) -> list[GuessedColumn]:
    """Find the columns w, x, y, z (or 0 to 3) of a quaternion of unit length."""
    whole = list(columns)
    found = next(
        filter(
            None,
            (take_axes(columns, stem, axes=axes) for stem in _QUATERNIONS for axes in ("wxyz", "0123")),
        ),
        [],
    )
    if found and not 0.99 < length_of(found) < 1.01:
        columns[:] = whole
        return []
    return found


def _length(place: list[GuessedColumn]) -> str:
    """Return the unit that a position's names state, or m."""
    return stated_unit(place[0], "m") or "m" if place else "m"


_TRUE = r"(^|_)(ground_?truth|truth|gt|mocap|vicon|optitrack)(_|$)"


def true_columns(columns: list[GuessedColumn], *, is_reference: bool) -> list[GuessedColumn]:
    """Remove the true columns from the list; return them under names without the word for truth.

    Args:
        columns: columns of a table.
        is_reference: whether the name of the file marks all columns as truth.
    """
    found = [each for each in columns if is_reference or re.search(_TRUE, each.plain)]
    columns[:] = [each for each in columns if each not in found]
    return [each._replace(plain=re.sub(_TRUE, r"\1", each.plain).strip("_")) for each in found]


def truth_lines(table: GuessedTable) -> Iterator[str]:
    """Write the stream of a table's true columns, but no stream that a filter could read."""
    columns = table.columns
    place, factors, said = _position(columns, table.places)
    if not place and (geodetic := take(columns, *_GEODETIC, usual="deg")):
        found = places_of(table, geodetic)
        if found.unit not in ("deg", "ddmm.mmmm"):
            raise BadInput(
                f"{table.path}: its true latitudes are in {found.unit}; convert them to degrees"
            )
        table.made.extend(found.lines)
        names = dict(zip(("latitude", "longitude"), geodetic, strict=True))
        height = take(columns, ALTITUDE, usual="m")
        if height and (of_height := altitude_of(table, height[0], found.unit)):
            if not all(line.startswith(ASSUMED) for line in of_height):
                raise BadInput(
                    f"{table.path}: its true altitudes, {height[0].name}, are not in m; convert them"
                )
            table.made.extend(of_height)
        names.update(zip(("altitude",), height, strict=False))
        parts = ", ".join(f"{key} = {name_of(each)}" for key, each in names.items())
        table.made.append(f"geodetic = {{ {parts} }}")
        axes = zip(("east_m", "north_m", "up_m"), names.values(), strict=False)
        place = [each._replace(name=name, unit="m") for name, each in axes]
        factors = [1] * len(place)
    turn = [] if -1 in factors else _quaternion(columns)
    heading = [] if turn else take(columns, _HEADING, usual="rad")
    if place or turn or heading:
        why = "the names say that it is the truth"
        lines = [*_truth(place, factors, turn, heading), *said]
        yield from stream_lines(f"{table.prefix}/truth", "TruthState", why, *lines)
    if columns:
        rest = ", ".join(each.name for each in columns)
        yield f"# True columns that are not imported, so that no filter reads them: {rest}"


def _truth(
    place: list[GuessedColumn],
    factors: list[int],
    turn: list[GuessedColumn],
    heading: list[GuessedColumn],
) -> list[str]:
    """Write the lines of a TruthState made from these columns."""
    names = [f"{axis}_m" for axis, _ in zip("xyz", place, strict=False)]
    names += [f"orientation_{part}" for part, _ in zip("wxyz", turn, strict=False)]
    kinds = ["linear"] * len(place) + ["quaternion"] * len(turn)
    lines, signs, length = [], [*factors, *[1] * len(turn)], _length(place)
    if heading:
        names, kinds = [*names, "heading_rad"], [*kinds, "angle"]
        in_unit, is_compass, why, _ = direction_of(heading[0], place)
        lines.append(
            f"units.state = {json.dumps([*[length] * len(place), in_unit])}   # the heading: {why}"
        )
        if is_compass:
            quarter = round(np.pi / 2 / unit(in_unit).size, 9)
            lines.append(
                "# According to the path, the heading is clockwise from north; fuselog's is from east:"
            )
            lines.append(f"offsets.state = {[*[0] * len(place), quarter]}")
            signs.append(-1)
        else:
            signs.append(1)
    elif length != "m":
        lines.append(f"units.state = {json.dumps([*[length] * len(place), *[''] * len(turn)])}")
    if -1 in signs:
        lines.append(f"factors.state = {signs}")
    return [
        f"fields.state = {names_of([*place, *turn, *heading])}",
        f'components = "{",".join(names)}"',
        f'kinds = "{",".join(kinds)}"',
        *lines,
        *_turned(turn),
    ]


def _heading(table: GuessedTable) -> Iterator[str]:
    """Write headings next to fixes; courses are not used, since they are undefined without motion."""
    if not table.places or not (found := take(table.columns, _HEADING_ALONE, usual="rad")):
        return
    is_compass = is_ais(table) or bool(re.search("compass|course|heading|hdg", found[0].plain))
    direction = direction_of(found[0], table.places, usual=is_compass)
    angle = "heading" if direction.is_compass else "yaw"
    what = "clockwise from north" if direction.is_compass else "anticlockwise from east"
    begin = "# " if direction.is_sure else ASSUMED
    table.made.append(f"{begin}{found[0].name}: {what}, in {direction.unit}, {direction.why}; attitude")
    table.made.append(f'attitude = {{ {angle} = {name_of(found[0])}, unit = "{direction.unit}" }}')
    quaternion = [f"quaternion_{part}" for part in "wxyz"]
    yield from stream_lines(
        f"{table.prefix}/heading",
        "Orientation",
        "the name is that of a heading or compass",
        f"fields.quaternion = {json.dumps(quaternion)}",
        f"states.sigma_heading_rad = {scatter_rad(found[0], direction.unit):.2g}   # by its scatter",
    )


def _velocity(table: GuessedTable) -> Iterator[str]:
    stem, columns = "(.*_)?v(el(ocity)?)?_?", table.columns
    found = take_axes(columns, "vel", "velocity", "v", usual="m/s")
    velocity, factors, said = _along_axes(found, [each.values for each in found], table.places)
    for up, sign in (("u(p)?", 1), ("d(own)?", -1)):
        if not velocity:
            velocity = take(columns, *(stem + each for each in ("e(ast)?", "n(orth)?", up)), usual="m/s")
            factors = [1, 1, sign]
    if velocity:
        in_unit, why = speed_unit_of(table, velocity)
        yield from stream_lines(
            f"{table.prefix}/velocity",
            "VelocityFix",
            "the names are a velocity along three axes",
            *(fixes_of(table)[0] if table.places else []),
            f"fields.velocity_mps = {names_of(velocity)}",
            *said,
            *[f"factors.velocity_mps = {factors}"] * (-1 in factors),
            f"units.velocity_mps = {json.dumps(in_unit)}   # {why}",
            "deviations.covariance_m2ps2 = [0.1, 0.1, 0.1]   # fill in the standard deviations",
        )


GUESSES: tuple[Callable[[GuessedTable], Iterator[str]], ...] = (
    _inertial, _magnetic, _fix, _target, _twist, _velocity, _odometry, _pose, _heading,
)  # fmt: skip
