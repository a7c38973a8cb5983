"""Positions of detections in the local tangent plane, from their scans and the sensor's position.

The metadata of a moving sensor's scans names the topic of the sensor's position, under the key ORIGIN.
"""

import numpy as np

from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors

ORIGIN = "origin"


def rows_of(scan: Stream, detected: Stream) -> Integers:
    """Return the row of each detection's scan."""
    order = np.argsort(scan["scan_id"], kind="stable")
    return order[np.searchsorted(scan["scan_id"][order], detected["scan_id"])]


def places_of_sensor(scan: Stream, fix: Stream | None) -> Floats:
    """Return a sensor's position (n, 2) at each scan: its latest fix, or zero if there are no fixes."""
    if fix is None:
        return np.zeros((len(scan), 2))
    last = np.searchsorted(fix.publish_time_ns, scan.publish_time_ns, side="right") - 1
    return read_vectors(fix, "position_m", PLANE)[np.maximum(last, 0)]


def detected_places(scan: Stream, detected: Stream, fix: Stream | None) -> Floats:
    """Return the positions (n, 2) of the detections in the local tangent plane."""
    own = places_of_sensor(scan, fix)[rows_of(scan, detected)]
    return own + read_vectors(detected, "position_m", PLANE)
