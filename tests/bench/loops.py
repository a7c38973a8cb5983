"""The compiled loops of filters that are made of models, taken out of the replay around them."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.replaying.estimator import Bound
from fuselog.replay.engine.replaying.replaying import replay
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.inference.run import filtering
from fuselog.replay.inference.run.recursion import EstimateRows, InnovationRows, RunResults, filled

Floats = NDArray[np.float64]


class Call(NamedTuple):
    """One call of a loop, its arguments as they were before it."""

    loop: Callable[..., None]
    runs: int
    before: tuple[Any, ...]
    results: tuple[EstimateRows, InnovationRows]
    scratch: Callable[[], Any]

    def __call__(self) -> Floats:
        """Do it again, into new arrays; returns the means of all runs end to end."""
        *columns, carried = self.before
        estimates, innovations = (
            type(each)(each.end.copy(), *(np.empty_like(column) for column in each[1:]))
            for each in self.results
        )
        arguments = (*columns, copy.deepcopy(carried), *handed_over(estimates, innovations))
        self.loop(self.runs, *arguments, scratch=self.scratch)
        return filled(estimates, np.append(self.results[0].end, len(estimates.mean)))[0].mean


def handed_over(estimates: EstimateRows, innovations: InnovationRows) -> tuple[Any, ...]:
    """What a loop fills, as it takes it."""
    return (RunResults(estimates, innovations),)


def calls_of(bound: Sequence[Bound], sources: Sequence[Source]) -> list[Call]:
    """The calls that a replay makes of the loops; none where no filter is made of a model."""
    calls: list[Call] = []
    compiled = filtering._compiled

    def recording(*key: Any) -> Any:
        loop, steps = compiled(*key)

        def record(runs: int, *arguments: Any, scratch: Callable[[], Any]) -> None:
            *before, (estimates, innovations) = arguments
            kept = copy.deepcopy((estimates.end, innovations.end, before[-1]))
            results = (estimates._replace(end=kept[0]), innovations._replace(end=kept[1]))
            calls.append(Call(loop, runs, (*before[:-1], kept[2]), results, scratch))
            loop(runs, *arguments, scratch=scratch)

        return record, steps

    with patch.object(filtering, "_compiled", recording):
        for _ in replay(sources, bound, block_messages=1 << 40):
            pass
    return calls
