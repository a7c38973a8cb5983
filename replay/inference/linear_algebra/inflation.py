"""Inflation of the covariance of an unlikely innovation, so that outliers are down-weighted."""

import numpy as np

from fuselog.replay.engine.arrays import Settings
from fuselog.replay.inference.linear_algebra.gaussian import Innovation


def inflation(squared: float, size: int, parameters: Settings) -> float:
    """Compute the factor by which the covariance of an innovation is inflated, from its NIS.

    The added covariance is treated as measurement noise, so the update remains a Kalman update. The
    factor is the largest of the factors of all given options, which are described in
    `fuselog.replay.inference.model.parameters.ModelParameters`. Options that are not given are NaN;
    without any option, the factor is 1:

    - `inflate_nis` = b: NIS / b if the NIS exceeds b, which reduces the NIS to b;
    - `student_freedom` = f: (f + NIS) / (f + m), the weight of Student's t-distribution; Roth, Ozkan,
      Gustafsson, ICASSP 2013. The factor is at least 1, so a small innovation does not reduce the noise;
    - `switch_nis` = b: ((b + NIS) / 2 b)^2 if the NIS exceeds b; Agarwal et al., ICRA 2013, (15) with
      s^-2.

    Args:
        squared: the NIS.
        size: number of components of the innovation.
        parameters: parameters with the three options.

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
