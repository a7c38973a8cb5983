"""Opens files that hold tables, one like another: the names of columns, and batches of rows.

CSV and its like, Parquet, JSON lines, NumPy's .npz, solutions of RTKLIB (.pos), and the trajectories of
benchmarks. A batch has an Arrow array for each column that is asked for; memory holds one at a time.
"""

import bz2
import gzip
import lzma
import re
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.json
import pyarrow.parquet
from scipy.spatial.transform import Rotation

from recorders.errors import BadInput, choices
from recorders.importers.tables.blocks import BLOCK_BYTES, COMMENTS, Utf8, blocks_of, delimited, lines_of
from recorders.importers.tables.npz import columns_of
from recorders.parsing import DEEPEST
from recorders.trajectories import NO_END, read_trajectory

Format = Literal["csv", "parquet", "json", "npz", "rtklib", "trajectory"]
Batch = dict[str, pa.Array]
# Gives the batches with these columns, and which of them are wanted as text.
Read = Callable[[Mapping[str, bool]], Iterator[Batch]]

_SUFFIXES: dict[str, Format] = {
    ".parquet": "parquet", ".jsonl": "json", ".ndjson": "json", ".npz": "npz", ".pos": "rtklib",
}  # fmt: skip
_OPENERS: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
_BLOCK_ROWS = 1 << 17
# Arrow takes 10 kB for a column, however few rows there are.
MOST_COLUMNS = 10_000
# Of JSON, such as a quotation mark that ends no string.
_ESCAPED = re.compile(rb"\\.", re.DOTALL)
DAMAGED = (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError, pa.ArrowException)


@dataclass
class Table:
    """Reads a file's table: its columns, what was left out of its rows, mended, and is doubtful."""

    path: Path
    columns: list[str]
    _read: Read
    left_out: Counter[str] = field(default_factory=Counter)
    mended: str = ""
    doubts: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        _check_width(self.path, len(self.columns))

    def column(self, name: str) -> str:
        """Find a column by its name, or its number from 1 on; raises BadInput where there is none."""
        if name in self.columns:
            return name
        if name.isdecimal() and len(name) < 9 and 0 < int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        raise BadInput(f"{self.path}: has no column '{name}'; {choices(name, self.columns)}")

    def batches(self, numbers: Collection[str], texts: Collection[str] = ()) -> Iterator[Batch]:
        """Yield the rows with these columns, block by block.

        Empty cells are null. Raises BadInput where the file is damaged, or a cell of `numbers` is none.
        """
        try:
            yield from self._read(dict.fromkeys(numbers, False) | dict.fromkeys(texts, True))
        except BadInput:
            raise
        except DAMAGED as error:
            raise BadInput(f"{self.path}: {_reason(error, self)}") from None


def open_table(
    path: Path,
    format: Format | None = None,  # noqa: A002
    *,
    names: Sequence[str] = (),
    has_header: bool | None = None,
    delimiter: str | None = None,
    decimal: str = ".",
) -> Table:
    """Open a file that holds a table.

    Args:
        path: the file; .gz, .bz2 and .xz are decompressed.
        format: what it holds; by default its suffix tells, and CSV is what has no other.
        names: of the columns, where the file does not name them.
        has_header: whether the first line names the columns; by default its cells tell.
        delimiter: between cells; " " is for any white space. By default the first line tells.
        decimal: the mark before fractions.

    Raises BadInput where the file cannot be read, or holds no rows.
    """
    suffix = path.suffixes[-2:][0] if path.suffix in _OPENERS and len(path.suffixes) > 1 else path.suffix
    format = format or _SUFFIXES.get(suffix.lower(), "csv")  # noqa: A001
    try:
        if format == "csv":
            found = _open_text(path, names, has_header, delimiter, decimal)
        elif format == "rtklib":
            found = _open_rtklib(path)
        else:
            found = {"parquet": _open_parquet, "json": _open_json, "npz": _open_npz}.get(
                format, _open_trajectory
            )(path)
    except DAMAGED as error:
        raise BadInput(f"{path}: cannot be read as {format} ({_first_line(error)})") from None
    return found


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _reason(error: Exception, table: Table) -> str:
    """Say what Arrow says of a cell, with the column's name and the mend."""
    found = re.search(r"In CSV column #(\d+):.*invalid value '(.*)'", str(error))
    if not found:
        return f"is damaged ({_first_line(error)})"
    name = table.columns[int(found[1])]
    return f"column {name} holds '{found[2]}'; expected numbers: mend the cell, or empty it"


def open_decompressed(path: Path) -> BinaryIO:
    """Open the bytes of a file; .gz, .bz2 and .xz are decompressed."""
    opener = _OPENERS.get(path.suffix)
    return cast(BinaryIO, opener(path, "rb")) if opener else path.open("rb")


def _check_width(path: Path, width: int) -> None:
    if width > MOST_COLUMNS:
        raise BadInput(f"{path}: has {width} columns, of which at most {MOST_COLUMNS} can be read")


# Text.


def _open_text(
    path: Path, names: Sequence[str], has_header: bool | None, delimiter: str | None, decimal: str
) -> Table:
    comments: list[str] = []
    skipped = 0
    with open_decompressed(path) as file:
        for line in lines_of(file):
            text = line.decode("utf-8-sig" if skipped == 0 else "utf-8").strip("\r\n")
            if text.strip() and not line.startswith(COMMENTS):
                break
            if text.strip():
                comments.append(text.lstrip("#% "))
            skipped += 1
        else:
            raise BadInput(f"{path}: has no rows; give a table with rows")
        following = next(lines_of(file), b"").decode("utf-8")
    # the first line may be cut, as that of a logger whose file began in the middle of one
    whole = following.strip() or text
    delimiter = delimiter or next((each for each in (";", "\t", "|", ",") if each in whole), " ")
    cells = _cells(text, delimiter)
    width = max(len(cells), len(_cells(following, delimiter)))
    _check_width(path, width)
    if has_header or (has_header is None and not any(map(_is_value, cells))):
        named, skipped = cells, skipped + 1
        if not following.strip():
            raise BadInput(f"{path}: has a header line but no rows; give a table with rows")
    else:
        named = _cells(comments[-1], delimiter) if comments else []
        named = named if len(named) == width else []
    columns, left_out, doubts = _unique(names or named, width, path), Counter[str](), set[str]()

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        with open_decompressed(path) as file:
            for _ in range(skipped):
                file.readline()
            blocks = blocks_of(file, doubts)
            yield from _text_batches(blocks, columns, wanted, delimiter, decimal, left_out)

    return Table(path, columns, read, left_out, doubts=doubts)


def _cells(line: str, delimiter: str) -> list[str]:
    cells = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip().strip('"') for cell in cells]


def _is_value(cell: str) -> bool:
    """Tell whether a cell is a number or a time, as no name of a column is."""
    return bool(re.match(r"[-+]?\.?\d", cell))


def _unique(names: Sequence[str], width: int, path: Path) -> list[str]:
    """Name columns; such as are empty, come again or are lacking are numbers from 1 on."""
    if len(names) > width:
        raise BadInput(
            f"{path}: `columns` names {len(names)} columns, and the rows have {width}; name each once"
        )
    counts = Counter(names)
    padded = [*names, *[""] * (width - len(names))]
    return [name if name and counts[name] == 1 else str(number) for number, name in enumerate(padded, 1)]


def _text_batches(
    blocks: Iterator[bytes],
    columns: list[str],
    wanted: Mapping[str, bool],
    delimiter: str,
    decimal: str,
    left_out: Counter[str],
) -> Iterator[Batch]:
    def leave_out(row: pyarrow.csv.InvalidRow) -> str:
        left_out[f"of another number of cells than {row.expected_columns}"] += 1
        return "skip"

    is_spaced = delimiter == " "
    batches = pyarrow.csv.open_csv(
        Utf8(delimited(blocks) if is_spaced else blocks),
        pyarrow.csv.ReadOptions(column_names=columns, block_size=BLOCK_BYTES),
        pyarrow.csv.ParseOptions(
            delimiter="," if is_spaced else delimiter, invalid_row_handler=leave_out
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
        if decimal != ".":  # Arrow minds it in numbers alone; of texts only those are mended
            number = rf"^\s*([-+]?\d*){re.escape(decimal)}(\d+(?:[eE][-+]?\d+)?)\s*$"
            for name in wanted:
                if wanted[name]:
                    batch[name] = pc.replace_substring_regex(batch[name], number, r"\1.\2")
        for name in wanted:
            if wanted[name] and pc.any(pc.match_substring(batch[name], "\ufffd")).as_py():
                raise ValueError(f"column {name} holds text that is not UTF-8")
        yield batch


def _open_rtklib(path: Path) -> Table:
    """Open a solution of RTKLIB: its header names two columns, date and time, by one word."""
    named: list[str] = []
    with open_decompressed(path) as file:
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
    return _open_text(path, named, False, None, ".")


# Binary files, and JSON.


def _open_parquet(path: Path) -> Table:
    columns = [each.name for each in pyarrow.parquet.ParquetFile(path).schema_arrow]

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        file = pyarrow.parquet.ParquetFile(path)
        names = list({name.partition(".")[0]: None for name in wanted})
        for batch in file.iter_batches(_BLOCK_ROWS, columns=names):
            yield from _flat_batches(pa.table(batch))

    first = next(read(dict.fromkeys(columns, False)), None)
    if first is None:
        raise BadInput(f"{path}: has no rows; give a table with rows")
    return Table(path, list(first), read)


def _open_json(path: Path) -> Table:
    doubts = set[str]()

    def read(wanted: Mapping[str, bool]) -> Iterator[Batch]:
        with open_decompressed(path) as file:
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
    """Raise ValueError where JSON is nested so deeply that Arrow, which recurses, dies of it."""
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


def _open_trajectory(path: Path) -> Table:
    """Open TUM, KITTI or EuRoC: time_ns (not of KITTI), x, y, z and the quaternion qw, qx, qy, qz."""
    found = read_trajectory(path)
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
    """Take structures and lists of a table apart: NAME.PART, NAME.0, NAME.1, ..."""
    while any(pa.types.is_struct(kind) for kind in table.schema.types):
        table = table.flatten()
    for batch in table.combine_chunks().to_batches():
        columns: Batch = {}
        for name, column in _by_name(batch).items():
            if not _is_list(column.type):
                columns[name] = column
                continue
            width = pc.max(pc.list_value_length(column)).as_py() or 0
            if width + len(columns) > MOST_COLUMNS:
                raise ValueError(f"{name} has lists of {width}; at most {MOST_COLUMNS} can be read")
            if pc.min(pc.list_value_length(column)).as_py() == width:
                columns |= {f"{name}.{index}": pc.list_element(column, index) for index in range(width)}
        yield columns


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)
