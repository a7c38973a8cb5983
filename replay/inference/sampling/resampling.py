"""Systematic resampling to the same number of particles, chosen in proportion to their weights.

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
    count, begin, end = len(weights), 0, 0.0
    chosen[:] = 0
    for k in range(count):
        if begin < count:
            chosen[begin] = k  # replaced by the next particle if this one is not drawn
        end += weights[k]
        begin = min(int(end * count - start) + 1, count)  # first position beyond, except for rounding
        while begin < count and (begin + start) / count < end:
            begin += 1
        while begin > 0 and (begin - 1 + start) / count >= end:
            begin -= 1
    last = 0
    for i in range(count):  # the last particle covers 1 despite rounding
        last = max(last, chosen[i])
        chosen[i] = last
