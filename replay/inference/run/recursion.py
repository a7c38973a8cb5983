"""Goes through the events of a run in time: the one recursion for all models and methods.

One prediction per distinct stamp, one update per message in the order given; a control message changes
what drives the next prediction. Messages before the state's own time say nothing. The run ends where its
belief is no Gaussian any more.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import schemas
from fuselog.recorders.log.streams import computed_stream
from fuselog.replay.engine.arrays import AnyArgument, Columns, Floats, Integers, RowSlice
from fuselog.replay.engine.streams.blocks import Ragged, filled_rows
from fuselog.replay.engine.streams.results import ALL_WELL, named, rows_of
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
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.settings import ReadSettings
from fuselog.replay.inference.model.stage import Stage
from fuselog.replay.inference.run.loops import Follow, over_events

CONTROL = -1  # an event's source; sensors count from zero, and NOTHING is only a time
NOTHING = -2


class FilterEvents(NamedTuple):
    """Holds the events of all runs in order: run r owns offsets[r]:offsets[r + 1].

    Attributes:
        offsets: (runs + 1,).
        time_ns: (n,).
        source: (n,) a sensor's number, CONTROL or NOTHING.
        data: (n, width) the numbers of the message, see `update.message_layout`; the control's where
            that is interpolated.
        wants_estimate: (n,) whether the estimate after the event is wanted.
        target_id: (n,) what the message is about, 0 for nothing.
        arrival: (n, 2) when the event was taken, and its place in the file; (n, 0) where that is the
            order of the stamps.
    """

    offsets: Integers
    time_ns: Integers
    source: Integers
    data: Floats
    wants_estimate: NDArray[np.bool_]
    target_id: Integers
    arrival: Integers


class RecursionState(NamedTuple):
    """Holds what the recursion carries from block to block; first axis = run.

    Attributes:
        belief: the method's own.
        control: (runs, controls), what drives the state.
        time_ns: (runs,), of the belief.
        accepted_ns: (runs, sensors), of the last measurement that the gate let in, or of the start.
        failure: (runs,), ALL_WELL or an index of `steps.FAILURES`.
    """

    belief: Belief
    control: Floats
    time_ns: Integers
    accepted_ns: Integers
    failure: Integers


class EstimateRows(NamedTuple):
    """Holds estimates as the recursion fills them in: those of run r end before row `end[r]`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats


class InnovationRows(NamedTuple):
    """Holds innovations as the recursion fills them in; see `steps.InnovationRecord`."""

    end: Integers
    time_ns: Integers
    target_id: NDArray[np.uint32]
    difference: Floats
    covariance: Floats
    numbers: Floats


class RunInputs(NamedTuple):
    """Holds what a recursion goes by, in all runs.

    Attributes:
        events: in the order in which they are processed.
        settings: (runs, 1 + sensors, fields), see `settings_of`.
        gates: (sensors + 1, m + 1), bounds of the NIS by sensor; the last row is an open gate's.
    """

    events: FilterEvents
    settings: Floats
    gates: Floats


class RunResults(NamedTuple):
    """Holds what a recursion fills in: the method's own estimates, and innovations."""

    estimates: EstimatesToFill
    innovations: InnovationRows


def recorded_innovations(
    topic: str, components: Mapping[str, str], truth: str, innovations: InnovationRows, offsets: Integers
) -> Ragged:
    """Make the stream of innovations that a recursion filled in.

    Args:
        topic: of the estimator.
        components: what is measured, with kinds.
        truth: the topic that the estimates are judged by.
        innovations: (n, ...), laid end to end, see `filled`.
        offsets: (runs + 1,), where those of each run begin.
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
    topic, metadata = f"{topic}/innovation", {**named(components), "truth": truth}
    stream = computed_stream(topic, schemas.INNOVATION, time_ns, columns, metadata)
    return Ragged(stream, offsets)


ResultsType = TypeVar("ResultsType", bound=tuple[AnyArgument, ...])


def no_results(
    due: Integers, recorded: Integers, model: Model, innovation_size: int
) -> tuple[EstimateRows, InnovationRows]:
    """Make results to be filled in: run r has the rows from due[r] and recorded[r] up to the next run's.

    All columns lie in one piece of memory, which is there at once: of many pieces, a system hands out
    every page by itself, and that takes as long as half of a small filter.

    Args:
        due: (runs + 1,) offsets of the estimates.
        recorded: (runs + 1,) offsets of the innovations.
        model: the model, for the sizes of its state and tangent space.
        innovation_size: how many components the sensors measure together.
    """
    places = _places(int(due[-1]), int(recorded[-1]), model.size, model.tangent, innovation_size)
    memory = np.empty(places[-1][0].stop)
    time_ns, mean, covariance, noted_ns, target_id, difference, spread, numbers = (
        memory[place].reshape(shape) for place, shape in places
    )
    estimates = EstimateRows(due[:-1].copy(), time_ns.view(np.int64), mean, covariance)
    reference = target_id.view(np.uint32)[: len(target_id)]
    innovations = InnovationRows(
        recorded[:-1].copy(), noted_ns.view(np.int64), reference, difference, spread, numbers
    )
    return estimates, innovations


@lru_cache(maxsize=64)
def _places(
    estimates: int, innovations: int, n: int, t: int, m: int
) -> tuple[tuple[RowSlice, tuple[int, ...]], ...]:
    """Return where the columns of so many estimates and innovations lie in memory, and their shapes."""
    shapes = (
        *((estimates, *shape) for shape in ((), (n,), (t, t))),
        *((innovations, *shape) for shape in ((), (), (m,), (m, m), (3,))),
    )
    ends = accumulate(map(math.prod, shapes), initial=0)
    return tuple((slice(*both), shape) for both, shape in zip(pairwise(ends), shapes, strict=True))


def filled(results: ResultsType, offsets: Integers) -> tuple[ResultsType, Integers]:
    """Cut results down to what was filled in, laid end to end, and return their offsets.

    Args:
        results: estimates or innovations, with the `end` that each run has reached.
        offsets: (runs + 1,) where the runs began.
    """
    end, *columns = results
    rows, kept = filled_rows(offsets, end)
    if isinstance(rows, slice):
        return results, kept
    made: Columns = type(results)
    return made(kept[1:], *(column.take(rows, axis=0) for column in columns)), kept


class ProcessEvent(Protocol):
    """Predicts to an event of a run and updates by it, see `processing`; an `OnEvent` of filters."""

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
    """Fills in the next estimate of a run from a row of the belief, see `writing_estimates`."""

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


def processing(stage: Stage, steps: Steps, settings_of: ReadSettings) -> ProcessEvent:
    """Make the function that processes one event of a run; see `recursion`.

    Args:
        stage: the model as the method takes it.
        steps: the method's steps for it.
        settings_of: `settings_of(settings, row)` makes a row's parameters.

    Returns `process(run, event, inputs, carried, results, memory)`.
    """
    predict = steps.predict
    updates = steps.updates
    interpolated = stage.model.control is not None and stage.model.control.interpolated
    has_gaps = stage.model.control is not None and bool(stage.model.control.gap)
    resumes_after_gap = steps.resumes_after_gap
    controls = stage.model.controls

    def drive(run: int, data: Floats, carried: RecursionState) -> None:
        """Take over the control that an event has; an interpolated one stands at the end of its data."""
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
        """Predict to an event."""
        control, data = carried.control[run], inputs.events.data[event]
        first = len(data) - controls
        if interpolated and not np.isnan(control[0]):  # the mean of both ends drives the step
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
        """Predict to one event and update by it; returns what failed, ALL_WELL where nothing did.

        UNKNOWN in a gap of the control after which it goes on.
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
            for number in range_of(len(updates)):  # written out: a kernel calls no function by number
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


def recursion(stage: Stage, steps: Steps, settings_of: ReadSettings) -> Follow:
    """Make the loop over events, for `fuselog.recorders.compiling.compile.compile_over_runs`.

    `settings_of(settings, row)` makes a row's parameters: 0 is the motion's, the others the sensors'.

    Args:
        stage: the model as the method takes it.
        steps: the method's steps for it.
        settings_of: see above.

    Returns `follow(run, inputs, carried, results, memory)`; it changes what is carried in place.
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
        """Fill in the estimate where one is wanted, from the state's own time on."""
        time_ns = inputs.events.time_ns[event]
        if inputs.events.wants_estimate[event] and time_ns >= carried.time_ns[run]:
            return write(run, run, time_ns, carried.belief, results.estimates, memory)
        return ALL_WELL

    return over_events(processing(stage, steps, settings_of), record)


def writing_estimates(estimate: EstimateRun) -> WriteEstimate:
    """Make `write(run, row, time_ns, belief, estimates, memory)`: it fills in a run's next estimate.

    That is of a row of the belief; an estimate that is none counts as not written. Returns what is wrong
    with it, see `fault_of`.

    Args:
        estimate: the method's, see `Steps.estimate`.
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
    """Find why an estimate is none: it is not finite, or a variance is negative; else ALL_WELL.

    Args:
        mean: (n,).
        covariance: (t, t).
    """
    total = 0.0
    for row in range(len(mean)):
        total += mean[row]
    for row in range(len(covariance)):
        for column in range(row + 1):
            total += covariance[row, column]
    if not np.isfinite(total):
        return NOT_FINITE
    for row in range(len(covariance)):
        if covariance[row, row] < 0.0:
            return NOT_POSITIVE_DEFINITE
    return ALL_WELL
