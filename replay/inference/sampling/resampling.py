"""Resamples systematically: as many particles as before, each as often as its weight says.

Kitagawa, Journal of Computational and Graphical Statistics 5(1), 1996.
"""

from fuselog.replay.engine.arrays import Floats, Integers


def choose_systematically(weights: Floats, start: float, chosen: Integers) -> None:
    """Fill `chosen` (N,), in order, with the particles that lie at the positions (i + start) / N.

    Args:
        weights: (N,) of sum 1; particle k lies from the sum of those before it, included, to that with
            its own.
        start: from [0, 1), one for all.
        chosen: the particles by number.
    """
    count = len(weights)
    last, end = 0, weights[0]
    for i in range(count):
        position = (i + start) / count
        while last < count - 1 and position >= end:  # the last one ends at 1, whatever round-off says
            last += 1
            end += weights[last]
        chosen[i] = last
