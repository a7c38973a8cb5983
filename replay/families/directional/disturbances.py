"""Detection of magnetic disturbances from estimates of the orientation and the local magnetic field."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream
from fuselog.recorders.models.inertial import into_body

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
COMPONENTS = (*(f"orientation_{part}" for part in "wxyz"), "field_north_ut", "field_up_ut")
AVERAGED_NS = 1_000_000_000


class Disturbances(NamedTuple):
    """Spans (n,) in which the field differs from the local field: start, end and largest difference."""

    begin_ns: Integers
    end_ns: Integers
    largest_ut: Floats


def disturbances(samples: Stream, estimates: Stream, limit_ut: float = 8.0) -> Disturbances:
    """Find seconds in which the mean deviation of the field exceeds a limit, and join them into spans.

    Args:
        samples: samples of an inertial unit with a magnetometer.
        estimates: estimates with the components `COMPONENTS`; samples without an estimate are ignored.
        limit_ut: limit of the deviation in uT, usually four times the standard deviation of an
            undisturbed field.
    """
    row = np.searchsorted(estimates.publish_time_ns, samples.publish_time_ns).clip(0, len(estimates) - 1)
    field = samples["magnetic_field_ut"]
    usable = (estimates.publish_time_ns[row] == samples.publish_time_ns) & np.isfinite(field).all(axis=1)
    places = [estimates.components.index(name) for name in COMPONENTS]
    w, x, y, z, north, up = estimates["mean"][row[usable]][:, places].T
    expected = np.stack(into_body((w, x, y, z), (0.0, north, up)), axis=1)
    second, of_sample = np.unique(samples.publish_time_ns[usable] // AVERAGED_NS, return_inverse=True)
    sums = [np.bincount(of_sample, column) for column in (field[usable] - expected).T]
    deviation = np.linalg.norm(sums, axis=0) / np.maximum(np.bincount(of_sample), 1)
    over = np.flatnonzero(deviation > limit_ut)
    spans = np.split(over, np.flatnonzero(np.diff(second[over]) > 1) + 1) if len(over) else []
    return Disturbances(
        np.array([second[span[0]] for span in spans], np.int64) * AVERAGED_NS,
        np.array([second[span[-1]] + 1 for span in spans], np.int64) * AVERAGED_NS,
        np.array([deviation[span].max() for span in spans]),
    )
