"""Real angles: what is predicted is known beforehand, and how sure a mean is."""

import numpy as np
import pytest

from fuselog.pipeline.families.directional.torus_real import FILTERS, interval, persistence, predict


def test_no_prediction_knows_what_comes():
    """An hour changes what is said of the later ones alone."""
    generator = np.random.default_rng(0)
    wind = np.cumsum(0.3 * generator.standard_normal(40)) % (2.0 * np.pi)
    other = wind.copy()
    other[20] += 1.0
    parameters = {"coupling_rad": 0.2, "system_sigma_rad": 0.3, "measurement_sigma_rad": 0.2}
    for run in FILTERS.values():
        first, second = (predict(each, run, parameters) for each in (wind, other))
        assert np.array_equal(first.log_density[:19], second.log_density[:19])
        assert not np.isclose(first.log_density[19], second.log_density[19])
        assert not np.isclose(first.error_rad[20], second.error_rad[20])
    said = [persistence(each, 15)["persistence"] for each in (wind, other)]
    assert np.array_equal(said[0].log_density[:19], said[1].log_density[:19])


def test_interval_of_blocks():
    """Five blocks of means 0, 1, 2, 3, 4; what is left over does not count."""
    found = interval(np.repeat([0.0, 1.0, 2.0, 3.0, 4.0, 99.0], [5, 5, 5, 5, 5, 3]), 5)
    half = 2.7764451051977934 * np.std([0, 1, 2, 3, 4], ddof=1) / np.sqrt(5)
    assert found[:3] == pytest.approx((2.0, 2.0 - half, 2.0 + half))
