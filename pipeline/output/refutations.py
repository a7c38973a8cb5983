"""Explanations of refuted claims, with the false parts of the comparison and their numbers."""

import ast
import re
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

from fuselog.pipeline.output.expressions import (
    Values,
    in_words,
    is_many,
    metrics_of,
    parse,
    value_of,
)
from fuselog.pipeline.output.numbers import COMPARISONS, Truth, by_entry, exactly, flat
from fuselog.replay.judging.intervals import Interval

MOST_ENTRIES = 4  # largest number of entries that a sentence names
_WORDS: dict[type[ast.cmpop], str] = {
    ast.Lt: "below",
    ast.LtE: "at most",
    ast.Gt: "above",
    ast.GtE: "at least",
    ast.Eq: "equal to",
    ast.In: "within",
}
_MIRRORED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt,
    ast.LtE: ast.GtE,
    ast.Gt: ast.Lt,
    ast.GtE: ast.LtE,
    ast.Eq: ast.Eq,
}


class _Entry(NamedTuple):
    """One comparison of two numbers, and whether it is true."""

    number: Interval
    limit: Interval
    truth: Truth


class _Comparison(NamedTuple):
    """A comparison of numbers, entry by entry, and the outcome that the claim requires.

    `subject` names the numbers, `other` names the limits if these are measured as well.
    """

    op: type[ast.cmpop]
    wanted: bool
    subject: str
    other: str
    entries: Sequence[_Entry]


def refutation(comparison: str, stated: Mapping[str, str], values: Values) -> str:
    """Describe the parts of a comparison that make it false; empty if it is true.

    Args:
        comparison: the expression that decides a claim.
        stated: expressions by the names that stand for them.
        values: everything that the comparison may name.
    """
    found = _Reader(stated, values).read(parse(comparison), wanted=True)
    return "; ".join(filter(None, map(_sentence, found)))


class _Reader(NamedTuple):
    """A reader that finds the comparisons in a condition."""

    stated: Mapping[str, str]
    values: Values

    def read(self, node: ast.expr, *, wanted: bool) -> list[_Comparison]:
        """List the comparisons of a condition that should be true, or false if not `wanted`."""
        match node:
            case ast.Name(id=name) if name in self.stated:
                return self.read(parse(self.stated[name]), wanted=wanted)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return self.read(operand, wanted=not wanted)
            case ast.Call(func=ast.Name(id="all" | "any"), args=[of]):
                return self.read(of, wanted=wanted)
            case ast.Call(func=ast.Name(id="falls"), args=[of]):
                numbers = flat([value_of(of, self.values)])
                entries = [_compared(ast.Lt, later, one) for one, later in pairwise(numbers)]
                return [_Comparison(ast.Lt, wanted, self._name(of), "the one before", entries)]
            case ast.Subscript(value=of, slice=index):
                place = value_of(index, self.values)
                assert isinstance(place, Interval)
                found = self.read(of, wanted=wanted)
                return [each._replace(entries=[each.entries[int(place.value)]]) for each in found]
            case ast.BoolOp(values=parts):
                truths = flat([value_of(node, self.values)])
                found = [one for part in parts for one in self.read(part, wanted=wanted)]
                return [_only(each, truths, wanted=wanted) for each in found]
            case ast.Compare(left=left, ops=ops, comparators=others):
                return [
                    self._compare(type(op), one, other, wanted=wanted)
                    for op, one, other in zip(ops, (left, *others), others, strict=False)
                ]
        return []

    def _compare(
        self, op: type[ast.cmpop], one: ast.expr, other: ast.expr, *, wanted: bool
    ) -> _Comparison:
        """Compare two sides entry by entry; the measured side is the subject, the other the limit."""
        if op in _MIRRORED and not self._is_measured(one) and self._is_measured(other):
            op, one, other = _MIRRORED[op], other, one

        sides = (value_of(each, self.values) for each in (one, other))
        entries = flat([by_entry(partial(_compared, op), *sides)])
        limit = self._name(other) if self._is_measured(other) else ""
        return _Comparison(op, wanted, self._name(one), limit, entries)

    def _is_measured(self, node: ast.expr) -> bool:
        """Test whether an expression reads a metric, directly or through names."""
        names = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} & self.stated.keys()
        return bool(metrics_of(node)) or any(
            self._is_measured(parse(self.stated[name])) for name in names
        )

    def _name(self, node: ast.expr) -> str:
        """Name an expression: its metric, the claim's name for it, or its text."""
        match node:
            case ast.Name(id="value") if "value" in self.stated:
                return self._name(parse(self.stated["value"]))
            case ast.Subscript(value=ast.Name(id=quantity), slice=ast.Constant(value=str() as of)):
                return quantity if is_many(of) else f"{quantity}[{of}]"
            case ast.Subscript(value=of) | ast.Call(func=ast.Name(id="max" | "min"), args=[of]):
                return self._name(of)
        text = re.sub(r"\['([^']*)'\]", r"[\1]", ast.unparse(node))
        if "value" not in self.stated:
            return text
        return re.sub(r"\bvalue\b(?!\()", lambda _: self._name(ast.Name("value")), text)


def _compared(op: type[ast.cmpop], number: Interval, limit: Interval) -> _Entry:
    return _Entry(number, limit, COMPARISONS[op](number, limit))


def _only(found: _Comparison, truths: Sequence[Truth], *, wanted: bool) -> _Comparison:
    """Ignore entries for which the enclosing condition already has the required outcome."""
    of_each = truths if len(truths) == len(found.entries) else [*truths[:1]] * len(found.entries)
    entries = [
        entry._replace(truth=found.wanted) if truth is wanted else entry
        for entry, truth in zip(found.entries, of_each, strict=True)
    ]
    return found._replace(entries=entries)


def _sentence(found: _Comparison) -> str:
    """List the numbers that are on the wrong side of their limits; empty if there are none."""
    against = [
        (place, each)
        for place, each in enumerate(found.entries, start=1)
        if isinstance(each.truth, bool) and each.truth is not found.wanted
    ]
    if not against:
        return ""
    side = ("not " if found.wanted else "") + _WORDS[found.op]
    one = against[0][1]
    number, limit = _written(one, found.op)
    if len(found.entries) == 1:
        of = f" of {one.number.name}" if one.number.name else ""
        subject = f"{number} is" if found.subject == number else f"{found.subject}{of} is {number},"
        of_limit = one.limit.name if one.limit.name != one.number.name else ""
        other = ", ".join(filter(None, [found.other, of_limit]))
        return f"{subject} {side} {limit}" + (f" ({other})" if other else "")
    is_common = len({each.limit[:3] for _, each in against}) == 1
    parts = []
    for place, each in against[:MOST_ENTRIES]:
        number, own = _written(each, found.op)
        name = each.number.name or f"entry {place}"
        parts.append(f"{name}: {number}" if is_common else f"{name}: {number} against {own}")
    if len(against) > MOST_ENTRIES:
        parts.append(f"{len(against) - MOST_ENTRIES} more")
    other = f" ({found.other})" if found.other else ""
    to = f"{limit}{other}" if is_common else found.other or "the limit"
    where = f"in {len(against)} of {len(found.entries)} ({', '.join(parts)})"
    return f"{found.subject} is {side} {to} {where}"


def _written(entry: _Entry, op: type[ast.cmpop]) -> tuple[str, str]:
    """Format a number and its limit with enough digits to show that they differ."""
    number, limit = entry[:2]
    ends = [exactly(each) for each in limit[1:3]] if op is ast.In else [limit]
    own, texts = "", [""]
    for digits in range(3, 16):
        own, *texts = (in_words(each, f".{_digits(each, digits)}g") for each in (number, *ends))
        if own not in texts or any(number[:3] == end[:3] for end in ends):
            break
    return own, " to ".join(texts)


def _digits(number: Interval, digits: int) -> int:
    """Raise the number of digits so that large numbers are written without an exponent."""
    return max(digits, len(f"{max(map(abs, number[:3])):.0f}"))
