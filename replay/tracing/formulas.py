"""Writing of graphs as readable Python formulas that compute the same values.

Long expressions that are used more than once, and expressions that would not fit in a line, are on
separate lines.
"""

import operator
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from fuselog.replay.tracing.derivatives import slopes_of
from fuselog.replay.tracing.functions import TracedFunction
from fuselog.replay.tracing.graph import CONSTANT, INPUT, POWER, SELECT, Node, needed
from fuselog.replay.tracing.traced import Trace

SHORTEST, LONGEST = (
    20,
    100,
)  # characters: shorter expressions are repeated, longer ones split

# Precedence of operators, as in Python, except that remainders next to products are in parentheses.
_CHOICE, _OR, _AND, _NOT, _COMPARISON, _SUM, _REMAINDER, _PRODUCT, _SIGN, _POWER, _WHOLE = range(11)
_OPERATORS: dict[Any, tuple[str, int]] = {
    operator.or_: ("or", _OR),
    operator.and_: ("and", _AND),
    operator.xor: ("!=", _COMPARISON),
    operator.lt: ("<", _COMPARISON),
    operator.le: ("<=", _COMPARISON),
    operator.gt: (">", _COMPARISON),
    operator.ge: (">=", _COMPARISON),
    operator.eq: ("==", _COMPARISON),
    operator.ne: ("!=", _COMPARISON),
    operator.add: ("+", _SUM),
    operator.sub: ("-", _SUM),
    operator.mul: ("*", _PRODUCT),
    operator.truediv: ("/", _PRODUCT),
    operator.mod: ("%", _REMAINDER),
    operator.floordiv: ("//", _REMAINDER),
}
_KNOWN: dict[float, tuple[str, int]] = {
    np.pi: ("pi", _WHOLE),
    2.0 * np.pi: ("2 * pi", _PRODUCT),
    0.5 * np.pi: ("pi / 2", _PRODUCT),
    np.pi / 180.0: ("pi / 180", _PRODUCT),
    180.0 / np.pi: ("180 / pi", _PRODUCT),
}


class Text(NamedTuple):
    """Formula or C expression, with the precedence of its last operation."""

    text: str
    binds: int

    def within(self, binds: int) -> str:
        """Return the text as an operand at this precedence, in parentheses if necessary."""
        return self.text if self.binds >= binds else f"({self.text})"


def formulas_of(
    function: TracedFunction,
    inputs: Mapping[Any, str],
    outputs: Mapping[str, Node],
    by: Mapping[Any, str],
) -> list[str]:
    """Return lines `name = formula` for the outputs of a function and their nonzero derivatives.

    Args:
        function: the function.
        inputs: names of the function's inputs, by position.
        outputs: output nodes of the function, by name.
        by: names of the inputs with respect to which it is differentiated, by position.
    """
    trace, names = Trace(function.graph, {}), list(by.values())
    seeds = {
        function.graph.input(place): {number: function.graph.constant(1.0)}
        for number, place in enumerate(by)
    }
    slopes = slopes_of(trace, list(outputs.values()), seeds)
    derivatives = {
        f"d {name} / d {names[number]}": node
        for name, slope in zip(outputs, slopes, strict=True)
        for number, node in slope.items()
    }
    return list(_lines({**outputs, **derivatives}, inputs))


def _lines(named: Mapping[str, Node], inputs: Mapping[Any, str]) -> Iterator[str]:
    """Yield a line for each named node, after the lines on which it depends."""
    everything = needed(named.values())
    uses = Counter(argument for node in everything for argument in node.arguments)
    uses.update(named.values())
    found: dict[Node, Text] = {}
    free = (name for name in map("v{}".format, range(1, len(everything) + 1)))
    taken = set(inputs.values())
    for name, output in named.items():
        for node in needed([output]):
            if node in found:
                continue
            text = _text_of(node, [found[each] for each in node.arguments], inputs)
            is_named = node is output and (name.isidentifier() or uses[node] == 1)
            if not is_named and len(text.text) > (SHORTEST if uses[node] > 1 else LONGEST):
                own = next(each for each in free if each not in taken)
                yield f"{own} = {text.text}"
                text = Text(own, _WHOLE)
            found[node] = text
        yield f"{name} = {found[output].text}"
        if name.isidentifier() and len(found[output].text) > SHORTEST:
            found[output] = Text(name, _WHOLE)


def _text_of(node: Node, given: list[Text], inputs: Mapping[Any, str]) -> Text:
    """Write a node as a formula, given the formulas of its arguments."""
    operation = node.operation
    if operation is INPUT:
        return Text(inputs[node.value], _WHOLE)
    if operation is CONSTANT:
        return _constant(node.value)
    if operation is SELECT:
        condition, yes, no = given
        choice = f"{yes.within(_OR)} if {condition.within(_OR)} else {no.within(_CHOICE)}"
        return Text(choice, _CHOICE)
    if operation is POWER:
        return Text(f"{given[0].within(_WHOLE)} ** {node.value}", _POWER)
    if operation is operator.neg:
        return Text(f"-{given[0].within(_PRODUCT)}", _PRODUCT)
    if operation is operator.not_:
        return Text(f"not {given[0].within(_NOT)}", _NOT)
    if operation in _OPERATORS:
        sign, binds = _OPERATORS[operation]
        left, right = given
        first = left.within(_SUM if binds == _COMPARISON else binds)  # Python chains comparisons
        last = right.within(_SIGN if binds == _REMAINDER else binds + 1)
        return Text(f"{first} {sign} {last}", binds)
    name = "abs" if operation is np.absolute else operation.__name__
    return Text(f"{name}({', '.join(each.text for each in given)})", _WHOLE)


def _constant(value: Any) -> Text:
    if isinstance(value, bool):
        return Text(str(value), _WHOLE)
    if value < 0.0 or str(value) == "-0.0":
        text, binds = _constant(-value)
        return Text(f"-{text}", min(binds, _SIGN))
    if value in _KNOWN:
        return Text(*_KNOWN[value])
    text = repr(float(value))
    return Text(text.removesuffix(".0"), _WHOLE)
