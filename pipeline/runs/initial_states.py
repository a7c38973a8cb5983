"""Replays that start from a state other than the log's own prior.

An estimator with a prior begins at the prior's stamp. If the replayed span begins later, the prior does
not apply, and the state must come from the truth or from the estimates of an earlier replay. The
estimator receives this state as a prior, so such starts need no special handling.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Clock, Stream, make_stream, open_log, schemas, topics_of
from fuselog.replay.engine.replaying.estimator import Bound
from fuselog.replay.engine.replaying.late import Late, parse_late
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source
from fuselog.replay.engine.vectors.components import (
    in_body_axes,
    match_components,
    match_tangent,
    stated_components,
)
from fuselog.replay.engine.vectors.tangent import named_now, tangent_components, truth_at
from fuselog.replay.judging.errors.evaluation import Floats, split_topic

# Function that computes a run's prior at a time in ns from an estimator's label and the log's prior.
Origin = Callable[[str, Stream, int], Stream]
Spanned = TypeVar("Spanned", bound=LogSource | MemorySource)


def order_of(
    *, arrival_order: bool, late: str | None, origins: Sequence[str | Path] = ()
) -> tuple[Clock, Late | None]:
    """Choose the clock that orders a replay, and the handling of out-of-sequence messages.

    Raises BadInput if `late` is invalid, or conflicts with the other arguments.
    """
    found = None if late is None else parse_late(late, arrival_order=arrival_order)
    if found is not None and origins:
        raise BadInput(
            f"--late {late} --start-from {origins[0]}: in order of arrival, a span does not begin at a "
            "single stamp with a known state; use only one of these options"
        )
    return "log_time" if arrival_order else "publish_time", found


def span_of(source: Spanned, start_s: float | None, end_s: float | None, order: Clock) -> Spanned:
    """Return the part of a run between two times in seconds, by the clock that orders the replay.

    Raises BadInput if the span contains no messages.
    """
    if start_s is not None and end_s is not None and start_s >= end_s:
        raise BadInput(f"--start {start_s:g} --end {end_s:g}: the end must be after the start")
    if start_s is None and end_s is None:
        return source
    zero_ns = source.zero_ns(order)
    start_ns, end_ns = (
        None if time_s is None else zero_ns + round(time_s * 1e9) for time_s in (start_s, end_s)
    )
    first_ns, last_ns = source.extent(order)
    if (start_ns is not None and start_ns > last_ns) or (end_ns is not None and end_ns < first_ns):
        first_s, last_s = ((time_ns - zero_ns) * 1e-9 for time_ns in (first_ns, last_ns))
        raise BadInput(
            f"{source.name}: no messages in this span; the log extends from {first_s:g} to {last_s:g} s"
        )
    return replace(source, start_ns=start_ns, end_ns=end_ns)


def origins_of(
    sources: Sequence[Source],
    origins: Sequence[str | Path],
    sigmas: Mapping[str, float],
    order: Clock,
    gap_limit_s: float,
) -> list[Origin]:
    """Find the initial state of each run; return [] if no initial state is requested.

    Args:
        sources: the runs.
        origins: "truth", or the estimates log of an earlier replay of each run.
        sigmas: standard deviations by component, for initial states from the truth; see `from_truth`.
        order: the clock of the replay.
        gap_limit_s: the longest gap over which the truth is interpolated.

    Raises BadInput if the replay starts at the beginning of the runs, or an estimates log is of another
    run.
    """
    if origins and sources[0].start_ns is None:
        raise BadInput(f"--start-from {origins[0]}: also give the start time with --start")
    if sigmas and tuple(origins) != ("truth",):
        name, sigma = next(iter(sigmas.items()))
        raise BadInput(f"--start-sigma {name}={sigma:g}: applies only to --start-from truth")
    if not origins:
        return []
    if tuple(origins) == ("truth",):
        return [from_truth(source, order, gap_limit_s, sigmas) for source in sources]
    if len(origins) != len(sources):
        raise BadInput(
            f"{len(sources)} logs and {len(origins)} --start-from; give truth, or one estimates log each"
        )
    opened = [LogSource(open_log(origin)) for origin in origins]
    for estimates, source in zip(opened, sources, strict=True):
        check_same_run(estimates, source)
    return [from_estimates(estimates) for estimates in opened]


def check_same_run(estimates: Source, source: Source) -> None:
    """Raise BadInput if estimates are not from the run of a log."""
    of, run = estimates.run, source.run
    if of and run and replace(of, notes={}) != replace(run, notes={}):
        raise BadInput(
            f"{estimates.name}: these are estimates of {of.scenario}, seed {of.seed}, run {of.run}; "
            f"{source.name} is {run.scenario}, seed {run.seed}, run {run.run}, or has other parameters"
        )


def start_from(
    bound: Bound, sources: Sequence[Source], origins: Sequence[Origin], order: Clock
) -> Bound:
    """Return the estimator, started from each run's origin if the run's span begins after its prior.

    Raises BadInput if an origin has no state for a prior at the beginning of the span, or if the log has
    no prior to replace.
    """
    label = bound.name.partition("/")[0]
    for topic in bound.priors.keys() - sources[0].topics.keys():
        raise BadInput(
            f"{sources[0].name}: estimator {label} has no prior in this log ({topic}) to replace; leave "
            "out --start-from, and it begins at the first measurements of the span"
        )
    priors = {
        topic: gather(
            [
                _prior(source, source.read([topic])[topic], origin, label, order)
                for source, origin in zip(sources, origins, strict=True)
            ]
        )
        for topic in bound.priors
    }
    return replace(bound, given=priors)


def _prior(source: Source, prior: Stream, origin: Origin, label: str, order: Clock) -> Stream:
    is_late = source.start_ns is not None and len(prior) and prior.times(order)[0] < source.start_ns
    if not is_late or not source.start_ns:
        return prior
    return origin(label, in_body_axes(prior), source.start_ns)


def from_truth(source: Source, order: Clock, gap_limit_s: float, sigmas: Mapping[str, float]) -> Origin:
    """Take a run's initial state from its truth.

    The covariance is the one of the log's prior. `sigmas` replace the standard deviations of some
    components, which are then uncorrelated with all others.
    """
    return partial(_true_state, source, order, gap_limit_s, sigmas)


def from_estimates(estimates: Source) -> Origin:
    """Take the initial state from an earlier replay: the last mean and covariance before the start.

    The estimate with the same label is used, or else the only estimate with the prior's components.
    """
    return partial(_estimated_state, estimates)


def _true_state(
    source: Source,
    order: Clock,
    gap_limit_s: float,
    sigmas: Mapping[str, float],
    label: str,  # noqa: ARG001
    prior: Stream,
    start_ns: int,
) -> Stream:
    topic = f"{prior.topic.rpartition('/')[0]}/truth"
    if topic not in source.topics:
        raise BadInput(
            f"{source.name}: there is no topic {topic} to start from; use --start-from ESTIMATES"
        )
    truth = source.read([topic])[topic]
    where = f"{source.name}: topic {topic}, to start from"
    components = _components(prior, source.name)
    columns = match_components(truth.metadata, components, where)
    rows = np.argsort(truth.times(order), kind="stable") if len(truth) else np.empty(0, np.int64)
    timed = replace(
        truth,
        publish_time_ns=truth.times(order)[rows],
        columns={"state": truth["state"][rows].reshape(len(rows), -1)[:, columns]},
    )
    mean = truth_at(timed, np.array([start_ns]), list(components.values()), gap_limit_s)
    if not np.isfinite(mean).all():
        raise BadInput(
            f"{where}: no truth within {gap_limit_s:g} s of the start; use another --start, a longer "
            "--gap-limit or --start-from ESTIMATES"
        )
    covariance = _with_sigmas(prior, components, sigmas)
    return _made(prior, start_ns, mean, covariance)


def _with_sigmas(prior: Stream, components: Mapping[str, Any], sigmas: Mapping[str, float]) -> Floats:
    """Replace the standard deviations of some components in the covariance (t, t) of a prior."""
    names = [name for name, _ in tangent_components(list(components), list(components.values()))]
    covariance = prior["covariance"][0].reshape(len(names), len(names)).copy()
    given = named_now(sigmas, list(components), list(components.values()))
    for name, sigma in given.items():
        if name not in names:
            raise BadInput(
                f"--start-sigma {name}: {prior.topic} has no such component; {choices(name, names)}"
            )
        own = names.index(name)
        covariance[own, :] = covariance[:, own] = 0.0
        covariance[own, own] = sigma**2
    return covariance


def _estimated_state(estimates: Source, label: str, prior: Stream, start_ns: int) -> Stream:
    components = _components(prior, estimates.name)
    topic = _estimate_topic(estimates, label, prior, components)
    stream = in_body_axes(estimates.read([topic])[topic])
    where = f"{estimates.name}: topic {topic}, to start from"
    columns = match_components(stream.metadata, components, where)
    tangent = match_tangent(stream.metadata, components, where)
    times_ns = stream.publish_time_ns
    # messages with the stamp of the start are replayed, so the prior must not contain them
    before = int(np.searchsorted(times_ns, start_ns, side="left"))
    if before == 0:
        raise BadInput(f"{where}: there is no estimate before the start; give a later --start")
    last_ns = int(times_ns[before - 1])
    is_over = before == len(stream)
    if is_over and start_ns - last_ns > np.diff(times_ns).max(initial=0):
        raise BadInput(
            f"{where}: ends {(start_ns - last_ns) * 1e-9:g} s before the start; give an earlier --start"
        )
    mean, covariance = stream["mean"][before - 1], stream["covariance"][before - 1]
    size = round(len(covariance) ** 0.5)
    block = covariance.reshape(size, size)[np.ix_(tangent, tangent)]
    return _made(prior, last_ns, mean[None, columns], block)


def _estimate_topic(estimates: Source, label: str, prior: Stream, components: Mapping[str, Any]) -> str:
    """Find the estimate that replaces a prior: it has the same case and all components of the prior."""
    case = prior.topic.rpartition("/")[0].removeprefix("/")
    found = [
        name
        for name in topics_of(estimates.topics, schemas.GAUSSIAN_ESTIMATE)
        if name.startswith("/estimates/")
        and split_topic(name)[1] == case
        and components.keys() <= set(estimates.topics[name].metadata.get("components", "").split(","))
    ]
    own = [name for name in found if split_topic(name)[0] == label] or found
    if len(own) != 1:
        listed = f"has several: {', '.join(own)}" if own else f"has {', '.join(estimates.topics)}"
        raise BadInput(
            f"{estimates.name}: starting {label} needs exactly one estimate of {', '.join(components)} "
            f"instead of {prior.topic}; the log {listed}"
        )
    return own[0]


def _components(prior: Stream, name: str) -> dict[str, Any]:
    """Return names and kinds of a prior's components; raise BadInput if it names no components."""
    found = stated_components(prior.metadata, {}, f"{name}: topic {prior.topic}")
    if not found:
        raise BadInput(
            f"{name}: topic {prior.topic} names no components, so no state can replace it; state them "
            "in the channel's metadata"
        )
    return found


def _made(prior: Stream, time_ns: int, mean: Floats, covariance: Floats) -> Stream:
    return make_stream(
        prior.topic,
        schemas.GAUSSIAN_ESTIMATE,
        [time_ns],
        metadata=prior.metadata,
        mean=mean,
        covariance=covariance.reshape(1, -1),
    )
