"""A log's messages as the recursion takes them: rows of numbers in time order, whatever the model."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from recorders.log import Stream
from replay.engine.arrays import Booleans, Floats, Integers
from replay.engine.streams.blocks import Block, Ragged, last_of_equals, ragged_rows
from replay.engine.streams.geodetic import GEODETIC, in_plane
from replay.engine.streams.measurements import Fixes, read_fixes, read_vectors, unknown
from replay.inference.kalman.update import reading
from replay.inference.model.binding import Found
from replay.inference.model.model import Control, Map, Sensor
from replay.inference.model.parameters import number_fields
from replay.inference.model.settings import reading_settings
from replay.inference.model.stage import Stage
from replay.inference.run.recursion import CONTROL, NOTHING, FilterEvents

EARLY = 1000  # of the times asked for: a prior of longer before is one of another time


@dataclass(frozen=True)
class Points:
    """The points of a map in all runs: keys are run * 2^32 + number, sorted; places (n, d)."""

    keys: Integers
    places: Floats

    def rows(self, run: Integers, number: Integers) -> Integers:
        """The rows of the points with these numbers in these runs; -1 where there is none."""
        keys = (run << 32) + number
        if len(self.keys) == 0:
            return np.full(len(keys), -1)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[rows] == keys, rows, -1)

    def at(self, rows: Integers) -> Floats:
        """The places (m, d) of rows as `rows` gives them; NaN where there is none."""
        nowhere = np.full((1, self.places.shape[1]), np.nan)  # what has no row takes the last one
        return np.concatenate([self.places, nowhere])[rows]


def points_of(ragged: Ragged, asked: Map) -> Points:
    """The points of all runs; raises BadInput where they lack a component."""
    places = read_vectors(ragged.stream, asked.point, asked.components)
    run = np.repeat(np.arange(ragged.runs), np.diff(ragged.offsets))
    keys = (run << 32) + ragged[asked.number]
    order = np.argsort(keys, kind="stable")
    return Points(keys[order], np.ascontiguousarray(places[order]))


class Context(NamedTuple):
    """What messages are read against: the points of every map by its topic, and the plane's origins.

    The origins (runs, 3) are latitude, longitude and altitude; None where no fix needs them.
    """

    points: Mapping[str, Points]
    origins: Floats | None


@lru_cache(maxsize=64)
def data_columns(stage: Stage) -> tuple[int, int]:
    """How many numbers an event has, and the first of the control's among them."""
    width, control = (
        max((reading(sensor).width for sensor in stage.sensors), default=0),
        stage.model.control,
    )
    start = width if control is not None and control.interpolated else 0
    return max(width, start + stage.model.controls), start


def filter_events(
    stage: Stage, found: Found, block: Block, context: Context, settings: Floats
) -> tuple[FilterEvents, Booleans]:
    """A block's messages as the recursion takes them, and which of them lack their covariance."""
    merged, control = block.events, stage.model.control
    width, start = data_columns(stage)
    uses: list[tuple[str, Table]] = []
    if control is not None and found.control is not None:
        columns = {name: start + index for index, name in enumerate(control.components)}
        replaced = {name for each, _ in found.fallbacks for name in each.components}
        own = {name: column for name, column in columns.items() if name not in replaced}
        name = found.control.name
        uses.append((name, _control_table(control, block.streams[name], width, own)))
        for each, topic in found.fallbacks:
            uses.append((topic.name, _control_table(each, block.streams[topic.name], width, columns)))
    for number, (_, topic) in enumerate(found.sensors):
        ragged = block.streams[topic.name]
        uses.append((topic.name, sensor_table(stage, number, ragged, context, settings)))
    tables = dict(reversed(uses))  # the first use of every topic
    data, source, target, without_covariance = (
        column[0] if len(column) == 1 else np.concatenate(column)[merged.source]
        for column in zip(*(tables[name] for name in block.streams), strict=True)
    )
    arrival = np.empty((len(source), 0), np.int64) if block.arrival is None else block.arrival
    events = FilterEvents(merged.offsets, merged.time_ns, source, data, merged.is_last, target, arrival)
    again = [_again(events, block, name, table) for name, table in uses if table is not tables[name]]
    if without_covariance.any():  # as if these had not come
        chosen = ~without_covariance
        after = np.cumsum(chosen)
        again = [(after[places] - 1, others) for places, others in again]
        events = select_events(events, chosen)
    if again:
        events = _inserted(events, again)
    if without_covariance.any() or again:
        events = events._replace(wants_estimate=last_of_stamps(events))
    return events._replace(wants_estimate=_wanted(stage, events)), without_covariance


def _wanted(stage: Stage, events: FilterEvents) -> Booleans:
    """Which of the last events of their stamps want an estimate: not where the control's are all."""
    control = stage.model.control
    if control is None or control.estimates or not stage.sensors:
        return events.wants_estimate
    stamp: Integers = np.cumsum(events.wants_estimate) - events.wants_estimate
    sensed = np.zeros(int(stamp[-1]) + 1 if len(stamp) else 0, bool)
    sensed[stamp[events.source != CONTROL]] = True
    return events.wants_estimate & sensed[stamp]


def delays_of(stage: Stage, settings: Floats) -> Integers:
    """How long before their stamps messages were measured, in ns, by an event's source.

    (sensors + 2,): the sensors', then that of NOTHING, which is 0, and of the CONTROL.
    """
    names, control = number_fields(stage.model.parameters), stage.model.control
    asked = [(number + 1, sensor.delay) for number, sensor in enumerate(stage.sensors)]
    asked += [(0, ""), (0, control.delay if control else "")]
    delays_s = [settings[row, names.index(name)] if name else 0.0 for row, name in asked]
    return np.rint(1e9 * np.array(delays_s)).astype(np.int64)


def compensate_delays(
    stage: Stage, events: FilterEvents, delays_ns: Integers, *, is_end: bool
) -> tuple[FilterEvents, FilterEvents]:
    """Events at the times at which they were measured, in order; and those still to wait.

    What is less than the longest of `delays_of` before a run's last stamp waits, unless this is the end:
    something older may come.
    """
    runs = len(events.offsets) - 1
    run = np.repeat(np.arange(runs), np.diff(events.offsets))
    time_ns = events.time_ns - delays_ns[events.source]
    last_ns = np.append(events.time_ns, 0)[events.offsets[1:] - 1]
    settled = is_end | (time_ns < last_ns[run] - delays_ns.max())
    waiting = select_events(events, ~settled)
    measured = select_events(events._replace(time_ns=time_ns), settled)
    order = np.lexsort((measured.time_ns, run[settled]))
    columns: Any = (column[order] for column in measured[1:])
    measured = FilterEvents(measured.offsets, *columns)
    measured = measured._replace(wants_estimate=last_of_stamps(measured))
    return measured._replace(wants_estimate=_wanted(stage, measured)), waiting


def last_of_stamps(events: FilterEvents) -> Booleans:
    """Whether the next event of the run has another stamp, or was taken at another time."""
    return last_of_equals(events.offsets, events.time_ns, *events.arrival.T[:1])


class Table(NamedTuple):
    """One topic's messages: data (n, width), source, what they are about, who lacks a covariance."""

    data: Floats
    source: Integers
    target_id: Integers
    lacks_covariance: Booleans


def _again(events: FilterEvents, block: Block, name: str, table: Table) -> tuple[Integers, FilterEvents]:
    """The messages of a topic as what another sensor measures by them, and their places among all.

    One of which nothing is measured does not come again.
    """
    before = list(block.streams).index(name)
    begin = sum(len(ragged) for ragged in list(block.streams.values())[:before])
    of_topic = block.events.topic == before
    row = np.where(of_topic, block.events.source - begin, 0)
    measures = ~np.isnan(table.data).all(axis=1) & ~table.lacks_covariance
    chosen = of_topic & measures[row]
    data, source, target, _ = (column[row[chosen]] for column in table)
    again = select_events(events, chosen)._replace(data=data, source=source, target_id=target)
    return np.flatnonzero(chosen), again


def _inserted(events: FilterEvents, again: Sequence[tuple[Integers, FilterEvents]]) -> FilterEvents:
    """Events with others after those at whose places they are."""
    places, others = zip(*again, strict=True)
    order = np.argsort(np.concatenate([np.arange(len(events.time_ns)), *places]), kind="stable")
    offsets, *columns = zip(events, *others, strict=True)
    return FilterEvents(sum(offsets), *(np.concatenate(column)[order] for column in columns))


def _control_table(control: Control, ragged: Ragged, width: int, columns: Mapping[str, int]) -> Table:
    """The numbers of a control in the columns of its components; NaN where they come from elsewhere."""
    count, names = len(ragged), control.components
    data = np.full((count, width), np.nan)
    read = _computed(control.read, ragged, len(names)) if control.read else _fields(ragged.stream, names)
    for name, numbers in zip(names, read.T, strict=True):
        if name in columns:
            data[:, columns[name]] = numbers
    without_covariance = np.zeros(count, bool)
    if control.interpolated:  # one that is not finite is as if it had not come
        without_covariance |= ~np.isfinite(read).all(axis=1)
    return Table(data, np.full(count, CONTROL), np.zeros(count, np.int64), without_covariance)


def sensor_table(stage: Stage, number: int, ragged: Ragged, context: Context, settings: Floats) -> Table:
    """The messages of sensor `number`: measured, what it is about, its covariance; see `steps.reading`.

    A message that lacks its covariance, or of which all is NaN, is as if it had not come.
    """
    sensor, (width, _) = stage.sensors[number], data_columns(stage)
    parameters = reading_settings(number_fields(stage.model.parameters))(settings, number + 1)
    m = len(sensor.measured)
    if ragged.stream.schema.full_name == GEODETIC:
        assert context.origins is not None
        ragged = in_plane(ragged, context.origins)
    stream = ragged.stream
    source, target = np.full(len(stream), number), np.zeros(len(stream), np.int64)
    without_covariance = np.zeros(len(stream), bool)
    parts = []
    if sensor.covariance:
        value, spread, without_covariance = _with_covariance(sensor, ragged)
        variances = np.array(sensor.noise(parameters) if sensor.noise else np.nan, float)
        if np.isfinite(variances).all():
            spread[without_covariance], without_covariance = (
                np.diag(variances),
                np.zeros(len(stream), bool),
            )
        without_covariance = without_covariance | np.isnan(value).all(axis=1)
        parts = [value, spread[:, *np.tril_indices(m)]]
    elif sensor.read:
        parts = [_computed(sensor.read, ragged, m)]
    elif sensor.vector:
        parts = [read_vectors(stream, sensor.vector, sensor.measured)]
    else:
        parts = [_fields(stream, tuple(sensor.measured))]
    reference: list[Floats] = []
    if sensor.maps:
        target = stream[sensor.maps[0].of].astype(np.int64)
        run = np.repeat(np.arange(ragged.runs), np.diff(ragged.offsets))
    for each in sensor.maps:
        places = context.points[each.topic]
        rows = places.rows(run, stream[each.of].astype(np.int64))
        source[rows < 0] = NOTHING
        reference.append(places.at(rows))
    if sensor.control is not None:  # see `fill_control`
        reference.append(np.full((len(stream), len(sensor.control.components)), np.nan))
    reference += [_field(stream, name, size) for name, size in sensor.fields.items()]
    if sensor.is_numbered:
        reference.append(np.stack([stream[each.of].astype(float) for each in sensor.maps], axis=1))
    parts[1:1] = reference
    source[without_covariance] = NOTHING
    filled = sum(part.shape[1] for part in parts)
    if filled < width:
        parts.append(np.full((len(stream), width - filled), np.nan))
    data = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    return Table(np.ascontiguousarray(data), source, target, without_covariance)


def _with_covariance(sensor: Sensor, ragged: Ragged) -> Fixes:
    """What messages measure, their covariances and which of them lack one."""
    if isinstance(sensor.covariance, str):
        return read_fixes(ragged.stream, sensor.vector, sensor.covariance, sensor.measured, None)
    assert sensor.read is not None
    m = len(sensor.measured)
    value = _computed(sensor.read, ragged, m)
    spread = np.array(sensor.covariance(ragged.stream), float).reshape(len(value), m, m)
    return Fixes(value, spread, unknown(spread))


def _fields(stream: Stream, names: Sequence[str]) -> Floats:
    return np.stack([stream[name] for name in names], axis=1)


def _field(stream: Stream, name: str, size: int) -> Floats:
    """A field of numbers or vectors (n, size); raises BadInput where it has another width."""
    if not len(stream):  # vectors have no width here
        return np.empty((0, size))
    numbers = np.asarray(stream[name], float).reshape(len(stream), -1)
    if numbers.shape[1] != size:
        raise BadInput(
            f"topic {stream.topic}: {name} has {numbers.shape[1]} components; the model needs {size}"
        )
    return numbers


def _computed(read: Callable[[Stream], Any], ragged: Ragged, components: int) -> Floats:
    """What a model's own function reads of a topic; BadInput where that is not as wide as it says."""
    if not len(ragged):  # vectors have no width here
        return np.empty((0, components))
    numbers = np.asarray(read(ragged.stream), float)
    if numbers.shape != (len(ragged), components):
        raise BadInput(
            f"topic {ragged.stream.topic}: the model reads an array of shape {numbers.shape} from "
            f"{len(ragged)} messages; ({len(ragged)}, {components}) is needed"
        )
    return numbers


def output_times(
    offsets: Integers, time_ns: Integers, width: int, *, wants_estimate: bool
) -> FilterEvents:
    """Events that are only times: run r owns offsets[r]:offsets[r + 1]."""
    count = len(time_ns)
    nothing = np.full(count, NOTHING), np.full((count, width), np.nan)
    reference, arrival = np.zeros(count, np.int64), np.empty((count, 0), np.int64)
    return FilterEvents(offsets, time_ns, *nothing, np.full(count, wants_estimate), reference, arrival)


def join_events(first: FilterEvents, second: FilterEvents) -> FilterEvents:
    """The events of both in time, run by run; at equal stamps those of the first go first."""
    first, second = _came_alike(first, second), _came_alike(second, first)
    runs = len(first.offsets) - 1
    run = np.concatenate([np.repeat(np.arange(runs), np.diff(each.offsets)) for each in (first, second)])
    order = np.lexsort((np.concatenate([first.time_ns, second.time_ns]), run))
    columns: Any = (
        np.concatenate([one, other])[order] for one, other in zip(first[1:], second[1:], strict=True)
    )
    return FilterEvents(first.offsets + second.offsets, *columns)


def _came_alike(events: FilterEvents, other: FilterEvents) -> FilterEvents:
    """Events that say when they came if others do: times alone come at their stamps."""
    if events.arrival.shape[1] >= other.arrival.shape[1]:
        return events
    time_ns = events.time_ns
    return events._replace(arrival=np.stack([time_ns, np.full(len(time_ns), -1)], axis=1))


def select_events(events: FilterEvents, chosen: Booleans) -> FilterEvents:
    """Some of the events."""
    columns: Any = (column[chosen] for column in events[1:])
    return FilterEvents(ragged_rows(chosen, events.offsets), *columns)


def interpolate_control(
    events: FilterEvents, controls: int, gap_ns: float = np.inf
) -> tuple[FilterEvents, FilterEvents]:
    """Events with the control at their stamps, linear between messages; and those still to wait.

    What comes after a run's last control message waits for the next, with that message before it. From
    one message that comes more than a gap before the next, up to that, the control is NaN.
    """
    data, is_control = events.data.copy(), events.source == CONTROL
    ready, waiting = np.zeros(len(data), bool), np.ones(len(data), bool)
    columns = range(data.shape[1] - controls, data.shape[1])
    for begin, end in pairwise(events.offsets):
        at = begin + np.flatnonzero(is_control[begin:end])
        if not len(at):
            continue
        inside = slice(begin, at[-1] + 1)
        times_ns, wanted_ns = (events.time_ns[rows] - events.time_ns[begin] for rows in (at, inside))
        for column in columns:
            data[inside, column] = np.interp(wanted_ns, times_ns, data[at, column])
        for late in np.flatnonzero(np.diff(times_ns) > gap_ns):
            data[at[late] + 1 : at[late + 1] + 1, -controls:] = np.nan
        ready[inside], waiting[begin : at[-1]] = True, False
    again = events._replace(wants_estimate=events.wants_estimate & ~ready)  # one estimate is enough
    return select_events(events._replace(data=data), ready), select_events(again, waiting)


def fill_control(stage: Stage, events: FilterEvents) -> FilterEvents:
    """Events whose control is known, with its numbers where sensors read them."""
    data = events.data.copy()
    for number, sensor in enumerate(stage.sensors):
        if sensor.control is not None:
            rows, controls = events.source == number, len(sensor.control.components)
            begin = len(sensor.measured) + sensor.control_start
            data[rows, begin : begin + controls] = data[rows, -controls:]
    return events._replace(data=data)


def hold_control(events: FilterEvents, initial: Sequence[float], gap_ns: float = np.inf) -> FilterEvents:
    """Events that wait for a control message that does not come: the last one holds, for up to a gap.

    `initial` holds in a run in which there was none.
    """
    data = events.data.copy()
    for begin, end in pairwise(events.offsets):
        if begin < end:
            is_control = events.source[begin] == CONTROL
            control = data[begin, -len(initial) :].copy() if is_control else initial
            data[begin:end, -len(initial) :] = control
            late = events.time_ns[begin:end] - events.time_ns[begin] > gap_ns
            data[begin:end][late & is_control, -len(initial) :] = np.nan
    return events._replace(data=data)


def add_output_times(
    events: FilterEvents, start_ns: Integers, next_output: Integers, every_ns: int
) -> tuple[FilterEvents, Integers]:
    """Events, and between them one every so often, at which an estimate is wanted.

    From the prior on, or, where that is more than EARLY such times before the run's first event, from
    there on.
    """
    times, runs, next_outputs = [], [], next_output.copy()
    for number, (begin, end) in enumerate(pairwise(events.offsets)):
        if begin == end:
            continue
        first_ns, last_ns = events.time_ns[begin], events.time_ns[end - 1]
        is_old = next_output[number] == 0 and first_ns - start_ns[number] > EARLY * every_ns
        begins_ns = int(first_ns if is_old else start_ns[number])
        first = max(int(next_output[number]), -(-begins_ns // every_ns))
        stop = max(int(last_ns) // every_ns + 1, first)
        wanted = np.arange(first, stop) * every_ns
        own = events.time_ns[begin:end][events.wants_estimate[begin:end]]
        wanted = wanted[~np.isin(wanted, own)]
        next_outputs[number] = stop
        times.append(wanted)
        runs.append(np.full(len(wanted), number))
    if not times:
        return events, next_outputs
    offsets = np.searchsorted(np.concatenate(runs), np.arange(len(events.offsets)))
    width = events.data.shape[1]
    return join_events(
        events, output_times(offsets, np.concatenate(times), width, wants_estimate=True)
    ), next_outputs
