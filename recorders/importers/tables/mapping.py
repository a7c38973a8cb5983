"""Mappings of tables: a TOML file states the files, their columns, and the messages made from them.

[[tables]]
files = "imu_{unit}.csv"                          # {unit} matches any text, which replaces {unit} below
time = { column = "stamp", unit = "ms", zero = "2026-01-31" }

[[tables.streams]]
topic = "/{unit}/inertial"
becomes = "InertialSample"
fields = { specific_force_mps2 = ["ax", "ay", "az"], turn_rate_radps = ["gx", "gy", "gz"] }
units = { specific_force_mps2 = "g", turn_rate_radps = "deg/s" }
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Annotated, NamedTuple, Self

from pydantic import (
    AfterValidator,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from fuselog.recorders.atomic import is_being_written
from fuselog.recorders.errors import BadInput, choices, some_of
from fuselog.recorders.importers.mapping import (
    Latitude,
    Longitude,
    OneOrMore,
    Source,
    StreamMapping,
    schema_of,
)
from fuselog.recorders.importers.tables.files import Format
from fuselog.recorders.importers.tables.times import TimeMapping
from fuselog.recorders.parameters import Parameters, build
from fuselog.recorders.parsing import read_toml

# In s; a larger delay is a mistake.
Delay = Annotated[float, Field(ge=-1e9, le=1e9)]
_SHIPPED = resources.files("fuselog_data") / "mappings"

# * and ? as in a shell, and {name} for text that gets a name.
_WILD = re.compile(r"(\{\w+\}|\*|\?)")


class Origin(Parameters):
    """The origin of the local tangent plane (east, north, up).

    Attributes:
        latitude_deg: latitude of the origin.
        longitude_deg: longitude of the origin.
        altitude_m: height of the origin above the WGS 84 ellipsoid.
    """

    latitude_deg: Latitude
    longitude_deg: Longitude
    altitude_m: float = 0.0


class Geodetic(Parameters):
    """Columns with geodetic positions, from which the columns east_m, north_m and up_m are made.

    Attributes:
        latitude: column of the latitude.
        longitude: column of the longitude.
        altitude: column of the altitude, in m.
        unit: unit of latitude and longitude.
    """

    latitude: str
    longitude: str
    altitude: str | None = None
    unit: str = "deg"


class Attitude(Parameters):
    """A body's angles (axes forward, left, up), from which quaternion_w to quaternion_z are made.

    The quaternion rotates to a frame of east, north, up.

    Attributes:
        heading: column of the angle clockwise from north; `pitch` is then positive with the nose up, as
            for aircraft.
        yaw: column of the angle anticlockwise from east, instead of a heading; `pitch` is then positive
            with the nose down.
        pitch: column of the pitch.
        roll: column of the roll, positive with the right side down.
        unit: unit of the angles.
    """

    heading: str | None = None
    yaw: str | None = None
    pitch: str | None = None
    roll: str | None = None
    unit: str = "deg"


class TableStream(StreamMapping):
    """A stream made from a table's rows.

    Attributes:
        topic: name of the topic.
        delay_s: time from a message's measurement to its stamp.
        only_first: whether only the first row is used, as for a prior.
        every: number of rows in a group, of which only the first is used.
        noise: standard deviation of white Gaussian noise to add, by field; this simulates fixes along a
            known path.
    """

    topic: str = Field(pattern=r"^/\S+$")
    delay_s: Delay = 0.0
    only_first: bool = False
    every: PositiveInt = 1
    noise: dict[str, PositiveFloat] = {}

    @model_validator(mode="after")
    def _has_fields_of_noise(self) -> Self:
        if unknown := self.noise.keys() - self.fields.keys():
            raise ValueError(f"`noise` names {', '.join(sorted(unknown))}, which are not in `fields`")
        return self


def _once(pattern: str) -> str:
    twice = [name for name, count in Counter(names_in(pattern)).items() if count > 1]
    if twice:
        raise ValueError(f"{{{twice[0]}}} occurs twice; give each a different name")
    return pattern


class TableMapping(Parameters):
    """Files of one kind, and the streams made from their rows.

    Attributes:
        files: a pattern for file names relative to the given folder, or for the name of a given file. *
            and {name} match any text, ? matches one letter. Each name in braces occurs once.
        optional: whether such a file may be missing.
        format: format of the files; by default it follows from the suffix, and is CSV for unknown ones.
        columns: names of the columns, if the files do not name them.
        header: whether the first line names the columns; by default this is recognised.
        delimiter: delimiter of cells, " " for any white space; by default it is recognised.
        decimal: the decimal mark.
        skip: number of lines at the start of the file that are not part of the table.
        split: columns whose cells contain several numbers, such as "47.5 8.7", with the names of these
            numbers.
        missing: numbers that mark a missing value, by column, in every stream that uses the column.
        degrees_minutes: columns of latitudes and longitudes in degrees and minutes, ddmm.mmmm, as in
            NMEA.
        hemispheres: for columns of latitudes and longitudes, the columns that state N or S, E or W.
        vehicle: the column that identifies the vehicle of a row; its value replaces {vehicle} in topics.
        joined: whether the files together are one table, with its rows in the order of the files' names.
        time: when a row was measured.
        arrival: when a row reached the recorder, if the table states it.
        sensor: the reading of the sensor's own clock, if the table states it and it differs from `time`.
        geodetic: columns of latitude and longitude, from which positions in the local tangent plane are
            made.
        attitude: columns of angles, from which quaternions are made.
        streams: streams made from the rows.
    """

    files: Annotated[str, AfterValidator(_once)] = "*"
    optional: bool = False
    format: Format | None = None
    columns: list[str] = []
    header: bool | None = None
    delimiter: str | None = None
    decimal: str = "."
    skip: NonNegativeInt = 0
    split: dict[str, Annotated[list[str], Field(min_length=2)]] = {}
    missing: dict[str, list[float]] = {}
    degrees_minutes: list[str] = []
    hemispheres: dict[str, str] = {}
    vehicle: str | None = None
    joined: bool = False
    time: TimeMapping
    arrival: TimeMapping | None = None
    sensor: TimeMapping | None = None
    geodetic: Geodetic | None = None
    attitude: Attitude | None = None
    streams: list[TableStream] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_vehicles_in_topics(self) -> Self:
        named = ["{vehicle}" in stream.topic for stream in self.streams]
        if self.vehicle is not None and not all(named):
            raise ValueError("`vehicle` needs {vehicle} in each topic, as in /{vehicle}/fix")
        if self.time.file is not None and not self.joined:
            raise ValueError("`file` of `time` is for files that are joined; give joined = true")
        return self


class ConstantStream(Parameters):
    """Messages that are stated in the mapping, such as anchors; all have the log's first stamp.

    Attributes:
        topic: name of the topic.
        becomes: name of the message.
        rows: fields of each message.
        components: names of a vector's components, separated by commas, for messages whose channels
            state them.
        kinds: kinds of these components, separated by commas; linear by default.
    """

    topic: str = Field(pattern=r"^/\S+$")
    becomes: str
    rows: list[dict[str, OneOrMore[Source]]] = Field(min_length=1)
    components: str = ""
    kinds: str = ""

    @property
    def mapping(self) -> StreamMapping:
        """Return the equivalent mapping of a stream: one row, with a message for each entry."""
        rows = [dict(row) for row in self.rows]
        return StreamMapping(
            becomes=self.becomes, each=rows, components=self.components, kinds=self.kinds
        )


class LogMapping(Parameters):
    """A mapping from the tables of a recording to a log.

    Attributes:
        summary: purpose of the mapping.
        origin: origin of the local tangent plane; by default the first fix.
        projection: a projection known to pyproj, used with the origin in place of the tangent plane.
        tables: the tables of a recording.
        constants: messages that are stated in the mapping itself.
        clock_tolerance_s: longest time between the beginnings of two tables; if it is exceeded, their
            clocks differ, and the import stops.
    """

    summary: str = ""
    origin: Origin | None = None
    projection: str | None = None
    tables: list[TableMapping] = Field(min_length=1)
    constants: list[ConstantStream] = []
    clock_tolerance_s: PositiveFloat = 3600.0


def shipped() -> list[str]:
    """Return the names of the mappings that are part of fuselog."""
    return sorted(
        each.name.removesuffix(".toml") for each in _SHIPPED.iterdir() if each.name.endswith(".toml")
    )


def read_mapping(name: str) -> LogMapping:
    """Read a mapping by name or file; raise BadInput if it does not exist or is not a mapping."""
    path = Path(name)
    if not name.endswith(".toml"):
        known = shipped()
        if name not in known:
            raise BadInput(
                f"no mapping '{name}'; {choices(name, known)}; a mapping of your own is a file whose "
                "name ends in .toml"
            )
        with resources.as_file(_SHIPPED / f"{name}.toml") as file:
            return build(LogMapping, read_toml(file), f"mapping {name}")
    found = build(LogMapping, read_toml(path), name)
    for table in found.tables:
        for stream in table.streams:
            schema_of(stream, f"{name}: {stream.topic}")
    for constant in found.constants:
        schema_of(constant.mapping, f"{name}: {constant.topic}")
    return found


def adapted(
    mapping: LogMapping,
    mounting_deg: tuple[float, float, float] | None = None,
    delays_s: Mapping[str, float] | None = None,
) -> LogMapping:
    """Replace the mounting of all streams that have one, and the delays of some topics.

    Raises BadInput if no stream has a mounting, or a topic is unknown.
    """
    delays_s = delays_s or {}
    streams = [stream for table in mapping.tables for stream in table.streams]
    topics = [stream.topic for stream in streams]
    for topic in delays_s:
        if topic not in topics:
            raise BadInput(f"delays_s: the mapping has no topic '{topic}'; {choices(topic, topics)}")
    if mounting_deg is not None and all(stream.mounting_deg is None for stream in streams):
        raise BadInput(
            "mounting_deg: no stream of the mapping has a mounting to replace; add mounting_deg to the "
            "mapping first"
        )

    def changed(stream: TableStream) -> TableStream:
        update: dict[str, object] = {"delay_s": delays_s.get(stream.topic, stream.delay_s)}
        if mounting_deg is not None and stream.mounting_deg is not None:
            update["mounting_deg"] = mounting_deg
        return stream.model_copy(update=update)

    tables = [
        table.model_copy(update={"streams": [changed(stream) for stream in table.streams]})
        for table in mapping.tables
    ]
    return mapping.model_copy(update={"tables": tables})


def recordings_in(mapping: LogMapping, place: Path) -> list[Path]:
    """Find the folders under a path with all files of a mapping; raise BadInput if there are none."""
    below = [each for each in place.rglob("*") if each.is_dir()] if place.is_dir() else []
    folders = []
    for folder in sorted([place, *below], key=lambda each: (len(each.name), each)):
        with suppress(BadInput):
            find_files(mapping, [folder])
            folders.append(folder)
    if not folders:
        patterns = some_of([table.files for table in mapping.tables if not table.optional])
        raise BadInput(
            f"{place}: neither this folder nor one in it has all files of the mapping ({patterns})"
        )
    return folders


class FileMatch(NamedTuple):
    """A file, its mapping, the texts that match the names in braces, and files that belong to it.

    `more` lists the files with further rows, and `stamps` is the file with the times of all rows.
    """

    path: Path
    table: TableMapping
    names: dict[str, str]
    more: tuple[Path, ...] = ()
    stamps: Path | None = None


def find_files(mapping: LogMapping, paths: list[Path]) -> tuple[list[FileMatch], list[Path]]:
    """Find the files of a mapping among files and folders; return them and the folders' other files.

    A file belongs to the first table whose pattern matches. Files that an import is writing are ignored.
    Raises BadInput if a table has no file, or a given file has no table.
    """
    found: list[FileMatch] = []
    others: list[Path] = []
    for path in paths:
        inside = [path]
        if path.is_dir():
            files = (each for each in path.rglob("*") if each.is_file() and not is_being_written(each))
            inside = sorted(files)
        for file in inside:
            name = file.relative_to(path).as_posix() if path.is_dir() else file.name
            own = next(_matches(mapping, file, name, is_alone=len(paths) == 1 == len(inside)), None)
            if own is not None:
                found.append(own)
            elif path.is_dir():
                others.append(file)
            else:
                patterns = some_of([table.files for table in mapping.tables])
                raise BadInput(f"{file}: is not one of the files that the mapping names ({patterns})")
    found, others = _joined(mapping, found, others)
    for table in mapping.tables:
        if not table.optional and not any(each.table is table for each in found):
            where = some_of(paths)
            raise BadInput(
                f"{where}: has no file {table.files}, which the mapping needs; add it, or set "
                "optional = true for its table"
            )
    return found, others


def _joined(
    mapping: LogMapping, found: list[FileMatch], others: list[Path]
) -> tuple[list[FileMatch], list[Path]]:
    """Join the files that form one table, and leave out the file that has their times."""
    for table in mapping.tables:
        if not table.joined:
            continue
        own = [each for each in found if each.table is table]
        rest = [each for each in found if each.table is not table]
        stamps = None
        if table.time.file is not None and own:
            paths = [*others, *(each.path for each in found)]
            stamps = next((path for path in paths if _ends_with(path, table.time.file)), None)
            if stamps is None:
                raise BadInput(
                    f"{own[0].path}: there is no file {table.time.file} with its times; give the folder "
                    "that has both, or change `file` in `time`"
                )
            own = [each for each in own if each.path != stamps]
            others = [path for path in others if path != stamps]
        if own:
            ordered = sorted(own, key=lambda each: each.path)
            more = tuple(each.path for each in ordered[1:])
            found = [*rest, ordered[0]._replace(more=more, stamps=stamps)]
    return found, others


def _ends_with(path: Path, name: str) -> bool:
    parts = Path(name).parts
    return path.parts[-len(parts) :] == parts


def _matches(mapping: LogMapping, file: Path, name: str, *, is_alone: bool) -> Iterator[FileMatch]:
    """Yield the tables that a file matches; if there is one file and one table, any name matches."""
    for table in mapping.tables:
        pattern = (
            table.files if "/" not in table.files or "/" in name else table.files.rpartition("/")[2]
        )
        names = fitted(pattern, name)
        if names is not None:
            yield FileMatch(file, table, names)
        elif is_alone and len(mapping.tables) == 1:
            yield FileMatch(file, table, dict.fromkeys(names_in(pattern), file.stem))


def names_in(pattern: str) -> list[str]:
    """Return the names in braces."""
    return [part[1:-1] for part in _WILD.split(pattern)[1::2] if part not in "*?"]


def fitted(pattern: str, name: str) -> dict[str, str] | None:
    """Match a name against a pattern; return the texts for the names in braces, or None.

    From left to right, each name in braces and each star matches as many characters as possible; a name
    in braces matches at least one. Neither matches a slash. The time for a match is limited by the
    lengths of pattern and name; a regular expression of `re` would try all ways to divide a name among
    many stars.
    """
    parts = _WILD.split(pattern)
    # bit k of a number: the rest of the pattern after a part matches the name from character k on
    following = [1 << len(name)]
    for index in range(len(parts) - 1, -1, -1):
        following.append(_before(parts[index], is_wild=index % 2 == 1, name=name, after=following[-1]))
    following.reverse()
    if not following[0] & 1:
        return None
    place, names = 0, {}
    for index, part in enumerate(parts):
        if index % 2 == 0 or part == "?":
            place += 1 if index % 2 else len(part)
            continue
        end = name.find("/", place)
        ends = following[index + 1] & ((2 << (len(name) if end < 0 else end)) - 1)
        begin, place = place, ends.bit_length() - 1
        if part != "*":
            names[part[1:-1]] = name[begin:place]
    return names


def _before(part: str, *, is_wild: bool, name: str, after: int) -> int:
    """Find where a part of a pattern may begin if it ends at one of the positions in `after`."""
    if not is_wild:
        return sum(1 << place for place in _places(part, name) if after >> (place + len(part)) & 1)
    # bit k: character k is not a slash
    within = sum(1 << place for place, each in enumerate(name) if each != "/")
    found = after if part == "*" else after >> 1 & within
    width = 1
    while part != "?" and width <= len(name):  # extend every end to the left up to a slash
        found |= found >> width & within
        within &= within >> width
        width *= 2
    return found


def _places(part: str, name: str) -> list[int]:
    return [place for place in range(len(name) - len(part) + 1) if name.startswith(part, place)]
