"""Reader of one file's rows, batch by batch, as streams."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.extras import extra
from fuselog.recorders.importers.mapping import (
    NOT_UNIT,
    SCALED,
    Mapped,
    Quaternions,
    Source,
    checked,
    mapped,
    not_finite,
    off_unit,
    schema_of,
    with_unit_quaternions,
)
from fuselog.recorders.importers.stamps import NOT_A_TIME, Stamps, to_ns
from fuselog.recorders.importers.tables.cells import read_ns, sided
from fuselog.recorders.importers.tables.files import (
    Batch,
    Table,
    TextOptions,
    floats,
    open_table,
    texts_in,
)
from fuselog.recorders.importers.tables.mapping import Attitude, FileMatch, Origin, TableStream
from fuselog.recorders.importers.tables.times import (
    REMEDY,
    Order,
    Reading,
    TimeMapping,
    is_reversed,
    read_counter,
    stamps_ns,
)
from fuselog.recorders.log import Stream, make_stream
from fuselog.recorders.log.planes import FRAME, is_planar
from fuselog.recorders.models.geodesy import into_tangent_plane
from fuselog.recorders.units import conversion

PLACE = ("east_m", "north_m", "up_m")
QUATERNION = tuple(f"quaternion_{part}" for part in "wxyz")

ReadCounts = Counter[tuple[str, str]]
_MOST_VEHICLES = 1000
# Rows by which the direction of time is recognised.
_LOOKED_AT = 1000
# The column for stamps from a separate file.
_STAMP = "\0stamp"

Floats = NDArray[np.float64]


class Plane(NamedTuple):
    """A conversion to east, north and up from an origin, in the tangent plane or on a map projection.

    If the mapping states the origin, all positions of the log are in this plane.
    """

    origin: Origin
    projection: str | None = None
    is_stated: bool = False

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata for channels of streams in the plane."""
        stated = {f"origin_{name}": repr(value) for name, value in self.origin}
        # a model would take a stated origin as that of a tangent plane
        return stated if self.projection is None else {"projection": self.projection}

    def place(
        self, latitude_deg: Floats, longitude_deg: Floats, altitude_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Compute east, north and up (n,) in m from positions on WGS 84.

        Raises BadInput if pyproj is needed but not installed, or does not know the projection.
        """
        here = self.origin
        if self.projection is None:
            touch = (here.latitude_deg, here.longitude_deg, here.altitude_m)
            east, north, up = into_tangent_plane((latitude_deg, longitude_deg, altitude_m), touch)
            return np.asarray(east), np.asarray(north), np.asarray(up)
        onto_map = _onto_map(self.projection)
        east, north = onto_map.transform(longitude_deg, latitude_deg)
        zero_east, zero_north = onto_map.transform(here.longitude_deg, here.latitude_deg)
        is_on_map = np.isfinite(east) & np.isfinite(latitude_deg)
        place = np.where(is_on_map, [east - zero_east, north - zero_north], np.nan)
        return place[0], place[1], altitude_m - here.altitude_m


@cache
def _onto_map(projection: str) -> Any:
    with extra("maps", f"projection {projection}"):
        from pyproj import CRS, Transformer
        from pyproj.exceptions import CRSError
    try:
        crs = CRS.from_user_input(projection)
    except CRSError:
        raise BadInput(
            f"pyproj knows no projection '{projection}'; give one such as EPSG:25832"
        ) from None
    if not crs.is_projected:
        raise BadInput(
            f"projection {projection}: has no east and north in m; give a projected one, such as "
            "EPSG:25832"
        )
    return Transformer.from_crs("EPSG:4326", crs, always_xy=True)


class Rows:
    """The importer of one file, which reads one batch ahead and counts what is left out.

    `generator` draws the noise that the mapping requests; `quaternions` states how to treat quaternions
    that are not of unit length. Raises BadInput if the file cannot be read, or lacks a column that its
    mapping names.
    """

    def __init__(
        self,
        found: FileMatch,
        counts: ReadCounts,
        generator: np.random.Generator,
        quaternions: Quaternions,
    ) -> None:
        self.path, self.mapping, self._names = found.path, found.table, dict(found.names)
        self._more, self._stamps_path = found.more, found.stamps
        self._counts, self._generator, self._quaternions = counts, generator, quaternions
        own = self.mapping
        self.table = self._open()
        self.count = 0
        self.messages = Counter[str]()
        self.span_ns: tuple[int, int] | None = None
        self.reached_ns = NOT_A_TIME
        self._is_prepared = bool(own.missing or own.degrees_minutes or own.hemispheres)
        self._missing = {self.table.column(name): values for name, values in own.missing.items()}
        self._halves = {
            self.table.column(name): self.table.column(side) for name, side in own.hemispheres.items()
        }
        self._in_minutes = {self.table.column(name) for name in own.degrees_minutes}
        self._numbers_of: dict[str, NDArray] = {}  # in the current rows, by column
        self._exact = {
            self.table.column(source) for stream in own.streams for source in _times_in(stream)
        }
        self._time = self._clock(own.time)
        self._others = {
            name: self._clock(clock)
            for name, clock in (("arrival", own.arrival), ("sensor", own.sensor))
            if clock is not None
        }
        self._vehicle = None if own.vehicle is None else self.table.column(own.vehicle)
        self._clocks: dict[str, tuple[Order, dict[str, Reading]]] = {}  # by vehicle
        self._reached: dict[str, int] = {}
        self._vehicles: dict[str, str] = {}  # names of vehicles, by their form in topics
        self._texts, self._numbers = self._wanted()
        self._batches = self._timed(self.table.batches(self._numbers, self._texts))
        self._next = next(self._batches, None)
        self._is_reversed = self._next is not None and self._goes_back(self._next)

    @property
    def is_done(self) -> bool:
        """Test whether all rows have been returned."""
        return self._next is None

    # Reading of columns.

    def _open(self) -> Table:
        own = self.mapping
        options = TextOptions(own.columns, own.header, own.delimiter, own.decimal, own.skip)
        return open_table(self.path, own.format, options, more=self._more, split=own.split)

    @property
    def tag_name(self) -> str:
        """Return the name of the time tag with the start time of the file, or an empty string."""
        return self.path.name + self._time.tag if self._time.tag else ""

    def _clock(self, given: TimeMapping) -> TimeMapping:
        """Return the time mapping with the file's own column names; read the time tag, if any."""
        if self._stamps_path is not None and given.file is not None:
            return given.model_copy(update={"column": [_STAMP], "file": None})
        columns = [self.table.column(name) for name in given.columns]
        week = columns.pop() if given.week else None
        own = given.model_copy(update={"column": columns, "week": week})
        if own.tag is not None:
            batches = self._open().batches((), own.columns)
            whole = own.model_copy(update={"tag": None})
            readings = (
                stamps_ns(whole, batch, np.arange(_size(batch)), str(self.path)) for batch in batches
            )
            self._ticks = read_counter(self.path, own.tag, readings)
        return own

    def _timed(self, batches: Iterator[Batch]) -> Iterator[Batch]:
        """Add the stamps to batches if they are in a separate file."""
        if self._stamps_path is None:
            yield from batches
            return
        lines = texts_in(self._stamps_path)
        count = 0
        for batch in batches:
            stamps = list(islice(lines, _size(batch)))
            count += len(stamps)
            if len(stamps) < _size(batch):
                raise BadInput(
                    f"{self._stamps_path}: has {count} times, but there are more rows in {self.path} "
                    "and the files after it; give a time for each row"
                )
            yield {**batch, _STAMP: pa.array(stamps, pa.string())}
        if rest := sum(1 for _ in lines):
            raise BadInput(
                f"{self._stamps_path}: has {count + rest} times, but there are {count} rows in "
                f"{self.path} and the files after it; give a row for each time"
            )

    def _wanted(self) -> tuple[set[str], set[str]]:
        """Return the columns to read as text, and those to read as numbers."""
        own = self.mapping
        clocks = [self._time, *self._others.values()]
        texts = {name for clock in clocks for name in clock.columns} - {_STAMP}
        names = set[str]()
        for made in (own.geodetic, own.attitude):
            if made is not None:
                names |= set(made.model_dump(exclude={"unit"}, exclude_none=True).values())
        made_here = {*(PLACE if own.geodetic else ()), *(QUATERNION if own.attitude else ())}
        for stream in own.streams:
            names |= {name for name in stream.sources() if name not in made_here}
            for name, values in stream.conditions():
                if any(isinstance(value, str) for value in values):
                    texts.add(self.table.column(name))
                else:
                    names.add(name)
        texts |= self._exact | {*self._halves.values()} | ({self._vehicle} if self._vehicle else set())
        columns = {self.table.column(name) for name in names if not self._is_given(name)}
        if not (texts or columns):  # one column is needed to count the rows
            columns = {self.table.columns[0]}
        return texts, columns - texts

    def _is_given(self, source: str) -> bool:
        """Test whether a source is not a column but a part of the file's name, such as {anchor}."""
        return source.startswith("{") and source[1:-1] in self._names

    def _filled(self, text: str) -> str:
        for name, value in self._names.items():
            text = text.replace(f"{{{name}}}", value)
        return text

    def _floats(self, batch: Batch, source: str) -> NDArray:
        """Read the numbers (n,) of a source, NaN for empty cells and codes of missing values."""
        if self._is_given(source):
            try:
                return np.full(_size(batch), float(self._filled(source)))
            except ValueError:
                name = self._filled(source)
                raise BadInput(
                    f"{self.path}: {source} in its file name is '{name}'; expected a number"
                ) from None
        column = self.table.column(source)
        if column in self._numbers_of:
            return self._numbers_of[column]
        cells = batch[column]
        sides = batch[self._halves[column]] if column in self._halves else None
        try:
            if sides is not None and self._halves[column] == column:
                cells, sides = sided(cells)
            found = floats(cells)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            raise BadInput(
                f"{self.path}: column {column} has cells that are not numbers; give a column of numbers"
            ) from None
        found = self._finite(column, cells, found)
        if self._is_prepared:
            found = self._prepared(column, found, sides)
        self._numbers_of[column] = found
        return found

    def _finite(self, column: str, cells: pa.Array, found: NDArray) -> NDArray:
        """Replace a column's infinite numbers (n,) by NaN; count them and cells that are not numbers."""
        if np.isfinite(found).all():
            return found
        is_odd = np.isinf(found)
        if self.table.is_text:
            is_odd |= np.isnan(found) & cells.is_valid().to_numpy(zero_copy_only=False)
        self._tell_missing(column, "cells that are not numbers", is_odd)
        return np.where(is_odd, np.nan, found)

    def _prepared(self, column: str, found: NDArray, sides: pa.Array | None) -> NDArray:
        """Remove codes of missing values from a column (n,), convert minutes, and apply hemispheres."""
        for code in self._missing.get(column, []):
            is_missing = found == code
            self._tell_missing(column, f"{code:g}", is_missing)
            found = np.where(is_missing, np.nan, found)
        if column in self._in_minutes:
            size = np.abs(found)
            minutes = np.fmod(size, 100.0)
            if np.any(minutes >= 60.0):
                row = int(np.argmax(minutes >= 60.0))
                raise BadInput(
                    f"{self.path}: column {column} holds {found[row]:.9g}, which is not in degrees and "
                    "minutes (ddmm.mmmm); remove it from degrees_minutes"
                )
            found = np.copysign(np.floor(size / 100.0) + minutes / 60.0, found)
        if sides is not None:
            sides = pc.utf8_upper(pc.utf8_trim_whitespace(sides.cast(pa.string())))
            letters = sides.to_numpy(zero_copy_only=False).astype(str)
            initials = np.char.ljust(letters, 1).astype("<U1")
            is_south, is_north = np.isin(initials, ["S", "W"]), np.isin(initials, ["N", "E"])
            if np.any(is_north & (found < 0.0)):
                row = int(np.argmax(is_north & (found < 0.0)))
                raise BadInput(
                    f"{self.path}: column {column} holds {found[row]:.9g}, but {self._halves[column]} "
                    f"says '{letters[row]}'; remove it from hemispheres if it already has signs"
                )
            unknown = ~(is_south | is_north) & np.isfinite(found)
            self._tell_missing(column, "without a hemisphere", unknown)
            found = np.where(is_south, -np.abs(found), np.where(is_north, found, np.nan))
        return found

    def _parts(self, batch: Batch, rows: NDArray[np.int64]) -> Iterator[tuple[Batch, NDArray[np.int64]]]:
        """Yield the rows of a batch by vehicle; meanwhile, the vehicle's name replaces {vehicle}."""
        if self._vehicle is None:
            self._numbers_of.clear()
            yield batch, rows
            return
        names = pc.utf8_trim_whitespace(batch[self._vehicle].cast(pa.string()))
        nameless = int(pc.sum(pc.or_kleene(pc.is_null(names), pc.equal(names, ""))).as_py() or 0)
        self._tell(self.path.name, f"rows without a {self._vehicle} are left out", nameless)
        for name in pc.unique(names).to_pylist():
            if not name:
                continue
            which = np.flatnonzero(pc.fill_null(pc.equal(names, name), False).to_numpy(False))
            plain = re.sub(r"\W+", "_", name).strip("_") or "_"
            if (other := self._vehicles.setdefault(plain, name)) != name:
                raise BadInput(
                    f"{self.path}: column {self._vehicle} has '{name}' and '{other}', which both become "
                    f"{plain} in topics; give them different names of letters and digits"
                )
            self._names["vehicle"] = plain
            self._numbers_of.clear()
            yield {column: cells.take(pa.array(which)) for column, cells in batch.items()}, rows[which]

    def _read_ns(
        self, batch: Batch, clock: TimeMapping, rows: NDArray[np.int64], reading: Reading | None = None
    ) -> Stamps:
        found = stamps_ns(clock, batch, rows, str(self.path), reading)
        return found if clock.tag is None else self._ticks.stamps_ns(found, str(self.path))

    def _goes_back(self, batch: Batch) -> bool:
        """Test from the local times of the first rows whether rows are newest first."""
        if self._time.order == "any" or not self._time.columns or self._time.tag:
            return False
        zone = "UTC" if self._time.zone else None
        clock = self._time.model_copy(update={"zone": zone, "rollover": None})
        batch = {name: cells[:_LOOKED_AT] for name, cells in batch.items()}
        rows = np.arange(_size(batch))
        return is_reversed([self._read_ns(part, clock, its) for part, its in self._parts(batch, rows)])

    # Information from the first rows.

    def first_ns(self) -> int | None:
        """Return the earliest stamp of the first rows, or of all rows if they are newest first."""
        if self._next is None:
            return None
        wanted = {*self._time.columns, *([self._vehicle] if self._vehicle else [])}
        whole = self._timed(self._open().batches((), wanted - {_STAMP})) if self._is_reversed else ()
        earliest, count = [], 0
        for batch in (self._next,) if not self._is_reversed else whole:
            rows = count + np.arange(_size(batch))
            count += len(rows)
            for part, its in self._parts(batch, rows):
                stamps = self._read_ns(*self._turned(part, its, self._time))
                earliest += [int(known.min())] if len(known := stamps[stamps != NOT_A_TIME]) else []
        return min(earliest, default=None)

    def _turned(
        self, batch: Batch, rows: NDArray[np.int64], clock: TimeMapping
    ) -> tuple[Batch, TimeMapping, NDArray[np.int64]]:
        if not self._is_reversed:
            return batch, clock, rows
        back = pa.array(np.arange(len(rows))[::-1])
        return {name: cells.take(back) for name, cells in batch.items()}, clock, rows[::-1]

    def first_fix(self) -> Origin | None:
        """Return the first position in the file."""
        fixes = next((each for each in self.mapping.streams if each.becomes == "GeodeticFix"), None)
        if self.mapping.geodetic is None and fixes is None:
            return None
        counts, self._counts = self._counts, Counter()  # these rows are read and counted again later
        try:
            for whole in self._open().batches(self._numbers, self._texts):
                for batch, _ in self._parts(whole, np.arange(_size(whole))):
                    if self.mapping.geodetic is not None:
                        places = self._places(batch)
                    else:
                        assert fixes is not None
                        found = self._mapped(fixes, batch, lambda _: {})
                        left_out = np.any([*found.dropped.values()], axis=0)
                        names = ("latitude_deg", "longitude_deg", "altitude_m")
                        columns = [found.columns[name] for name in names]
                        latitude, longitude, altitude = np.where(left_out, np.nan, columns)
                        places = latitude, longitude, altitude
                    known = np.flatnonzero(np.isfinite(places[0]) & np.isfinite(places[1]))[:1]
                    if len(known):
                        self._check_place(places[0][known], places[1][known])
                        first = [values[known].item() for values in places]
                        return Origin(
                            latitude_deg=first[0],
                            longitude_deg=first[1],
                            altitude_m=first[2] if np.isfinite(first[2]) else 0.0,
                        )
            return None
        finally:
            self._counts = counts

    # Messages.

    def block(self, plane: Plane | None) -> list[Stream]:
        """Make the streams of the next batch."""
        assert self._next is not None
        whole, self._next = self._next, next(self._batches, None)
        size = _size(whole)
        streams = []
        for part, its in self._parts(whole, self.count + np.arange(size)):
            batch, _, rows = self._turned(part, its, self._time)
            streams += self._streams(batch, rows, plane)
        self.count += size
        if self._is_reversed:
            self._tell(self.path.name, "rows are newest first, so they are reversed", size)
        if self.is_done:
            self._end()
        return streams

    def _streams(self, batch: Batch, rows: NDArray[np.int64], plane: Plane | None) -> list[Stream]:
        """Make the streams of rows that belong to one vehicle."""
        vehicle = self._names.get("vehicle", "")
        if vehicle not in self._clocks:
            if len(self._clocks) == _MOST_VEHICLES:
                raise BadInput(
                    f"{self.path}: column {self._vehicle} has more than {_MOST_VEHICLES} values; name "
                    "the column of the vehicle, or remove `vehicle`"
                )
            label = f"{self.path}: column {' and '.join(self._time.columns)}"
            self._clocks[vehicle] = (
                Order(label, self._time),
                {name: Reading() for name in ("time", *self._others)},
            )
        order, readings = self._clocks[vehicle]
        if self._is_reversed:  # the rows of a block are earlier than those of the previous block
            if self._time.rollover and not (self.is_done and self.count == 0):
                raise BadInput(
                    f"{self.path}: its rows are newest first, and its counter rolls over at "
                    f"{self._time.rollover:g}; reverse the rows of the file"
                )
            order = Order(f"{self.path}: column {' and '.join(self._time.columns)}", self._time)
            for reading in readings.values():
                reading.begin()
        stamps = self._read_ns(batch, self._time, rows, readings["time"])
        others = {
            name: self._read_ns(batch, clock, rows, readings[name])
            for name, clock in self._others.items()
        }
        timed = stamps != NOT_A_TIME
        for each in others.values():
            timed &= each != NOT_A_TIME
        self._tell(self.path.name, "rows without a time are left out", int((~timed).sum()))
        order.follow(stamps[timed], rows[timed])
        if self._is_reversed:
            order.end()
        self._note(stamps[timed], vehicle)
        clocks = _Clocks(stamps, others.get("arrival", stamps), others.get("sensor", stamps))
        made: dict[tuple[float, ...], dict[str, NDArray]] = {}

        def made_of(missing: Sequence[float]) -> dict[str, NDArray]:
            key = tuple(missing)
            if key not in made:
                made[key] = self._made(batch, plane, missing)
            return made[key]

        streams = []
        for own in self.mapping.streams:
            if own.only_first and self.messages[self._filled(own.topic)]:
                continue
            if own.only_first and self._is_reversed and not self.is_done:
                raise BadInput(
                    f"{self.path}: its rows are newest first, but `only_first` of {own.topic} needs the "
                    "earliest one; sort the file by its times"
                )
            found = self._mapped(own, batch, made_of)
            streams.append(self._stream(own, found, self._kept(own, found, timed, rows), clocks, plane))
        return streams

    def _end(self) -> None:
        """Report decisions about times, and check the order of the last rows."""
        for order, readings in self._clocks.values():
            if not self._is_reversed:
                order.end()
            for reading in readings.values():
                for fact, count in reading.facts.items():
                    self._tell(self.path.name, fact, count)

    def _note(self, stamps: Stamps, vehicle: str) -> None:
        """Update the facts about the clock from stamps (n,)."""
        if not len(stamps):
            return
        reached = self._reached.get(vehicle, int(stamps[0]) - 1)
        steps = np.diff(stamps, prepend=reached)
        self._tell(self.path.name, "stamps repeat, but are kept", int((steps == 0).sum()))
        if not self._is_reversed or len(stamps) > 1:
            back = steps[1:] if self._is_reversed else steps
            self._tell(
                self.path.name, "stamps go back in time, so they are sorted", int((back < 0).sum())
            )
        self.reached_ns = self._reached[vehicle] = int(stamps[-1])
        low, high = self.span_ns or (self.reached_ns, self.reached_ns)
        self.span_ns = min(low, int(stamps.min())), max(high, int(stamps.max()))

    def _made(self, batch: Batch, plane: Plane | None, missing: Sequence[float]) -> dict[str, NDArray]:
        """Compute positions and quaternions from other columns, without the codes in `missing`."""
        made: dict[str, NDArray] = {}
        if self.mapping.geodetic is not None:
            places = self._places(batch, missing)
            self._check_place(*places[:2])
            # without a tangent plane there is no position in the whole log
            unknown = np.full((3, _size(batch)), np.nan)
            made |= zip(PLACE, unknown if plane is None else plane.place(*places), strict=True)
        if self.mapping.attitude is not None:
            quaternion = self._quaternion(batch, self.mapping.attitude, missing)
            made |= zip(QUATERNION, quaternion.T, strict=True)
        return made

    def _known(self, batch: Batch, source: str, missing: Sequence[float]) -> NDArray:
        found = self._floats(batch, source)
        return np.where(np.isin(found, missing), np.nan, found) if missing else found

    def _places(self, batch: Batch, missing: Sequence[float] = ()) -> tuple[NDArray, NDArray, NDArray]:
        """Read latitude and longitude (deg) and altitude (m, 0 without a column) of rows (n,)."""
        own = self.mapping.geodetic
        assert own is not None
        factor = conversion(own.unit, "latitude_deg")
        altitude = (
            np.zeros(_size(batch)) if own.altitude is None else self._known(batch, own.altitude, missing)
        )
        return (
            self._known(batch, own.latitude, missing) * factor,
            self._known(batch, own.longitude, missing) * factor,
            altitude,
        )

    def _check_place(self, latitude_deg: NDArray, longitude_deg: NDArray) -> None:
        for field, values in (("latitude_deg", latitude_deg), ("longitude_deg", longitude_deg)):
            checked(str(self.path), field, values[np.isfinite(values)])

    def _quaternion(self, batch: Batch, own: Attitude, missing: Sequence[float]) -> NDArray:
        """Compute orientations (n, 4), NaN if an angle is missing."""
        factor = conversion(own.unit, "angle_rad")
        names = (own.heading or own.yaw, own.pitch, own.roll)
        zero = np.zeros(_size(batch))
        angles = [zero if name is None else self._known(batch, name, missing) * factor for name in names]
        turns = np.stack(angles, axis=1)
        if own.heading is not None:  # clockwise from north and nose up, as for aircraft
            turns = turns * (-1, -1, 1) + (np.pi / 2, 0, 0)
        known = np.isfinite(turns).all(axis=1)
        quaternion = np.full((len(turns), 4), np.nan)
        quaternion[known] = Rotation.from_euler("ZYX", turns[known]).as_quat(scalar_first=True)
        return quaternion

    def _mapped(
        self,
        own: TableStream,
        batch: Batch,
        made_of: Callable[[Sequence[float]], Mapping[str, NDArray]],
    ) -> Mapped:
        made = made_of(own.missing)

        def read(source: str) -> NDArray:
            if source in made:
                return made[source]
            if source in self._exact:
                return read_ns(
                    batch[self.table.column(source)],
                    0,
                    where=f"{self.path}: column {source}",
                    remedy=REMEDY,
                )
            return self._floats(batch, source)

        def holds(source: str, values: Sequence[Source]) -> NDArray[np.bool_]:
            if not any(isinstance(value, str) for value in values):
                return np.isin(self._floats(batch, source), values)
            texts = pc.utf8_trim_whitespace(batch[self.table.column(source)].cast(pa.string()))
            return np.isin(texts.to_numpy(zero_copy_only=False).astype(str), list(map(str, values)))

        return mapped(own, _size(batch), read, holds, f"{self.path}: {self._filled(own.topic)}")

    def _kept(
        self, own: TableStream, found: Mapped, timed: NDArray[np.bool_], rows: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Choose the messages to keep; count those left out by reason."""
        topic = self._filled(own.topic)
        lacking = not_finite(schema_of(own, topic), found.columns)
        keep = timed[found.rows] & (rows[found.rows] % own.every == 0)
        for reason, which in {**found.dropped, "NaN or infinite": lacking}.items():
            self._tell(topic, f"messages left out: {reason}", int((which & keep).sum()))
            keep = keep & ~which
        where = f"{self.path}: {topic}"
        off = off_unit(where, found.columns, own.kinds, keep, self._quaternions)
        self._tell(topic, f"messages left out: {NOT_UNIT}", int(off.left_out.sum()))
        self._tell(topic, f"messages with {SCALED}", int(off.scaled.sum()))
        keep &= ~off.left_out
        return np.flatnonzero(keep)[: 1 if own.only_first else None]

    def _stream(
        self,
        own: TableStream,
        found: Mapped,
        rows: NDArray[np.int64],
        clocks: "_Clocks",
        plane: Plane | None,
    ) -> Stream:
        topic, of = self._filled(own.topic), found.rows[rows]
        where = f"{self.path}: {topic}"
        self.messages[topic] += len(rows)
        metadata = own.metadata
        if own.delay_s:
            metadata["delay_s"] = repr(own.delay_s)
        if plane is not None and is_planar(schema_of(own, where).full_name, metadata):
            is_geodetic = self.mapping.geodetic is not None or own.becomes == "GeodeticFix"
            own_frame = {FRAME: self.path.name}  # its position on the earth is unknown
            metadata |= plane.metadata if plane.is_stated or is_geodetic else own_frame
        columns = {name: column[rows] for name, column in found.columns.items()}
        columns = with_unit_quaternions(columns, own.kinds)
        columns = {name: checked(where, name, column) for name, column in columns.items()}
        for name, sigma in own.noise.items():
            columns[name] = columns[name] + sigma * self._generator.normal(size=columns[name].shape)
            self._tell(topic, f"messages with simulated noise, {name}: {sigma:g}", len(rows))
        return make_stream(
            topic,
            schema_of(own, where),
            to_ns(clocks.stamps[of], 1, -round(own.delay_s * 1e9), where=where),
            log_time_ns=clocks.logged[of],
            sensor_time_ns=clocks.sensed[of],
            metadata=metadata,
            **columns,
        )

    # Notes.

    def _tell_missing(self, column: str, what: str, which: NDArray[np.bool_]) -> None:
        self._tell(f"{self.path.name}: {column}", f"{what}, read as missing", int(which.sum()))

    def _tell(self, subject: str, fact: str, count: int) -> None:
        if count:
            self._counts[subject, fact] += count

    def notes(self) -> dict[str, str]:
        """Describe what was read from the file."""
        name = self.path.name
        self._names.pop("vehicle", None)
        topics = ", ".join(self._filled(stream.topic) for stream in self.mapping.streams)
        of = f" of {len(self._clocks)} vehicles" if self._vehicle else ""
        files = f" of {1 + len(self._more)} files" if self._more else ""
        notes = {name: f"{self.count} rows{files} as {topics}{of}"}
        used = self._texts | self._numbers
        if rest := [each for each in self.table.columns if each not in used]:
            notes[f"{name}: columns not taken"] = some_of(rest)
        if self.table.mended:
            notes[f"{name}, trajectory"] = self.table.mended
        for doubt in sorted(self.table.doubts):
            notes[name] += f"; {doubt}"
        for reason, count in self.table.left_out.items():
            notes[f"{name}: rows left out, {reason}"] = str(count)
        return notes


class _Clocks(NamedTuple):
    """The stamps (n,) of rows by three clocks: of the measurement, the recorder and the sensor."""

    stamps: Stamps
    logged: Stamps
    sensed: Stamps


def _size(batch: Batch) -> int:
    return len(next(iter(batch.values())))


def _times_in(stream: TableStream) -> Iterator[str]:
    """Yield the sources of fields that are times, which are read without loss of digits."""
    times = {
        entry.name for entry in list(schema_of(stream, stream.topic))[1:] if entry.kind == "time_ns"
    }
    for name in times & stream.fields.keys():
        if isinstance(source := stream.fields[name], str):
            yield source
