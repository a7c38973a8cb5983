"""Diagnosis of an inconsistent estimator from its innovations and errors, with the likely causes.

Faults are ranked by the gain in log-likelihood from correcting them, not by their apparent size. For
example, if the stated noise of a bearing is too small, the innovations of the range become too large as
well.
"""

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.altering.sources import alter, alterations_of, setting_of, split_settings
from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.api.planning import Log, Named, settings_of, sources_of
from fuselog.pipeline.api.replays import Replay, replay
from fuselog.pipeline.comparing.renamed import Renamed
from fuselog.pipeline.diagnosing.advice import Advice, Trying, number
from fuselog.pipeline.diagnosing.causes import Sought, least_gain, seek, tried_table
from fuselog.pipeline.diagnosing.consistency import (
    judged_by_itself,
    nis_charts,
    of_each_component,
    unnamed,
    unseen_errors,
)
from fuselog.pipeline.diagnosing.findings import (
    component_table,
    corrected_by,
    is_told,
    of_estimates,
    of_innovations,
    of_log,
)
from fuselog.pipeline.diagnosing.hypotheses.parameters import NEVER_S
from fuselog.pipeline.diagnosing.sentences import (
    MOST_SENTENCES,
    cause_of,
    marks_of,
    notes_of,
    notes_of_log,
    ranked,
)
from fuselog.pipeline.output.charts import Chart
from fuselog.pipeline.output.outputs import TIMELINE, check_files, check_folder
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.pipeline.output.summary import summarise, summary_table
from fuselog.pipeline.runs.ensemble import Pass, judge_logs
from fuselog.pipeline.runs.estimates import (
    labels_of,
    recorded_estimators,
    source_of_estimates,
    stated_estimators,
)
from fuselog.pipeline.tuning.objective import for_likelihood, until_last_measured
from fuselog.pipeline.tuning.tuning import OPEN, gate_of
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput, choices, without_warnings_of_numbers
from fuselog.recorders.log import RunMetadata, Schema, Stream, schemas, topics_of
from fuselog.recorders.log.streams import concatenate
from fuselog.recorders.parameters import merge
from fuselog.replay.engine.replaying.estimator import Bound, bind
from fuselog.replay.engine.streams.blocks import Findings
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, is_sensed
from fuselog.replay.foreign.naming import allowed, name_of, of_file, refuse_programs
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.metrics.measuring import find_metrics

NOTHING = "nothing found"
MOST_MESSAGES = 40_000  # number of messages from the start of a log in which causes are searched for


class Outputs(Mapping[str, Stream]):
    """A mapping from topics to those outputs of a replay that have a given schema.

    Only the last topic is cached, because the outputs of a long log take much memory.
    """

    def __init__(self, done: Replay, schema: Schema) -> None:
        self._estimates, self._known = done.estimates[0], Findings(most=1)
        topics = self._estimates.topics
        self._topics = [name for name in topics_of(topics, schema) if topics[name].messages]

    def __getitem__(self, topic: str) -> Stream:
        stream: Stream = self._known.once(topic, lambda: self._estimates.read([topic])[topic])
        return stream

    def __iter__(self) -> Iterator[str]:
        return iter(self._topics)

    def __len__(self) -> int:
        return len(self._topics)

    def state(self, column: str) -> bool:
        """Test whether all outputs have a column."""
        firsts = (next(iter(self._estimates.blocks([topic], "publish_time", 1))) for topic in self)
        return all(column in stream.columns for first in firsts for stream in first.values())


def silent(name: str, label: str, bound: Sequence[Bound], settings: Mapping[str, Any]) -> BadInput:
    """Return the error for an estimator that has no innovations on a log of this name."""
    offers = (offer for each in bound for offer in getattr(each, "offers", {}).items())
    topic, setting = next(offers, ("", ""))
    remedy = for_likelihood(settings) or "use a filter of the same model, such as -e ekf"
    if topic:
        remedy = f"to make it use {topic}, give {setting}"
    return BadInput(f"{name}: {label} gives no innovations, which a diagnosis needs; {remedy}")


def recorded(source: LogSource | MemorySource, label: str, gap_limit_s: float) -> Replay:
    """Return an estimator's recorded estimates in the form of a replay's."""
    estimates = Renamed(source, label, label)
    judge = judge_logs([estimates], [source], find_metrics(), gap_limit_s=gap_limit_s)
    return Replay([source], [estimates], {label: {}}, Pass(judge, {label: {}}), gap_limit_s)


class Portion(NamedTuple):
    """The messages that the estimator reads from a log, up to `end_ns` (None means the whole log)."""

    source: MemorySource
    end_ns: int | None
    note: str


def first_part(
    source: LogSource | MemorySource, bound: Sequence[Bound], streamed: Sequence[str]
) -> Portion:
    """Read the topics that the estimator uses, at most the log's first MOST_MESSAGES messages."""
    whole = dict.fromkeys(topic for each in bound for topic in each.static)
    streams = source.read([topic for topic in whole if topic in source.topics])
    parts: dict[str, list[Stream]] = {topic: [] for topic in streamed}
    stamps_ns = np.empty(0, np.int64)
    for block in source.blocks(streamed, "publish_time", MOST_MESSAGES):
        for topic, stream in block.items():
            parts[topic].append(stream)
        stamps_ns = np.concatenate([stamps_ns, *(stream.publish_time_ns for stream in block.values())])
        if len(stamps_ns) > MOST_MESSAGES:
            break
    for topic, found in parts.items():
        streams[topic] = concatenate(found) if found else source.empty(topic)
    for each in bound:  # a setting may name the truth, whose errors are not needed here
        if each.truth in source.topics:
            streams.setdefault(each.truth, source.empty(each.truth))
    end_ns, note = None, ""
    if len(stamps_ns) > MOST_MESSAGES:
        end_ns = int(np.partition(stamps_ns, MOST_MESSAGES)[MOST_MESSAGES])
        for topic in streamed:
            streams[topic] = streams[topic].take(streams[topic].publish_time_ns < end_ns)
        count = sum(source.topics[topic].messages for topic in streamed)
        note = (
            f"causes were searched in the first {(end_ns - source.epoch_ns) * 1e-9:.4g} s "
            f"({MOST_MESSAGES} of {count} messages) and tested on the rest; use fuselog cut to diagnose "
            "another part"
        )
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    part = MemorySource(streams, run, source.name)
    return Portion(part, end_ns, note)


def on_the_rest(
    source: LogSource | MemorySource,
    label: str,
    settings: Mapping[str, Any],
    advised: Mapping[str, Any],
    end_ns: int,
) -> str:
    """Compute the gain from advice over the rest of the log, and format it as the end of a sentence.

    Args:
        source: the whole log.
        label: the estimator's label.
        settings: the estimator's parameters, with an open gate.
        advised: the advised settings of topics and parameters.
        end_ns: the end of the part in which the cause was found.
    """
    of_topics, own = split_settings(advised)
    before, after = (
        _likelihood(alter(source, altering), label, given, end_ns)
        for altering, given in (({}, settings), (of_topics, merge(settings, own)))
    )
    gain = after - before
    if not np.isfinite(gain):
        return ""
    if gain > 0.0:
        return f", and {number(gain, 4)} over the rest of the log"
    return f"; but it decreases by {number(-gain, 4)} over the rest of the log, so it is not valid there"


def _likelihood(
    source: LogSource | MemorySource, label: str, settings: Mapping[str, Any], end_ns: int
) -> float:
    """Compute the log-likelihood of all innovations from a stamp on."""
    done = replay(source, {label: settings})
    total = 0.0
    for stream in Outputs(done, schemas.INNOVATION).values():
        total += float(np.nansum(stream["log_likelihood"][stream.publish_time_ns >= end_ns]))
    return total


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        label: the estimator's label.
        replay: the replay of the log with the estimator's settings.
        sentences: at most five findings: faults of stamps, then causes, the most likely first.
        components: a row per measured component; see `component_table`.
        tried: a row per fault that was tried on the unaltered log, in descending order of gain: kind,
            topic, part, value, gain.
        least_gain: the gain that a fault needs to be named.
        notes: remarks on the diagnosis.
        log_likelihood: log-likelihood of all measurements used in the search for causes, with an open
            gate; NaN if it is unknown.
    """

    label: str
    replay: Replay
    sentences: Sequence[Finding]
    components: pd.DataFrame
    tried: pd.DataFrame
    least_gain: float
    notes: Sequence[str]
    log_likelihood: float

    def __repr__(self) -> str:
        return "\n".join([f"{self.label} over {self.replay.logs[0].name}", *self.told, *self.notes])

    @property
    def hypotheses(self) -> int:
        """Return the number of faults that were tried."""
        return len(self.tried)

    @property
    def told(self) -> list[str]:
        """Return the numbered sentences, or a sentence stating that no fault was found."""
        if not self.sentences:
            why = (
                f"none of the {self.hypotheses} faults tried reaches the required gain in "
                f"log-likelihood, {self.least_gain:.3g}"
            )
            return [f"{NOTHING}: {why}" if self.hypotheses else NOTHING]
        return [f"{number}. {each.sentence}" for number, each in enumerate(self.sentences, start=1)]

    @property
    def causes(self) -> pd.DataFrame:
        """Return a table with a row per sentence or value: kind, topic, part, interval, gain, setting.

        Alternatives that the log does not distinguish from a cause have its `sentence_number`.
        """
        rows = []
        for order, each in enumerate(self.sentences, start=1):
            shared = {"sentence_number": order, "kind": each.kind, "topic": each.where}
            own_cause = cause_of(each)
            nothing = [Interval(np.nan)]
            alike = (own_cause, *own_cause.others) if own_cause else ()
            for cause in alike or (None,):
                about = cause.hypothesis if cause else None
                own = {"kind": about.kind, "topic": about.topic} if about else {}
                for part in cause.numbers if cause else nothing:
                    rows.append(
                        {
                            **shared,
                            **own,
                            "part": part.name,
                            **{name: getattr(part, name) for name in ("value", "low", "high")},
                            "gain": cause.gain if cause else np.nan,
                            "setting": each.setting if cause is own_cause else "",
                            "sentence": each.sentence,
                        }
                    )
        return pd.DataFrame(rows)

    @property
    def metrics(self) -> pd.DataFrame:
        """Return a table with a row per metric of the replay: estimator, quantity, case, value."""
        return self.replay.metrics

    @cached_property
    def profiles(self) -> dict[str, Chart]:
        """Return charts of NIS per component over time, by case."""
        innovations = Outputs(self.replay, schemas.INNOVATION)
        return nis_charts(self.label, innovations, self.replay.logs[0].epoch_ns)

    @property
    def marks(self) -> dict[str, Stream]:
        """Return the sentences as messages by topic for the timeline, at the findings' first stamps."""
        first_ns = self.replay.logs[0].extent("publish_time")[0]
        return marks_of(self.sentences, self.label, [*self.replay.estimates[0].topics], first_ns)

    def view(self, save: str | Path) -> None:
        """Write the replay's timeline, with the sentences among its events, to the .rrd file `save`.

        Raises BadInput if the file cannot be written.
        """
        check_files([(Path(save), TIMELINE)], {"log": self.replay.paths})
        self._draw(Path(save))

    def _draw(self, rrd: Path) -> None:
        from fuselog.replay.timeline.show import Drawing

        log, estimates = self.replay.logs[0], self.replay.estimates
        with Drawing(log.whole(), identity="\n".join(self.told), save=rrd) as drawing:
            drawing.add(self.marks, [])
            judge_logs(estimates, [log], {}, gap_limit_s=self.replay.gap_limit_s, drawing=drawing)

    def save(self, folder: str | Path) -> ResultFolder:
        """Write sentences, tables, figures, metrics and a timeline to the result folder `folder`.

        Raises BadInput if the folder exists and is not a fuselog result.
        """
        place = Path(folder)
        check_folder(place, {"input": self.replay.paths})
        done = self.replay.done
        outcome = summarise(done.judge, done.coverage, done.parameters)
        outcome = replace_tables(outcome, {"diagnosis": self.causes, "components": self.components})
        outcome.figures |= self.profiles
        outcome.input_sha256, outcome.kind = self.replay.input_sha256, "diagnose"
        settings = {
            "title": f"{self.label} diagnosed over {self.replay.logs[0].name}",
            "logs": [log.name for log in self.replay.logs],
            "estimators": json.loads(json.dumps(self.replay.settings, default=str)),
            **setting_of(self.replay.logs[0]),
            "notes": [*self.told, *self.notes],
            "gap_limit_s": self.replay.gap_limit_s,
        }
        with result_folder(place) as part:
            self._draw(part / "timeline.rrd")
            return ResultFolder(place, write_outcome(part, "diagnose", settings, outcome))


def replace_tables(outcome: Outcome, tables: Mapping[str, pd.DataFrame]) -> Outcome:
    """Replace the tables of an outcome by `tables` and a new summary; omit empty tables."""
    found = {**tables, "summary": summary_table(outcome.metrics)}
    return replace(outcome, tables={name: table for name, table in found.items() if len(table)})


@without_warnings_of_numbers()
def diagnose(
    log: Log,
    estimator: Named | None = None,
    *,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    gap_limit_s: float = 0.2,
) -> Diagnosis:
    """Find the causes of an estimator's inconsistency, if there are any.

    Each possible fault of the log and of the settings is corrected separately, with the value that
    increases the log-likelihood most. The cause with the largest gain is named first, after findings
    that `sentences.ranked` places before causes. The gate is open during the search.

    Args:
        log: a path, an opened log, or a recording; or an estimates log next to its source log.
        estimator: a registered name, or a label of your own mapped to an estimator (see `replay`). For
            an estimates log, one of its labels; by default its only label.
        set: parameters of the estimator, and alterations of topics; see `replay`.
        gap_limit_s: the longest gap over which the truth is interpolated.

    Returns:
        At most five sentences on what is wrong, and tables of the evidence.

    Raises BadInput if there are several logs, or if the estimator does not fit the log, fails, or has
    no innovations.

    >>> from fuselog.pipeline.api.api import record
    >>> found = diagnose(record("landmarks", duration_s=20.0), "ekf", set={"sigma_range_m": 0.02})
    >>> found.sentences[0].kind, found.sentences[0].where
    ('measurement noise', 'sigma_range_m')
    """
    alterations, given = split_settings(set or {})
    sources = sources_of(log, alterations)
    if len(sources) > 1:
        raise BadInput(
            f"{len(sources)} logs: give one log, such as {sources[0].name}; diagnose takes one at a "
            "time. The table `runs` of a replay shows which run is worst, and tune takes several logs"
        )
    labels = [label for label in recorded_estimators(sources[0]) if estimator in (None, label)]
    if labels:
        return _of_recorded(sources[0], labels, given, gap_limit_s)
    source, chosen = _asked(sources[0], estimator)
    [(label, own)] = chosen.items()
    settings = merge(own, allowed(given))
    source, done, mended, why = _followed(source, label, settings, gap_limit_s)
    bound = bind(label, [source], {"kind": label, **settings})
    innovations = Outputs(done, schemas.INNOVATION)
    if not innovations:
        raise silent(source.name, label, bound, settings)
    gate = gate_of(bound)
    streamed = list(dict.fromkeys(topic for each in bound for topic in each.streams))
    notes, sought, end_ns = [*why], Sought(), None
    opened = merge({"kind": label, **settings}, OPEN if gate < 1.0 else {})
    if innovations.state("log_likelihood"):
        part, end_ns, note = first_part(source, bound, streamed)
        notes += [note] if note else []
        sought = seek(part, label, opened, MOST_SENTENCES)
    if not np.isfinite(sought.log_likelihood):
        notes.append(_without_likelihood(label, settings, innovations))
    named, beside = name_of(label, {"kind": label, **settings})
    trying = Trying(shlex.quote(named), alterations_of(source), "kind" in beside, gate)
    rest = partial(on_the_rest, source, label, opened, end_ns=end_ns) if end_ns else None
    seen = of_log(source, streamed, corrected_by(bound))
    told = [each for each in seen if is_told(each)]
    sentences = [*mended, *ranked(sought.causes, told, trying, rest)]
    no_judges = judged_by_itself(source, streamed)
    outliers = [each.value for each in sought.causes if each.hypothesis.kind == "outliers"]
    gating = {"has_outliers": bool(outliers), "in_stretches": NEVER_S in outliers}
    findings: list[Finding] = [
        *of_innovations(innovations, gate, source.epoch_ns, **gating),
        *of_estimates(Outputs(done, schemas.GAUSSIAN_ESTIMATE)),
        *(
            each
            for each in unseen_errors(done, has_causes=bool(sought.causes))
            if each.where not in no_judges
        ),
    ]
    if not sentences and all(each.kind == "gate" for each in findings):  # a gate is not a cause
        findings += unnamed(done, innovations, len(sought.tried), no_judges)
    sentences += findings
    return Diagnosis(
        label,
        done,
        sentences[:MOST_SENTENCES],
        component_table(innovations),
        tried_table(sought.tried),
        least_gain(len(sought.tried)),
        [
            *notes,
            *notes_of_log(seen, sentences),
            *no_judges.values(),
            *notes_of(done, sentences, sought.in_doubt),
        ],
        sought.log_likelihood,
    )


def _without_likelihood(label: str, settings: Mapping[str, Any], innovations: Outputs) -> str:
    """Explain why no fault is tried."""
    if innovations.state("log_likelihood") and any(
        np.isneginf(each["log_likelihood"]).any() for each in innovations.values()
    ):
        return f"{label} diverged: its log-likelihood is -inf, so no fault was tried"
    remedy = for_likelihood(settings)
    return (
        f"{label} states no likelihood of its innovations: faults are only found by unusual "
        f"measurements{'; ' if remedy else ''}{remedy}"
    )


def _of_recorded(
    source: LogSource | MemorySource,
    labels: Sequence[str],
    settings: Mapping[str, Any],
    gap_limit_s: float,
) -> Diagnosis:
    """Diagnose a filter that cannot be replayed, from the innovations that it recorded.

    Raises BadInput if there are several filters, settings for the filter, or no innovations.
    """
    label, *others = labels
    if others:
        raise BadInput(f"{source.name}: has {', '.join(labels)}; choose one with -e")
    if settings:
        raise BadInput(
            f"--set {next(iter(settings))}: {label} was recorded and takes no settings; remove them"
        )
    done = recorded(source, label, gap_limit_s)
    innovations = Outputs(done, schemas.INNOVATION)
    if not innovations:
        raise BadInput(f"{source.name}: has no innovations of {label}, which a diagnosis needs")
    sensed = [topic for topic in source.topics if is_sensed(source, topic)]
    seen = of_log(source, sensed)
    sentences = [
        *filter(is_told, seen),
        *of_each_component(innovations),
        *of_innovations(innovations, None, source.epoch_ns, has_outliers=False),
        *unseen_errors(done, has_causes=False),
    ]
    note = (
        f"{label} was recorded, so no fault can be corrected and tried: only its innovations are judged"
    )
    return Diagnosis(
        label,
        done,
        sentences[:MOST_SENTENCES],
        component_table(innovations),
        tried_table([]),
        np.inf,
        [note, *notes_of_log(seen, sentences), *notes_of(done, sentences)],
        np.nan,
    )


class _Followed(NamedTuple):
    """A log that an estimator can replay, the replay, and the findings corrected before the replay."""

    source: LogSource | MemorySource
    done: Replay
    mended: Sequence[Finding] = ()
    notes: Sequence[str] = ()


def _followed(
    source: LogSource | MemorySource, label: str, settings: Mapping[str, Any], gap_limit_s: float
) -> _Followed:
    """Replay a log; if this fails, correct the faults that a check of the log finds, and try again.

    Raises BadInput with the reason for the original log if the corrected log cannot be replayed either.
    """

    def replayed(source: LogSource | MemorySource) -> _Followed:
        source = until_last_measured(source, bind(label, [source], {"kind": label, **settings}))
        done = replay(source, {label: settings}, gap_limit_s=gap_limit_s)
        if done.failures:
            why = next((f": {each.sentence}" for each in of_log(source, source.topics)), "")
            raise BadInput(f"{done.failures[0]}; fix this first{why}")
        return _Followed(source, done)

    try:
        return replayed(source)
    except BadInput as error:
        mended = [each for each in of_log(source, source.topics) if each.setting and is_told(each)]
        if not mended:
            raise
        trying = Trying(label, alterations_of(source), is_own=False)
        remedies = [trying.over(Advice.of(each.setting)) for each in mended]
        settings_given = " ".join(f"--set {each.setting}" for each in remedies)
        note = (
            f"all other findings are about the log with {settings_given}, because it cannot be "
            f"replayed without these settings: {error}"
        )
        with suppress(BadInput):
            other = alter(source, {each.key: each.value for each in remedies})
            return replayed(other)._replace(mended=mended, notes=[note])
        raise


def _asked(
    source: LogSource | MemorySource, estimator: Named | None
) -> tuple[LogSource | MemorySource, dict[str, dict[str, Any]]]:
    """Return the log and the estimator; for an estimates log, return its source log."""
    has_estimates = labels_of(source) and not recorded_estimators(source)
    if has_estimates and isinstance(source, LogSource):
        stated = stated_estimators(source.log)
        labels = list(stated if estimator is None else settings_of(estimator))
        for label in labels:
            if label not in stated:
                raise BadInput(f"{source.name}: no estimates of {label}; {choices(label, stated)}")
        if len(labels) != 1:
            raise BadInput(f"{source.name}: has {', '.join(stated)}; choose one with -e")
        own = {name: value for name, value in stated[labels[0]].items() if value is not None}
        chosen = of_file({labels[0]: own})
        refuse_programs(chosen, source.name)
        return source_of_estimates(source.log), chosen
    if estimator is None:
        raise BadInput(f"{source.name}: has no estimates; name the estimator to diagnose with -e")
    chosen = settings_of(estimator)
    if len(chosen) > 1:
        raise BadInput(f"{', '.join(chosen)}: give one estimator; only one can be diagnosed at a time")
    return source, chosen
