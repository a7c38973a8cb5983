"""An estimator with runs in memory, for repeated replays with other settings or altered runs."""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.recorders.parameters import merge, nested
from fuselog.replay.engine.replaying.estimator import Bound, Recursive, bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource

MOST_MESSAGES = 300_000  # largest number of messages of the runs that are replayed together


@dataclass(frozen=True, eq=False)
class Trial:
    """An estimator with its settings, and the runs in memory that it replays together.

    Attributes:
        label: the estimator's label.
        runs: the runs; an `Ensemble` caches what its replays have in common.
        settings: the estimator's parameters, with its `kind` if that is not the label.
        stretched: by topic, the logarithm of the factor by which alterations scale the volume of a
            measurement; log-likelihoods are corrected by it, because a density depends on the unit.
    """

    label: str
    runs: Sequence[MemorySource]
    settings: Mapping[str, Any]
    stretched: Mapping[str, float] = field(default_factory=dict)

    @property
    def source(self) -> MemorySource:
        """Return the first run, which is the only one unless runs are replayed together."""
        return self.runs[0]

    def bind(self) -> list[Bound]:
        """Bind the estimator to the runs; raise BadInput as `bind` does."""
        return bind(self.label, self.runs, self.settings)

    def with_settings(self, values: Mapping[str, Any]) -> "Trial":
        """Copy the trial with other values of parameters, by their full names."""
        return replace(self, settings=with_values(self.settings, values))

    def altered(
        self, topic: str, alteration: alter.Alteration, value: float, stretched: float = 0.0
    ) -> "Trial":
        """Copy the trial with an altered topic, and add `stretched` to the topic's log volume."""
        runs = [alter.altered(each, topic, alteration, value) for each in self.runs]
        by_topic = {**self.stretched, topic: self.stretched.get(topic, 0.0) + stretched}
        return replace(self, runs=runs, stretched=by_topic if stretched else self.stretched)

    def outputs(self) -> dict[str, Ragged]:
        """Replay the runs, and return the outputs by topic; raise BadInput as `replay` does."""
        return collect(replay(self.runs, self.bind()))


def alike(bound: Sequence[Bound]) -> Hashable:
    """Return a key that is equal for estimators that can be replayed together; None for all others."""
    keys = [each.alike.key for each in bound if isinstance(each, Recursive) and each.alike]
    return tuple(keys) if len(keys) == len(bound) else None


def together(bounds: Sequence[Bound], count: int) -> Bound:
    """Make one estimator of several that are alike, with the parameters of each for `count` runs."""
    first = bounds[0]
    if all(each is first for each in bounds):
        return first
    found = [each.alike for each in bounds if isinstance(each, Recursive) and each.alike]
    return found[0].together(np.repeat([each.numbers for each in found], count, axis=0))


def in_memory_together(places: Sequence[int], runs: Sequence[MemorySource]) -> Iterator[Sequence[int]]:
    """Divide trials that all replay as many messages as `runs` into groups that fit in memory."""
    messages = sum(len(stream) for run in runs for stream in run.streams.values())
    size = max(1, MOST_MESSAGES // max(messages, 1))
    return (places[first : first + size] for first in range(0, len(places), size))


def with_values(settings: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Copy settings with other values of parameters, by their full names."""
    return reduce(merge, (nested(name, value) for name, value in values.items()), dict(settings))
