"""Conversion of a log's messages to events: rows of numbers in time order, independent of the model."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.arrays import Booleans, Floats, Integers, over_columns
from fuselog.replay.engine.streams.blocks import Block, Ragged, ragged_rows, run_of_rows
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.engine.streams.geodetic import GEODETIC, in_plane
from fuselog.replay.engine.streams.measurements import MeasuredVectors, read_fixes, read_vectors, unknown
from fuselog.replay.inference.kalman.update import message_layout
from fuselog.replay.inference.model.binding import Found
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Control, Map, Sensor
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.settings import complaint_of, reading_settings
from fuselog.replay.inference.run.recursion import CONTROL, NOTHING, FilterEvents
from fuselog.replay.inference.run.timing import last_of_stamps, select_events, share_stamps, where_wanted


@dataclass(frozen=True, eq=False)
class Points:
    """Points of a map in all runs: sorted keys, run * 2^32 + number, and positions (n, d)."""

    keys: Integers
    places: Floats

    @cached_property
    def _places(self) -> Floats:
        """The positions of the points, followed by a row of NaN, so that row -1 selects NaN."""
        return np.concatenate([self.places, np.full((1, self.places.shape[1]), np.nan)])

    @cached_property
    def _by_number(self) -> Integers:
        """The rows of points by run and number, -1 if missing; empty if most would be missing."""
        keys, first = np.unique(self.keys, return_index=True)
        runs, numbers = keys >> 32, keys & 0xFFFFFFFF
        shape = (runs.max(initial=-1) + 1, numbers.max(initial=-1) + 1)
        if np.prod(shape) > 16 * len(keys):
            return np.empty((0, 0), np.int64)
        found = np.full(shape, -1)
        found[runs, numbers] = first
        return found

    def rows(self, run: Integers, number: Integers) -> Integers:
        """Return the rows of the points with these numbers in these runs; -1 for missing points."""
        runs, numbers = self._by_number.shape
        if (
            runs
            and number.min(initial=0) >= 0
            and number.max(initial=0) < numbers
            and run.max(initial=0) < runs
        ):
            return self._by_number[run, number]
        keys = (run << 32) + number
        if len(self.keys) == 0:
            return np.full(len(keys), -1)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[rows] == keys, rows, -1)

    def at(self, rows: Integers) -> Floats:
        """Return the positions (m, d) at rows that `rows` returned; NaN for row -1."""
        return self._places.take(rows, axis=0)


def points_of(ragged: Ragged, asked: Map) -> Points:
    """Collect the points of a map in all runs.

    Args:
        ragged: messages of the map's topic, in all runs.
        asked: description of the map in the model.

    Raises BadInput if the points lack a component.
    """
    places = read_vectors(ragged.stream, asked.point, asked.components)
    run = run_of_rows(ragged.offsets)
    keys = (run << 32) + ragged[asked.number]
    order = np.argsort(keys, kind="stable")
    return Points(keys[order], np.ascontiguousarray(places[order]))


class Context(NamedTuple):
    """Data to which messages refer: points of maps, by topic, and origins of tangent planes.

    The origins (runs, 3) are latitude, longitude and altitude; None if no fix needs them.
    """

    points: Mapping[str, Points]
    origins: Floats | None


@lru_cache(maxsize=64)
def data_columns(bound_model: BoundModel) -> tuple[int, int]:
    """Return the number of columns of an event's data, and the first column of the control."""
    width, control = (
        max((message_layout(sensor).width for sensor in bound_model.sensors), default=0),
        bound_model.model.control,
    )
    start = width if control is not None and control.interpolated else 0
    return max(width, start + bound_model.model.controls), start


def events_of(
    bound_model: BoundModel, found: Found, block: Block, context: Context, settings: Floats
) -> tuple[FilterEvents, Booleans]:
    """Return the result of `filter_events`; it may be stored from an earlier replay of the same block.

    Args:
        bound_model, found, block, context, settings: as for `filter_events`.
    """
    drives = () if found.control is None else (found.control.name,)
    read = (topic.name for _, topic in (*found.fallbacks, *found.sensors))
    origins = None if context.origins is None else context.origins.tobytes()
    noise = [
        own_variances(bound_model, number, settings).tobytes()
        for number, sensor in enumerate(bound_model.sensors)
        if sensor.covariance
    ]
    key = bound_model, drives, *read, *context.points.values(), origins, *noise
    return block.once(key, lambda: filter_events(bound_model, found, block, context, settings))


def filter_events(
    bound_model: BoundModel, found: Found, block: Block, context: Context, settings: Floats
) -> tuple[FilterEvents, Booleans]:
    """Convert a block's messages to events of the recursion.

    Args:
        bound_model: the bound model, with the sensors of the log.
        found: its topics.
        block: messages of these topics, in all runs.
        context: maps and origins.
        settings: (1 + sensors, fields); see `settings_of`.

    Returns:
        The events, and whether each message (n,) of the block is skipped because it lacks a covariance
        or a finite control.
    """
    merged, control = block.events, bound_model.model.control
    width, start = data_columns(bound_model)
    uses: list[tuple[str, Table]] = []
    sampled: list[int] = []  # columns of samples, which do not apply until the next sample
    if control is not None and found.control is not None:
        columns = {name: start + index for index, name in enumerate(control.components)}
        replaced = {name for each, _ in found.fallbacks for name in each.components}
        own = {name: column for name, column in columns.items() if name not in replaced}
        name = found.control.name
        uses.append((name, _control_table(control, block.streams[name], width, own)))
        for each, topic in found.fallbacks:
            uses.append((topic.name, _control_table(each, block.streams[topic.name], width, columns)))
        for each in (*(drive for drive, _ in found.fallbacks), control):
            if each.schema is schemas.INERTIAL_SAMPLE:
                sampled += [columns[component] for component in each.components]
    for number, (_, topic) in enumerate(found.sensors):
        given = bound_model, number, block.streams[topic.name], context, settings
        is_further = topic.name in dict(uses)
        uses.append((topic.name, sensor_table(*given, only_measured=is_further)))
    tables = dict(reversed(uses))  # the first use of every topic
    data, source, target, without_covariance = (
        column[0] if len(column) == 1 else np.concatenate(column).take(merged.source, axis=0)
        for column in zip(*(tables[name][:4] for name in block.streams), strict=True)
    )
    arrival = np.empty((len(source), 0), np.int64) if block.arrival is None else block.arrival
    events = FilterEvents(merged.offsets, merged.time_ns, source, data, merged.is_last, target, arrival)
    again = [_again(events, block, name, table) for name, table in uses if table is not tables[name]]
    if without_covariance.any():  # events without these
        chosen = ~without_covariance
        after = np.cumsum(chosen)
        again = [(after[places] - 1, others) for places, others in again]
        events = select_events(events, chosen)
    if again:
        events = _inserted(events, again)
    if without_covariance.any() or again:
        events = events._replace(wants_estimate=last_of_stamps(events))
    if sampled and not events.arrival.shape[1]:
        events = share_stamps(events, sampled)
    return events._replace(wants_estimate=where_wanted(bound_model, events)), without_covariance


class Table(NamedTuple):
    """Messages of one topic: data (n, width), source, target, and whether each message is skipped.

    `rows` (n,) are their numbers in the topic; None for all messages.
    """

    data: Floats
    source: Integers
    target_id: Integers
    lacks_covariance: Booleans
    rows: Integers | None = None


def _again(events: FilterEvents, block: Block, name: str, table: Table) -> tuple[Integers, FilterEvents]:
    """Convert messages of a topic to measurements of a further sensor; also return event indices.

    Messages without a measurement for the sensor are left out.
    """
    before = list(block.streams).index(name)
    begin = sum(len(ragged) for ragged in list(block.streams.values())[:before])
    of_topic = block.events.topic == before
    row = np.where(of_topic, block.events.source - begin, 0)
    measures = ~over_columns(np.logical_and, np.isnan(table.data)) & ~table.lacks_covariance
    known = np.flatnonzero(measures)
    place = np.full(len(block.streams[name]), -1)
    place[known if table.rows is None else table.rows[known]] = known
    chosen = of_topic & (place[row] >= 0)
    data, source, target = (column.take(place[row[chosen]], axis=0) for column in table[:3])
    again = select_events(events, chosen)._replace(data=data, source=source, target_id=target)
    return np.flatnonzero(chosen), again


def _inserted(events: FilterEvents, again: Sequence[tuple[Integers, FilterEvents]]) -> FilterEvents:
    """Insert further events after the events at the given indices."""
    places, others = zip(*again, strict=True)
    order = np.argsort(np.concatenate([np.arange(len(events.time_ns)), *places]), kind="stable")
    offsets, *columns = zip(events, *others, strict=True)
    joined = (np.concatenate(column).take(order, axis=0) for column in columns)
    return FilterEvents(sum(offsets), *joined)


def _control_table(control: Control, ragged: Ragged, width: int, columns: Mapping[str, int]) -> Table:
    """Read a control into the columns of its components; NaN for components that fallbacks replace."""
    count, names = len(ragged), control.components
    data = np.full((count, width), np.nan)
    read = control_numbers(control, ragged)
    for name, numbers in zip(names, read.T, strict=True):
        if name in columns:
            data[:, columns[name]] = numbers
    # a message without finite components, or one that cannot be interpolated, is skipped
    known = np.isfinite(read)
    enough = np.logical_and if control.interpolated else np.logical_or
    says_nothing = np.logical_not(over_columns(enough, known))
    return Table(data, np.full(count, CONTROL), np.zeros(count, np.int64), says_nothing)


def control_numbers(control: Control, ragged: Ragged) -> Floats:
    """Read the control (n, components)."""
    names = control.components
    return _computed(control.read, ragged, len(names)) if control.read else _fields(ragged.stream, names)


def sensor_table(
    bound_model: BoundModel,
    number: int,
    ragged: Ragged,
    context: Context,
    settings: Floats,
    *,
    only_measured: bool = False,
) -> Table:
    """Read the messages of a sensor: measurement, reference and covariance; see `update.message_layout`.

    Messages that lack a covariance, or have no finite component, are marked as not used.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
        ragged: messages of the sensor in all runs.
        context: maps and origins.
        settings: (1 + sensors, fields); see `settings_of`.
        only_measured: whether messages without a measured component may be left out.

    Raises BadInput if a field has another width than the model declares.
    """
    sensor, (width, _) = bound_model.sensors[number], data_columns(bound_model)
    m = len(sensor.measured)
    if ragged.stream.schema.full_name == GEODETIC:
        assert context.origins is not None
        ragged = in_plane(ragged, context.origins)
    stream = ragged.stream
    without_covariance = np.zeros(len(stream), bool)
    if sensor.covariance:
        value, spread, without_covariance = with_covariance(sensor, ragged)
        variances = own_variances(bound_model, number, settings)
        if np.isfinite(variances).all():
            spread[without_covariance], without_covariance = (
                np.diag(variances),
                np.zeros(len(stream), bool),
            )
        without_covariance = without_covariance | over_columns(np.logical_and, np.isnan(value))
        parts = [value, spread[:, *_lower(m)]]
    else:
        parts = [without_covariance_of(sensor, ragged)]
    rows = None
    if only_measured and not sensor.reference_size:
        rows = np.flatnonzero(~over_columns(np.logical_and, np.isnan(parts[0])))
        without_covariance, *parts = (each.take(rows, axis=0) for each in (without_covariance, *parts))
    count = len(without_covariance)
    source, target = np.full(count, number), np.zeros(count, np.int64)
    reference: list[Floats] = []
    numbers = [stream[each.of].astype(np.int64) for each in sensor.maps]
    if sensor.maps:
        target = numbers[0]
        run = run_of_rows(ragged.offsets)
    for each, number_of in zip(sensor.maps, numbers, strict=True):
        places = context.points[each.topic]
        found = places.rows(run, number_of)
        source[found < 0] = NOTHING
        reference.append(places.at(found))
    if sensor.control is not None:  # see `fill_control`
        reference.append(np.full((len(stream), len(sensor.control.components)), np.nan))
    reference += [_field(stream, name, size) for name, size in sensor.fields.items()]
    if sensor.is_numbered:
        reference.append(np.stack(numbers, axis=1).astype(float))
    parts[1:1] = reference
    source[without_covariance] = NOTHING
    data, filled = np.empty((count, width)), 0
    for part in parts:
        data[:, filled : filled + part.shape[1]] = part
        filled += part.shape[1]
    data[:, filled:] = np.nan
    return Table(data, source, target, without_covariance, rows)


@lru_cache(maxsize=64)
def _lower(size: int) -> tuple[Integers, Integers]:
    """Return the rows and columns of the lower triangle of a matrix, row by row."""
    rows, columns = np.tril_indices(size)
    return rows, columns


def own_variances(bound_model: BoundModel, number: int, settings: Floats) -> Floats:
    """Compute a sensor's variances for messages without a covariance; NaN if it defines none.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
        settings: (1 + sensors, fields); see `settings_of`.
    """
    sensor = bound_model.sensors[number]
    parameters = reading_settings(number_fields(bound_model.model.parameters))(settings, number + 1)
    return np.array(sensor.noise(parameters) if sensor.noise else np.nan, float)


def without_covariance_of(sensor: Sensor, ragged: Ragged) -> Floats:
    """Read measurements (n, m) from messages that state no covariance; NaN for missing components."""
    if sensor.read:
        return _computed(sensor.read, ragged, len(sensor.measured))
    if sensor.vector:
        return read_vectors(ragged.stream, sensor.vector, sensor.measured)
    return _fields(ragged.stream, tuple(sensor.measured))


def with_covariance(sensor: Sensor, ragged: Ragged) -> MeasuredVectors:
    """Read measurements, their covariances, and whether each message lacks a covariance."""
    if isinstance(sensor.covariance, str):
        return read_fixes(ragged.stream, sensor.vector, sensor.covariance, sensor.measured, None)
    assert sensor.read is not None
    m = len(sensor.measured)
    value = _computed(sensor.read, ragged, m)
    spread = np.array(sensor.covariance(ragged.stream), float).reshape(len(value), m, m)
    return MeasuredVectors(value, spread, unknown(spread))


def _fields(stream: Stream, names: Sequence[str]) -> Floats:
    return np.stack([stream[name] for name in names], axis=1)


def _field(stream: Stream, name: str, size: int) -> Floats:
    """Read a field of numbers or vectors (n, size); raise BadInput if its width differs."""
    if not len(stream):  # the width of vectors is unknown here
        return np.empty((0, size))
    numbers = np.asarray(stream[name], float).reshape(len(stream), -1)
    if numbers.shape[1] != size:
        raise BadInput(
            f"topic {stream.topic}: {name} has {numbers.shape[1]} components; the model needs {size}"
        )
    return numbers


def _computed(read: Callable[[Stream], Floats], ragged: Ragged, components: int) -> Floats:
    """Call the `read` function of a model on a topic; raise BadInput if its array has a wrong shape."""
    if not len(ragged):  # the width of vectors is unknown here
        return np.empty((0, components))
    numbers = np.asarray(read(ragged.stream), float)
    if numbers.shape != (len(ragged), components):
        raise BadInput(
            f"topic {ragged.stream.topic}: the model reads an array of shape {numbers.shape} from "
            f"{len(ragged)} messages; expected ({len(ragged)}, {components})"
        )
    return numbers


def not_driven(name: str, control: Control, found: Found, events: FilterEvents) -> Ragged:
    """Report measurements that were skipped because the control had a gap.

    Args:
        name: name of the filter.
        control: interpolated control, which is NaN in its gaps.
        found: topics of the filter.
        events: events with the control.
    """
    in_gap = (events.source >= 0) & np.isnan(events.data[:, -1])
    reasons = [
        f"topic {topic.name}: the state is unknown while {control.topic} is missing for longer than "
        f"{control.gap}"
        for _, topic in found.sensors
    ]
    stream = reason_stream(
        f"/estimates/{name}/skipped",
        schemas.SKIPPED,
        events.time_ns[in_gap],
        events.source[in_gap],
        reasons,
    )
    return Ragged(stream, ragged_rows(in_gap, events.offsets))


@lru_cache(maxsize=64)
def _may_pass_over(bound_model: BoundModel) -> bool:
    """Test whether there can be messages that are skipped, even if there are none in a block."""
    control = bound_model.model.control
    drops = control is not None and control.interpolated
    return drops or any(sensor.covariance for sensor in bound_model.sensors)


def passed_over(
    name: str, bound_model: BoundModel, found: Found, block: Block, without_covariance: Booleans
) -> list[Ragged]:
    """Report messages skipped for lack of a covariance or a finite control; [] if none can be skipped.

    Args:
        name: name of the filter.
        bound_model: the bound model, with the sensors of the log.
        found: its topics.
        block: messages of these topics.
        without_covariance: whether each message (n,) is skipped; see `filter_events`.
    """
    if not np.count_nonzero(without_covariance) and not _may_pass_over(bound_model):
        return []
    sensors = {topic.name: sensor for sensor, topic in found.sensors}
    reasons = [
        complaint_of(bound_model.model, sensors[topic], topic)
        if topic in sensors
        else f"topic {topic}: the control is not finite"
        for topic in block.streams
    ]
    merged = block.events
    stream = reason_stream(
        f"/estimates/{name}/skipped",
        schemas.SKIPPED,
        merged.time_ns[without_covariance],
        merged.topic[without_covariance],
        reasons,
    )
    return [Ragged(stream, ragged_rows(without_covariance, merged.offsets))]
