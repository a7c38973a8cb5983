"""Trajectory files: recognised from their content, read to the last digit, refused by their line."""

import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.trajectories import Trajectory, kitti_lines, read_trajectory, tum_lines

# A pose at (1, 2, 3), turned a quarter about the vertical, and one more, not turned.
HALF = 0.7071067811865476
TUM = f"# time x y z\n1305031102.160407123 1 2 3 0 0 {HALF} {HALF}\n\n1305031103 4 5 6 0 0 0 1\n"
KITTI = "0 -1 0 1 1 0 0 2 0 0 1 3\n1 0 0 4 0 1 0 5 0 0 1 6\n"
EUROC = (
    f"#timestamp [ns], p [m], q\n1305031102160407123,1,2,3,{HALF},0,0,{HALF},9,9\n"
    "1305031103000000000,4,5,6,1,0,0,0,9,9\n"
)
QUARTER = [[[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.eye(3)]


@pytest.mark.parametrize(
    ("text", "is_timed"), [(TUM, True), (KITTI, False), (EUROC, True), ("﻿" + TUM, True)]
)
def test_formats_are_known_by_their_content(text: str, is_timed: bool, tmp_path: Path) -> None:
    path = tmp_path / "poses"
    path.write_text(text, encoding="utf-8")
    found = read_trajectory(path)
    assert_array_equal(found.position_m, [[1, 2, 3], [4, 5, 6]])
    assert found.rotation is not None
    assert_allclose(found.rotation, QUARTER, atol=1e-15)
    if is_timed:  # to the nanosecond, which a double cannot
        assert_array_equal(found.time_ns, [1305031102160407123, 1305031103000000000])
    else:
        assert found.time_ns is None


def test_poses_are_sorted_and_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "poses"
    path.write_text("".join(f"{time} {time} 0 0 0 0 0 1\n" for time in (3, 1, 1, 2)))
    found = read_trajectory(path)
    assert found.position_m[:, 0].tolist() == [1, 1, 2, 3]
    how, mended = found.notes
    assert how.startswith(f"{path}: read as TUM (8 numbers: time in s")
    assert mended == f"{path}: 1 stamps go back in time, 1 repeat; the poses were sorted"


POSE = f"1 2 3 0 0 {HALF} {HALF}"  # as TUM a quarter turn about z, as EuRoC one of 180 deg about z and y
NANOSECONDS, UPTIME_NS = 1305031102160407123, 1200_000_000_000


@pytest.mark.parametrize(
    ("begin", "step", "gap", "read_as"),
    [
        (0, 1, ",", "tum"),  # whole seconds
        (1305031102, 30, ",", "tum"),
        ("1305031102.5", "0.05", ", ", "tum"),
        (0, 50_000_000, ",", "euroc"),
        (NANOSECONDS, 5_000_000, ",", "euroc"),
        (UPTIME_NS, 50_000_000, ",", "euroc"),
        (0, 1, " ", "tum"),
        (0, 20_000, " ", "tum"),  # with spaces it is no EuRoC
        (0, 100_000, ",", "may be in s or ns; give --format tum or --format euroc"),
        (NANOSECONDS, 50_000_000, " ", "in ns, and it has no commas"),
        (1305031102160, 50, ",", "in ms"),
        (1305031102160407, 1_000_000, ",", "in us"),
    ],
)
def test_stamps_tell_one_format_from_another(
    begin: int | str, step: int | str, gap: str, read_as: str, tmp_path: Path
) -> None:
    path = tmp_path / "poses"
    stamps = [Decimal(begin) + row * Decimal(step) for row in range(9)]
    path.write_text("".join(f"{stamp}{gap}{POSE.replace(' ', gap)}\n" for stamp in stamps))
    if read_as not in ("tum", "euroc"):
        with pytest.raises(BadInput, match=re.escape(read_as)):
            read_trajectory(path)
        return
    found = read_trajectory(path)
    assert found.time_ns is not None
    assert found.rotation is not None
    unit_ns = 1 if read_as == "euroc" else 10**9
    assert found.time_ns.tolist() == [int(stamp * unit_ns) for stamp in stamps]
    assert np.allclose(found.rotation[0], QUARTER[0]) == (read_as == "tum")
    assert found.notes[0].casefold().startswith(f"{path}: read as {read_as}".casefold())


def test_a_first_column_that_numbers_the_poses_is_told(tmp_path: Path) -> None:
    path = tmp_path / "poses"
    for gap in (" ", ","):
        rows = [f"{row} {row * 0.1:.1f} {POSE}".replace(" ", gap) for row in range(1, 9)]
        path.write_text("\n".join(rows))
        with pytest.raises(BadInput, match="its first column numbers the poses, so remove it"):
            read_trajectory(path)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    rotation = Rotation.random(20, rng=generator).as_matrix()
    stamps = np.cumsum(generator.integers(1, 2**55, 20))
    made = Trajectory("made", generator.normal(size=(20, 3)) * 1e6, rotation, stamps)
    for lines, tolerance in ((tum_lines(made), 1e-15), (kitti_lines(made), 0.0)):
        path = tmp_path / "poses"
        path.write_text("\n".join(lines))
        found = read_trajectory(path)
        assert_array_equal(found.position_m, made.position_m)
        assert found.rotation is not None
        assert_allclose(found.rotation, rotation, atol=tolerance)
        assert found.time_ns is None or found.time_ns.tolist() == stamps.tolist()


@pytest.mark.parametrize(
    ("text", "format_", "words"),
    [
        ("", None, ("has no poses", "TUM, KITTI or EuRoC")),
        (
            "1 2 3\n",
            None,
            ("line 1 is not a pose", "3 columns", "tum has 8 numbers", "fuselog import table"),
        ),
        (TUM + "1305031104 4 5 6 0 0 0\n", None, ("line 5 has 7 columns", "8 numbers")),
        (TUM + "1305031104 4 5 six 0 0 0 1\n", None, ("line 5 is not a pose", "'six'")),
        (TUM + "1305031104 4 5 nan 0 0 0 1\n", None, ("line 5 has a value that is not finite",)),
        (TUM + "1305031104 4 5 6 0 0 0 1.05\n", None, ("line 5", "quaternion", "scale it to 1")),
        (TUM + "1305031104000000 4 5 6 0 0 0 1\n", None, ("line 5", "beyond the year 2262", "in s")),
        (KITTI + "1 0 0 4 0 2 0 5 0 0 1 6\n", None, ("line 3", "matrix that is not a rotation")),
        (KITTI + "1 0 0 4 0 1 0 5 0 0 -1 6\n", None, ("line 3", "matrix that is not a rotation")),
        (
            TUM.replace("\n1305031103 ", "\n1305031103.5 "),
            "euroc",
            ("line 2", "not a whole number of ns"),
        ),
        ("# t px py pz qw qx qy qz\n" + TUM.partition("\n")[2], None, ("header has", "w first")),
        (f"0.5,1,2,3,0,0,{HALF},{HALF},9\n", None, ("line 1 is not a pose", "9 columns")),
        (TUM + "1305031104 4 5 6 0 0 0 3\n", None, ("line 5", "check what it is", "x y z w")),
        (KITTI, "tum", ("line 1 has 12 columns", "tum has 8 numbers")),
        (TUM, "tmu", ("no trajectory format 'tmu'", "did you mean 'tum'")),
    ],
)
def test_what_is_no_trajectory_is_told_by_its_line(
    text: str, format_: str | None, words: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "poses"
    path.write_text(text)
    with pytest.raises(BadInput) as raised:
        read_trajectory(path, format_)
    assert all(word in str(raised.value) for word in words), raised.value


def test_what_is_no_text_is_told(tmp_path: Path) -> None:
    (tmp_path / "poses").write_bytes(b"\x89MCAP0\r\n\xff")
    for place, words in (
        (tmp_path / "poses", "is not a text file"),
        (tmp_path / "none", "No such file"),
    ):
        with pytest.raises(BadInput, match=words):
            read_trajectory(place)


def test_arrays_that_are_no_trajectory_are_refused() -> None:
    position_m = np.zeros((2, 3))
    with pytest.raises(BadInput, match=r"mine: rotation has shape \(2, 4\); expected \(2, 3, 3\)"):
        Trajectory("mine", position_m, rotation=np.zeros((2, 4)))
    with pytest.raises(BadInput, match="mine: its stamps go back"):
        Trajectory("mine", position_m, time_ns=np.array([1, 0]))


def test_a_time_whose_exponent_is_absurd_is_zero(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text(f"1e-{'9' * 25} 0 0 0 0 0 0 1\n1e-32000000 0 0 0 0 0 0 1\n")
    found = read_trajectory(tmp_path / "a.tum")
    assert found.time_ns is not None
    assert found.time_ns.tolist() == [0, 0]
