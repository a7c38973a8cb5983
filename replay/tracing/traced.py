"""Traced numbers, with which a model's function is called to record its graph.

Traced numbers support Python's operators and NumPy's functions of numbers, even inside arrays of
objects. Conditions that depend on traced numbers are followed on both paths (see `functions`). Uses that
need a known value, such as float() or an index, raise an error with advice.
"""

import linecache
import operator
import re
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from fuselog.replay.tracing.graph import Graph, Node


class CannotTrace(TypeError):
    """Error for operations that a graph cannot represent, with advice on alternatives."""


MOST_WAYS = 256
_REMEDIES = {
    "float()": "leave the number as it is, or write np.where(condition, a, b)",
    "an array of float": "build the array from its numbers: np.array([a, b])",
    "int()": "write np.floor or np.trunc, and np.choose for an index",
    "an index": "write np.interp(x, table_x, table_y), or np.choose(np.searchsorted(bounds, x), "
    "numbers)",
    "math.*": "write np.* instead",
}
_INTO_AN_ARRAY = re.compile(r"\]\s*\S{0,2}=(?!=)")  # `a[k] = x`, `a[k] += x`


def refused(what: str) -> CannotTrace:
    """Make the error for a use of a traced number that is not supported."""
    remedy = _REMEDIES.get(what, "write it with operators, np.where and functions such as np.exp")
    return CannotTrace(f"it uses {what} on a number that is only known later; {remedy}")


def too_many_ways() -> CannotTrace:
    """Make the error for too many conditions, which an endless loop may cause."""
    return CannotTrace(
        f"there are more than {MOST_WAYS} paths through its `if`s and `while`s on numbers that are only "
        "known later; write np.clip or np.where, and a fixed number of iterations"
    )


class Traced(np.lib.mixins.NDArrayOperatorsMixin):
    """Number that is a node of a graph; operations on the number add nodes."""

    __slots__ = ("node", "trace")

    def __init__(self, trace: "Trace", node: Node) -> None:
        self.trace = trace
        self.node = node

    def __repr__(self) -> str:
        return f"traced number {self.node.number}"

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        options.pop("out", None)  # of `x += y`, which may also make a new number
        if method != "__call__":
            raise CannotTrace(f"it uses np.{ufunc.__name__}.{method}; write it with operators")
        if options:
            raise CannotTrace(
                f"it uses np.{ufunc.__name__} with {', '.join(options)}; write np.where around it"
            )
        return apply(ufunc, inputs)

    def __array_function__(self, function: Any, _: Any, inputs: Any, options: dict[str, Any]) -> Any:
        return apply(function, inputs, options)

    def __bool__(self) -> bool:
        return self.trace.decided(self)

    def __round__(self, decimals: int = 0) -> Any:
        return apply(np.round, (self, decimals))

    def __divmod__(self, other: Any) -> Any:
        return self // other, self % other

    def __float__(self) -> float:
        frame = sys._getframe(1)
        line = linecache.getline(frame.f_code.co_filename, frame.f_lineno)
        into_an_array = _INTO_AN_ARRAY.search(line)
        raise refused(
            "float()" if "float(" in line else "an array of float" if into_an_array else "math.*"
        )

    def __int__(self) -> int:
        raise refused("int()")

    def __index__(self) -> int:
        raise refused("an index")

    def __hash__(self) -> int:
        return hash(self.node)


class Trace:
    """Call of a function with traced numbers: the graph, and the path through the conditions."""

    def __init__(self, graph: Graph, decisions: dict[Node, bool]) -> None:
        self.graph = graph
        self.decisions = decisions  # of conditions, in the order in which they were reached
        self.more: list[Node] = []  # newly reached conditions

    def decided(self, number: Traced) -> bool:
        """Return the path at a condition; a new condition is true now and false in a later call."""
        node = (
            number.node
            if number.node.is_truth
            else self.graph.apply(operator.ne, number.node, self.graph.constant(0.0))
        )
        if node.is_constant:
            return bool(node.value)
        if node not in self.decisions:
            if len(self.more) == MOST_WAYS:  # each is false in a later call
                raise too_many_ways()
            self.decisions[node] = True
            self.more.append(node)
        return self.decisions[node]

    def number(self, node: Node) -> Traced:
        """Return a node as a traced number."""
        return Traced(self, node)

    def node_of(self, value: Any) -> Node:
        """Return the node of a traced or a known number."""
        if isinstance(value, Traced):
            return value.node
        return self.graph.constant(value)


def where(condition: Any, yes: Any, no: Any) -> Any:
    """Select one of two numbers; the other number may have any value."""
    numbers = [each for each in (condition, yes, no) if isinstance(each, Traced)]
    if not numbers:
        return yes if condition else no
    trace = numbers[0].trace
    test = trace.node_of(condition)
    if not test.is_truth:
        test = trace.graph.apply(operator.ne, test, trace.graph.constant(0.0))
    return trace.number(trace.graph.select(test, trace.node_of(yes), trace.node_of(no)))


def _interpolated(x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None) -> Any:
    """Trace `np.interp` over a known table, on the segment that begins at the last knot before x."""
    known_x, known_y = (_known("np.interp", each) for each in (xp, fp))
    found = where(np.isnan(x), x, known_y[0] if left is None else left)
    for k in range(len(known_x) - 1):
        slope = (known_y[k + 1] - known_y[k]) / (known_x[k + 1] - known_x[k])
        found = where(x >= known_x[k], slope * (x - known_x[k]) + known_y[k], found)
    found = where(x >= known_x[-1], known_y[-1], found)
    return found if right is None else where(x > known_x[-1], right, found)


def _sorted_in(a: Any, v: Any, side: str = "left") -> Any:
    """Trace `np.searchsorted` in a known table, by counting the smaller entries."""
    count: Any = 0.0
    for each in _known("np.searchsorted", a):
        count = count + where(v > each if side == "left" else v >= each, 1.0, 0.0)
    return count


def _chosen(a: Any, choices: Any) -> Any:
    """Trace `np.choose`; `np.take` does not dispatch on its index."""
    found, *others = choices
    for place, each in enumerate(others, 1):
        found = where(a >= float(place), each, found)
    return found


def _known(what: str, table: Any) -> list[float]:
    """Return the numbers of a table; raise CannotTrace if they are traced."""
    if any(isinstance(each, Traced) for each in np.ravel(np.asarray(table, object))):
        raise CannotTrace(f"it uses {what} on a table that is only known later; write np.where")
    return np.asarray(table, float).tolist()


def _clipped(x: Any, a_min: Any = None, a_max: Any = None, **named: Any) -> Any:
    """Trace `np.clip`."""
    low, high = named.get("min", a_min), named.get("max", a_max)
    x = x if low is None else np.maximum(x, low)
    return x if high is None else np.minimum(x, high)


def _rounded(x: Any, decimals: int = 0) -> Any:
    """Trace `np.round`."""
    return np.rint(x * 10.0**decimals) / 10.0**decimals if decimals else np.rint(x)


def _log_of_sum(x: Any, y: Any) -> Any:
    """Trace `np.logaddexp`."""
    larger, less = where(x > y, x, y), where(x > y, y, x)
    return where(x == y, x + np.log(2.0), larger + np.log1p(np.exp(less - larger)))


# Functions composed of other functions; selections ignore NaN in the other alternative.
_COMPOSED: dict[Any, Callable[..., Any]] = {
    np.where: where,
    np.minimum: lambda x, y: where((x <= y) | np.isnan(x), x, y),
    np.maximum: lambda x, y: where((x >= y) | np.isnan(x), x, y),
    np.clip: _clipped,
    np.round: _rounded,
    np.around: _rounded,
    np.divmod: lambda x, y: (x // y, x % y),
    np.square: lambda x: x * x,
    np.reciprocal: lambda x: 1.0 / x,
    np.positive: lambda x: x,
    np.deg2rad: lambda x: x * (np.pi / 180.0),
    np.radians: lambda x: x * (np.pi / 180.0),
    np.rad2deg: lambda x: x * (180.0 / np.pi),
    np.degrees: lambda x: x * (180.0 / np.pi),
    np.interp: _interpolated,
    np.searchsorted: _sorted_in,
    np.choose: _chosen,
    np.logaddexp: _log_of_sum,
}
_OPERATORS: dict[Any, Any] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.true_divide: operator.truediv,
    np.negative: operator.neg,
    np.less: operator.lt,
    np.less_equal: operator.le,
    np.greater: operator.gt,
    np.greater_equal: operator.ge,
    np.equal: operator.eq,
    np.not_equal: operator.ne,
    np.logical_and: operator.and_,
    np.bitwise_and: operator.and_,
    np.logical_or: operator.or_,
    np.bitwise_or: operator.or_,
    np.logical_xor: operator.xor,
    np.bitwise_xor: operator.xor,
    np.logical_not: operator.not_,
    np.invert: operator.not_,
    np.remainder: operator.mod,
    np.floor_divide: operator.floordiv,
    np.fabs: np.absolute,
}
# Functions that a graph represents directly, in addition to the operators.
PRIMITIVES = (
    *(np.sqrt, np.cbrt, np.hypot, np.exp, np.exp2, np.expm1, np.log, np.log2, np.log10, np.log1p),
    *(np.sin, np.cos, np.tan, np.arcsin, np.arccos, np.arctan, np.arctan2, np.sinc),
    *(np.sinh, np.cosh, np.tanh, np.arcsinh, np.arccosh, np.arctanh),
    *(np.absolute, np.sign, np.copysign, np.fmod, np.floor, np.ceil, np.trunc, np.rint),
    *(np.isnan, np.isfinite, np.isinf, np.signbit),
)
_LOGICAL = (operator.and_, operator.or_, operator.xor, operator.not_)
_OF_TABLES = (np.interp, np.searchsorted, np.choose)


def apply(function: Any, inputs: tuple[Any, ...], options: dict[str, Any] | None = None) -> Any:
    """Apply a NumPy function to traced and other numbers, or arrays of them."""
    if function in _OF_TABLES:
        return _COMPOSED[function](*inputs, **(options or {}))
    if any(not isinstance(each, Traced) and np.ndim(each) for each in inputs):
        return _over_arrays(function, inputs)
    if function in _COMPOSED:
        return _COMPOSED[function](*inputs, **(options or {}))
    trace = next(each.trace for each in inputs if isinstance(each, Traced))
    if function is np.power:
        return _power(trace, *inputs)
    operation = _OPERATORS.get(function, function)
    if operation not in PRIMITIVES and function not in _OPERATORS:
        raise refused(f"np.{getattr(function, '__name__', function)}")
    nodes = [trace.node_of(each) for each in inputs]
    if operation in _LOGICAL:
        nodes = [
            each if each.is_truth else trace.graph.apply(operator.ne, each, trace.graph.constant(0.0))
            for each in nodes
        ]
    return trace.number(trace.graph.apply(operation, *nodes))


def _power(trace: Trace, base: Any, exponent: Any) -> Any:
    """Trace a power; integer exponents become multiplications."""
    if isinstance(exponent, int | np.integer):
        return trace.number(trace.graph.power(trace.node_of(base), int(exponent)))
    return trace.number(trace.graph.apply(np.power, trace.node_of(base), trace.node_of(exponent)))


def _over_arrays(function: Any, inputs: tuple[Any, ...]) -> Any:
    boxed = []
    for each in inputs:
        box = np.empty((), object)
        if isinstance(each, Traced):
            box[()] = each
        else:
            box = np.asarray(each, object)
        boxed.append(box)
    parts = np.broadcast_arrays(*boxed)
    found = np.empty(parts[0].shape, object)
    for index in np.ndindex(found.shape):
        found[index] = function(*(part[index] for part in parts))
    return found


def _methods() -> None:
    """Define the methods that NumPy calls on the objects in an array, such as `x.sin()`."""

    def method(function: Any) -> Callable[..., Any]:
        return lambda *inputs: apply(function, inputs)

    for function in (*PRIMITIVES, *_COMPOSED, *_OPERATORS):
        name = function.__name__
        if not hasattr(Traced, name):
            setattr(Traced, name, method(function))


_methods()
