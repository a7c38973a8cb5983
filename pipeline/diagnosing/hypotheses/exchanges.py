"""Hypotheses that two identifiers in a map, or two topics, are swapped."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.diagnosing.advice import Advice
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis, in_topic, supposed
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.log import Stream
from fuselog.replay.engine.replaying.estimator import Bound
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.errors.evaluation import split_topic

SUSPECT = 2.0  # mean NIS per component above which numbers may be swapped
SUSPECTS = 12  # number of suspects; all pairs of them are tried


def of_numbers(
    bound: Sequence[Bound], source: MemorySource, innovations: Mapping[str, Stream]
) -> Iterator[Hypothesis]:
    """Yield hypotheses that two identifiers in a map, or two topics, are swapped."""
    maps = {
        topic: field.name
        for each in bound
        for topic in each.static
        if topic in source.streams
        for field in source.streams[topic].schema
        if field.kind == "identifier" and topic not in each.priors
    }
    targets = _suspects(
        (int(target), stream.take(stream["target_id"] == target))
        for stream in innovations.values()
        for target in np.unique(stream["target_id"])
    )
    for topic, field in maps.items():
        known = set(source.streams[topic][field].tolist())
        for first, second in combinations(sorted(each for each in targets if each in known), 2):
            without = in_topic(topic, alter.renumbered(field, first, second))
            words = f"{topic}: {field} {first} and {second} are swapped"
            advice = Advice(f"{topic}.exchanged", f"{first},{second}")
            yield supposed("exchanged numbers", topic, f"{first} {second}", without, words, advice)
    of_case = {split_topic(each.name + "/_")[1]: each.streams for each in bound}
    cases = _suspects((split_topic(topic)[1], stream) for topic, stream in innovations.items())
    for one, other in combinations(sorted(each for each in cases if each in of_case), 2):
        for here, there in zip(of_case[one], of_case[other], strict=False):
            if source.topics[here].schema_name == source.topics[there].schema_name:
                words = f"{here} and {there} are swapped"
                advice = Advice(f"{here}.exchanged", there)
                without = _back(here, there)
                yield supposed("exchanged numbers", here, there, without, words, advice)


def _back(first: str, second: str) -> Callable[[Trial, float], Trial]:
    """Make a function that swaps the messages of two topics back in a trial."""
    return lambda trial, _: replace(trial, runs=[alter.exchanged(trial.source, first, second)])


def _suspects(parts: Iterable[tuple[Any, Stream]]) -> list[Any]:
    """Choose the parts with the largest mean NIS, or none if no mean is too large."""
    means: dict[Any, float] = {}
    for name, stream in parts:
        degrees = np.isfinite(stream["innovation"]).sum()
        if degrees:
            nis = np.nansum(stream["normalised_innovation_squared"]) / degrees
            means[name] = max(means.get(name, 0.0), float(nis))
    worst = sorted(means, key=lambda name: -means[name])[:SUSPECTS]
    return worst if worst and means[worst[0]] > SUSPECT else []
