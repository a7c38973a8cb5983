"""Metrics: the registered ones on errors whose numbers are known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from recorders.errors import BadInput
from recorders.log import make_stream, schemas
from replay.engine.blocks import Ragged
from replay.judging.evaluation import Errors, Innovations, chi_square_interval, rmse_interval
from replay.judging.metrics import (
    Metric,
    Output,
    accuracy,
    consistency_bounds,
    failures,
    find_metrics,
    innovation,
    likelihood,
    measure,
)


def make_errors(error: np.ndarray, components: tuple[str, ...]) -> Errors:
    rows, size = error.shape
    numbers = np.arange(rows)
    return Errors(
        estimator="e",
        case="a",
        components=components,
        kinds=("linear",) * size,
        run=numbers * 0,
        step=numbers,
        time_ns=numbers,
        elapsed_s=numbers.astype(float),
        error=error,
        covariance=np.tile(np.eye(size), (rows, 1, 1)),
        nees=np.sum(error**2, axis=1),
        without_truth=2,
    )


def test_nees_and_nis_have_the_bounds_of_what_is_independent() -> None:
    """NEES those of the mean over the runs, NIS those of all innovations; values of a table."""
    errors = make_errors(np.ones((4, 3)), ("x_m", "y_m", "heading_rad"))
    two_runs = replace(errors, run=np.array([0, 0, 1, 1]), step=np.array([0, 1, 0, 1]))
    numbers = np.arange(5)
    degrees = np.full(5, 2)
    innovations = Innovations("e", "", numbers, numbers, numbers == 0, numbers * 1.0, degrees)
    bounds = consistency_bounds([two_runs, innovations])
    assert bounds == {
        "e.nees.a": pytest.approx((1.237344 / 2, 14.449375 / 2), rel=1e-6),  # of 6 degrees
        "e.position_nees.a": pytest.approx((0.484419 / 2, 11.143287 / 2), rel=1e-5),  # of 4
        "e.nis_per_component": pytest.approx((3.246973 / 10, 20.483177 / 10), rel=1e-6),  # of 10
    }


def test_rmse_lies_in_its_interval_as_often_as_it_says() -> None:
    """Exactly so where the variances are equal; nearly where one is nine times the other."""
    runs = 4000
    errors = make_errors(np.zeros((2 * runs, 2)), ("x_m", "y_m"))
    errors = replace(errors, run=np.arange(2 * runs) % runs, step=np.arange(2 * runs) // runs)
    low, high = rmse_interval(errors, [0, 1])
    assert_allclose(low**2, chi_square_interval(2, runs)[0])
    assert_allclose(high**2, chi_square_interval(2, runs)[1])
    covariance = np.array([[5.0, 4.0], [4.0, 5.0]])
    samples = np.random.default_rng(1).multivariate_normal([0, 0], covariance, (2000, 5))
    five = make_errors(np.zeros((5, 2)), ("x_m", "y_m"))
    five = replace(
        five, run=np.arange(5), step=np.zeros(5, int), covariance=np.tile(covariance, (5, 1, 1))
    )
    [low], [high] = rmse_interval(five, [0, 1])
    rmse = np.sqrt(np.mean(np.sum(samples**2, axis=2), axis=1))
    assert np.mean((low < rmse) & (rmse < high)) == pytest.approx(0.95, abs=0.01)


def test_registered_metrics_by_name() -> None:
    assert set(find_metrics()) >= {"accuracy", "consistency", "failures", "innovation"}
    assert list(find_metrics(["accuracy"])) == ["accuracy"]
    with pytest.raises(BadInput, match="did you mean 'accuracy'"):
        find_metrics(["acuracy"])


def test_accuracy_is_the_length_of_the_position_error_and_each_other_component() -> None:
    """3, 4, 5 triangles; units go to the end of the name."""
    error = np.array([[3.0, 4.0, 0.1], [0.0, 0.0, -0.1]])
    assert accuracy(make_errors(error, ("x_m", "y_m", "heading_rad"))) == pytest.approx(
        {"position_rmse_m": np.sqrt(12.5), "heading_rmse_rad": 0.1, "estimates_without_truth": 2}
    )
    assert accuracy(make_errors(np.empty((0, 1)), ("x_m",))) == {"estimates_without_truth": 2}


def test_metrics_get_what_they_judge_and_keys_name_estimator_quantity_and_case() -> None:
    judged = make_errors(np.array([[1.0], [3.0]]), ("depth_m",))
    metric = Metric("largest error", Errors, lambda errors: {"worst_m": errors.error.max()})
    other = Metric("of innovations", Innovations, lambda _: {"never": 1.0})
    assert measure([judged], {"worst": metric, "other": other}) == {"e.worst_m.a": 3.0}
    values = measure([judged], find_metrics(["consistency"]))
    assert values["e.nees.a"] == 5.0
    with pytest.raises(BadInput, match="metric bad raised IndexError"):
        measure([judged], {"bad": Metric("", Errors, lambda errors: {"x": errors.error[9, 9]})})


def test_innovations_count_per_measured_component() -> None:
    """Two components of squared 2 and one of squared 3, one of them gated."""
    three = np.zeros(2, np.int64)
    seen = Innovations(
        "e", "", three, three, np.array([True, False]), np.array([4.0, 2.0]), np.array([2, 1])
    )
    assert innovation(seen) == {"nis_per_component": 2.0, "gated_share": 0.5}


def test_the_log_likelihood_is_the_mean_over_the_runs_of_what_was_let_in() -> None:
    """Nothing where one is not stated, as by an estimator that knows none or in an older log."""
    runs = np.array([0, 0, 2])
    accepted = np.array([True, False, True])
    told = Innovations("e", "", runs, runs, accepted, np.ones(3), runs, np.array([-1.0, 0.0, -4.0]))
    assert likelihood(told) == {"log_likelihood": -2.5}
    assert likelihood(told._replace(log_likelihood=np.array([-1.0, 0.0, np.nan]))) == {}
    assert likelihood(told._replace(log_likelihood=None)) == {}
    assert likelihood(told._replace(log_likelihood=np.array([-1.0, np.nan, -4.0]))) != {}


def test_failed_runs_are_counted_once() -> None:
    stream = make_stream("/estimates/e/a/failure", schemas.FAILURE, [1, 2], reason=[0, 0])
    output = Output("e", "a", "failure", Ragged(stream, np.array([0, 0, 2, 2])), [])
    assert failures(output) == {"failed_runs": 1.0}
