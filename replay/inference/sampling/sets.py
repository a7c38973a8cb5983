"""Sample sets for compiled filters: one set for all steps, or a new set for each step.

A randomised sampling uses a separate generator for each run, seeded by the data of the run, so that the
estimates of a run are the same in an ensemble and in a replay of this run alone.
"""

import copy
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from fuselog.replay.engine.arrays import RowSlice
from fuselog.replay.inference.sampling.distance import Array
from fuselog.replay.inference.sampling.samplers import Sampler

Generators = tuple[Generator | None, ...]
DRAWN_AT_ONCE = 1 << 23  # numbers
_UNUSED = np.random.default_rng(0)  # for sets that are not drawn


class SampleSets(NamedTuple):
    """Points (sets, L, N) and weights (sets, L); event number e uses the set (e - first) * stride."""

    points: Array
    weights: Array
    first: int
    stride: int


def sets_by_runs(
    sampler: Sampler, generators: Sequence[Generator | None], offsets: NDArray[np.int64]
) -> Iterator[tuple[RowSlice, SampleSets]]:
    """Yield slices of runs with their sample sets; available memory limits the size of a slice.

    Args:
        sampler: sampler that draws the sets.
        generators: generators of the runs; a randomised sampling needs and advances all of them.
        offsets: (runs + 1,); run r has the events offsets[r]:offsets[r + 1], each of which uses one set.
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
    """Copy the generators of runs; seed missing ones by `seed` and the first data of the run.

    Args:
        generators: generators of the runs.
        data: (n, ...) of all runs; only the first row of each run is used.
        offsets: (runs + 1,) first row of each run.
        seed: seed of the estimator.
        function: index of the sampled function; each of several functions has separate generators.
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
