"""Replays from broad starts, to compare likelihoods of different parameters or of altered logs.

Without a prior, a filter begins with a state that follows from the log's first messages, and with a
covariance that depends on the parameters. To score the same measurements from the same start, all trials
begin at the log's first stamp from a broad start that is divided into equally likely parts; the
likelihood is the mean over the parts.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fuselog.recorders.log import Clock
from fuselog.replay.engine.replaying.estimator import Bound, Initialization, Initialized, Recursive
from fuselog.replay.engine.replaying.replaying import replay
from fuselog.replay.engine.streams.blocks import Ragged, gather, side_by_side
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import MemorySource

# by the name of the estimated object; all have the same number of parts
Starts = Mapping[str, Sequence[Initialized]]


def broad_starts(source: MemorySource, bound: Sequence[Bound]) -> Starts:
    """Find equally likely starts for a log that does not state one; raise BadInput as `replay` does."""
    stamps = [source.streams[topic].publish_time_ns[:1] for each in bound for topic in each.streams]
    first_ns = int(np.min(np.concatenate(stamps), initial=np.iinfo(np.int64).max))
    found: dict[str, list[Initialized]] = {}

    def note(
        bound: Bound, first: Mapping[str, Ragged], static: Mapping[str, Ragged], clock: Clock
    ) -> Initialized:
        initialization = initialization_of(bound)
        assert initialization is not None
        if initialization.find_broad is None:
            found[bound.name] = [initialization.find(first, static, clock)]
        else:
            found[bound.name] = initialization.find_broad(first, static, clock, [first_ns])
        return found[bound.name][0]

    if any(map(initialization_of, bound)):
        noting = [with_find(each, partial(note, each)) for each in bound]
        next(replay(Ensemble([source]), noting, is_part=True), None)
    most = max(map(len, found.values()), default=1)
    return {name: (list(parts) * most)[:most] for name, parts in found.items()}


def part_count(starts: Starts) -> int:
    """Count the parts into which a broad start is divided; each part is replayed."""
    return max(map(len, starts.values()), default=1)


def begun_at(bound: Bound, starts: Starts) -> Bound:
    """Make an estimator for runs that repeat the log, once for each part of its starts, in order."""
    parts = starts.get(bound.name)
    return bound if parts is None else with_find(bound, partial(_part_of_runs, parts))


def _part_of_runs(parts: Sequence[Initialized], first: Mapping[str, Ragged], *_: Any) -> Initialized:
    count = next(iter(first.values())).runs
    of_run = [parts[run % len(parts)] for run in range(count)]
    topics = parts[0].static
    return Initialized(
        {name: gather([each.static[name].stream for each in of_run]) for name in topics}, []
    )


def begun_broadly(bound: Bound, begins_ns: Sequence[int], count: int) -> Bound:
    """Make an estimator for trials that are repeated `count` times, once for each of their parts.

    Each trial finds its own starts from its own first messages, because measurements may be altered. The
    starts have the stamps `begins_ns`. An estimator that finds no broad starts is not changed.
    """
    initialization = initialization_of(bound)
    if initialization is None or initialization.find_broad is None:
        return bound
    return with_find(bound, partial(_own_parts, initialization.find_broad, begins_ns, count))


def _own_parts(
    find_broad: Callable[..., list[Initialized]],
    begins_ns: Sequence[int],
    count: int,
    first: Mapping[str, Ragged],
    static: Mapping[str, Ragged],
    clock: Clock,
) -> Initialized:
    trials = range(0, len(begins_ns) * count, count)
    own, about = (
        {name: gather([ragged.of_run(run) for run in trials]) for name, ragged in given.items()}
        for given in (first, static)
    )
    found = find_broad(own, about, clock, begins_ns)
    parts = [found[number % len(found)].static for number in range(count)]
    return Initialized({name: side_by_side([each[name] for each in parts]) for name in parts[0]}, [])


def mean_likelihood(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Compute the log of the mean likelihood by estimated object; failed parts have likelihood zero."""
    found = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        known = [part[name] for part in parts if not np.isnan(part.get(name, np.nan))]
        found[name] = float(np.logaddexp.reduce(known, initial=-np.inf) - np.log(len(parts)))
    return found


def initialization_of(bound: Bound) -> Initialization | None:
    """Return the function with which an estimator finds its start, or None if it needs no search."""
    return bound.initialization if isinstance(bound, Recursive) else None


def with_find(bound: Bound, find: Callable[..., Initialized]) -> Bound:
    """Replace the function with which an estimator finds its start, if it has one."""
    if isinstance(bound, Recursive) and bound.initialization is not None:
        return replace(bound, initialization=replace(bound.initialization, find=find))
    return bound
