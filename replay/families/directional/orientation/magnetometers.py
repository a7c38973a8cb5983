"""Magnetometers with their own topic, for estimators of nine-axis samples.

A field is assigned to the next sample of the unit, as if it were part of that message; samples between
two fields have no field. The magnetometer may therefore have any rate.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.log import Clock, Topic, schemas
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.replaying.estimator import (
    Batch,
    Bound,
    Estimator,
    Initialized,
    Needed,
    Recursive,
)
from fuselog.replay.engine.streams.blocks import (
    Block,
    Events,
    Ragged,
    last_of_equals,
    merge_events,
    ragged_rows,
    run_of_rows,
)

FIELD = "magnetic_field_ut"
REFUSAL = (
    "has no magnetic field, which the heading needs, and there is no topic magnetic_field; import "
    "the field with fields.magnetic_field_ut = [...] in the mapping"
)


class _Waiting(NamedTuple):
    """Fields (runs, 3) that wait for a sample, NaN if there is no field, and the estimator's state."""

    field: Floats | None
    inner: Any


def with_magnetometer(estimator: Estimator[Any]) -> Estimator[Any]:
    """Return the estimator with support for a magnetometer on its own topic.

    Samples with equal stamps are replaced by the mean of their forces and turn rates, so that each of
    them contributes.
    """

    def bind(name: str, topics: Mapping[str, Topic], values: Any) -> list[Bound]:
        bound = estimator.bind(name, topics, values)
        units = [each.streams[0] for each in bound]
        return [
            _joining(_averaging(each), _magnetometer(each.streams[0], units, topics)) for each in bound
        ]

    needs = (
        f"{estimator.requirements}, .../magnetic_field ({schemas.MAGNETIC_FIELD.full_name}, optional)"
    )
    return replace(estimator, requirements=needs, bind=bind)


def _magnetometer(unit: str, units: list[str], topics: Mapping[str, Topic]) -> str:
    """Find a unit's magnetometer: in its namespace, or the only magnetometer if there is one unit."""
    own = f"{unit.rpartition('/')[0]}/magnetic_field"
    kind = schemas.MAGNETIC_FIELD.full_name
    there = [name for name, topic in topics.items() if topic.schema_name == kind]
    if own in there:
        return own
    return there[0] if len(there) == 1 and len(units) == 1 else ""


def _averaging(bound: Bound) -> Bound:
    """Wrap a bound estimator so that samples with equal stamps are averaged."""
    unit = bound.streams[0]
    if isinstance(bound, Batch):
        solve = bound.solve
        return replace(bound, solve=lambda given: solve({**given, unit: with_means(given[unit])}))
    run = bound.run

    def run_means(state: Any, block: Block) -> tuple[Any, list[Ragged]]:
        return run(state, block._replace(streams={unit: with_means(block.streams[unit])}))

    return replace(bound, run=run_means)


def with_means(samples: Ragged) -> Ragged:
    """Sort inertial samples by time, and replace samples with equal stamps by their mean."""
    stream, run = samples.stream, run_of_rows(samples.offsets)
    is_new = (np.diff(stream.publish_time_ns, prepend=-1) != 0) | (np.diff(run, prepend=-1) != 0)
    if is_new.all():
        return samples
    stamp, changed = np.cumsum(is_new) - 1, {}
    for name in ("specific_force_mps2", "turn_rate_radps"):
        changed[name] = stream[name].copy()
        for column in changed[name].T:
            known = np.isfinite(column)
            sums = np.bincount(stamp[known], column[known])
            column[known] = (sums / np.maximum(np.bincount(stamp[known]), 1))[stamp[known]]
    return Ragged(replace(stream, columns={**stream.columns, **changed}), samples.offsets)


def _joining(bound: Bound, magnetometer: str) -> Bound:
    """Wrap a bound estimator of a unit's samples so that it also uses the fields of a magnetometer."""
    unit = bound.streams[0]
    if not magnetometer:
        return replace(bound, needed={unit: Needed(FIELD, REFUSAL)})
    streams = (unit, magnetometer)
    if isinstance(bound, Batch):
        solve = bound.solve
        return replace(
            bound,
            streams=streams,
            solve=lambda given: solve({**given, unit: _joined_whole(given, streams, "publish_time")}),
        )

    def run(state: _Waiting, block: Block) -> tuple[_Waiting, list[Ragged]]:
        joined, waiting = _joined(block, streams, state.field)
        after, made = bound.run(state.inner, joined)
        return _Waiting(waiting, after), made

    changed = replace(
        bound, streams=streams, start=lambda static: _Waiting(None, bound.start(static)), run=run
    )
    if bound.initialization is None:
        return changed
    find = partial(_find, bound, streams)
    return replace(changed, initialization=replace(bound.initialization, topics=streams, find=find))


def _find(
    bound: Recursive,
    streams: tuple[str, str],
    first: Mapping[str, Ragged],
    static: Mapping[str, Ragged],
    clock: Clock,
) -> Initialized:
    assert bound.initialization is not None
    return bound.initialization.find({streams[0]: _joined_whole(first, streams, clock)}, static, clock)


def _joined_whole(given: Mapping[str, Ragged], streams: tuple[str, str], clock: Clock) -> Ragged:
    """Assign the fields of a magnetometer to the samples of a unit, for whole streams."""
    both = {topic: given[topic] for topic in streams}
    joined, _ = _joined(Block(both, merge_events(both, clock)), streams, None)
    return joined.streams[streams[0]]


def _joined(block: Block, streams: tuple[str, str], waiting: Floats | None) -> tuple[Block, Floats]:
    """Return a block of the unit's samples with fields assigned, and the fields not yet assigned.

    Args:
        block: messages of both topics.
        streams: the topics of the unit and the magnetometer.
        waiting: (runs, 3), fields after the last sample; None before the first block.
    """
    unit, fields = (block.streams[topic] for topic in streams)
    events, names = block.events, list(block.streams)
    begins = np.cumsum([0, *(len(ragged) for ragged in block.streams.values())])
    of_unit, of_fields = (names.index(topic) for topic in streams)
    is_sample, count = events.topic == of_unit, len(events.topic)
    run, places = run_of_rows(events.offsets), np.arange(count)
    begin = events.offsets[:-1]
    sampled = np.maximum.accumulate(np.where(is_sample, places, -1)) if count else places
    felt = np.maximum.accumulate(np.where(events.topic == of_fields, places, -1)) if count else places
    before = np.append(-1, sampled[:-1])[:count]  # the sample before each event, in any run
    is_new = is_sample & (felt > before) & (felt >= begin[run])
    runs = len(begin)
    waiting = np.full((runs, 3), np.nan) if waiting is None else waiting.copy()
    row = events.source - begins[of_unit]
    given = unit.stream.columns.get(FIELD, np.empty((len(unit), 0)))
    found = given.copy() if given.shape[1:] == (3,) else np.full((len(unit), 3), np.nan)
    values = fields[FIELD]
    source = events.source - begins[of_fields]
    made = np.full((count, 3), np.nan)
    made[is_new] = values[source[felt[is_new]]]
    is_first = is_sample & (before < begin[run]) & ~is_new
    made[is_first] = waiting[run[is_first]]
    waiting[run[is_sample]] = np.nan
    own = row[is_sample]
    lacks = ~np.isfinite(found[own]).all(axis=1)
    found[own[lacks]] = made[is_sample][lacks]
    ends = events.offsets[1:] - 1
    for number in np.flatnonzero(events.offsets[1:] > begin):
        last = felt[ends[number]]
        if last >= begin[number] and last > sampled[ends[number]]:
            waiting[number] = values[source[last]]
    stream = replace(unit.stream, columns={**unit.stream.columns, FIELD: found})
    offsets, time_ns = ragged_rows(is_sample, events.offsets), events.time_ns[is_sample]
    samples = Events(
        offsets, time_ns, np.zeros(len(time_ns), np.int64), own, last_of_equals(offsets, time_ns)
    )
    arrival = None if block.arrival is None else block.arrival[is_sample]
    return Block({streams[0]: Ragged(stream, unit.offsets)}, samples, arrival), waiting
