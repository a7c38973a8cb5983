"""Metrics: the registered ones on errors whose numbers are known."""

from dataclasses import replace

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.judging.errors.evaluation import (
    Errors,
    Innovations,
    chi_square_interval,
    rmse_interval,
)
from fuselog.replay.judging.metrics.measuring import Output, find_metrics, measure, metric_of_sums
from fuselog.replay.judging.metrics.metrics import (
    ACCURACY,
    CONSISTENCY,
    FAILURES,
    INNOVATION,
    LIKELIHOOD,
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


def test_rmse_lies_in_its_interval_as_often_as_it_says() -> None:
    """Exactly so where the variances are equal; nearly where one is nine times the other."""
    [low], [high] = rmse_interval(np.array([4.0]), np.array([2.0]), np.array([2.0]))
    assert (low**2, high**2) == pytest.approx(chi_square_interval(2, 4), rel=1e-12)
    covariance = np.array([[5.0, 4.0], [4.0, 5.0]])
    moments = np.trace(covariance), np.trace(covariance @ covariance)
    [low], [high] = rmse_interval(np.array([5.0]), *np.reshape(moments, (2, 1)))
    samples = np.random.default_rng(1).multivariate_normal([0, 0], covariance, (2000, 5))
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
    assert ACCURACY.of(make_errors(error, ("x_m", "y_m", "heading_rad"))) == pytest.approx(
        {"position_rmse_m": np.sqrt(12.5), "heading_rmse_rad": 0.1, "estimates_without_truth": 2}
    )
    assert ACCURACY.of(make_errors(np.empty((0, 1)), ("x_m",))) == {"estimates_without_truth": 2}


def test_metrics_get_what_they_judge_and_keys_name_estimator_quantity_and_case() -> None:
    judged = make_errors(np.array([[1.0], [3.0]]), ("depth_m",))
    metric = metric_of_sums("sum of errors", Errors, lambda errors: {"sum_m": errors.error.sum()}, dict)
    other = metric_of_sums("of innovations", Innovations, lambda _: {"never": 1.0}, dict)
    assert measure([judged], {"sum": metric, "other": other}) == {"e.sum_m.a": 4.0}
    values = measure([judged], find_metrics(["consistency"]))
    assert values["e.nees.a"] == 5.0
    bad = metric_of_sums("", Errors, lambda errors: {"x": errors.error[9, 9]}, dict)
    with pytest.raises(BadInput, match="metric bad raised IndexError"):
        measure([judged], {"bad": bad})


def test_consistency_is_of_state_and_position_where_there_is_a_nees() -> None:
    """One covariance of four is singular, and one too small for its error."""
    squared = np.array([1.0, 9.0, 0.1, 81.0])  # of each component; a NEES of .3 is in bounds for three
    errors = make_errors(np.sqrt(np.tile(squared, (3, 1)).T), ("x_m", "y_m", "heading_rad"))
    errors = replace(errors, nees=np.append(errors.nees[:3], np.nan))
    errors.covariance[3] = 0.0
    assert CONSISTENCY.of(errors) == pytest.approx(
        {
            "nees": (3.0 + 27.0 + 0.3) / 3,
            "estimates_without_nees": 1.0,
            "position_nees": (2.0 + 18.0 + 0.2) / 3,
            "nees_steps_within_95": 2 / 3,
        }
    )
    assert CONSISTENCY.of(make_errors(np.empty((0, 1)), ("x_m",))) == {}


def test_innovations_count_per_measured_component() -> None:
    """Two components of squared 2 and one of squared 3, one of them gated."""
    three = np.zeros(2, np.int64)
    seen = Innovations(
        "e", "", three, three, np.array([True, False]), np.array([4.0, 2.0]), np.array([2, 1])
    )
    assert INNOVATION.of(seen) == {"nis_per_component": 2.0, "gated_share": 0.5}


def test_the_log_likelihood_is_the_mean_over_the_runs_of_what_was_let_in() -> None:
    """Nothing where one is not stated, as by an estimator that knows none or in an older log."""
    runs = np.array([0, 0, 2])
    accepted = np.array([True, False, True])
    told = Innovations("e", "", runs, runs, accepted, np.ones(3), runs, np.array([-1.0, 0.0, -4.0]))
    assert LIKELIHOOD.of(told) == {"log_likelihood": -2.5}
    assert LIKELIHOOD.of(told._replace(log_likelihood=np.array([-1.0, 0.0, np.nan]))) == {}
    assert LIKELIHOOD.of(told._replace(log_likelihood=None)) == {}
    assert LIKELIHOOD.of(told._replace(log_likelihood=np.array([-1.0, np.nan, -4.0]))) != {}


def test_failed_runs_are_counted_once() -> None:
    stream = make_stream("/estimates/e/a/failure", schemas.FAILURE, [1, 2], reason=[0, 0])
    output = Output("e", "a", "failure", Ragged(stream, np.array([0, 0, 2, 2])), [])
    assert FAILURES.of(output) == {"failed_runs": 1.0}
