"""Tests whether innovations are white: uncorrelated in time and, if normalised, of mean square one.

If the stated measurement noise is too small, successive innovations are negatively correlated; if the
process noise is too small, they are positively correlated: Mehra, "On the identification of variances
and adaptive Kalman filtering", IEEE TAC 1970. Ljung and Box, "On a measure of lack of fit in time series
models", Biometrika 1978.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream
from fuselog.replay.engine import chi2

Floats = NDArray[np.float64]
LAGS = 20


class Whiteness(NamedTuple):
    """Statistics of a series of normalised innovations.

    Attributes:
        size: number of innovations.
        mean_square: mean square, which is one if the covariances are correct; the mean is not removed.
        correlation: (lags,) the autocorrelation at lags 1, 2, ...; the mean is removed.
        ljung_box: Q = n (n + 2) sum correlation^2 / (n - lag), chi-square with one degree of freedom
            per lag.
        probability: probability that a white series has a larger Q.
    """

    size: int
    mean_square: float
    correlation: Floats
    ljung_box: float
    probability: float

    @property
    def bound(self) -> float:
        """Return the 95 % bound of the absolute autocorrelation of a white series."""
        return float(1.96 / np.sqrt(self.size))


def whitened(innovations: Stream) -> Floats:
    """Compute the normalised innovations e = L^-1 v (n, m) of a stream of innovations, with S = L L'.

    Each component is made independent of the components before it. A missing component is NaN and does
    not affect the other components; a row with an invalid covariance is NaN.
    """
    difference = innovations["innovation"]
    n, m = difference.shape
    covariance = innovations["covariance"].reshape(n, m, m)
    missing = np.isnan(difference)
    apart = missing[:, :, None] | missing[:, None, :]
    covariance = np.where(apart, np.eye(m), covariance)
    with np.errstate(invalid="ignore"):
        lower = np.zeros((n, m, m))
        errors = np.where(missing, 0.0, difference)
        for i in range(m):
            for j in range(i + 1):
                entry = covariance[:, i, j] - np.sum(lower[:, i, :j] * lower[:, j, :j], axis=1)
                lower[:, i, j] = np.sqrt(entry) if i == j else entry / lower[:, j, j]
            known = np.sum(lower[:, i, :i] * errors[:, :i], axis=1)
            errors[:, i] = (errors[:, i] - known) / lower[:, i, i]
    return np.where(missing, np.nan, errors)


def whiteness(series: Sequence[Floats], lags: int = LAGS) -> Whiteness:
    """Compute the whiteness of normalised innovations of one component.

    With fewer than `lags` + 2 innovations, all statistics except their number are NaN.

    Args:
        series: one array (n,) per run; values that are not finite are left out.
        lags: the largest lag of the autocorrelation.
    """
    known = [each[np.isfinite(each)] for each in series]
    count = sum(map(len, known))
    if count < lags + 2:
        return Whiteness(count, np.nan, np.full(lags, np.nan), np.nan, np.nan)
    mean = sum(float(each.sum()) for each in known) / count
    centred = [each - mean for each in known]
    variance = sum(float(each @ each) for each in centred)
    products = [
        sum(float(each[lag:] @ each[:-lag]) for each in centred if len(each) > lag)
        for lag in range(1, lags + 1)
    ]
    correlation = np.array(products) / variance
    squares = correlation**2 / (count - np.arange(1, lags + 1))
    ljung_box = float(count * (count + 2) * squares.sum())
    mean_square = sum(float(each @ each) for each in known) / count
    return Whiteness(count, mean_square, correlation, ljung_box, float(chi2.sf(ljung_box, lags)))
