"""A German dump of a car's bus, with car D's numbers: imported by --guess in one command, diagnosed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl
from fuselog.pipeline.diagnosing.battery.car import FAULTS, drive
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.recorders.simulators.car import Car

BERLIN = (52.5, 13.4, 40.0)
FOOT_M = 0.3048
SPAN_S = 50.0  # of the drive
NAMES = (
    "Datum;Uhrzeit (CET);Geschwindigkeit [km/h];Gierrate [°/s];Breite [°];Länge [°];Höhe [ft];"
    "Kompass [°];Genauigkeit [ft]"
)


def dump(car: Car, place: Path) -> None:
    """A row for each message: commas in numbers, day.month.year, by the clocks of winter."""
    latitude, longitude, _ = out_of_tangent_plane((car.fix_m[:, 0], car.fix_m[:, 1]), BERLIN)
    accuracy_ft = car.fix_variance_m2**0.5 / FOOT_M
    compass_deg = np.degrees(np.pi / 2 - car.compass_rad) % 360.0
    rows = [
        (at_s, f"{3.6 * speed:.6f};{np.degrees(turn):.6f};;;;;")
        for at_s, speed, turn in zip(car.odometry_s, car.speed_mps, car.turn_radps, strict=True)
    ]
    rows += [
        (at_s, f";;{north:.9f};{east:.9f};{BERLIN[2] / FOOT_M:.3f};;{accuracy_ft:.6f}")
        for at_s, north, east in zip(car.fix_s, latitude, longitude, strict=True)
    ]
    rows += [
        (at_s, f";;;;;{angle:.4f};") for at_s, angle in zip(car.compass_s, compass_deg, strict=True)
    ]
    lines = [NAMES]
    for at_s, cells in sorted(row for row in rows if row[0] <= SPAN_S):
        minutes, milliseconds = divmod(round(1000 * at_s), 60_000)
        clock = f"05.10.2026;14:{3 + minutes:02d}:{milliseconds // 1000:02d},{milliseconds % 1000:03d}"
        lines.append(f"{clock};{cells.replace('.', ',')}")
    place.write_text("\n".join(lines) + "\n", encoding="utf-8")


def imported(car: Car, folder: Path, fuselog: Callable[..., Any]) -> Path:
    """The log of the dump, by one command."""
    log = folder / "drive.mcap"
    dump(car, folder / "drive.csv")
    said = fuselog("import", "table", folder / "drive.csv", "--guess", "-o", log)
    assert said.code == 0, said.err
    assert f"{folder / 'drive.toml'}: the guessed mapping" in said.out
    return log


def test_a_german_dump_is_imported_by_one_command(fuselog: Callable[..., Any], tmp_path: Path) -> None:
    car = drive(3)
    log = fl.open(imported(car, tmp_path, fuselog))
    assert set(log) == {"/odometry", "/fix", "/heading"}
    wheels, fixes, compass = log["/odometry"], log["/fix"], log["/heading"]
    assert_allclose(wheels["forward_mps"], car.speed_mps[: len(wheels)], atol=1e-6)
    assert_allclose(wheels["turn_radps"], car.turn_radps[: len(wheels)], atol=1e-7)
    assert np.datetime64(int(wheels.publish_time_ns[1]), "ns") == np.datetime64("2026-10-05T13:03:00.1")
    assert_allclose(fixes["altitude_m"], BERLIN[2], atol=1e-3)
    assert_allclose(fixes["covariance_m2"][0], np.diag([0.25, 0.25, 1.0]).ravel(), rtol=1e-5)
    half = 0.5 * car.compass_rad[: len(compass)]
    turned = compass["quaternion"][:, 0] * np.cos(half) + compass["quaternion"][:, 3] * np.sin(half)
    assert_allclose(np.abs(turned), 1.0, atol=1e-9)
    said = fuselog("info", tmp_path / "drive.mcap", "--json")
    assert said.json["findings"] == []


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_the_fault_of_the_dump_is_named_first(fuselog: Callable[..., Any], tmp_path: Path) -> None:
    """`test_battery.py` has all other faults, and several at once."""
    car = FAULTS["lever (2, .6) m"](drive(3))
    found = fl.diagnose(imported(car, tmp_path, fuselog), "ekf").sentences[0]
    told = {
        key: float(value) for key, _, value in (each.partition("=") for each in found.setting.split())
    }
    assert told == pytest.approx({"lever_x_m": 2.0, "lever_y_m": 0.6}, rel=0.4)
