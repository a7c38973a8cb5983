"""Reads the rows of one file, batch by batch, as streams."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recorders.errors import BadInput, some_of
from recorders.importers.mapping import Mapped, Source, checked, mapped, not_finite, schema_of
from recorders.importers.stamps import NOT_A_TIME, Stamps, to_ns
from recorders.importers.tables.files import Batch, Table, open_table
from recorders.importers.tables.mapping import Attitude, FileMatch, Origin, TableStream
from recorders.importers.tables.plane import Plane
from recorders.importers.tables.times import TimeMapping, read_counter, stamps_ns
from recorders.importers.units import conversion
from recorders.log import Stream, make_stream
from recorders.log.planes import FRAME, is_planar

PLACE = ("east_m", "north_m", "up_m")
QUATERNION = tuple(f"quaternion_{part}" for part in "wxyz")

ReadCounts = Counter[tuple[str, str]]


class Rows:
    """Imports a file: its next batch lies ready, and what is left out is counted.

    `generator` makes the noise that the mapping asks for. Raises BadInput where the file cannot be read,
    or lacks a column that its mapping names.
    """

    def __init__(self, found: FileMatch, counts: ReadCounts, generator: np.random.Generator) -> None:
        self.path, self.mapping, self._names = found
        self._counts, self._generator = counts, generator
        own = self.mapping
        self.table = self._open()
        self.count = 0
        self.messages = Counter[str]()
        self.span_ns: tuple[int, int] | None = None
        self.reached_ns = NOT_A_TIME
        self._time = self._clock(own.time)
        self._arrival = None if own.arrival is None else self._clock(own.arrival)
        self._texts, self._numbers = self._wanted()
        self._batches = self.table.batches(self._numbers, self._texts)
        self._next = next(self._batches, None)

    @property
    def is_done(self) -> bool:
        """Tell whether all rows were given."""
        return self._next is None

    # What is read.

    def _open(self) -> Table:
        own = self.mapping
        return open_table(
            self.path,
            own.format,
            names=own.columns,
            has_header=own.header,
            delimiter=own.delimiter,
            decimal=own.decimal,
        )

    @property
    def tag_name(self) -> str:
        """Return the name of the time tag that tells when the file was begun; else an empty one."""
        return self.path.name + self._time.tag if self._time.tag else ""

    def _clock(self, given: TimeMapping) -> TimeMapping:
        """Return the time mapping with columns as the file names them; a counter is read here."""
        columns = [self.table.column(name) for name in given.columns]
        week = columns.pop() if given.week else None
        own = given.model_copy(update={"column": columns, "week": week})
        if own.tag is not None:
            batches = self._open().batches((), own.columns)
            readings = (self._read_ns(batch, own) for batch in batches)
            self._counter = read_counter(self.path, own.tag, readings)
        return own

    def _wanted(self) -> tuple[set[str], set[str]]:
        """Return the columns that are wanted as text, and as numbers."""
        own = self.mapping
        clocks = [self._time, *([] if self._arrival is None else [self._arrival])]
        texts = {name for clock in clocks for name in clock.columns}
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
        columns = {self.table.column(name) for name in names if not self._is_given(name)}
        return texts, columns - texts

    def _is_given(self, source: str) -> bool:
        """Tell whether a source is no column but a part of the file's name, such as {anchor}."""
        return source.startswith("{") and source[1:-1] in self._names

    def _filled(self, text: str) -> str:
        for name, value in self._names.items():
            text = text.replace(f"{{{name}}}", value)
        return text

    def _floats(self, batch: Batch, source: str) -> NDArray:
        """Read the numbers (n,) of a source, NaN for empty cells."""
        if self._is_given(source):
            try:
                return np.full(_size(batch), float(self._filled(source)))
            except ValueError:
                name = self._filled(source)
                raise BadInput(
                    f"{self.path}: {source} in its file name is '{name}'; expected a number"
                ) from None
        column = self.table.column(source)
        cells = batch[column]
        if pa.types.is_string(cells.type):
            cells = pc.utf8_trim_whitespace(cells)
        try:
            return cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            raise BadInput(
                f"{self.path}: column {column} has cells that are not numbers; give a column of numbers"
            ) from None

    def _read_ns(self, batch: Batch, clock: TimeMapping) -> Stamps:
        return stamps_ns(clock, batch, self.count, _size(batch), str(self.path))

    def _stamps(self, batch: Batch, clock: TimeMapping) -> Stamps:
        found = self._read_ns(batch, clock)
        return found if clock.tag is None else self._counter.stamps_ns(found, str(self.path))

    # What the first rows say.

    def first_ns(self) -> int | None:
        """Return the earliest stamp of the first rows."""
        if self._next is None:
            return None
        stamps = self._stamps(self._next, self._time)
        known = stamps[stamps != NOT_A_TIME]
        return int(known.min()) if len(known) else None

    def first_fix(self) -> Origin | None:
        """Return the first place of the file."""
        fixes = next((each for each in self.mapping.streams if each.becomes == "GeodeticFix"), None)
        if self.mapping.geodetic is None and fixes is None:
            return None
        for batch in self._open().batches(self._numbers, self._texts):
            if self.mapping.geodetic is not None:
                places = self._places(batch)
            else:
                assert fixes is not None
                columns = self._mapped(fixes, batch, {}).columns
                places = (columns["latitude_deg"], columns["longitude_deg"], columns["altitude_m"])
            known = np.flatnonzero(np.isfinite(places[0]) & np.isfinite(places[1]))[:1]
            if len(known):
                self._check_place(places[0][known], places[1][known])
                latitude, longitude, altitude = (values[known].item() for values in places)
                altitude = altitude if np.isfinite(altitude) else 0.0
                return Origin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
        return None

    # What becomes of them.

    def block(self, plane: Plane | None) -> list[Stream]:
        """Return the streams of the next batch."""
        assert self._next is not None
        batch, self._next = self._next, next(self._batches, None)
        stamps = self._stamps(batch, self._time)
        logged = stamps if self._arrival is None else self._stamps(batch, self._arrival)
        timed = (stamps != NOT_A_TIME) & (logged != NOT_A_TIME)
        self._tell(self.path.name, "rows without a time are left out", int((~timed).sum()))
        self._note(stamps[timed])
        made = self._made(batch, plane)
        streams = []
        for own in self.mapping.streams:
            if not (own.only_first and self.messages[own.topic]):
                found = self._mapped(own, batch, made)
                rows = self._kept(own, found, timed)
                streams.append(self._stream(own, found, rows, stamps, logged, plane))
        self.count += len(stamps)
        return streams

    def _note(self, stamps: Stamps) -> None:
        """Take up what stamps (n,) tell of the clock."""
        if not len(stamps):
            return
        before = stamps[0] - 1 if self.reached_ns == NOT_A_TIME else self.reached_ns
        steps = np.diff(stamps, prepend=before)
        self._tell(self.path.name, "stamps repeat, and are kept", int((steps == 0).sum()))
        self._tell(self.path.name, "stamps go back, and are sorted", int((steps < 0).sum()))
        self.reached_ns = int(stamps[-1])
        low, high = self.span_ns or (self.reached_ns, self.reached_ns)
        self.span_ns = min(low, int(stamps.min())), max(high, int(stamps.max()))

    def _made(self, batch: Batch, plane: Plane | None) -> dict[str, NDArray]:
        """Make the columns that are made of others."""
        made: dict[str, NDArray] = {}
        if self.mapping.geodetic is not None:
            places = self._places(batch)
            self._check_place(*places[:2])
            # without a plane there is no place in the whole log
            unknown = np.full((3, _size(batch)), np.nan)
            made |= zip(PLACE, unknown if plane is None else plane.place(*places), strict=True)
        if self.mapping.attitude is not None:
            made |= zip(QUATERNION, self._quaternion(batch, self.mapping.attitude).T, strict=True)
        return made

    def _places(self, batch: Batch) -> tuple[NDArray, NDArray, NDArray]:
        """Read latitude and longitude (deg), altitude (m, 0 where no column has it) of rows (n,)."""
        own = self.mapping.geodetic
        assert own is not None
        factor = conversion(own.unit, "latitude_deg")
        altitude = np.zeros(_size(batch)) if own.altitude is None else self._floats(batch, own.altitude)
        return (
            self._floats(batch, own.latitude) * factor,
            self._floats(batch, own.longitude) * factor,
            altitude,
        )

    def _check_place(self, latitude_deg: NDArray, longitude_deg: NDArray) -> None:
        for field, values in (("latitude_deg", latitude_deg), ("longitude_deg", longitude_deg)):
            checked(str(self.path), field, values[np.isfinite(values)])

    def _quaternion(self, batch: Batch, own: Attitude) -> NDArray:
        """Compute orientations (n, 4), NaN where an angle is missing."""
        factor = conversion(own.unit, "angle_rad")
        names = (own.heading or own.yaw, own.pitch, own.roll)
        zero = np.zeros(_size(batch))
        angles = [zero if name is None else self._floats(batch, name) * factor for name in names]
        turns = np.stack(angles, axis=1)
        if own.heading is not None:  # clockwise from north and nose up, as aircraft have them
            turns = turns * (-1, -1, 1) + (np.pi / 2, 0, 0)
        known = np.isfinite(turns).all(axis=1)
        quaternion = np.full((len(turns), 4), np.nan)
        quaternion[known] = Rotation.from_euler("ZYX", turns[known]).as_quat(scalar_first=True)
        return quaternion

    def _mapped(self, own: TableStream, batch: Batch, made: Mapping[str, NDArray]) -> Mapped:
        def read(source: str) -> NDArray:
            return made[source] if source in made else self._floats(batch, source)

        def holds(source: str, values: Sequence[Source]) -> NDArray[np.bool_]:
            if not any(isinstance(value, str) for value in values):
                return np.isin(self._floats(batch, source), values)
            texts = pc.utf8_trim_whitespace(batch[self.table.column(source)].cast(pa.string()))
            return np.isin(texts.to_numpy(zero_copy_only=False).astype(str), list(map(str, values)))

        return mapped(own, _size(batch), read, holds, f"{self.path}: {self._filled(own.topic)}")

    def _kept(self, own: TableStream, found: Mapped, timed: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Choose which of the messages are taken; the others are counted by reason."""
        topic = self._filled(own.topic)
        lacking = not_finite(schema_of(own, topic), found.columns)
        keep = timed[found.rows] & ((self.count + found.rows) % own.every == 0)
        for reason, which in {**found.dropped, "NaN or infinite": lacking}.items():
            self._tell(topic, f"messages left out: {reason}", int((which & keep).sum()))
            keep = keep & ~which
        return np.flatnonzero(keep)[: 1 if own.only_first else None]

    def _stream(
        self,
        own: TableStream,
        found: Mapped,
        rows: NDArray[np.int64],
        stamps: Stamps,
        logged: Stamps,
        plane: Plane | None,
    ) -> Stream:
        topic, of = self._filled(own.topic), found.rows[rows]
        where = f"{self.path}: {topic}"
        self.messages[own.topic] += len(rows)
        metadata = own.metadata
        if own.delay_s:
            metadata["delay_s"] = repr(own.delay_s)
        if plane is not None and is_planar(schema_of(own, where).full_name, metadata):
            is_geodetic = self.mapping.geodetic is not None or own.becomes == "GeodeticFix"
            own_frame = {FRAME: self.path.name}  # nobody says where on earth that is
            metadata |= plane.metadata if plane.is_stated or is_geodetic else own_frame
        columns = {name: checked(where, name, column[rows]) for name, column in found.columns.items()}
        for name, sigma in own.noise.items():
            columns[name] = columns[name] + sigma * self._generator.normal(size=columns[name].shape)
            self._tell(topic, f"messages with simulated noise, {name}: {sigma:g}", len(rows))
        return make_stream(
            topic,
            schema_of(own, where),
            to_ns(stamps[of], 1, -round(own.delay_s * 1e9), where=where),
            log_time_ns=logged[of],
            sensor_time_ns=stamps[of],
            metadata=metadata,
            **columns,
        )

    # What is told.

    def _tell(self, subject: str, fact: str, count: int) -> None:
        if count:
            self._counts[subject, fact] += count

    def notes(self) -> dict[str, str]:
        """Describe what was read of the file."""
        name = self.path.name
        topics = ", ".join(self._filled(stream.topic) for stream in self.mapping.streams)
        notes = {name: f"{self.count} rows as {topics}"}
        if rest := [each for each in self.table.columns if each not in self._texts | self._numbers]:
            notes[f"{name}: columns not taken"] = some_of(rest)
        if self.table.mended:
            notes[f"{name}, mended"] = self.table.mended
        for doubt in sorted(self.table.doubts):
            notes[name] += f"; {doubt}"
        for reason, count in self.table.left_out.items():
            notes[f"{name}: rows left out, {reason}"] = str(count)
        return notes


def _size(batch: Batch) -> int:
    return len(next(iter(batch.values())))
