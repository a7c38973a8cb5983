"""Importer of ULog: topics become streams, and notes report what is not imported."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.importers.mapping import not_finite
from fuselog.recorders.importers.stamps import to_ns
from fuselog.recorders.importers.ulog.estimator import TOPICS, Autopilot
from fuselog.recorders.importers.ulog.file import Rows, UlogFile
from fuselog.recorders.importers.ulog.sensors import BODY, SENSORS, Fields, Part, heights
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.planes import Origin, in_plane
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Blocks, Importer

_PLACED = ("vehicle_local_position", "vehicle_gps_position", "sensor_gps")

# EKF2's noise is a density divided by the root of its step: its variance in a step is (step x noise)^2.
_DENSITIES = {
    "EKF2_GYR_NOISE": "gyro_noise_density",
    "EKF2_ACC_NOISE": "force_noise_density",
    "EKF2_GYR_B_NOISE": "gyro_bias_density",
    "EKF2_ACC_B_NOISE": "force_bias_density",
}
_NAMED = 3  # names listed for parameters that share a reason; /vehicle/parameters has all
_STEP_US = "EKF2_PREDICT_US"
_DEFAULT_STEP_US = 10_000
# For each parameter, our settings and the factor to their unit.
_SETTINGS = {
    "EKF2_GPS_DELAY": (("fix_delay_s", "velocity_delay_s"), 1e-3),
    "EKF2_ABIAS_INIT": (("force_bias_sigma_mps2",), 1.0),
    "EKF2_GBIAS_INIT": (("gyro_bias_sigma_radps",), 1.0),
    "EKF2_ANGERR_INIT": (("tilt_sigma_rad",), 1.0),
}
_LEVERS = {"X": ("lever_x_m", 1.0), "Y": ("lever_y_m", -1.0), "Z": ("lever_z_m", -1.0)}
# Reasons why parameters are not used, by their names; the first pattern that matches counts.
_REASONS = {
    "CAL_*": "were applied before sensor_combined and vehicle_imu were logged; accelerometer_N, "
    "gyro_N and magnetometer_N are raw sensor readings",
    "EKF2_*_GATE": "test single components; gate_probability tests all components of a message together",
    "EKF2_GPS_?_NOISE": "are lower limits in EKF2; here fixes have the noise that they state",
    "EKF2_MAG_NOISE": "is in gauss; with the magnetometer, set sigma_field_ut to 100 times this value",
    "EKF2_*": "have no counterpart in the model inertial",
}


class UlogParameters(Parameters):
    """The empty set of parameters: everything that can be imported is imported."""


class _Surroundings(NamedTuple):
    """The contents of a log that are read in advance.

    Attributes:
        origin: origin of the filter's local tangent plane; None if the log does not state it.
        separation_m: height of the sea level above the ellipsoid; 0 if unknown.
        first: the first instance of every topic.
    """

    origin: Origin | None
    separation_m: float
    first: Mapping[str, int]


def _surroundings(path: Path) -> _Surroundings:
    """Read a log until the filter's origin and both heights of a receiver are known."""
    place: list[float] | None = None
    separation_m: float | None = None
    file = UlogFile(path)
    for block in file.blocks(lambda topic: topic in _PLACED):
        for fields in map(Fields, block):
            if fields.has("ref_lat"):
                place = _reference(fields) if place is None else place
                continue
            ellipsoid_m, sea_m, agree = heights(fields)
            if (agree & (fields.of("fix_type") >= 3)).any():
                separation_m = float((ellipsoid_m - sea_m)[agree][-1])
        if place is not None and separation_m is not None:
            break
    separation_m = separation_m or 0.0
    origin = None if place is None else Origin(place[0], place[1], place[2] + separation_m)
    instances = sorted(((topic, instance) for topic, instance in file.rows), reverse=True)
    return _Surroundings(origin, separation_m, dict(instances))


def _reference(fields: Fields) -> list[float] | None:
    """Return latitude, longitude and height above the sea of the filter's origin, if it is known."""
    known = np.flatnonzero((fields.of("xy_global") > 0) & (fields.of("ref_timestamp") > 0))
    for place in fields.vector("ref_lat", "ref_lon", "ref_alt")[known[:1]].tolist():
        if np.isfinite(place).all() and abs(place[0]) <= 90 and abs(place[1]) <= 180:
            return list(place)
    return None


class _Import:
    """The import of one file, which makes its streams, block by block, and collects the notes."""

    def __init__(self, file: UlogFile, around: _Surroundings) -> None:
        self._file, self._around = file, around
        self._sources: dict[str, tuple[str, int]] = {}
        self._autopilot = Autopilot(file.parameters)
        self._noise = stated_noise(file.parameters)
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None

    def block(self, rows: list) -> list[Stream]:
        """Make the streams of a block's rows."""
        parts: list[Part] = []
        for each in rows:
            if each.untimed:
                fact = f"{each.topic}: rows without a stamp, timed by their neighbours in the file"
                self._counts[fact] += each.untimed
            if each.topic not in SENSORS:
                continue
            is_first = each.instance == self._around.first.get(each.topic, each.instance)
            fields = Fields(each, is_first, self._around.separation_m)
            try:
                parts += [self._named(part, each) for part in SENSORS[each.topic](fields)]
            except (KeyError, ValueError) as error:
                self._counts[f"{each.topic}: rows with unexpected fields ({error})"] += len(each.data)
        parts += self._autopilot.parts([each for each in rows if each.topic in TOPICS])
        return [stream for part in parts if (stream := self._stream(part)) is not None]

    def _named(self, part: Part, rows: Rows) -> Part:
        """Rename a part if another topic of the file has the same name."""
        source = rows.topic, rows.instance
        is_own = self._sources.setdefault(part.topic, source) == source
        name = part.topic if is_own else f"{part.topic}_{rows.topic}_{rows.instance}"
        self._sources[name] = source
        return replace(part, topic=name)

    def _stream(self, part: Part) -> Stream | None:
        for fact, count in part.facts.items():
            self._counts[f"{part.topic}: {fact}"] += count
        if not len(part.time_us):
            return None
        bad = not_finite(part.schema, dict(part.columns)) | (part.time_us < 0)
        self._counts[f"{part.topic}: left out, NaN or infinite"] += int(bad.sum())
        kept = part.take(np.flatnonzero(~bad)[np.argsort(part.time_us[~bad], kind="stable")])
        if not len(kept.time_us):
            return None
        where = f"{self._file.path}: {part.topic}"
        published = to_ns(kept.time_us, 1000, where=where)
        first_ns = int(published[0])
        self._first_ns = first_ns if self._first_ns is None else min(self._first_ns, first_ns)
        stream = make_stream(
            part.topic,
            part.schema,
            published,
            log_time_ns=to_ns(kept.logged_us, 1000, where=where),
            metadata={**part.metadata, **self._noise.get(part.topic.rpartition("/")[2], {})},
            **kept.columns,
        )
        return in_plane(stream, self._around.origin)

    def last(self) -> list[Stream]:
        """Make the streams that are complete only at the end: parameters, and the logger's losses."""
        file = self._file
        streams = []
        if file.parameters:
            names, rows, times = list(file.parameters), [file.parameters], [file.start_us]
            for time_us, name, value in file.changes:
                if name in rows[-1] and value != rows[-1][name]:
                    rows.append({**rows[-1], name: value})
                    times.append(max(time_us, times[-1]))
            metadata = {"components": ",".join(names), "kinds": ",".join(["linear"] * len(names))}
            streams.append(
                make_stream(
                    f"{BODY}/parameters",
                    schemas.VECTOR_MEASUREMENT,
                    to_ns(times, 1000, where=f"{file.path}: its parameters"),
                    metadata=metadata,
                    value=np.array([[*row.values()] for row in rows]),
                )
            )
        if file.dropouts:
            begin_us, length_us = np.array(file.dropouts, np.int64).T
            begin_ns = to_ns(begin_us, 1000, where=f"{file.path}: its dropouts")
            streams.append(
                make_stream(
                    f"{BODY}/dropouts", schemas.OUTAGE, begin_ns, end_time_ns=begin_ns + 1000 * length_us
                )
            )
        return streams

    @property
    def epoch_ns(self) -> int:
        """Return the first stamp."""
        return self._first_ns or 0

    def check(self) -> None:
        """Raise BadInput if nothing could be imported."""
        if self._first_ns is None:
            topics = some_of(sorted({topic for topic, _ in self._file.rows})) or "none"
            raise BadInput(
                f"{self._file.path}: none of its topics can be imported; it has {topics}: log "
                "sensor_combined, vehicle_gps_position and estimator_states"
            )

    def notes(self) -> dict[str, str]:
        """Write notes on the contents of the file, by subject."""
        file = self._file
        notes = {
            "frames": "north, east, down became east, north, up; forward, right, down became forward, "
            "left, up",
            "parameters": f"{len(file.parameters)}, {len(file.changes)} changes; in {BODY}/parameters",
        }
        notes |= {key: file.info[key] for key in ("sys_name", "ver_hw", "ver_sw") if key in file.info}
        notes |= carried(file.parameters)
        for number, text in enumerate(file.texts, start=1):
            notes[f"text {number}, {text.time_us * 1e-6:.3f} s, {text.level}"] = text.text
        for what, count in (self._counts + self._autopilot.left_out).items():
            notes[what] = str(count)
        for what, count in (+file.losses).items():
            notes[f"lost, {what}"] = str(count)
        taken = {*SENSORS, *TOPICS}
        others: dict[str, list[str]] = {}
        for name, (topic, instance) in self._sources.items():
            if name.endswith(f"_{topic}_{instance}"):
                others.setdefault(f"{topic}, instance {instance}", []).append(name)
        notes |= {of: f"another instance, as {', '.join(names)}" for of, names in others.items()}
        rest = Counter({topic: 0 for topic, _ in file.rows if topic not in taken})
        for (topic, _), count in file.rows.items():
            if topic in rest:
                rest[topic] += count
        if rest:
            named = some_of([f"{topic} ({count})" for topic, count in sorted(rest.items())])
            notes["not taken"] = named
        return notes


def read(path: Path, parameters: UlogParameters) -> Blocks:  # noqa: ARG001
    """Read a ULog block by block; notes report what is lost, left out or not imported.

    Iterating the blocks raises BadInput if the file is not a ULog, its definitions are damaged, or
    nothing can be imported.
    """
    if path.is_dir():
        raise BadInput(f"{path}: is a folder; give one .ulg file")
    found = Blocks(iter(()))
    found.blocks = _blocks(path, found)
    return found


def _blocks(path: Path, result: Blocks) -> Iterator[list[Stream]]:
    around = _surroundings(path)
    file = UlogFile(path)
    work = _Import(file, around)
    for rows in file.blocks(lambda topic: topic in SENSORS or topic in TOPICS):
        yield work.block(rows)
    work.check()
    yield work.last()
    result.notes.update(work.notes())
    result.epoch_ns = work.epoch_ns


ULOG = Importer("ULog, the logs of PX4 autopilots: a .ulg file", UlogParameters, read)


def stated_noise(parameters: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """Return the noise densities that channels state, by the last part of their topics."""
    root_s = (1e-6 * parameters.get(_STEP_US, _DEFAULT_STEP_US)) ** 0.5
    stated = {
        ours: f"{parameters[name] * root_s:.6g}"
        for name, ours in _DENSITIES.items()
        if parameters.get(name, -1.0) >= 0.0 and root_s > 0.0
    }
    return {"inertial": stated} if stated else {}


def carried(parameters: Mapping[str, float]) -> dict[str, str]:
    """Describe which parameters are metadata, which are settings, and why others are not used."""
    notes = {}
    stated = [name for name in _DENSITIES if name in parameters]
    if stated:
        notes[", ".join(stated)] = "are noise densities that /vehicle/inertial states"
    used = {_STEP_US, *stated}
    settings = []
    for name, (ours, unit) in _SETTINGS.items():
        if name in parameters:
            used.add(name)
            settings += [f"{each}={unit * parameters[name]:.6g}" for each in ours]
    for axis, (lever, sign) in _LEVERS.items():
        antenna, imu = f"EKF2_GPS_POS_{axis}", f"EKF2_IMU_POS_{axis}"
        if antenna in parameters:
            used |= {antenna, imu}
            lever_m = sign * (parameters[antenna] - parameters.get(imu, 0.0))
            settings += [f"{lever}={lever_m:.6g}"] if lever_m else []
    if settings:
        notes["settings that the filter had"] = " ".join(f"--set {each}" for each in settings)
    rest: dict[str, list[str]] = {}
    for name in sorted(parameters.keys() - used):
        pattern = next((each for each in _REASONS if fnmatchcase(name, each)), None)
        if pattern is not None:
            rest.setdefault(pattern, []).append(name)
    notes |= {some_of(names, _NAMED): _REASONS[pattern] for pattern, names in rest.items()}
    return notes
