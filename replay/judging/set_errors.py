"""Estimated sets against the true ones, step by step: OSPA and GOSPA with its parts.

A set estimate is a pair of streams: its size, and its elements (see `schemas.ESTIMATE_SIZE`). The true
set at a time are all things whose truth has the estimate's components and is known then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.log import Stream, schemas
from replay.engine.blocks import Ragged
from replay.engine.sources import Source
from replay.judging.evaluation import POSITION, split_topic, truth_at
from replay.judging.metrics import Metric
from replay.judging.set_distances import gospa, ospa

Floats = NDArray[np.float64]
CUTOFF_M = 10.0
ORDER = 2.0


class SetErrors(NamedTuple):
    """A set estimate of an ensemble, judged: one row (n,) per run and step.

    Distances are in m; localisation, missed and false are GOSPA's parts in m^2. `estimated` and `true`
    are the numbers of things.
    """

    estimator: str
    case: str
    run: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    elapsed_s: Floats
    ospa: Floats
    gospa: Floats
    localisation: Floats
    missed: Floats
    false: Floats
    estimated: NDArray[np.int64]
    true: NDArray[np.int64]


def set_errors(
    outputs: Mapping[str, Ragged],
    sources: Sequence[Source],
    *,
    cutoff_m: float = CUTOFF_M,
    gap_limit_s: float = 0.2,
) -> list[SetErrors]:
    """Judge every set estimate among a replay's outputs whose things have truths in all runs."""
    found = []
    for topic, sizes in outputs.items():
        elements = outputs.get(f"{topic.rpartition('/')[0]}/element")
        if sizes.stream.schema.full_name != schemas.ESTIMATE_SIZE.full_name or elements is None:
            continue
        components = sizes.stream.components
        truths = [_truths(source, components) for source in sources]
        if components and all(truths):
            runs = [
                _judge_run(sizes.of_run(run), elements.of_run(run), truths[run], cutoff_m, gap_limit_s)
                for run in range(len(sources))
            ]
            number = np.repeat(np.arange(len(runs)), [len(each) for each in runs])
            time_ns = sizes.stream.publish_time_ns
            epochs = np.array([source.epoch_ns for source in sources])
            elapsed_s = (time_ns - epochs[number]) * 1e-9
            rows = np.concatenate(runs)
            judged = (*rows[:, :6].T, *rows[:, 6:].T.astype(np.int64))
            found.append(SetErrors(*split_topic(topic), number, time_ns, elapsed_s, *judged))
    return found


def _truths(source: Source, components: Sequence[str]) -> list[Stream]:
    """The truths of things that have exactly these components, put into their order."""
    topics = [
        topic.name
        for topic in source.topics.values()
        if topic.schema_name == schemas.TRUTH_STATE.full_name
        and sorted(topic.metadata.get("components", "").split(",")) == sorted(components)
    ]
    found = []
    for truth in source.read(topics).values():
        columns = [truth.components.index(name) for name in components]
        state = truth["state"].reshape(-1, len(components))[:, columns]
        found.append(replace(truth, columns={**truth.columns, "state": state}))
    return found


def _judge_run(
    sizes: Stream, elements: Stream, truths: Sequence[Stream], cutoff_m: float, gap_limit_s: float
) -> Floats:
    """Rows of OSPA, GOSPA, its three parts, the estimated and the true number (n, 7)."""
    components = sizes.components
    place = [components.index(name) for name in POSITION if name in components]
    kinds = ["linear"] * len(components)
    states = [truth_at(each, sizes.publish_time_ns, kinds, gap_limit_s) for each in truths]
    true = np.stack(states, axis=1)[..., place]
    ends = np.cumsum(sizes["elements"].astype(np.int64))
    rows = np.empty((len(sizes), 7))
    for step, end in enumerate(ends):
        estimated = elements["mean"][end - sizes["elements"][step] : end][:, place]
        there = true[step][np.isfinite(true[step]).all(axis=1)]
        parts = gospa(estimated, there, cutoff_m, ORDER)
        counts = len(estimated), len(there)
        rows[step] = ospa(estimated, there, cutoff_m, ORDER), *parts, *counts
    return rows


def _measure(found: SetErrors) -> dict[str, float]:
    if len(found.run) == 0:
        return {}
    per_thing = CUTOFF_M**ORDER / 2.0
    return {
        "ospa_m": float(found.ospa.mean()),
        "gospa_m": float(found.gospa.mean()),
        "gospa_localisation_m": float(np.sqrt(found.localisation.mean())),
        "missed_things": float(found.missed.mean() / per_thing),
        "false_things": float(found.false.mean() / per_thing),
        "cardinality_error_things": float((found.estimated - found.true).mean()),
    }


SETS = Metric("OSPA and GOSPA with its parts of estimated sets, cutoff 10 m", SetErrors, _measure)
