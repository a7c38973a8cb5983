"""Reader of NumPy archives (.npz) as columns, block by block, so that no whole array is in memory."""

import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput, some_of

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class _Array(NamedTuple):
    """An array in an archive.

    Attributes:
        member: name in the archive.
        begin: offset of the values in the member.
        shape, kind: shape and dtype.
        by_column: whether columns are stored one after the other, in Fortran order.
    """

    member: str
    begin: int
    shape: tuple[int, ...]
    kind: np.dtype
    by_column: bool

    @property
    def width(self) -> int:
        """Count the columns."""
        return self.shape[1] if len(self.shape) == 2 else 1


class _Column(NamedTuple):
    """A column: its array, and its index in that array."""

    array: _Array
    number: int


class Columns(NamedTuple):
    """The columns of an archive: their names, and a function that reads some of them, block by block."""

    names: list[str]
    read: Callable[[Collection[str]], Iterator[dict[str, NDArray]]]


def columns_of(path: Path, most_columns: int, block_bytes: int) -> Columns:
    """Describe the arrays of an archive as columns; two-dimensional ones are NAME.0, NAME.1, ...

    Raises BadInput if the arrays' lengths differ, and ValueError if the archive is damaged, has too many
    columns, or has values that are too large.
    """
    with _archive(path) as archive:
        arrays = {name.removesuffix(".npy"): _described(archive, name) for name in archive.namelist()}
    lengths = {each.shape[:1] for each in arrays.values()}
    if len(lengths) != 1 or any(len(each.shape) not in (1, 2) for each in arrays.values()):
        found = some_of([f"{name} {each.shape}" for name, each in arrays.items()]) or "none"
        raise BadInput(
            f"{path}: its arrays are not columns of one length ({found}); save arrays of the same length"
        )
    width = sum(each.width for each in arrays.values())
    if width > most_columns:
        raise ValueError(f"it has {width} columns; at most {most_columns} can be read")
    columns = {
        f"{name}.{index}" if len(array.shape) == 2 else name: _Column(array, index)
        for name, array in arrays.items()
        for index in range(array.width)
    }
    ((rows,),) = lengths

    def read(wanted: Collection[str]) -> Iterator[dict[str, NDArray]]:
        chosen = {name: columns[name] for name in wanted}
        row_bytes = sum(each.array.kind.itemsize * each.array.width for each in chosen.values())
        if row_bytes > block_bytes:
            raise ValueError(f"its rows have {row_bytes} bytes; at most {block_bytes} can be read")
        step = block_bytes // max(row_bytes, 1)
        with _archive(path) as archive, ExitStack() as stack:
            # one open file for an array, or for each of its columns if they are stored one after the
            # other
            files: dict[_Column | _Array, IO[bytes]] = {}
            for column in chosen.values():
                if _source(column) not in files:
                    file = stack.enter_context(archive.open(column.array.member))
                    files[_source(column)] = file
                    skipped = column.number * rows if column.array.by_column else 0
                    file.seek(column.array.begin + skipped * column.array.kind.itemsize)
            for begin in range(0, rows, step):
                count = min(step, rows - begin)
                blocks = {source: _block(source, file, count) for source, file in files.items()}
                yield {
                    name: blocks[_source(each)][:, 0 if each.array.by_column else each.number]
                    for name, each in chosen.items()
                }

    return Columns(list(columns), read)


def _source(column: _Column) -> _Column | _Array:
    return column if column.array.by_column else column.array


def _block(source: _Column | _Array, file: IO[bytes], count: int) -> NDArray:
    """Read the next rows (count, width) of an array, or of one of its columns."""
    array, width = (source.array, 1) if isinstance(source, _Column) else (source, source.width)
    content = file.read(count * width * array.kind.itemsize)
    if len(content) < count * width * array.kind.itemsize:
        raise ValueError(f"{array.member} ends early")
    values = np.frombuffer(content, array.kind).reshape(count, width)
    return values.astype(array.kind.newbyteorder("="), copy=False)


def _described(archive: zipfile.ZipFile, member: str) -> _Array:
    """Read the header of an array."""
    with archive.open(member) as file:
        version = npy.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"{member} has NumPy's format version {version}, which is not supported")
        shape, by_column, kind = _HEADERS[version](file)
        if kind.hasobject or kind.names is not None or kind.itemsize == 0:
            raise ValueError(f"{member} holds {kind}, not numbers")
        return _Array(member, file.tell(), shape, kind, bool(by_column and len(shape) == 2))


@contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; convert its errors to ValueError."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise ValueError(error) from None
