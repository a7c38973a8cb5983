"""Reads and writes trajectories as benchmarks exchange them: TUM, KITTI and (read only) EuRoC.

A line of a TUM file is time (s), position and quaternion x, y, z, w; of a KITTI file the upper three
rows of a pose's matrix, without a stamp; of a EuRoC file, with commas, time (ns), position, quaternion
w, x, y, z, and more that is no part of the pose.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from recorders.errors import BadInput, choices

Floats = NDArray[np.float64]
Format = Literal["tum", "kitti", "euroc"]

# How far quaternions may be from unit length, and matrices from orthogonal: they are printed numbers.
TOLERANCE = 1e-3
# Squares of positions that are farther away, and their sums, may be no numbers any more.
FARTHEST_M = 1e100
# Of a text's last line; a number that is cut off is still a number.
NO_END = (
    "the last line does not end with a newline, so it may be cut off within it; it was read as it is"
)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Holds poses of a body along its way, in the order of time.

    Attributes:
        name: what to call it in a message.
        position_m: (n, 3).
        rotation: (n, 3, 3) from the body's frame to that of the positions, to as many digits as the
            source states; None where there is none.
        time_ns: (n,); None where there are no stamps.
        notes: sentences on what was mended or is doubtful.
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
                f"{self.name}: has a position beyond {FARTHEST_M:g} m, which cannot be compared; "
                "leave such poses out"
            )
        if self.time_ns is not None and np.any(np.diff(self.time_ns) < 0):
            raise BadInput(f"{self.name}: its stamps go back; sort the poses by time")

    def __len__(self) -> int:
        return len(self.position_m)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Trajectory":
        """Return the poses of `rows`."""
        return Trajectory(
            self.name,
            self.position_m[rows],
            None if self.rotation is None else self.rotation[rows],
            None if self.time_ns is None else self.time_ns[rows],
            self.notes,
        )


class _Layout(NamedTuple):
    """Describes what a line holds: a word for it, its least and most numbers, and which is the time."""

    columns: str
    least: int
    most: float
    position: list[int]
    time_ns: Callable[[str], int] | None = None


def _seconds_ns(text: str) -> int:
    """Read a time exactly to the nanosecond, where a double is to a quarter of a microsecond."""
    return round(_exact(text).scaleb(9))


def _exact(text: str) -> Decimal:
    """Read a number that is finite as a double; with an exponent beyond Decimal's, that is zero."""
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
        lambda text: int(_exact(text)),
    ),
}


def read_trajectory(path: str | Path, format: str | None = None) -> Trajectory:  # noqa: A002
    """Read a trajectory file; poses that are not in the order of time are sorted, which a note tells.

    Args:
        path: the file; lines that are empty or begin with # are passed over.
        format: one of `Format`; by default the content tells.

    Returns:
        The poses in the order of time; `notes` of them say what was mended.

    Raises BadInput that names the line where the file holds no trajectory.
    """
    text = _text(Path(path))
    numbers, lines = zip(*_lines(path, text), strict=True)
    found = _recognised(path, numbers[0], lines[0]) if format is None else _known(format)
    layout = LAYOUTS[found]
    rows = list(map(_fields, lines))
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
    if found == "kitti":
        rotation = values.reshape(-1, 3, 4)[:, :, :3]
        off = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
        bad = (off > TOLERANCE) | (np.linalg.det(rotation) < 0)
        _refuse(bad, path, numbers, "has a matrix that is not a rotation; give an orthogonal one")
    else:
        quaternion = values[:, 4:]
        bad = np.abs(np.linalg.norm(quaternion, axis=1) - 1) > TOLERANCE
        _refuse(bad, path, numbers, "has a quaternion that is not of unit length; scale it to 1")
        rotation = Rotation.from_quat(quaternion, scalar_first=found == "euroc").as_matrix()
    position_m = values[:, layout.position]
    doubts = () if text.endswith("\n") else (f"{path}: {NO_END}",)
    if layout.time_ns is None:
        return Trajectory(str(path), position_m, rotation, notes=doubts)
    stamps = [layout.time_ns(fields[0]) for fields in rows]
    beyond = [abs(stamp) >= 2**63 for stamp in stamps]
    _refuse(beyond, path, numbers, f"has a stamp beyond the year 2262; {_wanted(found)}")
    poses = _in_order(str(path), position_m, rotation, np.array(stamps, np.int64))
    return replace(poses, notes=(*poses.notes, *doubts))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror}; give a trajectory file") from None
    except UnicodeDecodeError:
        raise BadInput(f"{path}: is not a text file; give a trajectory as TUM, KITTI or EuRoC") from None


def _lines(path: object, text: str) -> list[tuple[int, str]]:
    """List the lines that hold something, with their numbers."""
    lines = [
        (number, line.strip())
        for number, line in enumerate(text.split("\n"), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise BadInput(f"{path}: has no poses; give a trajectory as TUM, KITTI or EuRoC")
    return lines


def _fields(line: str) -> list[str]:
    return re.split(r"\s*,\s*|\s+", line)


def _recognised(path: object, number: int, line: str) -> Format:
    """Find the format that the first pose looks like."""
    fields = _fields(line)
    if "," in line and fields[0].isdigit() and len(fields) >= LAYOUTS["euroc"].least:
        return "euroc"
    for name in ("tum", "kitti"):
        if len(fields) == LAYOUTS[name].least:
            return name
    layouts = "; ".join(f"{name} has {layout.columns}" for name, layout in LAYOUTS.items())
    raise BadInput(
        f"{path}: line {number} is not a pose: it has {len(fields)} columns, where {layouts}; "
        "fuselog import table makes a log of a table with other columns"
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


def _in_order(name: str, position_m: Floats, rotation: Floats, time_ns: NDArray[np.int64]) -> Trajectory:
    steps = np.diff(time_ns)
    if not len(steps) or steps.min() > 0:
        return Trajectory(name, position_m, rotation, time_ns)
    back, again = int((steps < 0).sum()), len(time_ns) - len(np.unique(time_ns))
    notes = (f"{name}: {back} stamps go back, {again} repeat; the poses were sorted",)
    order = np.argsort(time_ns, kind="stable")
    return Trajectory(name, position_m[order], rotation[order], time_ns[order], notes)


def tum_lines(trajectory: Trajectory) -> list[str]:
    """Write lines of a TUM file, with all digits; the identity stands for no rotation."""
    assert trajectory.time_ns is not None
    seconds = (f"{Decimal(time).scaleb(-9):f}" for time in trajectory.time_ns.tolist())
    quaternion = Rotation.from_matrix(_rotation(trajectory)).as_quat()
    poses = np.hstack([trajectory.position_m, quaternion]).tolist()
    return [f"{time} {' '.join(map(repr, pose))}" for time, pose in zip(seconds, poses, strict=True)]


def kitti_lines(trajectory: Trajectory) -> list[str]:
    """Write lines of a KITTI file, with all digits; the identity stands for no rotation."""
    matrix = np.concatenate([_rotation(trajectory), trajectory.position_m[:, :, None]], axis=2)
    return [" ".join(map(repr, row)) for row in matrix.reshape(-1, 12).tolist()]


def _rotation(trajectory: Trajectory) -> Floats:
    count = len(trajectory)
    return np.tile(np.eye(3), (count, 1, 1)) if trajectory.rotation is None else trajectory.rotation
