"""Is this result a result? Replays under changes that should not matter; begin with `stress`."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.altering.sources import split_settings
from pipeline.api.planning import Log, Named, settings_of, sources_of
from pipeline.api.replays import Replay, replay
from pipeline.runs.settings import with_settings
from pipeline.stressing.changes import (
    CHANGES,
    PARAMETERS,
    SHIFT_NS,
    Change,
    Inputs,
    inputs_of,
    parameters_changed,
)
from pipeline.stressing.partings import partings
from pipeline.stressing.verdicts import HARMLESS, MARGIN, Stress, Stressed, Tried
from recorders.errors import BadInput
from recorders.log import RunMetadata, Stream, schemas
from recorders.parameters import merge
from replay.engine.replaying.estimator import Bound, Recursive, bind
from replay.engine.streams.sources import LogSource, MemorySource, is_sensed
from replay.foreign.naming import allowed

MOST_HALVED = 3


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

    Raises BadInput where an estimator cannot replay a run.

    >>> from pipeline.api.api import record
    >>> stress(record("landmarks", duration_s=5.0), "ekf").stressed[0].worst
    'sensitive'
    """
    alterations, given = split_settings(set or {})
    settings = settings_of(estimators)
    if given:
        settings = with_settings(settings, allowed(given))
    stressed = [
        _stressed(_in_memory(source), label, own, seed, gap_limit_s)
        for source in sources_of(logs, alterations)
        for label, own in settings.items()
    ]
    return Stress(stressed)


def _in_memory(source: LogSource | MemorySource) -> MemorySource:
    if isinstance(source, MemorySource):
        return MemorySource(source.streams, source.run, source.name, source.start_ns, source.end_ns)
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    topics = [topic for topic in source.topics if is_sensed(source, topic)]
    return MemorySource(source.read(topics), run, source.name, source.start_ns, source.end_ns)


def _stressed(
    source: MemorySource, label: str, settings: Mapping[str, Any], seed: int, gap_limit_s: float
) -> Stressed:
    bound = bind(label, [source], settings)
    controls = [
        topic
        for each in bound
        if isinstance(each, Recursive) and each.reading is not None
        for topic in each.reading().controls
    ]
    inputs = inputs_of(source, _topics(bound), dict.fromkeys(controls))
    copies = {
        name: change.of_run(source, inputs, 1.0, seed)
        for name, change in CHANGES.items()
        if change.of_run is not None and not _lacking(name, inputs)
    }
    done = replay([source, *copies.values()], {label: settings}, gap_limit_s=gap_limit_s)
    base = _estimates(done, 0)
    tried = {
        name: _tried(name, done, 0, done, row, base) for row, name in enumerate(copies, start=1)
    } | {name: Tried(name, why=why) for name in CHANGES if (why := _lacking(name, inputs))}
    known = _parameters(done, label)
    tried[PARAMETERS] = _with_parameters(source, label, settings, known, 1.0, seed, done)
    tried = {name: tried[name] for name in CHANGES}
    doubtful = sorted(
        (each for each in tried.values() if CHANGES[each.name].is_scaled and _is_doubtful(each)),
        key=lambda each: (not each.is_wider, -each.largest),
    )[:MOST_HALVED]
    halves = {}
    runs = {each.name: CHANGES[each.name] for each in doubtful if each.name != PARAMETERS}
    if runs:
        halved = [_half(source, each, inputs, seed) for each in runs.values()]
        again = replay(halved, {label: settings}, gap_limit_s=gap_limit_s)
        halves = {name: _tried(name, done, 0, again, row, base) for row, name in enumerate(runs)}
    if any(each.name == PARAMETERS for each in doubtful):
        halves[PARAMETERS] = _with_parameters(source, label, settings, known, 0.5, seed, done)
    stamps_ns = {topic: np.sort(source.streams[topic].publish_time_ns) for topic in inputs.sensed}
    return Stressed(source.name, label, source.epoch_ns, tried, halves, stamps_ns, base)


def _half(source: MemorySource, change: Change, inputs: Inputs, seed: int) -> MemorySource:
    assert change.of_run is not None  # parameters are no change of the run
    return change.of_run(source, inputs, 0.5, seed)


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


def _is_doubtful(each: Tried) -> bool:
    return not each.why and (each.largest >= HARMLESS or each.is_beyond or each.is_wider)


def _estimates(done: Replay, run: int) -> dict[str, Stream]:
    log = done.estimates[run]
    wanted = schemas.GAUSSIAN_ESTIMATE.full_name
    return log.read([topic for topic, each in log.topics.items() if each.schema_name == wanted])


def _tried(
    name: str, before: Replay, row: int, done: Replay, run: int, base: Mapping[str, Stream]
) -> Tried:
    found = partings(base, _estimates(done, run), SHIFT_NS if name == "stamps" else 0)
    largest = max(found, key=lambda each: each.amplification.max(initial=0.0), default=None)
    one, other = (_metrics(each, at) for each, at in ((before, row), (done, run)))
    moved = {key: other[key] - value for key, value in one.items() if key in other}
    main = _main([key[1] for key in one])
    if largest is None and not main:
        return Tried(name, why="no estimate is one Gaussian, and no error is known")
    is_beyond = any(
        abs(by) > MARGIN * abs(one[key]) for key, by in moved.items() if key[1] == main and main
    )
    return Tried(name, largest, moved, is_beyond)


def _metrics(done: Replay, run: int) -> dict[tuple[str, str], float]:
    """The metrics of one run by case and quantity, those that are known."""
    table = done.runs
    if table.empty:
        return {}
    own = table[table["run"] == run].set_index("case").drop(columns=["estimator", "run"])
    numbers = own.select_dtypes("number")
    return {
        (str(case), str(quantity)): float(value)
        for case, values in numbers.iterrows()
        for quantity, value in values.items()
        if np.isfinite(value)
    }


def _main(quantities: Sequence[str]) -> str:
    """The metric that a verdict goes by: RMSE of the position or orientation, else the first one."""
    errors = [each for each in quantities if "rmse" in each]
    main = [each for each in ("position_rmse_m", "orientation_rmse_deg") if each in errors]
    return next(iter([*main, *errors]), "")


def _parameters(done: Replay, label: str) -> dict[str, Any]:
    """All parameters of an estimator: those that it has, and those that one channel states."""
    stated = {}
    for name, words in done.done.stated.get(label, {}).items():
        number = words.partition(" (")[0]
        try:
            stated[name] = float(number)
        except ValueError:  # channels that state different ones
            continue
    return stated | done.done.parameters.get(label, {})


def _with_parameters(
    source: MemorySource,
    label: str,
    settings: Mapping[str, Any],
    known: Mapping[str, Any],
    size: float,
    seed: int,
    before: Replay,
) -> Tried:
    changed = parameters_changed(dict(known), size, np.random.default_rng(seed))
    changed = {name: value for name, value in changed.items() if value != known[name]}
    if not changed:
        return Tried(PARAMETERS, why="no parameter is a number other than zero")
    try:
        done = replay(source, {label: merge(settings, changed)}, gap_limit_s=before.gap_limit_s)
    except BadInput as error:
        return Tried(PARAMETERS, why=str(error))
    return _tried(PARAMETERS, before, 0, done, 0, _estimates(before, 0))
