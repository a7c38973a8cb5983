"""Functions that write goldens as compressed JSON, and that read and validate them."""

import base64
import json
import lzma
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    ValidationError,
    model_validator,
)

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput, check_format
from fuselog.recorders.parsing import parse_json

SUFFIX = ".golden.xz"
# Version of the format; incremented if this reader would misread new goldens.
FORMAT = 1
# Limits on a golden's text in bytes and on its values, since a small archive may unpack to far more.
MOST_BYTES, MOST_VALUES = 64 << 20, 4_000_000
# Memory limit for unpacking; the best presets of xz need a quarter of it.
_UNPACKING_BYTES = 256 << 20

Golden = dict[str, Any]


def _numbers(values: Any) -> Any:
    """Raise ValueError if values are not an array of numbers; null means NaN."""
    try:
        np.asarray(values, float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("it is not an array of numbers") from None
    return values


Numbers = Annotated[Any, AfterValidator(_numbers)]


class _Part(BaseModel):
    """A part of a golden, in which keys other than its fields are errors."""

    model_config = ConfigDict(extra="forbid")


class _Column(_Part):
    """Some rows of a column, and its number of missing values, sum and sum of squares over all rows."""

    kept: Numbers
    missing: Numbers
    sum: Numbers
    sum_of_squares: Numbers

    @model_validator(mode="after")
    def _is_of_one_shape(self) -> Self:
        shapes = [np.shape(each) for each in (self.missing, self.sum, self.sum_of_squares)]
        kept = np.shape(self.kept)
        is_empty = kept == (0,)  # without messages, the list does not show the shape of a row
        if not kept or any(shape != (shapes[0] if is_empty else kept[1:]) for shape in shapes):
            raise ValueError("its rows and its sums have different shapes")
        return self


class _Stream(_Part):
    """The stored part of one topic: its stamps, and a checksum of every row."""

    rows: NonNegativeInt
    publish_times: str
    log_times: str
    metadata: dict[str, str]
    checksums: str
    columns: dict[str, _Column]

    @model_validator(mode="after")
    def _has_rows(self) -> Self:
        checked = len(base64.b64decode(self.checksums, validate=True))
        if checked not in (0, 2 * self.rows):
            raise ValueError(f"it has {self.rows} rows, but checksums for {checked / 2:g} rows")
        for column in self.columns.values():
            if not (0 < len(column.kept) <= self.rows or len(column.kept) == self.rows == 0):
                raise ValueError(f"it cannot keep {len(column.kept)} of {self.rows} rows")
        return self


class _Run(_Part):
    """The stored part of one run: the hash of its log, and its outputs by topic."""

    input: str
    recorded: bool
    streams: dict[str, _Stream]


class _Tolerance(_Part):
    """The allowed difference of numbers, and the reason for it."""

    relative: NonNegativeFloat
    reason: str = ""
    elsewhere: bool = False


class _Settings(_Part):
    """The settings with which the runs were replayed."""

    estimators: dict[str, dict[str, Any]] = {}
    late: str | None = None
    arrival_order: bool = False
    columns: list[str] = Field(default=["*"])


class _Golden(_Part):
    """The complete content of a golden file."""

    format: int
    arithmetic: str
    settings: _Settings
    tolerances: dict[str, _Tolerance]
    runs: dict[str, _Run]
    metrics: dict[str, Numbers]


def write(path: Path, golden: Golden) -> None:
    """Write a golden, with the same bytes for equal goldens; raise BadInput if it is too large."""
    text = json.dumps(golden, sort_keys=True, separators=(",", ":")).encode()
    if not _is_small(text):
        raise BadInput(
            f"{path}: would have {len(text) / 1e6:.0f} MB of text, too much for a golden; take a part "
            "of the log with fuselog cut, or keep fewer columns with --keep"
        )
    with whole_file(path) as part:
        part.write_bytes(lzma.compress(text, preset=9))


def read(path: Path) -> Golden:
    """Read a golden; raise BadInput if it is missing, damaged or in another format."""
    try:
        golden = parse_json(_unpacked(path).decode(), constants=True)
    except FileNotFoundError:
        raise BadInput(f"{path}: no such golden; --update creates it") from None
    except (OSError, lzma.LZMAError, ValueError) as error:
        raise BadInput(
            f"{path}: is not a golden, or is damaged ({error}); --update writes a new one"
        ) from None
    if not isinstance(golden, dict) or "format" not in golden:
        raise BadInput(f"{path}: is not a golden of fuselog check; --update writes one")
    check_format(path, golden["format"], FORMAT)
    try:
        return _Golden.model_validate(golden).model_dump()
    except ValidationError as error:
        first = error.errors()[0]
        where = " ".join(map(str, first["loc"])) or "it"
        why = first["msg"].removeprefix("Value error, ")
        raise BadInput(
            f"{path}: is not a golden, or is damaged ({where}: {why}); --update writes a new one"
        ) from None


def _unpacked(path: Path) -> bytes:
    """Unpack the text; raise ValueError if it is incomplete, or too large for a golden."""
    with path.open("rb") as file:
        packed = file.read(MOST_BYTES)
    unpacking = lzma.LZMADecompressor(memlimit=_UNPACKING_BYTES)
    text = unpacking.decompress(packed, MOST_BYTES + 1)
    if not _is_small(text):
        raise ValueError("it is too large when unpacked")
    if not unpacking.eof or unpacking.unused_data:
        raise ValueError("it is incomplete or has trailing bytes")
    return text


def _is_small(text: bytes) -> bool:
    return len(text) <= MOST_BYTES and sum(map(text.count, (b",", b"[", b"{"))) <= MOST_VALUES
