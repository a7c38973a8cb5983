"""Correlation of a source with motion in windows, beside NumPy's."""

import numpy as np
import pytest

from fuselog.recorders.checks.body import Series
from fuselog.recorders.checks.timing import likenesses
from fuselog.recorders.checks.windows import Windows


@pytest.mark.parametrize(("columns", "is_path"), [(1, False), (1, True), (2, True)])
def test_a_correlation_is_that_of_numpy(columns: int, is_path: bool) -> None:
    """With stamps in bursts; for most lags some windows begin before or end after the source."""
    rng = np.random.default_rng(7)
    times_s = np.cumsum(rng.choice([0.01, 0.5, 3.0], 200, p=[0.6, 0.38, 0.02]))
    values = rng.normal(size=(200, columns) if columns > 1 else 200)
    begin_s = np.sort(rng.uniform(times_s[0], times_s[-1] - 5.0, 80))
    windows = Windows(begin_s, begin_s + rng.uniform(1.0, 5.0, 80), rng.normal(size=80))
    source = Series("/odometry", "forward_mps", times_s, values, holds=True)
    lags_s = np.linspace(-0.7, 0.7, 29) * np.ptp(times_s)
    found = likenesses(windows, lags_s, source, is_path=is_path)
    for lag_s, likeness in zip(lags_s, found, strict=True):
        begin, end = (source.integral(each - lag_s) for each in (windows.begin_s, windows.end_s))
        moves = (end - begin).reshape(80, columns)
        moved = np.sqrt((moves**2).sum(axis=1)) if is_path else moves[:, 0]
        known = np.isfinite(moved)
        if known.sum() < 40:
            assert np.isnan(likeness)
        else:
            expected = np.corrcoef(moved[known], windows.values[known])[0, 1]
            assert likeness == pytest.approx(expected, abs=1e-12)
    assert 5 < np.isfinite(found).sum() < 25
