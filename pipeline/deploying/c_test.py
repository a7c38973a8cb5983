"""A test of a filter in C, with a recorded log as input and the results of fuselog's own filter."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.deploying.c_source.braces import braced
from fuselog.pipeline.deploying.c_source.names import CFilter, rendered
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.replaying.estimator import Recursive
from fuselog.replay.engine.replaying.replaying import replay
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.inference.kalman.update import message_layout
from fuselog.replay.inference.run.filtering import Filter, FilterState
from fuselog.replay.inference.run.recursion import CONTROL, FilterEvents

MOST_EVENTS = 400  # largest number of events, exceeded only until every sensor has a message
FAR = 1e4  # distance of outliers from the measurement, as a multiple of one plus its magnitude


class Vectors(NamedTuple):
    """The messages of a log in the order in which a filter processes them, with the filter's results.

    Attributes:
        start_ns, mean, covariance: the prior.
        time_ns, source, data: stamps (n,), sources (n,) and numbers (n, width) of the events.
        accepted, nis: (n,) whether the filter accepts the measurement of an event, and the NIS; -1 and
            NaN if the event has no measurement.
        judged: (n,) the row of `means` after each event, -1 if there is no estimate.
        means, covariances: the estimates.
    """

    start_ns: int
    mean: Floats
    covariance: Floats
    time_ns: Integers
    source: Integers
    data: Floats
    accepted: Integers
    nis: Floats
    judged: Integers
    means: Floats
    covariances: Floats


def vectors_of(source: LogSource, bound: Recursive, filtering: Filter) -> Vectors:
    """Run a filter over the first messages of a log, starting at the prior, with added outliers.

    Raises BadInput if the filter does not start in the log, or has no estimates or accepted messages.
    """
    start, events = _handed(source, bound, filtering)
    first, sensors = start.carried, filtering.bound_model.sensors
    events = _with_outliers(filtering, _from_start(events, int(first.time_ns[0]), len(sensors)))
    count, time_ns = len(events.time_ns), events.time_ns
    last = np.append(np.diff(time_ns) > 0, True)
    events = events._replace(wants_estimate=last, target_id=np.arange(count, dtype=np.uint32))
    _, (given, _), made = filtering.filtered(start, events)
    accepted, nis = np.full(count, -1), np.full(count, np.nan)
    if sensors:
        innovations = made[0].stream
        at = innovations["target_id"]
        accepted[at] = innovations["accepted"]
        nis[at] = innovations["normalised_innovation_squared"]
    rows = np.searchsorted(given.time_ns, time_ns).clip(max=max(len(given.time_ns) - 1, 0))
    if not len(given.time_ns) or (sensors and not (accepted > 0).any()):
        raise BadInput(
            f"{source.name}: the filter accepts no measurement after its start, so its C code would not "
            "be tested; give a log in which it accepts messages of its sensors"
        )
    covariance = first.belief.covariance[0].copy()
    filtering.form.to_covariance(covariance)
    return Vectors(
        int(first.time_ns[0]),
        first.belief.mean[0],
        covariance,
        time_ns,
        events.source,
        events.data,
        accepted,
        nis,
        np.where(last & (given.time_ns[rows] == time_ns), rows, -1),
        given.mean,
        given.covariance,
    )


def _handed(source: LogSource, bound: Recursive, filtering: Filter) -> tuple[FilterState, FilterEvents]:
    """Replay a log, and return the filter's first state and all its events."""
    handed: list[FilterEvents] = []
    begun: list[FilterState] = []

    class Listening(Filter):
        """A filter that records its events."""

        def filtered(self, state: Any, events: Any) -> Any:
            handed.append(events)
            return super().filtered(state, events)

    def start(static: Any) -> Any:
        begun.append(bound.start(static))
        return begun[-1]

    listening = Listening(*(getattr(filtering, each.name) for each in fields(Filter)))
    heard = replace(bound, start=start, run=listening.run, finish=listening.finish)
    for _ in replay([source], [heard]):
        pass
    if not begun:
        raise BadInput(f"{source.name}: the filter finds no start in this log; give a log with a prior")
    columns = [np.concatenate(each) for each in zip(*(each[1:] for each in handed), strict=True)]
    return begun[0], FilterEvents(np.array([0, len(columns[0])]), *columns)


def _rows(events: FilterEvents, rows: Integers) -> FilterEvents:
    columns: list[Any] = [column[rows] for column in events[1:]]
    return FilterEvents(np.array([0, len(rows)]), *columns)


def _from_start(events: FilterEvents, start_ns: int, sensors: int) -> FilterEvents:
    """Select the first events after the start, and further ones until every sensor is included."""
    rows = np.flatnonzero(events.time_ns >= start_ns)
    found = [np.flatnonzero(events.source[rows] == sensor) for sensor in range(sensors)]
    until = max([MOST_EVENTS, *(int(each[0]) + 1 for each in found if len(each))])
    return _rows(events, rows[:until])


def _with_outliers(filtering: Filter, events: FilterEvents) -> FilterEvents:
    """Add a distant copy of the last message of every sensor that has a gate, as an outlier."""
    source, data = events.source, events.data
    rows, far = [np.arange(len(source))], [data]
    for number, sensor in enumerate(filtering.bound_model.sensors):
        m = len(sensor.measured)
        own = np.flatnonzero((source == number) & ~np.isnan(data[:, :m]).all(axis=1))
        if len(own) and np.isfinite(filtering.gates[number, 1]):
            outlier = data[own[-1:]].copy()
            angular = np.array([kind == "angle" for kind in sensor.measured.values()])
            outlier[0, :m] += np.where(angular, 0.5 * np.pi, FAR * (1.0 + abs(outlier[0, :m])))
            rows.append(own[-1:])
            far.append(outlier)
    place = np.concatenate(rows)
    order = np.argsort(place, kind="stable")
    return _rows(events, place[order])._replace(data=np.concatenate(far)[order])


def vectors_text(made: CFilter, vectors: Vectors) -> str:
    """Write the text of vectors.h."""
    upper, width = made.name.upper(), vectors.data.shape[1]
    count, n, t = len(vectors.time_ns), made.states, made.tangent
    rows = [row for row in vectors.judged if row >= 0]
    place = {row: index for index, row in enumerate(rows)}
    judged = [place.get(row, -1) for row in vectors.judged]
    lines = [
        "/* A recorded log as input of the filter, with outliers for its gates, and the results of",
        " * fuselog's own filter: whether it accepted a measurement (-1: there was none), and more. */",
        f"#define VECTORS_EVENTS {count}",
        f"#define VECTORS_WIDTH {width}\n",
        f"static const int64_t start_ns = {vectors.start_ns};",
        *_array(made, "prior_mean", vectors.mean, f"[{n}]"),
        *_array(made, "prior_covariance", vectors.covariance.ravel(), f"[{t * t}]"),
        *_whole("int64_t", "event_time_ns", vectors.time_ns),
        *_whole("int", "event_source", vectors.source),
        *_whole("int", "event_estimate", judged),
        *_whole("int", "event_accepted", vectors.accepted),
        *([] if made.precision.ending else _array(made, "event_nis", vectors.nis, "[]")),
        *_array(made, "event_data", vectors.data, "[][VECTORS_WIDTH]"),
        *_array(made, "expected_mean", vectors.means[rows], f"[][{upper}_STATES]"),
        *_array(
            made,
            "expected_covariance",
            vectors.covariances[rows].reshape(-1, t * t),
            f"[][{upper}_TANGENT * {upper}_TANGENT]",
        ),
    ]
    return "\n".join(lines) + "\n"


def _array(made: CFilter, name: str, values: Floats, sizes: str) -> Iterator[str]:
    kind = "double" if name.startswith("expected") else made.precision.real
    number = made.precision._replace(ending="").number if kind == "double" else made.precision.number
    yield f"static const {kind} {name}{sizes} = {{"
    for row in np.atleast_2d(values):
        text = ", ".join(number(float(each)) for each in row)
        yield f"    {text}," if values.ndim == 1 else f"    {{{text}}},"
    yield "};"


def _whole(kind: str, name: str, values: Sequence[Any] | Integers) -> Iterator[str]:
    yield f"static const {kind} {name}[] = {{"
    for first in range(0, len(values), 8):
        yield "    " + ", ".join(str(int(each)) for each in values[first : first + 8]) + ","
    yield "};"


def test_text(made: CFilter) -> str:
    """Write the text of test_NAME.c."""
    gates = [int(math.isfinite(bounds[1])) for bounds in made.filtering.gates[: len(made.sensors)]]
    return braced(rendered(made, "test.c", gates=gates, control=CONTROL, layout=message_layout))
