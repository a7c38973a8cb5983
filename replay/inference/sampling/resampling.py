"""Systematic resampling of the same number of particles, each in proportion to its weight.

Kitagawa, Journal of Computational and Graphical Statistics 5(1), 1996.
"""

from fuselog.replay.engine.arrays import Floats, Integers


def choose_systematically(weights: Floats, start: float, chosen: Integers) -> None:
    """Fill `chosen` (N,), in order, with the indices of the particles at the positions (i + start) / N.

    Args:
        weights: (N,), with sum 1; particle k covers the interval of positions from the sum of the
            weights before it (inclusive) to that sum plus its weight.
        start: offset in [0, 1), the same for all positions.
        chosen: (N,), filled with indices of particles.
    """
    count = len(weights)
    last, end = 0, weights[0]
    for i in range(count):
        position = (i + start) / count
        while last < count - 1 and position >= end:  # the last particle covers 1 despite rounding
            last += 1
            end += weights[last]
        chosen[i] = last
