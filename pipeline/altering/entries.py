"""The numbers in a topic's messages that an estimator uses."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.changes import AXES, names_in
from fuselog.recorders.log import Stream
from fuselog.replay.engine.replaying.estimator import Reading

PROBED = 64  # number of messages that are altered to find out which entries an estimator uses


class Entry(NamedTuple):
    """A number in a topic's messages that an estimator uses.

    Attributes:
        field, place: the field, and the index in it; a heading belongs to the field `quaternion`.
        name: the name in a setting, with the unit.
        is_angle: whether the number is a measured angle.
        number: the index of the measured component that depends on the number; None if several
            components do.
        varies: the number's standard deviation over the log.
    """

    field: str
    place: int | None
    name: str
    is_angle: bool
    number: int | None
    varies: float

    @property
    def is_heading(self) -> bool:
        """Test whether this number is the heading of orientations."""
        return self.field == "quaternion"


def entries_of(stream: Stream, reading: Reading | None) -> list[Entry]:
    """List the numbers in a topic's messages that change what an estimator reads.

    If `reading` is None, list all scalar fields, and the entries of positions and velocities.
    """
    some = stream.take(slice(0, PROBED))
    found = []
    for field, place, name in _columns(stream):
        column = stream[field] if place is None else stream[field][:, place]
        known = column[np.isfinite(column)]
        if not len(known):
            continue
        varies = float(np.std(known)) or 1.0
        if reading is None:
            if place is None or field in ("position_m", "velocity_mps"):
                found.append(Entry(field, place, name, field == "bearing_rad", None, varies))
            continue
        moved = alter.shifted(field, place)(some, varies)
        places = _changed(reading, some, moved)
        if len(places):
            kinds = reading.kinds[stream.topic]
            is_angle = stream.topic not in reading.controls and kinds[places[0]] == "angle"
            one = int(places[0]) if len(places) == 1 else None
            found.append(Entry(field, place, name, is_angle, one, varies))
    if reading is not None and "quaternion" in stream.columns:
        places = _changed(reading, some, alter.heading_turned(some, 0.1))
        places = [each for each in places if reading.kinds[stream.topic][each] == "angle"]
        if places:
            found.append(Entry("quaternion", None, "heading_rad", True, places[0], 1.0))
    return found


def _columns(stream: Stream) -> Iterator[tuple[str, int | None, str]]:
    """Yield the scalar fields and vector entries of a topic, except covariances and orientations."""
    for entry in stream.schema:
        column = stream.columns.get(entry.name)
        if column is None or entry.name.startswith(("covariance", "quaternion")):
            continue
        if entry.kind == "real":
            yield entry.name, None, entry.name
        elif entry.kind == "vector" and column.shape[1] <= len(AXES):
            for place, name in zip(range(column.shape[1]), names_in(stream, entry.name), strict=False):
                yield entry.name, place, name


def _changed(reading: Reading, before: Stream, after: Stream) -> list[int]:
    """List the indices of the read components that differ between two streams."""
    same = np.isclose(
        reading.numbers(before), reading.numbers(after), rtol=0.0, atol=0.0, equal_nan=True
    )
    return np.flatnonzero(~same.all(axis=0)).tolist()
