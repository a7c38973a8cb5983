"""Search for tables in folders: single files, and sets of one-row files with a file of their times."""

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.blocks import COMMENTS, lines_of
from fuselog.recorders.importers.tables.files import open_text

# The smallest number of one-row files that are treated as one table.
_FEWEST = 3
_TEXTS = {".txt", ".csv", ".tsv", ".dat"}


class Source(NamedTuple):
    """The files of one table.

    Attributes:
        path: the first file.
        name: pattern of the names of all files.
        more: the files whose rows follow.
        stamps: the file with the times of the rows, and its name relative to the folder.
        columns: names of the columns from another file.
    """

    path: Path
    name: str
    more: tuple[Path, ...] = ()
    stamps: tuple[Path, str] | None = None
    columns: tuple[str, ...] = ()


def sources_of(files: Sequence[tuple[Path, str]]) -> list[Source]:
    """Group files with their names into tables; the one-row files of a folder are one table."""
    groups: dict[tuple[Path, str], list[tuple[Path, str]]] = {}
    for path, name in files:
        if path.suffix.lower() in _TEXTS and re.fullmatch(r"\D*\d+", path.stem):
            groups.setdefault((path.parent, path.suffix), []).append((path, name))
    joined = []
    taken: set[Path] = set()
    for (_, suffix), group in groups.items():
        if len(group) < _FEWEST or any(_count(path, 2) != 1 for path, _ in (group[0], group[-1])):
            continue
        others = [each for each in files if each not in group and each[0].suffix.lower() in _TEXTS]
        stamps = next((each for each in others if _count(each[0], len(group) + 1) == len(group)), None)
        columns, said_by = _columns(group[0][0], [path for path, _ in others])
        taken |= {path for path, _ in group} | ({stamps[0]} if stamps else set()) | said_by
        folder = group[0][1].rpartition("/")[0]
        pattern = f"{folder}/*{suffix}" if folder else f"*{suffix}"
        more = tuple(path for path, _ in group[1:])
        joined.append(Source(group[0][0], pattern, more, stamps, columns))
    return [*joined, *(Source(path, name) for path, name in files if path not in taken)]


def stamps_in(path: Path) -> list[str]:
    """Read the lines of a file of times, except blank ones."""
    with open_text(path) as file:
        lines = [line.decode("utf-8", "replace").strip() for line in lines_of(file)]
    return [line for line in lines if line]


def _count(path: Path, most: int) -> int:
    """Count the rows of a text, up to `most`; 0 if it cannot be read."""
    try:
        with open_text(path) as file:
            rows = (line for line in lines_of(file) if line.strip() and not line.startswith(COMMENTS))
            return sum(1 for _ in islice(rows, most))
    except (OSError, ValueError):
        return 0


def _columns(first: Path, others: Sequence[Path]) -> tuple[tuple[str, ...], set[Path]]:
    """Find a file that lists columns as lines `name: meaning`; return the names and the file."""
    width = len(stamps_in(first)[0].replace(",", " ").split())
    for path in others:
        try:
            named = [
                re.match(r"\s*([A-Za-z]\w*)\s*:", line) for line in islice(stamps_in(path), width + 1)
            ]
        except (OSError, ValueError, BadInput):
            continue
        if len(named) == width and all(named):
            return tuple(each[1] for each in named if each), {path}
    return (), set()
