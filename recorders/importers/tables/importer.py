"""Importer of tables: a mapping turns rows into messages, and notes report what is left out."""

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import NonNegativeInt

from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.importers.mapping import (
    Place,
    Quaternions,
    checked,
    mapped,
    off_unit,
    schema_of,
    with_unit_quaternions,
)
from fuselog.recorders.importers.tables.mapping import (
    ConstantStream,
    Delay,
    LogMapping,
    Origin,
    adapted,
    find_files,
    read_mapping,
    shipped,
)
from fuselog.recorders.importers.tables.rows import Plane, ReadCounts, Rows
from fuselog.recorders.log import Stream, make_stream
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Blocks, Importer


class TableParameters(Parameters):
    """The mapping, and settings that differ between recordings.

    Attributes:
        mapping: the mapping, by its name (walk) or file (own.toml).
        more: further files and folders.
        mounting_deg: roll, pitch and yaw that replace the mapping's values.
        delays_s: by topic, the time from a message's measurement to its stamp, in s; replaces the
            delays of the mapping.
        seed: seed of the noise that a mapping adds.
        origin: latitude and longitude (deg) and optionally height (m) of the origin of the local tangent
            plane; replaces the mapping's origin.
        quaternions: what to do with messages whose quaternions are not of unit length: "refuse" stops
            the import, "normalise" scales them, "skip" leaves such messages out.
    """

    mapping: str = ""
    more: list[str] = []
    mounting_deg: tuple[float, float, float] | None = None
    delays_s: dict[str, Delay] = {}
    seed: NonNegativeInt = 0
    origin: Place | None = None
    quaternions: Quaternions = "refuse"


def read(path: Path, parameters: TableParameters) -> Blocks:
    """Read tables block by block; notes report what is left out, doubtful or not imported.

    Iterating the blocks raises BadInput if a file, the mapping or a value cannot be used: latitudes
    beyond 90 deg, quaternions that are not of unit length, tables of different clocks.
    """
    if not parameters.mapping:
        raise BadInput(
            f"{path}: state the meaning of its columns with --mapping, a file or one of "
            f"{', '.join(shipped())}; --guess -o FILE.toml writes a mapping to start from"
        )
    paths = [path, *map(Path, parameters.more)]
    for each in paths:
        if not each.exists():
            raise BadInput(f"{each}: no such file or folder; give the tables to import")
    found = Blocks(iter(()))
    mapping = adapted(read_mapping(parameters.mapping), parameters.mounting_deg, parameters.delays_s)
    if parameters.origin is not None:
        origin = Origin(**dict(zip(Origin.model_fields, parameters.origin, strict=False)))
        mapping = mapping.model_copy(update={"origin": origin})
    found.blocks = _blocks(paths, mapping, parameters, found)
    return found


def _blocks(
    paths: list[Path], mapping: LogMapping, parameters: TableParameters, result: Blocks
) -> Iterator[list[Stream]]:
    files, others = find_files(mapping, paths)
    generator = np.random.default_rng(parameters.seed)
    counts: ReadCounts = Counter()
    sources = [Rows(file, counts, generator, parameters.quaternions) for file in files]
    firsts = {
        number: first
        for number, source in enumerate(sources)
        if (first := source.first_ns()) is not None
    }
    if not firsts:
        raise BadInput(
            f"{paths[0]}: no row has a readable time, so nothing can be imported; check `time` in the "
            "mapping"
        )
    result.epoch_ns = min(firsts.values())
    _check_clocks({sources[number].path: first for number, first in firsts.items()}, mapping)
    origin = mapping.origin or next(filter(None, (source.first_fix() for source in sources)), None)
    is_stated = mapping.origin is not None
    plane = None if origin is None else Plane(origin, mapping.projection, is_stated)
    yield [_constant(each, result.epoch_ns) for each in mapping.constants]
    # the file that is furthest behind comes next, so that the log is nearly sorted by time
    queue = [(first, number) for number, first in firsts.items()]
    heapq.heapify(queue)
    while queue:
        _, number = heapq.heappop(queue)
        yield sources[number].block(plane)
        if not sources[number].is_done:
            heapq.heappush(queue, (sources[number].reached_ns, number))
    if not any(source.messages.total() for source in sources):
        facts = "; ".join(f"{topic}: {fact}" for topic, fact in counts) or "it has no rows"
        raise BadInput(f"{paths[0]}: none of its rows could be imported: {facts}")
    result.notes.update(_notes(sources, plane, mapping))
    result.notes.update({f"{subject}: {fact}": str(count) for (subject, fact), count in counts.items()})
    not_taken = {other.name for other in others} - {source.tag_name for source in sources}
    if not_taken:
        result.notes["files not taken"] = some_of(sorted(not_taken))


def _check_clocks(firsts: Mapping[Path, int], mapping: LogMapping) -> None:
    """Raise BadInput if files begin so far apart that their clocks must differ."""
    early, late = min(firsts, key=lambda each: firsts[each]), max(firsts, key=lambda each: firsts[each])
    apart_s = (firsts[late] - firsts[early]) * 1e-9
    if apart_s > mapping.clock_tolerance_s:
        raise BadInput(
            f"mixed time bases: {early} begins {apart_s:.6g} s before {late}; give unit, zero and "
            "utc_offset_h of their times, or a larger clock_tolerance_s in the mapping"
        )


def _constant(own: ConstantStream, time_ns: int) -> Stream:
    """Make the messages that are stated in a mapping."""

    def read_none(source: str, *_: object) -> NDArray:
        raise BadInput(
            f"{own.topic}: '{source}' is not a number; constants have no columns to read from"
        )

    found = mapped(own.mapping, 1, read_none, read_none, own.topic)
    off_unit(own.topic, found.columns, own.kinds, np.ones(len(found.rows), bool), "refuse")
    columns = with_unit_quaternions(found.columns, own.kinds)
    columns = {name: checked(own.topic, name, column) for name, column in columns.items()}
    times = np.full(len(found.rows), time_ns)
    schema = schema_of(own.mapping, own.topic)
    return make_stream(own.topic, schema, times, metadata=own.mapping.metadata, **columns)


def _notes(sources: list[Rows], plane: Plane | None, mapping: LogMapping) -> dict[str, str]:
    """Write notes on the clock, the origin, and what was read from each file."""
    spans = [source.span_ns for source in sources if source.span_ns is not None]
    ends = min(low for low, _ in spans), max(high for _, high in spans)
    notes = {"clock": " to ".join(str(pd.Timestamp(stamp)) for stamp in ends)}
    if plane is not None:
        here = plane.origin
        place = f"{here.latitude_deg:.9g}, {here.longitude_deg:.9g} deg, {here.altitude_m:.6g} m"
        notes["origin"] = place if mapping.origin else f"{place}, the first fix"
    for source in sources:
        notes |= source.notes()
    return notes


TABLE = Importer(
    "tables by a mapping: CSV, TSV, Parquet, JSON lines, .npz, RTKLIB .pos, .vbo, TUM, KITTI, EuRoC",
    TableParameters,
    read,
)
