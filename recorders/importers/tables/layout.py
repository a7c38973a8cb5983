"""Recognition of a text table's layout by its first lines: delimiter, names and units of columns."""

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import BinaryIO, NamedTuple

from fuselog.recorders.importers.tables.blocks import COMMENTS, lines_of

# How many lines, and about how many bytes, are examined at most.
_LINES, _BYTES = 40, 1 << 20
_DELIMITERS = (";", "\t", "|", ",")
_QUOTED = re.compile(r'"[^"]*"')
_SEPARATOR = re.compile(r'\s*"?sep=(.)"?\s*')
NUMBER = r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?"
_TIME = r"\d{1,4}[-./:]\d{1,2}([-./: T].*)?"
_VALUE = re.compile(rf"{NUMBER}|{_TIME}|{NUMBER}[ ,;/]+{NUMBER}.*|[-+]?0[xX][0-9a-fA-F]+")
MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "inf", "-inf"}


class Layout(NamedTuple):
    """The layout of a text table.

    Attributes:
        names: names from the header, empty without a header.
        width: number of cells in a row.
        delimiter: delimiter of cells, " " for any white space.
        skipped: number of lines of the file before the rows.
        heads: lines of the header, which are not rows if they are repeated.
        units: units from a row below the header, by column; empty if there is no such row.
        above: number of lines above the header.
        is_empty: whether there are no rows below the header.
    """

    names: list[str]
    width: int
    delimiter: str
    skipped: int
    heads: tuple[bytes, ...]
    units: list[str]
    above: int
    is_empty: bool = False


class _Line(NamedTuple):
    """A line that is not a comment: its bytes, its text, and the number of the line after it."""

    content: bytes
    text: str
    end: int


def layout_of(
    file: BinaryIO, *, has_names: bool, has_header: bool | None, delimiter: str | None, skip: int
) -> Layout | None:
    """Recognise the layout of a table; return None for a file without rows.

    Args:
        file: the text.
        has_names: whether the names of columns are known, so that no header is needed.
        has_header: whether the first line names the columns; None to recognise it.
        delimiter: delimiter of cells; None to recognise it.
        skip: number of lines to skip at the start of the file.

    Raises ValueError if the header is not UTF-8.
    """
    comments: list[_Line] = []
    lines: list[_Line] = []
    for line in _joined(file, skip):
        if not lines and (found := _SEPARATOR.fullmatch(line.text)):
            delimiter = delimiter or found[1]
        elif line.content.startswith(COMMENTS):
            comments += [line] * (not lines)
        else:
            lines.append(line)
    if not lines:
        return None
    delimiter = delimiter or _delimiter([line.text for line in lines])
    rows = [cells_of(line.text, delimiter) for line in lines]
    first, is_named = _first(rows, has_header, is_searched=not skip and not has_names)
    head, below = rows[first], rows[first + 1 :]
    width = max(len(head), len(below[0]) if below else 0)
    if not is_named:
        named = cells_of(comments[-1].text.lstrip("#% "), delimiter) if comments else []
        is_header = len(named) == width
        heads: tuple[bytes, ...] = (comments[-1].content,) if is_header else ()
        begin = comments[-1].end if comments and is_header else skip
        return Layout(named if is_header else [], width, delimiter, begin, heads, [], 0)
    lines[first].content.decode()  # its names have to be UTF-8
    has_units = bool(below) and _are_units(below)
    heads = tuple(line.content for line in lines[first : first + 1 + has_units])
    begin = lines[first + has_units].end
    units = [_bare(cell) for cell in below[0]] if has_units else []
    return Layout(head, width, delimiter, begin, heads, units, first, not below)


def cells_of(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, as in RFC 4180."""
    if delimiter == " ":
        return [cell.strip('"') for cell in line.split()]
    try:
        [cells] = csv.reader([line.replace("\n", " ").replace("\r", " ")], delimiter=delimiter)
    except (csv.Error, ValueError):
        cells = line.split(delimiter)
    return [" ".join(cell.split()).strip('"') for cell in cells]


def _joined(file: BinaryIO, skip: int) -> Iterator[_Line]:
    """Yield the first lines that are not blank; a line that ends within quotation marks is continued."""
    size = count = 0
    parts: list[bytes] = []
    for number, line in enumerate(lines_of(file)):
        if number < skip:
            continue
        parts.append(line)
        if sum(part.count(b'"') for part in parts) % 2 and len(parts) < _LINES:
            continue
        content = b"".join(parts)
        text = content.decode("utf-8-sig" if number == len(parts) - 1 else "utf-8", "replace")
        parts = []
        if text.strip():
            yield _Line(content.strip(b"\r\n"), text.strip("\r\n"), number + 1)
            size, count = size + len(content), count + 1
            if size > _BYTES or count == _LINES:
                return


def _delimiter(lines: Sequence[str]) -> str:
    """Return the delimiter that gives most lines the same number of cells."""
    plain = [_QUOTED.sub("", line) for line in lines]
    alike = {}
    for each in _DELIMITERS:
        [(count, lines_with)] = Counter(line.count(each) for line in plain).most_common(1)
        if count:
            alike[each] = lines_with
    return max(alike, key=lambda each: alike[each]) if alike else " "


def _first(rows: list[list[str]], has_header: bool | None, *, is_searched: bool) -> tuple[int, bool]:
    """Return the index of the table's first line, and whether it names the columns.

    Lines above a header are not part of the table if all of them have another number of cells than the
    rows.
    """
    if has_header is not None:
        return 0, has_header
    if _names_columns(rows[0], rows[1:]):
        usual = _usual_width(rows)
        if not is_searched or len(rows[0]) == usual or len(rows) < 4:
            return 0, True
    elif not is_searched or any(_is_value(cell) for cell in rows[0][:1]):
        return 0, False
    usual = _usual_width(rows)
    for index, row in enumerate(rows[:-2]):
        if len(row) == usual > 1 and _names_columns(row, rows[index + 1 :]):
            above_is_other = all(len(other) != usual for other in rows[:index])
            return (index, True) if above_is_other else (0, _names_columns(rows[0], rows[1:]))
    return 0, _names_columns(rows[0], rows[1:])


def _usual_width(rows: list[list[str]]) -> int:
    [(width, _)] = Counter(map(len, rows[len(rows) // 3 :])).most_common(1)
    return width


def _is_value(cell: str) -> bool:
    """Test whether a cell is a number, a time or a position."""
    return _VALUE.fullmatch(cell) is not None


def _names_columns(head: list[str], below: Iterable[list[str]]) -> bool:
    """Test whether a line names columns: only words, or words above values and 1 to 3-digit numbers."""
    is_word = [not _is_value(cell) and cell.lower() not in MISSING for cell in head]
    values = [cell for cell in head if _is_value(cell)]
    if not values:
        return any(is_word)
    words_above = any(
        word and _is_value(cell) for row in below for word, cell in zip(is_word, row, strict=False)
    )
    return words_above and all(re.fullmatch(r"\d{1,3}", cell) for cell in values)


def _are_units(below: list[list[str]]) -> bool:
    """Test whether the line below the names has units or blanks above values."""
    if len(below) < 2 or any(_is_value(cell) or len(cell) > 24 for cell in below[0]):
        return False
    return any(
        unit.lower() not in MISSING and _is_value(cell)
        for row in below[1:]
        for unit, cell in zip(below[0], row, strict=False)
    )


def _bare(cell: str) -> str:
    return re.sub(r"^[\[(]\s*(.*?)\s*[\])]$", r"\1", cell)
