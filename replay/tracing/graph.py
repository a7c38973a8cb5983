"""Expression graphs without duplicates and with folded constants.

A node is an operation of Python or NumPy on other nodes; equal nodes are the same object.
Simplifications preserve all bits with one exception: zero times anything is zero, so that terms with a
zero factor can be removed.
"""

import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput

MOST_NODES = 50_000
WORTH_A_BRANCH = 8  # nodes that are computed only if a condition is true
INPUT, CONSTANT, POWER, SELECT = "input", "constant", "power", "select"
_COMPARISONS = (operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne)
_TRUTHS = (
    *_COMPARISONS,
    np.isnan,
    np.isfinite,
    np.isinf,
    np.signbit,
    operator.and_,
    operator.or_,
    operator.xor,
    operator.not_,
)

# operations that cost about as much as loading a number
_CHEAP = (
    *(INPUT, CONSTANT, POWER, SELECT, np.absolute, np.sign),
    *(operator.add, operator.sub, operator.mul, operator.truediv, operator.neg),
    *_TRUTHS,
)

_COMMUTATIVE = (operator.add, operator.mul)


class Node:
    """Number or truth value: an operation, its arguments, and its constant."""

    __slots__ = ("arguments", "is_truth", "number", "operation", "value")

    def __init__(self, number: int, operation: Any, arguments: tuple["Node", ...], value: Any) -> None:
        self.number = number
        self.operation = operation
        self.arguments = arguments
        self.value = value
        self.is_truth: bool = operation in _TRUTHS or (operation is CONSTANT and isinstance(value, bool))
        if operation is SELECT:
            self.is_truth = arguments[1].is_truth

    @property
    def is_constant(self) -> bool:
        """Whether the node's value is known."""
        return self.operation is CONSTANT

    def is_number(self, value: float) -> bool:
        """Test whether the node is known to be this number."""
        return self.operation is CONSTANT and not self.is_truth and self.value == value


class Graph:
    """Nodes of one function, in an order in which they can be computed."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[Any, Node] = {}

    def _node(self, operation: Any, arguments: tuple[Node, ...], value: Any, key: Any) -> Node:
        found = self._known.get(key)
        if found is None:
            if len(self.nodes) == MOST_NODES:
                raise BadInput(
                    f"it needs more than {MOST_NODES:,} operations with unrolled loops; use fewer "
                    "iterations"
                )
            found = self._known[key] = Node(len(self.nodes), operation, arguments, value)
            self.nodes.append(found)
        return found

    def input(self, place: Any) -> Node:
        """Return the node of an input."""
        return self._node(INPUT, (), place, (INPUT, place))

    def constant(self, value: Any) -> Node:
        """Return the node of a number or a truth value."""
        value = bool(value) if isinstance(value, bool | np.bool_) else float(value)
        sign = math.copysign(1.0, value)
        return self._node(CONSTANT, (), value, (CONSTANT, type(value), sign, repr(value)))

    def power(self, base: Node, exponent: int) -> Node:
        """Return an integer power of a number, by multiplication."""
        if exponent == 1:
            return base
        if exponent == 0:
            return self.constant(1.0)
        if base.is_constant:
            return self.constant(_power(base.value, exponent))
        return self._node(POWER, (base,), exponent, (POWER, base.number, exponent))

    def select(self, condition: Node, yes: Node, no: Node) -> Node:
        """Select one of two nodes; the other does not affect the result, even if it is NaN."""
        if condition.is_constant:
            return yes if condition.value else no
        if yes is no:
            return yes
        return self._node(
            SELECT, (condition, yes, no), None, (SELECT, condition.number, yes.number, no.number)
        )

    def apply(self, operation: Any, *arguments: Node) -> Node:
        """Return an operation on nodes, or a simpler node that is equal."""
        if all(each.is_constant for each in arguments):
            return self.constant(evaluated(operation, *(each.value for each in arguments)))
        simpler = self._simpler(operation, arguments)
        if simpler is not None:
            return simpler
        numbers = [each.number for each in arguments]
        if operation in _COMMUTATIVE:
            numbers.sort()
        return self._node(operation, arguments, None, (operation, *numbers))

    def _simpler(self, operation: Any, arguments: tuple[Node, ...]) -> Node | None:
        if operation is operator.neg:
            inner = arguments[0]
            return inner.arguments[0] if inner.operation is operator.neg else None
        if len(arguments) != 2 or any(each.is_truth for each in arguments):
            return None
        x, y = arguments
        opposite = operator.neg
        if operation is operator.add:
            if x.is_number(0.0) or y.is_number(0.0):
                return y if x.is_number(0.0) else x
            if y.operation is opposite:
                return self.apply(operator.sub, x, y.arguments[0])
            return self.apply(operator.sub, y, x.arguments[0]) if x.operation is opposite else None
        if operation is operator.sub:
            if y.is_number(0.0):
                return x
            if y.operation is opposite:
                return self.apply(operator.add, x, y.arguments[0])
            return self.apply(opposite, y) if x.is_number(0.0) else None
        if operation is operator.mul:
            if x.is_number(0.0) or y.is_number(0.0):
                return self.constant(0.0)
            for one, other in ((x, y), (y, x)):
                if one.is_number(1.0):
                    return other
                if one.is_number(-1.0):
                    return self.apply(opposite, other)
                if one.operation is opposite:
                    return self.apply(opposite, self.apply(operator.mul, one.arguments[0], other))
        if operation is operator.truediv and y.is_number(1.0):
            return x
        return None


def evaluated(operation: Any, *values: Any) -> Any:
    """Compute the result of an operation on numbers, without warnings about infinity and NaN."""
    with np.errstate(all="ignore"):
        if operation in (operator.not_, operator.and_, operator.or_, operator.xor):
            return operation(*values)
        return operation(*(each if isinstance(each, bool) else np.float64(each) for each in values))


def _power(base: float, exponent: int) -> float:
    """Compute a power by repeated squaring, as compiled code does."""
    found, square, rest = None, base, abs(exponent)
    while rest:
        if rest & 1:
            found = square if found is None else found * square
        rest >>= 1
        if rest:
            square = square * square
    assert found is not None
    return found if exponent > 0 else float(np.float64(1.0) / found)


def needed(outputs: Iterable[Node], known: Collection[Node] = ()) -> list[Node]:
    """Return all nodes on which the outputs depend, including the outputs, in order of computation.

    Known nodes are included, but nodes that only known nodes need are not.
    """
    found: set[Node] = set()
    waiting = list(outputs)
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            waiting += () if node in known else node.arguments
    return sorted(found, key=lambda node: node.number)


class Choice(NamedTuple):
    """Selections by one condition, and for each branch the nodes that only that branch needs."""

    condition: Node
    members: tuple[Node, ...]
    sides: tuple[frozenset[Node], frozenset[Node]]


# A side of a choice, on which a node is computed; None for nodes that are always computed.
Level = tuple[Choice, int] | None


def choices(
    outputs: Collection[Node], known: Collection[Node] = ()
) -> tuple[dict[Node, Choice], dict[Node, Level]]:
    """Find selections that are worth a branch, by member, and the level of the nodes inside them."""
    nodes, kept = needed(outputs, known), {*outputs, *known}
    users: dict[Node, list[tuple[Node, int]]] = {}
    grouped: dict[Node, list[Node]] = {}
    for node in nodes:
        if node in known:
            continue
        for place, argument in enumerate(node.arguments):
            users.setdefault(argument, []).append((node, place))
        if node.operation is SELECT and not node.is_truth:
            members = grouped.setdefault(node.arguments[0], [])
            if members and not set(members).isdisjoint(needed([node])):
                continue
            members.append(node)
    inner = [each for each in reversed(nodes) if each not in kept and each.arguments]
    found: list[Choice] = []
    for condition, members in grouped.items():
        sides: list[set[Node]] = [set(), set()]
        for place, side in enumerate(sides, 1):
            for node in inner:
                if all(user in side or (user in members and at == place) for user, at in users[node]):
                    side.add(node)
        if max(map(len, sides)) >= WORTH_A_BRANCH:
            found.append(Choice(condition, tuple(members), (frozenset(sides[0]), frozenset(sides[1]))))
    while True:
        levels: dict[Node, Level] = {}
        for choice in sorted(found, key=lambda each: -max(map(len, each.sides))):
            for index in (0, 1):
                levels |= dict.fromkeys(choice.sides[index], (choice, index))
        whole = [each for each in found if len({levels.get(one) for one in each.members}) == 1]
        if len(whole) == len(found):
            return {member: choice for choice in found for member in choice.members}, levels
        found = whole


def steady(outputs: Collection[Node], varies: Callable[[Any], bool]) -> list[Node]:
    """Find nodes to compute before a loop: constant in the loop and including a function call.

    Args:
        outputs: outputs of the loop.
        varies: (position of an input) -> whether this input changes between iterations.
    """
    varying, costly, wanted = set[Node](), set[Node](), set(outputs)
    nodes = needed(outputs)
    for node in nodes:
        if (node.operation is INPUT and varies(node.value)) or not varying.isdisjoint(node.arguments):
            varying.add(node)
        if node.operation not in _CHEAP or not costly.isdisjoint(node.arguments):
            costly.add(node)
    for node in nodes:
        wanted.update(node.arguments if node in varying or node.is_truth else ())
    return [each for each in nodes if each in wanted & costly - varying and not each.is_truth]


def described(outputs: Iterable[Node]) -> Iterator[str]:
    """Yield for each output a digest of the part of the graph from which it is computed."""
    outputs = list(outputs)
    words: dict[Node, str] = {}
    for node in needed(outputs):
        name = node.operation if isinstance(node.operation, str) else node.operation.__name__
        parts = [words[each] for each in node.arguments]
        if node.operation in _COMMUTATIVE:
            parts.sort()
        text = f"{name} {' '.join(parts)} {node.value!r}"
        words[node] = blake2b(text.encode(), digest_size=16).hexdigest()
    yield from (words[each] for each in outputs)
