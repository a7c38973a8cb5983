"""Adds noise to what drives a motion, to find what that noise gains by itself.

A control that is measured has noise (errors in variables). Stamps that are shifted by a part of a step
average it over two messages, and a factor below one attenuates it: both gain log-likelihood in a log
with nothing wrong. Noise of the same size that is added costs as much as the noise that is there
already, and less where it is averaged or attenuated. So the corrected log-likelihood is L(u) - c, where
c is the mean of L(u + n) and L(u - n) less L(u): the noise then enters all alternatives alike. Nakamura,
Corrected score function for errors-in-variables models, Biometrika 77, 1990; Cook and Stefanski,
Simulation-extrapolation estimation, JASA 89, 1994.

An error of the mean over few copies moves the estimates of all logs of one length in the same way. So
the signs of the noise are those of a Hadamard matrix: over all copies the products of nearby messages
cancel, and only messages that are further apart than there are pairs leave an error. Bekas, Kokiopoulou
and Saad, An estimator for the diagonal of a matrix, Applied Numerical Mathematics 57, 2007.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.entries import entries_of
from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.sources import MemorySource

Floats = NDArray[np.float64]
PAIRS = 8  # of copies with opposite noise; a power of two
SEED = 62
FEWEST = 20  # messages that tell noise
MAD = 1.4826  # of a normal distribution: its standard deviation by its median absolute value


class _Noise(NamedTuple):
    """Describes the noise of one number of a control."""

    topic: str
    field: str
    place: int | None
    sigma: float


def disturbed(
    source: MemorySource, bound: Sequence[Bound], log: int = 0, pairs: int = PAIRS
) -> list[MemorySource]:
    """Return copies of a log with noise added to its controls: each with its opposite after it.

    The noise is as large as the model states, but no larger than what is seen in the control. There are
    no copies if a model states none, or none is seen. Of several logs each has noise of its own, by its
    number `log`. `pairs` is a power of two.
    """
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
    """Yield the noise of the numbers that drive an estimator."""
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
    """Compute the standard deviation of noise in values (n,), by their second differences."""
    bends = np.abs(np.diff(values, 2))
    return MAD * float(np.nanmedian(bends)) / 6.0**0.5 if np.isfinite(bends).any() else 0.0
