"""Timing of events: delays, interpolated controls, and additional output times."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Columns, Floats, Integers
from fuselog.replay.engine.streams.blocks import last_of_equals, ragged_rows, run_of_rows
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.run.recursion import CONTROL, NOTHING, FilterEvents

EARLY = 1000  # intervals of output: a prior that is older than this does not start the output times


def where_wanted(bound_model: BoundModel, events: FilterEvents) -> Booleans:
    """Test whether each event (n,) requests an estimate; control-only stamps may be excluded."""
    control = bound_model.model.control
    if control is None or control.estimates or not bound_model.sensors:
        return events.wants_estimate
    return at_stamps_of(events.wants_estimate, events.source != CONTROL)


def at_stamps_of(is_last: Booleans, chosen: Booleans) -> Booleans:
    """Select the last event of each stamp that has a chosen event; returns booleans (n,).

    Args:
        is_last: (n,) whether each event is the last of its stamp.
        chosen: (n,) whether each event is chosen.
    """
    stamp: Integers = np.cumsum(is_last) - is_last
    has_one = np.zeros(int(stamp[-1]) + 1 if len(stamp) else 0, bool)
    has_one[stamp[chosen]] = True
    return is_last & has_one[stamp]


def delays_of(bound_model: BoundModel, settings: Floats) -> Integers:
    """Compute the delays in ns from measurement to stamp, by source of the event.

    Args:
        bound_model: the bound model, with the sensors of the log.
        settings: (1 + sensors, fields); see `settings_of`. Or (runs, 1 + sensors, fields).

    Returns:
        (sensors + 2,) delays of the sensors, then 0 for NOTHING, then the delay of CONTROL; or (runs,
        sensors + 2).
    """
    names, control = number_fields(bound_model.model.parameters), bound_model.model.control
    asked = [(number + 1, sensor.delay) for number, sensor in enumerate(bound_model.sensors)]
    asked += [(0, ""), (0, control.delay if control else "")]
    zero = np.zeros(settings.shape[:-2])
    delays_s = [settings[..., row, names.index(name)] if name else zero for row, name in asked]
    return np.rint(1e9 * np.stack(delays_s, axis=-1)).astype(np.int64)


def compensate_delays(
    bound_model: BoundModel, events: FilterEvents, delays_ns: Integers, *, is_end: bool
) -> tuple[FilterEvents, FilterEvents]:
    """Move events to their times of measurement, in order; return ready and waiting events.

    An event waits if it was measured less than the longest delay before the last stamp of its run,
    because an earlier event may still arrive; at the end, no event waits.

    Args:
        bound_model: the bound model, with the sensors of the log.
        events: events in the order of their stamps.
        delays_ns: (sensors + 2,) or (runs, sensors + 2); see `delays_of`.
        is_end: whether no more events will arrive.
    """
    run = run_of_rows(events.offsets)
    last_ns = np.append(events.time_ns, 0)[events.offsets[1:] - 1]
    delays_ns = np.broadcast_to(delays_ns, (len(last_ns), delays_ns.shape[-1]))
    time_ns = events.time_ns - delays_ns[run, events.source]
    settled = is_end | (time_ns < (last_ns - delays_ns.max(axis=1))[run])
    waiting = select_events(events, ~settled)
    places = np.flatnonzero(settled)
    order = places[np.lexsort((time_ns[places], run[places]))]
    columns: Columns = (column.take(order, axis=0) for column in events._replace(time_ns=time_ns)[1:])
    measured = FilterEvents(ragged_rows(settled, events.offsets), *columns)
    measured = measured._replace(wants_estimate=last_of_stamps(measured))
    return measured._replace(wants_estimate=where_wanted(bound_model, measured)), waiting


def last_of_stamps(events: FilterEvents) -> Booleans:
    """Test whether the next event of the run has a different stamp or arrival time."""
    return last_of_equals(events.offsets, events.time_ns, *events.arrival.T[:1])


def output_times(
    offsets: Integers, time_ns: Integers, width: int, *, wants_estimate: bool
) -> FilterEvents:
    """Make events that consist only of a time; events offsets[r]:offsets[r + 1] belong to run r.

    Args:
        offsets: (runs + 1,).
        time_ns: (n,) the times.
        width: number of data columns of the other events.
        wants_estimate: whether each event requests an estimate.
    """
    count = len(time_ns)
    nothing = np.full(count, NOTHING), np.full((count, width), np.nan)
    reference, arrival = np.zeros(count, np.int64), np.empty((count, 0), np.int64)
    return FilterEvents(offsets, time_ns, *nothing, np.full(count, wants_estimate), reference, arrival)


def join_events(first: FilterEvents, second: FilterEvents) -> FilterEvents:
    """Merge two sequences of events by time, run by run; at ties, the first sequence is first."""
    first, second = _with_arrivals(first, second), _with_arrivals(second, first)
    run = np.concatenate([run_of_rows(each.offsets) for each in (first, second)])
    order = np.lexsort((np.concatenate([first.time_ns, second.time_ns]), run))
    columns: Columns = (np.concatenate(both) for both in zip(first[1:], second[1:], strict=True))
    if (order[1:] < order[:-1]).any():
        columns = (column.take(order, axis=0) for column in columns)
    return FilterEvents(first.offsets + second.offsets, *columns)


def _with_arrivals(events: FilterEvents, other: FilterEvents) -> FilterEvents:
    """Add arrival times, equal to the stamps, to events if the other events have arrival times."""
    if events.arrival.shape[1] >= other.arrival.shape[1]:
        return events
    time_ns = events.time_ns
    return events._replace(arrival=np.stack([time_ns, np.full(len(time_ns), -1)], axis=1))


def select_events(events: FilterEvents, chosen: Booleans) -> FilterEvents:
    """Select some of the events.

    Args:
        events: n events of all runs.
        chosen: (n,) whether each event is selected.
    """
    if chosen.all():
        return events
    places = np.flatnonzero(chosen)
    columns: Columns = (column.take(places, axis=0) for column in events[1:])
    return FilterEvents(ragged_rows(chosen, events.offsets), *columns)


def share_stamps(events: FilterEvents, columns: Iterable[int]) -> FilterEvents:
    """Replace control samples that have the same stamp by their mean, so that no sample is lost.

    A recorder may give two samples the same stamp; without this step, one of them would have no effect.

    Args:
        events: events in the order of their stamps.
        columns: columns of the control that contain samples.
    """
    at = np.flatnonzero(events.source == CONTROL)
    run = run_of_rows(events.offsets)[at]
    is_new = (np.diff(events.time_ns[at], prepend=-1) != 0) | (np.diff(run, prepend=-1) != 0)
    if is_new.all():
        return events
    stamp, data = np.cumsum(is_new) - 1, events.data.copy()
    for column in columns:
        known = at[np.isfinite(data[at, column])]
        of = stamp[np.isfinite(data[at, column])]
        sums = np.bincount(of, data[known, column])
        data[known, column] = (sums / np.maximum(np.bincount(of), 1))[of]
    return events._replace(data=data)


def interpolate_control(
    events: FilterEvents, controls: int, gap_ns: float = np.inf
) -> tuple[FilterEvents, FilterEvents]:
    """Interpolate the control linearly at all events; return ready and waiting events.

    Events after a run's last control message wait for the next one, together with that message. During a
    gap, from just after the last message up to and including the next message, the control is NaN.

    Args:
        events: events in order; control messages have the control in their last columns.
        controls: number of components of the control.
        gap_ns: longest time without messages of the control.
    """
    data, is_control = events.data.copy(), events.source == CONTROL
    ready, waiting = np.zeros(len(data), bool), np.ones(len(data), bool)
    columns = range(data.shape[1] - controls, data.shape[1])
    for begin, end in pairwise(events.offsets):
        at = begin + np.flatnonzero(is_control[begin:end])
        if not len(at):
            continue
        inside = np.arange(begin, at[-1] + 1)
        times_ns = events.time_ns[at] - events.time_ns[begin]
        if np.all(np.diff(times_ns) > 0):  # messages of the control keep their own
            inside = inside[~is_control[inside]]
        wanted_ns = events.time_ns[inside] - events.time_ns[begin]
        for column in columns:
            data[inside, column] = np.interp(wanted_ns, times_ns, data[at, column])
        for late in np.flatnonzero(np.diff(times_ns) > gap_ns):
            data[at[late] + 1 : at[late + 1] + 1, -controls:] = np.nan
        ready[begin : at[-1] + 1], waiting[begin : at[-1]] = True, False
    again = events._replace(wants_estimate=events.wants_estimate & ~ready)  # one estimate suffices
    return select_events(events._replace(data=data), ready), select_events(again, waiting)


def fill_control(bound_model: BoundModel, events: FilterEvents) -> FilterEvents:
    """Copy the interpolated control to the events of sensors that read it."""
    if all(sensor.control is None for sensor in bound_model.sensors):
        return events
    data = events.data.copy()
    for number, sensor in enumerate(bound_model.sensors):
        if sensor.control is not None:
            rows, controls = events.source == number, len(sensor.control.components)
            begin = len(sensor.measured) + sensor.control_start
            data[rows, begin : begin + controls] = data[rows, -controls:]
    return events._replace(data=data)


def hold_control(events: FilterEvents, initial: Sequence[float], gap_ns: float = np.inf) -> FilterEvents:
    """Apply the last control to events still waiting at the end of a log, for at most `gap_ns`.

    Args:
        events: waiting events; if a run has a control message, its last one is the first of these
            events.
        initial: control of runs without a control message.
        gap_ns: longest time without messages of the control.
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
    """Add events at regular output times, which request an estimate.

    Output starts at the prior, or at the run's first event if that event is more than EARLY intervals
    after the prior.

    Args:
        events: events in order.
        start_ns: (runs,) stamps of the priors.
        next_output: (runs,) number of the next output time.
        every_ns: interval of output; output times are multiples of it.

    Returns:
        The events, and the numbers (runs,) of the next output times.
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
