"""LCD sets: as good as the sheet's, stationary, and what the moment correction and symmetry do."""

from functools import cache

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling import lcd_distance, lcd_samples, moment_corrected
from fuselog.replay.inference.sampling.distance import lcd_distance_and_gradient
from fuselog.replay.inference.sampling.lcd import check_count

pytestmark = pytest.mark.paper

# N, L, D / pi^(N/2), smallest and largest eigenvalue of the raw covariance: sets of an independent
# implementation of Steinbring and Hanebeck, JAIF 2014, section V
REFERENCE = [
    (2, 5, 1.98423761e-2, 0.8232, 0.8232),
    (2, 10, 5.52653726e-3, 0.9022, 0.9069),
    (2, 12, 4.02779704e-3, 0.9123, 0.9132),
    (2, 20, 1.54941651e-3, 0.9494, 0.9494),
    (2, 50, 2.90670e-4, 0.980, 0.980),
    (4, 25, 6.38297e-3, 0.932, 0.936),
    (8, 25, 2.2989e-2, 0.92, 0.94),
    (8, 50, 8.9922e-3, 0.950, 0.979),
]


@cache
def optimum(dimension, count, **options):
    """Large sets take long, and are as good from one start."""
    starts = 4 if count < 50 else 1
    return lcd_samples(dimension, count, np.random.default_rng(1), starts=starts, **options)


def covariance(points):
    return np.cov(points.T, bias=True).reshape(points.shape[1], -1)


@pytest.mark.parametrize(("dimension", "count", "best", "low", "high"), REFERENCE)
def test_best_of_some_starts_is_as_good_as_the_reference(dimension, count, best, low, high):
    """A wrong gradient or an early stop would leave D above it; a wrong D would move the eigenvalues."""
    points = optimum(dimension, count)
    distance, gradient = lcd_distance_and_gradient(points, np.full(count, 1 / count))
    assert distance <= best * (1.05 if dimension >= 8 else 1.02)
    assert np.abs(gradient).max() < 1e-8
    eigenvalues = np.linalg.eigvalsh(covariance(points))
    assert eigenvalues[[0, -1]] == pytest.approx([low, high], abs=0.008 if dimension >= 8 else 0.001)

    corrected = moment_corrected(points)
    assert np.abs(corrected.mean(axis=0)).max() < 1e-14
    assert covariance(corrected) == pytest.approx(np.eye(dimension), abs=1e-13)


@pytest.mark.parametrize(
    ("dimension", "count", "low", "high"), [(2, 20, 1.0, 1.04), (4, 25, 1.0, 1.04), (8, 50, 1.09, 1.12)]
)
def test_symmetric_sets_mirror_every_sample_at_a_known_cost(dimension, count, low, high):
    """The sheet: at most 4 % in D for N <= 4, 9 to 12 % at (8, 50)."""
    points = optimum(dimension, count, symmetric=True)
    half = count // 2
    assert np.array_equal(points[:half], -points[half : 2 * half])
    assert np.array_equal(points[2 * half :], np.zeros((count % 2, dimension)))
    cost = lcd_distance(points) / lcd_distance(optimum(dimension, count))
    assert low - 1e-6 <= cost <= high


@pytest.mark.parametrize(("dimension", "symmetric"), [(2, False), (3, False), (8, True)])
def test_the_unscented_set_is_among_them(dimension, symmetric):
    """With L = 2N + 1, the corrected set is the equally weighted unscented one, turned."""
    points = moment_corrected(optimum(dimension, 2 * dimension + 1, symmetric=symmetric))
    spread = dimension + 0.5
    arms = points[np.argsort(np.linalg.norm(points, axis=1))][1:]
    products = np.sort(arms @ arms.T, axis=1)
    expected = np.zeros_like(products)
    expected[:, 0], expected[:, -1] = -spread, spread
    assert products == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("dimension", "count"), [(2, 20), (8, 25), (8, 50)])
def test_correction_costs_between_7_and_27_percent(dimension, count):
    """The sheet's range: the raw optimum is closer in D, which is why the correction is told apart."""
    points = optimum(dimension, count)
    assert 1.07 < lcd_distance(moment_corrected(points)) / lcd_distance(points) < 1.27


def test_a_seed_gives_the_same_bytes_and_progress_is_told():
    said = []
    one = lcd_samples(2, 6, np.random.default_rng(3), starts=2, report=said.append)
    assert np.array_equal(one, lcd_samples(2, 6, np.random.default_rng(3), starts=2))
    assert said == [f"6 samples in 2 dimensions: start {start} of 2" for start in (1, 2)]


@pytest.mark.parametrize(
    ("dimension", "count", "symmetric"), [(0, 5, False), (3, 3, False), (3, 5, True)]
)
def test_sets_without_a_regular_covariance_are_refused(dimension, count, symmetric):
    with pytest.raises(BadInput, match="dimension"):
        optimum(dimension, count, symmetric=symmetric)


def test_flat_sets_cannot_be_corrected():
    with pytest.raises(BadInput, match="span fewer than 3 dimensions"):
        moment_corrected(np.random.default_rng(0).standard_normal((9, 3)) * [1, 1, 0])


@pytest.mark.parametrize(
    ("dimension", "least", "symmetric"), [(3, 4, False), (3, 6, True), (1, 2, True)]
)
def test_the_fewest_samples_are_enough(dimension: int, least: int, symmetric: bool) -> None:
    check_count(dimension, least, symmetric)
    with pytest.raises(BadInput, match=f"give {least} or more"):
        check_count(dimension, least - 1, symmetric)
