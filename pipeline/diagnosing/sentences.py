"""The ordered sentences of a diagnosis, on causes and on findings in the log itself."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fuselog.pipeline.api.replays import Replay
from fuselog.pipeline.diagnosing.advice import Trying
from fuselog.pipeline.diagnosing.causes import Cause
from fuselog.pipeline.diagnosing.findings import FIRST
from fuselog.pipeline.output.results import split_metric
from fuselog.recorders.checks.finding import Finding, Kind
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.impossible import Rejections
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.judging.errors.evaluation import split_topic

# Kinds of faults of the values themselves; noise or biases would have to be large to explain them.
OF_FORM = (
    *("factor or sign", "exchanged axes", "convention", "parameter", "delay", "clock drift"),
    *("outliers", "exchanged numbers", "start"),
)
CONSEQUENCES = ("delay", "clock drift", "measurement noise", "process noise")  # of faulty stamps

MOST_SENTENCES = 5
Rest = Callable[[Mapping[str, Any]], str]  # the gain of settings over the rest of a long log


# Kinds of findings in the log that a cause of another kind explains.
ALIKE: Mapping[Kind, Kind] = {"mounting": "bias or turned frame", "covariance": "measurement noise"}


@dataclass(frozen=True, kw_only=True)
class CauseFinding(Finding):
    """A finding that the search for causes made, about the topic or parameter of its `cause`."""

    cause: Cause

    @property
    def fix(self) -> str:
        """Return the advice."""
        return self.otherwise


def cause_of(found: Finding) -> Cause | None:
    """Return the cause of a finding that the search for causes made, or None for other findings."""
    return found.cause if isinstance(found, CauseFinding) else None


def names_of(found: Finding) -> list[tuple[Kind, str]]:
    """Return the kind and topic of a finding and of its alternatives."""
    cause = cause_of(found)
    others = [each.hypothesis for each in cause.others] if cause else []
    return [(found.kind, found.where), *((each.kind, each.topic) for each in others)]


def ranked(
    causes: Sequence[Cause], of_log: Sequence[Finding], trying: Trying, rest: Rest | None
) -> list[Finding]:
    """Order findings: those on stamps, then causes, then other findings that need no filter.

    A finding with a setting that corrects it comes before causes that are only consequences of the
    finding, such as noise. Findings that are among the causes, or whose settings are already advised,
    are not repeated.
    """
    remedies = [cause.hypothesis.remedy(cause.value) for cause in causes]
    advised = {key for remedy in remedies if remedy is not None for key in remedy.settings}
    of_stamps = [each for each in of_log if each.kind in FIRST]
    alike = [each.hypothesis for cause in causes for each in (cause, *cause.others)]
    kinds = {(each.kind, each.topic) for each in alike}
    others = [
        each
        for each in of_log
        if each.kind not in FIRST
        and (ALIKE.get(each.kind, each.kind), each.where) not in kinds
        and not (each.setting and _is_advised(each.setting, advised))
    ]
    is_consequence = bool(causes) and causes[0].hypothesis.kind not in OF_FORM
    before = [each for each in others if each.setting and is_consequence and each.kind != "covariance"]
    after = [each for each in others if each not in before]
    return [
        *of_stamps,
        *before,
        *(_finding(each, trying, of_stamps, rest) for each in causes),
        *after,
    ]


def _is_advised(setting: str, advised: Collection[str]) -> bool:
    """Test whether a setting, or the setting of the vector that contains it, is already advised."""
    stem = setting.partition("=")[0].removesuffix("_scale")
    return any(stem.startswith(each.removesuffix("_scale")) for each in advised)


def marks_of(
    sentences: Sequence[Finding], label: str, outputs: Sequence[str], first_ns: int
) -> dict[str, Stream]:
    """Write sentences as messages by topic for a timeline, at the stamps where the findings begin.

    `outputs` are the topics of the estimates, `first_ns` is the first stamp of the log.
    """
    cases = list(dict.fromkeys(split_topic(topic)[1] for topic in outputs))
    found: dict[str, list[Finding]] = {}
    for each in sentences:
        case = next((case for case in cases if case and each.where.startswith(f"/{case}/")), cases[0])
        found.setdefault(case, []).append(each)
    marks = {}
    for case, own in found.items():
        own = sorted(own, key=lambda each: each.time_ns or first_ns)
        topic = "/".join(filter(None, ("/estimates", label, case, "diagnosis")))
        times_ns = np.array([each.time_ns or first_ns for each in own], np.int64)
        words = [each.sentence for each in own]
        marks[topic] = reason_stream(topic, schemas.DIAGNOSED, times_ns, np.arange(len(own)), words)
    return marks


def notes_of_log(of_log: Sequence[Finding], sentences: Sequence[Finding]) -> list[str]:
    """List findings that are not sentences: hints, and findings that a cause describes differently."""
    return [
        f"hint: {each.sentence}" if each.severity == "hint" else f"the log itself shows: {each.evidence}"
        for each in of_log
        if each not in sentences
    ]


def notes_of(done: Replay, sentences: Sequence[Finding], in_doubt: Sequence[Cause] = ()) -> list[str]:
    """List remarks on a diagnosis: causes in doubt, omitted messages and findings, missing truth."""
    notes = [
        "this cause and every cause with a smaller gain are in doubt, because the parts of the log "
        f"disagree about its value by more than chance explains: {each.words}"
        for each in in_doubt
    ]
    left_out = Rejections().plus(source.rejections for source in done.logs)
    notes += [f"{topic}: {left_out.sentence(topic)}" for topic in left_out]
    notes += done.judge.components_without_truth
    if not any(split_metric(key)[1] == "nees" for key in done.judge.bounds):
        notes.append(
            "no truth: errors and NEES are missing, and faults that innovations do not show stay hidden"
        )
    elif len(done.logs) == 1:
        notes.append(
            "there is only one run, so the interval of NEES is that of a single step; use fuselog run "
            "with more runs"
        )
    if len(sentences) > MOST_SENTENCES:
        notes.append(f"{len(sentences) - MOST_SENTENCES} more findings; fix these first")
    return notes


def _finding(
    cause: Cause,
    trying: Trying,
    before: Sequence[Finding],
    rest: Rest | None,
) -> CauseFinding:
    """Describe a cause, what to try, and the effect of trying it on the rest of a long log.

    `before` contains findings on stamps, of which a cause may be a consequence.
    """
    of, words = cause.hypothesis, cause.words
    remedy = of.remedy(cause.value)
    found = CauseFinding(of.kind, of.topic, of.part, cause.numbers[0].value, words, cause=cause)
    if remedy is None or trying.is_set(remedy):
        return replace(found, evidence=f"{words}; the gate in the settings rejects these")
    advice = trying.over(remedy)
    words += rest(remedy.settings) if rest is not None else ""
    if before and of.kind in CONSEQUENCES:
        words += f"; this may be a consequence of the faulty stamps of {before[0].where}"
    tried = f"try {trying.words(advice)}"
    return replace(found, evidence=words, setting=advice.setting, otherwise=tried)
