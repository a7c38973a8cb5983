"""A test of whether a result is robust under changes that should not matter; see `stress`.

Runs with the same topics are replayed together with all their copies in one pass.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fuselog.pipeline.altering.sources import split_settings
from fuselog.pipeline.api.planning import Log, Named, settings_of, sources_of
from fuselog.pipeline.runs.ensemble import RUNS_AT_ONCE, Settings
from fuselog.pipeline.runs.settings import with_settings
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.stressing.changes import (
    CHANGES,
    PARAMETERS,
    Inputs,
    inputs_of,
)
from fuselog.pipeline.stressing.copies import How, Replayed, compared, replayed, with_parameters
from fuselog.pipeline.stressing.verdicts import BENT, HALVES, HARMLESS, Stress, Stressed, Tried
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import MemorySource, in_memory
from fuselog.replay.foreign.naming import allowed

MOST_HALVED, MOST_REPLAYS = 3, 12
# Number of runs that are stressed together; with their copies about as many as a replay processes at
# once.
TOGETHER = max(1, RUNS_AT_ONCE // (1 + len(CHANGES)))


@without_warnings_of_numbers()
def stress(
    logs: Log | Iterable[Log],
    estimators: Named | Iterable[Named],
    *,
    seed: int = 0,
    gap_limit_s: float = 0.2,
    set: Mapping[str, Any] | None = None,  # noqa: A002
) -> Stress:
    """Replay under changes that should not matter, and report their effect on the result.

    At most twelve replays are made per run and estimator: one without changes, one for each change, and
    one with half of each of the three changes with the largest effect. If half of a change has neither
    half of the effect nor all of it, there is one more replay with a quarter of this change.

    Args:
        logs: paths, opened logs, or recordings.
        estimators: the estimators, in the form that `replay` accepts.
        seed: the seed of random signs and of dropped messages.
        gap_limit_s: longest gap over which the truth is interpolated.
        set: parameters of estimators and alterations of topics, in the form that `replay` accepts; the
            alterations are applied first.

    Returns:
        The effect of each change on the estimates of each run and estimator, and a verdict.

    Raises BadInput if an estimator cannot replay a run, or if it fails in all runs before its first
    estimate.

    >>> from fuselog.pipeline.api.api import record
    >>> stress(record("landmarks", duration_s=5.0), "ekf").stressed[0].worst
    'sensitive'
    """
    alterations, given = split_settings(set or {})
    settings = settings_of(estimators)
    if given:
        settings = with_settings(settings, allowed(given))
    sources = [in_memory(source) for source in sources_of(logs, alterations)]
    found = stress_runs(sources, settings, How(seed, gap_limit_s))
    for label in settings:
        own = [each for each in found if each.estimator == label]
        if all(each.failed for each in own):
            raise BadInput(f"{own[0].run}: estimator {label} fails {own[0].failed}")
    return Stress(found, gap_limit_s)


def stress_runs(sources: Sequence[MemorySource], settings: Settings, how: How) -> list[Stressed]:
    """Stress estimators over runs in memory, run by run.

    Args:
        sources: the runs; those with the same topics are replayed together.
        settings: the settings of the estimators, by label.
        how: how the runs are replayed.

    Raises BadInput if an estimator cannot replay a run.
    """
    alike: dict[Any, list[int]] = defaultdict(list)
    for run, source in enumerate(sources):
        held = tuple(
            (each.name, each.schema_name, *sorted(each.metadata.items()))
            for each in source.topics.values()
        )
        alike[held].append(run)
    found: dict[tuple[int, str], Stressed] = {}
    for runs in alike.values():
        for first in range(0, len(runs), TOGETHER):
            own = runs[first : first + TOGETHER]
            for label, values in settings.items():
                stressed = _stressed([sources[run] for run in own], label, values, how)
                found |= {(run, label): each for run, each in zip(own, stressed, strict=True)}
    return [found[run, label] for run in range(len(sources)) for label in settings]


def _stressed(
    sources: Sequence[MemorySource], label: str, settings: Mapping[str, Any], how: How
) -> list[Stressed]:
    """Stress runs with the same topics: replay all copies, changed parameters, and halved changes."""
    trial = Trial(label, Ensemble(sources), settings)
    bound = trial.bind()
    controls = [
        topic
        for each in bound
        if isinstance(each, Recursive) and each.reading is not None
        for topic in each.reading().controls
    ]
    topics = _topics(bound)
    inputs = [inputs_of(source, topics, dict.fromkeys(controls)) for source in sources]

    def copies(of: Sequence[tuple[int, str]], size: float) -> list[MemorySource]:
        made = []
        for run, name in of:
            change = CHANGES[name].of_run
            assert change is not None  # parameters are not part of the run
            made.append(change(sources[run], inputs[run], size, how.seed))
        return made

    def again(sources: Sequence[MemorySource]) -> Replayed:
        return replayed(replace(trial, runs=Ensemble(sources)), how)

    whole = [
        (run, name)
        for run, own in enumerate(inputs)
        for name in CHANGES
        if name != PARAMETERS and not _lacking(name, own)
    ]
    refused: dict[str, str] = {}
    try:
        done = again([*sources, *copies(whole, 1.0)])
    except BadInput:
        again(sources)  # raises if the fault is not that of a copy
        for name in CHANGES:
            own = [what for what in whole if what[1] == name]
            try:
                again([*sources, *copies(own, 1.0)])
            except BadInput as error:
                refused[name] = str(error)
        whole = [what for what in whole if what[1] not in refused]
        done = again([*sources, *copies(whole, 1.0)])
    rows = {what: len(sources) + place for place, what in enumerate(whole)}
    base = [done.estimates(run) for run in range(len(sources))]
    other = with_parameters(trial, how, 1.0)

    def tried(run: int, name: str) -> Tried:
        if name == PARAMETERS:
            if isinstance(other, str):
                return Tried(name, why=other)
            return compared(name, done, run, other, run, base[run])
        if (run, name) not in rows:
            return Tried(name, why=refused.get(name) or _lacking(name, inputs[run]))
        return compared(name, done, run, done, rows[run, name], base[run])

    found = [{name: tried(run, name) for name in CHANGES} for run in range(len(sources))]
    doubtful = [(run, name) for run, own in enumerate(found) for name in _doubtful(own.values())]

    def smaller(of: Sequence[tuple[int, str]], size: float) -> dict[tuple[int, str], Tried]:
        """Try smaller versions of the given changes of the given runs."""
        own, less = [what for what in of if what[1] != PARAMETERS], dict[tuple[int, str], Tried]()
        if own:
            lesser = again(copies(own, size))
            for row, (run, name) in enumerate(own):
                less[run, name] = compared(name, done, run, lesser, row, base[run])
        runs = [run for run, name in of if name == PARAMETERS]
        if runs:
            of_runs = replace(trial, runs=Ensemble(sources[run] for run in runs))
            changed = with_parameters(of_runs, how, size)
            for row, run in enumerate([] if isinstance(changed, str) else runs):
                assert not isinstance(changed, str)
                less[run, PARAMETERS] = compared(PARAMETERS, done, run, changed, row, base[run])
        return less

    halves = smaller(doubtful, 0.5)
    quarters = smaller(_bent(found, halves), 0.25)
    return [
        Stressed(
            source,
            label,
            found[run],
            {name: each for (of, name), each in halves.items() if of == run},
            {name: each for (of, name), each in quarters.items() if of == run},
            {t: np.sort(source.streams[t].publish_time_ns) for t in inputs[run].sensed},
            base[run],
            {name: done.estimates(row) for (of, name), row in rows.items() if of == run}
            | ({} if isinstance(other, str) else {PARAMETERS: other.estimates(run)}),
            any(isinstance(each, Recursive) for each in bound),
        )
        for run, source in enumerate(sources)
    ]


def _bent(
    found: Sequence[Mapping[str, Tried]], halves: Mapping[tuple[int, str], Tried]
) -> list[tuple[int, str]]:
    """Choose the changes to quarter: half of such a change has less effect, but more than half as much.

    A nonlinear effect is proportional if the change is small enough. No run is replayed more than twelve
    times.
    """
    chosen = []
    for run, own in enumerate(found):
        less = {name: each for (of, name), each in halves.items() if of == run}
        bent = [
            name
            for name, each in less.items()
            if BENT * each.size <= own[name].size < HALVES[0] * each.size
        ]
        replays = 1 + sum(not each.why for each in own.values()) + len(less)
        bent.sort(key=lambda name: -own[name].size)
        chosen += [(run, name) for name in bent[: max(0, MOST_REPLAYS - replays)]]
    return chosen


def _topics(bound: Sequence[Bound]) -> list[str]:
    """List the topics that are read: streams and priors, or all inputs of a batch estimator."""
    found = [
        topic
        for each in bound
        for topic in (*each.streams, *(each.priors if isinstance(each, Recursive) else ()))
    ]
    return list(dict.fromkeys(found))


def _lacking(name: str, inputs: Inputs) -> str:
    if name == "start" and not inputs.priors:
        return "the log contains no initial state"
    if name == "zero duration" and not inputs.controls:
        return "the estimator has no control"
    return "" if inputs.sensed or name == "start" else "the log has no measurements"


def _doubtful(tried: Iterable[Tried]) -> list[str]:
    """Choose the changes to halve, which are the three with the largest effect."""
    own = [
        each
        for each in tried
        if CHANGES[each.name].is_scaled
        and not each.why
        and (each.largest >= HARMLESS or each.beyond or each.is_wider)
    ]
    own.sort(key=lambda each: (not each.is_wider, -each.size))
    return [each.name for each in own[:MOST_HALVED]]
