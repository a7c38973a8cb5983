"""Units and axes that files of some devices do not state, recognised by the names of columns."""

import numpy as np

from fuselog.recorders.importers.tables.columns import GuessedColumn, known_of
from fuselog.recorders.importers.tables.files import VBOX_UNITS

# The counter of Xsens, and the sample rates at which it is in us, as in a DOT; otherwise it is in 0.1
# ms.
_XSENS, _DOT_RATES_HZ = "SampleTimeFine", np.array([1, 4, 10, 12, 15, 20, 30, 60, 120])
# Names of columns in tables of a VBOX.
_VBOX = (
    {"sats", "time", "lat", "long", "velocity", "heading", "height"},
    {"satellites", "time", "latitude", "longitude", "velocity", "heading", "height"},
)
# An inertial unit of ArduPilot, with axes forward, right, down.
_ARDUPILOT = ("TimeUS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
# The largest latitude in deg, and in minutes.
_LARGEST_LATITUDE = (90.0, 5400.0)


def of_device(columns: list[GuessedColumn]) -> list[GuessedColumn]:
    """Add the units and axes of known devices to columns."""
    units = {}
    by_name = {column.name: column for column in columns}
    if by_name.keys() >= {*_ARDUPILOT} and np.nanmedian(by_name[_ARDUPILOT[-1]].values) < 0:
        columns = [
            each._replace(frame="ned") if each.name in _ARDUPILOT[1:] else each for each in columns
        ]
    for column in columns:
        if column.name == _XSENS:
            steps = np.abs(np.diff(known_of(column)))
            rate_hz = 1e6 / np.median(steps) if steps.any() else 0.0
            units[column.name] = (
                "us" if np.isclose(rate_hz, _DOT_RATES_HZ, rtol=0.01).any() else "0.1 ms"
            )
    plain = {column.plain: column for column in columns}
    if any(names <= plain.keys() for names in _VBOX):
        latitude = plain.get("lat") or plain["latitude"]
        if _LARGEST_LATITUDE[0] < np.nanmax(np.abs(latitude.values)) <= _LARGEST_LATITUDE[1]:
            of_vbox = {name: each for name, each in plain.items() if name in VBOX_UNITS}
            units |= {each.name: each.unit or VBOX_UNITS[name] for name, each in of_vbox.items()}
    return [each._replace(unit=units.get(each.name, each.unit)) for each in columns]
