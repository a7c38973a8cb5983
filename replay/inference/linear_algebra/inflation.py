"""Takes the covariance of a surprising innovation for larger, so that outliers count for less."""

import numpy as np

from fuselog.replay.engine.arrays import Settings
from fuselog.replay.inference.linear_algebra.gaussian import Innovation


def inflation(squared: float, size: int, parameters: Settings) -> float:
    """Compute how many times larger the covariance of an innovation counts, from its NIS and size.

    To S is added what makes it that much larger, as if to the measurement's noise, so that the update is
    a Kalman update still. 1 where no option of
    `fuselog.replay.inference.model.parameters.ModelParameters` is
    given: those are NaN then. The largest of those given holds:

    - `inflate_nis` = b: NIS / b above b, so that the NIS becomes b;
    - `student_freedom` = f: (f + NIS) / (f + m), the weight of Student's distribution; Roth, Ozkan,
      Gustafsson, ICASSP 2013. No less than 1: a small innovation makes no noise smaller;
    - `switch_nis` = b: ((b + NIS) / 2 b)^2 above b; Agarwal et al., ICRA 2013, (15) with s^-2.

    Args:
        squared: the NIS.
        size: how many components the innovation has.
        parameters: with the three options.

    >>> from types import SimpleNamespace
    >>> given = dict(inflate_nis=9.0, student_freedom=np.nan, switch_nis=np.nan)
    >>> inflation(36.0, 1, SimpleNamespace(**given)), inflation(8.0, 1, SimpleNamespace(**given))
    (4.0, 1.0)
    """
    factor = 1.0
    if squared > parameters.inflate_nis:
        factor = squared / parameters.inflate_nis
    if parameters.student_freedom > 0.0:
        freedom = parameters.student_freedom
        factor = max(factor, (freedom + squared) / (freedom + size))
    if squared > parameters.switch_nis:
        half = 0.5 * (1.0 + squared / parameters.switch_nis)
        factor = max(factor, half * half)
    return factor


def inflate(innovation: Innovation, size: int, factor: float) -> None:
    """Multiply the covariance of a whitened innovation of `size` components by a factor, in place."""
    root = np.sqrt(factor)
    for i in range(size):
        innovation.difference[i] /= root
        for k in range(i + 1):
            innovation.covariance[i, k] *= root
