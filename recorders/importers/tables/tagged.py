"""Selection of one kind of row from receivers' logs whose lines begin with their kind."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.blocks import lines_of

_HEADER_LINES = 1000
_NOVATEL = re.compile(rb"[#%][A-Z0-9]{3,}A,")
_NMEA = re.compile(rb"[$!](G[A-Z]|BD|QZ|AI|II|HE)[A-Z]{3},")
_INSPVA = (
    "week", "seconds_of_week", "latitude", "longitude", "height", "vel_n", "vel_e", "vel_u", "roll",
    "pitch", "heading", "status",
)  # fmt: skip
_NO_SOLUTION = re.compile(
    rb",(INS_INACTIVE|INS_ALIGNING|WAITING_|DETERMINING_ORIENTATION|MOTION_DETECT|INERTIAL_SOLUTION_NOT)"
)
_INSPVA_UNITS = {
    "seconds_of_week": "s", "latitude": "deg", "longitude": "deg", "height": "m", "vel_n": "m/s",
    "vel_e": "m/s", "vel_u": "m/s", "roll": "deg", "pitch": "deg", "heading": "deg",
}  # fmt: skip


class Tagged(NamedTuple):
    """Rows of one kind: their beginnings, the marks around the cells, the columns and their units.

    `invalid` matches rows that report no solution.
    """

    what: str
    begins: tuple[bytes, ...]
    after: bytes
    before: bytes
    columns: tuple[str, ...]
    units: dict[str, str]
    invalid: re.Pattern[bytes] | None = None

    def rows(self, blocks: Iterable[bytes], left_out: Counter[str]) -> Iterator[bytes]:
        """Yield the cells of this kind's rows, block by block; count other lines."""
        for block in blocks:
            lines = block.splitlines()
            own = [line for line in lines if line.startswith(self.begins)]
            valid = [line for line in own if not (self.invalid and self.invalid.search(line))]
            if len(own) < len(lines):
                left_out[f"that are not {self.what}"] += len(lines) - len(own)
            if len(valid) < len(own):
                left_out["without a solution"] += len(own) - len(valid)
            cells = (line.partition(self.after)[2].partition(self.before)[0] for line in valid)
            yield b"".join(each + b"\n" for each in cells)


def tagged_of(file: BinaryIO, path: Path) -> Tagged | None:
    """Recognise a receiver's log by its first lines, and return the rows to read; None for other files.

    Raises BadInput if it is such a log, but without rows that can be read.
    """
    lines = [line.rstrip() for line in islice(lines_of(file), 1)]
    first = lines[0] if lines else b""
    if _NMEA.match(first):
        raise BadInput(
            f"{path}: holds NMEA sentences, which are not a table; convert them first, for example with "
            "gpsbabel -i nmea -f FILE -o unicsv -F track.csv"
        )
    if _NOVATEL.match(first):
        begins = b"#INSPVAA,", b"%INSPVASA,"
        return Tagged("INSPVAA of NovAtel", begins, b";", b"*", _INSPVA, _INSPVA_UNITS, _NO_SOLUTION)
    if not first.startswith(b"$FLYS,"):
        return None
    said = {
        tuple(cells[:2]): cells[2:]
        for line in islice(lines_of(file), _HEADER_LINES)
        if len(cells := line.decode("utf-8", "replace").strip().split(",")) > 2
    }
    names, units = said.get(("$COL", "GNSS")), said.get(("$UNIT", "GNSS"), [])
    if names is None:
        raise BadInput(
            f"{path}: is a log of a FlySight without GNSS rows; give its TRACK.CSV, or a table with one "
            "kind of rows and their names above"
        )
    of_columns = {name: unit for name, unit in zip(names, units, strict=False) if unit}
    return Tagged("GNSS of a FlySight", (b"$GNSS,",), b",", b"\r", tuple(names), of_columns)
