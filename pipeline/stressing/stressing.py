"""Tells whether a result is one: replays under changes that should not matter; see `stress`.

Runs that hold the same topics are replayed together with all their copies, as further runs of one pass.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pipeline.altering.sources import split_settings
from pipeline.api.planning import Log, Named, settings_of, sources_of
from pipeline.runs.ensemble import RUNS_AT_ONCE, Settings, parameters_of, replay_blocks, stated_of
from pipeline.runs.settings import with_settings
from pipeline.stressing.changes import (
    CHANGES,
    DROPPED,
    PARAMETERS,
    SHIFT_NS,
    Inputs,
    inputs_of,
    parameters_changed,
)
from pipeline.stressing.partings import partings
from pipeline.stressing.verdicts import HARMLESS, MARGIN, Stress, Stressed, Tried
from recorders.errors import BadInput
from recorders.log import Clock, RunMetadata, Stream, schemas
from recorders.parameters import merge
from replay.engine.replaying.estimator import Bound, Recursive, bind
from replay.engine.replaying.late import Late
from replay.engine.replaying.replaying import Report, collect
from replay.engine.streams.blocks import Ragged
from replay.engine.streams.sources import Ensemble, LogSource, MemorySource, is_sensed
from replay.foreign.naming import allowed
from replay.judging.judge import Judge

MOST_HALVED = 3
# Runs that are stressed together: with their copies about as many as a replay holds at once.
TOGETHER = max(1, RUNS_AT_ONCE // (1 + len(CHANGES)))


class How(NamedTuple):
    """Says how runs are replayed and stressed.

    Attributes:
        seed: of signs, coins, and what is dropped.
        gap_limit_s: the truth is not interpolated over longer gaps.
        order: the clock to go by.
        late: what is done about messages that come late, in the order of log time.
    """

    seed: int = 0
    gap_limit_s: float = 0.2
    order: Clock = "publish_time"
    late: Late | None = None


def stress(
    logs: Log | Iterable[Log],
    estimators: Named | Iterable[Named],
    *,
    seed: int = 0,
    gap_limit_s: float = 0.2,
    set: Mapping[str, Any] | None = None,  # noqa: A002
) -> Stress:
    """Replay under changes that should not matter, and say what they do to the result.

    A run and an estimator take twelve replays at most: one as it is, one for each change, and one with
    half the change for the three that do most.

    Args:
        logs: paths, logs that were opened, or recordings.
        estimators: as for `replay`.
        seed: of signs, coins, and what is dropped.
        gap_limit_s: the truth is not interpolated over longer gaps.
        set: parameters of estimators, and how topics are altered first, as for `replay`.

    Returns:
        What each change does to the estimates of each run and estimator, and a verdict.

    Raises BadInput where an estimator cannot replay a run.

    >>> from pipeline.api.api import record
    >>> stress(record("landmarks", duration_s=5.0), "ekf").stressed[0].worst
    'sensitive'
    """
    alterations, given = split_settings(set or {})
    settings = settings_of(estimators)
    if given:
        settings = with_settings(settings, allowed(given))
    sources = [_in_memory(source) for source in sources_of(logs, alterations)]
    return Stress(stress_runs(sources, settings, How(seed, gap_limit_s)), gap_limit_s)


def stress_runs(sources: Sequence[MemorySource], settings: Settings, how: How) -> list[Stressed]:
    """Stress estimators over runs in memory, run by run.

    Args:
        sources: the runs; those that hold the same topics are replayed together.
        settings: of the estimators, by label.
        how: how they are replayed.

    Raises BadInput where an estimator cannot replay a run.
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


def _in_memory(source: LogSource | MemorySource) -> MemorySource:
    if isinstance(source, MemorySource):
        return MemorySource(source.streams, source.run, source.name, source.start_ns, source.end_ns)
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    topics = [topic for topic in source.topics if is_sensed(source, topic)]
    return MemorySource(source.read(topics), run, source.name, source.start_ns, source.end_ns)


@dataclass(frozen=True)
class _Replayed:
    """Holds runs and copies that one estimator replayed.

    Attributes:
        sources: runs and copies.
        bound: the estimator.
        outputs: what it gave, by topic.
        how: how they were replayed.
    """

    sources: Ensemble[MemorySource]
    bound: Sequence[Bound]
    outputs: Mapping[str, Ragged]
    how: How

    def estimates(self, run: int) -> dict[str, Stream]:
        """Return the Gaussian estimates of a run, by topic, in the order of their stamps."""
        wanted = schemas.GAUSSIAN_ESTIMATE.full_name
        found = {
            topic: rows.of_run(run)
            for topic, rows in self.outputs.items()
            if rows.stream.schema.full_name == wanted
        }
        return {
            topic: each.take(np.argsort(each.publish_time_ns, kind="stable"))
            for topic, each in found.items()
        }

    @cached_property
    def _metrics(self) -> Mapping[int, Mapping[tuple[str, str], float]]:
        judge = Judge(self.sources, {}, gap_limit_s=self.how.gap_limit_s)
        judge.add(self.outputs)
        found: dict[int, dict[tuple[str, str], float]] = defaultdict(dict)
        for row in judge.runs_table.to_dict("records"):
            found[row["run"]] |= {
                (str(row["case"]), str(quantity)): float(value)
                for quantity, value in row.items()
                if quantity != "run" and isinstance(value, int | float) and np.isfinite(value)
            }
        return found

    def metrics(self, run: int) -> Mapping[tuple[str, str], float]:
        """Return the metrics of one run by case and quantity, those that are known."""
        return self._metrics.get(run, {})


def _replayed(
    sources: Sequence[MemorySource], label: str, settings: Mapping[str, Any], how: How
) -> _Replayed:
    ensemble = Ensemble(sources)
    bound, report = bind(label, ensemble, settings), Report()
    blocks = replay_blocks(ensemble, bound, report, order=how.order, late=how.late)
    outputs = collect(list(block.values()) for block in blocks)
    for refusal in report.refused.values():
        raise refusal
    return _Replayed(ensemble, bound, outputs, how)


def _stressed(
    sources: Sequence[MemorySource], label: str, settings: Mapping[str, Any], how: How
) -> list[Stressed]:
    """Runs that hold the same topics, stressed; replays of all copies, of parameters, of the halves."""
    bound = bind(label, sources, settings)
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
            assert change is not None  # parameters are no change of the run
            made.append(change(sources[run], inputs[run], size, how.seed))
        return made

    whole = [
        (run, name)
        for run, own in enumerate(inputs)
        for name in CHANGES
        if name != PARAMETERS and not _lacking(name, own)
    ]
    refused: dict[str, str] = {}
    try:
        done = _replayed([*sources, *copies(whole, 1.0)], label, settings, how)
    except BadInput:
        _replayed(sources, label, settings, how)  # which raises where it is no fault of a copy
        for name in CHANGES:
            own = [what for what in whole if what[1] == name]
            try:
                _replayed([*sources, *copies(own, 1.0)], label, settings, how)
            except BadInput as error:
                refused[name] = str(error)
        whole = [what for what in whole if what[1] not in refused]
        done = _replayed([*sources, *copies(whole, 1.0)], label, settings, how)
    rows = {what: len(sources) + place for place, what in enumerate(whole)}
    base = [done.estimates(run) for run in range(len(sources))]
    other = _with_parameters(done, sources, label, settings, 1.0)

    def tried(run: int, name: str) -> Tried:
        if name == PARAMETERS:
            if isinstance(other, str):
                return Tried(name, why=other)
            return _tried(name, done, run, other, run, base[run])
        if (run, name) not in rows:
            return Tried(name, why=refused.get(name) or _lacking(name, inputs[run]))
        return _tried(name, done, run, done, rows[run, name], base[run])

    found = [{name: tried(run, name) for name in CHANGES} for run in range(len(sources))]
    doubtful = [(run, name) for run, own in enumerate(found) for name in _doubtful(own.values())]
    halved = [what for what in doubtful if what[1] != PARAMETERS]
    halves: list[dict[str, Tried]] = [{} for _ in sources]
    if halved:
        again = _replayed(copies(halved, 0.5), label, settings, how)
        for row, (run, name) in enumerate(halved):
            halves[run][name] = _tried(name, done, run, again, row, base[run])
    runs = [run for run, name in doubtful if name == PARAMETERS]
    if runs:
        less = _with_parameters(done, [sources[run] for run in runs], label, settings, 0.5)
        for row, run in enumerate([] if isinstance(less, str) else runs):
            assert not isinstance(less, str)
            halves[run][PARAMETERS] = _tried(PARAMETERS, done, run, less, row, base[run])
    return [
        Stressed(
            source,
            label,
            found[run],
            halves[run],
            {t: np.sort(source.streams[t].publish_time_ns) for t in inputs[run].sensed},
            base[run],
            {name: done.estimates(row) for (of, name), row in rows.items() if of == run}
            | ({} if isinstance(other, str) else {PARAMETERS: other.estimates(run)}),
            any(isinstance(each, Recursive) for each in bound),
        )
        for run, source in enumerate(sources)
    ]


def _topics(bound: Sequence[Bound]) -> list[str]:
    """What is read: of an estimator in time its streams and priors, of a batch all that it takes."""
    found = [
        topic
        for each in bound
        for topic in (*each.streams, *(each.priors if isinstance(each, Recursive) else ()))
    ]
    return list(dict.fromkeys(found))


def _lacking(name: str, inputs: Inputs) -> str:
    if name == "start" and not inputs.priors:
        return "the log states no start"
    if name == "zero duration" and not inputs.controls:
        return "no topic drives the motion"
    return "" if inputs.sensed or name == "start" else "nothing is measured"


def _doubtful(tried: Iterable[Tried]) -> list[str]:
    """Which changes are halved: of those that do something the three that do most."""
    own = [
        each
        for each in tried
        if CHANGES[each.name].is_scaled
        and not each.why
        and (each.largest >= HARMLESS or each.is_beyond or each.is_wider)
    ]
    own.sort(key=lambda each: (not each.is_wider, -each.largest))
    return [each.name for each in own[:MOST_HALVED]]


def _tried(
    name: str, before: _Replayed, row: int, done: _Replayed, run: int, base: Mapping[str, Stream]
) -> Tried:
    within_ns = SHIFT_NS if name == "stamps" else 0
    found = partings(base, done.estimates(run), within_ns, has_less=name == DROPPED)
    largest = max(found, key=lambda each: each.amplification.max(initial=0.0), default=None)
    one, other = before.metrics(row), done.metrics(run)
    moved = {key: other[key] - value for key, value in one.items() if key in other}
    main = _main([key[1] for key in one])
    if largest is None and not main:
        return Tried(name, why="no estimate is one Gaussian, and no error is known")
    is_beyond = any(
        abs(by) > MARGIN * abs(one[key]) for key, by in moved.items() if key[1] == main and main
    )
    return Tried(name, largest, moved, is_beyond)


def _main(quantities: Sequence[str]) -> str:
    """The metric that a verdict goes by: RMSE of the position or orientation, else the first one."""
    errors = [each for each in quantities if "rmse" in each]
    main = [each for each in ("position_rmse_m", "orientation_rmse_deg") if each in errors]
    return next(iter([*main, *errors]), "")


def _parameters(done: _Replayed, label: str) -> dict[str, Any]:
    """All parameters of an estimator: those that it has, and those that one channel states."""
    stated = {}
    for name, words in stated_of(done.bound, done.sources[0]).get(label, {}).items():
        number, _, topics = words.partition(" (")
        if "(" in topics:  # channels that state different ones
            continue
        try:
            stated[name] = float(number)
        except ValueError:
            continue
    return stated | parameters_of(done.bound).get(label, {})


def _with_parameters(
    done: _Replayed,
    sources: Sequence[MemorySource],
    label: str,
    settings: Mapping[str, Any],
    size: float,
) -> _Replayed | str:
    """Runs replayed with other parameters than they were, or why that cannot be."""
    known = _parameters(done, label)
    changed = parameters_changed(known, size, np.random.default_rng(done.how.seed))
    changed = {name: value for name, value in changed.items() if value != known[name]}
    if not changed:
        return "no parameter is a number other than zero"
    try:
        return _replayed(sources, label, merge(settings, changed), done.how)
    except BadInput as error:
        return str(error)
