"""Tables from the command line and from Python: guessed, imported, replayed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl

COUNT = 50


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A folder with an inertial unit in g and deg/s, stamped in ms, and a receiver with a gap."""
    folder = tmp_path / "drive"
    folder.mkdir()
    stamps = 1756402240961 + 10 * np.arange(COUNT)
    rows = [f"{stamp},0.01,-0.02,1.001,{20 * np.sin(row):.3f},0,1" for row, stamp in enumerate(stamps)]
    (folder / "imu.csv").write_text("timestamp,Acc_X,Acc_Y,Acc_Z,gyroX,gyroY,gyroZ\n" + "\n".join(rows))
    times = [0, 1, 2, 3, 13, 14, 14]
    fixes = [f"{1756402241 + time};50.{time:02d};8.1;{100 + time};{time}" for time in times]
    (folder / "gnss.csv").write_text("time;lat;lon;alt;speed [km/h]\n" + "\n".join(fixes))
    (folder / "photo.jpg").write_bytes(bytes(range(256)))
    (folder / "readme.md").write_text("# Drive\n\n| file | rate |\n| - | - |\n| imu.csv | 100 |\n")
    return folder


def test_a_guessed_mapping_works_as_it_is(
    fuselog: Callable[..., Any], drive: Path, tmp_path: Path
) -> None:
    """Units, rates and gaps are recognised and told in comments; a mapping is never written over."""
    mapping, out = tmp_path / "own.toml", tmp_path / "own.mcap"
    said = fuselog("import", "table", str(drive), "--guess", "-o", str(mapping))
    assert (said.code, f"--mapping {mapping}" in said.out) == (0, True)
    text = mapping.read_text()
    assert 'unit = "ms" }' in text
    assert "# 100 rows a second." in text
    assert "# 1 rows a second; 1 gaps over 5 s, the longest 10 s; 1 stamps repeat." in text
    assert 'units.specific_force_mps2 = "g"   # its median length is 1.001' in text
    assert 'units.turn_rate_radps = "deg/s"   # the largest is 2' in text
    assert "# not taken:" in text
    assert "photo.jpg" in text
    assert "readme.md: has no times" in text
    again = fuselog("import", "table", str(drive), "--guess", "-o", str(mapping))
    assert (again.code, "give another name, or remove it yourself" in again.err) == (2, True)
    assert fuselog("import", "table", str(drive), "--mapping", str(mapping), "-o", str(out)).code == 0
    log = fl.open(out)
    assert set(log) == {"/imu/inertial", "/gnss/fix", "/gnss/values"}
    assert_allclose(log["/imu/inertial"]["specific_force_mps2"][0] / 9.80665, [0.01, -0.02, 1.001])
    assert log["/imu/inertial"].publish_time_ns[1] == 1756402240_971_000_000
    assert log["/gnss/fix"]["latitude_deg"].tolist()[:2] == [50.0, 50.01]


def test_several_tables_become_one_log(fuselog: Callable[..., Any], drive: Path, tmp_path: Path) -> None:
    """Files and folders in any order; what is wrong is one sentence, and nothing is written."""
    mapping, out = tmp_path / "own.toml", tmp_path / "own.mcap"
    fuselog("import", "table", str(drive), "--guess", "-o", str(mapping))
    files = [str(drive / "gnss.csv"), str(drive / "imu.csv")]
    said = fuselog("import", "table", *files, "--mapping", str(mapping), "-o", str(out))
    assert said.code == 0
    assert "gnss.csv: stamps repeat, and are kept: 1" in said.out
    assert "origin: 50, 8.1 deg, 100 m, the first fix" in said.out
    direct = fl.import_("table", drive, mapping=str(mapping))
    assert_allclose(direct["/gnss/fix"]["altitude_m"], fl.open(out)["/gnss/fix"]["altitude_m"])
    out.unlink()
    mapping.write_text(mapping.read_text().replace('"Acc_X"', '"Acc_W"'))
    wrong = fuselog("import", "table", *files, "--mapping", str(mapping), "-o", str(out))
    assert wrong.code == 2
    assert f"{files[1]}: has no column 'Acc_W'; did you mean 'Acc_" in wrong.err
    assert not out.exists()
    none = fuselog("import", "table", *files, "-o", str(out))
    assert (none.code, "--guess -o FILE.toml writes a mapping" in none.err) == (2, True)
    words = tmp_path / "words.csv"
    words.write_text("name,colour\na,red\n")
    guess = fuselog("import", "table", str(words), "--guess", "-o", str(tmp_path / "words.toml"))
    assert (guess.code, guess.err.count("\n")) == (2, 1)
    assert "write a mapping by hand, as docs/your-log.md says" in guess.err
    assert not (tmp_path / "words.toml").exists()
    two = fuselog("import", "ros", *files, "-o", str(out))
    assert (two.code, "ros data are one file or folder" in two.err) == (2, True)
