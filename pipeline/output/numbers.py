"""Arithmetic with numbers that have intervals, for the evaluation of expressions.

A comparison is neither true nor false if the interval of a number does not decide it. Operations and
comparisons on lists apply to each entry.
"""

import ast
import math
import operator
from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import median
from typing import Any, Literal

from fuselog.recorders.errors import BadInput
from fuselog.replay.judging.intervals import Interval

# True, false, None if the interval does not decide it, or "missing" if a number is NaN.
Truth = bool | Literal["missing"] | None
Value = Interval | Truth | list[Any]


def exactly(value: float | None, name: str = "") -> Interval:
    """Make an exact number, whose interval has no width; None becomes NaN."""
    value = math.nan if value is None else float(value)
    return Interval(value, value, value, name=name)


def by_entry(function: Callable[..., Any], *arguments: Value) -> Value:
    """Apply a function to numbers, or to the entries of lists of equal length."""
    lengths = {len(each) for each in arguments if isinstance(each, list)}
    if not lengths:
        return function(*arguments)
    if len(lengths) > 1:
        raise BadInput(f"lists of {' and '.join(map(str, sorted(lengths)))} entries cannot be combined")
    [length] = lengths
    columns = (each if isinstance(each, list) else [each] * length for each in arguments)
    return [by_entry(function, *each) for each in zip(*columns, strict=True)]


def combined(operation: Callable[[float, float], float]) -> Callable[[Interval, Interval], Interval]:
    """Extend an operation to intervals, whose ends are computed from the ends of the arguments."""

    def of(one: float, other: float) -> float:
        try:
            return operation(one, other)
        except ZeroDivisionError:
            return math.copysign(math.inf, one) if one else math.nan

    def combine(one: Interval, other: Interval) -> Interval:
        ends = [of(first, second) for first in one[1:3] for second in other[1:3]]
        known = (min(ends), max(ends)) if not any(map(math.isnan, ends)) else (math.nan, math.nan)
        return Interval(of(one.value, other.value), *known, name=one.name or other.name)

    return combine


def _of_known(compare: Callable[[Interval, Interval], Truth]) -> Callable[[Interval, Interval], Truth]:
    """Make a comparison that returns "missing" if one of its numbers is missing."""

    def found(one: Interval, other: Interval) -> Truth:
        if not (isinstance(one, Interval) and isinstance(other, Interval)):
            raise BadInput("only numbers can be compared; join comparisons with and, or")
        return compare(one, other) if one.is_known and other.is_known else "missing"

    return found


def _ordered(holds: Callable[[float, float], bool]) -> Callable[[Interval, Interval], Truth]:
    """Make a test of whether one number's whole interval is below, or above, the other's."""

    def compare(one: Interval, other: Interval) -> Truth:
        if one.low == one.high and other.low == other.high:
            return holds(one.value, other.value)
        rising = holds(0.0, 1.0)
        near, far = (one.high, other.low) if rising else (one.low, other.high)
        if holds(near, far):
            return True
        near, far = (one.low, other.high) if rising else (one.high, other.low)
        return None if holds(near, far) else False

    return _of_known(compare)


def _within(one: Interval, other: Interval) -> Truth:
    """Test whether a number, with its whole interval, is inside another's interval."""
    if other.low <= one.low and one.high <= other.high:
        return True
    return False if one.high < other.low or one.low > other.high else None


def _equal(one: Interval, other: Interval) -> Truth:
    if one.low == one.high and other.low == other.high:
        return one.value == other.value
    return False if one.high < other.low or one.low > other.high else None


def negated(of: Truth) -> Truth:
    """Negate a truth value; undecided and missing values stay as they are."""
    return not of if isinstance(of, bool) else of


def all_hold(truths: Sequence[Any]) -> Truth:
    """Test whether all truth values, nested lists included, are true.

    The result is missing if any value is missing, otherwise false if any is false, otherwise undecided
    if any is undecided.
    """
    known = flat(truths)
    if "missing" in known:
        return "missing"
    return False if False in known else None if None in known else True


def any_holds(truths: Sequence[Any]) -> Truth:
    """Test whether any truth value, nested lists included, is true; missing if any value is missing."""
    return negated(all_hold([negated(each) for each in flat(truths)]))


def flat(values: Sequence[Any]) -> list[Any]:
    """Flatten nested lists."""
    return [one for each in values for one in (flat(each) if isinstance(each, list) else [each])]


def _of_all(function: Callable[[Sequence[float]], float]) -> Callable[..., Interval]:
    """Make a function of numbers or lists, such as the minimum, that also handles intervals."""

    def found(*arguments: Value) -> Interval:
        numbers = flat(arguments)
        if not numbers or not all(each.is_known for each in numbers):
            return exactly(None)
        value, low, high = (function([each[place] for each in numbers]) for place in range(3))
        name = next((each.name for each in numbers if each.value == value), "")
        return Interval(value, low, high, name=name)

    return found


def _rising(function: Callable[[float], float]) -> Callable[[Value], Value]:
    """Make an increasing function that applies to a number, or to each entry of a list."""

    def of(number: float) -> float:
        try:
            return function(number)
        except (ValueError, OverflowError):
            return math.nan

    return lambda values: by_entry(lambda each: each.rising(of), values)


def negative(number: Interval) -> Interval:
    """Negate a number and its interval."""
    return Interval(-number.value, -number.high, -number.low, name=number.name)


def _absolute(number: Interval) -> Interval:
    ends = abs(number.low), abs(number.high)
    least = 0.0 if number.low <= 0.0 <= number.high else min(ends)
    return Interval(abs(number.value), least, max(ends), name=number.name)


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers)


def _deviation(numbers: Sequence[float]) -> float:
    """Compute the standard deviation of a sample."""
    mean = _mean(numbers)
    squares = sum((each - mean) ** 2 for each in numbers)
    return math.sqrt(squares / (len(numbers) - 1)) if len(numbers) > 1 else math.nan


def _plus_minus(number: Interval, spread: Interval) -> Interval:
    """Replace the interval of a number by plus and minus a spread."""
    low, high = number.value - spread.value, number.value + spread.value
    return Interval(number.value, low, high, name=number.name)


def _chi_square(share: Interval, size: Interval) -> Interval:
    """Compute a quantile of the chi-square distribution; return NaN for zero degrees of freedom."""
    from fuselog.replay.engine import chi2

    return exactly(float(chi2.ppf(share.value, size.value)) if size.value > 0.0 else None)


def _count(values: list[Any]) -> Interval:
    """Count the true comparisons; if a comparison is missing, the count has no interval."""
    known = flat(values)
    count = float(sum(each is True for each in known))
    return Interval(count) if "missing" in known else exactly(count)


def _falls(values: list[Interval]) -> Truth:
    """Test whether each entry is below the previous one."""
    return all_hold([COMPARISONS[ast.Lt](later, one) for one, later in pairwise(values)])


def _consistent(size: Interval, count: Interval) -> Interval:
    """Compute the 95 % interval of the mean NEES of `size` components over `count` estimates.

    Returns NaN if `size` or `count` is missing.
    """
    from fuselog.replay.judging.errors.evaluation import chi_square_interval

    if not (size.is_known and count.is_known):
        return exactly(None)
    low, high = chi_square_interval(int(size.value), int(count.value))
    return Interval(size.value, float(low), float(high))


OPERATIONS: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
COMPARISONS: dict[type[ast.cmpop], Callable[[Interval, Interval], Truth]] = {
    ast.Lt: _ordered(operator.lt),
    ast.LtE: _ordered(operator.le),
    ast.Gt: _ordered(operator.gt),
    ast.GtE: _ordered(operator.ge),
    ast.Eq: _of_known(_equal),
    ast.In: _of_known(_within),
}
FUNCTIONS: dict[str, Callable[..., Value]] = {
    "abs": lambda values: by_entry(_absolute, values),
    "all": lambda values: all_hold([values]),
    "any": lambda values: any_holds([values]),
    "chi_square": _chi_square,
    "consistent": _consistent,
    "count": _count,
    "deviation": _of_all(_deviation),
    "degrees": _rising(math.degrees),
    "exp": _rising(math.exp),
    "falls": _falls,
    "high": lambda values: by_entry(lambda each: exactly(each.high, each.name), values),
    "len": lambda values: exactly(len(values)),
    "log": _rising(math.log),
    "low": lambda values: by_entry(lambda each: exactly(each.low, each.name), values),
    "max": _of_all(max),
    "mean": _of_all(_mean),
    "median": _of_all(median),
    "min": _of_all(min),
    "plus_minus": _plus_minus,
    "sqrt": _rising(math.sqrt),
    "sum": _of_all(sum),
    "value": lambda values: by_entry(lambda each: exactly(each.value, each.name), values),
}
