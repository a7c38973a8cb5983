"""What is guessed of tables, for columns of every kind: the lines that state a reason.

A comment that stands by itself is told once.
"""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.guessing import guess

ROWS = np.arange(24)
# A drive to the north-north-east, whose course in degrees clockwise from north is 20.
EAST, NORTH, HEIGHT = 3.0 * np.sin(0.35) * ROWS, 3.0 * np.cos(0.35) * ROWS, 500.0 + 0.5 * ROWS
BEND = 0.01 * np.sin(ROWS)


def drives() -> Iterator[str]:
    """Places with headings, speeds with turn rates: units and directions by names, sizes and courses."""
    seconds = {"t": 1_700_000_000 + 0.5 * ROWS}
    place = {"x_m": EAST, "y_m": NORTH}
    geodetic = {"latitude": 48.1 + 1e-5 * NORTH, "longitude": 11.5 + 1.4e-5 * EAST}
    yield from _guessed(**seconds, **place, yaw=np.pi / 2 - 0.35 + BEND)
    yield from _guessed(**seconds, **place, heading=np.degrees(0.35 + BEND))
    at_rest = {"lat": 48.1 + 0.0 * ROWS, "lon": 11.5 + 0.0 * ROWS}
    for heading in ({"compass": 100.0 + BEND}, {"yaw": BEND}, {"hdg_deg": BEND}):
        yield from _guessed(**seconds, **at_rest, **heading)
    yield from _guessed(**seconds, **geodetic, **{"alt [ft]": HEIGHT}, heading=np.degrees(0.35 + BEND))
    yield from _guessed(**seconds, **geodetic, yaw=np.pi / 2 - 0.35 + 3.0 * BEND, hdop=1.0 + BEND)
    yield from _guessed(
        **seconds, lat=0.84 + 0.0 * ROWS, lon=0.2 + 1e-6 * EAST, sd_e_ft=BEND, sd_n=BEND, sd_u=BEND
    )
    yield from _guessed(**seconds, lat=4.8e8 + ROWS, lon=1.1e8 + ROWS, accuracy_ft=5.0 + BEND)
    yield from _guessed(**seconds, speed=3.0 + BEND, yaw_rate=BEND)
    yield from _guessed(**seconds, speed_kmh=30.0 + BEND, yaw_rate=3.0 + BEND)
    yield from _guessed(**seconds, **{"v [m/s]": 3.0 + BEND, "gyro_z": 20.0 + BEND})
    yield from _guessed(**seconds, east=EAST, north=NORTH, down=-HEIGHT, file="reference.csv")
    yield from _guessed(**seconds, e_ft=EAST, n_ft=NORTH)


def sensors() -> Iterator[str]:
    """Inertial units, magnetometers, ranges, orientations, velocities, and what is none of these."""
    clock = {"stamp_ms": 40 * ROWS}
    force = {"acc_x": 0.1 + BEND, "acc_y": -0.2 + BEND, "acc_z": 9.8 + BEND}
    for size, turn in ((1.0, 2.0), (1 / 9.8, 200.0), (30.0, 0.2)):
        rates = {f"gyro_{axis}": turn * (0.5 + BEND) for axis in "xyz"}
        yield from _guessed(**clock, **{name: size * each for name, each in force.items()}, **rates)
    in_units = {f"acc_{axis} [g]": 0.5 + BEND for axis in "xyz"}
    in_units |= {f"gyro_{axis} [deg/s]": 2.0 + BEND for axis in "xyz"}
    yield from _guessed(**clock, **in_units)
    for size in (25.0, 0.25, 1000.0):
        yield from _guessed(**clock, **{f"mag_{axis}": size * (1.0 + BEND) for axis in "xyz"})
    yield from _guessed(**clock, landmark_id=ROWS % 5, range_ft=10.0 + BEND, bearing=BEND)
    yield from _guessed(**clock, distance=10.0 + BEND, azimuth=180.0 + BEND)
    yield from _guessed(**clock, barcode=ROWS % 5, bearing_deg=BEND)
    turned = {f"q{part}": np.full(len(ROWS), 0.5) for part in "wxyz"}
    yield from _guessed(**clock, **turned)
    yield from _guessed(**clock, px=EAST, py=NORTH, pz=HEIGHT, **turned)
    yield from _guessed(**clock, **{f"vel_{axis}": 1.0 + BEND for axis in "xyz"})
    twist = {f"{of}_{axis}": 1.0 + BEND for of in ("linear", "angular") for axis in "xyz"}
    yield from _guessed(**clock, **twist)
    yield from _guessed(**clock, **{"Strom (A)": BEND, "%": BEND, "strom_a": BEND})


def clocks() -> Iterator[str]:
    """Stamps in their units, dates, gaps, repetitions; rows without a clock, tables that are none."""
    for unit_s, zero in ((1e-9, 1.7e9), (1e-3, 1.7e9), (1.0, 0.0), (1e-3, 0.0), (1e-6, 0.0)):
        yield from _guessed(time=np.rint((zero + 0.25 * ROWS) / unit_s).astype(np.int64), level=BEND)
    uneven = 1_700_000_000 + 0.5 * np.delete(np.arange(32), [4, 5, 6, 7, 8, 9, 10, 11])
    uneven[[3, 20]] = uneven[[2, 19]]
    uneven[15] -= 1.0
    yield from _guessed(time_s=uneven, level=BEND)
    yield from _guessed(time=0.25 * ROWS + 1e4 * (ROWS > 12), level=BEND)  # one long gap
    yield from _guessed(level=BEND, other=-BEND)
    yield from _guessed(**{"0": BEND, "1": ROWS})
    day = [f"{5 + row % 3:02d}.10.2026" for row in ROWS.tolist()]
    hour = [f"14:{row:02d}:07,5" for row in ROWS.tolist()]
    yield from _guessed(Datum=day, **{"Uhrzeit [MESZ]": hour}, Geschwindigkeit=BEND, Gierrate=BEND)
    yield from _guessed(time=hour, mode=["auto"] * len(ROWS), level=BEND)
    months = [f"{1 + row % 9}/{1 + row % 7}/2026 10:00:{row:02d}" for row in ROWS.tolist()]
    yield from _guessed(when=months, level=BEND)
    yield from _guessed(when=["14:03 and 1 s"] * len(ROWS), level=BEND)
    yield from _guessed(name=["a"] * len(ROWS))


def folders() -> Iterator[str]:
    """Several tables: each has a namespace, and what they lack together is said."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "drive"
        place.mkdir()
        stamps = {"t": 1_700_000_000 + 0.5 * ROWS}
        _write(place / "gnss.csv", {**stamps, "lat": 48.1 + 1e-5 * ROWS, "lon": 11.5 + 1e-5 * ROWS})
        _write(place / "my truth.csv", {**stamps, "x": EAST, "y": NORTH, "heading": BEND})
        (place / "notes.csv").write_text("remark\nnone\n")
        yield from (f"  {line}" for line in guess([place]).replace(folder, "").splitlines())


def _reasons(case: Callable[[], Iterable[str]]) -> Callable[[], Iterator[str]]:
    """Leave out what states no reason, and comments that were told."""

    @wraps(case)
    def told() -> Iterator[str]:
        said: set[str] = set()
        for line in case():
            if line[:1] != " " or (" #" in line and line not in said):
                yield line
            if line.lstrip().startswith("#"):
                said.add(line)

    return told


GUESSED = tuple(map(_reasons, (drives, sensors, clocks, folders)))


def _guessed(file: str = "drive.csv", **columns: NDArray | list[str]) -> Iterator[str]:
    """The mapping of a table of these columns, or why there is none; what all have alike is left out."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / file
        _write(path, columns)
        yield f"{'; '.join(columns)}:"
        try:
            yield from (f"  {line}" for line in guess([path]).splitlines()[4:])
        except BadInput as error:
            yield str(error).replace(f"{folder}/", "")


def _write(path: Path, columns: Mapping[str, NDArray | list[str]]) -> None:
    """A table with semicolons."""
    rows = [";".join(columns)]
    rows += [
        ";".join(each if isinstance(each, str) else f"{each:.12g}" for each in row)
        for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
