"""Noise that is added to a motion's controls, to measure how noise affects the likelihood.

A measured control has noise (errors in variables). If a parameter shifts the stamps by part of a step,
the noise is averaged over two messages; a scale factor below one attenuates it. Both effects increase
the log-likelihood even if the log has no fault. Added noise of the same size reduces the log-likelihood
as much as the existing noise does, and less if the added noise is averaged or attenuated. The corrected
log-likelihood is therefore L(u) - c, where c is the mean of L(u + n) and L(u - n) minus L(u); the noise
then affects all alternatives equally. Nakamura, Corrected score function for errors-in-variables models,
Biometrika 77, 1990; Cook and Stefanski, Simulation-extrapolation estimation, JASA 89, 1994.

An error of the mean over a few copies shifts the estimates of all logs of the same length in the same
way. The signs of the noise are therefore those of a Hadamard matrix. Over all copies, the products of
the signs of nearby messages cancel, and only messages that are further apart than the number of pairs
contribute an error. Bekas, Kokiopoulou and Saad, An estimator for the diagonal of a matrix, Applied
Numerical Mathematics 57, 2007.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.entries import entries_of
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.sources import MemorySource

PAIRS = 8  # number of pairs of copies with opposite noise; a power of two
SEED = 62
FEWEST = 20  # fewest messages from which noise can be estimated
MAD = 1.4826  # standard deviation of a normal distribution divided by its median absolute deviation


class _Noise(NamedTuple):
    """The noise of one measured component of a control."""

    topic: str
    field: str
    place: int | None
    sigma: float


def disturbed(
    source: MemorySource, bound: Sequence[Bound], log: int = 0, pairs: int = PAIRS
) -> list[MemorySource]:
    """Copy a log with noise added to its controls; each copy is followed by one with the opposite noise.

    The noise is as large as the model states, but at most as large as the noise seen in the control.
    There are no copies if the model states no noise or no noise is visible. Each of several logs has its
    own noise, selected by the number `log`. `pairs` is a power of two.
    """
    from scipy.linalg import hadamard  # slow to import

    noises = [noise for each in bound for noise in _noises(source, each)]
    rng = np.random.default_rng([SEED, log])
    copies = [source] * (2 * pairs if noises else 0)
    for each in noises:
        count = len(source.streams[each.topic])
        signs = hadamard(pairs)[:, np.arange(count) % pairs] * rng.choice([-1.0, 1.0], count)
        for number, copy in enumerate(copies):
            pair, is_opposite = divmod(number, 2)
            noise = (-1.0 if is_opposite else 1.0) * each.sigma * signs[pair]
            noisy = alter.added(each.field, each.place, copy.streams[each.topic], noise)
            copies[number] = replace(copy, streams={**copy.streams, each.topic: noisy})
    return copies


def _noises(source: MemorySource, bound: Bound) -> Iterator[_Noise]:
    """Yield the noises of an estimator's controls."""
    if not isinstance(bound, Recursive) or bound.reading is None:
        return
    reading = bound.reading()
    for topic in dict.fromkeys(topic for topic, _ in reading.control_noise(1.0)):
        stream = source.streams[topic]
        if len(stream) < FEWEST:
            continue
        step_s = 1e-9 * float(np.median(np.diff(stream.publish_time_ns)))
        stated = reading.control_noise(step_s) if step_s > 0.0 else {}
        for entry in entries_of(stream, reading):
            column = stream[entry.field] if entry.place is None else stream[entry.field][:, entry.place]
            variance = stated.get((topic, -1 if entry.number is None else entry.number), 0.0)
            sigma = min(variance**0.5, _seen(column))
            if sigma > 0.0:
                yield _Noise(topic, entry.field, entry.place, sigma)


def _seen(values: Floats) -> float:
    """Estimate the standard deviation of noise in values (n,) from their second differences."""
    bends = np.abs(np.diff(values, 2))
    return MAD * float(np.nanmedian(bends)) / 6.0**0.5 if np.isfinite(bends).any() else 0.0
