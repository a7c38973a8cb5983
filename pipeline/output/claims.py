"""Decides claims: statements of papers with our verdicts.

A claim is stated as data, beside an experiment's settings in data/experiments: a sentence, what the
paper says, and a comparison of metrics that decides it; see `fuselog.pipeline.output.expressions`.
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

# The recording of a claim that is made of all there are.
ANY = "any"
TOO_FEW = f"too few runs for a 95 % interval, which takes {FEWEST_RUNS}"


@dataclass(frozen=True)
class Claim:
    """Represents a statement of a paper: what it prints, what we measured, our verdict and its reason.

    There is no verdict on a claim that is made of another recording.

    Attributes:
        claim: the statement.
        paper: what the paper prints, or where.
        ours: what we measured.
        verdict: a `Claimed`, or its word.
        why: the reason of the verdict; of a refuted claim at least the numbers that are against it.
    """

    claim: str
    paper: str
    ours: str
    verdict: Claimed
    why: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "verdict", Claimed(self.verdict))


def judged(claim: str, paper: str, ours: str, holds: bool | np.bool_, why: str = "") -> Claim:
    """Return a claim that a measured condition confirms or refutes.

    Args:
        claim: as in `Claim`.
        paper: likewise.
        ours: likewise.
        holds: whether what was measured confirms the claim.
        why: as in `Claim`.

    Returns:
        The claim with its verdict, "confirmed" or "refuted".

    >>> print(judged("the filter is consistent", "NEES 3", "NEES 3.1", holds=True).verdict)
    confirmed
    """
    return Claim(claim, paper, ours, Claimed.CONFIRMED if holds else Claimed.REFUTED, why)


def known(claim: Claim) -> Claim:
    """Return the claim, neither confirmed nor refuted where a number of ours is missing."""
    has_none = claim.verdict in (Claimed.NOT_REPRODUCIBLE, Claimed.NO_VERDICT) or claim.why == TOO_FEW
    if has_none or not re.search(rf"\bnan\b|(?<!\w){MISSING}(?!\w)", claim.ours):
        return claim
    why = "; ".join(filter(None, [claim.why, "estimates are missing"]))
    return replace(claim, verdict=Claimed.NOT_REPRODUCIBLE, why=why)


class StatedClaim(Parameters):
    """States a claim as an experiment's file has it.

    In texts, `{EXPRESSION:FORMAT}` is a number; everywhere `$NAME` is what `each` says.

    Attributes:
        sentence: what is claimed.
        paper: what the paper says, or where the limit comes from.
        holds: comparison that decides: confirmed, refuted, or inconclusive if an interval holds both;
            without one the claim is not reproducible.
        value: expression that the texts and the comparison name `value`.
        ours: what we found.
        why: reason of the verdict, or what has to be known beside it. If a refuted claim has neither
            this nor `unless`, it names the numbers that refute it.
        unless: what is said beside every verdict but `confirmed`.
        reproducible: comparison without which the claim is not reproducible, whatever `holds` says.
        each: names and what they stand for; the claim is made of each, or of each combination. An entry
            that is a table gives several names; `nees[ekf, *]` gives all that its `*` stands for.
        given: numbers or expressions by the names that the texts and the comparison have for them.
        optional: whether it is left out where the result lacks one of its metrics, in place of not
            reproducible.
        least_runs: with fewer runs it is inconclusive, unless each number that decides it has an
            interval; by default as many as the file of the experiment states, if it makes runs.
        recording: of which of the experiment's recordings it is claimed, by default of the first; `any`
            for all data there are. Of other data it has its numbers, and no verdict.
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
        """Return the claim with this least number of runs, unless it states one."""
        return self if self.least_runs else self.model_copy(update={"least_runs": runs})

    @property
    def recordings(self) -> set[str]:
        """Return the recordings that it is of: `*` for those a result will tell, "" for the first."""
        return {_named(self, meant).recording for meant in _combinations(self.each)}

    @property
    def names(self) -> set[str]:
        """Return the names in its expressions that the claim lacks; raises BadInput for what is none."""
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
    """Read an expression; raises BadInput that names the claim where it cannot be read."""
    try:
        return read(*arguments)
    except BadInput as error:
        raise BadInput(f"claim '{sentence}': {error}") from None


def require_names(stated: Sequence[StatedClaim], names: Collection[str], where: str) -> None:
    """Raise BadInput that names `where` and the claim, where one names a number that is not there."""
    for claim in stated:
        for name in sorted(claim.names.difference(names)):
            raise BadInput(
                f"{where}: claim '{claim.sentence}': no number '{name}'; {choices(name, names)}"
            )


def require_recordings(stated: Sequence[StatedClaim], recordings: Collection[str], where: str) -> None:
    """Raise BadInput that names `where` and the claim, where one is of a recording that is not there."""
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
    """Give claims verdicts by a result's metrics, 95 % intervals, and numbers by name.

    `recordings` tells of each recording whether the result is of it: there is no verdict on claims of
    others. Raises BadInput where an expression of a claim cannot be evaluated.
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
    """Return the claim, without its verdict where it is of another recording; "" is the first."""
    name = recording or next(iter(recordings), ANY)
    if name == ANY or recordings.get(name):
        return claim
    return replace(claim, verdict=Claimed.NO_VERDICT, why=f"claimed of {name}, not of these data")


def _combinations(
    each: Mapping[str, str | list[Any]], metrics: Mapping[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield what the names of `each` stand for, one combination after another.

    Without metrics, which are not known before a run, their `*` stands for itself.
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
    """List what the `*` of a metric such as `nees[ekf, *]` stands for, each once."""
    quantity, _, of = pattern.removesuffix("]").partition("[")
    return list(dict.fromkeys(keys_of(quantity, of, metrics).values()))


def _named(claim: StatedClaim, names: Mapping[str, Any]) -> StatedClaim:
    """Put into the claim what names stand for."""

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
    """Give the claim its verdict; None where it is left out."""
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
    """Put numbers into the text, or leave it as it stands where one of them is missing."""
    try:
        return formatted(text, values)
    except (BadInput, NoMetric):
        return text


def _few_runs(claim: StatedClaim, values: Values) -> str:
    """Explain that a claim is of too few runs to be decided without an interval; empty if it is not."""
    runs, least = values.names.get("runs"), claim.least_runs
    if not isinstance(runs, Interval) or least is None or runs.value >= least:
        return ""
    stated = _stated(claim)
    if not any(needs_runs(each, stated, values) for each in (claim.holds, claim.reproducible) if each):
        return ""
    return f"of {runs.value:g} runs; without an interval it is decided from {least} on"


def _stated(claim: StatedClaim) -> dict[str, str]:
    """Return the claim's expressions by the names that it has for them."""
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
