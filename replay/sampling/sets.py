"""Gives sample sets to compiled filters: one that serves every step, or a new one for each.

A randomised sampling draws from a generator of each run's own, which the run's own data seed: so a run
gives the same estimates alone and in an ensemble.
"""

import copy
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from fuselog.replay.engine.arrays import RowSlice
from fuselog.replay.sampling.distance import Array
from fuselog.replay.sampling.samplers import Sampler

Generators = tuple[Generator | None, ...]
DRAWN_AT_ONCE = 1 << 23  # numbers
_UNUSED = np.random.default_rng(0)  # for sets that are not drawn


class SampleSets(NamedTuple):
    """Holds points (sets, L, N), weights (sets, L); use number u takes the set (u - first) * stride."""

    points: Array
    weights: Array
    first: int
    stride: int


def sets_by_runs(
    sampler: Sampler, generators: Sequence[Generator | None], offsets: NDArray[np.int64]
) -> Iterator[tuple[RowSlice, SampleSets]]:
    """Yield the sets of all runs, as many runs at once as memory should hold.

    Args:
        sampler: which draws them.
        generators: of the runs; a randomised sampling needs all of them, and moves them on.
        offsets: (runs + 1,); run r has the uses offsets[r]:offsets[r + 1].
    """
    runs = len(offsets) - 1
    if not sampler.redrawn:
        points, weights = sampler.draw(_UNUSED, (1,))
        yield slice(0, runs), SampleSets(np.array(points), np.array(weights), 0, 0)
        return
    at_once = DRAWN_AT_ONCE // (sampler.count * (sampler.dimension + 1))
    start = 0
    while start < runs:
        fit = int(np.searchsorted(offsets, offsets[start] + at_once, side="right")) - 1
        stop = max(start + 1, min(fit, runs))
        uses = np.diff(offsets[start : stop + 1])
        drawn = [
            sampler.draw(generator, (count,))
            for generator, count in zip(generators[start:stop], uses.tolist(), strict=True)
            if generator is not None
        ]
        points, weights = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        yield slice(start, stop), SampleSets(points, weights, int(offsets[start]), 1)
        start = stop


def seeded_by_data(
    generators: Generators, data: Array, offsets: NDArray[np.int64], seed: int, function: int = 0
) -> Generators:
    """Copy the runs' generators; one that is missing comes from `seed` and the run's first data.

    Args:
        generators: of the runs.
        data: (n, ...), of all runs, of which the first row of each counts.
        offsets: (runs + 1,), where the data of each run begin.
        seed: of the estimator.
        function: of several that are sampled its number, from zero; each has generators of its own.
    """
    words = np.ascontiguousarray(data).view(np.uint32).reshape(len(data), -1)
    return tuple(
        np.random.default_rng(
            [seed, *(words[first].tolist() if first < last else []), *([function] if function else [])]
        )
        if generator is None
        else copy.deepcopy(generator)
        for generator, first, last in zip(generators, offsets[:-1], offsets[1:], strict=True)
    )
