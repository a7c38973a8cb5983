"""Writing of graphs as readable C99, with a line for each expression that is used more than once.

Sums and products are in the same order as in kernels. A compiler that neither contracts nor reorders
operations (`-ffp-contract=off`, no `-ffast-math`) therefore produces the same results, bit for bit.
"""

import math
import operator
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from fuselog.replay.tracing.formulas import Text
from fuselog.replay.tracing.graph import (
    CONSTANT,
    INPUT,
    POWER,
    SELECT,
    Choice,
    Level,
    Node,
    choices,
    needed,
)

SHORTEST, LONGEST = (
    16,
    90,
)  # characters: shorter expressions are repeated, longer ones split

_CHOICE, _OR, _AND, _EQUAL, _COMPARISON, _SUM, _PRODUCT, _SIGN, _WHOLE = range(9)
_OPERATORS: dict[Any, tuple[str, int]] = {
    operator.or_: ("||", _OR),
    operator.and_: ("&&", _AND),
    operator.xor: ("!=", _EQUAL),
    operator.eq: ("==", _EQUAL),
    operator.ne: ("!=", _EQUAL),
    operator.lt: ("<", _COMPARISON),
    operator.le: ("<=", _COMPARISON),
    operator.gt: (">", _COMPARISON),
    operator.ge: (">=", _COMPARISON),
    operator.add: ("+", _SUM),
    operator.sub: ("-", _SUM),
    operator.mul: ("*", _PRODUCT),
    operator.truediv: ("/", _PRODUCT),
}
_LIBM = {
    np.absolute: "fabs",
    np.arcsin: "asin",
    np.arccos: "acos",
    np.arctan: "atan",
    np.arctan2: "atan2",
    np.arcsinh: "asinh",
    np.arccosh: "acosh",
    np.arctanh: "atanh",
    np.power: "pow",
}
_TESTS = (np.isnan, np.isfinite, np.isinf, np.signbit)
_IS_EQUAL = """/* Whether two numbers are equal; false for NaN. */
static int is_equal(REAL x, REAL y)
{
    return x <= y && x >= y;
}
"""
# Functions that C lacks; REAL is the type of numbers, and _S the suffix of libm's functions for it.
HELPERS: Mapping[Any, tuple[str, str]] = {
    operator.mod: (
        "modulo",
        """/* The remainder of x / y, with the sign of y. */
static REAL modulo(REAL x, REAL y)
{
    const REAL rest = fmod_S(x, y);
    if (!(fabs_S(rest) <= 0.0_S))
        return (y < 0.0_S) != (rest < 0.0_S) ? rest + y : rest;
    return y < 0.0_S ? -0.0_S : 0.0_S;
}
""",
    ),
    operator.floordiv: (
        "floor_of_quotient",
        """/* The largest integer that is not above x / y. */
static REAL floor_of_quotient(REAL x, REAL y)
{
    const REAL rest = fmod_S(x, y);
    REAL quotient = (x - rest) / y, whole;
    if (fabs_S(y) <= 0.0_S)
        return x / y;
    if (!(fabs_S(rest) <= 0.0_S) && (y < 0.0_S) != (rest < 0.0_S))
        quotient -= 1.0_S;
    if (fabs_S(quotient) <= 0.0_S)
        return copysign_S(0.0_S, x / y);
    whole = floor_S(quotient);
    return quotient - whole > 0.5_S ? whole + 1.0_S : whole;
}
""",
    ),
    np.sinc: (
        "sinc",
        """/* sin(pi x) / (pi x), 1 at zero. */
static REAL sinc(REAL x)
{
    const REAL angle = x * 3.141592653589793_S;
    return fabs_S(x) <= 0.0_S ? 1.0_S : sin_S(angle) / angle;
}
""",
    ),
    np.sign: (
        "sign_of",
        """/* -1, 0 or 1; NaN for NaN. */
static REAL sign_of(REAL x)
{
    return x > 0.0_S ? 1.0_S : x < 0.0_S ? -1.0_S : isnan(x) ? x : 0.0_S;
}
""",
    ),
}


class Precision(NamedTuple):
    """Notation of numbers: their type, and the suffix of constants and of libm's functions."""

    real: str = "double"
    ending: str = ""

    def number(self, value: float) -> str:
        """Write a number so that it is read back unchanged.

        In single precision, numbers that would be rounded to zero become the smallest normal number,
        because a nonzero divisor must stay nonzero; numbers beyond the range become infinite.
        """
        if self.ending and np.isfinite(value) and value != 0.0:
            limits = np.finfo(np.float32)
            size = max(abs(value), float(limits.tiny))
            value = math.copysign(size if size <= limits.max else math.inf, value)
        if math.isnan(value):
            return f"({self.real})NAN"
        if math.isinf(value):
            return f"({self.real})INFINITY" if value > 0.0 else f"-({self.real})INFINITY"
        text = repr(float(value))
        return f"{text}{'' if '.' in text or 'e' in text else '.0'}{self.ending}"

    def text(self, template: str) -> str:
        """Replace REAL by the type and _S by the suffix."""
        return re.sub(r"(?<=[0-9a-z])_S\b", self.ending, re.sub(r"\bREAL\b", self.real, template))


DOUBLE, SINGLE = Precision(), Precision("float", "f")


def c_lines(
    named: Mapping[str, Node],
    inputs: Mapping[Any, str],
    precision: Precision,
    of: str = "v",
    known: Mapping[Node, str] = MappingProxyType({}),
) -> Iterator[str]:
    """Yield lines that assign the named nodes, such as `const double name = ...;`, in order.

    Args:
        named: the nodes by name; a name that is not an identifier, such as `P[0][0]`, is assigned to
            without a declaration.
        inputs: names of the inputs of the graph, by position.
        precision: precision of the numbers.
        of: first letter of the names of auxiliary variables, which are assigned first.
        known: names of nodes that earlier lines define.
    """
    everything = needed(named.values(), known)
    uses = Counter(argument for node in everything for argument in node.arguments)
    uses.update(named.values())
    squared = {node.arguments[0] for node in everything if node.operation is POWER}
    taken = {*inputs.values(), *named, *known.values()}
    free = (name for name in map(f"{of}{{}}".format, range(1, len(everything) + 1)) if name not in taken)
    found = {node: Text(name, _WHOLE) for node, name in known.items()}
    choice_of, levels = choices(list(named.values()), known)

    def lines_of(nodes: Collection[Node], level: Level) -> Iterator[str]:
        """Yield the lines that define the nodes on a level."""
        for node in nodes:
            if node in found or levels.get(node) != level:
                continue
            if node in choice_of:
                yield from branches(choice_of[node], level)
                continue
            text = _text_of(node, [found[each] for each in node.arguments], inputs, precision)
            is_call = text.binds == _WHOLE and text.text.endswith(")")
            longest = 0 if uses[node] > 1 and is_call else SHORTEST if uses[node] > 1 else LONGEST
            is_own = node is output and (name.isidentifier() or uses[node] == 1)
            is_single = text.binds == _WHOLE and node.operation in (INPUT, CONSTANT)
            if not is_own and not is_single and (len(text.text) > longest or node in squared):
                own = next(free)
                kind = "int" if node.is_truth else precision.real
                yield f"const {kind} {own} = {text.text};"
                text = Text(own, _WHOLE)
            found[node] = text

    def branches(choice: Choice, level: Level) -> Iterator[str]:
        """Yield the lines of a choice; each of its two branches is computed only if it is selected."""
        yield from lines_of(
            [each for each in needed(choice.members, known) if each not in choice.members], level
        )
        own = [next(free) for _ in choice.members]
        yield f"{precision.real} {', '.join(own)};"
        for index, head in enumerate((f"if ({found[choice.condition].text}) {{", "} else {")):
            yield head
            sides = [each.arguments[1 + index] for each in choice.members]
            for line in lines_of(needed(sides, known), (choice, index)):
                yield f"    {line}"
            for target, side in zip(own, sides, strict=True):
                yield f"    {target} = {_real(side, found[side], precision).text};"
        yield "}"
        found.update(zip(choice.members, (Text(each, _WHOLE) for each in own), strict=True))

    for name, output in named.items():
        yield from lines_of(needed([output], known), None)
        if name.isidentifier():
            yield f"const {precision.real} {name} = {_real(output, found[output], precision).text};"
            found[output] = Text(name, _WHOLE) if not output.is_truth else found[output]
        else:
            yield f"{name} = {_real(output, found[output], precision).text};"


def truth_text(node: Node, inputs: Mapping[Any, str], precision: Precision) -> str:
    """Write a condition as one expression."""
    found: dict[Node, Text] = {}
    for each in needed([node]):
        found[each] = _text_of(each, [found[one] for one in each.arguments], inputs, precision)
    return found[node].text


def _real(node: Node, text: Text, precision: Precision) -> Text:
    """Write a truth value as a number."""
    return Text(f"({precision.real}){text.within(_WHOLE)}", _SIGN) if node.is_truth else text


def _text_of(node: Node, given: list[Text], inputs: Mapping[Any, str], precision: Precision) -> Text:
    operation = node.operation
    if operation is INPUT:
        return Text(inputs[node.value], _WHOLE)
    if operation is CONSTANT:
        if isinstance(node.value, bool):
            return Text(str(int(node.value)), _WHOLE)
        text = precision.number(node.value)
        if not math.isfinite(node.value):
            text = f"({precision.real}){text}"
        return Text(text, _SIGN if text[0] in "-(" else _WHOLE)
    if operation is SELECT:
        condition, yes, no = given
        if node.is_truth and [each.value for each in node.arguments[1:]] == [False, True]:
            return Text(f"!({condition.text})", _SIGN)
        sides = [
            text if node.is_truth else _real(side, text, precision)
            for side, text in zip(node.arguments[1:], (yes, no), strict=True)
        ]
        return Text(
            f"{condition.within(_OR)} ? {sides[0].within(_OR)} : {sides[1].within(_CHOICE)}", _CHOICE
        )
    if operation in (operator.and_, operator.or_, operator.xor):
        sign, binds = _OPERATORS[operation]
        return Text(f" {sign} ".join(each.within(_COMPARISON) for each in given), binds)
    if operation is operator.not_:
        return Text(f"!{given[0].within(_WHOLE)}", _SIGN)
    numbers = [_real(*each, precision) for each in zip(node.arguments, given, strict=True)]
    if operation is POWER:
        return _power(numbers[0].within(_WHOLE), node.value, precision)
    if operation is operator.neg:
        return Text(f"-{numbers[0].within(_WHOLE)}", _SIGN)
    if operation in (operator.eq, operator.ne) and not all(each.is_truth for each in node.arguments):
        return _equality(node, numbers, precision)
    if operation in _OPERATORS:
        sign, binds = _OPERATORS[operation]
        first, last = numbers
        lowest = _SUM if binds in (_EQUAL, _COMPARISON) else binds
        return Text(f"{first.within(lowest)} {sign} {last.within(max(lowest, binds + 1))}", binds)
    listed = ", ".join(each.text for each in numbers)
    if operation in HELPERS:
        return Text(f"{HELPERS[operation][0]}({listed})", _WHOLE)
    if operation in _TESTS:
        return Text(f"({operation.__name__}({listed}) != 0)", _WHOLE)
    return Text(f"{_LIBM.get(operation, operation.__name__)}{precision.ending}({listed})", _WHOLE)


def _equality(node: Node, numbers: list[Text], precision: Precision) -> Text:
    """Write a comparison of numbers for equality without `==`, because compilers warn about it."""
    first, last = (each.text for each in numbers)
    is_unequal = node.operation is operator.ne
    if node.arguments[1].operation is CONSTANT and not node.arguments[1].value:
        text = f"fabs{precision.ending}({first}) <= {last}"
        return Text(f"!({text})", _SIGN) if is_unequal else Text(text, _COMPARISON)
    return Text(f"{'!' if is_unequal else ''}is_equal({first}, {last})", _SIGN)


def _power(base: str, exponent: int, precision: Precision) -> Text:
    """Write a power by repeated squaring, as in kernels."""
    found, square, rest = "", base, abs(exponent)
    while rest:
        if rest & 1:
            found = f"{found} * {square}" if found else square
        rest >>= 1
        if rest:
            square = f"({square} * {square})"
    if exponent < 0:
        return Text(f"{precision.number(1.0)} / ({found})", _PRODUCT)
    return (
        Text(found.removeprefix("(").removesuffix(")"), _PRODUCT)
        if exponent == 2
        else Text(found, _PRODUCT if " * " in found else _WHOLE)
    )


def helpers_of(nodes: Collection[Node], precision: Precision) -> list[str]:
    """Return the functions that these nodes need and that C lacks."""
    used = {node.operation for node in nodes}
    compared = [_IS_EQUAL] if used & {operator.eq, operator.ne} else []  # left out if it is not called
    texts = [text for operation, (_, text) in HELPERS.items() if operation in used]
    return [precision.text(text) for text in [*compared, *texts]]
