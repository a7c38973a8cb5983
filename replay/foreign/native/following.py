"""Processing of messages by the filters of a library, in one loop with calls by address.

The calls are made from kernels, without any Python code between messages.
"""

import ctypes
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.compiling.kernels.numbers import REAL, WHOLE, Emitter, Number
from fuselog.recorders.compiling.kernels.program import Program
from fuselog.recorders.compiling.kernels.values import Array
from fuselog.replay.engine.arrays import Floats, Integers, varying
from fuselog.replay.engine.streams.blocks import copied, filled_rows
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.foreign.description import Description
from fuselog.replay.foreign.native.library import NOTHING, REJECTED, WELL, Addresses, Library
from fuselog.replay.foreign.results import Results
from fuselog.replay.inference.linear_algebra.gaussian import (
    LOG_TWO_PI,
    Innovation,
    drop_missing,
    no_innovation,
    whiten,
)
from fuselog.replay.inference.run.recursion import (
    EstimateRows,
    FilterEvents,
    InnovationRows,
    fault_of,
    filled,
)

# Codes of failures that any filter can have; a filter's own status s has the code OWN + s.
NOT_CREATED, NOT_COPIED, INNOVATION_UNSOUND, UNDEFINED, OWN = 5, 6, 7, 8, 8
FAILED = -10  # the status FAILED - code means the failure of that code; the header's statuses are larger
NOBODY = -1  # the caller if no estimate is requested
FAILURES = {
    0: "a variance of the filter's covariance is negative",
    1: "the filter's estimate or covariance is not finite",
    NOT_CREATED: "fuselog_filter_create returned NULL",
    NOT_COPIED: "fuselog_filter_copy returned NULL",
    INNOVATION_UNSOUND: "the covariance of the filter's innovation is not positive definite",
    UNDEFINED: "the filter returned a negative number that fuselog_filter.h does not define",
}

_LLVM = {"i32": "i32", "i64": "i64", "pointer": "ptr", "void": "void"}
_C: dict[str, Any] = {
    "i32": ctypes.c_int32,
    "i64": ctypes.c_int64,
    "pointer": ctypes.c_void_p,
    "void": None,
}


class Filters(NamedTuple):
    """Filters of all runs; the first axis is the run.

    Attributes:
        handle: (runs,) addresses; 0 if there is no filter.
        time_ns: (runs,) stamp of the prior or, after the first message, of the last message.
        begun: (runs,) 0 until the filter has started, then 1.
        failure: (runs,) ALL_WELL, or a code; see `reason_of_code`.
        mean, covariance: (runs, n) and (runs, t, t), means and covariances of the priors.
        has_prior: (runs,) 0 if the filter starts without a prior.
    """

    handle: Integers
    time_ns: Integers
    begun: Integers
    failure: Integers
    mean: Floats
    covariance: Floats
    has_prior: Integers


@varying(1)
class Static(NamedTuple):
    """Messages that are processed before the start: rows offsets[r]:offsets[r + 1] belong to run r."""

    offsets: Integers
    time_ns: Integers
    source: Integers
    data: Floats


class Given(NamedTuple):
    """Input of the filters of all runs, and the functions to call."""

    addresses: Addresses
    static: Static
    events: FilterEvents


def follow(
    run: int, given: Given, carried: Filters, made: Results, work: tuple[Innovation, Innovation]
) -> None:
    """Pass the messages of one run to its filter in order and store the results, until the run fails."""
    events = given.events
    for event in range(events.offsets[run], events.offsets[run + 1]):
        caller = event if events.wants_estimate[event] else NOBODY
        advance(run, event, caller, given, carried, made, work)


def advance(
    run: int,
    event: int,
    caller: int,
    given: Given,
    carried: Filters,
    made: Results,
    work: tuple[Innovation, Innovation],
) -> None:
    """Pass a message to a filter that has not failed, and store its innovation.

    `caller` is the message after which an estimate is requested, or `NOBODY`.
    """
    if carried.failure[run] == ALL_WELL:
        addresses, static, events = given
        made.progress[run] = event
        time_ns = events.time_ns[event]
        status = WELL
        if carried.begun[run] == 0:
            carried.begun[run] = 1
            status = begin(run, addresses, static, time_ns, carried)
        if status == WELL and time_ns >= carried.time_ns[run]:
            carried.time_ns[run] = time_ns
            status = take(run, event, addresses, events, carried, made.innovations, work)
            if status == WELL and caller != NOBODY:
                status = tell(run, event, caller, given, carried, made)
        if status != WELL:
            carried.failure[run] = OWN + status if status > 0 else FAILED - status
            carried.time_ns[run] = time_ns


def outcome(status: int) -> int:
    """Convert the return value of a filter's function to WELL or the code of a failure."""
    if status < REJECTED:
        return FAILED - UNDEFINED
    return max(status, WELL)


def begin(run: int, addresses: Addresses, static: Static, time_ns: int, carried: Filters) -> int:
    """Pass static messages to the filter and start it; return WELL or the code of a failure."""
    handle = carried.handle[run]
    for row in range(static.offsets[run], static.offsets[run + 1]):
        status = TAKE(addresses.take, handle, static.source[row], static.time_ns[row], static.data[row])
        if outcome(status) != WELL:
            return outcome(status)
    if carried.has_prior[run] == 0:
        carried.time_ns[run] = time_ns
        status = START(addresses.start, handle, time_ns, 0, 0)
    else:
        start_ns = carried.time_ns[run]
        status = START(addresses.start, handle, start_ns, carried.mean[run], carried.covariance[run])
    return outcome(status)


def take(
    run: int,
    event: int,
    addresses: Addresses,
    events: FilterEvents,
    carried: Filters,
    innovations: InnovationRows,
    work: tuple[Innovation, Innovation],
) -> int:
    """Pass a message to the filter and store its innovation; return WELL or the code of a failure."""
    handle, time_ns = carried.handle[run], events.time_ns[event]
    if events.source[event] < 0:
        return outcome(PREDICT(addresses.predict, handle, time_ns))
    status = TAKE(addresses.take, handle, events.source[event], time_ns, events.data[event])
    if outcome(status) != WELL or addresses.innovation == 0:
        return outcome(status)
    given, kept = work
    for i in range(len(given.difference)):
        given.difference[i] = np.nan
    status = INNOVATION(addresses.innovation, handle, given.difference, given.covariance)
    if outcome(status) != WELL or status == NOTHING:
        return outcome(status)
    row = innovations.end[run]
    for i in range(len(given.difference)):
        kept.difference[i] = given.difference[i]
        innovations.difference[row, i] = given.difference[i]
        for j in range(len(given.difference)):
            kept.covariance[i, j] = given.covariance[i, j]
            missing = np.isnan(given.difference[i] + given.difference[j])
            innovations.covariance[row, i, j] = np.nan if missing else given.covariance[i, j]
    size = drop_missing(kept)
    squared, determinant = whiten(kept, size)
    if np.isnan(squared):
        return FAILED - INNOVATION_UNSOUND
    accepted = size > 0 and status != REJECTED
    innovations.numbers[row, 0] = squared
    innovations.numbers[row, 1] = 0.0
    innovations.numbers[row, 2] = 1.0 if accepted else 0.0
    if accepted:
        innovations.numbers[row, 1] = -0.5 * (squared + determinant + size * LOG_TWO_PI)
    innovations.time_ns[row] = time_ns
    innovations.target_id[row] = events.target_id[event]
    innovations.end[run] = row + 1
    return WELL


def tell(run: int, event: int, caller: int, given: Given, carried: Filters, made: Results) -> int:
    """Store the filter's estimate; return WELL or the code of a failure."""
    estimates, events = made.estimates, given.events
    row, state = estimates.end[run], given.addresses.state
    status = STATE(state, carried.handle[run], estimates.mean[row], estimates.covariance[row])
    if outcome(status) != WELL or status == NOTHING:
        return outcome(status)
    fault = fault_of(estimates.mean[row], estimates.covariance[row])
    if fault != ALL_WELL:
        return FAILED - fault
    estimates.time_ns[row] = events.time_ns[event]
    made.issued_ns[row] = events.time_ns[event]
    if events.arrival.shape[1] > 0:
        made.issued_ns[row] = events.arrival[caller, 0]
    estimates.end[run] = row + 1
    return WELL


@lru_cache(maxsize=1)
def _loop() -> OverRuns:
    return compile_over_runs(follow, title="filters of a library")


def reason_of_code(code: int, description: Description) -> str:
    """Return the message that explains a failure code."""
    if code in FAILURES:
        return FAILURES[code]
    number = code - OWN
    sentences = description.failures
    return sentences[number - 1] if number <= len(sentences) else f"the filter returned {number}"


class Followed(NamedTuple):
    """Results of filters: estimates with their times of issue, innovations, and offsets of the runs."""

    issued_ns: Integers
    estimates: EstimateRows
    estimate_offsets: Integers
    innovations: InnovationRows
    innovation_offsets: Integers


def offsets_of(description: Description, events: FilterEvents) -> tuple[Integers, Integers]:
    """Return the first rows of the estimates and of the innovations of every run: (runs + 1,) each."""
    due, recorded = (
        np.concatenate([[0], np.cumsum(chosen)])[events.offsets]
        for chosen in (events.wants_estimate, events.source >= 0)
    )
    return due, recorded if description.innovation else np.zeros_like(recorded)


def follow_all(
    library: Library,
    description: Description,
    static: Static,
    events: FilterEvents,
    carried: Filters,
    made: Results,
) -> None:
    """Pass the messages of all runs to their filters, which change in place, and fill the results."""
    given = Given(addresses_of(library, description), static, events)
    _loop()(len(carried.handle), given, carried, made, scratch=work_of(description))


def addresses_of(library: Library, description: Description) -> Addresses:
    """Return a library's function addresses; 0 for innovations if its description has none."""
    addresses = library.addresses
    return addresses if description.innovation else addresses._replace(innovation=0)


def followed(made: Results, due: Integers, recorded: Integers) -> Followed:
    """Trim results to the filled rows.

    Args:
        made: results of all runs.
        due, recorded: (runs + 1,), first rows of the estimates and innovations of each run.
    """
    issued_ns = made.issued_ns[filled_rows(due, made.estimates.end)[0]]
    return Followed(issued_ns, *filled(made.estimates, due), *filled(made.innovations, recorded))


def copies_of(library: Library, filters: Filters) -> Filters:
    """Copy filters; mark a filter that cannot be copied as failed."""
    handles = np.array([library.copy(handle) for handle in filters.handle.tolist()], np.int64)
    found = copied(filters)._replace(handle=handles)
    found.failure[(handles == 0) & (found.failure == ALL_WELL)] = NOT_COPIED
    return found


def work_of(description: Description) -> Callable[[], tuple[Innovation, Innovation]]:
    """Return a function that allocates work space of kernels."""
    return partial(_work, max(len(description.innovation), 1))


def _work(components: int) -> tuple[Innovation, Innovation]:
    given, kept = (no_innovation(1, components) for _ in range(2))
    for each in given:
        each[:] = np.nan
    return given, kept


def filters_of(
    library: Library,
    parameters: Sequence[float],
    seed: int,
    prior: tuple[Integers, Floats, Floats] | None,
    runs: int,
    description: Description,
) -> Filters:
    """Make the filters of all runs; a run whose prior is NaN is not processed.

    Args:
        library: the library of the filters.
        parameters, seed: parameters and seed of each filter.
        prior: stamps (runs,), means (runs, n), covariances (runs, t, t), or None.
        runs: number of runs.
        description: description of the library.
    """
    n, t = len(description.state), description.tangent
    time_ns, mean, covariance = prior or (
        np.zeros(runs, np.int64),
        np.zeros((runs, n)),
        np.zeros((runs, t, t)),
    )
    handles = np.array([library.create(parameters, seed) for _ in range(runs)], np.int64)
    failure = np.where(handles == 0, NOT_CREATED, ALL_WELL)
    failure[~np.isfinite(mean.sum(axis=1))] = ALL_WELL - 1  # the reason has been reported for the prior
    return Filters(
        handles,
        time_ns.copy(),
        np.zeros(runs, np.int64),
        failure,
        np.ascontiguousarray(mean),
        np.ascontiguousarray(covariance),
        np.full(runs, int(prior is not None)),
    )


class Call:
    """C function that is called by address, in a kernel or in Python: `call(address, *arguments)`.

    A pointer is an array or an address; the result is 0 for a function without a return value.
    """

    def __init__(self, name: str, *kinds: str, returns: str = "i32") -> None:
        self.__name__ = name
        self._kinds, self._returns = kinds, returns
        self._prototype = ctypes.CFUNCTYPE(_C[returns], *(_C[kind] for kind in kinds))

    def __call__(self, address: int, *arguments: Any) -> int:
        """Call the function from Python."""
        given = (
            each.ctypes.data
            if isinstance(each, np.ndarray)
            else int(each) or (None if kind == "pointer" else 0)
            for each, kind in zip(arguments, self._kinds, strict=True)
        )
        return int(self._prototype(int(address))(*given) or 0)

    def kernel_identity(self) -> str:
        """Return the part of a kernel's key that identifies the call."""
        return f"call of {self.__name__}: {' '.join(self._kinds)} -> {self._returns}"

    def lowered(self, program: Program, emitter: Emitter, arguments: Sequence[Any]) -> Number:  # noqa: ARG002
        """Emit a call in LLVM; see `fuselog.recorders.compiling.kernels.expressions`."""
        address, *others = arguments
        given = ", ".join(
            f"{_LLVM[kind]} {_passed(emitter, each, kind)}"
            for each, kind in zip(others, self._kinds, strict=True)
        )
        function = _passed(emitter, address, "pointer")
        call = f"call {_LLVM[self._returns]} {function}({given})"
        if self._returns == "void":
            emitter.add(call)
            return emitter.as_kind(0, WHOLE)
        wider = "ptrtoint ptr" if self._returns == "pointer" else "sext i32"
        return emitter.number(WHOLE, f"{wider} {emitter.number(WHOLE, call).code} to i64")


def _passed(emitter: Emitter, value: Any, kind: str) -> str:
    """Convert an argument to the C type of a parameter."""
    if isinstance(value, Array):
        if kind != "pointer" or value.dtype != "<f8":
            raise TypeError("a pointer argument of a C function must be an array of real numbers")
        return value.pointer
    if isinstance(value, Number) and value.kind == REAL:
        raise TypeError("an argument of a C function must be a whole number or an array")
    number = emitter.as_kind(value, WHOLE)
    if kind == "i64":
        return number.code
    text = f"trunc i64 {number.code} to i32" if kind == "i32" else f"inttoptr i64 {number.code} to ptr"
    return emitter.number(WHOLE, text).code


START = Call("start", "pointer", "i64", "pointer", "pointer")


TAKE = Call("take", "pointer", "i32", "i64", "pointer")


PREDICT = Call("predict", "pointer", "i64")


STATE = Call("state", "pointer", "pointer", "pointer")


INNOVATION = Call("innovation", "pointer", "pointer", "pointer")


COPY = Call("copy", "pointer", returns="pointer")


DESTROY = Call("destroy", "pointer", returns="void")
