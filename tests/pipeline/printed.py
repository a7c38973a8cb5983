"""Tables as commands print them, read back by their headings."""

import re

Row = dict[str, str]


def printed(text: str, named: str) -> list[Row]:
    """The rows, by heading, of the table with this title, or first heading; the first may be empty.

    A cell lies below its heading: it begins or ends where that does, or overlaps with it.
    """
    lines = text.splitlines()
    rules = (at for at, line in enumerate(lines) if line.startswith("─"))
    at = next(
        at for at in rules if named in (lines[at - 2].strip(), _cells(lines[at - 1])[0][0].strip())
    )
    columns, first = _cells(lines[at - 1]), re.match(r" \S+(?: \S+)*", lines[at - 1])
    found: list[Row] = []
    for line, below in zip(lines[at + 1 :], [*lines[at + 2 :], ""], strict=True):
        if not line.startswith(" ") or below.startswith("─"):
            break
        cells = _cells(line)
        row = {} if first else {"": cells.pop(0)[0]}
        for cell in cells:
            row[max(columns, key=lambda heading: _common(cell, heading))[0]] = cell[0]
        found.append(row)
    return found


def _common(cell: re.Match[str], heading: re.Match[str]) -> float:
    """How much of a cell lies below a heading; all of it where an end of both is the same."""
    if cell.start() == heading.start() or cell.end() == heading.end():
        return float("inf")
    return min(cell.end(), heading.end()) - max(cell.start(), heading.start())


def _cells(line: str) -> list[re.Match[str]]:
    return list(re.finditer(r"\S+(?: \S+)*", line))
