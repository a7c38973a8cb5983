"""The importer of tables: rows become messages by a mapping, and what is left out is told."""

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recorders.errors import BadInput
from recorders.importers.mapping import Source, checked, mapped, not_finite, schema_of
from recorders.importers.tables.files import Batch, Table, open_table
from recorders.importers.tables.mapping import (
    Attitude,
    ConstantStream,
    Found,
    Geodetic,
    LogMapping,
    Origin,
    TableStream,
    find_files,
    read_mapping,
    shipped,
)
from recorders.importers.tables.times import NOT_A_TIME, Stamps, TimeMapping, read_counter, stamps_ns
from recorders.importers.units import conversion
from recorders.log import Stream, make_stream
from recorders.models.geodesy import into_tangent_plane
from recorders.parameters import Parameters
from recorders.recording import Blocks, Importer

_PLACE = ("east_m", "north_m", "up_m")
_QUATERNION = tuple(f"quaternion_{part}" for part in "wxyz")
# What is in the axes of the local plane, and states where that touches.
_IN_PLANE = {"PositionFix", "VelocityFix", "TruthState", "Pose"}


class TableParameters(Parameters):
    """The mapping, a name (walk) or a file (own.toml), and more files and folders that it is of."""

    mapping: str = ""
    more: list[str] = []


class _Rows:
    """The rows of one file, batch by batch, as streams."""

    def __init__(self, found: Found, told: Counter[tuple[str, str]]) -> None:
        self.path, self.mapping, self._names = found
        self._told = told
        own = self.mapping
        self.table: Table = open_table(
            self.path,
            own.format,
            names=own.columns,
            has_header=own.header,
            delimiter=own.delimiter,
            decimal=own.decimal,
        )
        self.count, self.messages = 0, Counter[str]()
        self._clocks = [self._clock(each) for each in (own.time, own.arrival) if each is not None]
        self._texts, self._numbers = self._wanted()
        self._last_ns = NOT_A_TIME
        self.span_ns: tuple[int, int] | None = None
        self._batches = self.table.batches(self._numbers, self._texts)
        self._next = next(self._batches, None)

    # What is read.

    def _clock(self, given: TimeMapping) -> TimeMapping:
        """The time mapping with columns as the file names them; a counter is read here."""
        columns = [self.table.column(name) for name in given.columns]
        week = columns.pop() if given.week else None
        own = given.model_copy(update={"column": columns, "week": week})
        if own.tag is not None:
            batches = self.table.batches((), own.columns)
            self._counter = read_counter(
                self.path, own.tag, (self._read_ns(batch, own) for batch in batches)
            )
        return own

    def _read_ns(self, batch: Batch, clock: TimeMapping) -> Stamps:
        return stamps_ns(clock, batch, self.count, _size(batch), str(self.path))

    def _wanted(self) -> tuple[set[str], set[str]]:
        """The columns that are wanted as text, and as numbers."""
        made = {
            *(_PLACE if self.mapping.geodetic else ()),
            *(_QUATERNION if self.mapping.attitude else ()),
        }
        texts = {name for clock in self._clocks for name in clock.columns}
        numbers = set()
        for stream in self.mapping.streams:
            texts |= {
                self._column(name)
                for name, values in stream.conditions()
                if any(isinstance(value, str) for value in values)
            }
            numbers |= {
                self._column(name)
                for name in chain(stream.sources(), (name for name, _ in stream.conditions()))
                if name not in made and not self._is_given(name)
            }
        for own in (self.mapping.geodetic, self.mapping.attitude):
            if own is not None:
                values = own.model_dump(exclude={"unit"}).values()
                numbers |= {self.table.column(name) for name in values if name is not None}
        return texts, numbers - texts

    def _column(self, name: str) -> str:
        return self.table.column(name)

    def _is_given(self, source: str) -> bool:
        """Whether a source is no column but a part of the file's name, such as {anchor}."""
        return source.startswith("{") and source[1:-1] in self._names

    def first_fix(self) -> Origin | None:
        """The first place of the file."""
        places = self.mapping.geodetic or next(
            (
                Geodetic(
                    latitude=str(stream.fields["latitude_deg"]),
                    longitude=str(stream.fields["longitude_deg"]),
                    altitude=str(stream.fields["altitude_m"]) if "altitude_m" in stream.fields else None,
                )
                for stream in self.mapping.streams
                if stream.becomes == "GeodeticFix"
            ),
            None,
        )
        if places is None or self._next is None:
            return None
        latitude, longitude, altitude = self._places(self._next, places)
        rows = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
        if not len(rows):
            return None
        row = rows[0]
        self._check_place(latitude[row : row + 1], longitude[row : row + 1])
        return Origin(
            latitude_deg=latitude[row],
            longitude_deg=longitude[row],
            altitude_m=altitude[row] if np.isfinite(altitude[row]) else 0.0,
        )

    def _places(self, batch: Batch, own: Geodetic) -> tuple[NDArray, NDArray, NDArray]:
        """Latitude, longitude (deg) and height (m, 0 where there is none) of the rows (n,)."""
        names = (own.latitude, own.longitude, own.altitude)
        found = [np.zeros(_size(batch)) if name is None else self._floats(batch, name) for name in names]
        return found[0], found[1], found[2]

    def _check_place(self, latitude: NDArray, longitude: NDArray) -> None:
        for field, values in (("latitude_deg", latitude), ("longitude_deg", longitude)):
            checked(str(self.path), field, values[np.isfinite(values)])

    def _floats(self, batch: Batch, name: str) -> NDArray:
        column = self.table.column(name)
        cells = batch[column]
        if pa.types.is_string(cells.type):
            cells = pc.utf8_trim_whitespace(cells)
        try:
            return cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
        except pa.ArrowInvalid:
            raise BadInput(f"{self.path}: column {column} holds what is no number") from None

    # What becomes of it.

    @property
    def is_done(self) -> bool:
        """Whether all rows were given."""
        return self._next is None

    @property
    def reached_ns(self) -> int:
        """The last stamp so far."""
        return self._last_ns

    def first_ns(self) -> int | None:
        """The earliest stamp of the first rows."""
        if self._next is None:
            return None
        stamps = self._stamps(self._next, self._clocks[0])
        known = stamps[stamps != NOT_A_TIME]
        return int(known.min()) if len(known) else None

    def _stamps(self, batch: Batch, clock: TimeMapping) -> Stamps:
        found = self._read_ns(batch, clock)
        return found if clock.tag is None else self._counter.stamps_ns(found)

    def block(self, origin: Origin | None) -> list[Stream]:
        """The streams of the next batch."""
        assert self._next is not None
        batch, self._next = self._next, next(self._batches, None)
        stamps = self._stamps(batch, self._clocks[0])
        logged = self._stamps(batch, self._clocks[1]) if len(self._clocks) > 1 else stamps
        timed = (stamps != NOT_A_TIME) & (logged != NOT_A_TIME)
        self._tell(self.path.name, "rows without a time are left out", int((~timed).sum()))
        self._note_stamps(stamps[timed])
        made = self._made(batch, origin)
        streams = [
            self._stream(stream, batch, made, stamps, logged, timed, origin)
            for stream in self.mapping.streams
            if not (stream.only_first and self.messages[stream.topic])
        ]
        self.count += len(stamps)
        return streams

    def _note_stamps(self, stamps: Stamps) -> None:
        if not len(stamps):
            return
        steps = np.diff(stamps, prepend=stamps[0] - 1 if self._last_ns == NOT_A_TIME else self._last_ns)
        self._tell(self.path.name, "stamps repeat, and are kept", int((steps == 0).sum()))
        self._tell(self.path.name, "stamps go back, and are sorted", int((steps < 0).sum()))
        self._last_ns = int(stamps[-1])
        low, high = self.span_ns or (self._last_ns, self._last_ns)
        self.span_ns = min(low, int(stamps.min())), max(high, int(stamps.max()))

    def _made(self, batch: Batch, origin: Origin | None) -> dict[str, NDArray]:
        """The columns that are made of others."""
        made: dict[str, NDArray] = {}
        if self.mapping.geodetic is not None:
            latitude, longitude, altitude = self._places(batch, self.mapping.geodetic)
            self._check_place(latitude, longitude)
            # without an origin there is no place either: all are NaN
            touch = (0.0, 0.0, 0.0) if origin is None else tuple(dict(origin).values())
            made |= zip(_PLACE, into_tangent_plane((latitude, longitude, altitude), touch), strict=True)
        if self.mapping.attitude is not None:
            made |= zip(_QUATERNION, self._quaternion(batch, self.mapping.attitude).T, strict=True)
        return made

    def _quaternion(self, batch: Batch, own: Attitude) -> NDArray:
        """Orientations (n, 4), NaN where an angle is missing."""
        names = (own.heading or own.yaw, own.pitch, own.roll)
        factor = conversion(own.unit, "angle_rad")
        angles = np.stack(
            [
                np.zeros(_size(batch)) if name is None else self._floats(batch, name) * factor
                for name in names
            ],
            axis=1,
        )
        if own.heading is not None:
            angles = angles * (-1, -1, 1) + (np.pi / 2, 0, 0)
        known = np.isfinite(angles).all(axis=1)
        quaternion = np.full((len(angles), 4), np.nan)
        quaternion[known] = Rotation.from_euler("ZYX", angles[known]).as_quat(scalar_first=True)
        return quaternion

    def _stream(
        self,
        own: TableStream,
        batch: Batch,
        made: Mapping[str, NDArray],
        stamps: Stamps,
        logged: Stamps,
        timed: NDArray[np.bool_],
        origin: Origin | None,
    ) -> Stream:
        topic = self._filled(own.topic)
        where = f"{self.path}: {topic}"

        def read(source: str) -> NDArray:
            if source in made:
                return made[source]
            if self._is_given(source):
                return np.full(_size(batch), self._number_of(source))
            return self._floats(batch, source)

        def holds(source: str, values: Sequence[Source]) -> NDArray[np.bool_]:
            if any(isinstance(value, str) for value in values):
                texts = pc.utf8_trim_whitespace(batch[self.table.column(source)].cast(pa.string()))
                return np.asarray(pc.is_in(texts, pa.array(map(str, values))))
            return np.isin(self._floats(batch, source), values)

        schema = schema_of(own, where)
        found = mapped(own, _size(batch), read, holds, where)
        keep = timed[found.rows]
        dropped = {**found.dropped, "NaN or infinite": not_finite(schema, found.columns)}
        for reason, which in dropped.items():
            self._tell(topic, f"messages left out: {reason}", int((which & keep).sum()))
            keep = keep & ~which
        rows = np.flatnonzero(keep)[: 1 if own.only_first else None]
        of = found.rows[rows]
        self.messages[own.topic] += len(rows)
        metadata = own.metadata
        if own.delay_s:
            metadata["delay_s"] = repr(own.delay_s)
        is_in_plane = self.mapping.geodetic is not None and own.becomes in _IN_PLANE
        if origin is not None and (is_in_plane or own.becomes == "GeodeticFix"):
            metadata |= {f"origin_{name}": repr(value) for name, value in origin}
        return make_stream(
            topic,
            schema,
            stamps[of] - round(own.delay_s * 1e9),
            log_time_ns=logged[of],
            sensor_time_ns=stamps[of],
            metadata=metadata,
            **{name: checked(where, name, column[rows]) for name, column in found.columns.items()},
        )

    def _filled(self, text: str) -> str:
        for name, value in self._names.items():
            text = text.replace(f"{{{name}}}", value)
        return text

    def _number_of(self, source: str) -> float:
        text = self._filled(source)
        try:
            return float(text)
        except ValueError:
            raise BadInput(f"{self.path}: {source} is '{text}' of its name, and no number") from None

    def _tell(self, subject: str, fact: str, count: int) -> None:
        if count:
            self._told[subject, fact] += count

    def notes(self) -> dict[str, str]:
        """What was read of the file."""
        topics = ", ".join(self._filled(stream.topic) for stream in self.mapping.streams)
        notes = {self.path.name: f"{self.count} rows as {topics}"}
        used = {*self._texts, *self._numbers}
        if rest := [name for name in self.table.columns if name not in used]:
            notes[f"{self.path.name}: columns not taken"] = ", ".join(rest)
        for reason, count in self.table.left_out.items():
            notes[f"{self.path.name}: {'rows left out, ' * bool(count)}{reason}"] = str(count or "")
        return notes


def _size(batch: Batch) -> int:
    return len(next(iter(batch.values())))


def read(path: Path, parameters: TableParameters) -> Blocks:
    """Read tables block by block; what is left out, doubtful or not taken is told in the notes.

    The blocks raise BadInput where a file or the mapping cannot be used, or a value cannot be: latitudes
    beyond 90 deg, quaternions that are not unit, tables of several clocks.
    """
    if not parameters.mapping:
        raise BadInput(
            f"{path}: say what its columns are with --mapping, a file or one of {', '.join(shipped())}; "
            "--guess -o FILE.toml writes a mapping to start from"
        )
    found = Blocks(iter(()))
    found.blocks = _blocks([path, *map(Path, parameters.more)], read_mapping(parameters.mapping), found)
    return found


def _blocks(paths: list[Path], mapping: LogMapping, told: Blocks) -> Iterator[list[Stream]]:
    for path in paths:
        if not path.exists():
            raise BadInput(f"{path}: no such file or folder; give the tables to import")
    files, others = find_files(mapping, paths)
    counts: Counter[tuple[str, str]] = Counter()
    sources = [_Rows(file, counts) for file in files]
    firsts = {source: first for source in sources if (first := source.first_ns()) is not None}
    if not firsts:
        raise BadInput(f"{paths[0]}: no row of it has a time; nothing can be imported")
    told.epoch_ns = min(firsts.values())
    _check_clocks(firsts, mapping.clock_tolerance_s)
    origin = mapping.origin or next(filter(None, (source.first_fix() for source in sources)), None)
    yield [_constant(each, told.epoch_ns) for each in mapping.constants]
    # the file that is furthest behind comes next, so that the log is nearly in the order of time
    queue = [
        (first, number) for number, first in enumerate(map(firsts.get, sources)) if first is not None
    ]
    heapq.heapify(queue)
    while queue:
        _, number = heapq.heappop(queue)
        source = sources[number]
        yield source.block(origin)
        if not source.is_done:
            heapq.heappush(queue, (source.reached_ns, number))
    if not any(source.messages.total() for source in sources):
        facts = "; ".join(f"{topic}: {fact}" for topic, fact in counts)
        raise BadInput(f"{paths[0]}: nothing of it could be imported: {facts or 'it has no rows'}")
    spans = [source.span_ns for source in sources if source.span_ns]
    begin, end = min(low for low, _ in spans), max(high for _, high in spans)
    told.notes["clock"] = " to ".join(f"{pd.Timestamp(stamp)}" for stamp in (begin, end))
    if origin is not None:
        kind = "" if mapping.origin else ", the first fix"
        told.notes["origin"] = (
            f"{origin.latitude_deg:.9g}, {origin.longitude_deg:.9g} deg, {origin.altitude_m:.6g} m{kind}"
        )
    for source in sources:
        told.notes.update(source.notes())
    for (subject, fact), count in counts.items():
        told.notes[f"{subject}: {fact}"] = str(count)
    if others:
        told.notes["files not taken"] = ", ".join(sorted({other.name for other in others}))


def _check_clocks(firsts: Mapping[_Rows, int], tolerance_s: float) -> None:
    """Raise BadInput where files begin so far apart that their clocks have nothing in common."""
    early, late = min(firsts, key=lambda each: firsts[each]), max(firsts, key=lambda each: firsts[each])
    apart_s = (firsts[late] - firsts[early]) * 1e-9
    if apart_s > tolerance_s:
        raise BadInput(
            f"mixed time bases: {early.path} begins {apart_s:.6g} s before {late.path}; give unit, zero "
            "and utc_offset_h of their times, or a larger clock_tolerance_s in the mapping"
        )


def _constant(own: ConstantStream, time_ns: int) -> Stream:
    """The messages of a mapping itself."""

    def never(source: str, *_: object) -> NDArray:
        raise AssertionError(source)

    schema = schema_of(own.mapping, own.topic)
    found = mapped(own.mapping, 1, never, never, own.topic)
    columns = {name: checked(own.topic, name, column) for name, column in found.columns.items()}
    times = np.full(len(found.rows), time_ns)
    return make_stream(own.topic, schema, times, metadata=own.mapping.metadata, **columns)


TABLE = Importer(
    "tables by a mapping: CSV, TSV, Parquet, JSON lines, .npz, RTKLIB .pos, TUM, KITTI, EuRoC",
    TableParameters,
    read,
)
