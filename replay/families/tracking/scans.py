"""Reading of unordered scans of one or more sensors, with the detections that belong to each scan."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Block, Ragged, run_of_rows
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.families.tracking.association.scans import Scans, ScanSensor


class SensorTopics(NamedTuple):
    """Kinds, topics and frames of a log's sensors.

    `origins` has the topics of the sensors' own positions; it is empty for a sensor without such a
    topic.
    """

    kinds: tuple[int, ...]
    scans: tuple[str, ...]
    detections: tuple[str, ...]
    origins: tuple[str, ...]
    frames: tuple[str, ...]

    @property
    def sensors(self) -> list[str]:
        """Return the names of the sensors, which are the prefixes of their topics."""
        return [scan.rpartition("/")[0].strip("/") for scan in self.scans]


class Fix(NamedTuple):
    """A sensor's own position (2,) at a stamp."""

    time_ns: int
    place: Floats


Fixes = dict[str, list[Fix | None]]


def scans_of(block: Block, found: SensorTopics, kinds: Sequence[ScanSensor], fixes: Fixes) -> Scans:
    """Return the scans of all runs and sensors in the order of replay.

    `fixes` has the last sensor positions of earlier blocks, by topic and run. Raises BadInput as
    `by_scan` does, and if the position of a sensor is not known yet.
    """
    starts = np.cumsum([0, *(len(ragged) for ragged in block.streams.values())])
    start_of = dict(zip(block.streams, starts.tolist(), strict=False))
    place_of = np.empty(starts[-1], np.int64)
    place_of[block.events.source] = np.arange(starts[-1])
    parts, places, first = [], [], 0
    for sensor, (kind, scan, seen, origin, _) in enumerate(zip(*found, strict=True)):
        scans, detections = block.streams[scan], block.streams[seen]
        order, bounds = by_scan(scans, detections)
        own = np.zeros((len(scans), 2))
        if origin:
            own = _origins(scans, block.streams[origin], fixes[origin])
        replayed = place_of[start_of[scan] :][: len(scans)]
        alike = np.full(len(scans), sensor), np.full(len(scans), kind)
        number = scans["scan_id"].astype(np.int64)
        parts.append((replayed, scans.stream.publish_time_ns, *alike, number, *(bounds + first), own))
        places.append(_measured(detections.stream, kinds[kind])[order])
        first += len(order)
    replayed, *columns = (np.concatenate(each) for each in zip(*parts, strict=True))
    rows = np.argsort(replayed)
    offsets = np.searchsorted(replayed[rows], block.events.offsets)
    return Scans._make([offsets, *(each[rows] for each in columns), np.concatenate(places)])


def by_scan(scan: Ragged, detection: Ragged) -> tuple[Integers, Integers]:
    """Sort detections by scan; return the order (n,), and the bounds of each scan in it (2, scans).

    Raises BadInput if two scans of a run have the same number, if the number of a scan's detections
    differs from the number in its message, or if the scan of a detection is missing.
    """
    keys, known = (
        (run_of_rows(each.offsets) << 32) + each["scan_id"].astype(np.int64)
        for each in (detection, scan)
    )
    numbers, counts = np.unique(known, return_counts=True)
    if (counts > 1).any():
        twice = int(numbers[counts.argmax()]) & 0xFFFFFFFF
        raise BadInput(
            f"topic {scan.stream.topic}: two scans have the number {twice}; give each scan its own "
            "scan_id"
        )
    topic, stated = detection.stream.topic, scan["detections"].astype(np.int64)
    order = np.argsort(keys, kind="stable")
    bounds = np.stack([np.searchsorted(keys[order], known, side=side) for side in ("left", "right")])
    there = bounds[1] - bounds[0]
    wrong = np.flatnonzero(there != stated)
    if len(wrong) or len(keys) != stated.sum():
        problem = "some detections belong to scans that are missing"
        if len(wrong):
            row = wrong[0]
            number = scan["scan_id"][row]
            problem = f"scan {number} states {stated[row]} detections, but has {there[row]}"
        raise BadInput(f"topic {topic}: {problem}; record every scan with its number of detections")
    return order, bounds


def _measured(stream: Stream, kind: ScanSensor) -> Floats:
    """Return the detections (n, 2); a bearing is in the first column."""
    if kind.fields == ("position_m",):
        return read_vectors(stream, "position_m", PLANE)
    measured = np.zeros((len(stream), 2))
    for component, field in enumerate(kind.fields):
        measured[:, component] = stream[field]
    return measured


def _origins(scans: Ragged, fixes: Ragged, known: Sequence[Fix | None]) -> Floats:
    """Find a sensor's position (n, 2) at each scan: the last fix so far, or else the first known."""
    found = np.empty((len(scans), 2))
    places = read_vectors(fixes.stream, "position_m", PLANE)
    for run, before in enumerate(known):
        rows = slice(int(scans.offsets[run]), int(scans.offsets[run + 1]))
        own = slice(int(fixes.offsets[run]), int(fixes.offsets[run + 1]))
        time_ns, place = fixes.stream.publish_time_ns[own], places[own]
        if before is not None:
            time_ns, place = np.append(before.time_ns, time_ns), np.vstack([before.place, place])
        order = np.argsort(time_ns, kind="stable")
        last = np.searchsorted(time_ns[order], scans.stream.publish_time_ns[rows], side="right") - 1
        if before is None and (last < 0).any():
            raise BadInput(
                f"topic {scans.stream.topic}: a scan precedes the first message of "
                f"{fixes.stream.topic}, so the position of its sensor is unknown; start the replay "
                "later, with --start"
            )
        found[rows] = place[order][np.maximum(last, 0)]
    return found


def latest_fixes(fixes: Ragged, known: Sequence[Fix | None]) -> list[Fix | None]:
    """Return the last sensor position of every run after a block."""
    places = read_vectors(fixes.stream, "position_m", PLANE)
    latest = list(known)
    for run in range(fixes.runs):
        for row in range(int(fixes.offsets[run]), int(fixes.offsets[run + 1])):
            time_ns, before = int(fixes.stream.publish_time_ns[row]), latest[run]
            if before is None or time_ns >= before.time_ns:
                latest[run] = Fix(time_ns, places[row])
    return latest
