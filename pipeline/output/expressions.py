"""Evaluation of expressions over a result's metrics, which decide claims.

    nees[ekf, robot1]          the metric `ekf.nees.robot1`
    nees[ekf]                  the metric `ekf.nees`
    nees[ekf | ukf, *]         a list: of both estimators in all cases, in this order
    gain[ekf, wind][0]         an entry of a list
    rmse_m[ekf] < 2 * limit    a comparison: true, false, or open if an interval allows both

Each number in a list is named after the text that `*` or `|` matched. The functions are
`numbers.FUNCTIONS`.
"""

import ast
import math
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from fnmatch import fnmatchcase
from functools import cache
from string import Formatter
from typing import Any, NamedTuple

from fuselog.pipeline.output.numbers import (
    COMPARISONS,
    FUNCTIONS,
    OPERATIONS,
    Truth,
    Value,
    all_hold,
    any_holds,
    by_entry,
    combined,
    exactly,
    negated,
    negative,
)
from fuselog.pipeline.output.words import MISSING
from fuselog.recorders.errors import BadInput, choices
from fuselog.replay.judging.intervals import Interval


class NoMetric(Exception):
    """An expression names a metric that the result does not contain."""


class Values(NamedTuple):
    """Everything that an expression may name.

    Attributes:
        metrics: the metrics by their keys, `estimator.quantity[.case]`.
        intervals: the 95 % intervals of metrics that have one.
        names: other numbers by name.
    """

    metrics: Mapping[str, Any]
    intervals: Mapping[str, Sequence[float | None]]
    names: Mapping[str, Value]


def evaluate(expression: str, values: Values) -> Value:
    """Evaluate an expression.

    Raises BadInput if the expression is invalid, and `NoMetric` if the result lacks one of the metrics.
    """
    try:
        return value_of(parse(expression), values)
    except (TypeError, AttributeError, ValueError, OverflowError):
        raise BadInput(
            f"'{expression}' uses a number, a list or a comparison in the wrong place"
        ) from None


def truth(expression: str, values: Values) -> Truth:
    """Test whether an expression holds, for all entries if it is a list; raise as `evaluate` does."""
    found = evaluate(expression, values)
    if isinstance(found, Interval):
        raise BadInput(f"'{expression}' is a number, not a comparison; compare it with a limit")
    return all_hold(found if isinstance(found, list) else [found])


def formatted(template: str, values: Values) -> str:
    """Replace every `{EXPRESSION:FORMAT}` in a sentence by its value; join lists with commas.

    If a number has an interval, the interval follows the number; `{EXPRESSION!n:FORMAT}` also writes the
    names of numbers. Raises as `evaluate` does.
    """
    parts = []
    for text, expression, form, conversion in Formatter().parse(template):
        parts.append(text)
        if expression is not None:
            found = evaluate(expression, values)
            try:
                parts.append(in_words(found, form or ".3g", named=conversion == "n"))
            except ValueError:
                raise BadInput(
                    f"'{form}' is not a number format; write for example {{value:.2f}}"
                ) from None
    return "".join(parts)


def expressions_in(template: str) -> list[str]:
    """Return the expressions of a template; raise BadInput if its braces do not match."""
    try:
        return [each for _, each, _, _ in Formatter().parse(template) if each is not None]
    except ValueError as error:
        raise BadInput(f"'{template}': {error}; write braces as {{{{ and }}}}") from None


def in_words(value: Value, form: str, *, named: bool = False) -> str:
    """Format a value, with its interval if it has one, and with the names of numbers if `named`."""
    if isinstance(value, list):
        return ", ".join(in_words(each, form, named=named) for each in value)
    if not isinstance(value, Interval):
        return value if isinstance(value, str) else {True: "yes", False: "no", None: "open"}[value]
    text, low, high = (format(each, form) if math.isfinite(each) else MISSING for each in value[:3])
    if value.low != value.high and value.is_known:
        text += f" ({low} to {high})"
    return f"{value.name} {text}" if named else text


@cache
def parse(expression: str) -> ast.expr:
    """Parse an expression; raise BadInput if it contains syntax that expressions do not allow."""
    quoted = re.sub(r"(\w)\[(?!-?\d+\])([^\[\]]*)\]", lambda each: f"{each[1]}[{each[2]!r}]", expression)
    try:
        tree = ast.parse(quoted.strip(), mode="eval").body
    except (SyntaxError, ValueError):
        raise BadInput(f"'{expression}' cannot be read; write for example nees[ekf, body] < 2") from None
    for node in ast.walk(tree):
        if type(node) not in _KNOWN:
            raise BadInput(
                f"'{expression}': only numbers, names, metrics, + - * / **, comparisons, and, or, not "
                "and functions are allowed; remove the rest"
            )
        if isinstance(node, ast.Call):
            called = getattr(node.func, "id", "")
            if called not in FUNCTIONS or node.keywords:
                raise BadInput(f"'{expression}': no function '{called}'; {choices(called, FUNCTIONS)}")
    return tree


@cache
def names_in(expression: str) -> frozenset[str]:
    """Return the names of numbers in an expression; raise BadInput if it is invalid."""
    tree = parse(expression)
    nodes = list(ast.walk(tree))
    called = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    of_metrics = {
        id(node.value)
        for node in nodes
        if isinstance(node, ast.Subscript)
        and isinstance(node.slice, ast.Constant)
        and isinstance(node.slice.value, str)
    }
    named = [node for node in nodes if isinstance(node, ast.Name)]
    return frozenset(node.id for node in named if id(node) not in called | of_metrics)


def needs_runs(expression: str, stated: Mapping[str, str], values: Values) -> bool:
    """Test whether chance could change the result of a comparison, so that it needs many runs.

    A comparison needs many runs if it reads a metric without an interval, uses only the value or one end
    of an interval, or tests whether an interval contains a number: fewer runs make intervals wider.

    Args:
        expression: the comparison.
        stated: expressions by name.
        values: everything that the comparison may name.
    """
    tree = _expanded(expression, stated)
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id="value" | "low" | "high"), args=[of]) if metrics_of(of):
                return True
            case ast.Compare(ops=ops, comparators=others):
                within = [each for op, each in zip(ops, others, strict=True) if isinstance(op, ast.In)]
                if any(map(metrics_of, within)):
                    return True
    return not values.intervals.keys() >= {*_keys_in(tree, values)}


def lacks_interval(expression: str, stated: Mapping[str, str], values: Values) -> bool:
    """Test whether an expression reads a metric whose interval is unknown for lack of runs.

    The arguments are the same as for `needs_runs`.
    """
    keys = {*_keys_in(_expanded(expression, stated), values)} & values.intervals.keys()
    ends = [end for key in keys if values.metrics[key] is not None for end in values.intervals[key]]
    return any(end is None or math.isnan(end) for end in ends)


def _keys_in(tree: ast.expr, values: Values) -> list[str]:
    """List the keys of the metrics that an expression reads."""
    return [key for each in metrics_of(tree) for key in keys_of(*each, values.metrics)]


def _expanded(expression: str, stated: Mapping[str, str]) -> ast.expr:
    """Parse an expression, and replace names by their expressions."""
    tree: ast.expr = _Expanded(stated).visit(deepcopy(parse(expression)))
    return tree


class _Expanded(ast.NodeTransformer):
    """A transformer that replaces names by their expressions."""

    def __init__(self, stated: Mapping[str, str]) -> None:
        self.stated = stated

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id not in self.stated:
            return node
        return self.visit(deepcopy(parse(self.stated[node.id])))

    def visit_Call(self, node: ast.Call) -> ast.expr:
        node.args = [self.visit(each) for each in node.args]
        return node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        is_metric = isinstance(node.slice, ast.Constant) and isinstance(node.slice.value, str)
        if not is_metric:
            self.generic_visit(node)
        return node


def metrics_of(tree: ast.expr) -> list[tuple[str, str]]:
    """Return the metrics that an expression names, as pairs of the quantity and the text in brackets."""
    found = []
    for node in ast.walk(tree):
        match node:
            case ast.Subscript(value=ast.Name(id=quantity), slice=ast.Constant(value=str() as of)):
                found.append((quantity, of))
    return found


def value_of(node: ast.expr, values: Values) -> Value:
    """Evaluate a part of an expression."""
    match node:
        case ast.Constant(value=bool()):
            raise BadInput("true and false are not numbers; compare numbers")
        case ast.Constant(value=int() | float() as number):
            return exactly(number)
        case ast.Name(id=name):
            if name not in values.names:
                raise BadInput(f"no name '{name}'; {choices(name, values.names)}")
            return values.names[name]
        case ast.Subscript(value=ast.Name(id=quantity), slice=ast.Constant(value=str() as of)):
            return metric(quantity, of, values)
        case ast.Subscript(value=of_list, slice=index):
            entries, place = value_of(of_list, values), value_of(index, values)
            if not isinstance(entries, list) or not isinstance(place, Interval):
                raise BadInput(f"'{ast.unparse(node)}': only a list has entries")
            if not -len(entries) <= place.value < len(entries):
                raise NoMetric(ast.unparse(node))
            return entries[int(place.value)]
        case ast.List(elts=entries):
            return [value_of(each, values) for each in entries]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return by_entry(negative, value_of(operand, values))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return by_entry(negated, value_of(operand, values))
        case ast.BinOp(left=left, op=op, right=right):
            combine = combined(OPERATIONS[type(op)])
            return by_entry(combine, value_of(left, values), value_of(right, values))
        case ast.BoolOp(op=op, values=parts):
            together = all_hold if isinstance(op, ast.And) else any_holds
            return by_entry(lambda *each: together(each), *(value_of(part, values) for part in parts))
        case ast.Compare(left=left, ops=ops, comparators=others):
            sides = [value_of(each, values) for each in (left, *others)]
            pairs = zip(ops, sides, sides[1:], strict=False)
            found = [by_entry(COMPARISONS[type(op)], one, other) for op, one, other in pairs]
            return found[0] if len(found) == 1 else by_entry(lambda *each: all_hold(list(each)), *found)
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name](*(value_of(each, values) for each in arguments))
    raise BadInput(f"'{ast.unparse(node)}' is not an expression of metrics")


def metric(quantity: str, of: str, values: Values) -> Value:
    """Look up the metric of `estimator, case`, or a list of metrics if the text contains `*` or `|`.

    Raises `NoMetric` if there is no such metric.
    """
    keys = keys_of(quantity, of, values.metrics)
    if not keys:
        raise NoMetric(f"{quantity}[{of}]")
    found = [_of_key(key, name, values) for key, name in keys.items()]
    return found if is_many(of) else found[0]


def keys_of(quantity: str, of: str, metrics: Mapping[str, Any]) -> dict[str, str]:
    """Find the keys of the metrics of `estimator, case`, and the names that `*` and `|` match in each.

    Raises `NoMetric` if a metric that the expression names without `*` is missing.
    """
    estimator, _, case = (part.strip() for part in of.partition(","))
    found = {}
    for label in estimator.split("|"):
        for one in case.split("|"):
            pattern = ".".join(filter(None, (label.strip(), quantity, one.strip())))
            if "*" not in pattern and pattern not in metrics:
                raise NoMetric(f"{quantity}[{', '.join(filter(None, (label.strip(), one.strip())))}]")
            matches = (
                [key for key in metrics if fnmatchcase(key, pattern)] if "*" in pattern else [pattern]
            )
            for key in matches:
                found[key] = _name(key, quantity, label.strip(), one.strip(), estimator, case)
    return found


def _name(key: str, quantity: str, label: str, one: str, estimator: str, case: str) -> str:
    own, _, rest = key.partition(f".{quantity}")
    parts = [(own, label, estimator), (rest.removeprefix("."), one, case)]
    return " ".join(
        part[len(some.partition("*")[0]) : len(part) - len(some.rpartition("*")[2]) or None]
        if "*" in some
        else part
        for part, some, all_ in parts
        if is_many(all_)
    )


def is_many(of: str) -> bool:
    """Test whether the brackets of a metric select a list."""
    return "*" in of or "|" in of


def _of_key(key: str, name: str, values: Values) -> Value:
    value = values.metrics[key]
    if isinstance(value, list):
        return [exactly(each, name) for each in value]
    if key in values.intervals:
        low, high = (exactly(end).value for end in values.intervals[key])
        return Interval(exactly(value).value, low, high, name=name)
    return exactly(value, name)


_KNOWN: set[type[ast.AST]] = {
    *(ast.Constant, ast.Name, ast.Load, ast.Subscript, ast.List, ast.UnaryOp, ast.USub, ast.Not),
    *(ast.BinOp, ast.BoolOp, ast.And, ast.Or, ast.Compare, ast.Call),
    *OPERATIONS,
    *COMPARISONS,
}
