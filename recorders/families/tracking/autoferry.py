"""Importer of Autoferry: lidar, radar and camera detections from a moving vessel, and GPS as truth.

Helgesen et al., "Heterogeneous multi-sensor tracking for an autonomous surface vehicle in a littoral
environment", Ocean Engineering 252, 2022; data CC0 1.0. A scenario is a folder with a list of scans,
NAME_detections.json, and a list of the targets' positions, NAME_groundTruth.json.

In the log's plane, x points east and y north. Detections are positions relative to the ownship
(/ownship/fix, one message per scan), or bearings anticlockwise from east. Both are in the plane's axes,
since the files state no heading. The arrival time of a scan is the latest stamp so far. A scan that
follows one with a later stamp is therefore out of sequence by the difference between the two stamps. All
scans are recorded, including empty ones.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.common_streams import truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.planes import in_frame
from fuselog.recorders.models.states import state_metadata
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.parsing import parse_json
from fuselog.recorders.recording import Importer, Recording

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Probability = Annotated[float, Field(gt=0, lt=1)]

LIDAR, RADAR, INFRARED, ELECTRO_OPTICAL = 1, 2, 3, 4
PLACES = {LIDAR: "lidar", RADAR: "radar"}
CAMERAS = {INFRARED: "infrared", ELECTRO_OPTICAL: "electro_optical"}
SENSORS = PLACES | CAMERAS
PLANE = ("x_m", "y_m")


class PlaceSensor(Parameters):
    """Assumed properties of a position sensor, which its channels state for trackers.

    Attributes:
        sigma_m: standard deviation of a position along the line of sight.
        sigma_across_rad: additional standard deviation across the line of sight, per m of range.
        lag_s: age of a scan's positions at the time of its stamp.
        detection_probability: probability that a near target is detected.
        near_range_m: range up to which a target is near; beyond it, the detection probability falls
            linearly.
        far_range_m: range beyond which the probability is constant.
        far_detection_probability: probability that a target beyond `far_range_m` is detected.
        clutter_per_m2: mean number of false detections in a scan, per area.
        joined_within_m: distance within which detections are merged into one target.
        gate_probability: probability that a target's detection is inside its gate.
    """

    sigma_m: PositiveFloat
    sigma_across_rad: NonNegativeFloat = 0.0
    lag_s: NonNegativeFloat = 0.0
    detection_probability: Probability
    near_range_m: NonNegativeFloat
    far_range_m: NonNegativeFloat
    far_detection_probability: Probability
    clutter_per_m2: PositiveFloat
    joined_within_m: NonNegativeFloat = 0.0
    gate_probability: Probability = 0.9973


class Camera(Parameters):
    """Assumed properties of a camera's bearings, which its channels state for trackers.

    Attributes:
        sigma_rad: standard deviation of a bearing.
        sigma_across_m: additional standard deviation across the line of sight, since a box may be
            anywhere on a hull.
        detection_probability: probability that a target is detected.
        clutter_per_rad: mean number of false detections in a scan, per angle.
        gate_probability: probability that a target's detection is inside its gate.
        interval_s: time between the bearings that a track uses, since bearing errors are correlated over
            seconds.
    """

    sigma_rad: PositiveFloat = 0.04
    sigma_across_m: NonNegativeFloat = 15.0
    detection_probability: Probability
    clutter_per_rad: PositiveFloat = 0.8
    gate_probability: Probability = 0.99
    interval_s: NonNegativeFloat = 1.0


class AutoferryParameters(Parameters):
    """Properties of the sensors, which the files do not state; they are the same in all scenarios.

    Attributes:
        lidar, radar: assumed properties of this sensor's detections.
        infrared, electro_optical: assumed properties of this camera's bearings.
    """

    lidar: PlaceSensor = PlaceSensor(
        sigma_m=2.0,
        detection_probability=0.7,
        near_range_m=70.0,
        far_range_m=130.0,
        far_detection_probability=0.02,
        clutter_per_m2=1e-4,
        joined_within_m=12.0,
    )
    radar: PlaceSensor = PlaceSensor(
        sigma_m=5.0,
        sigma_across_rad=0.03,
        lag_s=1.5,
        detection_probability=0.85,
        near_range_m=400.0,
        far_range_m=400.0,
        far_detection_probability=0.425,
        clutter_per_m2=3e-5,
    )
    infrared: Camera = Camera(detection_probability=0.4)
    electro_optical: Camera = Camera(detection_probability=0.6)


class Scans(NamedTuple):
    """Scans (n,) of a file in order: sensor, stamp, arrival, ownship (n, 2), and detections.

    The detections of a scan are (detections, 2) positions east and north of the ownship, or (detections,
    1) bearings.
    """

    sensor: Integers
    time_ns: Integers
    arrival_ns: Integers
    ownship: Floats
    seen: list[Floats]


def read(folder: Path, parameters: AutoferryParameters) -> Recording:
    """Read a scenario; the notes count the scans, the empty scans and the late scans.

    Raises BadInput, with the file and the entry, if either is missing or not in the published form.
    """
    scans = _scans(_file(folder, "detections"))
    truths = _truths(_file(folder, "groundTruth"))
    notes: dict[str, str] = {}
    ownship = make_stream(
        "/ownship/fix",
        schemas.POSITION_FIX,
        scans.time_ns,
        log_time_ns=scans.arrival_ns,
        metadata=state_metadata(PLANE),
        position_m=scans.ownship,
        covariance_m2=np.full((len(scans.time_ns), 4), np.nan),
    )
    streams = [ownship]
    for sensor, name in SENSORS.items():
        rows = np.flatnonzero(scans.sensor == sensor)
        if len(rows):
            stated = {key: repr(value) for key, value in getattr(parameters, name)}
            streams += _sensor_streams(f"/{name}", rows, scans, stated)
            _tell(notes, name, rows, scans)
    for target, (time_ns, place) in truths.items():
        truth = truth_stream(f"/target{target}/truth", time_ns, PLANE, place)
        streams.append(replace(truth, metadata={**truth.metadata, "covers": "some targets"}))
    return Recording(streams, int(scans.time_ns.min()), notes)


def _file(folder: Path, kind: str) -> Path:
    """Find the only file of a kind in a scenario's folder."""
    found = sorted(folder.glob(f"*_{kind}.json")) if folder.is_dir() else []
    if len(found) != 1:
        raise BadInput(
            f"{folder}: {len(found) or 'no'} files *_{kind}.json, expected one; give the folder of one "
            "Autoferry scenario, such as scenario2"
        )
    return found[0]


def _entries(path: Path) -> list[Any]:
    try:
        entries = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read as JSON ({error})") from None
    if not isinstance(entries, list) or not entries:
        raise BadInput(f"{path}: is not a list of entries; give the file as published")
    return entries


def _scans(path: Path) -> Scans:
    sensors, stamps, ownships, seen = [], [], [], []
    for number, entry in enumerate(_entries(path)):
        where = f"{path}: scan {number}"
        sensor = _of(entry, "sensorID", where)
        if type(sensor) is not int or sensor not in SENSORS:
            raise BadInput(
                f"{where}: sensorID is {sensor}; expected one of {', '.join(map(str, SENSORS))}"
            )
        sensors.append(sensor)
        stamps.append(_stamp_ns(entry, where))
        ownships.append(_numbers(_of(entry, "ownshipPosition", where), where, "ownshipPosition", 2))
        detections = _of(entry, "measurement", where)
        seen.append((_places if sensor in PLACES else _bearings)(detections, where))
    time_ns = np.array(stamps, np.int64)
    ownship = np.array(ownships)[:, ::-1]
    return Scans(np.array(sensors), time_ns, np.maximum.accumulate(time_ns), ownship, seen)


def _places(measurement: Any, where: str) -> Floats:
    """Read positions (n, 2) east and north: none as [], one as [N, E], several as [[N ...], [E ...]]."""
    if measurement == []:
        return np.empty((0, 2))
    rows = measurement if isinstance(measurement, list) else [measurement]
    if len(rows) != 2 or isinstance(rows[0], list) != isinstance(rows[1], list):
        raise BadInput(
            f"{where}: measurement must be [], [N, E] or [[N ...], [E ...]]; give the file as published"
        )
    several = isinstance(rows[0], list)
    north, east = (
        _numbers(row if several else [row], where, "measurement", len(rows[0]) if several else 1)
        for row in rows
    )
    return np.stack([east, north], axis=1)


def _bearings(measurement: Any, where: str) -> Floats:
    """Read bearings (n, 1), anticlockwise from east; a single bearing is a plain number."""
    values = measurement if isinstance(measurement, list) else [measurement]
    clockwise = _numbers(values, where, "measurement", len(values))
    return np.pi - (clockwise[:, None] + np.pi / 2.0) % (2.0 * np.pi)


def _truths(path: Path) -> dict[int, tuple[Integers, Floats]]:
    """Read the distinct stamps (n,), ascending, and positions (n, 2) by target."""
    found: dict[int, dict[int, tuple[float, ...]]] = {}
    for number, entry in enumerate(_entries(path)):
        where = f"{path}: entry {number}"
        for target in entry if isinstance(entry, list) else [entry]:
            name = _of(target, "targetID", where)
            if not isinstance(name, int) or not 0 <= name < 2**32:
                raise BadInput(f"{where}: targetID is {name}; expected a whole number")
            north, east, *_ = _numbers(_of(target, "position", where), where, "position", 3)
            stamps = found.setdefault(name, {})
            if stamps.setdefault(_stamp_ns(target, where), (east, north)) != (east, north):
                raise BadInput(f"{where}: target {name} has two positions at one time; remove one entry")
    return {
        target: (np.array(sorted(stamps), np.int64), np.array([stamps[each] for each in sorted(stamps)]))
        for target, stamps in sorted(found.items())
    }


def _of(entry: Any, key: str, where: str) -> Any:
    if not isinstance(entry, dict) or key not in entry:
        raise BadInput(f"{where}: has no {key}; give the file as published")
    return entry[key]


def _stamp_ns(entry: Any, where: str) -> int:
    """Read an entry's time; whole seconds are converted separately, to avoid rounding errors."""
    [time_s] = _numbers([_of(entry, "time", where)], where, "time", 1)
    if not 0.0 <= time_s < 9e9:
        raise BadInput(f"{where}: time is {time_s:g}; expected seconds since 1970")
    return int(time_s) * 10**9 + round((time_s - int(time_s)) * 1e9)


def _numbers(values: Any, where: str, name: str, count: int) -> Floats:
    are_numbers = isinstance(values, list) and all(type(each) in (int, float) for each in values)
    if not are_numbers or len(values) != count:
        raise BadInput(f"{where}: {name} is not {count} numbers as published")
    return np.array(values, float)


def _sensor_streams(
    prefix: str, rows: Integers, scans: Scans, stated: dict[str, str]
) -> Iterator[Stream]:
    """Yield the scans of one sensor and their detections."""
    counts = np.array([len(scans.seen[row]) for row in rows])
    owner, seen = np.repeat(rows, counts), np.concatenate([scans.seen[row] for row in rows])
    scan_id = np.repeat(np.arange(len(rows)), counts)
    yield make_stream(
        f"{prefix}/scan",
        schemas.SCAN,
        scans.time_ns[rows],
        log_time_ns=scans.arrival_ns[rows],
        metadata={**stated, "origin": "/ownship/fix"},
        scan_id=np.arange(len(rows)),
        detections=counts,
    )
    make: Callable[..., Stream] = make_stream
    clocks = {"publish_time_ns": scans.time_ns[owner], "log_time_ns": scans.arrival_ns[owner]}
    if seen.shape[1] == 2:
        yield make(
            f"{prefix}/detection",
            schemas.DETECTION,
            **clocks,
            metadata=in_frame(prefix.strip("/")),
            scan_id=scan_id,
            position_m=seen,
        )
    else:
        yield make(
            f"{prefix}/bearing", schemas.SCAN_BEARING, **clocks, scan_id=scan_id, bearing_rad=seen[:, 0]
        )


def _tell(notes: dict[str, str], name: str, rows: Integers, scans: Scans) -> None:
    empty = sum(len(scans.seen[row]) == 0 for row in rows)
    late_s = (scans.arrival_ns - scans.time_ns)[rows] * 1e-9
    late = late_s > 0.0
    behind = f", {late.sum()} late by up to {late_s.max():.3f} s" if late.any() else ""
    notes[f"{name} scans"] = f"{len(rows)}, {empty} of them empty{behind}"


AUTOFERRY = Importer(
    "Autoferry scenarios: lidar, radar and camera scans from a moving vessel; a folder of JSON files",
    AutoferryParameters,
    read,
)
