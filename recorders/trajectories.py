"""Readers and writers of trajectories in the formats of benchmarks: TUM, KITTI and (read only) EuRoC.

A line of a TUM file has the time (s), the position and the quaternion x, y, z, w. A line of a KITTI file
has the upper three rows of a pose's matrix, without a stamp. A line of a EuRoC file has, separated by
commas, the time (ns), the position, the quaternion w, x, y, z, and further columns that are not part of
the pose. TUM files may also have commas; the stamps then distinguish them from EuRoC files. If both
formats remain possible, the file is rejected.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput, choices

Floats = NDArray[np.float64]
Format = Literal["tum", "kitti", "euroc"]

# Tolerance for the length of quaternions and the orthogonality of matrices, which are printed numbers.
TOLERANCE = 1e-3
# A quaternion farther from unit length than this is not just rounded.
NEARLY = 0.1
# Stamps in s end in 2262. Steps in s are below the second of these, steps in ns above the third.
MOST_S, SLOWEST_S, FASTEST_NS = 9.2e9, 1e4, 1e6
_NO_NS = "has a stamp that is not a whole number of ns; --format tum reads seconds"
# Squares of larger positions, and sums of them, may overflow.
FARTHEST_M = 1e100
# For the last line of a text: a number that is cut off is still a number.
NO_END = "the last line does not end with a newline, so it may be truncated; it was read as it is"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a body in the order of time.

    Attributes:
        name: name in messages.
        position_m: (n, 3).
        rotation: (n, 3, 3) rotations from the body's frame to the frame of the positions, with all
            digits of the source; None if there are no orientations.
        time_ns: (n,), or None if there are no stamps.
        notes: sentences on the format that was found, and on corrected or doubtful data.
    """

    name: str
    position_m: Floats
    rotation: Floats | None = None
    time_ns: NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.position_m)
        expected = {"position_m": (count, 3), "rotation": (count, 3, 3), "time_ns": (count,)}
        for what, shape in expected.items():
            values = getattr(self, what)
            if values is not None and values.shape != shape:
                raise BadInput(f"{self.name}: {what} has shape {values.shape}; expected {shape}")
        if np.any(np.abs(self.position_m) > FARTHEST_M):
            raise BadInput(
                f"{self.name}: has a position beyond {FARTHEST_M:g} m, which cannot be compared; remove "
                "such poses"
            )
        if self.time_ns is not None and np.any(np.diff(self.time_ns) < 0):
            raise BadInput(f"{self.name}: its stamps go back in time; sort the poses by time")

    def __len__(self) -> int:
        return len(self.position_m)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Trajectory":
        """Select the poses of `rows`."""
        return Trajectory(
            self.name,
            self.position_m[rows],
            None if self.rotation is None else self.rotation[rows],
            None if self.time_ns is None else self.time_ns[rows],
            self.notes,
        )


class _Layout(NamedTuple):
    """The layout of a line: a description, the smallest and largest number of cells, and its columns."""

    columns: str
    least: int
    most: float
    position: list[int]
    time_ns: Callable[[str], int | Decimal] | None = None


def _seconds_ns(text: str) -> int:
    """Read a time exactly to the nanosecond; a double would have steps of a quarter of a microsecond."""
    return round(_exact(text).scaleb(9))


def _exact(text: str) -> Decimal:
    """Read a finite number exactly; return zero if its exponent is beyond the range of Decimal."""
    try:
        return Decimal(text)
    except InvalidOperation:
        return Decimal(0)


LAYOUTS: dict[Format, _Layout] = {
    "tum": _Layout("8 numbers: time in s, position, quaternion x y z w", 8, 8, [1, 2, 3], _seconds_ns),
    "kitti": _Layout("12 numbers: the upper three rows of a matrix", 12, 12, [3, 7, 11]),
    "euroc": _Layout(
        "8 numbers or more, with commas: time in ns, position, quaternion w x y z",
        8,
        np.inf,
        [1, 2, 3],
        _exact,
    ),
}


def read_trajectory(path: str | Path, format: str | None = None) -> Trajectory:  # noqa: A002
    """Read a trajectory file; unsorted poses are sorted by time, and a note reports it.

    Args:
        path: the file; empty lines and lines that begin with # are skipped.
        format: one of `Format`; by default it is recognised from the content.

    Returns:
        The poses in the order of time; their `notes` state the format that was read, and corrections.

    Raises BadInput that names the line if the file is not a trajectory, or could have two formats.
    """
    text = _text(Path(path))
    comment, numbers, lines = _lines(path, text)
    rows = list(map(_fields, lines))
    found = _recognised(path, numbers, lines, rows) if format is None else _known(format)
    layout = LAYOUTS[found]
    values = np.empty((len(rows), layout.least))
    for row, (number, fields) in enumerate(zip(numbers, rows, strict=True)):
        if not layout.least <= len(fields) <= layout.most:
            raise BadInput(f"{path}: line {number} has {len(fields)} columns; {_wanted(found)}")
        try:
            values[row] = [float(field) for field in fields[: layout.least]]
        except ValueError as error:
            raise BadInput(f"{path}: line {number} is not a pose ({error}); {_wanted(found)}") from None
    _refuse(
        ~np.isfinite(values).all(axis=1),
        path,
        numbers,
        "has a value that is not finite; remove the line",
    )
    _check_header(path, comment, found)
    if found == "kitti":
        rotation = values.reshape(-1, 3, 4)[:, :, :3]
        off = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
        bad = (off > TOLERANCE) | (np.linalg.det(rotation) < 0)
        _refuse(bad, path, numbers, "has a matrix that is not a rotation; give an orthogonal one")
    else:
        quaternion = values[:, 4:]
        with np.errstate(over="ignore"):  # an infinite length is rejected like any other
            norm = np.linalg.norm(quaternion, axis=1)
        bad = np.abs(norm - 1) > TOLERANCE
        remedy = (
            "scale it to 1"
            if np.all(np.abs(norm - 1) < NEARLY)
            else f"check what it is; {_wanted(found)}"
        )
        _refuse(bad, path, numbers, f"has a quaternion that is not of unit length; {remedy}")
        rotation = Rotation.from_quat(quaternion, scalar_first=found == "euroc").as_matrix()
    position_m = values[:, layout.position]
    note = f"{path}: read as {found.upper().replace('EUROC', 'EuRoC')} ({layout.columns})"
    notes = (note,) if text.endswith("\n") else (note, f"{path}: {NO_END}")
    if layout.time_ns is None:
        return Trajectory(str(path), position_m, rotation, notes=notes)
    stamps: list[int | Decimal] = [layout.time_ns(fields[0]) for fields in rows]
    beyond = [not -(2**63) < stamp < 2**63 for stamp in stamps]
    _refuse(beyond, path, numbers, f"has a stamp beyond the year 2262; {_wanted(found)}")
    _refuse([stamp != int(stamp) for stamp in stamps], path, numbers, _NO_NS)
    time_ns = np.array(list(map(int, stamps)), np.int64)
    return _in_order(str(path), position_m, rotation, time_ns, notes)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror}; give a trajectory file") from None
    except UnicodeDecodeError:
        raise BadInput(f"{path}: is not a text file; give a trajectory as TUM, KITTI or EuRoC") from None


def _lines(path: object, text: str) -> tuple[str, list[int], list[str]]:
    """Return the last comment before the poses, and the numbers and texts of the lines with content."""
    comment = ""
    numbers: list[int] = []
    lines: list[str] = []
    for number, line in enumerate(text.split("\n"), 1):
        if line.lstrip().startswith("#"):
            comment = comment if lines else line
        elif line.strip():
            numbers.append(number)
            lines.append(line.strip())
    if not lines:
        raise BadInput(f"{path}: has no poses; give a trajectory as TUM, KITTI or EuRoC")
    return comment, numbers, lines


def _fields(line: str) -> list[str]:
    return re.split(r"\s*,\s*|\s+", line)


def _recognised(
    path: object, numbers: Sequence[int], lines: Sequence[str], rows: Sequence[Sequence[str]]
) -> Format:
    """Recognise the format from the columns of the first pose and the stamps of all poses.

    Raises BadInput if the format is unknown, or if the poses could have two formats.
    """
    count, has_commas = len(rows[0]), "," in lines[0]
    if count == LAYOUTS["kitti"].least and not (has_commas and _unit(rows) == "ns"):
        return "kitti"
    if count >= LAYOUTS["tum"].least and (count == LAYOUTS["tum"].least or has_commas):
        unit = _unit(rows)
        if count == LAYOUTS["tum"].least and (unit == "s" or not (unit or has_commas)):
            return "tum"
        if unit == "ns" and has_commas:
            return "euroc"
        if not unit:
            raise BadInput(
                f"{path}: its stamps, from {rows[0][0]} to {rows[-1][0]}, may be in s or ns; give "
                '--format tum or --format euroc; in a mapping, format = "tum" or "euroc"'
            )
        if unit == "ns":
            raise BadInput(
                f"{path}: its stamps are in ns, and it has no commas, unlike EuRoC: give --format euroc "
                "if the quaternion's w is first; otherwise import it as a table, with a mapping"
            )
        if unit != "s":
            raise BadInput(
                f"{path}: its stamps are in {unit}, but TUM has s and EuRoC ns; import it as a table, "
                "with a mapping"
            )
    layouts = "; ".join(f"{name} has {layout.columns}" for name, layout in LAYOUTS.items())
    numbered = "its first column numbers the poses, so remove it; or " if _is_numbered(rows) else ""
    raise BadInput(
        f"{path}: line {numbers[0]} is not a pose: it has {count} columns, but {layouts}; "
        f"{numbered}import a table with other columns by fuselog import table"
    )


def _unit(rows: Sequence[Sequence[str]]) -> str:
    """Infer the unit of stamps (s, ms, us, ns) from size and steps; return "" if it is ambiguous.

    Poses are assumed to be at most three hours apart, and to have a rate of at most 1 kHz. Dates in ms
    and us are from 2001 to 2033.
    """
    try:
        stamps = np.array([float(fields[0]) for fields in rows])
    except ValueError:
        return "s"  # the reader of seconds then names the line
    steps = np.abs(np.diff(stamps))
    typical, usual = float(np.median(stamps)), float(np.median(steps[steps > 0] if steps.any() else 0))
    if 1e15 < typical < 2e15 or (1e12 < typical < 2e12 and usual < FASTEST_NS):
        return "us" if typical > 1e13 else "ms"
    if typical > MOST_S:
        return "ns"
    if np.any(stamps % 1.0) or 0.0 < usual < SLOWEST_S:
        return "s"
    return "ns" if usual > FASTEST_NS else ""


def _is_numbered(rows: Sequence[Sequence[str]]) -> bool:
    """Test whether the first column counts the poses, from 0 or 1."""
    first = [fields[0] for fields in rows]
    return first in ([str(row + begin) for row in range(len(rows))] for begin in (0, 1))


def _check_header(path: object, comment: str, name: Format) -> None:
    """Raise BadInput if column names in a comment state another order of the quaternion."""
    places = [re.search(rf"\bq\w*?_?{axis}\b", comment.lower()) for axis in "wx"]
    first, second = (place.start() if place else -1 for place in places)
    if name != "kitti" and min(first, second) >= 0 and (first < second) != (name == "euroc"):
        raise BadInput(
            f"{path}: its header has the quaternion's w {'first' if first < second else 'last'}, but "
            f"{_wanted(name)}; give another --format, or use fuselog import table with a mapping"
        )


def _known(name: str) -> Format:
    for each in get_args(Format):
        if name == each:
            return each
    raise BadInput(f"no trajectory format '{name}'; {choices(name, get_args(Format))}")


def _wanted(name: Format) -> str:
    return f"{name} has {LAYOUTS[name].columns}"


def _refuse(bad: ArrayLike, path: object, numbers: Sequence[int], what: str) -> None:
    if np.any(bad):
        raise BadInput(f"{path}: line {numbers[int(np.argmax(bad))]} {what}")


def _in_order(
    name: str,
    position_m: Floats,
    rotation: Floats,
    time_ns: NDArray[np.int64],
    notes: tuple[str, ...],
) -> Trajectory:
    steps = np.diff(time_ns)
    if not len(steps) or steps.min() > 0:
        return Trajectory(name, position_m, rotation, time_ns, notes)
    back, again = int((steps < 0).sum()), len(time_ns) - len(np.unique(time_ns))
    notes = (*notes, f"{name}: {back} stamps go back in time, {again} repeat; the poses were sorted")
    order = np.argsort(time_ns, kind="stable")
    return Trajectory(name, position_m[order], rotation[order], time_ns[order], notes)


def tum_lines(trajectory: Trajectory) -> list[str]:
    """Format poses as lines of a TUM file, with all digits; the identity replaces missing rotations."""
    assert trajectory.time_ns is not None
    seconds = (f"{Decimal(time).scaleb(-9):f}" for time in trajectory.time_ns.tolist())
    quaternion = Rotation.from_matrix(_rotation(trajectory)).as_quat()
    poses = np.hstack([trajectory.position_m, quaternion]).tolist()
    return [f"{time} {' '.join(map(repr, pose))}" for time, pose in zip(seconds, poses, strict=True)]


def kitti_lines(trajectory: Trajectory) -> list[str]:
    """Format poses as lines of a KITTI file, with all digits; missing rotations become the identity."""
    matrix = np.concatenate([_rotation(trajectory), trajectory.position_m[:, :, None]], axis=2)
    return [" ".join(map(repr, row)) for row in matrix.reshape(-1, 12).tolist()]


def _rotation(trajectory: Trajectory) -> Floats:
    count = len(trajectory)
    return np.tile(np.eye(3), (count, 1, 1)) if trajectory.rotation is None else trajectory.rotation
