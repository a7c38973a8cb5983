"""Guessed mappings of tables as loggers outside of the United States write them."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl
from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.guessing import guess

DATE = "time = { column = 't', unit = 'date'"
VALUES = "[[tables.streams]]\ntopic = '/v'\nbecomes = 'VectorMeasurement'\nfields.value = ['v']\n"


def guessed(folder: Path, text: str) -> fl.MemorySource:
    """The log of a table by what is guessed of it."""
    table, mapping = folder / "own.csv", folder / "own.toml"
    table.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
    mapping.write_text(guess([table]), encoding="utf-8")
    return fl.import_("table", table, mapping=str(mapping))


def read(folder: Path, head: str, cells: list[str]) -> list[str]:
    """The stamps of a table with these times, by a mapping with this head."""
    table, mapping = folder / "own.csv", folder / "own.toml"
    table.write_text("\n".join(["t;v", *(f"{cell};1,5" for cell in cells), ""]), encoding="utf-8")
    mapping.write_text(f"[[tables]]\ndecimal = ','\n{head}\ncomponents = 'v'\n", encoding="utf-8")
    stream = fl.import_("table", table, mapping=str(mapping))["/v"]
    assert stream["value"][0] == 1.5
    return [str(np.datetime64(int(each), "ns")) for each in stream.publish_time_ns]


def test_commas_stand_before_fractions(tmp_path: Path) -> None:
    rows = [f"{1_700_000_000 + row},25;{row},5;0,{row}" for row in range(9)]
    log = guessed(tmp_path, "\n".join(["t;speed [m/s];yaw_rate [rad/s]", *rows]))
    assert log["/odometry"]["forward_mps"][:2].tolist() == [0.5, 1.5]
    assert log["/odometry"].publish_time_ns[0] == 1_700_000_000_250_000_000


def test_a_magnetometer_beside_an_inertial_unit_is_of_its_samples_too(tmp_path: Path) -> None:
    """In gauss, every third row: orientation filters read it of the unit, headings of its own topic."""
    rows = [
        f"{row / 100},0,0,9.81,0,0,0,{'0.1,0.2,-0.4' if row % 3 == 0 else ',,'}" for row in range(60)
    ]
    log = guessed(tmp_path, "\n".join(["time,ax,ay,az,gx,gy,gz,mag_x,mag_y,mag_z", *rows]))
    for topic in ("/inertial", "/magnetic_field"):
        field = log[topic]["magnetic_field_ut"]
        assert_allclose(field[~np.isnan(field[:, 0])], np.tile([10.0, 20.0, -40.0], (20, 1)))


@pytest.mark.parametrize(
    ("cell", "stamp"),
    [
        ("05.10.2026 14:03:0{},5", "2026-10-05T14:03:00.5"),
        ("5.10.26 14:03:0{}", "2026-10-05T14:03:00"),
        ("05.10.2026, 14:03:0{}.5", "2026-10-05T14:03:00.5"),
        ("25/10/2026 14:03:0{}", "2026-10-25T14:03:00"),
        ("10/25/2026 2:03:0{} PM", "2026-10-25T14:03:00"),
        ("2026/10/05 14:03:0{}", "2026-10-05T14:03:00"),
        ("14:03:0{},5", "2026-01-01T14:03:00.5"),
    ],
)
def test_dates_are_read_as_they_are_written(tmp_path: Path, cell: str, stamp: str) -> None:
    rows = [f"{cell.format(row)};{row}.5;0.1" for row in range(9)]
    log = guessed(tmp_path, "\n".join(["when;speed;yaw_rate", *rows]))
    assert np.datetime64(int(log["/odometry"].publish_time_ns[0]), "ns") == np.datetime64(stamp)


def test_no_rate_stands_for_times_that_cannot_be_read(tmp_path: Path) -> None:
    table = tmp_path / "own.csv"
    rows = [f"{row};14:03 and {row} s;{row}.5;0.1" for row in range(20)]
    table.write_text("\n".join(["number;when;speed;yaw_rate", *rows, ""]))
    with pytest.raises(
        BadInput, match="column when holds times such as '14:03 and 0 s' in an unknown format"
    ):
        guess([table])


def test_feet_are_lengths(tmp_path: Path) -> None:
    rows = [f"{1_700_000_000 + row};48.1;11.5;1000;10" for row in range(9)]
    log = guessed(tmp_path, "\n".join(["t;lat;lon;alt [feet];accuracy_ft", *rows]))
    assert_allclose(log["/fix"]["altitude_m"], 304.8)
    assert_allclose(log["/fix"]["covariance_m2"][0, 0], 3.048**2)
    rows = [f"{1_700_000_000 + row};{row};0" for row in range(9)]
    log = guessed(tmp_path, "\n".join(["t;x_ft;y_ft", *rows]))
    assert_allclose(log["/position"]["position_m"][1], [0.3048, 0.0])


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_the_course_decides_what_a_heading_is_in(tmp_path: Path, unit: str) -> None:
    """Of three turns in rad the largest value is 20; of a straight drive in deg it is 3."""
    direction = np.linspace(0.0, 20.0, 200) if unit == "rad" else np.radians(np.linspace(1.0, 3.0, 200))
    place = np.cumsum([np.cos(direction), np.sin(direction)], axis=1)
    heading = direction if unit == "rad" else np.degrees(direction)
    rows = [
        f"{1_700_000_000 + row};{place[0, row]:.6f};{place[1, row]:.6f};{heading[row]:.6f}"
        for row in range(200)
    ]
    log = guessed(tmp_path, "\n".join(["t;x;y;yaw", *rows]))
    turned = np.angle(np.exp(1j * (log["/truth"]["state"][:, 2] - direction)))
    assert_allclose(turned, 0.0, atol=1e-6)
    assert "factors." not in (tmp_path / "own.toml").read_text(encoding="utf-8")


def test_a_decimal_comma_leaves_dates_alone(tmp_path: Path) -> None:
    head = f"{DATE}, format = '%d.%m.%Y, %H:%M:%S,%f' }}\n{VALUES}"
    assert read(tmp_path, head, ["05.10.2026, 14:03:07,5"]) == ["2026-10-05T14:03:07.500000000"]


@pytest.mark.parametrize(
    ("entry", "cell"),
    [
        (", zone = 'Europe/Berlin'", "2026-07-05 14:00:00"),
        (", zone = 'CEST'", "2026-07-05 14:00:00"),
        ("", "2026-07-05 14:00:00 MESZ"),
        ("", "2026-07-05 14:00:00 Europe/Berlin"),
    ],
)
def test_zones_have_names(tmp_path: Path, entry: str, cell: str) -> None:
    assert read(tmp_path, f"{DATE}{entry} }}\n{VALUES}", [cell]) == ["2026-07-05T12:00:00.000000000"]


def test_an_unknown_zone_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no time zone 'Europe/Berln'; give one such as Europe/Berlin"):
        read(tmp_path, f"{DATE}, zone = 'Europe/Berln' }}\n{VALUES}", ["2026-07-05 14:00:00"])


@pytest.mark.parametrize(
    "head",
    [
        "lat;lon;alt",
        "acc_x;acc_y;acc_z;gyro_x;gyro_y;gyro_z",
        "mag_x;mag_y;mag_z",
        "linear_x;linear_y;linear_z;angular_x;angular_y;angular_z",
        "vel_x;vel_y;vel_z",
        "speed;yaw_rate",
        "landmark_id;range;bearing",
        "x;y;z;qw;qx;qy;qz",
        "east;north;up",
    ],
)
def test_without_any_one_column_the_others_are_taken_once_and_in_their_order(
    tmp_path: Path, head: str
) -> None:
    """What is guessed of columns of which one is missing can be imported, and loses none of them."""
    names = head.split(";")
    near = {"acc": 5.0, "mag": 25.0, "lat": 48.0}  # sizes that tell m/s^2, uT and deg
    cells = {
        name: near.get(name[:3], 0.0) + np.linspace(0.1, 0.15, 9) + 0.1 * place
        for place, name in enumerate(names)
    }
    cells |= dict.fromkeys(("qw", "qx", "qy", "qz"), np.full(9, 0.5)) | {"landmark_id": np.arange(9)}
    for without in [None, *names]:
        kept = [name for name in names if name != without]
        rows = [
            f"{1_700_000_000 + row};" + ";".join(str(cells[name][row]) for name in kept)
            for row in range(9)
        ]
        log = guessed(tmp_path, "\n".join([";".join(["t", *kept]), *rows]))
        taken = [
            column
            for stream in log.streams.values()
            for field in stream.schema
            for column in np.atleast_2d(np.asarray(stream[field.name]).T)
            if field.kind != "time_ns" and not np.isnan(column).any()
        ]
        places = [
            [place for place, column in enumerate(taken) if np.allclose(column, cells[name], atol=1e-9)]
            for name in kept
            if name[0] != "q"
        ]
        assert all(len(each) == 1 for each in places), without
        if len(log.streams) == 1:
            assert places == sorted(places), without


@pytest.mark.parametrize("cell", ["++1", "0b1", "1.7e9e9", "\uff11\uff17"])
def test_a_cell_of_a_column_of_times_that_is_no_number_is_named(tmp_path: Path, cell: str) -> None:
    times = [str(1_700_000_000 + row) for row in range(30)]
    times[11] = cell
    with pytest.raises(BadInput, match=f"but '{re.escape(cell)}' in row 12 is not a number; correct it"):
        guessed(tmp_path, "\n".join(["t,x_m,y_m", *(f"{each},1.5,2.5" for each in times)]))
