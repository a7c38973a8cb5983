"""Whiteness of innovations, by the reference sheet's numbers."""

import numpy as np
import pytest

from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.judging.consistency.whiteness import whitened, whiteness
from tests.replay.inference.sheet_robot import of_sigmas, recorded


@pytest.mark.parametrize(
    ("sigmas", "told"),
    [
        ((0.1, 0.05, 0.2, 0.03), (1.0502795, -0.0214637183, 34.7139462)),
        ((0.1, 0.05, 0.2, 0.01), (4.91053596, -0.298200276, 86.6600775)),
        ((0.1, 0.05 / 3, 0.2, 0.03), (1.62243815, 0.288252802, 272.59332)),
    ],
)
def test_a_noise_that_is_too_small_colours_innovations(
    sigmas: tuple[float, ...], told: tuple[float, float, float]
) -> None:
    """Negatively that of the measurement, positively that of the process."""
    source = recorded(600, 300.0)
    bound = bind("ekf", [source], {"gate_probability": 1.0, **of_sigmas(*sigmas)})
    innovations = collect(replay([source], bound))["/estimates/ekf/robot/innovation"].stream
    found = whiteness([whitened(innovations)[:, 1]])
    assert (found.mean_square, found.correlation[0], found.ljung_box) == pytest.approx(told, rel=1e-7)
    assert found.size == 600
    assert found.bound == pytest.approx(0.0800, abs=1e-4)
    assert (found.probability > 0.02) == (sigmas == (0.1, 0.05, 0.2, 0.03))


def innovations_of(difference: list[list[float]], covariance: np.ndarray) -> Stream:
    count = len(difference)
    return make_stream(
        "/estimates/test/innovation",
        schemas.INNOVATION,
        range(count),
        target_id=[0] * count,
        accepted=[1] * count,
        innovation=difference,
        covariance=np.tile(covariance.ravel(), (count, 1)),
        normalised_innovation_squared=[0.0] * count,
        log_likelihood=[0.0] * count,
    )


def test_missing_components_are_left_out_of_the_others() -> None:
    covariance = np.array([[4.0, 2.0, 0.0], [2.0, 5.0, 1.0], [0.0, 1.0, 3.0]])
    stream = innovations_of([[1.0, 2.0, 3.0], [np.nan, 2.0, 3.0]], covariance)
    first, second = whitened(stream)
    lower = np.linalg.cholesky(covariance)
    np.testing.assert_allclose(first, np.linalg.solve(lower, [1.0, 2.0, 3.0]), rtol=1e-12)
    assert np.isnan(second[0])
    without = np.linalg.cholesky(covariance[1:, 1:])
    np.testing.assert_allclose(second[1:], np.linalg.solve(without, [2.0, 3.0]), rtol=1e-12)


def test_runs_are_series_of_their_own() -> None:
    """Nothing correlates the end of a run with the beginning of the next."""
    rng = np.random.default_rng(5)
    runs = [rng.standard_normal(40) for _ in range(3)]
    together = np.concatenate(runs)
    mean = together.mean()
    products = sum((run[1:] - mean) @ (run[:-1] - mean) for run in runs)
    told = whiteness(runs)
    assert told.correlation[0] == pytest.approx(products / np.sum((together - mean) ** 2), rel=1e-12)
    assert told.correlation[0] != pytest.approx(whiteness([together]).correlation[0], rel=1e-3)
    assert np.isnan(whiteness([together[:20]]).ljung_box)
