"""Verdicts on claims, which are statements of papers.

Claims are stored next to an experiment's settings in data/experiments. A claim consists of a sentence,
the paper's result, and a comparison of metrics that decides it (`fuselog.pipeline.output.expressions`).
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from string import Template
from typing import Any, Self

import numpy as np
from pydantic import PositiveInt, model_validator

from fuselog.pipeline.output.expressions import (
    NoMetric,
    Values,
    evaluate,
    expressions_in,
    formatted,
    keys_of,
    lacks_interval,
    names_in,
    needs_runs,
    truth,
)
from fuselog.pipeline.output.numbers import Value, exactly
from fuselog.pipeline.output.refutations import refutation
from fuselog.pipeline.output.words import MISSING
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import Parameters
from fuselog.replay.judging.intervals import FEWEST_RUNS, Interval
from fuselog.replay.judging.verdicts import Claimed

# Name of the recording in a claim about all recordings.
ANY = "any"
TOO_FEW = f"too few runs for a 95 % interval, which needs {FEWEST_RUNS}"


@dataclass(frozen=True)
class Claim:
    """A statement of a paper, with the paper's result, ours, our verdict and its reason.

    A claim about another recording has no verdict.

    Attributes:
        claim: the statement.
        paper: the result in the paper, or where the paper states it.
        ours: what we measured.
        verdict: a `Claimed`, or its text.
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

    In texts, `{EXPRESSION:FORMAT}` is replaced by the value of the expression; everywhere `$NAME` is
    replaced by its value in `each`.

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
            names, for every combination. A table as a value sets several names; `nees[ekf, *]` is a list
            of everything that its `*` matches.
        given: numbers or expressions, by their names in texts and in the comparison.
        optional: whether the claim is left out, instead of not reproducible, if the result lacks one
            of its metrics.
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
        """Return the claim's recordings: "" is the first, `*` means that they depend on the result."""
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
    """Raise BadInput with `where` and the claim if a claim uses the name of an unknown number."""
    for claim in stated:
        for name in sorted(claim.names.difference(names)):
            raise BadInput(
                f"{where}: claim '{claim.sentence}': no number '{name}'; {choices(name, names)}"
            )


def require_recordings(stated: Sequence[StatedClaim], recordings: Collection[str], where: str) -> None:
    """Raise BadInput with `where` and the claim if a claim is about an unknown recording."""
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
    """Return the claim, without its verdict if it is about another recording; "" is the first."""
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
    return f"only {runs.value:g} runs; without an interval, a verdict needs at least {least}"


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
