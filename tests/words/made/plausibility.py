"""What `info` and `import` say of a log's own faults: each sentence, of a car and of its inertial unit.

That every fault is named is tested in `tests/recorders/test_plausibility.py`.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fuselog.pipeline.diagnosing.battery.car import (
    UNIT_FAULTS,
    faulty,
    recorded,
    recorded_unit,
    ride,
)
from fuselog.recorders.checks.lint import compared
from fuselog.recorders.log import Stream

# one for each sentence
CAR = (
    "fixes .3 s late",
    "turn rate's sign",
    "speed x 3.6",
    "speed / 3.6",
    "fix variance / 16",
    "E, N exchanged",
    "degrees as radians",
    "odometry clock 6 % fast",
    "fixes 18 s late",
    "half of the odometry lost",
    "compass + 4.5 deg",
    "compass clockwise from north",
)
UNIT = ("accelerometer in g", "gravity's sign", "mounted 90 deg", "unit late .3 s", "E, N exchanged")


def of_car() -> Iterator[str]:
    """A car with a compass, with a fault."""
    for name in CAR:
        yield f"{name}: {_said(recorded(faulty(2000, name)).streams)}"


def of_car_without_compass() -> Iterator[str]:
    """The same car without its compass: which of two is mirrored, nothing tells."""
    streams = dict(recorded(faulty(2000, "E, N exchanged")).streams)
    del streams["/car/heading"]
    yield _said(streams)


def of_unit() -> Iterator[str]:
    """A vehicle with an inertial unit, with a fault."""
    for name in UNIT:
        yield f"{name}: {_said(recorded_unit(UNIT_FAULTS[name](ride(0))).streams)}"


def of_stamps() -> Iterator[str]:
    """Odometry alone: messages there twice, one in 20 lost, and clocks beside the recorder's."""
    wheels, fixes, _ = recorded(faulty(2000, "nothing")).streams.values()
    rows = np.arange(len(wheels))
    yield f"one twice: {_said({wheels.topic: wheels.take(np.sort([*rows, 7]))})}"
    yield f"lost: {_said({wheels.topic: wheels.take(rows % 20 != 5)})}"
    slow = {wheels.topic: _logged(wheels, 0.98)}
    yield f"clock of one: {_said({**slow, fixes.topic: _logged(fixes, 1.0)})}"
    yield f"clocks of both: {_said({**slow, fixes.topic: _logged(fixes, 0.98)})}"


def _logged(stream: Stream, rate: float) -> Stream:
    return replace(stream, log_time_ns=(rate * stream.publish_time_ns).astype(np.int64))


def _said(streams: dict[str, Stream]) -> str:
    return " / ".join(each.sentence for each in compared(streams)) or "nothing"


FOUND = (of_car, of_car_without_compass, of_unit, of_stamps)
