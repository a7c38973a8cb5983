"""Copying of a graph into another one when a traced function is called with traced numbers."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fuselog.replay.tracing.graph import CONSTANT, INPUT, POWER, SELECT, Node, needed
from fuselog.replay.tracing.traced import Trace, Traced


class Parameters:
    """Parameters of a function during tracing."""

    def __init__(self, trace: Trace, argument: int, names: tuple[str, ...]) -> None:
        self.trace, self._argument, self._names = trace, argument, names

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name not in self._names:
            raise AttributeError(f"no parameter '{name}'; the model has {', '.join(self._names)}")
        return self.trace.number(self.trace.graph.input((self._argument, name)))

    def __iter__(self) -> Iterator[Any]:
        return (getattr(self, name) for name in self._names)


# traces in progress, in any thread; without traces, all numbers are known
_AT_WORK: list[Trace] = []


@contextmanager
def tracing(trace: Trace) -> Iterator[None]:
    """Register a trace for as long as functions may be called with its numbers."""
    _AT_WORK.append(trace)
    try:
        yield
    finally:
        _AT_WORK.remove(trace)


def trace_of(arguments: Sequence[Any]) -> Trace | None:
    """Return the trace of the traced numbers in these arguments; None if no number is traced."""
    return _found(arguments) if _AT_WORK else None


def _found(arguments: Sequence[Any]) -> Trace | None:
    for each in arguments:
        if isinstance(each, Traced):
            return each.trace
        if isinstance(each, Parameters):
            return each.trace
        if isinstance(each, tuple):
            found = _found(each)
            if found is not None:
                return found
    return None


def inlined(
    trace: Trace, outputs: Sequence[Node], number_at: Callable[[Any], Any]
) -> tuple[Traced, ...]:
    """Copy nodes of one graph to another, and replace the inputs by numbers of the other graph."""
    graph, found = trace.graph, dict[Node, Node]()
    for node in needed(outputs):
        given = [found[each] for each in node.arguments]
        if node.operation is INPUT:
            found[node] = trace.node_of(number_at(node.value))
        elif node.operation is CONSTANT:
            found[node] = graph.constant(node.value)
        elif node.operation is SELECT:
            found[node] = graph.select(*given)
        elif node.operation is POWER:
            found[node] = graph.power(given[0], node.value)
        else:
            found[node] = graph.apply(node.operation, *given)
    return tuple(trace.number(found[each]) for each in outputs)
