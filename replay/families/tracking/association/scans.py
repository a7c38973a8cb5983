"""Columns of unordered scans of detections, and the kinds of sensors that record scans."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fuselog.recorders.log import Schema
from fuselog.replay.engine.arrays import Floats, Integers, Numbers, Settings
from fuselog.replay.engine.vectors.components import Components

# (target, origin, parameters) -> numbers of a detection. A target is (x_m, vx_mps, y_m, vy_mps).
OfTarget = Callable[[Numbers, Numbers, Settings], Numbers]
# A position, the lower triangle of its covariance, and the area in m^2 for each unit of the measurement.
Born = tuple[Numbers, Numbers, float]


@dataclass(frozen=True, eq=False)
class ScanSensor:
    """A kind of sensor that records unordered scans.

    Its functions have the arguments `target`, (x_m, vx_mps, y_m, vy_mps) for any state of the model, and
    `origin`, the position of the sensor during the scan.

    Attributes:
        leaf, schema, fields: last part of the name, schema and fields of the topic with its detections.
        measured: the components of a detection.
        measure: (target, origin, parameters) -> the measurement of a target.
        noise: (target, origin, parameters) -> variances, or the rows of a lower triangle.
        detection: (target, origin, parameters) -> the probability that the target is detected.
        clutter: (detection, parameters) -> density of false detections, per unit of the measurement.
        birth: (detection, origin, parameters) -> the position of a target at the detection, the rows of
            the lower triangle of its covariance, and the area in m^2 that a unit of the measurement
            covers there; None if a detection does not determine a position.
    """

    leaf: str
    schema: Schema
    fields: tuple[str, ...]
    measured: Components
    measure: OfTarget
    noise: OfTarget
    detection: Callable[[Numbers, Numbers, Settings], float]
    clutter: Callable[[Numbers, Settings], float]
    birth: Callable[[Numbers, Numbers, Settings], Born] | None = None


class Scans(NamedTuple):
    """Scans of all runs in time order; scans offsets[r]:offsets[r + 1] belong to run r.

    Attributes:
        offsets: (runs + 1,).
        time_ns, sensor, kind, number: (scans,), stamp, index of the sensor, index of its kind, and the
            number that the sensor gave the scan.
        first, end: (scans,), the index of the first detection of each scan, and the index after its
            last.
        origin: (scans, 2), position of the sensor.
        detection: (detections, 2), the measurements.
    """

    offsets: Integers
    time_ns: Integers
    sensor: Integers
    kind: Integers
    number: Integers
    first: Integers
    end: Integers
    origin: Floats
    detection: Floats


BY_SCAN = ("time_ns", "sensor", "kind", "number", "first", "end", "origin")


def take_scans(scans: Scans, rows: Integers) -> Scans:
    """Return selected scans, in the given order, as the scans of one run.

    Args:
        scans: scans of any runs.
        rows: (k,), indices of the scans.
    """
    own = {name: getattr(scans, name)[rows] for name in BY_SCAN}
    counts = own["end"] - own["first"]
    ends = np.cumsum(counts)
    detections = np.arange(int(counts.sum())) + np.repeat(own["first"] - ends + counts, counts)
    own |= {"first": ends - counts, "end": ends}
    return Scans(np.array([0, len(rows)]), **own, detection=scans.detection[detections])


def in_time(first: Scans, second: Scans) -> Scans:
    """Merge two sequences of scans of one run in time order.

    At equal stamps, the scans of the first sequence come first.
    """
    shifted = second._replace(
        first=second.first + len(first.detection), end=second.end + len(first.detection)
    )
    own = {name: np.concatenate([getattr(first, name), getattr(shifted, name)]) for name in BY_SCAN}
    detection = np.concatenate([first.detection, second.detection])
    both = Scans(np.array([0, len(own["time_ns"])]), **own, detection=detection)
    return take_scans(both, np.argsort(both.time_ns, kind="stable"))
