"""Comparison of estimated sets with true ones, step by step: OSPA, and GOSPA with its parts.

A set estimate is a pair of streams: its size, and its elements (see `schemas.ESTIMATE_SIZE`). The true
set at a given time consists of all targets whose truths have the components of the estimate and are
known at this time.
"""

from abc import ABC
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas, topics_of
from fuselog.recorders.log.planes import frame_of
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.sets.judging.distances import gospa, ospa
from fuselog.replay.families.sets.judging.regions import Regions, regions_of
from fuselog.replay.judging.errors.evaluation import POSITION, reference, split_topic
from fuselog.replay.judging.errors.frames import not_comparable, seen_in
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.kinds import KindJudge
from fuselog.replay.judging.metrics.measuring import Sums, metric_of_sums

Floats = NDArray[np.float64]
CUTOFF_M = 10.0
ORDER = 2.0


class SetErrors(NamedTuple):
    """Errors of a set estimate over an ensemble, with one row (n,) per run and step.

    Attributes:
        estimator: the estimator's label.
        case: name of the estimated quantity; may be empty.
        run, time_ns, elapsed_s: the number of the run, the stamp, and the time since the run's epoch.
        ospa, gospa: the distances, in m.
        localisation, missed, false: GOSPA's parts, in m^2.
        estimated, true: estimated and true number of targets.
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
    truths: Sequence[Truths],
    *,
    cutoff_m: float = CUTOFF_M,
    gap_limit_s: float = 0.2,
    first_run: int = 0,
) -> dict[str, SetErrors]:
    """Judge every set estimate in the outputs of a replay, or in a block of them, by topic.

    Targets are transformed into the frame of the estimates. Estimates are left out if their targets have
    no truths in some run, or if their frame has no known pose (see `unjudged_sets`). `first_run` is the
    number of the first run.
    """
    found = {}
    for topic, sizes in outputs.items():
        elements = outputs.get(f"{topic.rpartition('/')[0]}/element")
        if sizes.stream.schema.full_name != schemas.ESTIMATE_SIZE.full_name or elements is None:
            continue
        components = sizes.stream.components
        sources = [each.source for each in truths]
        targets = [targets_in(each, components) for each in sources]
        if components and all(targets) and not unjudged_sets(sizes.stream, sources):
            judge = partial(_judge_run, cutoff_m=cutoff_m, gap_limit_s=gap_limit_s)
            runs = [
                judge(sizes.of_run(run), elements.of_run(run), targets[run], truths[run])
                for run in range(len(truths))
            ]
            number = np.repeat(np.arange(len(runs)), [len(each) for each in runs])
            time_ns = sizes.stream.publish_time_ns
            epochs = np.array([each.source.epoch_ns for each in truths])
            elapsed_s = (time_ns - epochs[number]) * 1e-9
            rows = np.concatenate(runs)
            judged = (*rows[:, :6].T, *rows[:, 6:].T.astype(np.int64))
            run_number = first_run + number
            found[topic] = SetErrors(*split_topic(topic), run_number, time_ns, elapsed_s, *judged)
    return found


def targets_in(source: Source, components: Sequence[str]) -> list[str]:
    """Return the topics of targets whose truths have exactly these components."""
    return [
        topic
        for topic in topics_of(source.topics, schemas.TRUTH_STATE)
        if sorted(source.topics[topic].metadata.get("components", "").split(",")) == sorted(components)
    ]


def unjudged_sets(sizes: Stream, sources: Sequence[Source]) -> str:
    """Explain why sets cannot be compared with the targets of a run; return "" if they can."""
    reasons = (
        not_comparable(sizes.metadata, targets_in(source, sizes.components), source.topics)
        for source in sources
    )
    return next(filter(None, reasons), "")


def _judge_run(
    sizes: Stream,
    elements: Stream,
    targets: Sequence[str],
    truths: Truths,
    *,
    cutoff_m: float,
    gap_limit_s: float,
) -> Floats:
    """Compute OSPA, GOSPA, its three parts, and the estimated and true number of targets: (n, 7)."""
    place = [name for name in POSITION if name in sizes.components]
    state: Components = dict.fromkeys(place, "linear")
    frame, at_ns = frame_of(sizes.metadata), sizes.publish_time_ns
    states = [
        seen_in(
            frame, truths, topic, reference(truths, topic, state, sizes, gap_limit_s), at_ns, gap_limit_s
        )
        for topic in targets
    ]
    true = np.stack(states, axis=1)
    columns = [sizes.components.index(name) for name in place]
    ends = np.cumsum(sizes["elements"].astype(np.int64))
    rows = np.empty((len(sizes), 7))
    for step, end in enumerate(ends):
        estimated = elements["mean"][end - sizes["elements"][step] : end][:, columns]
        there = true[step][np.isfinite(true[step]).all(axis=1)]
        parts = gospa(estimated, there, cutoff_m, ORDER)
        counts = len(estimated), len(there)
        rows[step] = ospa(estimated, there, cutoff_m, ORDER), *parts, *counts
    return rows


class SetsJudge(KindJudge):
    """Judge of sets of targets, and of regions that should contain one target."""

    def add(self, outputs: Mapping[str, Ragged]) -> list[tuple[str, Any]]:
        """Judge a block; see `KindJudge`."""
        sources, truths, gap_limit_s, first_run = self.runs
        for topic, sizes in outputs.items():
            is_size = sizes.stream.schema.full_name == schemas.ESTIMATE_SIZE.full_name
            is_set = is_size and f"{topic.rpartition('/')[0]}/element" in outputs
            if is_set and topic not in self.unjudged:
                self.unjudged[topic] = unjudged_sets(sizes.stream, sources)
        sets = set_errors(outputs, truths, gap_limit_s=gap_limit_s, first_run=first_run)
        return [*sets.items(), *regions_of(outputs, truths, gap_limit_s).items()]


class AnySets(ABC):  # noqa: B024  # named tuples have no base of their own
    """Base class of results judged by metrics of sets: sets of targets, and regions of one target."""


AnySets.register(SetErrors)
AnySets.register(Regions)


def _sums(found: Any) -> Sums:
    if isinstance(found, Regions):
        held = int((found.holds & found.known).sum())
        area_m2 = float(found.area_m2.sum())
        known = int(found.known.sum())
        return {"regions": len(found.area_m2), "area": area_m2, "known": known, "held": held}
    return {
        "steps": len(found.run),
        "ospa": float(found.ospa.sum()),
        "gospa": float(found.gospa.sum()),
        "localisation": float(found.localisation.sum()),
        "missed": float(found.missed.sum()),
        "false": float(found.false.sum()),
        "excess": int((found.estimated - found.true).sum()),
    }


def _means(sums: Sums) -> dict[str, float]:
    if sums.get("regions"):
        known = sums["known"]
        return {
            "area_mean_m2": sums["area"] / sums["regions"],
            "containment_share": sums["held"] / known if known else np.nan,
        }
    steps = sums.get("steps")
    if not steps:
        return {}
    per_target = CUTOFF_M**ORDER / 2.0
    return {
        "ospa_m": sums["ospa"] / steps,
        "gospa_m": sums["gospa"] / steps,
        "gospa_localisation_m": float(np.sqrt(sums["localisation"] / steps)),
        "missed_targets": sums["missed"] / steps / per_target,
        "false_targets": sums["false"] / steps / per_target,
        "cardinality_error_targets": sums["excess"] / steps,
    }


SETS = metric_of_sums(
    "OSPA and GOSPA of estimated sets, cutoff 10 m; area of regions, and whether they contain the truth",
    AnySets,
    _sums,
    _means,
)
