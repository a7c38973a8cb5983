"""Recursion through the events of a run in time, common to all models and methods.

The recursion makes one prediction per distinct stamp and one update per message, in the given order; a
control message changes the control of the next prediction. Messages before the time of the state are
ignored. The run ends when its belief becomes invalid.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import accumulate
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import schemas
from fuselog.recorders.log.streams import computed_stream
from fuselog.replay.engine.arrays import AnyArgument, Columns, Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged, filled_rows
from fuselog.replay.engine.streams.results import ALL_WELL, rows_of
from fuselog.replay.inference.kalman.steps import (
    NOT_DRIVEN,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    UNKNOWN,
    Belief,
    CoreMemory,
    EstimateRun,
    EstimatesToFill,
    InnovationRecord,
    Interval,
    Measurement,
    Steps,
)
from fuselog.replay.inference.linear_algebra.tuples import range_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.settings import ReadSettings
from fuselog.replay.inference.run.loops import Follow, over_events

# Columns of results share one array up to this size.
SHARED_BYTES = 1 << 24
CONTROL = -1  # source of an event; sensors count from zero, and NOTHING means only a time
NOTHING = -2


class FilterEvents(NamedTuple):
    """Events of all runs in order; events offsets[r]:offsets[r + 1] belong to run r.

    Attributes:
        offsets: (runs + 1,).
        time_ns: (n,) stamps.
        source: (n,) number of the sensor, CONTROL or NOTHING.
        data: (n, width) contents of the message, see `update.message_layout`; with an interpolated
            control, the last columns are the control.
        wants_estimate: (n,) whether the event requests an estimate.
        target_id: (n,) number of the target of the message, or 0.
        arrival: (n, 2) time of arrival, and position in the file; (n, 0) if events arrive in the order
            of their stamps.
    """

    offsets: Integers
    time_ns: Integers
    source: Integers
    data: Floats
    wants_estimate: NDArray[np.bool_]
    target_id: Integers
    arrival: Integers


class RecursionState(NamedTuple):
    """State of the recursion between blocks; the first axis is the run.

    Attributes:
        belief: the belief, of a type that the method defines.
        control: (runs, controls) current control.
        time_ns: (runs,) time of the belief.
        accepted_ns: (runs, sensors) time of the last measurement that the gate accepted, or of the
            start.
        failure: (runs,) ALL_WELL or an index of `steps.FAILURES`.
    """

    belief: Belief
    control: Floats
    time_ns: Integers
    accepted_ns: Integers
    failure: Integers


class EstimateRows(NamedTuple):
    """Estimates that the recursion fills; the filled rows of run r end before row `end[r]`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats


class InnovationRows(NamedTuple):
    """Innovations that the recursion fills; see `steps.InnovationRecord`."""

    end: Integers
    time_ns: Integers
    target_id: NDArray[np.uint32]
    difference: Floats
    covariance: Floats
    numbers: Floats


class RunInputs(NamedTuple):
    """Inputs of a recursion, for all runs.

    Attributes:
        events: events in the order of processing.
        settings: (runs, 1 + sensors, fields); see `settings_of`.
        gates: (sensors + 1, m + 1) bounds of the NIS by sensor; the last row is an open gate.
    """

    events: FilterEvents
    settings: Floats
    gates: Floats


class RunResults(NamedTuple):
    """Results of a recursion: estimates of a type that the method defines, and innovations."""

    estimates: EstimatesToFill
    innovations: InnovationRows


def recorded_innovations(
    topic: str, metadata: Mapping[str, str], innovations: InnovationRows, offsets: Integers
) -> Ragged:
    """Make the stream of innovations from the results of a recursion.

    Args:
        topic: topic of the stream.
        metadata: metadata of its channel: the measured components, and the topic with the truth.
        innovations: (n, ...) innovations of all runs, concatenated; see `filled`.
        offsets: (runs + 1,) first row of each run.
    """
    _, time_ns, target_id, difference, covariance, numbers = innovations
    columns: dict[str, Columns] = {
        "sensor_time_ns": time_ns,
        "target_id": target_id,
        "accepted": numbers[:, 2].astype(np.uint32),
        "innovation": difference,
        "covariance": rows_of(covariance),
        "normalised_innovation_squared": numbers[:, 0],
        "log_likelihood": numbers[:, 1],
    }
    stream = computed_stream(topic, schemas.INNOVATION, time_ns, columns, metadata)
    return Ragged(stream, offsets)


ResultsType = TypeVar("ResultsType", bound=tuple[AnyArgument, ...])


def no_results(
    due: Integers, recorded: Integers, model: Model, innovation_size: int
) -> tuple[EstimateRows, InnovationRows]:
    """Allocate results; for run r, estimates begin at row due[r], innovations at row recorded[r].

    All columns share one array. With many arrays, the operating system would map the pages of each array
    separately; this alone takes half as long as running a small filter. Large columns are separate,
    since only arrays of less than 32 MB can be made of freed memory, see `executors.keep_freed_memory`.

    Args:
        due: (runs + 1,) offsets of the estimates.
        recorded: (runs + 1,) offsets of the innovations.
        model: the model, for the sizes of state and tangent space.
        innovation_size: number of distinct components that the sensors measure.
    """
    size, places = _places(int(due[-1]), int(recorded[-1]), model.size, model.tangent, innovation_size)
    if size < SHARED_BYTES:
        memory = np.empty(size, np.uint8)
        columns = [np.ndarray(shape, dtype, memory, offset) for shape, dtype, offset in places]
    else:
        columns = [np.empty(shape, dtype) for shape, dtype, _ in places]
    estimates = EstimateRows(due[:-1].copy(), *columns[:3])
    return estimates, InnovationRows(recorded[:-1].copy(), *columns[3:])


@lru_cache(maxsize=64)
def _places(
    estimates: int, innovations: int, n: int, t: int, m: int
) -> tuple[int, tuple[tuple[tuple[int, ...], Columns, int], ...]]:
    """Return the size of the shared memory, and the shape, type and offset of each column, in bytes."""
    types = tuple(map(np.dtype, ("i8", "f8", "f8", "i8", "u4", "f8", "f8", "f8")))
    shapes = (
        *((estimates, *shape) for shape in ((), (n,), (t, t))),
        *((innovations, *shape) for shape in ((), (), (m,), (m, m), (3,))),
    )
    *begins, size = accumulate((8 * math.prod(shape) for shape in shapes), initial=0)
    return size, tuple(zip(shapes, types, begins, strict=True))


def filled(results: ResultsType, offsets: Integers) -> tuple[ResultsType, Integers]:
    """Remove the rows of results that were not filled; return the results and their new offsets.

    Args:
        results: estimates or innovations, with the `end` of each run's filled rows.
        offsets: (runs + 1,) first row of each run.
    """
    rows, kept = filled_rows(offsets, results[0])
    if isinstance(rows, slice):
        return results, kept
    columns: Columns = results[1:]
    made: Columns = type(results)
    return made(kept[1:], *(column.take(rows, axis=0) for column in columns)), kept


class ProcessEvent(Protocol):
    """Function that predicts a run to the time of an event and updates by it; see `processing`."""

    def __call__(
        self,
        run: int,
        event: int,
        inputs: RunInputs,
        carried: RecursionState,
        results: RunResults,
        memory: CoreMemory,
        /,
    ) -> int: ...


class WriteEstimate(Protocol):
    """Function that writes the next estimate of a run from a row of the belief.

    See `writing_estimates`.
    """

    def __call__(
        self,
        run: int,
        row: int,
        time_ns: int,
        belief: Belief,
        estimates: EstimatesToFill,
        memory: CoreMemory,
        /,
    ) -> int: ...


def processing(bound_model: BoundModel, steps: Steps, settings_of: ReadSettings) -> ProcessEvent:
    """Make the function that processes one event of a run; see `recursion`.

    Args:
        bound_model: the bound model.
        steps: steps of the method for the bound model.
        settings_of: `settings_of(settings, row)` makes the parameters of a row.

    Returns:
        `process(run, event, inputs, carried, results, memory)`.
    """
    predict = steps.predict
    updates = steps.updates
    interpolated = bound_model.model.control is not None and bound_model.model.control.interpolated
    has_gaps = bound_model.model.control is not None and bool(bound_model.model.control.gap)
    resumes_after_gap = steps.resumes_after_gap
    controls = bound_model.model.controls

    def drive(run: int, data: Floats, carried: RecursionState) -> None:
        """Set the control to that of an event; if interpolated, it is at the end of the event's data."""
        first = len(data) - controls if interpolated else 0
        for k in range(controls):
            if not np.isnan(data[first + k]):
                carried.control[run, k] = data[first + k]

    def advance(
        run: int,
        event: int,
        duration_s: float,
        inputs: RunInputs,
        carried: RecursionState,
        memory: CoreMemory,
    ) -> bool:
        control, data = carried.control[run], inputs.events.data[event]
        first = len(data) - controls
        if interpolated and not np.isnan(control[0]):  # the control of the step is the mean of both ends
            for k in range(controls):
                control[k] = 0.5 * (control[k] + data[first + k])
        interval = Interval(control, duration_s, settings_of(inputs.settings[run], 0), event)
        return predict(run, carried.belief, interval, memory)

    def process(
        run: int,
        event: int,
        inputs: RunInputs,
        carried: RecursionState,
        results: RunResults,
        memory: CoreMemory,
    ) -> int:
        """Predict to the time of an event and update by it; return a failure or ALL_WELL.

        In a gap of the control after which the filter continues, the result is UNKNOWN.
        """
        events, gates, innovations = inputs.events, inputs.gates, results.innovations
        source, data = events.source[event], events.data[event]
        duration_s = (events.time_ns[event] - carried.time_ns[run]) * 1e-9
        if duration_s > 0.0:
            if has_gaps and np.isnan(data[len(data) - 1]):
                if not resumes_after_gap:
                    return NOT_DRIVEN
                carried.control[run, :] = np.nan
                return UNKNOWN
            carried.time_ns[run] = events.time_ns[event]
            if not advance(run, event, duration_s, inputs, carried, memory):
                return NOT_POSITIVE_DEFINITE
        if duration_s >= 0.0 if interpolated else source == CONTROL:
            drive(run, data, carried)
        if source >= 0 and duration_s >= 0.0:
            row = innovations.end[run]
            record = InnovationRecord(
                innovations.difference[row], innovations.covariance[row], innovations.numbers[row]
            )
            parameters = settings_of(inputs.settings[run], source + 1)
            waited_s = (events.time_ns[event] - carried.accepted_ns[run, source]) * 1e-9
            gate = gates[-1] if waited_s > parameters.gate_reopens_s else gates[source]
            measurement = Measurement(data, parameters, gate, event)
            outcome = NOTHING_MEASURED
            for number in range_of(len(updates)):  # unrolled: a kernel cannot call functions by index
                if source == number:
                    outcome = updates[number](run, carried.belief, measurement, memory, record)
            if outcome >= 0:
                return outcome
            if outcome == ALL_WELL:
                if record.numbers[2] > 0.0:
                    carried.accepted_ns[run, source] = events.time_ns[event]
                innovations.time_ns[row] = events.time_ns[event]
                innovations.target_id[row] = events.target_id[event]
                innovations.end[run] = row + 1
        return ALL_WELL

    return process


def recursion(bound_model: BoundModel, steps: Steps, settings_of: ReadSettings) -> Follow:
    """Make the loop over events, for `fuselog.recorders.compiling.compile.compile_over_runs`.

    Args:
        bound_model: the bound model.
        steps: steps of the method for the bound model.
        settings_of: `settings_of(settings, row)` makes the parameters of a row: row 0 is the motion, and
            all other rows are sensors.

    Returns:
        `follow(run, inputs, carried, results, memory)`, which changes `carried` in place.
    """
    write = writing_estimates(steps.estimate)

    def record(
        run: int,
        event: int,
        inputs: RunInputs,
        carried: RecursionState,
        results: RunResults,
        memory: CoreMemory,
    ) -> int:
        """Write an estimate if the event requests one and is not older than the state."""
        time_ns = inputs.events.time_ns[event]
        if inputs.events.wants_estimate[event] and time_ns >= carried.time_ns[run]:
            return write(run, run, time_ns, carried.belief, results.estimates, memory)
        return ALL_WELL

    return over_events(processing(bound_model, steps, settings_of), record)


def writing_estimates(estimate: EstimateRun) -> WriteEstimate:
    """Make `write(run, row, time_ns, belief, estimates, memory)`, which writes the next estimate.

    The estimate is made from a row of the belief. The function returns a failure, see `fault_of`; an
    invalid estimate is not kept.

    Args:
        estimate: function of the method; see `Steps.estimate`.
    """

    def write(
        run: int,
        row: int,
        time_ns: int,
        belief: Belief,
        estimates: EstimatesToFill,
        memory: CoreMemory,
    ) -> int:
        result = estimates.end[run]
        estimate(row, belief, estimates, result, memory)
        failure = fault_of(estimates.mean[result], estimates.covariance[result])
        if failure == ALL_WELL:
            estimates.time_ns[result] = time_ns
            estimates.end[run] = result + 1
        return failure

    return write


def fault_of(mean: Floats, covariance: Floats) -> int:
    """Return the failure of an estimate that is not finite or has a negative variance, or ALL_WELL.

    Args:
        mean: (n,).
        covariance: (t, t).
    """
    total = 0.0
    for row in range(len(mean)):
        total += mean[row]
    for row in range(len(covariance)):
        of_row = 0.0  # so that the sums of rows do not wait for each other
        for column in range(row + 1):
            of_row += covariance[row, column]
        total += of_row
    if not np.isfinite(total):
        return NOT_FINITE
    for row in range(len(covariance)):
        if covariance[row, row] < 0.0:
            return NOT_POSITIVE_DEFINITE
    return ALL_WELL
