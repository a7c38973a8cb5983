"""Uniform access to files that contain tables: names of columns, and batches of rows.

Formats are CSV and similar texts, Parquet, JSON lines, NumPy's .npz, solutions of RTKLIB (.pos), logs of
a VBOX (.vbo), of a FlySight and of NovAtel (ASCII), and trajectories of benchmarks. A batch has an Arrow
array for each requested column; one batch at a time is in memory.
"""

import bz2
import gzip
import io
import lzma
import re
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.json
import pyarrow.parquet
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.importers.tables.blocks import (
    BLOCK_BYTES,
    Chunks,
    Tagged,
    blocks_of,
    delimited,
    joined,
    lines_of,
    tagged_of,
    utf8,
    without,
)
from fuselog.recorders.importers.tables.layout import Layout, layout_of
from fuselog.recorders.importers.tables.npz import columns_of
from fuselog.recorders.parsing import DEEPEST
from fuselog.recorders.trajectories import NO_END, read_trajectory

Format = Literal["csv", "parquet", "json", "npz", "rtklib", "trajectory", "tum", "kitti", "euroc", "vbo"]
Batch = dict[str, pa.Array]
# Yields batches of these columns; the flag of each says whether it is wanted as text.
Read = Callable[[Mapping[str, bool]], Iterator[Batch]]

_SUFFIXES: dict[str, Format] = {
    ".parquet": "parquet", ".jsonl": "json", ".ndjson": "json", ".npz": "npz", ".pos": "rtklib",
    ".vbo": "vbo",
}  # fmt: skip
_OPENERS: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
_BLOCK_ROWS = 1 << 17
# How much of a text is read to find out how its lines end.
_HEAD_BYTES = 1 << 16
# The most lines before the data of a .vbo file, and the units of a VBOX's columns.
_HEADER_LINES = 10_000
VBOX_UNITS = {
    "time": "hhmmss", "lat": "arcmin", "latitude": "arcmin", "long": "-1 arcmin",
    "longitude": "-1 arcmin", "velocity": "km/h", "heading": "deg",
}  # fmt: skip
# Arrow needs 10 kB for a column, even for few rows.
MOST_COLUMNS = 10_000
# Escapes in JSON, such as a quotation mark that does not end a string.
_ESCAPED = re.compile(rb"\\.", re.DOTALL)
DAMAGED = (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError, pa.ArrowException)


@dataclass
class Table:
    """The table in a file.

    Attributes:
        path: the file.
        columns: names of the columns.
        left_out: number of rows that were left out, by reason.
        mended: corrections that were made.
        units: units from a row of units, by column.
        doubts: doubtful facts about the rows.
        is_text: whether cells are texts; a cell with the text NaN is null.
    """

    path: Path
    columns: list[str]
    read: Read
    left_out: Counter[str] = field(default_factory=Counter)
    mended: str = ""
    units: dict[str, str] = field(default_factory=dict)
    doubts: set[str] = field(default_factory=set)
    is_text: bool = False

    def __post_init__(self) -> None:
        _check_width(self.path, len(self.columns))

    def column(self, name: str) -> str:
        """Find a column by its name, or its number from 1; raise BadInput if there is none."""
        if name in self.columns:
            return name
        if name.isdecimal() and len(name) < 9 and 0 < int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        raise BadInput(f"{self.path}: has no column '{name}'; {choices(name, self.columns)}")

    def batches(self, numbers: Collection[str], texts: Collection[str] = ()) -> Iterator[Batch]:
        """Yield batches of rows with these columns.

        Empty cells are null. Raises BadInput if the file is damaged, or a cell of `numbers` is not a
        number.
        """
        try:
            yield from self.read(dict.fromkeys(numbers, False) | dict.fromkeys(texts, True))
        except BadInput:
            raise
        except DAMAGED as error:
            raise BadInput(f"{self.path}: {_reason(error, self)}") from None


class TextOptions(NamedTuple):
    """Options for reading a text table.

    Attributes:
        names: names of the columns, if the file does not name them.
        has_header: whether the first line names the columns; by default this is recognised.
        delimiter: delimiter of cells; " " is any white space. By default it is recognised.
        decimal: the decimal mark.
        skip: number of lines at the start of the file that are not part of the table.
    """

    names: Sequence[str] = ()
    has_header: bool | None = None
    delimiter: str | None = None
    decimal: str = "."
    skip: int = 0


def open_table(
    path: Path,
    format: Format | None = None,  # noqa: A002
    options: TextOptions = TextOptions(),  # noqa: B008
    *,
    more: Sequence[Path] = (),
    split: Mapping[str, Sequence[str]] | None = None,
) -> Table:
    """Open a file that contains a table.

    Args:
        path: the file; .gz, .bz2 and .xz are decompressed.
        format: format of the file; by default it follows from the suffix, and is CSV for unknown ones.
        options: options for a text table, which the file itself does not state.
        more: text files whose lines follow those of the first.
        split: columns whose cells contain several numbers, with the names of these numbers.

    Raises BadInput if the file cannot be read, or has no rows.
    """
    suffix = path.suffixes[-2:][0] if path.suffix in _OPENERS and len(path.suffixes) > 1 else path.suffix
    format = format or _SUFFIXES.get(suffix.lower(), "csv")  # noqa: A001
    try:
        if format == "csv":
            with open_text(path) as file:
                tagged = tagged_of(file, path)
            found = _open_tagged(path, tagged) if tagged else _open_text(path, more, options)
        elif format in ("rtklib", "vbo"):
            found = _open_rtklib(path) if format == "rtklib" else _open_vbo(path)
        else:
            of_trajectory = partial(_open_trajectory, format=None if format == "trajectory" else format)
            found = {"parquet": _open_parquet, "json": _open_json, "npz": _open_npz}.get(
                format, of_trajectory
            )(path)
    except DAMAGED as error:
        raise BadInput(f"{path}: cannot be read as {format} ({_first_line(error)})") from None
    return _split_table(found, split) if split else found


def _split_table(table: Table, split: Mapping[str, Sequence[str]]) -> Table:
    """Split the cells of some columns into separate columns."""
    parts = {table.column(source): names for source, names in split.items()}
    source_of = {name: source for source, names in parts.items() for name in names}
    twice = [name for name in source_of if name in table.columns]
    if twice or len(source_of) < sum(map(len, parts.values())):
        names = ", ".join(twice or source_of)
        raise BadInput(
            f"{table.path}: `split` gives a name twice, or the name of another column: {names}"
        )

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        sources = {source_of[name]: True for name in wanted if name in source_of}
        for batch in table.read(
            {name: wanted[name] for name in wanted if name not in source_of} | sources
        ):
            made: Batch = {}
            for source in sources:
                cells = batch[source].cast(pa.string())
                found = pc.extract_regex(cells, _parts_of(parts[source]))
                lacking = int(pc.sum(pc.and_(pc.is_valid(cells), pc.is_null(found))).as_py() or 0)
                if lacking:
                    fact = f"whose cell in column {source} does not have {len(parts[source])} numbers"
                    table.left_out[fact] += lacking
                for index, name in enumerate(parts[source]):
                    made[name] = pc.struct_field(found, [index])
            yield {
                name: batch[name]
                if name not in made
                else made[name]
                if wanted[name]
                else made[name].cast(pa.float64())
                for name in wanted
            }

    columns = [each for name in table.columns for each in parts.get(name, [name])]
    return replace(table, columns=columns, read=read)


def _parts_of(names: Sequence[str]) -> str:
    """Return the regular expression for a cell that contains one number for each name."""
    return r"[\s,;]+".join(rf"(?P<p{index}>[-+]?[\d.]+(?:[eE][-+]?\d+)?)" for index in range(len(names)))


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _reason(error: Exception, table: Table) -> str:
    """Translate Arrow's error on a cell into a sentence with the column's name and a remedy."""
    found = re.search(r"In CSV column #(\d+):.*invalid value '(.*)'", str(error))
    if not found:
        return f"is damaged ({_first_line(error)})"
    name = table.columns[int(found[1])]
    return f"column {name} holds '{found[2]}'; expected numbers: correct or empty the cell"


def open_decompressed(path: Path) -> BinaryIO:
    """Open a file as bytes; .gz, .bz2 and .xz are decompressed."""
    opener = _OPENERS.get(path.suffix)
    return cast(BinaryIO, opener(path, "rb")) if opener else path.open("rb")


def open_text(path: Path) -> BinaryIO:
    """Open a text as decompressed bytes; line ends that are only CR become newlines."""
    file = open_decompressed(path)
    head = file.read(_HEAD_BYTES).strip()
    file.seek(0)
    if b"\n" in head or b"\r" not in head:
        return file
    return cast(BinaryIO, io.BufferedReader(Chunks(_with_newlines(file))))


def texts_in(path: Path) -> Iterator[str]:
    """Yield the lines of a text that are not blank."""
    with open_text(path) as file:
        for line in lines_of(file):
            if text := line.decode("utf-8", "replace").strip():
                yield text


def _with_newlines(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while chunk := file.read(BLOCK_BYTES):
            yield chunk.replace(b"\r", b"\n")


@contextmanager
def _open_joined(paths: Sequence[Path]) -> Iterator[BinaryIO]:
    """Open one file, or several files as one text."""
    if len(paths) == 1:
        with open_text(paths[0]) as file:
            yield file
        return
    yield cast(BinaryIO, io.BufferedReader(Chunks(joined(open_text, paths))))


def _check_width(path: Path, width: int) -> None:
    if width > MOST_COLUMNS:
        raise BadInput(f"{path}: has {width} columns; at most {MOST_COLUMNS} can be read")


# Text.


def _open_text(path: Path, more: Sequence[Path], options: TextOptions) -> Table:
    paths = [path, *more]
    with _open_joined(paths) as file:
        found = layout_of(
            file,
            has_names=bool(options.names),
            has_header=options.has_header,
            delimiter=options.delimiter,
            skip=options.skip,
        )
    if found is None:
        raise BadInput(f"{path}: has no rows; give a table with rows")
    if found.is_empty:
        raise BadInput(f"{path}: has a header line but no rows; give a table with rows")
    _check_width(path, found.width)
    columns, left_out = _unique(options.names or found.names, found.width, path), Counter[str]()
    doubts: set[str] = set()
    if found.above:
        left_out["that are above the names of the columns"] = found.above
    if found.units:
        left_out["that are the units of the columns"] = 1

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        with _open_joined(paths) as file:
            for _ in range(found.skipped):
                file.readline()
            blocks = blocks_of(file, doubts)
            yield from _text_batches(blocks, columns, wanted, found, options.decimal, left_out)

    units = {name: unit for name, unit in zip(columns, found.units, strict=False) if unit}
    return Table(path, columns, read, left_out, units=units, doubts=doubts, is_text=True)


def _open_tagged(path: Path, found: Tagged) -> Table:
    columns, left_out, doubts = list(found.columns), Counter[str](), set[str]()
    layout = Layout(columns, len(columns), ",", 0, (), [], 0)

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        with open_text(path) as file:
            rows = found.rows(blocks_of(file, doubts), left_out)
            first = next((block for block in rows if block), None)
            if first is None:
                raise BadInput(f"{path}: has no rows of {found.what}; give a log or a table with them")
            yield from _text_batches(chain([first], rows), columns, wanted, layout, ".", left_out)

    return Table(path, columns, read, left_out, units=found.units, doubts=doubts, is_text=True)


def _unique(names: Sequence[str], width: int, path: Path) -> list[str]:
    """Name the columns; numbers from 1 replace empty, repeated and missing names."""
    if len(names) > width:
        raise BadInput(
            f"{path}: `columns` names {len(names)} columns, but the rows have {width}; name each once"
        )
    counts = Counter(names)
    padded = [*names, *[""] * (width - len(names))]
    return [name if name and counts[name] == 1 else str(number) for number, name in enumerate(padded, 1)]


def _text_batches(
    blocks: Iterator[bytes],
    columns: list[str],
    wanted: Mapping[str, bool],
    layout: Layout,
    decimal: str,
    left_out: Counter[str],
) -> Iterator[Batch]:
    def leave_out(row: pyarrow.csv.InvalidRow) -> str:
        left_out[f"with a number of cells other than {row.expected_columns}"] += 1
        return "skip"

    is_spaced = layout.delimiter == " "
    rows = without(blocks, layout.heads, left_out)
    batches = pyarrow.csv.open_csv(
        Chunks(utf8(delimited(rows) if is_spaced else rows)),
        pyarrow.csv.ReadOptions(column_names=columns, block_size=BLOCK_BYTES),
        pyarrow.csv.ParseOptions(
            delimiter="," if is_spaced else layout.delimiter, invalid_row_handler=leave_out
        ),
        pyarrow.csv.ConvertOptions(
            column_types={
                name: pa.string() if is_text else pa.float64() for name, is_text in wanted.items()
            },
            include_columns=list(wanted),
            decimal_point=decimal,
            strings_can_be_null=True,
        ),
    )
    for batch in map(_by_name, batches):
        if (
            decimal != "."
        ):  # Arrow uses it only for numbers; texts are changed if they are numbers, or like 48,1N
            begin, end = r"[NSEWnsew]?\s*[-+]?\d*", r"\d+(?:[eE][-+]?\d+)?\s*°?\s*[NSEWnsew]?"
            number = rf"^\s*({begin}){re.escape(decimal)}({end})\s*$"
            for name in wanted:
                if wanted[name]:
                    batch[name] = pc.replace_substring_regex(batch[name], number, r"\1.\2")
        for name in wanted:
            if wanted[name] and pc.any(pc.match_substring(batch[name], "\ufffd")).as_py():
                raise ValueError(f"column {name} holds text that is not UTF-8")
        yield batch


def _open_rtklib(path: Path) -> Table:
    """Open a solution of RTKLIB; its header has one name for two columns, date and time."""
    named: list[str] = []
    with open_text(path) as file:
        for line in lines_of(file):
            if not line.startswith(b"%"):
                break
            words = line[1:].decode("utf-8", "replace").replace(",", " ").split()
            if words and words[0] in ("GPST", "UTC", "JST"):
                named = ["date", "time", *words[1:]]
    if not named:
        raise BadInput(
            f"{path}: has no header line of RTKLIB, which begins with '%  GPST'; give the .pos file as "
            "RTKLIB writes it"
        )
    return _open_text(path, (), TextOptions(named, has_header=False))


def _open_vbo(path: Path) -> Table:
    """Open a log of Racelogic's VBOX, with positions in minutes, positive to the north and west."""
    sections: dict[str, list[str]] = {}
    section: list[str] = []
    count = 0
    with open_text(path) as file:
        for line in islice(lines_of(file), _HEADER_LINES):
            count += 1
            text = line.decode("utf-8", "replace").strip()
            if text.startswith("["):
                section = sections.setdefault(text.lower(), [])
            elif text:
                section.append(text)
            if "[data]" in sections:
                break
    names = sections.get("[column names]", [""])[0].split()
    if not (names and "[data]" in sections):
        raise BadInput(
            f"{path}: has no sections [column names] and [data]; give the .vbo file as a VBOX writes it"
        )
    titles = sections.get("[header]", [])
    named = titles if len(titles) == len(names) else names
    table = _open_text(path, (), TextOptions(named, has_header=False, delimiter=" ", skip=count))
    for name, short in zip(table.columns, names, strict=False):
        if unit := VBOX_UNITS.get(short.lower()):
            table.units[name] = unit
    return table


# Binary files, and JSON.


def _open_parquet(path: Path) -> Table:
    columns = [each.name for each in pyarrow.parquet.ParquetFile(path).schema_arrow]

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        file = pyarrow.parquet.ParquetFile(path)
        names = list({_root(name, columns): None for name in wanted})
        for batch in file.iter_batches(_BLOCK_ROWS, columns=names):
            yield from _flat_batches(pa.table(batch))

    first = next(read(dict.fromkeys(columns, False)), None)
    if first is None:
        raise BadInput(f"{path}: has no rows; give a table with rows")
    units = {name: "s" for name, cells in first.items() if pa.types.is_duration(cells.type)}
    return Table(path, list(first), read, units=units)


def _root(name: str, columns: Sequence[str]) -> str:
    """Return the top-level column that contains a column; names may contain dots themselves."""
    return next(
        (each for each in columns if name == each or name.startswith(f"{each}.")), name.partition(".")[0]
    )


def _open_json(path: Path) -> Table:
    doubts = set[str]()

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        with open_text(path) as file:
            for block in blocks_of(file, doubts):
                _check_depth(block)
                for batch in _flat_batches(pyarrow.json.read_json(pa.BufferReader(block))):
                    missing = pa.nulls(len(next(iter(batch.values()))))
                    yield {name: batch.get(name, missing) for name in wanted} or batch

    first = next(read({}), None)
    if first is None:
        raise BadInput(f"{path}: has no rows; give one JSON object per line")
    return Table(path, list(first), read, doubts=doubts)


def _check_depth(block: bytes) -> None:
    """Raise ValueError if JSON is nested so deeply that Arrow, which recurses, would crash."""
    text = np.frombuffer(_ESCAPED.sub(b"__", block), np.uint8)
    outside = np.cumsum(text == ord('"'), dtype=np.uint8) % 2 == 0
    step = np.isin(text, list(b"{[")).astype(np.int32) - np.isin(text, list(b"}]"))
    if np.cumsum(step * outside).max(initial=0) > DEEPEST:
        raise ValueError(f"it is nested more than {DEEPEST} levels deep")


def _open_npz(path: Path) -> Table:
    names, read = columns_of(path, MOST_COLUMNS, BLOCK_BYTES)

    def batches(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        for block in read(wanted):
            yield {name: pa.array(column) for name, column in block.items()}

    return Table(path, names, batches)


def _open_trajectory(path: Path, format: str | None) -> Table:  # noqa: A002
    """Open TUM, KITTI or EuRoC: time_ns (except KITTI), x, y, z and the quaternion qw, qx, qy, qz."""
    found = read_trajectory(path, format)
    columns = dict(zip("xyz", found.position_m.T, strict=True))
    if found.rotation is not None:
        quaternion = Rotation.from_matrix(found.rotation).as_quat(scalar_first=True)
        columns |= dict(zip(("qw", "qx", "qy", "qz"), quaternion.T, strict=True))
    whole: Batch = {} if found.time_ns is None else {"time_ns": pa.array(found.time_ns)}
    whole |= {name: pa.array(np.ascontiguousarray(column)) for name, column in columns.items()}
    notes = [note.removeprefix(f"{path}: ") for note in found.notes]
    doubts = {NO_END} & {*notes}
    return Table(
        path,
        list(whole),
        lambda wanted: iter([{name: whole[name] for name in wanted}]),
        mended="; ".join(note for note in notes if note not in doubts),
        doubts=doubts,
    )


def _by_name(batch: pa.RecordBatch) -> Batch:
    return dict(zip(batch.schema.names, batch.columns, strict=True))


def _flat_batches(table: pa.Table) -> Iterator[Batch]:
    """Split the structures and lists of a table into columns NAME.PART, NAME.0, NAME.1, ..."""
    while any(pa.types.is_struct(kind) for kind in table.schema.types):
        table = table.flatten()
    for batch in table.combine_chunks().to_batches():
        columns: Batch = {}
        for name, column in _by_name(batch).items():
            if not _is_list(column.type):
                columns[name] = _plain(column)
                continue
            width = pc.max(pc.list_value_length(column)).as_py() or 0
            if width + len(columns) > MOST_COLUMNS:
                raise ValueError(f"{name} has lists of {width}; at most {MOST_COLUMNS} can be read")
            if pc.min(pc.list_value_length(column)).as_py() == width:
                columns |= {f"{name}.{index}": pc.list_element(column, index) for index in range(width)}
        yield columns


def _plain(column: pa.Array) -> pa.Array:
    """Convert a column to one of the few types that are read: numbers, texts, dates with a time."""
    kind = column.type
    if pa.types.is_dictionary(kind):
        return _plain(column.dictionary_decode())
    for is_such, plain in _PLAIN:
        if is_such(kind):
            return column.cast(plain)
    return column


_PLAIN: tuple[tuple[Callable[[pa.DataType], bool], pa.DataType], ...] = (
    (pa.types.is_large_string, pa.string()),
    (pa.types.is_string_view, pa.string()),
    (pa.types.is_time, pa.string()),
    (pa.types.is_date, pa.timestamp("ms")),
    (pa.types.is_decimal, pa.string()),
    (pa.types.is_boolean, pa.int8()),
)


def floats(cells: pa.Array) -> NDArray[np.float64]:
    """Convert cells (n,) to floats, NaN for empty cells; whole numbers beyond 2^53 are rounded.

    Raises pa.ArrowException if a cell contains anything else.
    """
    if pa.types.is_string(cells.type):
        cells = pc.utf8_trim_whitespace(cells)
    if pa.types.is_duration(cells.type):  # in s
        counts = cells.cast(pa.duration("ns")).cast(pa.int64())
        cells = pc.divide(counts.cast(pa.float64(), safe=False), 1e9)
    found = cells.cast(pa.float64(), safe=not pa.types.is_integer(cells.type))
    return cast(NDArray[np.float64], found.to_numpy(zero_copy_only=False))


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)
