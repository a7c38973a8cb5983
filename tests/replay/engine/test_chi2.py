"""The chi-squared distribution is that of SciPy, in both tails, for few degrees and many."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2 as reference

from fuselog.replay.engine import chi2

DEGREES = np.array([0.5, 1, 2, 3, 4.37, 9, 30, 100, 999, 17492, 1e6])[:, None]


@pytest.mark.parametrize("uncompiled", ["", "1"])
def test_quantiles_and_tails_are_those_of_scipy(uncompiled, monkeypatch):
    monkeypatch.setenv("FUSELOG_UNCOMPILED", uncompiled)
    shares = np.array([1e-4, 0.025, 0.1, 0.5, 0.683, 0.975, 0.999, 1 - 1e-9])
    values = reference.ppf(shares, DEGREES)
    assert_allclose(chi2.ppf(shares, DEGREES), values, rtol=1e-10)
    assert_allclose(chi2.isf(shares, DEGREES), reference.isf(shares, DEGREES), rtol=1e-10)
    assert_allclose(chi2.sf(values, DEGREES), reference.sf(values, DEGREES), rtol=1e-9)
    small = np.array([1e-12, 1e-40, 1e-200])
    assert_allclose(chi2.isf(small, DEGREES[:-2]), reference.isf(small, DEGREES[:-2]), rtol=1e-10)


def test_ends_and_what_is_no_number_are_those_of_scipy():
    nan, inf = np.nan, np.inf
    assert_array_equal(chi2.ppf([0, 1, nan, 0.5, 0.5], [1, 1, 1, 0, nan]), [0, inf, nan, nan, nan])
    assert_array_equal(chi2.isf([1, 0, 0.5], [2, 2, -1]), [0, inf, nan])
    assert_array_equal(chi2.sf([0, inf, 1e300, nan, 1], [3, 3, 3, 3, 0]), [1, 0, 0, nan, nan])
    assert chi2.ppf(0.5, np.arange(0)).shape == (0,)
    assert isinstance(chi2.ppf(0.95, 2), float)
