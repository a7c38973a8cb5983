"""Samples of randomised filters, with one random generator per run and one set per event."""

from collections.abc import Iterator, Sequence

from fuselog.replay.engine.arrays import Integers, RowSlice
from fuselog.replay.inference.run.recursion import (
    FilterEvents,
)
from fuselog.replay.inference.sampling.samplers import Sampler
from fuselog.replay.inference.sampling.sets import Generators, SampleSets, seeded_by_data, sets_by_runs


def seeded_generators(
    generators: tuple[Generators, ...], events: FilterEvents, count: int, seed: int
) -> tuple[Generators, ...]:
    """Seed a generator for every sampled function and run from the seed and the run's first data.

    Args:
        generators: generators after the previous block, by function and run; empty for the first block.
        events: events of all runs.
        count: number of sampled functions.
        seed: the parameter `seed`.
    """
    runs = len(events.offsets) - 1
    before = generators or ((None,) * runs,) * count
    return tuple(
        seeded_by_data(each, events.data, events.offsets, seed, function)
        for function, each in enumerate(before)
    )


def sample_sets(
    samplers: Sequence[Sampler], generators: tuple[Generators, ...], offsets: Integers
) -> Iterator[tuple[RowSlice, tuple[SampleSets, ...]]]:
    """Yield slices of runs with their samples; the largest sampled function limits the slice size.

    Args:
        samplers: one sampler for each sampled function.
        generators: random generators by function and run; see `seeded_generators`.
        offsets: (runs + 1,) offsets of the events.
    """
    drawn = [index for index, each in enumerate(samplers) if each.redrawn]
    if not drawn:
        sets = tuple(next(sets_by_runs(each, (), offsets))[1] for each in samplers)
        yield slice(0, len(offsets) - 1), sets
        return
    largest = max(drawn, key=lambda index: samplers[index].count * (samplers[index].dimension + 1))
    for part, most in sets_by_runs(samplers[largest], generators[largest], offsets):
        span = offsets[part.start : part.stop + 1]
        others = (
            most if index == largest else next(sets_by_runs(each, generators[index][part], span))[1]
            for index, each in enumerate(samplers)
        )
        yield part, tuple(others)
