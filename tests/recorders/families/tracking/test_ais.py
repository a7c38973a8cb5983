"""The AIS importer: rows, codes for what is not known, notes, the tangent plane, and bad tables."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, open_log, read_streams, write_log
from fuselog.recorders.models.geodesy import into_tangent_plane, out_of_tangent_plane
from fuselog.recorders.recording import Recording, import_run

HEADER = "Time,MMSI,Latitude_degrees,Longitude_degrees,COG_degrees,SOG_knots"
SMALL = [
    "2016-01-12 13:02:11.218,235070762,50.77,-1.09,90,10",
    "2016-01-12 13:02:11.218,235070762,50.77,-1.09,90,10",
    "2016-01-12 13:02:12,235013375,50.78,-1.10,360,0.2",
    "2016-01-12 13:02:13,235070762,91,181,0,102.3",
    "2016-01-12 13:02:14,235070762,50.77,-1.09,0,102.3",
    "2016-01-12 13:02:15,235070762,40,-1.09,0,10",
    "2016-01-12 13:02:16,235070762,50.77,-1.09,0,10",
    "2016-01-12 13:32:16,235070762,50.77,-1.09,0,10",
]


def table(folder: Path, rows: list[str], header: str = HEADER, name: str = "ais.csv") -> Path:
    path = folder / name
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def imported(path: Path, **values) -> tuple[Recording, dict[str, Stream]]:
    recording, _ = import_run("ais", path, values)
    return recording, {stream.topic: stream for stream in recording.streams}


def test_a_small_table_row_by_row(tmp_path: Path):
    """Stamps, identities and units; what is not known is NaN; every doubt is counted."""
    recording, streams = imported(table(tmp_path, SMALL), origin_deg=(50.77, -1.09))
    reports, identity = streams["/reports"], streams["/identity"]
    assert len(reports) == 6
    second = 1_000_000_000
    since = reports.publish_time_ns - recording.epoch_ns
    assert_array_equal(since[:2], [0, 782_000_000])
    assert since[-1] == 1804 * second + 782_000_000
    assert identity["thing_id"].tolist() == [235070762, 235013375, *[235070762] * 4]
    assert_allclose(reports["position_m"][0], 0, atol=1e-9)
    assert_allclose(reports["speed_mps"][:2], [5.1444444, 0.2 * 1852 / 3600], rtol=1e-7)
    assert_allclose(reports["course_rad"][0], np.pi / 2)
    assert np.isnan(reports["course_rad"][1])
    assert np.isnan(reports["speed_mps"][2])
    assert recording.notes == {
        "position not available": "1 reports dropped",
        "course not available": "1 reports kept",
        "speed not available": "1 reports kept",
        "repeated rows": "1 dropped",
        "vessels": "2, 1 of them always below one knot",
        "wrong positions": "1 over 50 m/s from the vessel's reports before and after "
        "(MMSI 235070762), kept",
        "gaps": "1 over 600 s, the longest 1800 s",
    }


def test_equal_stamps_stay_in_the_order_of_the_file(tmp_path: Path):
    """Receivers stamp by the second: who was heard first stays first, in every stream and in the log."""
    vessels = [1 + place * 7 % 100 for place in range(100)]
    rows = [
        f"2016-01-12 13:02:{place // 25:02},{mmsi},50.77,-1.09,90,10"
        for place, mmsi in enumerate(vessels)
    ]
    # one vessel twice within a second: both are kept, and no gap or leap is counted between them
    rows.append("2016-01-12 13:02:03,1,50.77001,-1.09,90,10")
    recording, streams = imported(table(tmp_path, rows))
    assert streams["/identity"]["thing_id"].tolist() == [*vessels, 1]
    assert set(recording.notes) == {"vessels"}
    write_log(tmp_path / "ais.mcap", recording.streams)
    read = read_streams(open_log(tmp_path / "ais.mcap"), ["/identity", "/reports"])
    assert read["/identity"]["thing_id"].tolist() == [*vessels, 1]
    assert_array_equal(read["/reports"]["position_m"], streams["/reports"]["position_m"])


def test_the_plane_is_where_the_earth_is():
    """A minute of latitude is a mile, and the way back gives the place again."""
    origin = (50.77, -1.09)
    _, north, _ = into_tangent_plane((50.77 + 1 / 60, -1.09), origin)
    assert north == pytest.approx(1854, abs=1)
    latitude, longitude = np.array([50.775, 50.768]), np.array([-1.085, -1.1])
    east, north, up = into_tangent_plane((latitude, longitude), origin)
    assert np.all(up < 0)
    back = out_of_tangent_plane((east, north), origin)
    assert_allclose(back[0], latitude, atol=1e-9)
    assert_allclose(back[1], longitude, atol=1e-9)
    assert_allclose(
        into_tangent_plane((50.77, -1.09, 130.0), (50.77, -1.09, 30.0)), (0, 0, 100), atol=1e-8
    )


def test_compressed_more_columns_other_times_and_a_date_line(tmp_path: Path):
    """Other tables with these columns work: ISO stamps with a zone, further columns, 180 degrees."""
    import lzma

    rows = ["2020-02-29T23:59:59Z,1,-17,179.999,10,5,x", "2020-03-01T00:00:01Z,2,-17,-179.999,10,5,y"]
    plain = table(tmp_path, rows, HEADER + ",Name")
    packed = tmp_path / "ais.csv.xz"
    packed.write_bytes(lzma.compress(plain.read_bytes()))
    _, streams = imported(packed)
    east = streams["/reports"]["position_m"][:, 0]
    assert_allclose(np.diff(east), 213, atol=1)
    assert abs(east).max() < 1000
    assert np.diff(streams["/reports"].publish_time_ns).tolist() == [2_000_000_000]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("soon,1,50,-1,0,0", "data row 9, column Time is 'soon'"),
        ("1969-01-01,1,50,-1,0,0", "column Time is '1969-01-01'"),
        ("9999-01-01,1,50,-1,0,0", "column Time is '9999-01-01'"),
        ("2016-01-12 13:02:11,1,50,-1,0,0", "sort the rows by Time"),
        ("2016-01-13,x,50,-1,0,0", "column MMSI is 'x'; expected a number"),
        ("2016-01-13,1.5,50,-1,0,0", "column MMSI is '1.5'; expected a whole number"),
        ("2016-01-13,-1,50,-1,0,0", "column MMSI is '-1'; expected from 1 to 999999999"),
        ("2016-01-13,1,95,-1,0,0", "column Latitude_degrees is '95'; expected from -90 to 91"),
        ("2016-01-13,1,50,-190,0,0", "column Longitude_degrees is '-190'; expected from -180 to 181"),
        ("2016-01-13,1,nan,-1,0,0", "column Latitude_degrees is missing; expected a number"),
        ("2016-01-13,1,50,-1,,0", "column COG_degrees is missing; expected a number"),
        ("2016-01-13,1,50,-1,361,0", "column COG_degrees is '361'; expected from 0 to 360"),
        ("2016-01-13,1,50,-1,0,-1", "column SOG_knots is '-1'; expected from 0 to 102.3"),
        ("2016-01-13,1,50,-1,0,inf", "column SOG_knots is 'inf'; expected a number"),
        ("2016-01-13,1,50,-1,0,0,0", "cannot be read as a CSV table"),
    ],
)
def test_a_bad_row_is_told_by_file_row_and_column(tmp_path: Path, row: str, words: str):
    path = table(tmp_path, [*SMALL, row])
    with pytest.raises(BadInput) as told:
        imported(path)
    assert words in str(told.value)
    assert str(path) in str(told.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (HEADER.encode(), "no reports"),
        (b"a,b\n1,2\n", "has no column Time"),
        (HEADER.replace("MMSI", "Ship").encode() + b"\n" + SMALL[0].encode(), "has no column MMSI"),
        (b"\xff\xfe\x00\x01", "cannot be read as a CSV table"),
        (HEADER.encode() + b"\n2016-01-13,1,91,181,0,0\n", "no report has a position"),
    ],
)
def test_what_is_no_ais_table_is_told(tmp_path: Path, content: bytes, words: str):
    for name in ("ais.csv", "ais.csv.xz"):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(BadInput, match=words if name == "ais.csv" else "ais.csv.xz: cannot be read"):
            imported(path)
    with pytest.raises(BadInput, match="is a folder"):
        imported(tmp_path)


def test_the_solent(real_data: Path):
    """The counts that the data set is known for."""
    recording, streams = imported(real_data / "solent_ais.csv.xz")
    assert [len(each) for each in streams.values()] == [18620] * 3
    assert len(np.unique(streams["/identity"]["thing_id"])) == 91
    assert recording.notes["repeated rows"] == "3 dropped"
    assert recording.notes["wrong positions"].startswith("1 over 50 m/s")
    assert streams["/reports"].metadata["origin_latitude_deg"] == "50.79"
