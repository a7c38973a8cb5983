"""Tracing of the functions of models for compiled kernels; plain Python calls the functions themselves.

The arguments of a model's function are numbers, tuples of numbers, parameters (a NamedTuple of numbers),
and sometimes arrays that the function changes; the result is one number or a tuple of numbers.
`Argument` describes the arguments. To trace a function, fuselog calls it once for every path through its
conditions, and joins the results by selections.
"""

import re
import traceback
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.compiling.identity import digest_of
from fuselog.recorders.compiling.kernels.numbers import REAL, Emitter, Number, constant
from fuselog.recorders.compiling.kernels.program import FEW_OF_GRAPH, Instance, Program, called
from fuselog.recorders.compiling.kernels.values import Array, Record, entries, load, part_of, store
from fuselog.recorders.errors import BadInput
from fuselog.replay.tracing.derivatives import slopes_of
from fuselog.replay.tracing.emission import emit, python_of
from fuselog.replay.tracing.graph import INPUT, Graph, Node, described, needed, steady
from fuselog.replay.tracing.inlining import Parameters, inlined, trace_of, tracing
from fuselog.replay.tracing.reads import Reads, reads_of
from fuselog.replay.tracing.traced import (
    MOST_WAYS,
    CannotTrace,
    Trace,
    refused,
    too_many_ways,
)

# Files that are not the source of a mistake in a model.
_NOT_THEIRS = (Path(__file__).parent, Path(np.__file__).parent)


class Shape(NamedTuple):
    """Argument that is an array of these sizes, which the function reads and changes."""

    sizes: tuple[int, ...]


# size of a tuple of numbers; names of parameters; an array; or None for a number
Argument = int | tuple[str, ...] | Shape | None


class Result(NamedTuple):
    """Result of a function: the returned nodes, and whether they are a single number or a tuple.

    `written` has the array entries that the function changes: argument, index, and node.
    """

    returned: tuple[Node, ...]
    is_number: bool
    written: tuple[tuple[int, tuple[int, ...], Node], ...]


class TracedFunction:
    """Function of a model, with its graph."""

    def __init__(self, function: Callable[..., Any], arguments: Sequence[Argument]) -> None:
        self.function = function
        self.arguments = tuple(arguments)
        self.__name__ = getattr(function, "__name__", "function")

    def __call__(self, *arguments: Any) -> Any:
        """Call the function; for traced numbers, copy the graph of the function into their graph."""
        found = trace_of(arguments)
        if found is None or self.result.written:
            return self.function(*arguments)
        numbers = inlined(found, self.result.returned, lambda place: _at(arguments, place))
        return numbers[0] if self.result.is_number else numbers

    @cached_property
    def graph(self) -> Graph:
        """The graph, including the graph of requested derivatives."""
        return Graph()

    @cached_property
    def result(self) -> Result:
        """Traced result; raises BadInput, with line and advice, if tracing is impossible."""
        return trace(self.graph, self.function, self.arguments)

    @property
    def outputs(self) -> list[Node]:
        """All nodes that the function returns or writes."""
        return [*self.result.returned, *(node for _, _, node in self.result.written)]

    def kernel_identity(self) -> str:
        """Return the part of the kernel key that depends on the graph."""
        return self._identity

    @cached_property
    def _identity(self) -> str:
        where = [(argument, place) for argument, place, _ in self.result.written]
        return _digest(
            [repr(self.arguments), repr(where), str(self.result.is_number), *described(self.outputs)]
        )

    def lowered(self, program: Program, emitter: Emitter, arguments: Sequence[Any]) -> Any:
        """Write a call of the function; see `fuselog.recorders.compiling.kernels.expressions`."""
        numbers = _called(program, emitter, self, self.outputs, arguments)
        count = len(self.result.returned)
        for (argument, place, _), number in zip(self.result.written, numbers[count:], strict=True):
            store(emitter, part_of(emitter, arguments[argument], place), number)
        if self.result.is_number:
            return numbers[0]
        return tuple(numbers[:count]) if count or not self.result.written else None


class Derivative:
    """Function that returns the values of a traced function and selected derivatives.

    Args:
        function: the function.
        seeds: (trace) -> derivatives of every input by the variables.
        combine: (trace, returned nodes, their slopes) -> requested derivatives by index; missing
            derivatives are zero.
    """

    def __init__(
        self,
        function: TracedFunction,
        seeds: Callable[[Trace], dict[Node, dict[int, Node]]],
        combine: Callable[[Trace, Sequence[Node], Sequence[dict[int, Node]]], dict[Any, Node]],
    ) -> None:
        self.function = function
        self._seeds = seeds
        self._combine = combine
        self.__name__ = f"derivative_of_{function.__name__}"

    @cached_property
    def entries(self) -> dict[Any, Node]:
        """Nonzero derivatives, by their index."""
        trace = Trace(self.function.graph, {})
        returned = self.function.result.returned
        slopes = slopes_of(trace, returned, self._seeds(trace))
        found = self._combine(trace, returned, slopes)
        return {place: node for place, node in found.items() if not node.is_number(0.0)}

    @property
    def places(self) -> tuple[Any, ...]:
        """Indices of the derivatives, which follow the values in the outputs."""
        return tuple(self.entries)

    @property
    def outputs(self) -> list[Node]:
        """The values, followed by the derivatives."""
        return [*self.function.result.returned, *self.entries.values()]

    def kernel_identity(self) -> str:
        """Return the part of the kernel key that depends on the graph."""
        return _digest([repr(self.function.arguments), repr(self.places), *described(self.outputs)])

    def lowered(self, program: Program, emitter: Emitter, arguments: Sequence[Any]) -> Any:
        """Write a call of the function."""
        return tuple(_called(program, emitter, self.function, self.outputs, arguments))

    def __call__(self, *arguments: Any) -> tuple[Any, ...]:
        """Compute the values by the function itself, and the derivatives by the graph.

        For traced numbers, both are computed by the graph, which is copied into their graph.
        """
        found = trace_of(arguments)
        if found is not None:
            return inlined(found, self.outputs, lambda place: _at(arguments, place))
        places, compute = self._computed
        return (*self.function(*arguments), *compute([_at(arguments, place) for place in places]))

    @cached_property
    def _computed(self) -> tuple[list[Any], Callable[[list[float]], list[float]]]:
        """Positions of the inputs that derivatives need, and a function that computes derivatives."""
        nodes = list(self.entries.values())
        places = [node.value for node in needed(nodes) if node.operation == INPUT]
        names = {place: f"x{index}" for index, place in enumerate(places)}
        lines = [f"    {name} = np.float64(given[{index}])" for index, name in enumerate(names.values())]
        lines += [f"    {line}" for line in python_of(nodes, names)]
        scope: dict[str, Any] = {"np": np}
        exec("\n".join(["def computed(given):", *lines]), scope)
        return places, scope["computed"]


def arguments_like(values: Sequence[Any]) -> tuple[Argument, ...]:
    """Describe the types of these argument values."""
    return tuple(
        (getattr(each, "_fields", None) or len(each)) if isinstance(each, tuple) else None
        for each in values
    )


# --- calls in kernels -------------------------------------------------------------------------------


def _called(
    program: Program,
    emitter: Emitter,
    function: TracedFunction,
    outputs: Sequence[Node],
    arguments: Sequence[Any],
) -> list[Number]:
    """Write a call of a separate function that computes a graph's outputs from the necessary inputs.

    Nodes that contain a function call and depend only on parameters are computed by another function;
    the compiler moves the call of that function out of loops over samples or particles.
    """

    def is_changing(place: Any) -> bool:
        return not isinstance(function.arguments[place[0]], tuple)

    known: dict[Node, Number] = {}
    for wanted in (steady(outputs, is_changing), outputs):
        numbers = _computed(program, emitter, function, wanted, arguments, known)
        known = dict(zip(wanted, numbers, strict=True))
    return numbers


def _computed(
    program: Program,
    emitter: Emitter,
    function: TracedFunction,
    outputs: Sequence[Node],
    arguments: Sequence[Any],
    known: dict[Node, Number],
) -> list[Number]:
    """Write a call of a function that computes a graph's outputs from its inputs and known nodes."""
    if not outputs:
        return []
    nodes = needed(outputs, known)
    places = [node.value for node in nodes if node.operation == INPUT]
    used = [node for node in nodes if node in known]
    key = "graph", *places, *described(used), *described(outputs)
    if key not in program.instances:
        body = Emitter()
        names = [Number(REAL, f"%a{index}") for index in range(len(places) + len(used))]
        inputs = dict(zip(places, names, strict=False))
        found = emit(body, outputs, inputs, dict(zip(used, names[len(places) :], strict=True)))
        parameters = [[(REAL, each.code)] for each in names]
        program.instances[key] = program.define(
            function.__name__, body, parameters, tuple(found), FEW_OF_GRAPH
        )
    instance: Instance = program.instances[key]
    given = [_number(emitter, function.arguments, arguments, place) for place in places]
    return list(called(emitter, instance, [*given, *(known[node] for node in used)]))


def _number(emitter: Emitter, kinds: Sequence[Argument], arguments: Sequence[Any], place: Any) -> Number:
    """Return the value at a position (index of an argument, index of its entry) in a kernel."""
    argument, entry = place
    value = arguments[argument]
    if isinstance(value, Array):
        return load(emitter, part_of(emitter, value, entry))
    if isinstance(value, Record) and isinstance(kinds[argument], tuple):
        value = value.get(entry)
    elif entry is not None:
        found = entries(value)
        assert found is not None
        value = found[entry]
    return emitter.as_kind(value, REAL) if isinstance(value, Number) else constant(float(value))


def _at(arguments: Sequence[Any], place: Any) -> float:
    """Return the value at a position (index of an argument, index of its entry) in Python."""
    argument, entry = place
    value = arguments[argument]
    if entry is None:
        return value
    return getattr(value, entry) if isinstance(entry, str) else value[entry]


# --- tracing ----------------------------------------------------------------------------------------


def _given(trace: Trace, argument: int, kind: Argument) -> Any:
    graph = trace.graph
    if kind is None:
        return trace.number(graph.input((argument, None)))
    if isinstance(kind, Shape):
        array = np.empty(kind.sizes, object)
        for index in np.ndindex(kind.sizes):
            array[index] = trace.number(graph.input((argument, index)))
        return array
    if isinstance(kind, int):
        return tuple(trace.number(graph.input((argument, entry))) for entry in range(kind))
    return Parameters(trace, argument, kind)


def trace(graph: Graph, function: Callable[..., Any], arguments: Sequence[Argument]) -> Result:
    """Call a function with traced numbers, on every path through its conditions.

    Raises BadInput, with the line and advice, if the function does something that a graph cannot
    represent.
    """
    ways = 0

    def follow(decisions: dict[Node, bool]) -> Result:
        nonlocal ways
        ways += 1
        if ways > MOST_WAYS:
            raise too_many_ways()
        here = Trace(graph, dict(decisions))
        given = [_given(here, index, kind) for index, kind in enumerate(arguments)]
        with np.errstate(all="ignore"), tracing(here):
            found = _result(here, function(*given), given)
        for index in reversed(range(len(here.more))):
            before = dict.fromkeys(here.more[:index], True)
            other = follow({**decisions, **before, here.more[index]: False})
            found = _joined(graph, here.more[index], found, other)
        return found

    try:
        return follow({})
    except Exception as error:
        raise BadInput(f"{place_of(function, error)}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """Explain why a function could not be traced, replacing NumPy's messages about traced numbers."""
    if isinstance(error, CannotTrace | BadInput):
        return str(error)
    no_method = re.search(r"which has no callable (\w+) method", str(error))
    if no_method:
        function = no_method[1]
        return f"it uses np.{function} on an array that has some known numbers; apply it to each number"
    if isinstance(error, IndexError) and "only integers" in str(error):
        return str(refused("an index"))
    return f"{type(error).__name__}: {error}"


def _result(trace: Trace, returned: Any, given: Sequence[Any]) -> Result:
    is_number = not isinstance(returned, tuple | list | np.ndarray | None)
    listed = [] if returned is None else [returned] if is_number else list(returned)
    written = []
    for argument, array in enumerate(given):
        if isinstance(array, np.ndarray):
            for index in np.ndindex(array.shape):
                node = trace.node_of(array[index])
                if node is not trace.graph.input((argument, index)):
                    written.append((argument, index, node))
    return Result(tuple(map(trace.node_of, listed)), is_number, tuple(written))


def _joined(graph: Graph, condition: Node, yes: Result, no: Result) -> Result:
    if len(yes.returned) != len(no.returned) or yes.is_number != no.is_number:
        ways = [
            "a number" if each.is_number else f"a tuple of {len(each.returned)}" for each in (yes, no)
        ]
        raise CannotTrace(
            f"it returns {' on one path and '.join(ways)} on another; return the same on both paths"
        )
    returned = tuple(
        graph.select(condition, *both) for both in zip(yes.returned, no.returned, strict=True)
    )
    places = dict.fromkeys(
        (argument, place) for part in (yes, no) for argument, place, _ in part.written
    )
    own = [{(argument, place): node for argument, place, node in part.written} for part in (yes, no)]
    written = tuple(
        (*place, graph.select(condition, *(part.get(place, graph.input(place)) for part in own)))
        for place in places
    )
    return Result(returned, yes.is_number, written)


def place_of(function: Callable[..., Any], error: Exception | None = None) -> str:
    """Return a function's name, file and line, or the file and line of an error inside its code."""
    own = [
        frame
        for frame in (traceback.extract_tb(error.__traceback__) if error else ())
        if not frame.filename.endswith(".pyx")
        and not any(Path(frame.filename).is_relative_to(each) for each in _NOT_THEIRS)
    ]
    while isinstance(function, partial):
        function = function.func
    called = function if hasattr(function, "__code__") else type(function).__call__
    name = getattr(function, "__name__", type(function).__name__)
    code = getattr(called, "__code__", None)
    if own:
        return f"{name} ({Path(own[-1].filename).name}, line {own[-1].lineno})"
    return f"{name} ({Path(code.co_filename).name}, line {code.co_firstlineno})" if code else name


def _digest(words: Sequence[str]) -> str:
    """Return the digest of a graph and of the code that writes its instructions."""
    return sha256("\n".join([digest_of("fuselog.replay.tracing"), *words]).encode()).hexdigest()


_KNOWN: dict[Any, tuple[TracedFunction, Reads | None]] = {}


def traced(function: Any, *arguments: Argument) -> Any:
    """Return the traced form of a function: the same object as long as the function does not change.

    A function is traced again if the values that it reads have changed or may have changed; see `reads`.
    None and functions that are already traced are returned unchanged.

    Raises BadInput if the function cannot be traced, or if its result differs when it is traced again.
    """
    if function is None or isinstance(function, TracedFunction):
        return function
    key = id(function), arguments
    known, reads = _KNOWN.get(key, (None, None))
    if reads is not None and reads.are_unchanged():
        return known
    reads, made = reads_of(function), TracedFunction(function, arguments)
    if known is not None and known.kernel_identity() == made.kernel_identity():
        _KNOWN[key] = known, reads
        return known
    if TracedFunction(function, arguments).kernel_identity() != made.kernel_identity():
        raise BadInput(
            f"{place_of(function)}: it returns another result when it is called again; clocks, random "
            "numbers and changing values cannot be part of a model, so make them parameters"
        )
    _KNOWN[key] = made, reads  # keeps a reference to the function, so that its id is not reused
    return made
