"""What `info` and `import` say of a log's own faults: each fault of a car and of its inertial unit."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fuselog.pipeline.diagnosing.battery.car import (
    FAULTS,
    UNIT_FAULTS,
    faulty,
    recorded,
    recorded_unit,
    ride,
)
from fuselog.recorders.checks.lint import compared
from fuselog.recorders.log import Stream


def of_car() -> Iterator[str]:
    """A car with a compass: without a fault, and with each."""
    for name in FAULTS:
        yield f"{name}: {_said(recorded(faulty(2000, name)).streams)}"


def of_car_without_compass() -> Iterator[str]:
    """The same car without its compass: which of two is mirrored, nothing tells."""
    for name in ("turn rate's sign", "E, N exchanged"):
        streams = dict(recorded(faulty(2000, name)).streams)
        del streams["/car/heading"]
        yield f"{name}: {_said(streams)}"


def of_unit() -> Iterator[str]:
    """A vehicle with an inertial unit: without a fault, and with each."""
    for name, put in UNIT_FAULTS.items():
        yield f"{name}: {_said(recorded_unit(put(ride(0))).streams)}"


def of_stamps() -> Iterator[str]:
    """Odometry alone: messages there twice, one in 20 lost, and clocks beside the recorder's."""
    wheels, fixes, _ = recorded(faulty(2000, "nothing")).streams.values()
    rows = np.arange(len(wheels))
    yield f"one twice: {_said({wheels.topic: wheels.take(np.sort([*rows, 7]))})}"
    yield f"lost: {_said({wheels.topic: wheels.take(rows % 20 != 5)})}"
    for rate in (0.98, 1.0, 1.02):
        slow, late = _logged(wheels, rate), {fixes.topic: _logged(fixes, rate)}
        yield f"clock of one, {rate:g}: {_said({wheels.topic: slow, fixes.topic: _logged(fixes, 1.0)})}"
        yield f"clocks of both, {rate:g}: {_said({wheels.topic: slow, **late})}"


def _logged(stream: Stream, rate: float) -> Stream:
    return replace(stream, log_time_ns=(rate * stream.publish_time_ns).astype(np.int64))


def _said(streams: dict[str, Stream]) -> str:
    return " / ".join(each.sentence for each in compared(streams)) or "nothing"


FOUND = (of_car, of_car_without_compass, of_unit, of_stamps)
