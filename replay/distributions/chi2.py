"""Computes the chi-squared distribution, by names and with numbers of `scipy.stats.chi2`.

Importing scipy.stats takes a quarter of the time that a short command of the command line does, and
scipy.special half of that, which is why it is imported by what needs it.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from replay.engine.compiling.notices import done_once


def ppf(probability: ArrayLike, degrees: ArrayLike) -> Any:
    """Return what is exceeded with one minus this probability, by that many degrees of freedom.

    Args:
        probability: (...), from 0 to 1.
        degrees: (...), of freedom.

    Returns:
        (...), or one number.
    """
    with done_once():
        from scipy.special import gammaincinv

    return 2.0 * gammaincinv(np.divide(degrees, 2.0), probability)


def isf(probability: ArrayLike, degrees: ArrayLike) -> Any:
    """Return what is exceeded with this probability.

    Args:
        probability: (...), from 0 to 1.
        degrees: (...), of freedom.

    Returns:
        (...), or one number.
    """
    with done_once():
        from scipy.special import chdtri

    return chdtri(degrees, probability)


def sf(value: ArrayLike, degrees: ArrayLike) -> Any:
    """Return the probability with which a value, which is not negative, is exceeded.

    Args:
        value: (...), not negative.
        degrees: (...), of freedom.

    Returns:
        (...), or one number.
    """
    with done_once():
        from scipy.special import chdtrc

    return chdtrc(degrees, value)
