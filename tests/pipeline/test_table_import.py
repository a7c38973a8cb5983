"""Tables from the command line and from Python: guessed, imported, replayed."""

import re
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl
from fuselog.recorders.importers.tables.guessing import guess

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
    assert "# 1 row a second; 1 gap over 5 s, the longest 10 s; 1 stamp repeats." in text
    assert 'units.specific_force_mps2 = "g"   # its median length is 1.001' in text
    assert 'units.turn_rate_radps = "deg/s"   # the largest is 2' in text
    assert "# not taken:" in text
    assert "photo.jpg" in text
    assert "readme.md: has no column of times" in text
    again = fuselog("import", "table", str(drive), "--guess", "-o", str(mapping))
    assert (again.code, "give another name, or remove the file yourself" in again.err) == (2, True)
    assert fuselog("import", "table", str(drive), "--mapping", str(mapping), "-o", str(out)).code == 0
    log = fl.open(out)
    assert set(log) == {"/imu/inertial", "/gnss/fix", "/gnss/values"}
    assert_allclose(log["/imu/inertial"]["specific_force_mps2"][0] / 9.80665, [0.01, -0.02, 1.001])
    assert log["/imu/inertial"].publish_time_ns[1] == 1756402240_971_000_000
    assert log["/gnss/fix"]["latitude_deg"].tolist()[:2] == [50.0, 50.01]


@pytest.mark.paper
def test_a_guess_whose_import_fails_leaves_nothing(fuselog: Callable[..., Any], tmp_path: Path) -> None:
    """So that the next try is not refused for the mapping of the first."""
    table, out = tmp_path / "drive.csv", tmp_path / "drive.mcap"
    rows = [f"{number},1.5,0.1" for number in range(200_000)]
    for last, code in (("200000,fast,0.1", 2), ("200000,1.5,0.1", 0)):
        table.write_text("\n".join(["time,speed,yaw_rate", *rows, last, ""]))
        said = fuselog("import", "table", str(table), "--guess", "-o", str(out))
        assert said.code == code, said.err
        assert (out.exists(), out.with_suffix(".toml").exists()) == 2 * (code == 0,)


@pytest.mark.paper
def test_a_guess_whose_import_is_killed_leaves_no_mapping(
    fuselog: Callable[..., Any], start_fuselog: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    """The mapping appears after the log, so that the same command goes through next time."""
    table, out = tmp_path / "drive.csv", tmp_path / "drive.mcap"
    rows = [f"{number},1.5,0.1" for number in range(300_000)]
    table.write_text("\n".join(["time,speed,yaw_rate", *rows, ""]))
    command = "import", "table", str(table), "--guess", "-o", str(out)
    with start_fuselog(*command) as running:
        while not list(tmp_path.glob(".drive.mcap.*.part")):
            assert running.poll() is None
            time.sleep(0.001)
        running.kill()
    assert {each.name for each in tmp_path.iterdir() if not each.name.startswith(".")} == {"drive.csv"}
    assert fuselog(*command).code == 0
    mapping = out.with_suffix(".toml")
    assert {*tmp_path.iterdir()} == {table, out, mapping}
    run = fl.open(out).run
    assert run is not None
    assert run.parameters["mapping"] == str(mapping)


def test_several_tables_become_one_log(fuselog: Callable[..., Any], drive: Path, tmp_path: Path) -> None:
    """Files and folders in any order; what is wrong is one sentence, and nothing is written."""
    mapping, out = tmp_path / "own.toml", tmp_path / "own.mcap"
    fuselog("import", "table", str(drive), "--guess", "-o", str(mapping))
    files = [str(drive / "gnss.csv"), str(drive / "imu.csv")]
    said = fuselog("import", "table", *files, "--mapping", str(mapping), "-o", str(out))
    assert said.code == 0
    assert "gnss.csv: stamps repeat, but are kept: 1" in said.out
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
    assert "write a mapping yourself, as docs/your-log.md explains" in guess.err
    assert not (tmp_path / "words.toml").exists()
    two = fuselog("import", "ros", *files, "-o", str(out))
    assert (two.code, "ros data are one file or folder" in two.err) == (2, True)


# Headers as their makers write them, numbers of two rows, and what comes of the first row.
GUESSED: dict[str, tuple[str, list[float], dict[str, dict[str, Any]]]] = {
    "wheels": (
        "t,speed,yaw_rate",
        [1.5, 12],
        {"/odometry Odometry": {"forward_mps": 1.5, "turn_radps": np.radians(12)}},
    ),
    "car bus": (  # 25 m/s times 3 rad/s would be seven times the acceleration of free fall
        "timestamp,vehicle_speed_kmh,gyro_z",
        [90, 3],
        {"/odometry Odometry": {"forward_mps": 25, "turn_radps": np.radians(3)}},
    ),
    "rostopic echo -p": (
        "%time,field.twist.twist.linear.x,field.twist.twist.angular.z",
        [0.5, 0.25],
        {"/odometry Odometry": {"forward_mps": 0.5, "turn_radps": 0.25}},
    ),
    "MRCLAM odometry": (
        "Time [s],forward velocity [m/s],angular velocity [rad/s]",
        [0.1, -0.2],
        {"/odometry Odometry": {"forward_mps": 0.1, "turn_radps": -0.2}},
    ),
    "MRCLAM measurements": (
        "Time [s],Subject #,range [m],bearing [rad]",
        [63, 2.5, -0.4],
        {"/range_bearing RangeBearing": {"target_id": 63, "range_m": 2.5, "bearing_rad": -0.4}},
    ),
    "MRCLAM truth": (
        "Time [s],x [m],y [m],orientation [rad]",
        [1, 2, 0.5],
        {"/truth TruthState": {"state": [1, 2, 0.5]}},
    ),
    "drone": (
        "timestamp,lat,lon,alt,ax,ay,az,gx,gy,gz,qw,qx,qy,qz",
        [47, 8.5, 400, 0, 0, 1, 0, 0, 20, 1, 0, 0, 0],
        {
            "/fix GeodeticFix": {"latitude_deg": 47, "longitude_deg": 8.5, "altitude_m": 400},
            "/inertial InertialSample": {
                "specific_force_mps2": [0, 0, 9.80665],
                "turn_rate_radps": [0, 0, np.radians(20)],
            },
            "/orientation Orientation": {"quaternion": [1, 0, 0, 0]},
        },
    ),
    "u-blox": (  # latitude and longitude in units of 1e-7 deg
        "timestamp,lat,lon",
        [47e7, 8.5e7],
        {"/fix GeodeticFix": {"latitude_deg": 47, "longitude_deg": 8.5}},
    ),
    "nothing": (
        "t,temperature,pressure",
        [20, 1013],
        {"/values VectorMeasurement": {"value": [20, 1013]}},
    ),
}


@pytest.mark.parametrize("name", GUESSED)
def test_names_of_columns_say_which_message_they_are(tmp_path: Path, name: str) -> None:
    """Each guess states its reason, and its mapping imports the table as it is, in fuselog's units."""
    header, numbers, wanted = GUESSED[name]
    table, mapping = tmp_path / "own.csv", tmp_path / "own.toml"
    rows = [",".join(map(str, [1_700_000_000 + second, *numbers])) for second in range(2)]
    table.write_text("\n".join([header, *rows]))
    text = guess([table])
    mapping.write_text(text)
    log = fl.import_("table", table, mapping=str(mapping))
    assert set(log) == {each.split()[0] for each in wanted}
    for stream, fields in wanted.items():
        topic, becomes = stream.split()
        assert re.search(rf"^# {becomes}: .*(names?|columns)\b", text, re.MULTILINE)
        for field, value in fields.items():
            assert_allclose(log[topic][field][0], value, err_msg=f"{topic} {field}")


def test_a_heading_is_guessed_by_the_path(tmp_path: Path) -> None:
    """A heading that the path shows to be clockwise from north is turned to fuselog's, from east."""
    direction = np.linspace(0, 3, 40)
    east, north = np.cumsum(np.cos(direction)), np.cumsum(np.sin(direction))
    columns = [1_700_000_000 + np.arange(40), east, north, np.degrees(np.pi / 2 - direction) % 360]
    table, mapping = tmp_path / "nav.csv", tmp_path / "nav.toml"
    np.savetxt(
        table, np.stack(columns, 1), "%.9f", ",", header="t,easting,northing,heading", comments=""
    )
    mapping.write_text(guess([table]))
    truth = fl.import_("table", table, mapping=str(mapping))["/truth"]
    assert truth.metadata["components"] == "x_m,y_m,heading_rad"
    turned = np.angle(np.exp(1j * (truth["state"][:, 2] - direction)))
    assert_allclose(turned, 0, atol=1e-6)


def test_a_guess_of_a_vehicles_tables_says_what_is_still_to_be_said(tmp_path: Path) -> None:
    """Fixes with a dilution, wheels, a truth in the plane: namespace and origin are asked for."""
    tables = {
        "gps": "stamp,latitude,longitude,hdop\n{:.3f},48.1370{},11.5750,0.87\n",
        "odom": "stamp,v,w\n{:.3f},1.2{},0.1\n",
        "truth": "stamp,x_east,y_north,yaw\n{:.3f},0.{},0.1,0.7\n",
    }
    for name, text in tables.items():
        head, row = text.split("\n", 1)
        stamps = [*range(12), 30]
        lines = [row.format(1_760_000_000 + stamp, stamp) for stamp in stamps]
        (tmp_path / f"{name}.csv").write_text(head + "\n" + "".join(lines))
    text = guess([tmp_path])
    found = re.findall(r'^becomes = "(\w+)"', text, re.MULTILINE)
    assert found == ["GeodeticFix", "Odometry", "TruthState"]
    assert "3 namespaces, /gps, /odom, /truth." in text
    assert "# [origin]" in text
    assert 'deviations.covariance_m2 = ["hdop", "hdop", "hdop"]' in text
    assert text.count("# 1 row a second; 1 gap over 5 s, the longest 19 s.") == 3
    folder, mapping = tmp_path / "one", tmp_path / "guessed.toml"
    mapping.write_text(text)
    truth = fl.import_("table", tmp_path, mapping=str(mapping))["/truth/truth"]
    assert truth.metadata["frame_id"] == "truth.csv"  # it is not in the plane of the first fix
    placed = fl.import_("table", tmp_path, mapping=str(mapping), origin=[48.137, 11.575])
    assert {placed[topic].metadata["origin_latitude_deg"] for topic in ("/truth/truth", "/gps/fix")} == {
        "48.137"
    }
    folder.mkdir()
    (tmp_path / "gps.csv").rename(folder / "gps.csv")
    mapping.write_text(guess([folder]))
    assert "namespaces" not in mapping.read_text()
    fixes = fl.import_("table", folder, mapping=str(mapping))["/fix"]
    assert_allclose(fixes["covariance_m2"][0], np.diag([1.218, 1.218, 2.436]).ravel() ** 2)


def test_a_mapping_states_noise_and_a_prior_as_the_page_shows(tmp_path: Path) -> None:
    """The channel states the densities; the reference's first row, with its deviations, is the prior."""
    page = (Path(__file__).parents[2] / "docs" / "your-log.md").read_text(encoding="utf-8")
    tables = {
        "wheels": "stamp,speed,yaw_rate\n{},1,0.1\n",
        "gps": "stamp,latitude,longitude,hdop\n{},48.137,11.575,2\n",
        "reference": "stamp,x_east,y_north,yaw\n{},1,2,0.5\n",
    }
    for name, text in tables.items():
        head, row = text.split("\n", 1)
        rows = "".join(row.format(1_760_000_000 + stamp) for stamp in range(3))
        (tmp_path / f"{name}.csv").write_text(f"{head}\n{rows}")
    blocks = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    [odometry] = [each for each in blocks if each.startswith("[[tables.streams]]") and "states" in each]
    [others] = [each for each in blocks if each.startswith("[origin]")]
    time = 'time = { column = "stamp", unit = "s" }'
    mapping = tmp_path / "drive.toml"
    mapping.write_text(f'{others}\n[[tables]]\nfiles = "wheels.csv"\n{time}\n\n{odometry}')
    log = fl.import_("table", tmp_path, mapping=str(mapping))
    assert log["/car/odometry"].metadata["forward_noise_density"] == "0.022"
    assert_allclose(log["/car/fix"]["covariance_m2"][0], np.diag([2.8, 2.8, 5.6]).ravel() ** 2)
    assert_allclose(log["/car/prior"]["mean"], [[1, 2, 0.5]])
    assert_allclose(log["/car/prior"]["covariance"][0], np.diag([1, 1, 0.01]).ravel())
