"""Replay of the runs of an ensemble in one time-ordered pass, through several estimators."""

import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from math import inf, isqrt
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock
from fuselog.recorders.log.planes import Origin, common_origin
from fuselog.replay.engine.replaying.estimator import (
    Batch,
    Bound,
    Carried,
    Initialized,
    Recursive,
    code_of,
)
from fuselog.replay.engine.replaying.late import Late, taking_late
from fuselog.replay.engine.replaying.monitor import RunMonitor
from fuselog.replay.engine.replaying.usage import Usage
from fuselog.replay.engine.streams.blocks import Block, Findings, Ragged, gather, join
from fuselog.replay.engine.streams.ensembles import Ensemble, ensemble_of
from fuselog.replay.engine.streams.priors import start_of_runs
from fuselog.replay.engine.streams.sources import Source

BLOCK_MESSAGES = 1 << 16
# Messages of a run that an initialization reads.
FIRST_MESSAGES = 1 << 15
# Fraction of the product of two standard deviations, far above rounding.
ASYMMETRIC = 1e-6
# The largest start (in bytes) that is cached with an ensemble in memory.
SMALL_BYTES = 1 << 16
# The state of an estimator that cannot start in any run.
_REFUSED = object()


@dataclass
class Report:
    """Report of a replay in addition to its outputs.

    Attributes:
        seconds: computing time of each estimator in s by label, without one-time work such as compiling.
        coverage: for each case, the share of every run that has estimates (`schemas.COVERAGE`).
        refused: by estimator, the error if no run of this part can be replayed.
        usages: by estimator, how its measurements were used.
    """

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    coverage: list[Ragged] = field(default_factory=list)
    refused: dict[str, BadInput] = field(default_factory=dict)
    usages: dict[str, Usage] = field(default_factory=dict)


def replay(
    sources: Sequence[Source],
    estimators: Sequence[Bound],
    *,
    order: Clock = "publish_time",
    late: Late | None = None,
    block_messages: int = BLOCK_MESSAGES,
    report: Report | None = None,
    is_part: bool = False,
) -> Iterator[list[Ragged]]:
    """Replay an ensemble and yield the output streams of all estimators, block by block.

    Args:
        sources: the runs, which must have the same topics but may have different time spans.
        estimators: bound estimators with different names.
        order: the clock that defines the order: publish time, or log time (order of arrival).
        late: the policy for messages whose publish times go back, if the order is log time. Without a
            policy, log time is used as the time of measurement.
        block_messages: approximate number of messages of each run that are in memory at a time.
        report: the report, which is filled after the last block.
        is_part: whether `sources` are only a part of all runs. It is then not an error if an estimator
            can process none of the runs: the runs fail, and the report contains the error.

    A run that an estimator cannot process fails on its own, see
    `fuselog.replay.engine.replaying.monitor`; the failures come last.
    Raises BadInput if an estimator can process no run, if no run has a message for it, if the span of a
    run begins after the estimator's prior (see `fuselog.pipeline.runs.initial_states`), or if the
    estimator does not support `late`.
    """
    if late is not None:
        estimators = [taking_late(bound, late) for bound in estimators]
    ensemble = ensemble_of(sources)
    read = ensemble.read(sorted({topic for bound in estimators for topic in bound.static}))
    statics = [
        {topic: read[topic] for topic in bound.static} | dict(bound.given) for bound in estimators
    ]
    for bound, static in zip(estimators, statics, strict=True):
        _refuse_old_priors(bound, ensemble, static, order)
        _refuse_asymmetric_priors(bound, ensemble, static)
    stamps: Clock = order if late is None else "publish_time"
    monitors = [
        RunMonitor(
            bound.name,
            len(sources),
            stamps,
            static,
            is_batch=isinstance(bound, Batch),
            is_part=is_part,
            is_counting=report is not None,
        )
        for bound, static in zip(estimators, statics, strict=True)
    ]
    plane = ensemble.findings.once("plane", partial(_plane_of, ensemble[0]))
    starts = [
        _kept_start(ensemble, bound, static, order, stamps)
        for bound, static in zip(estimators, statics, strict=True)
    ]
    for monitor, start in zip(monitors, starts, strict=True):
        monitor.plane = plane
        monitor.exclude(start.unable)
    refused = _refused(estimators, starts)
    if refused and not is_part:
        raise next(iter(refused.values()))
    states = [start.state for start in starts]
    beginnings = [ragged for start in starts for ragged in start.streams]
    if beginnings:
        yield beginnings
    for bound, monitor, given in zip(estimators, monitors, states, strict=True):
        if isinstance(bound, Batch):
            for block in _required(ensemble, bound.streams, order, sys.maxsize):
                yield monitor.receive(monitor.take(partial(_solve, bound, given), block))
    block_of = partial(ensemble.block, order=order, latest=Findings(1))
    streamed = {topic for bound in estimators if isinstance(bound, Recursive) for topic in bound.streams}
    for block in _required(ensemble, sorted(streamed), order, block_messages):
        outputs: list[Ragged] = []
        for index, (bound, monitor) in enumerate(zip(estimators, monitors, strict=True)):
            if isinstance(bound, Recursive):
                streams = {topic: block[topic] for topic in bound.streams}
                work = partial(_advance, bound, states[index], block_of)
                states[index], produced = monitor.take(work, streams)
                outputs += monitor.receive(produced)
        yield outputs
    for bound, monitor, state in zip(estimators, monitors, states, strict=True):
        if isinstance(bound, Recursive) and bound.finish is not None and state is not _REFUSED:
            yield monitor.receive(monitor.take(partial(_finish, bound, bound.finish, state), {}))
    yield [failures for monitor in monitors for failures in monitor.finish()]
    if report is not None:
        report.refused |= refused
        for monitor in monitors:
            if monitor.refused is not None:
                report.refused[monitor.name] = monitor.refused
            report.seconds[monitor.name.partition("/")[0]] += monitor.seconds
            report.coverage += monitor.coverage()
            if monitor.usage is not None:
                report.usages[monitor.name] = monitor.usage


def _plane_of(source: Source) -> Origin | None:
    return common_origin({name: topic.metadata for name, topic in source.topics.items()})


class _Start(NamedTuple):
    """Start of a bound estimator.

    Attributes:
        state: state of a recursion, or input of a batch estimator; _REFUSED if the estimator cannot
            start in any run.
        unable: by run, the reason why the estimator cannot start.
        why: the error if it cannot start in any run.
        streams: output streams of the initialization.
    """

    state: Carried
    unable: Mapping[int, str] = {}
    why: BadInput | None = None
    streams: Sequence[Ragged] = ()


def _kept_start(
    ensemble: Ensemble[Source],
    bound: Bound,
    static: Mapping[str, Ragged],
    order: Clock,
    stamps: Clock,
) -> _Start:
    """Return an estimator's start; if the runs are in memory and its state is small, cache the start."""
    key = "start", bound, order, stamps
    kept: _Start | None = ensemble.findings.get(key)
    if kept is not None:
        return kept
    start = _start(ensemble, bound, static, order, stamps)
    if ensemble.is_in_memory and _bytes_of(start.state) <= SMALL_BYTES:
        ensemble.findings.once(key, lambda: start)
    return start


def _bytes_of(state: Carried) -> float:
    """Return the size in bytes of a state made of arrays; infinite for any other state."""
    if isinstance(state, np.ndarray):
        return state.nbytes
    if isinstance(state, tuple):
        return sum(map(_bytes_of, state))
    if isinstance(state, dict):
        return sum(map(_bytes_of, state.values()))
    return 0 if state is None else inf


def _start(
    ensemble: Ensemble[Source],
    bound: Bound,
    static: Mapping[str, Ragged],
    order: Clock,
    stamps: Clock,
) -> _Start:
    """Start an estimator; if it cannot start in any run, return the reason in the result."""
    streams: Sequence[Ragged] = ()
    try:
        found, streams = _initialized(ensemble, bound, static, order, stamps)
        given, unable = start_of_runs({**static, **found}, bound.priors)
        with code_of(bound.name):
            state = given if isinstance(bound, Batch) else bound.start(given)
    except BadInput as error:
        return _Start(_REFUSED, dict.fromkeys(range(len(ensemble)), str(error)), error, streams)
    starts = len(unable) < len(ensemble)
    left_out = [
        each.rejections.sentence(topic)
        for each in ensemble[:1]
        for topic in bound.priors
        if topic in each.rejections
    ]
    reasons = [] if starts else [unable[0], *left_out, "the filter cannot start"]
    why = None if starts else BadInput("; ".join(reasons))
    return _Start(state, unable, why, streams)


def _initialized(
    ensemble: Ensemble[Source],
    bound: Bound,
    static: Mapping[str, Ragged],
    order: Clock,
    stamps: Clock,
) -> Initialized:
    if not isinstance(bound, Recursive) or bound.initialization is None:
        return Initialized({}, [])
    topics = bound.initialization.topics
    first = next(ensemble.blocks(topics, order, FIRST_MESSAGES), None)
    if first is None:
        first = {topic: gather([source.empty(topic) for source in ensemble]) for topic in topics}
    with code_of(bound.name):
        return bound.initialization.find(first, static, stamps)


def _refused(estimators: Sequence[Bound], starts: Sequence[_Start]) -> dict[str, BadInput]:
    """Return, by label, the error of each estimator that cannot start in any run.

    If only some of the bound estimators of a label (one for each robot, say) cannot start, only those
    fail.
    """
    if all(start.why is None for start in starts):
        return {}
    errors_of: dict[str, list[BadInput | None]] = {}
    for bound, start in zip(estimators, starts, strict=True):
        errors_of.setdefault(bound.name.partition("/")[0], []).append(start.why)
    return {
        label: errors[0] for label, errors in errors_of.items() if errors[0] is not None and all(errors)
    }


def _solve(bound: Batch, given: Carried, streams: dict[str, Ragged]) -> list[Ragged]:
    if given is _REFUSED:
        return []
    with code_of(bound.name):
        return bound.solve(given | streams)


def _advance(
    bound: Recursive,
    state: Carried,
    block_of: Callable[[dict[str, Ragged]], Block],
    streams: dict[str, Ragged],
) -> tuple[Carried, list[Ragged]]:
    if state is _REFUSED:
        return state, []
    block = block_of(streams)
    try:
        return bound.run(state, block)
    except Exception:  # enter the context only here, since it costs time for every block
        with code_of(bound.name):
            raise


def _finish(
    bound: Recursive,
    finish: Callable[[Carried], list[Ragged]],
    state: Carried,
    _: dict[str, Ragged],
) -> list[Ragged]:
    with code_of(bound.name):
        return finish(state)


def _refuse_old_priors(
    bound: Bound, ensemble: Ensemble[Source], static: Mapping[str, Ragged], order: Clock
) -> None:
    """Raise BadInput if an estimator would start a span from a prior that is older than the span."""
    starts_ns = ensemble.starts_ns
    for topic in (bound.priors.keys() & static.keys()) - bound.given.keys() if starts_ns else ():
        for run, start_ns in starts_ns.items():
            times_ns = static[topic].of_run(run).times(order)[:1]
            if len(times_ns) and times_ns[0] < start_ns:
                raise BadInput(
                    f"{ensemble[run].name}: the replay would start {bound.name} from {topic}, which is "
                    f"{(start_ns - int(times_ns[0])) * 1e-9:g} s before the span; choose "
                    "another start with --start-from truth or --start-from ESTIMATES"
                )


def _refuse_asymmetric_priors(
    bound: Bound, ensemble: Ensemble[Source], static: Mapping[str, Ragged]
) -> None:
    """Raise BadInput if the covariance of a prior is not symmetric."""
    for topic in bound.priors.keys() & static.keys():
        prior = static[topic]
        run = prior.findings.once("asymmetric", partial(_first_asymmetric, prior))
        if run is not None:
            raise BadInput(
                f"{ensemble[run].name}: the covariance of {topic} is not symmetric; correct the prior"
            )


def _first_asymmetric(prior: Ragged) -> int | None:
    """Return the first run with a covariance that is not symmetric, or None if all are symmetric."""
    covariance = prior["covariance"]
    size = isqrt(covariance.shape[1])
    if not len(covariance) or size**2 != covariance.shape[1]:
        return None
    matrix = covariance.reshape(-1, size, size)
    deviation = np.sqrt(np.abs(matrix.diagonal(0, 1, 2)))
    apart = np.abs(matrix - matrix.swapaxes(1, 2))
    wrong = (apart > ASYMMETRIC * deviation[:, :, None] * deviation[:, None, :]).any(axis=(1, 2))
    return int(np.searchsorted(prior.offsets, np.argmax(wrong), "right")) - 1 if wrong.any() else None


def _required(
    ensemble: Ensemble[Source], topics: Sequence[str], order: Clock, block_messages: int
) -> Iterator[dict[str, Ragged]]:
    """Yield the blocks of the ensemble; raise BadInput if no run has a message on the topics."""
    blocks = ensemble.blocks(topics, order, block_messages)
    first = next(blocks, None)
    if first is None and topics:
        raise BadInput(f"{ensemble[0].name}: no messages on {', '.join(topics)} to replay")
    yield from chain([first] if first is not None else [], blocks)


def collect(outputs: Iterable[list[Ragged]]) -> dict[str, Ragged]:
    """Join the blocks of a replay into whole output streams by topic; rows of a run are adjacent."""
    parts: dict[str, list[Ragged]] = {}
    for block in outputs:
        for ragged in block:
            parts.setdefault(ragged.stream.topic, []).append(ragged)
    return {topic: join(found) for topic, found in parts.items()}
