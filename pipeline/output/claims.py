"""Verdicts on claims, which are statements of papers.

Claims are stored next to an experiment's settings in data/experiments. A claim consists of a sentence,
the paper's result, and a comparison of metrics that decides it (`fuselog.pipeline.output.expressions`).
"""

import ast
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from string import Template
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import PositiveInt, model_validator

from fuselog.pipeline.output.expressions import (
    NoMetric,
    Values,
    evaluate,
    expressions_in,
    formatted,
    in_words,
    is_many,
    keys_of,
    lacks_interval,
    metrics_of,
    names_in,
    needs_runs,
    parse,
    truth,
    value_of,
)
from fuselog.pipeline.output.numbers import COMPARISONS, Truth, Value, by_entry, exactly, flat
from fuselog.pipeline.output.words import MISSING
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import Parameters
from fuselog.replay.judging.intervals import FEWEST_RUNS, Interval
from fuselog.replay.judging.verdicts import Claimed

# Name of the recording in a claim about all recordings.
ANY = "any"
TOO_FEW = f"too few runs for a 95 % interval, which needs {FEWEST_RUNS}"

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


@dataclass(frozen=True)
class Claim:
    """A statement of a paper, with the paper's result, our result, and our verdict with its reason.

    A claim about another recording has no verdict.

    Attributes:
        claim: the statement.
        paper: the result in the paper, or where the paper states it.
        ours: what we measured.
        verdict: the verdict, as a `Claimed` or its text.
        why: the reason for the verdict; for a refuted claim, at least the numbers that contradict it.
    """

    claim: str
    paper: str
    ours: str
    verdict: Claimed
    why: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "verdict", Claimed(self.verdict))


def judged(claim: str, paper: str, ours: str, holds: bool | np.bool_, why: str = "") -> Claim:
    """Make a claim that a measured condition confirms or refutes.

    Args:
        claim: as in `Claim`.
        paper: as in `Claim`.
        ours: as in `Claim`.
        holds: whether the measurement confirms the claim.
        why: as in `Claim`.

    Returns:
        The claim with its verdict, "confirmed" or "refuted".

    >>> print(judged("the filter is consistent", "NEES 3", "NEES 3.1", holds=True).verdict)
    confirmed
    """
    return Claim(claim, paper, ours, Claimed.CONFIRMED if holds else Claimed.REFUTED, why)


def known(claim: Claim) -> Claim:
    """Return the claim, with the verdict "not reproducible" if one of our numbers is missing."""
    has_none = claim.verdict in (Claimed.NOT_REPRODUCIBLE, Claimed.NO_VERDICT) or claim.why == TOO_FEW
    if has_none or not re.search(rf"\bnan\b|(?<!\w){MISSING}(?!\w)", claim.ours):
        return claim
    why = "; ".join(filter(None, [claim.why, "estimates are missing"]))
    return replace(claim, verdict=Claimed.NOT_REPRODUCIBLE, why=why)


class StatedClaim(Parameters):
    """A claim as written in an experiment's file.

    In texts, `{EXPRESSION:FORMAT}` is replaced by the value of the expression. In all entries, `$NAME`
    is replaced by its value in `each`.

    Attributes:
        sentence: the claim.
        paper: what the paper says, or the source of the limit.
        holds: the comparison that decides whether the claim is confirmed, refuted or, if an interval
            allows both, inconclusive; without a comparison, the claim is not reproducible.
        value: the expression to which `value` refers in texts and in the comparison.
        ours: what we found.
        why: the reason for the verdict, or a remark. If a refuted claim has neither `why` nor `unless`,
            the reason lists the numbers that refute the claim.
        unless: a remark for every verdict except `confirmed`.
        reproducible: a comparison; if it is false, the claim is not reproducible, whatever `holds`
            says.
        each: names and lists of their values; a claim is made for every value or, if there are several
            names, for every combination. If a value is a table, it sets several names; `nees[ekf, *]` is
            a list of everything that its `*` matches.
        given: numbers or expressions, by their names in texts and in the comparison.
        optional: whether the claim is omitted, rather than called not reproducible, if the result lacks
            one of its metrics.
        least_runs: the number of runs below which the claim is inconclusive, unless each number that
            decides it has an interval. The default is the number of runs in the experiment's file.
        recording: the experiment's recording to which the claim refers, by default the first; `any`
            means all data. For other data, the claim has numbers but no verdict.
    """

    sentence: str
    paper: str
    holds: str = ""
    value: str = ""
    ours: str = "{value}"
    why: str = ""
    unless: str = ""
    reproducible: str = ""
    each: dict[str, str | list[Any]] = {}
    given: dict[str, float | str] = {}
    optional: bool = False
    least_runs: PositiveInt | None = None
    recording: str = ""

    @model_validator(mode="after")
    def _can_be_read(self) -> Self:
        try:
            _ = self.names
        except BadInput as error:
            raise ValueError(str(error)) from None
        return self

    def decided_from(self, runs: int) -> "StatedClaim":
        """Return the claim with this minimum number of runs, unless it already has one."""
        return self if self.least_runs else self.model_copy(update={"least_runs": runs})

    @property
    def recordings(self) -> set[str]:
        """Return the claim's recordings: "" is the first; `*` means that the result determines them."""
        return {_named(self, meant).recording for meant in _combinations(self.each)}

    @property
    def names(self) -> set[str]:
        """Return names that the claim uses but does not define; raise BadInput for bad expressions."""
        found: set[str] = set()
        for meant in _combinations(self.each):
            claim = _named(self, meant)
            texts = (claim.sentence, claim.paper, claim.ours, claim.why, claim.unless)
            expressions = [claim.holds, claim.value, claim.reproducible]
            expressions += [of for of in claim.given.values() if isinstance(of, str)]
            for text in texts:
                expressions += _reading(self.sentence, expressions_in, text)
            for expression in filter(None, expressions):
                found |= _reading(self.sentence, names_in, expression)
        return found - {*self.given, *(["value"] if self.value else [])}


def _reading(sentence: str, read: Any, *arguments: Any) -> Any:
    """Parse an expression; if it is invalid, raise BadInput with the claim's name."""
    try:
        return read(*arguments)
    except BadInput as error:
        raise BadInput(f"claim '{sentence}': {error}") from None


def require_names(stated: Sequence[StatedClaim], names: Collection[str], where: str) -> None:
    """Raise BadInput, naming `where` and the claim, if a claim uses the name of an unknown number."""
    for claim in stated:
        for name in sorted(claim.names.difference(names)):
            raise BadInput(
                f"{where}: claim '{claim.sentence}': no number '{name}'; {choices(name, names)}"
            )


def require_recordings(stated: Sequence[StatedClaim], recordings: Collection[str], where: str) -> None:
    """Raise BadInput, naming `where` and the claim, if a claim is about an unknown recording."""
    if ANY in recordings:
        raise BadInput(f"{where}: '{ANY}' stands for all recordings; give recordings.{ANY} another name")
    known = {"", "*", ANY, *recordings}
    for claim in stated if recordings else ():
        for name in sorted(claim.recordings - known):
            raise BadInput(
                f"{where}: claim '{claim.sentence}': no recording '{name}'; {choices(name, recordings)}"
            )


def decide(
    stated: Sequence[StatedClaim],
    metrics: Mapping[str, Any],
    intervals: Mapping[str, Sequence[float | None]],
    names: Mapping[str, float],
    recordings: Mapping[str, bool] | None = None,
) -> list[Claim]:
    """Decide claims from a result's metrics, their 95 % intervals, and numbers by name.

    `recordings` states for each recording whether the result comes from it. Claims about other
    recordings get no verdict. Raises BadInput if an expression of a claim cannot be evaluated.
    """
    values = Values(metrics, intervals, {name: exactly(value) for name, value in names.items()})
    found = []
    for claim in stated:
        for meant in _combinations(claim.each, metrics):
            named = _named(claim, meant)
            decided = _decided(named, values)
            if decided is not None:
                found.append(_if_claimed_of(named.recording, recordings or {}, decided))
    return found


def _if_claimed_of(recording: str, recordings: Mapping[str, bool], claim: Claim) -> Claim:
    """Return the claim, without its verdict if it is about another recording; "" means the first one."""
    name = recording or next(iter(recordings), ANY)
    if name == ANY or recordings.get(name):
        return claim
    return replace(claim, verdict=Claimed.NO_VERDICT, why=f"claimed for {name}, not for these data")


def _combinations(
    each: Mapping[str, str | list[Any]], metrics: Mapping[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the values of the names in `each`, one combination after another.

    Without metrics, which are unknown before a run, `*` stays as it is.
    """
    entries = {
        name: of if isinstance(of, list) else ["*"] if metrics is None else _found(of, metrics)
        for name, of in each.items()
    }
    for chosen in product(*entries.values()):
        names: dict[str, Any] = {}
        for name, entry in zip(entries, chosen, strict=True):
            names |= entry if isinstance(entry, dict) else {name: entry}
        yield names


def _found(pattern: str, metrics: Mapping[str, Any]) -> list[str]:
    """List the names that the `*` of a metric such as `nees[ekf, *]` matches, without duplicates."""
    quantity, _, of = pattern.removesuffix("]").partition("[")
    return list(dict.fromkeys(keys_of(quantity, of, metrics).values()))


def _named(claim: StatedClaim, names: Mapping[str, Any]) -> StatedClaim:
    """Replace the `$NAME`s of a claim by their values."""

    def put(text: str) -> str:
        return Template(text).safe_substitute(names)

    given = {name: put(of) if isinstance(of, str) else of for name, of in claim.given.items()}
    texts = {name: put(getattr(claim, name)) for name in _TEXTS}
    return claim.model_copy(update={**texts, "given": given})


_TEXTS = (
    *("sentence", "paper", "holds", "value", "ours", "why", "unless", "reproducible"),
    "recording",
)


def _decided(claim: StatedClaim, values: Values) -> Claim | None:
    """Decide a claim; return None if the claim is omitted."""
    try:
        return _reading(claim.sentence, _verdict, claim, values)
    except NoMetric as error:
        if claim.optional:
            return None
        limits = {name: exactly(of) for name, of in claim.given.items() if not isinstance(of, str)}
        values = values._replace(names={**values.names, **limits})
        sentence, paper = (_as_far_as_known(text, values) for text in (claim.sentence, claim.paper))
        return Claim(sentence, paper, "-", Claimed.NOT_REPRODUCIBLE, f"the result has no {error}")


def _as_far_as_known(text: str, values: Values) -> str:
    """Insert numbers into the text, or return the text unchanged if one of them is missing."""
    try:
        return formatted(text, values)
    except (BadInput, NoMetric):
        return text


def _few_runs(claim: StatedClaim, values: Values) -> str:
    """Return the reason why a claim needs more runs, or an empty text if it has enough."""
    runs, least = values.names.get("runs"), claim.least_runs
    if not isinstance(runs, Interval) or least is None or runs.value >= least:
        return ""
    stated = _stated(claim)
    if not any(needs_runs(each, stated, values) for each in (claim.holds, claim.reproducible) if each):
        return ""
    return f"only {runs.value:g} runs; a verdict without an interval needs at least {least}"


def _stated(claim: StatedClaim) -> dict[str, str]:
    """Return the expressions that the claim defines, by name."""
    stated = {name: of for name, of in claim.given.items() if isinstance(of, str)}
    return stated | ({"value": claim.value} if claim.value else {})


def _verdict(claim: StatedClaim, values: Values) -> Claim:
    names: dict[str, Value] = dict(values.names)
    values = values._replace(names=names)
    for name, of in {**claim.given, **({"value": claim.value} if claim.value else {})}.items():
        names[name] = evaluate(of, values) if isinstance(of, str) else exactly(of)
    sentence, paper, ours, why, unless = (
        formatted(text, values)
        for text in (claim.sentence, claim.paper, claim.ours, claim.why, claim.unless)
    )
    verdict = Claimed.NOT_REPRODUCIBLE
    holds = truth(claim.holds, values) if claim.holds else False
    if holds == "missing" and lacks_interval(claim.holds, _stated(claim), values):
        return Claim(sentence, paper, ours, Claimed.INCONCLUSIVE, TOO_FEW)
    if holds == "missing":
        unless = "; ".join(filter(None, [unless, "estimates are missing"]))
    elif claim.holds and (not claim.reproducible or truth(claim.reproducible, values) is True):
        decided = Claimed.CONFIRMED if holds else Claimed.REFUTED
        verdict = Claimed.INCONCLUSIVE if holds is None else decided
    if verdict != Claimed.NOT_REPRODUCIBLE and (few := _few_runs(claim, values)):
        return Claim(sentence, paper, ours, Claimed.INCONCLUSIVE, few)
    if verdict != Claimed.CONFIRMED:
        why = "; ".join(filter(None, [why, unless]))
    if verdict == Claimed.REFUTED and not why:
        why = refutation(claim.holds, _stated(claim), values)
    return Claim(sentence, paper, ours, verdict, why)


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
    """Describe the parts of a comparison that make it false; return "" if it is true.

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
        """List the comparisons in a condition that has to be true or, if not `wanted`, false."""
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
        """Compare two sides entry by entry; the measured side is the subject, the other is the limit."""
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
    """Ignore entries whose enclosing condition already has the required outcome."""
    of_each = truths if len(truths) == len(found.entries) else [*truths[:1]] * len(found.entries)
    entries = [
        entry._replace(truth=found.wanted) if truth is wanted else entry
        for entry, truth in zip(found.entries, of_each, strict=True)
    ]
    return found._replace(entries=entries)


def _sentence(found: _Comparison) -> str:
    """List the numbers on the wrong side of their limits; return "" if there are no such numbers."""
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
