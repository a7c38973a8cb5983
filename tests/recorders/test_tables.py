"""Tables of others become logs by mappings: columns, units, times and axes are what the mapping says."""

import gzip
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables import blocks, files
from fuselog.recorders.importers.tables.blocks import NO_END
from fuselog.recorders.importers.tables.mapping import read_mapping, recordings_in, shipped
from fuselog.recorders.log import Stream, open_log, read_streams, write_log
from fuselog.recorders.recording import import_log, import_run

GRAVITY = 9.80665
INERTIAL = """
[[tables]]
time = { column = "time" }
[[tables.streams]]
topic = "/inertial"
becomes = "InertialSample"
fields = { specific_force_mps2 = ["ax", "ay", "az"], turn_rate_radps = ["gx", "gy", "gz"] }
units = { specific_force_mps2 = "g", turn_rate_radps = "deg/s" }
"""
ROWS = (
    "time,ax,ay,az,gx,gy,gz,note\n1756402240.961,.1,.2,1,10,20,30,a\n1756402240.9670007,0,0,1,-5,0,5,b\n"
)
FIX = """
[[tables]]
time = { column = "t" }
geodetic = { latitude = "lat", longitude = "lon", altitude = "h" }
[[tables.streams]]
topic = "/fix"
becomes = "GeodeticFix"
fields = { latitude_deg = "lat", longitude_deg = "lon", altitude_m = "h" }
[[tables.streams]]
topic = "/truth"
becomes = "TruthState"
fields = { state = ["east_m", "north_m", "up_m"] }
components = "x_m,y_m,z_m"
"""


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., tuple[dict[str, Stream], dict[str, str]]]:
    """Imports a table by a mapping, which may be text: its streams and notes."""

    def run(
        path: Path | str, mapping: str, *more: Path, **settings: Any
    ) -> tuple[dict[str, Stream], dict[str, str]]:
        if isinstance(path, str):
            (tmp_path / "table.csv").write_text(path)
            path = tmp_path / "table.csv"
        if "\n" in mapping:
            (tmp_path / "mapping.toml").write_text(mapping)
            mapping = str(tmp_path / "mapping.toml")
        values = {"mapping": mapping, "more": [str(each) for each in more], **settings}
        recording, run = import_run("table", path, values)
        return {stream.topic: stream for stream in recording.streams}, run.notes

    return run


@pytest.fixture
def refusal(tmp_path: Path, imported: Callable[..., Any]) -> Callable[..., str]:
    """Why a table is refused, of which nothing is written."""

    def run(path: Path | str, mapping: str) -> str:
        with pytest.raises(BadInput) as refused:
            imported(path, mapping)
        values = {"mapping": str(tmp_path / "mapping.toml")}
        with pytest.raises(BadInput):
            import_log("table", tmp_path / "table.csv", values, tmp_path / "log.mcap")
        assert not list(tmp_path.glob("*log*"))
        sentence = str(refused.value)
        assert "\n" not in sentence
        return sentence.replace(f"{tmp_path}/", "")

    return run


def test_units_stamps_and_columns(imported: Callable[..., Any]) -> None:
    """Numbers in fuselog's units, stamps to the last digit written; what is not taken is told."""
    streams, notes = imported(ROWS, INERTIAL)
    inertial = streams["/inertial"]
    assert_allclose(inertial["specific_force_mps2"], np.array([[0.1, 0.2, 1], [0, 0, 1]]) * GRAVITY)
    assert_allclose(inertial["turn_rate_radps"], np.radians([[10, 20, 30], [-5, 0, 5]]))
    assert inertial.publish_time_ns.tolist() == [1756402240_961000000, 1756402240_967000700]
    assert notes["table.csv"] == "2 rows as /inertial"
    assert notes["table.csv: columns not taken"] == "note"
    by_number = INERTIAL.replace('["ax", "ay", "az"]', '["2", "3", "4"]')
    assert_array_equal(
        imported(ROWS, by_number)[0]["/inertial"]["specific_force_mps2"], inertial["specific_force_mps2"]
    )


@pytest.mark.parametrize(
    "form", ["tsv", "semicolon", "spaces", "comment", "headless", "gz", "parquet", "jsonl", "npz"]
)
def test_one_table_in_many_formats(form: str, imported: Callable[..., Any], tmp_path: Path) -> None:
    """The same numbers and stamps, however they are written."""
    plain = ROWS.replace(",note", "").replace(",a\n", "\n").replace(",b\n", "\n")
    expected = imported(plain, INERTIAL)[0]["/inertial"]
    mapping, path = INERTIAL, tmp_path / f"rows.{form}"
    frame = pd.read_csv(tmp_path / "table.csv")
    if form == "parquet":
        frame.to_parquet(path)
    elif form == "jsonl":
        lines = [
            {"time": t, "imu": {"ax": ax, "ay": ay, "az": az}, "rate": [gx, gy, gz]}
            for t, ax, ay, az, gx, gy, gz in frame.itertuples(index=False)
        ]
        path.write_text("\n".join([*map(json.dumps, lines), ""]))
        for name in ("ax", "ay", "az"):
            mapping = mapping.replace(f'"{name}"', f'"imu.{name}"')
        for index, name in enumerate(("gx", "gy", "gz")):
            mapping = mapping.replace(f'"{name}"', f'"rate.{index}"')
    elif form == "npz":
        rates = frame[["gx", "gy", "gz"]].to_numpy()
        np.savez(path, rate=rates, **{name: frame[name] for name in ("time", "ax", "ay", "az")})
        for index, name in enumerate(("gx", "gy", "gz")):
            mapping = mapping.replace(f'"{name}"', f'"rate.{index}"')
    elif form == "gz":
        path = tmp_path / "rows.csv.gz"
        path.write_bytes(gzip.compress(plain.encode()))
    else:
        text = {
            "tsv": plain.replace(",", "\t"),
            "semicolon": plain.replace(",", ";").replace(".", ","),
            "spaces": plain.replace(",", "   "),
            "comment": f"# recorded by hand\n#{plain}",
            "headless": plain.partition("\n")[2],
        }[form]
        path.write_text(text)
        further = {
            "semicolon": 'decimal = ","',
            "headless": 'columns = ["time", "ax", "ay", "az", "gx", "gy", "gz"]',
        }
        mapping = mapping.replace("[[tables]]", f"[[tables]]\n{further.get(form, '')}", 1)
    found = imported(path, mapping)[0]["/inertial"]
    for name in ("specific_force_mps2", "turn_rate_radps"):
        assert_array_equal(found[name], expected[name])
    apart_ns = np.abs(found.publish_time_ns - expected.publish_time_ns)
    assert apart_ns.max() <= (200 if form in ("parquet", "jsonl", "npz") else 0)


@pytest.mark.parametrize(
    ("cells", "told", "expected"),
    [
        (["1.7345014855003267e+18"], 'column = "t", unit = "ns"', 1734501485_500326700),
        (["1734501485317395687"], 'column = "t", unit = "ns"', 1734501485_317395687),
        (["0.09999999999999432"], 'column = "t", zero = "2026-01-01"', 1767225600_100000000),
        (["8333"], 'column = "t", unit = "us", zero = "2026-01-01"', 1767225600_008333000),
        (
            ["2022-08-15 9:37:27.039"],
            'column = "t", unit = "date", utc_offset_h = 8',
            1660527447_039000000,
        ),
        (["2022-08-15T01:37:27.039Z"], 'column = "t", unit = "date"', 1660527447_039000000),
        (["2025/08/28", "17:30:39.749"], 'column = ["t", "u"], unit = "date"', 1756402239_749000000),
        (
            ["28.08.2025 17:30"],
            'column = "t", unit = "date", format = "%d.%m.%Y %H:%M"',
            1756402200_000000000,
        ),
        (["408639.749", "2381"], 'column = "t", week = "u"', 1756402239_749000000),
        (["408639.749", "2381"], 'column = "t", week = "u", leap_seconds = 18', 1756402221_749000000),
    ],
)
def test_times(cells: list[str], told: str, expected: int, imported: Callable[..., Any]) -> None:
    """Every way to write a time comes to the nanosecond; GPS time stays as it is written."""
    text = f"{','.join('tuvw'[: len(cells)])},x\n{','.join(cells)},1\n"
    mapping = f"""
[[tables]]
time = {{ {told} }}
[[tables.streams]]
topic = "/x"
becomes = "VectorMeasurement"
fields = {{ value = ["x"] }}
"""
    assert imported(text, mapping)[0]["/x"].publish_time_ns.tolist() == [expected]


def test_rates_delays_arrival_and_time_tags(imported: Callable[..., Any], tmp_path: Path) -> None:
    """Stamps of a rate, stamps that come late by a stated delay, and those of RTKLIB's time tag."""
    mapping = """
[[tables]]
time = { rate_hz = 8, zero = "2026-01-01" }
[[tables.streams]]
topic = "/x"
becomes = "VectorMeasurement"
fields = { value = ["x"] }
delay_s = 0.5
"""
    found = imported("x,tick\n1,5000\n2,5500\n3,7000\n", mapping)[0]["/x"]
    since = found.publish_time_ns - 1767225600_000000000
    assert since.tolist() == [-500000000, -375000000, -250000000]
    assert (found.log_time_ns - found.publish_time_ns).tolist() == [500000000] * 3
    logged = mapping.replace("rate_hz = 8,", 'column = "x", unit = "s",').replace(
        "[[tables.streams]]",
        'arrival = { column = "tick", unit = "ms", zero = "2026-01-01" }\n[[tables.streams]]',
    )
    found = imported("x,tick\n1,5000\n2,5500\n3,7000\n", logged)[0]["/x"]
    for clock_ns, times_s in (
        (found.publish_time_ns, [0.5, 1.5, 2.5]),
        (found["sensor_time_ns"], [1.0, 2.0, 3.0]),
        (found.log_time_ns, [5.0, 5.5, 7.0]),
    ):
        assert ((clock_ns - 1767225600_000000000) / 1e9).tolist() == times_s
    head = b"TIMETAG RTKLIB demo5".ljust(64, b"\0") + struct.pack("<Id", 1756402240, 0.25)
    (tmp_path / "raw.csv.tag").write_bytes(head + struct.pack("<6I", 0, 0, 500, 10, 2002, 20))
    (tmp_path / "raw.csv").write_text("80\n1,5000\n2,5500\n3,7000\n4,70")  # both ends are cut
    tagged = mapping.replace(
        'rate_hz = 8, zero = "2026-01-01"', 'column = "tick", unit = "ms", tag = ".tag"'
    ).replace("[[tables]]", '[[tables]]\nfiles = "*.csv"\ncolumns = ["x", "tick"]', 1)
    streams, notes = imported(tmp_path / "raw.csv", tagged.replace("0.5", "0.0"))
    since = streams["/x"].publish_time_ns - 1756402240_250000000
    assert since.tolist() == [0, 500_500_000, 2_002_000_000]  # 2000 ms of the counter are 2002
    assert notes["raw.csv: rows left out, with a number of cells other than 2"] == "1"
    assert notes["raw.csv: rows without a time are left out"] == "1"
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "raw.csv.tag").write_bytes((tmp_path / "raw.csv.tag").read_bytes())
    (raw / "raw.csv").write_text("1,500\n2,1000\n3,2500\n4,1500")  # of 15005
    streams, notes = imported(raw, tagged.replace("0.5", "0.0"))
    assert (streams["/x"].publish_time_ns - 1756402240_250000000).tolist() == [
        0,
        500_500_000,
        2_002_000_000,
    ]
    assert notes["raw.csv: rows without a time are left out"] == "1"
    assert "files not taken" not in notes
    (tmp_path / "raw.csv.tag").write_bytes(b"no tag")
    with pytest.raises(BadInput, match="is not a time tag of RTKLIB"):
        imported(tmp_path / "raw.csv", tagged)


def test_fixes_are_made_of_a_path_that_is_known(imported: Callable[..., Any], tmp_path: Path) -> None:
    """Some of the rows with noise of a seed, which the notes say; other noise comes of another seed."""
    mapping = """
[[tables]]
time = { column = "t" }
[[tables.streams]]
topic = "/fix"
becomes = "PositionFix"
fields = { position_m = ["x", "y"] }
every = 3
noise = { position_m = 0.5 }
"""
    text = "t,x,y\n" + "".join(f"{t},{t},0\n" for t in range(10))
    streams, notes = imported(text, mapping, seed=9)
    noise = 0.5 * np.random.default_rng(9).normal(size=(4, 2))
    places = np.array([[0, 0], [3, 0], [6, 0], [9, 0]])
    assert_allclose(streams["/fix"]["position_m"], places + noise, rtol=1e-15)
    assert notes["/fix: messages with simulated noise, position_m: 0.5"] == "4"
    assert (streams["/fix"]["position_m"] != imported(text, mapping)[0]["/fix"]["position_m"]).all()
    with pytest.raises(BadInput, match="`noise` names position, which are not in `fields`"):
        imported(text, mapping.replace("{ position_m = 0.5", "{ position = 0.5"))


def test_recordings_of_one_format_differ_in_mounting_and_delays(imported: Callable[..., Any]) -> None:
    """Settings take the place of what the mapping says of them; what it does not say is refused."""
    mapping = INERTIAL + "mounting_deg = [0, 0, 90]\n"
    found = imported(ROWS, mapping, mounting_deg=[0, 0, 180], delays_s={"/inertial": 0.5})[0][
        "/inertial"
    ]
    assert_allclose(found["specific_force_mps2"][0], np.array([-0.1, -0.2, 1]) * GRAVITY)
    assert (found.log_time_ns - found.publish_time_ns).tolist() == [500000000] * 2
    with pytest.raises(BadInput, match=r"delays_s: the mapping has no topic '/inertia'; did you mean"):
        imported(ROWS, mapping, delays_s={"/inertia": 0.5})
    with pytest.raises(BadInput, match="mounting_deg: no stream of the mapping has a mounting"):
        imported(ROWS, INERTIAL, mounting_deg=[0, 0, 180])


def test_recordings_are_found_below_a_folder(tmp_path: Path) -> None:
    """Those that have all files of the mapping, a single folder or many; a part of one is none."""
    mapping = read_mapping("quadrotor")
    for name, held in {"a/path_2": ["GT.csv", "IMU_1.csv"], "path_10": ["GT.csv", "IMU_1.csv"]}.items():
        (tmp_path / name).mkdir(parents=True)
        for file in held:
            (tmp_path / name / file).touch()
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "GT.csv").touch()
    both = [tmp_path / "a" / "path_2", tmp_path / "path_10"]
    assert recordings_in(mapping, tmp_path) == both
    assert recordings_in(mapping, both[1]) == both[1:]
    with pytest.raises(
        BadInput, match=r"neither this folder nor one in it has .* \(GT.csv, IMU_{unit}.csv\)"
    ):
        recordings_in(mapping, tmp_path / "part")


def test_many_messages_of_a_row_and_what_is_missing(imported: Callable[..., Any]) -> None:
    """A row of ranges is a message for each; empty cells and such as stand for none are left out."""
    mapping = """
[[tables]]
time = { column = "t" }
[[tables.streams]]
topic = "/ranges"
becomes = "AnchorRange"
units = { range_m = "cm" }
missing = [0]
each = [
  { anchor_id = 0, tag_id = 0, range_m = "a" },
  { anchor_id = 0, tag_id = 1, range_m = "b" },
  { anchor_id = 1, tag_id = 0, range_m = "c" },
]
[[constants]]
topic = "/anchors"
becomes = "Landmark"
rows = [{ landmark_id = 0, position_m = [0, 0, 1] }, { landmark_id = 1, position_m = [3, 0, 1] }]
"""
    streams, notes = imported("t,a,b,c\n1,100,200,300\n2,,0,310\n,1,1,1\n", mapping)
    ranges, anchors = streams["/ranges"], streams["/anchors"]
    assert ranges["range_m"].tolist() == [1, 2, 3, 3.1]
    assert ranges["anchor_id"].tolist() == [0, 0, 1, 1]
    assert ranges["tag_id"].tolist() == [0, 1, 0, 0]
    assert ranges.publish_time_ns.tolist() == [10**9, 10**9, 10**9, 2 * 10**9]
    assert anchors["position_m"].tolist() == [[0, 0, 1], [3, 0, 1]]
    assert anchors.publish_time_ns.tolist() == [10**9, 10**9]
    assert notes["/ranges: messages left out: NaN or infinite"] == "2"
    assert notes["table.csv: rows without a time are left out"] == "1"


@pytest.mark.parametrize("name", ["table.csv", "table.csv.gz"])
def test_lines_may_end_with_carriage_returns_only(
    imported: Callable[..., Any], tmp_path: Path, name: str
) -> None:
    data = ROWS.replace("\n", "\r").encode()
    (tmp_path / name).write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    old, _ = imported(tmp_path / name, INERTIAL)
    new, _ = imported(ROWS, INERTIAL)
    assert_array_equal(old["/inertial"]["turn_rate_radps"], new["/inertial"]["turn_rate_radps"])
    assert len(old["/inertial"]["turn_rate_radps"]) == 2


POSITION = """
[[tables]]
time = { column = "t" }
[[tables.streams]]
topic = "/position"
becomes = "PositionFix"
fields.position_m = ["x", "y"]
"""


def test_cells_that_are_no_numbers_are_counted(imported: Callable[..., Any], tmp_path: Path) -> None:
    """Of a text, odd ones too; NaN and empty cells stand for nothing measured, in an array as well."""
    cells = ["0", "-inf", "infinity", "nan(0x7)", "1e+2147483648", "", "nan", "NaN"]
    text = "t,x,y\n" + "".join(f"{time},{cell},1\n" for time, cell in enumerate(cells))
    streams, notes = imported(text, POSITION)
    assert notes["table.csv: x: cells that are not numbers, read as missing"] == "4"
    assert not [key for key in notes if key.startswith("table.csv: y")]
    missing = [np.nan] * 7
    assert_array_equal(streams["/position"]["position_m"][:, 0], [0.0, *missing])
    x = np.array([0.0, np.nan, np.inf])
    np.savez(tmp_path / "table.npz", t=np.arange(3.0), x=x, y=np.ones(3))
    streams, notes = imported(tmp_path / "table.npz", POSITION)
    assert notes["table.npz: x: cells that are not numbers, read as missing"] == "1"
    assert_array_equal(streams["/position"]["position_m"][:, 0], [0.0, np.nan, np.nan])


def test_axes_and_attitudes(imported: Callable[..., Any]) -> None:
    """A mounting turns vectors, covariances and orientations; a heading east is the identity."""
    mapping = """
[[tables]]
time = { column = "t" }
attitude = { heading = "heading", pitch = "pitch", roll = "roll" }
[[tables.streams]]
topic = "/twist"
becomes = "Twist"
fields = { velocity_mps = ["vx", "vy", 0], turn_rate_radps = [0, 0, 0] }
deviations = { covariance = [1, 2, 3, 4, 5, 6] }
mounting_deg = [0, 0, 90]
[[tables.streams]]
topic = "/orientation"
becomes = "Orientation"
fields = { quaternion = ["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"] }
[[tables.streams]]
topic = "/turned"
becomes = "Orientation"
fields = { quaternion = ["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"] }
mounting_deg = [180, 0, 0]
"""
    text = "t,vx,vy,heading,pitch,roll\n1,1,0,90,0,0\n2,0,1,0,30,0\n3,0,1,90,0,20\n"
    streams, _ = imported(text, mapping)
    assert_allclose(streams["/twist"]["velocity_mps"], [[0, 1, 0], [-1, 0, 0], [-1, 0, 0]], atol=1e-15)
    covariance = np.diag(streams["/twist"]["covariance"][0].reshape(6, 6))
    assert_allclose(covariance, [4, 1, 9, 25, 16, 36])
    turn = Rotation.from_quat(streams["/orientation"]["quaternion"], scalar_first=True)
    forward, left = turn.apply([1, 0, 0]), turn.apply([0, 1, 0])
    half = np.sqrt(0.75)
    assert_allclose(forward, [[1, 0, 0], [0, half, 0.5], [1, 0, 0]], atol=1e-15)
    assert_allclose(left[0], [0, 1, 0], atol=1e-15)
    assert left[2, 2] == pytest.approx(np.sin(np.radians(20)))  # the right side is down
    turned = Rotation.from_quat(streams["/turned"]["quaternion"], scalar_first=True)
    assert_allclose(turned.apply([0, 1, 1]), turn.apply([0, -1, -1]), atol=1e-15)


def test_planes_priors_and_angles(imported: Callable[..., Any], refusal: Callable[..., str]) -> None:
    """Places in rad on a stated plane or a map; a prior of the first row, the truth of some."""
    text = "t,lat,lon,h,head,mode\n" + "".join(
        f"{row},{np.radians(50 + row / 1000)},{np.radians(9)},110,{10 * row},{mode}\n"
        for row, mode in enumerate(["fixed", "float", "fixed "])
    )
    mapping = FIX.replace('altitude = "h"', 'altitude = "h", unit = "rad"').replace(
        '"h" }\n[[', '"h" }\nunits = { latitude_deg = "rad", longitude_deg = "rad" }\n[['
    )
    mapping += """where = { mode = "fixed" }
[[tables.streams]]
topic = "/prior"
becomes = "GaussianEstimate"
fields = { mean = ["east_m", "north_m", "head"] }
deviations = { covariance = [1, 2, 90] }
factors = { mean = [1, 1, -1] }
offsets = { mean = [0, 0, 90] }
units = { mean = ["m", "m", "deg"], covariance = ["m", "m", "deg"] }
components = "x_m,y_m,heading_rad"
kinds = "linear,linear,angle"
only_first = true
"""
    origin = "origin = { latitude_deg = 50, longitude_deg = 9, altitude_m = 100 }\n"
    streams, notes = imported(text, origin + mapping)
    assert notes["origin"] == "50, 9 deg, 100 m"
    assert_allclose(streams["/fix"]["latitude_deg"], [50, 50.001, 50.002])
    truth, prior = streams["/truth"], streams["/prior"]
    assert_allclose(truth["state"], [[0, 0, 10], [0, 222.459, 10 - 0.004]], atol=1e-2)
    assert truth.metadata["origin_altitude_m"] == "100.0"
    assert prior.metadata["origin_latitude_deg"] == "50.0"
    moved, _ = imported(text, origin + mapping, origin=[50.0, 9.0, 0.0])
    assert_allclose(moved["/truth"]["state"][:, 2] - truth["state"][:, 2], 100.0, atol=1e-2)
    assert_allclose(prior["mean"], [[0, 0, np.pi / 2]], atol=1e-8)
    assert_allclose(prior["covariance"][0, [0, 4, 8]], [1, 4, np.pi**2 / 4])
    on_map, _ = imported(text, origin + 'projection = "EPSG:25832"\n' + mapping)
    # UTM's scale at its middle meridian, and the heights as they are
    assert_allclose(on_map["/truth"]["state"], [[0, 0, 10], [0, 0.9996 * 222.456, 10]], atol=1e-2)
    assert on_map["/truth"].metadata["projection"] == "EPSG:25832"
    assert "no projection 'EPSG:1'" in refusal(text, origin + 'projection = "EPSG:1"\n' + mapping)


def test_the_walk(imported: Callable[..., Any], navigation: Path) -> None:
    """RTKLIB's solution and an inertial file, of which float rows are worth less and are no truth."""
    streams, notes = imported(navigation / "gnss_imu_rtk" / "walk_0827", "walk")
    rows = np.genfromtxt(
        navigation / "gnss_imu_rtk/walk_0827/gnss_1730_sf.pos", comments="%", skip_header=1
    )
    fix, velocity, truth = streams["/fix"], streams["/velocity"], streams["/truth"]
    assert_array_equal(fix["latitude_deg"], rows[:, 2])
    scale = np.where(rows[:, 5] == 2, 10, 1)
    assert_allclose(fix["covariance_m2"][:, 0], (scale * rows[:, 8]) ** 2)
    assert_allclose(fix["covariance_m2"][:, 4], (scale * rows[:, 7]) ** 2)
    assert_array_equal(velocity["velocity_mps"], rows[:, [16, 15, 17]])
    assert set((velocity.log_time_ns - velocity.publish_time_ns).tolist()) == {125_000_000}
    assert_allclose(
        velocity["covariance_m2ps2"][:, 8], (np.where(rows[:, 5] == 2, 2, 1) * rows[:, 20]) ** 2
    )
    assert len(truth) == 349
    assert_array_equal(truth["state"][0], [0, 0, 0])
    # against the radii of curvature at the origin, good to the mm over 100 m
    latitude, place = np.radians(rows[0, 2]), np.radians(rows[rows[:, 5] == 1, 2:4] - rows[0, 2:4])
    shape = 1 - 0.00669437999014 * np.sin(latitude) ** 2
    meridian, prime = 6378137 * (1 - 0.00669437999014) / shape**1.5, 6378137 / np.sqrt(shape)
    height = rows[0, 4]
    north, east = place[:, 0] * (meridian + height), place[:, 1] * (prime + height) * np.cos(latitude)
    assert_allclose(truth["state"][:, :2], np.stack([east, north], axis=1), atol=2e-3)
    assert np.ptp(truth["state"][:, 1]) > 10
    inertial = streams["/inertial"]
    assert inertial.publish_time_ns[0] == 1756402240_961000000
    assert_allclose(inertial["specific_force_mps2"][0] / GRAVITY, [0.0070006, -0.0170050, 1.0109805])
    assert_allclose(inertial["turn_rate_radps"][0], [0.0028012, 0.0006601, 0.0027935], rtol=1e-12)
    assert float(fix.metadata["origin_latitude_deg"]) == rows[0, 2]
    assert notes["gnss_1730_sf.pos"] == "536 rows as /fix, /velocity, /quality, /truth"


def test_the_other_navigation_data(imported: Callable[..., Any], navigation: Path) -> None:
    """Quadrotor, UWB indoors and outdoors: residuals of ranges are as the data sheet measures them."""
    streams, notes = imported(navigation / "quad_mimu" / "path_9", "quadrotor")
    assert {f"/imu{unit}/inertial" for unit in range(1, 5)} < set(streams)
    assert streams["/truth"]["state"][1, :3].tolist() == [
        -0.25996192441084676,
        0.591234406176474,
        -0.10000003381003134,
    ]
    assert notes["IMU_2.csv: stamps repeat, but are kept"] == "3"
    assert len(streams["/fix"]) == 55
    assert streams["/prior"].publish_time_ns.tolist() == [streams["/truth"].publish_time_ns[0]]

    streams, notes = imported(navigation / "uwb_lias", "uwb-lias")
    ranges, truth = streams["/ranges"], streams["/truth"]
    assert notes["/ranges: messages left out: NaN or infinite"] == "7"
    assert notes["motion_capture_dynamic_exp_mid.csv: stamps repeat, but are kept"] == "198"
    residual = _residual(ranges, truth, streams["/anchors"], streams["/tags"])
    assert residual.std() == pytest.approx(0.096, abs=5e-4)
    assert residual.mean() == pytest.approx(0.179, abs=5e-4)

    streams, notes = imported(navigation / "uwb_outdoor/LOS/Trajectory_A/Case_1", "uwb-outdoor")
    assert notes["ESKF.csv: stamps repeat, but are kept"] == "19"
    truth, published = streams["/truth"], streams["/published/LS"]
    assert truth.publish_time_ns[0] == 1734501485_500326700
    inside = np.flatnonzero((truth["state"][:, 0] > 49.3) & (truth["state"][:, 1] > -5))
    ends = np.flatnonzero((truth["state"][:, 0] <= 12) & (truth["state"][:, 1] > 3.4))
    begin, end = inside[0], ends[ends > inside[0]][0]
    flat = np.abs(truth["state"][:, 2] - 1) < 0.5
    rows = (published.publish_time_ns >= truth.publish_time_ns[begin]) & (
        published.publish_time_ns <= truth.publish_time_ns[end]
    )
    error = [
        published["state"][rows, axis]
        - np.interp(
            published.publish_time_ns[rows], truth.publish_time_ns[flat], truth["state"][flat, axis]
        )
        for axis in range(2)
    ]
    assert np.sqrt(np.mean(np.sum(np.square(error), axis=0))) == pytest.approx(1.0384, abs=5e-5)
    assert streams["/ranges"].log_time_ns[0] == 1734501485_315630136


def _residual(ranges: Stream, truth: Stream, anchors: Stream, tags: Stream) -> np.ndarray:
    """Measured less true ranges, at those within the truth."""
    inside = (ranges.publish_time_ns >= truth.publish_time_ns[0]) & (
        ranges.publish_time_ns <= truth.publish_time_ns[-1]
    )
    ranges = ranges.take(inside)
    nearest = np.searchsorted(truth.publish_time_ns, ranges.publish_time_ns).clip(0, len(truth) - 1)
    state = truth["state"][nearest]
    turn = Rotation.from_quat(state[:, 3:], scalar_first=True)
    tag = state[:, :3] + turn.apply(tags["position_m"][ranges["tag_id"]])
    distance = np.linalg.norm(tag - anchors["position_m"][ranges["anchor_id"]], axis=1)
    return ranges["range_m"] - distance


def test_trajectories(imported: Callable[..., Any], trajectories: Path) -> None:
    """A TUM file as poses; KITTI's have the rate that the mapping states."""
    streams, _ = imported(trajectories / "freiburg1_xyz-groundtruth.txt", "tum")
    poses = streams["/truth"]
    first = np.loadtxt(trajectories / "freiburg1_xyz-groundtruth.txt")[0]
    assert_allclose(poses["state"][0], first[[1, 2, 3, 7, 4, 5, 6]], atol=1e-4)
    streams, _ = imported(trajectories / "KITTI_00_gt.txt", "kitti")
    assert set(np.diff(streams["/truth"].publish_time_ns[:100]).tolist()) == {100_000_000}


def test_a_euroc_folder(imported: Callable[..., Any], tmp_path: Path) -> None:
    """Inertial samples, gyro first, and the truth with its velocity, by their places in the folder."""
    for name, text in {
        "imu0": "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z\n"
        "1403636579758555392,.1,.2,.3,9,8,7\n",
        "state_groundtruth_estimate0": "#timestamp,x,y,z,w,x,y,z,vx,vy,vz,b,b,b,c,c,c\n"
        "1403636580838555648,1,2,3,0,1,0,0,4,5,6,0,0,0,0,0,0\n",
    }.items():
        (tmp_path / "seq" / "mav0" / name).mkdir(parents=True)
        (tmp_path / "seq" / "mav0" / name / "data.csv").write_text(text)
    streams, _ = imported(tmp_path / "seq", "euroc")
    inertial, truth = streams["/imu0/inertial"], streams["/truth"]
    assert inertial.publish_time_ns.tolist() == [1403636579_758555392]
    assert inertial["specific_force_mps2"].tolist() == [[9, 8, 7]]
    assert inertial["turn_rate_radps"].tolist() == [[0.1, 0.2, 0.3]]
    assert truth["state"].tolist() == [[1, 2, 3, 4, 5, 6, 0, 1, 0, 0]]


def test_stamps_that_go_back_and_rows_that_are_cut(imported: Callable[..., Any], tmp_path: Path) -> None:
    """What repeats or goes back is kept, told, and in order where a log is read; a cut row is told."""
    mapping = FIX.replace('time = { column = "t" }', 'time = { column = "t", zero = "2026-01-01" }')
    text = "t,lat,lon,h\n1,50,8,100\n3,50,8.001,100\n2,50.001,8,110\n3,,8,100\n3,,8,100\n4,50\n"
    _, notes = imported(text, mapping)
    assert notes["table.csv: stamps go back in time, so they are sorted"] == "1"
    assert notes["table.csv: stamps repeat, but are kept"] == "1"
    assert notes["/fix: messages left out: NaN or infinite"] == "2"
    assert notes["table.csv: rows left out, with a number of cells other than 4"] == "1"
    import_log(
        "table",
        tmp_path / "table.csv",
        {"mapping": str(tmp_path / "mapping.toml")},
        tmp_path / "log.mcap",
    )
    read = read_streams(open_log(tmp_path / "log.mcap"), ["/truth"])["/truth"]
    assert np.all(np.diff(read.publish_time_ns) > 0)
    assert_allclose(read["state"][0], [0, 0, 0], atol=1e-9)
    assert read["state"][1, 2] == pytest.approx(10, abs=1e-3)  # 111 m away the ellipsoid is 1 mm lower


@pytest.mark.parametrize("form", ["csv", "jsonl", "tum", "kitti"])
def test_a_last_line_without_an_end_is_told(form: str, tmp_path: Path) -> None:
    """A number that is cut off is a number all the same: 12.5 of 12.5678."""
    whole = {
        "csv": "t,x\n0,1.5\n1,12.5678\n",
        "jsonl": '{"t": 0, "x": 1.5}\n{"t": 1, "x": 12.5678}\n',
        "tum": "0 0 0 0 0 0 0 1\n1 12 0 0 0 0 0 1\n",
        "kitti": "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 12\n",
    }[form]
    path = tmp_path / f"rows.{form}"
    for text, is_told in ((whole, False), (whole[:-1], True)):
        path.write_text(text)
        table = files.open_table(path, "trajectory" if form in ("tum", "kitti") else None)
        assert sum(len(next(iter(batch.values()))) for batch in table.batches(table.columns)) == 2
        assert table.doubts == ({NO_END} if is_told else set())


def test_blocks_make_no_difference(
    imported: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of many blocks, whose first fix comes in a later one and whose stamps go back."""
    rows = [
        f"{1000 + row - 5 * (row == 70)},{50 + row / 1e4 if row > 40 else ''},8,100"
        for row in range(100)
    ]
    text = "\n".join(["t,lat,lon,h", *rows, ""])
    whole, notes = imported(text, FIX)
    for module in (blocks, files):
        monkeypatch.setattr(module, "BLOCK_BYTES", 100)
    parts, notes_of_parts = imported(text, FIX)
    assert notes_of_parts == notes
    assert notes["origin"] == "50.0041, 8 deg, 100 m, the first fix"
    for topic, stream in whole.items():
        assert_array_equal(parts[topic].publish_time_ns, stream.publish_time_ns)
    assert_array_equal(parts["/truth"]["state"], whole["/truth"]["state"])


BAD = [
    (ROWS, INERTIAL, '"ax"', '"foo"', "table.csv: has no column 'foo'; available: time, ax"),
    (ROWS, INERTIAL, '"g"', '"m/s"', "the unit 'm/s' does not fit: specific_force_mps2 is in m/s^2"),
    (ROWS, INERTIAL, '"g"', '"0 g"', "the unit '0 g': its number must not be zero"),
    (ROWS, INERTIAL, '"g"', '"gee"', "unknown unit 'gee'; available: m, mm"),
    (ROWS, INERTIAL, '"time"', '"note"', "column note has cells that are not numbers"),
    (ROWS, INERTIAL, '"ax"', '"note"', "table.csv: column note holds 'a'; expected numbers"),
    (ROWS, INERTIAL, "InertialSample", "Inertial", "did you mean 'InertialSample'?"),
    (ROWS, INERTIAL, "turn_rate_radps = [", "turn_rate = [", "InertialSample has no field 'turn_rate'"),
    (ROWS, INERTIAL, ', "gz"]', "]", "field turn_rate_radps is given 2 columns; expected 3"),
    ("t,lat,lon,h\n1,90.5,8,0\n", FIX, "", "", "a latitude is 90.5 deg, beyond 90"),
    ("t,lat,lon,h\n1,x,8,0\n", FIX, "", "", "column lat holds 'x'; expected numbers"),
    ("t,lat,lon,h\n,1,8,0\n", FIX, "", "", "table.csv: no row has a readable time"),
    ("t,lat,lon,h\n1,,8,0\n", FIX, "", "", "none of its rows could be imported"),
    ("t,lat,lon,h\n-1,1,8,0\n", FIX, "", "", "column t: a stamp is before 1970 or after"),
    ("t,lat,lon,h\n1767225600000,1,8,0\n", FIX, "", "", "or after 2262 (1767225600000"),
    ("t,lat,lon,h\n9999-01-01,1,8,0\n", FIX, '"t"', '"t", unit = "date"', "cells that are not dates"),
    ("t,lat,lon,h\n1,1,8,30000\n", FIX, '"t"', '"t", week = "h", unit = "ms"', "t and h: a stamp"),
    ("t,lat,lon,h\n", FIX, "", "", "table.csv: has a header line but no rows"),
    ("", FIX, "", "", "table.csv: has no rows"),
    ("t,w,x,y,z\n1,1,1,0,0\n", FIX, FIX[FIX.index("geodetic") :], """
[[tables.streams]]
topic = "/truth"
becomes = "TruthState"
fields = { state = ["w", "x", "y", "z"] }
components = "a_w,a_x,a_y,a_z"
kinds = "quaternion,quaternion,quaternion,quaternion"
""", "table.csv: /truth: 1 of its quaternions is not of unit length, the first of length 1.41421356"),
    ("t,w,x,y,z\n1,1,1,0,0\n", FIX, FIX[FIX.index("geodetic") :], """
[[tables.streams]]
topic = "/o"
becomes = "Orientation"
fields = { quaternion = ["w", "x", "y", "z"] }
mounting_deg = [180, 0, 0]
""", "table.csv: /o: 1 of its quaternions is not of unit length, the first of length 1.41421356"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "mapping", "old", "new", "sentence"), BAD)
def test_bad_input_is_one_sentence_and_nothing_is_written(
    text: str, mapping: str, old: str, new: str, sentence: str, refusal: Callable[..., str]
) -> None:
    """Columns, units, times and values that cannot be used."""
    assert sentence in refusal(text, mapping.replace(old, new) if old else mapping)


def test_a_measurement_keeps_its_other_components(imported: Callable[..., Any], tmp_path: Path) -> None:
    """One cell is empty: the others are measured all the same; without any there is no message."""
    mapping = """[[tables]]
time = { column = "t" }
[[tables.streams]]
topic = "/wheels"
becomes = "VectorMeasurement"
fields = { value = ["left", "right"] }
components = "left_mps,right_mps"
"""
    streams, notes = imported("t,left,right\n1,0.5,0.6\n2,,0.7\n3,,\n4,inf,0.8\n", mapping)
    nan = np.nan
    wanted = [[0.5, 0.6], [nan, 0.7], [nan, 0.8]]
    assert_array_equal(streams["/wheels"]["value"], wanted)
    assert notes["/wheels: messages left out: NaN or infinite"] == "1"
    write_log(tmp_path / "log.mcap", streams.values())
    read = read_streams(open_log(tmp_path / "log.mcap"), ["/wheels"])["/wheels"]
    assert_array_equal(read["value"], wanted)


def test_an_estimate_states_the_axes_of_its_rotations(imported: Callable[..., Any]) -> None:
    mapping = """[[tables]]
time = { column = "t" }
[[tables.streams]]
topic = "/estimates/theirs/state"
becomes = "GaussianEstimate"
fields = { mean = [1, 0, 0, 0], covariance = [1, 0, 0, 0, 1, 0, 0, 0, 1] }
components = "q_w,q_x,q_y,q_z"
kinds = "quaternion,quaternion,quaternion,quaternion"
rotation_axes = "world"
"""
    streams, _ = imported("t\n1\n2\n", mapping)
    assert streams["/estimates/theirs/state"].metadata["rotation_axes"] == "world"
    without, _ = imported("t\n1\n2\n", mapping.replace('rotation_axes = "world"', ""))
    assert "rotation_axes" not in without["/estimates/theirs/state"].metadata


def test_quaternions_not_of_unit_length_are_scaled_or_left_out(imported: Callable[..., Any]) -> None:
    """Of an orientation and of a state, each counted."""
    fields = 'fields = { quaternion = ["w", "x", "y", "z"] }'
    components = 'components = "a_w,a_x,a_y,a_z"\nkinds = "quaternion,quaternion,quaternion,quaternion"'
    stream = '[[tables.streams]]\ntopic = "/o"\nbecomes = "Orientation"\n' + fields
    state = stream.replace("/o", "/truth").replace("Orientation", "TruthState")
    state = state.replace("quaternion =", "state =") + "\n" + components
    mapping = f'[[tables]]\ntime = {{ column = "t" }}\n{stream}\n{state}\n'
    text = "t,w,x,y,z\n1,1,0,0,0\n2,2,0,0,0\n3,0,0,0,0\n"
    for setting, kept in (("normalise", 2), ("skip", 1)):
        streams, notes = imported(text, mapping, quaternions=setting)
        for topic, field in (("/o", "quaternion"), ("/truth", "state")):
            assert streams[topic][field].tolist() == [[1.0, 0.0, 0.0, 0.0]] * kept
            left_out = notes[f"{topic}: messages left out: a quaternion that is not of unit length"]
            assert left_out == str(3 - kept)
            scaled = f"{topic}: messages with a quaternion that was scaled to unit length"
            assert notes.get(scaled) == ("1" if setting == "normalise" else None)


def test_files_that_do_not_fit(imported: Callable[..., Any], tmp_path: Path) -> None:
    """Several files by their names; one that is missing, one too many, and clocks years apart."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for name, since in (("imu_left", 1756402240), ("imu_right", 1756402241)):
        (folder / f"{name}.csv").write_text(ROWS.replace("1756402240", str(since)))
    (folder / "readme.txt").write_text("x")
    part = folder / ".drive.mcap.x1.part"  # as where the log is written beside the tables
    part.mkdir()
    for name in ("fuselog.lock", "new.mcap"):
        (part / name).touch()
    mapping = INERTIAL.replace("[[tables]]", '[[tables]]\nfiles = "imu_{side}.csv"')
    mapping = mapping.replace('"/inertial"', '"/{side}/inertial"')
    streams, notes = imported(folder, mapping)
    assert list(streams) == ["/left/inertial", "/right/inertial"]
    assert notes["files not taken"] == "readme.txt"
    again, _ = imported(folder / "imu_left.csv", mapping, folder / "imu_right.csv")
    assert list(again) == list(streams)
    with pytest.raises(BadInput, match="is not one of the files that the mapping names"):
        imported(folder / "imu_left.csv", mapping, folder / "readme.txt")
    with pytest.raises(BadInput, match="has no file"):
        imported(tmp_path, mapping.replace("imu_{side}", "gnss_{side}"))
    (folder / "imu_right.csv").write_text(ROWS.replace("1756402240", "12"))
    with pytest.raises(BadInput, match=r"mixed time bases: .*imu_right.csv begins 1.7564e"):
        imported(folder, mapping)
    with pytest.raises(BadInput, match="state the meaning of its columns with --mapping"):
        imported(folder, "")
    with pytest.raises(BadInput, match="no mapping 'wlak'; did you mean 'walk'"):
        imported(folder, "wlak")


@pytest.mark.parametrize("name", shipped())
def test_mappings_that_ship(name: str) -> None:
    """Each can be read and says what it is for."""
    assert read_mapping(name).summary
