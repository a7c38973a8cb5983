"""Importer of AIS position reports of vessels: tables with one row per report (CSV, also compressed).

The columns are Time, MMSI, Latitude_degrees, Longitude_degrees, COG_degrees and SOG_knots; other columns
are ignored. Codes for values that a transponder does not know are those of ITU-R M.1371-5, table 48.
/reports contains positions without identities, as a radar would report them; /identity has the vessel
of each report, and /geodetic its position on the ellipsoid.
"""

import lzma
import zlib
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.geodesy import SEMI_MAJOR_M, into_tangent_plane
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Importer, Recording

Floats = NDArray[np.float64]
KNOT_MPS = 1852.0 / 3600.0
NUMBERS = ("MMSI", "Latitude_degrees", "Longitude_degrees", "COG_degrees", "SOG_knots")
# Smallest and largest valid value of each column, including the codes for "not available".
BOUNDS = {
    "MMSI": (1.0, 999_999_999.0),
    "Latitude_degrees": (-90.0, 91.0),
    "Longitude_degrees": (-180.0, 181.0),
    "COG_degrees": (0.0, 360.0),
    "SOG_knots": (0.0, 102.3),
}
NO_COURSE, NO_SPEED = 360.0, 102.3


class AisParameters(Parameters):
    """The origin of the tangent plane, and the limits for notes about unlikely reports.

    Attributes:
        origin_deg: latitude and longitude of the tangent plane's origin; if not set, the median of the
            positions, rounded to 0.01 deg.
        top_speed_mps: speed above which a vessel's position is reported as wrong in the notes.
        gap_s: gaps between a vessel's reports longer than this are counted in the notes.
    """

    origin_deg: (
        tuple[Annotated[float, Field(ge=-90, le=90)], Annotated[float, Field(ge=-180, le=180)]] | None
    ) = None
    top_speed_mps: PositiveFloat = 50.0
    gap_s: PositiveFloat = 600.0


class Reports(NamedTuple):
    """Rows of a file: stamps in ns, MMSI, degrees, and m/s; NaN if not available."""

    time_ns: NDArray[np.int64]
    mmsi: NDArray[np.int64]
    latitude_deg: Floats
    longitude_deg: Floats
    course_deg: Floats
    speed_mps: Floats

    def take(self, rows: NDArray) -> "Reports":
        """Return some of the rows."""
        return Reports(*(column[rows] for column in self))


def read(path: Path, parameters: AisParameters) -> Recording:
    """Read a file; the notes count dropped and doubtful rows.

    Repeated rows, unavailable positions, and positions on the far half of the earth, as seen from the
    origin, are dropped. Wrong positions are kept, because real sensors produce them. Raises BadInput
    with file, row and column if the table is invalid.
    """
    notes: dict[str, str] = {}
    reports = _without_repetitions(_with_positions(_reports(path), path, notes), notes)
    origin = parameters.origin_deg or _middle(reports)
    east, north, up = into_tangent_plane((reports.latitude_deg, reports.longitude_deg), origin)
    near = up > -SEMI_MAJOR_M
    if not near.any():
        raise BadInput(
            f"{path}: all positions are on the other half of the earth from the origin {origin}; give "
            "an origin near them"
        )
    if not near.all():
        notes["beyond the tangent plane's half of the earth"] = f"{(~near).sum()} reports dropped"
    reports, place = reports.take(near), np.stack([east, north], axis=1)[near]
    _tell_doubts(reports, place, parameters, notes)
    plane = {"origin_latitude_deg": repr(origin[0]), "origin_longitude_deg": repr(origin[1])}
    streams = [
        make_stream(
            "/reports",
            schemas.COURSE_FIX,
            reports.time_ns,
            metadata=plane,
            position_m=place,
            course_rad=np.radians(reports.course_deg),
            speed_mps=reports.speed_mps,
        ),
        make_stream("/identity", schemas.IDENTITY, reports.time_ns, thing_id=reports.mmsi),
        make_stream(
            "/geodetic",
            schemas.GEODETIC_FIX,
            reports.time_ns,
            latitude_deg=reports.latitude_deg,
            longitude_deg=reports.longitude_deg,
            altitude_m=np.full(len(reports.mmsi), np.nan),
        ),
    ]
    return Recording(streams, int(reports.time_ns[0]), notes)


def _reports(path: Path) -> Reports:
    """Read and check all rows of a file."""
    table = _table(path)
    numbers = table[list(NUMBERS)].apply(pd.to_numeric, errors="coerce")
    for name in NUMBERS:
        low, high = BOUNDS[name]
        _refuse(path, table, name, ~np.isfinite(numbers[name]), "a number")
        _refuse(path, table, name, ~numbers[name].between(low, high), f"from {low:.10g} to {high:.10g}")
    _refuse(path, table, "MMSI", numbers["MMSI"] % 1 != 0, "a whole number")
    times = pd.to_datetime(table["Time"], errors="coerce", format="ISO8601", utc=True)
    wanted = "a date and time from 1970 to 2261, such as 2016-01-12 13:02:11.218"
    _refuse(path, table, "Time", times.isna() | ~times.dt.year.between(1970, 2261), wanted)
    backwards = times.diff() < pd.Timedelta(0)
    _refuse(
        path,
        table,
        "Time",
        backwards,
        "a time no earlier than that of the row above; sort the rows by Time",
    )
    mmsi, latitude, longitude, course, speed = numbers.to_numpy(float).T
    return Reports(
        times.dt.tz_localize(None).dt.as_unit("ns").to_numpy().astype(np.int64),
        mmsi.astype(np.int64),
        latitude,
        longitude,
        np.where(course == NO_COURSE, np.nan, course),
        np.where(speed == NO_SPEED, np.nan, speed * KNOT_MPS),
    )


def _table(path: Path) -> pd.DataFrame:
    """Read the rows of a file as text."""
    if path.is_dir():
        raise BadInput(f"{path}: is a folder; give one AIS table, a .csv or .csv.xz file")
    try:
        table = pd.read_csv(path, dtype=str)
    except pd.errors.EmptyDataError:
        raise BadInput(f"{path}: is empty; give an AIS table with a header line") from None
    except (OSError, EOFError, ValueError, lzma.LZMAError, zlib.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(f"{path}: cannot be read as a CSV table ({reason})") from None
    missing = [name for name in ("Time", *NUMBERS) if name not in table.columns]
    if missing:
        raise BadInput(
            f"{path}: has no column {missing[0]}; an AIS table has the columns Time, "
            f"{', '.join(NUMBERS)}"
        )
    if table.empty:
        raise BadInput(f"{path}: has a header line but no reports; give an AIS table with rows")
    return table


def _refuse(path: Path, table: pd.DataFrame, name: str, bad: pd.Series, wanted: str) -> None:
    if bad.any():
        row = int(np.argmax(bad.to_numpy()))
        given = table[name].iloc[row]
        what = "missing" if pd.isna(given) else f"'{given}'"
        raise BadInput(f"{path}: data row {row + 1}, column {name} is {what}; expected {wanted}")


def _with_positions(reports: Reports, path: Path, notes: dict[str, str]) -> Reports:
    """Keep reports with a known position; note how many values are not available."""
    unknown = (reports.latitude_deg > 90.0) | (reports.longitude_deg > 180.0)
    if unknown.all():
        raise BadInput(
            f"{path}: no report has a position: all have latitude 91 or longitude 181, the codes for "
            "not available"
        )
    if unknown.any():
        notes["position not available"] = f"{unknown.sum()} reports dropped"
    for what, values in (("course", reports.course_deg), ("speed", reports.speed_mps)):
        count = np.isnan(values[~unknown]).sum()
        if count:
            notes[f"{what} not available"] = f"{count} reports kept"
    return reports.take(~unknown)


def _without_repetitions(reports: Reports, notes: dict[str, str]) -> Reports:
    """Drop repeated rows."""
    repeated = pd.DataFrame(reports._asdict()).duplicated().to_numpy()
    if repeated.any():
        notes["repeated rows"] = f"{repeated.sum()} dropped"
    return reports.take(~repeated)


def _middle(reports: Reports) -> tuple[float, float]:
    """Compute the median of the positions, with longitudes taken relative to their circular mean."""
    longitude = np.radians(reports.longitude_deg)
    mean = np.degrees(np.arctan2(np.sin(longitude).mean(), np.cos(longitude).mean()))
    about = (reports.longitude_deg - mean + 180.0) % 360.0 - 180.0
    middle = (mean + np.median(about) + 180.0) % 360.0 - 180.0
    return round(float(np.median(reports.latitude_deg)), 2), round(float(middle), 2)


def _tell_doubts(
    reports: Reports, place: Floats, parameters: AisParameters, notes: dict[str, str]
) -> None:
    """Note the numbers of vessels, of vessels that never move, of wrong positions and of gaps."""
    order = np.lexsort((reports.time_ns, reports.mmsi))
    mmsi, time_s = reports.mmsi[order], reports.time_ns[order] * 1e-9
    same = mmsi[1:] == mmsi[:-1]
    silent_s = np.diff(time_s)[same]
    # one second of tolerance, since a transponder may repeat a report immediately
    too_far = np.hypot(*np.diff(place[order], axis=0).T) > parameters.top_speed_mps * (
        np.diff(time_s) + 1.0
    )
    leaps = too_far & same
    wrong = np.zeros(len(mmsi), bool)
    # a jump there and back is wrong; after a single jump, either side may be wrong
    wrong[1:-1] = leaps[:-1] & leaps[1:]
    fastest = pd.Series(reports.speed_mps).groupby(reports.mmsi).max()
    notes["vessels"] = f"{len(fastest)}, {(fastest < KNOT_MPS).sum()} of them always below one knot"
    if wrong.any():
        limit = f"over {parameters.top_speed_mps:g} m/s from the vessel's reports before and after"
        rows = ", ".join(str(each) for each in np.unique(mmsi[wrong])[:5])
        notes["wrong positions"] = f"{wrong.sum()} {limit} (MMSI {rows}), kept"
    long = silent_s[silent_s > parameters.gap_s]
    if len(long):
        notes["gaps"] = f"{len(long)} over {parameters.gap_s:g} s, the longest {long.max():.0f} s"


AIS = Importer(
    "AIS position reports of vessels: a .csv or .csv.xz table with Time, MMSI, position, course, speed",
    AisParameters,
    read,
)
