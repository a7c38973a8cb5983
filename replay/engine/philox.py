"""Random numbers inside kernels by the generator Philox, with a counter and a key for each run.

A kernel that creates no arrays cannot use a NumPy generator; the state of Philox is a few words per run.
This generator produces the same words as `numpy.random.Philox`. Salmon, Moraes, Dror, Shaw, "Parallel
random numbers: as easy as 1, 2, 3", SC 2011: Philox4x64-10. Normals: Marsaglia and Tsang, "The ziggurat
method for generating random variables", Journal of Statistical Software 5(8), 2000; Doornik 2005.
"""

from collections.abc import Iterable
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.kernels.words import high_word
from fuselog.replay.engine.arrays import AnyArray, Floats

Words = NDArray[np.uint64]

WORDS = 4  # per block
_ROUNDS = 10
_MULTIPLIERS = 0xD2E7470EE14C6C93, 0xCA5A826395121157
_WEYL = 0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B
_UNIT = 2.0**-53
_LAYERS, _TAIL = 256, 3.6541528853610088  # number of layers of the ziggurat, and where its tail begins
# erfc(_TAIL / sqrt 2); computing it would need scipy.special, which is slow to import.
_BEYOND = 0.00025803248765390125


def run_key(seed: int, first: Iterable[AnyArray]) -> Words:
    """Compute the key (2,) of a run from a seed and the run's first data.

    The run's random numbers therefore depend neither on the number of cores nor on the other runs.

    Args:
        seed: the estimator's parameter `seed`.
        first: arrays of the run's first data.
    """
    words = [str(seed).encode(), *(part.tobytes() for part in first)]
    return np.frombuffer(sha256(b" ".join(words)).digest()[:16], np.uint64)


def philox(counter: int, key: Words) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Compute the block of four words at a counter.

    Args:
        counter: number of the block.
        key: (2,) key of the run.
    """
    a, b, c, d = np.uint64(counter), np.uint64(0), np.uint64(0), np.uint64(0)
    k0, k1 = key[0], key[1]
    m0, m1 = np.uint64(_MULTIPLIERS[0]), np.uint64(_MULTIPLIERS[1])
    for _ in range(_ROUNDS):
        high_a, high_c = high_word(m0, a), high_word(m1, c)
        a, b, c, d = high_c ^ b ^ k0, m1 * c, high_a ^ d ^ k1, m0 * a
        k0, k1 = k0 + np.uint64(_WEYL[0]), k1 + np.uint64(_WEYL[1])
    return a, b, c, d


def unit(word: np.uint64) -> float:
    """Map a word to the midpoint of one of 2^53 intervals of (0, 1); the result is never 0 or 1."""
    return (float(word >> np.uint64(11)) + 0.5) * _UNIT


def _ziggurat() -> tuple[Floats, Floats, Floats]:
    """Compute layers of equal area under exp(-x^2 / 2): right ends (layers + 1,), heights, inner shares.

    The lowest layer, number 0, includes the tail; its right end is where a rectangle with the layer's
    area would end. The inner share of a layer is the part of its width that is entirely below the curve.
    """
    area = _TAIL * np.exp(-0.5 * _TAIL**2) + np.sqrt(0.5 * np.pi) * _BEYOND
    ends = np.zeros(_LAYERS + 1)
    ends[0], ends[1] = area / np.exp(-0.5 * _TAIL**2), _TAIL
    for layer in range(2, _LAYERS):
        height = np.exp(-0.5 * ends[layer - 1] ** 2) + area / ends[layer - 1]
        ends[layer] = np.sqrt(-2.0 * np.log(height))
    heights, shares = np.exp(-0.5 * ends**2), ends[1:] / ends[:-1]
    for table in (ends, heights, shares):
        table.flags.writeable = False
    return ends, heights, shares


_ENDS, _HEIGHTS, _SHARES = _ziggurat()


def fill_normals(numbers: Floats, words: Words, key: Words, counter: int) -> int:
    """Fill an array with draws from N(0, 1).

    The blocks after number `counter` provide one word per draw. About one draw in 67 needs more than one
    word and uses further blocks.

    Args:
        numbers: (n,), overwritten; n is a multiple of four.
        words: (n,), work space.
        key: (2,), see `run_key`.
        counter: number of the last block that was used before the call.

    Returns:
        The number of the last block that was used.
    """
    blocks = len(words) // WORDS
    for block in range(blocks):
        at = WORDS * block
        a, b, c, d = philox(counter + block + 1, key)
        words[at], words[at + 1], words[at + 2], words[at + 3] = a, b, c, d
    counter += blocks
    for at in range(len(words)):
        layer, share, sign = layer_of(words[at])
        if share < _SHARES[layer]:
            numbers[at] = sign * share * _ENDS[layer]
        else:
            numbers[at], counter = settled(layer, share, sign, key, counter)
    return counter


def layer_of(word: np.uint64) -> tuple[int, float, float]:
    """Extract a layer of the ziggurat, a relative position within it, and a sign from a word."""
    layer = int(word & np.uint64(_LAYERS - 1))
    return layer, unit(word), 1.0 if word & np.uint64(_LAYERS) else -1.0


def settled(layer: int, share: float, sign: float, key: Words, counter: int) -> tuple[float, int]:
    """Draw from the outer part of a layer by rejection sampling, and return the new counter."""
    while True:
        counter += 1
        a, b, c, _ = philox(counter, key)
        x = share * _ENDS[layer]
        if share < _SHARES[layer]:
            return sign * x, counter
        if layer == 0:  # the tail; Marsaglia, Technometrics 6(1), 1964
            beyond = -np.log(unit(a)) / _TAIL
            if -2.0 * np.log(unit(b)) > beyond * beyond:
                return sign * (_TAIL + beyond), counter
        elif _HEIGHTS[layer] + unit(a) * (_HEIGHTS[layer + 1] - _HEIGHTS[layer]) < np.exp(-0.5 * x * x):
            return sign * x, counter
        layer, share, sign = layer_of(c)
